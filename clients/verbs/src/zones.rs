//! `scanhub zones SENSOR mask`: learns which readings of a sensor are its own robot, and prints a configuration with
//! which the hub ignores them. Module `body_mask` computes these readings. The verb does not change the configuration
//! of the hub.

mod body_mask;

use std::fmt::Write as _;
use std::fs::File;
use std::io::{IsTerminal, Write};
use std::rc::Rc;
use std::time::{Duration, Instant};

use clap::{Args, Subcommand};
use scanhub_client::streams::Sample;
use scanhub_schema::{Failure, Kind, Pose, Quality, Topic, check_sensor};
use serde::Serialize;

use self::body_mask::{Body, Mask, SLICE_COUNT, Sector};
use crate::context::Context;
use crate::follow::{Event, Notice, RunLimits, TopicRun};
use crate::names::{TopicName, as_argument};
use crate::output::{ExitReason, Output, verb_result};
use crate::{duration, text};

/// Find the robot itself in a sensor's view, to mask it
#[derive(Args, Clone, Debug)]
#[command(after_help = "Example:\n  scanhub zones front mask --for 10s")]
pub struct ZonesArgs {
    /// The sensor
    sensor: String,
    #[command(subcommand)]
    order: ZonesCommand,
}

#[derive(Clone, Debug, Subcommand)]
enum ZonesCommand {
    /// Find the beams that hit the robot itself, and print the configuration that masks them. First place the robot in
    /// an open area with no one near it
    #[command(after_help = "Example:\n  scanhub zones front mask --for 10s")]
    Mask {
        /// Time to observe the sensor, for example 10s
        #[arg(long = "for", default_value = "10s", value_name = "DURATION", value_parser = duration::parse)]
        run_for: Duration,
        /// Maximum distance of the robot's body from its center, in meters [default: the radius of the largest zone]
        #[arg(long, value_name = "RADIUS")]
        within: Option<f64>,
    },
}

impl ZonesArgs {
    /// Observes the sensor for a while, and then writes the mask of the sensor to stdout, as TOML for the hub. Warnings
    /// go to stderr. If stderr is a terminal, the progress is also shown there.
    ///
    /// # Errors
    ///
    /// - [`Kind::Configuration`] if a value is not valid.
    /// - [`Kind::NoHub`] and [`Kind::NoTopic`] as for [`EchoArgs::run`](crate::echo::EchoArgs::run).
    /// - [`Kind::Timeout`] if too few scans arrived.
    /// - [`Kind::Failed`] if the hub exited, or the sensor's settings changed during the observation.
    /// - [`Kind::Interrupted`] if a signal stops the run.
    pub fn run(&self, context: &mut Context) -> Result<(), Failure> {
        let (locations, stop) = (context.domain.locations()?, context.signals.stop()?);
        let (sensor, ZonesCommand::Mask { run_for, within }) = (&self.sensor, &self.order);
        as_argument(check_sensor(sensor))?;
        if let Some(within_m) = within.filter(|metres| !(0.001..=MAX_DISTANCE_M).contains(metres)) {
            let message = format!("--within {within_m} is not a valid radius");
            return Err(Failure::new(
                Kind::Configuration,
                message,
                "use meters from the robot's center, at most 65",
            ));
        }
        if run_for.is_zero() {
            let message = "--for 0s measures nothing";
            return Err(Failure::new(Kind::Configuration, message, "--for 10s is the default"));
        }
        let topics = [Topic::Status, Topic::Zones, Topic::Scan];
        let names: Vec<_> =
            topics.into_iter().map(|topic| TopicName { sensor: sensor.clone(), topic }).collect();
        let limits = RunLimits { run_for: Some(*run_for), ..RunLimits::default() };
        let mut observation = Observation {
            run_for: *run_for,
            since: Instant::now(),
            pose: None,
            within_mm: within.map(|metres| 1000.0 * metres),
            verdicts: 0,
            violated: 0,
            body: None,
            is_shown: context.notes.is_terminal().then_some(false),
            notes: &mut context.notes,
            shown_seconds: 0,
        };
        let end = verb_result(observation.run(&mut TopicRun::new(&names, &[], &locations, &limits, &stop)));
        observation.clear();
        end?;
        let (body, within_mm) = observation.result(sensor)?;
        let (scans, mask) = (body.scans(), body.mask());
        let is_violated = observation.is_violated();
        let found = MaskReport { sensor, run_for: *run_for, within_mm, scans, mask, is_violated };
        let mut notes = Output::new(&mut context.notes);
        verb_result(
            found.warnings().iter().try_for_each(|warning| notes.line(|line| write!(line, "{warning}"))),
        )?;
        let mut output = Output::new(&mut context.out);
        verb_result(if context.json {
            output.json(&found.object())
        } else {
            found.toml().lines().try_for_each(|text| output.line(|line| write!(line, "{text}")))
        })
    }
}

