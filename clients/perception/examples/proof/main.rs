//! Proof of the tracker: simulated people in a simulated house, scored by the package `motmetrics`.
//!
//! ```sh
//! cargo run --release -p scanhub-perception --example proof -- --seeds 601..611
//! ```
//!
//! `PROOF_PYTHON` names a Python that has `motmetrics` and numpy below 2.

mod baseline;
mod diagnosis;
mod hours;
mod house;
mod oracle;
mod run;
mod walkers;

use std::collections::BTreeMap;
use std::io::Write;
use std::ops::Range;
use std::process::{Command, Stdio};

use house::House;
use run::{Outcome, ProofSetup, TrackerKind, run};

const SCORE: &str = include_str!("score.py");

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let value = |flag: &str| arguments.iter().position(|a| a == flag).and_then(|i| arguments.get(i + 1));
    let number = |text: &str| text.parse::<u64>().unwrap_or_else(|_| usage());
    if let Some(hours) = value("--hours") {
        return hours::run(number(hours), value("--people").map_or(8, |text| number(text) as usize));
    }
    let (from, to) = value("--seeds").map_or((1, 11), |range| {
        range.split_once("..").map_or_else(|| usage(), |(a, b)| (number(a), number(b)))
    });
    let seconds = value("--seconds").map_or(120, |text| number(text)) as f64;
    let has = |flag: &str| arguments.iter().any(|argument| argument == flag);
    println!("seeds {from} to {}, {seconds} s each", to - 1);
    let of_seeds =
        |seeds: Range<u64>, people, seconds, (restless, sits), is_ideal, tracker| -> Vec<Outcome> {
            let house = House { is_ideal };
            let setup = |seed| ProofSetup {
                people,
                seconds,
                seed,
                room_change_share: restless,
                sit_share: sits,
                house,
                tracking: tracker,
            };
            seeds.map(|seed| run(setup(seed))).collect()
        };
    let all = |people, seconds, shares, is_ideal, tracker| {
        of_seeds(from..to, people, seconds, shares, is_ideal, tracker)
    };
    if let Some(people) = value("--people") {
        let outcomes = all(number(people) as usize, seconds, USUAL_SHARES, has("--ideal"), TrackerKind::All);
        return report(people, &outcomes);
    }
    let cases: &[(&str, usize, TrackerKind)] = &[
        ("3 people", 3, TrackerKind::All),
        ("8 people", 8, TrackerKind::All),
        ("20 people", 20, TrackerKind::All),
        ("8 people, one sensor a room", 8, TrackerKind::OneSensorEach),
        ("20 people, one sensor a room", 20, TrackerKind::OneSensorEach),
        ("8 people, nearest segment", 8, TrackerKind::NearestSegment),
        ("20 people, nearest segment", 20, TrackerKind::NearestSegment),
    ];
    let is_quick = has("--quick");
    for (title, is_ideal) in [("sensors as they are", false), ("ideal sensor", true)] {
        if has("--ideal") && !is_ideal {
            continue;
        }
        println!(
            "\n{title}\n\n| | IDF1 | MOTA | switches | misses | false | RMS mm | corridor | oracle | doors | us a scan | x real time |"
        );
        println!("|---|---|---|---|---|---|---|---|---|---|---|---|");
        let cases = if is_quick || is_ideal { &cases[1..3] } else { cases };
        for &(name, people, tracker) in cases {
            report(name, &all(people, seconds, USUAL_SHARES, is_ideal, tracker));
        }
        if is_quick {
            return;
        }
    }
    if has("--ideal") {
        return;
    }
    println!();
    let sitter = of_seeds(from..from + 20, 1, 180.0, (0.25, 1.0), false, TrackerKind::All);
    report("one person who sits down and leaves, 20 seeds", &sitter);
    let empty = all(0, 600.0, USUAL_SHARES, false, TrackerKind::All);
    let false_tracks: usize = empty.iter().map(|outcome| outcome.tracks).sum();
    println!("empty rooms: {:.3} false tracks a minute", false_tracks as f64 / (10.0 * empty.len() as f64));
    let stands = all(1, 630.0, (-1.0, 0.0), false, TrackerKind::All);
    let stands: Vec<(usize, f64)> = stands.iter().map(|outcome| outcome.late_ids[0]).collect();
    let kept_share = stands.iter().filter(|(ids, share)| *ids == 1 && *share > 0.98).count();
    println!("standing for 10 minutes: {kept_share} of {} kept under one identity", stands.len());
    let passages = all(2, 600.0, (1.0, 0.0), false, TrackerKind::All);
    let sum = |f: &dyn Fn(&Outcome) -> usize| passages.iter().map(f).sum::<usize>();
    let (real, counted, right) = (sum(&|o| o.doors.0), sum(&|o| o.doors.1), sum(&|o| o.doors.2));
    println!(
        "passages of doors: {real}, reported {counted}, right {right}: {:.4}",
        right as f64 / real.max(counted) as f64
    );
}

