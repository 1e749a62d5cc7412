//! The lines that only `track` has: who went through doors, and the end. Refuses to know how that is found.

use std::io::{self, Write};
use std::time::Duration;

use crate::track::Counts;
use serde::Serialize;

/// Class `count`.
pub(super) fn count<'a>(
    sensor: &'a str,
    door: &'a str,
    passed: [u64; 2],
    wall_ns: u64,
) -> impl Serialize + 'a {
    #[derive(Serialize)]
    struct Line<'a> {
        class: &'static str,
        sensor: &'a str,
        wall_ns: u64,
        #[serde(flatten)]
        door: Passed<'a>,
    }
    Line { class: "count", sensor, wall_ns, door: Passed::of((door, passed)) }
}

/// Class `misplaced`.
pub(super) fn misplaced<'a>(
    tracker: &'a str,
    wall_ns: u64,
    name: &'a str,
    other: &'a str,
    off: [f64; 2],
) -> impl Serialize + 'a {
    #[derive(Serialize)]
    struct Line<'a> {
        class: &'static str,
        sensor: &'a str,
        wall_ns: u64,
        name: &'a str,
        other: &'a str,
        dx_m: f64,
        dy_m: f64,
    }
    let [dx_m, dy_m] = off.map(|value| (100.0 * value).round() / 100.0);
    Line { class: "misplaced", sensor: tracker, wall_ns, name, other, dx_m, dy_m }
}

pub(super) fn misplaced_text(line: &mut Vec<u8>, name: &str, other: &str, off: [f64; 2]) -> io::Result<()> {
    let [x, y] = off;
    write!(
        line,
        "{name} sees people ({x:.2}, {y:.2}) m beside where {other} sees them: correct one of their poses "
    )?;
    write!(line, "in the site file; until then {name} is taken to be where {other} says")
}

/// Class `late`.
pub(super) fn late<'a>(
    tracker: &'a str,
    wall_ns: u64,
    name: &'a str,
    late: u64,
    delay: Duration,
) -> impl Serialize + 'a {
    #[derive(Serialize)]
    struct Line<'a> {
        class: &'static str,
        sensor: &'a str,
        wall_ns: u64,
        name: &'a str,
        late: u64,
        delay_ms: u64,
    }
    let delay_ms = u64::try_from(delay.as_millis()).unwrap_or(u64::MAX);
    Line { class: "late", sensor: tracker, wall_ns, name, late, delay_ms }
}

pub(super) fn late_text(line: &mut Vec<u8>, name: &str, late: u64, delay: Duration) -> io::Result<()> {
    match late {
        1 => write!(line, "{name}: 1 scan was dropped because it arrived late")?,
        _ => write!(line, "{name}: {late} scans were dropped because they arrived late")?,
    }
    write!(line, ": set --delay longer than {delay:?}")
}

#[derive(Serialize)]
struct Passed<'a> {
    door: &'a str,
    /// From the room that `from` names to that which `to` names.
    forth: u64,
    back: u64,
}

impl<'a> Passed<'a> {
    fn of((door, [forth, back]): (&'a str, [u64; 2])) -> Passed<'a> {
        Passed { door, forth, back }
    }
}

/// What a run came to, beside its doors.
pub(super) struct Sum {
    pub(super) pictures: u64,
    pub(super) appeared: u64,
    pub(super) counts: Counts,
    pub(super) missed: u64,
    /// Samples that were not published for lack of memory.
    pub(super) failed: u64,
}

/// Class `summary`.
pub(super) fn summary<'a>(sensor: &'a str, sum: &Sum, doors: &[(&'a str, [u64; 2])]) -> impl Serialize + 'a {
    #[derive(Serialize)]
    struct Line<'a> {
        class: &'static str,
        sensor: &'a str,
        pictures: u64,
        appeared: u64,
        doors: Vec<Passed<'a>>,
        scans: u64,
        late: u64,
        jumped: u64,
        unfit: u64,
        missed: u64,
        failed: u64,
    }
    let Counts { scans, late, jumped, unfit } = sum.counts;
    Line {
        class: "summary",
        sensor,
        pictures: sum.pictures,
        appeared: sum.appeared,
        doors: doors.iter().map(|&door| Passed::of(door)).collect(),
        scans,
        late,
        jumped,
        unfit,
        missed: sum.missed,
        failed: sum.failed,
    }
}

pub(super) fn count_text(line: &mut Vec<u8>, door: &str, [forth, back]: [u64; 2]) -> io::Result<()> {
    write!(line, "{door}: {forth} forth, {back} back")
}

pub(super) fn summary_text(line: &mut Vec<u8>, sum: &Sum, doors: &[(&str, [u64; 2])]) -> io::Result<()> {
    let Counts { scans, late, jumped, unfit } = sum.counts;
    write!(line, "{} people appeared in {scans} scans", sum.appeared)?;
    for (name, passed) in doors {
        write!(line, "; ")?;
        count_text(line, name, *passed)?;
    }
    write!(line, "; left out: {late} late, {jumped} jumped, {unfit} unfit, {} missed", sum.missed)?;
    if sum.failed > 0 { write!(line, "; {} not published: no memory", sum.failed) } else { Ok(()) }
}