/// State of an observation.
struct Observation<'a> {
    run_for: Duration,
    since: Instant,
    pose: Option<Pose>,
    within_mm: Option<f64>,
    /// Number of zones samples with at least one zone.
    verdicts: u32,
    /// Number of these samples in which the largest zone is violated.
    violated: u32,
    body: Option<Body>,
    notes: &'a mut File,
    /// Whether the progress line is shown; `None` if `notes` is not a terminal.
    is_shown: Option<bool>,
    /// Number of seconds of the observation for which the progress was shown.
    shown_seconds: u64,
}

impl Observation<'_> {
    /// Returns the body and the radius in mm, if the observation is sufficient to distinguish a body from noise.
    fn result(&self, sensor: &str) -> Result<(&Body, f64), Failure> {
        let few = |message: String, hint: String| Err(Failure::new(Kind::Timeout, message, hint));
        let see = format!("`scanhub info {sensor}` shows its state");
        if self.pose.is_none() {
            return few(format!("no status of {sensor} arrived"), see);
        }
        let Some(within_mm) = self.within_mm else {
            return few(format!("no zones of {sensor} arrived"), "--within RADIUS sets their size".into());
        };
        match &self.body {
            None => few(format!("no scan of {sensor} arrived in {:?}", self.run_for), see),
            Some(body) if body.scans() < MIN_SCANS || 2 * body.slice_count() < SLICE_COUNT => {
                let message =
                    format!("only {} scans of {sensor} arrived in {:?}", body.scans(), self.run_for);
                few(message, format!("{MIN_SCANS} are needed, spread over the time: use a longer --for"))
            }
            Some(body) => Ok((body, within_mm)),
        }
    }

    /// Returns whether the largest zone was violated during nearly the whole observation.
    fn is_violated(&self) -> bool {
        self.verdicts > 0 && f64::from(self.violated) >= MIN_VIOLATED_SHARE * f64::from(self.verdicts)
    }

    fn slice(&self) -> usize {
        let share = self.since.elapsed().as_secs_f64() / self.run_for.as_secs_f64();
        ((share * SLICE_COUNT as f64) as usize).min(SLICE_COUNT - 1)
    }

    fn run(&mut self, following: &mut TopicRun<'_>) -> Result<(), ExitReason> {
        while let Some(event) = following.next(None)? {
            match event {
                Event::Sample(name, sample, _) => self.sample(&name, &sample)?,
                Event::Notice(names, notice) => self.notice(&names, notice)?,
                Event::Tick(now) => self.tick(now),
                _ => {}
            }
        }
        Ok(())
    }

    fn sample(&mut self, name: &TopicName, sample: &Sample) -> Result<(), ExitReason> {
        match sample {
            Sample::Status(status) => self.pose = Some(status.pose),
            Sample::Zones(update) => {
                let Some(largest) = update.zones.zones().first() else { return Ok(()) };
                self.within_mm.get_or_insert(f64::from(largest.radius_mm));
                self.verdicts += 1;
                self.violated += u32::from(largest.violated != 0);
            }
            // Ignore suspect telegrams, because they may be damaged.
            Sample::Scan(scan) if scan.header().quality() == Quality::Clean => {
                let slice = self.slice();
                if let (Some(pose), Some(within_mm)) = (self.pose, self.within_mm) {
                    let body = self.body.get_or_insert_with(|| Body::new(pose, within_mm));
                    if !body.add(slice, scan) {
                        let message = format!("{} was set to another resolution or unit", name.sensor);
                        return Err(Failure::new(Kind::Failed, message, "try again").into());
                    }
                }
            }
            _ => {}
        }
        Ok(())
    }

    fn notice(&mut self, names: &[Rc<TopicName>], notice: Notice) -> Result<(), ExitReason> {
        if notice == Notice::HubGone {
            return Err(Failure::new(Kind::Failed, "the hub has exited", "try again when it runs").into());
        }
        self.clear();
        Output::new(self.notes).line(|line| text::notice(line, names, &notice))
    }

    fn tick(&mut self, now: Instant) {
        let seconds = (now - self.since).as_secs();
        if seconds >= self.shown_seconds {
            self.shown_seconds = seconds + 1;
            let scans = self.body.as_ref().map_or(0, Body::scans);
            if let Some(is_shown) = &mut self.is_shown {
                let _ = write!(
                    self.notes,
                    "\r\x1b[K{seconds} of {} s, {scans} scans ..",
                    self.run_for.as_secs_f64()
                );
                *is_shown = true;
            }
        }
    }

    /// Removes the progress line.
    fn clear(&mut self) {
        if self.is_shown == Some(true) {
            let _ = write!(self.notes, "\r\x1b[K");
            self.is_shown = Some(false);
        }
    }
}

