//! What a telegram costs the whole hub in made-up time, over the number of sensors and of beams: how many sensors one core
//! could serve if their bytes came for nothing. Many sensors are shared out among several hubs, because a hub has 256 links at
//! most and a process not descriptors for more.

use std::time::Duration;

use lms::variant::Variant;

use crate::support::Outcome;
use crate::support::child::Child;
use crate::support::figures::{self, Figure, Target};
use crate::support::options::Options;
use crate::support::stage::{PATIENCE, Stage};
use crate::sweep::{Quantity, Sweep};

/// 1 to 1,000 sensors.
pub(crate) fn sensors(options: &Options) -> Outcome<()> {
    let quantity = |name, unit, linear| Quantity { name, unit, linear };
    let quantities = vec![
        quantity("processor time per telegram, all topics followed", "us", Some(0.0)),
        quantity("nobody there", "us", Some(0.0)),
        quantity("sensors per core, all topics followed", "1", None),
        quantity("nobody there", "1", None),
        quantity("telegrams not received", "1", None),
        quantity("descriptors per sensor and its consumers", "1", None),
    ];
    let mut sweep = Sweep::new("sensors in made-up time", "sensors", quantities);
    let mut of_most = Vec::new();
    let telegrams = options.count(20_000);
    // With fewer telegrams than a turn of all needs, a great number of sensors is left out.
    for sensors in SENSORS.into_iter().filter(|sensors| sensors * 4 <= telegrams) {
        // To have many takes longer than to measure them, and they are many.
        for _ in 0..if sensors > SHARE { 1 } else { runs(options) } {
            let both = run(sensors, Variant::HALF, telegrams, true)
                .and_then(|followed| Ok((followed, run(sensors, Variant::HALF, telegrams, false)?)));
            let (followed, alone) = match both {
                Ok(both) => both,
                // More than this machine has room for.
                Err(error) => {
                    eprintln!("{sensors} sensors in made-up time: {error}");
                    continue;
                }
            };
            let per_core = |us: f64| 1e6 / (us * RATE);
            let descriptors = followed.descriptors / sensors as f64;
            let lost = followed.lost;
            sweep.add(
                sensors,
                &[followed.us, alone.us, per_core(followed.us), per_core(alone.us), lost, descriptors],
            );
            of_most.extend((sensors == MOST).then_some(followed.us));
        }
    }
    sweep.tell(options, 2, "scale-made-up.svg")?;
    if !of_most.is_empty() {
        let figure = Figure {
            name: "per telegram of 1000 sensors",
            unit: "us",
            hub: of_most,
            floor: Vec::new(),
            // As many at their full rate on one core.
            target: Target::Most((1e7 / (MOST as f64 * RATE)).floor() / 10.0),
        };
        figures::print("scale", options.json, &[figure]);
    }
    Ok(())
}

/// All variants, 16 sensors.
pub(crate) fn beams(options: &Options) -> Outcome<()> {
    let quantities = vec![Quantity { name: "processor time per telegram", unit: "us", linear: Some(1.0) }];
    let mut sweep = Sweep::new("beams in made-up time, 16 sensors", "beams", quantities);
    let mut variants = Variant::ALL;
    variants.sort_by_key(|variant| variant.beams());
    for variant in variants {
        for _ in 0..runs(options) {
            sweep.add(variant.beams(), &[run(16, variant, options.count(20_000), true)?.us]);
        }
    }
    sweep.tell(options, 1, "scale-beams.svg")
}

struct Cost {
    /// Processor time per telegram.
    us: f64,
    lost: f64,
    descriptors: f64,
}

/// `sensors` in hubs of their own, which begin together.
fn run(sensors: usize, variant: Variant, telegrams: usize, followed: bool) -> Outcome<Cost> {
    let stage = Stage::new()?;
    let begin = stage.file("begin");
    let name = begin.display().to_string();
    let hubs = sensors.div_ceil(SHARE);
    let beams = variant.beams().to_string();
    let mut parts = Vec::new();
    for number in 0..hubs {
        let share = (sensors * (number + 1) / hubs - sensors * number / hubs).to_string();
        let telegrams = telegrams.div_ceil(hubs).to_string();
        parts.push(stage.part(&["driven", &name, &beams, &share, &telegrams, &followed.to_string()])?);
    }
    // Each telegram on the way to a learned background takes far less than a millisecond.
    let patience = PATIENCE + Duration::from_millis(sensors as u64 * 760);
    parts.iter().try_for_each(|part: &Child| part.await_line("ready", patience).map(drop))?;
    std::fs::write(&begin, "")?;
    let (mut ns, mut published, mut received, mut descriptors) = (0.0, 0.0, 0.0, 0.0);
    for part in &parts {
        let cost = part.await_line("cost", patience)?;
        ns += cost.number(1)? as f64;
        published += cost.number(2)? as f64;
        received += cost.number(3)? as f64;
        descriptors += cost.number(4)? as f64;
    }
    parts.into_iter().try_for_each(|part| part.guard.wait())?;
    Ok(Cost { us: ns / published / 1e3, lost: published - received, descriptors })
}

fn runs(options: &Options) -> usize {
    options.pairs().min(3)
}

const SENSORS: [usize; 6] = [1, 4, 16, 64, 250, MOST];
const MOST: usize = 1000;
/// Sensors of one hub: its descriptors and those of the consumers are in one process.
const SHARE: usize = 125;
/// Scans a second of a sensor with half degrees.
const RATE: f64 = 37.5;