/// Share of rests that end with a change of the room, and share of rests on a chair.
const USUAL_SHARES: (f64, f64) = (0.25, 0.12);

fn usage() -> ! {
    eprintln!(
        "proof [--seeds FROM..TO] [--seconds N] [--people N] [--ideal] [--quick] [--why] | proof --hours N [--people N]"
    );
    std::process::exit(2);
}

fn report(name: &str, outcomes: &[Outcome]) {
    let scores: Option<Vec<Vec<f64>>> = outcomes.iter().map(|outcome| score(&outcome.csv)).collect();
    let scores = scores.unwrap_or_default();
    let mean = |i: usize| match scores.len() {
        0 => "-".to_owned(),
        n => format!("{:.3}", scores.iter().map(|score| score[i]).sum::<f64>() / n as f64),
    };
    let share = |i: usize| match scores.len() {
        0 => "-".to_owned(),
        _ => {
            let sum = |i: usize| scores.iter().map(|score| score[i]).sum::<f64>();
            if i == 2 { format!("{}", sum(2)) } else { format!("{:.4}", sum(i) / sum(5)) }
        }
    };
    let sum = |f: &dyn Fn(&Outcome) -> f64| outcomes.iter().map(f).sum::<f64>();
    let rms = (sum(&|o| o.squared_errors.0) / sum(&|o| o.squared_errors.1 as f64)).sqrt();
    let crossings = sum(&|o| o.crossings.0 as f64);
    let time_s = sum(&|o| o.simulated_s);
    println!(
        "| {name} | {} | {} | {} | {} | {} | {:.0} | {:.3} of {crossings} | {:.3} | {:.3} of {} | {:.1} | {:.0} |",
        mean(0),
        mean(1),
        share(2),
        share(3),
        share(4),
        1000.0 * rms,
        sum(&|o| o.crossings.1 as f64) / crossings,
        sum(&|o| o.crossings.2 as f64) / crossings,
        sum(&|o| o.doors.2 as f64) / sum(&|o| o.doors.0.max(o.doors.1) as f64),
        sum(&|o| o.doors.0 as f64),
        1e6 * sum(&|o| o.tracker_time_s) / (time_s * 100.0),
        time_s / sum(&|o| o.tracker_time_s),
    );
    let offset = outcomes.iter().map(|o| o.offset_error_s.abs()).fold(0.0, f64::max);
    let bounds: Vec<f64> = outcomes.iter().filter_map(|o| Some(score(&o.oracle_csv)?[0])).collect();
    println!(
        "<!-- late {}, worst clock offset left {:.1} ms, IDF1 of perfect places with the oracle's identities {:.3} -->",
        sum(&|o| o.late as f64),
        1000.0 * offset,
        bounds.iter().sum::<f64>() / bounds.len() as f64
    );
    if std::env::args().any(|argument| argument == "--why") {
        print_causes(outcomes);
    }
}

/// Prints the causes of lost IDs, and the position errors by class.
fn print_causes(outcomes: &[Outcome]) {
    let (mut causes, mut errors) = (BTreeMap::new(), BTreeMap::new());
    for diagnosis in outcomes.iter().filter_map(|outcome| outcome.diagnosis.as_ref()) {
        for (cause, count) in &diagnosis.causes {
            *causes.entry(*cause).or_insert(0) += count;
        }
        for (class, (squares, count)) in &diagnosis.errors {
            let sum = errors.entry(*class).or_insert((0.0, 0));
            *sum = (sum.0 + squares, sum.1 + count);
        }
    }
    causes.iter().for_each(|(cause, count)| println!("{count:6} {cause}"));
    for (class, (squares, count)) in &errors {
        println!(
            "{count:6} {class}: RMS {:.0} mm, squares {squares:.1} m2",
            1000.0 * (squares / *count as f64).sqrt()
        );
    }
}

fn score(csv: &str) -> Option<Vec<f64>> {
    let python = std::env::var("PROOF_PYTHON").unwrap_or_else(|_| "python3".to_owned());
    let child = Command::new(&python)
        .args(["-c", SCORE])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn();
    let mut child = child.ok()?;
    child.stdin.take()?.write_all(csv.as_bytes()).ok();
    let out = child.wait_with_output().ok().filter(|out| out.status.success());
    if out.is_none() {
        eprintln!("no score: {python} has no motmetrics; name another by PROOF_PYTHON");
    }
    String::from_utf8(out?.stdout).ok()?.split_whitespace().map(|word| word.parse().ok()).collect()
}