/// Result of an observation, for output.
struct MaskReport<'a> {
    sensor: &'a str,
    run_for: Duration,
    within_mm: f64,
    scans: u32,
    mask: Mask,
    /// Whether the hub reported an object in the largest zone nearly all the time.
    is_violated: bool,
}

impl MaskReport<'_> {
    /// Returns the warnings: what the user must check before using the mask.
    fn warnings(&self) -> Vec<String> {
        let within = meters(self.within_mm as u32);
        let mut warnings = Vec::new();
        if self.mask.sectors.is_empty() {
            let so = if self.is_violated {
                // The hub adds zones.margin to its zones, but does not publish the margin.
                "but the largest zone is violated all the time. If by the robot, use a larger --within RADIUS: \
                 at least the zone's radius plus zones.margin"
            } else {
                "no mask is needed"
            };
            warnings.push(format!("the sensor does not see the robot within {within} m of its center: {so}"));
        }
        for Sector { from_mdeg, to_mdeg, range_mm, .. } in &self.mask.moving {
            let (from, to) = (degrees(*from_mdeg), degrees(*to_mdeg));
            warnings.push(format!(
                "from {from} to {to} degrees an object moved, at {} m and farther: it is not in the mask. Try again with no one near",
                meters(*range_mm)
            ));
        }
        if self.beams() * HIDDEN_VIEW_DIVISOR > self.mask.of_beams {
            warnings.push(format!(
                "{} of {} beams are hidden: the hub will be blind there. Try in an open area, with nothing else within {within} m",
                self.beams(),
                self.mask.of_beams
            ));
        }
        warnings
    }

    fn beams(&self) -> usize {
        self.mask.sectors.iter().map(|sector| sector.beams).sum()
    }

    /// Returns the section of the link's configuration that masks the body.
    fn toml(&self) -> String {
        let MaskReport { sensor, run_for, scans, mask, .. } = self;
        let mut text = format!(
            "# Beams of {sensor} that see its own robot within {} m of the center: {} of {} beams, from {scans} scans in {run_for:?}.\n",
            meters(self.within_mm as u32),
            self.beams(),
            mask.of_beams
        );
        text += "# As its own file in /etc/scanhub/conf.d, or without the first lines among the link's other keys.\n";
        let _ = writeln!(text, "[[link]]\nname = \"{sensor}\"\n\n[link.zones]");
        if mask.sectors.is_empty() {
            return text + "body_mask = []\n";
        }
        text += "body_mask = [\n";
        for Sector { from_mdeg, to_mdeg, range_mm, .. } in &mask.sectors {
            let (from, to, range) = (degrees(*from_mdeg), degrees(*to_mdeg), meters(*range_mm));
            let _ = writeln!(text, "    {{ from_deg = {from}, to_deg = {to}, range = {range} }},");
        }
        text + "]\n"
    }

    /// Returns the line of class `mask`.
    fn object(&self) -> impl Serialize {
        #[derive(Serialize)]
        struct MaskJson<'a> {
            class: &'static str,
            sensor: &'a str,
            seconds: f64,
            scans: u32,
            within_m: f64,
            beams: usize,
            of_beams: usize,
            body_mask: Vec<Part>,
            moving: Vec<Part>,
        }
        /// Sector in the units of the configuration: degrees and meters.
        #[derive(Serialize)]
        struct Part {
            from_deg: f64,
            to_deg: f64,
            range: f64,
        }
        let part = |sector: &Sector| Part {
            from_deg: f64::from(sector.from_mdeg) / 1000.0,
            to_deg: f64::from(sector.to_mdeg) / 1000.0,
            range: f64::from(sector.range_mm) / 1000.0,
        };
        MaskJson {
            class: "mask",
            sensor: self.sensor,
            seconds: self.run_for.as_secs_f64(),
            scans: self.scans,
            within_m: self.within_mm / 1000.0,
            beams: self.beams(),
            of_beams: self.mask.of_beams,
            body_mask: self.mask.sectors.iter().map(part).collect(),
            moving: self.mask.moving.iter().map(part).collect(),
        }
    }
}

/// Formats a range in meters as a TOML number: 1000 mm is 1.0.
fn meters(mm: u32) -> String {
    format!("{:?}", f64::from(mm) / 1000.0)
}

fn degrees(mdeg: i32) -> String {
    format!("{:?}", f64::from(mdeg) / 1000.0)
}

/// Minimum number of scans of an observation: five per slice. With fewer scans, the body cannot be distinguished from
/// noise.
const MIN_SCANS: u32 = 50;
/// Minimum share of zones samples with a violated zone for a warning. It is below 1, so that single scans without a
/// reading do not matter.
const MIN_VIOLATED_SHARE: f64 = 0.9;
/// Maximum radius of a zone in meters.
const MAX_DISTANCE_M: f64 = 65.0;
/// Divisor of the number of beams. If the mask hides more than this part of the view (one third), it probably includes
/// the room.
const HIDDEN_VIEW_DIVISOR: usize = 3;
