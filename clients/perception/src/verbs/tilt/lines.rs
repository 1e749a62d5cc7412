//! The lines that only `tilt` has: what is wrong with the angles, and the end. Refuses to know how that is found.

use std::io::{self, Write};

use crate::tilt::{Counts, Withheld};
use serde::Serialize;

/// Class `angles`.
pub(super) fn angles(sensor: &str, trouble: Option<Withheld>, late_ns: i64) -> impl Serialize {
    #[derive(Serialize)]
    struct Line<'a> {
        class: &'static str,
        sensor: &'a str,
        trouble: Option<&'static str>,
        late_ms: f64,
    }
    Line { class: "angles", sensor, trouble: trouble.map(word), late_ms: late_ms(late_ns) }
}

/// Returns milliseconds with one decimal.
fn late_ms(late_ns: i64) -> f64 {
    (late_ns as f64 / 1e5).round() / 10.0
}

/// Writes that the stamps of the angles of `mount` are late.
pub(super) fn late_text(line: &mut Vec<u8>, mount: &str, late_ns: i64) -> io::Result<()> {
    let late = lateness(late_ns);
    write!(
        line,
        "the stamps of {mount}/tilt are {late}, or its gears have play: corrected. Publish each angle with the time of its \
         measurement"
    )
}

/// Returns by how much stamps are late, or early, as text.
fn lateness(late_ns: i64) -> String {
    format!("{:.1} ms {}", late_ms(late_ns).abs(), if late_ns < 0 { "early" } else { "late" })
}

pub(super) fn angles_text(line: &mut Vec<u8>, trouble: Option<Withheld>) -> io::Result<()> {
    let words = match trouble {
        None => "the angles are well again",
        Some(Withheld::Silent) => {
            "no points: no angles come, or too late; is the program that publishes them running, and its clock right?"
        }
        Some(Withheld::Jumped) => "no points: the angles have jumped",
        Some(Withheld::Inconsistent) => "no points: the angles are not those that their rates say",
        Some(Withheld::Standing) => "no points: the mount stands, or its encoder hangs",
    };
    line.write_all(words.as_bytes())
}

/// The words of all output.
fn word(why: Withheld) -> &'static str {
    match why {
        Withheld::Silent => "silent",
        Withheld::Jumped => "jumped",
        Withheld::Inconsistent => "inconsistent",
        Withheld::Standing => "standing",
    }
}

/// What a run came to.
pub(super) struct Sum {
    pub(super) counts: Counts,
    /// Delay of the stamps of the angles.
    pub(super) late_ns: i64,
    pub(super) missed: u64,
    /// Samples that were not published for lack of memory.
    pub(super) failed: u64,
}

/// Beams with a reading that became no points, by reason.
#[derive(Serialize)]
struct Beams {
    silent: u64,
    jumped: u64,
    inconsistent: u64,
    standing: u64,
}

/// Class `summary`.
pub(super) fn summary<'a>(sensor: &'a str, sum: &Sum) -> impl Serialize + 'a {
    #[derive(Serialize)]
    struct Line<'a> {
        class: &'static str,
        sensor: &'a str,
        sweeps: u64,
        incomplete: u64,
        doubted: u64,
        forgotten: u64,
        scans: u64,
        unordered: u64,
        points: u64,
        withheld: Beams,
        angles: u64,
        angles_unordered: u64,
        angles_ahead: u64,
        angles_unfit: u64,
        missed: u64,
        failed: u64,
        late_ms: f64,
    }
    let Counts { withheld: [silent, jumped, inconsistent, standing], .. } = sum.counts;
    Line {
        class: "summary",
        sensor,
        sweeps: sum.counts.sweeps,
        incomplete: sum.counts.incomplete,
        doubted: sum.counts.doubted,
        forgotten: sum.counts.forgotten,
        scans: sum.counts.scans,
        unordered: sum.counts.unordered,
        points: sum.counts.points,
        withheld: Beams { silent, jumped, inconsistent, standing },
        angles: sum.counts.angles,
        angles_unordered: sum.counts.angles_unordered,
        angles_ahead: sum.counts.angles_ahead,
        angles_unfit: sum.counts.angles_unfit,
        missed: sum.missed,
        failed: sum.failed,
        late_ms: late_ms(sum.late_ns),
    }
}

pub(super) fn summary_text(line: &mut Vec<u8>, sum: &Sum) -> io::Result<()> {
    let Counts { sweeps, incomplete, doubted, scans, points, withheld, angles, .. } = sum.counts;
    write!(
        line,
        "{sweeps} sweeps ({incomplete} incomplete, {doubted} doubted) of {scans} scans, {points} points"
    )?;
    let [silent, jumped, inconsistent, standing] = withheld;
    write!(line, "; withheld: {silent} without an angle, {jumped} jumped, {inconsistent} inconsistent, ")?;
    let Counts { angles_unordered, angles_ahead, angles_unfit, .. } = sum.counts;
    write!(
        line,
        "{standing} standing; {angles} angles; left out: {angles_unordered} late, {angles_ahead} ahead, "
    )?;
    write!(line, "{angles_unfit} unfit, {} missed", sum.missed)?;
    if sum.late_ns != 0 {
        write!(line, "; stamps of angles {}, corrected", lateness(sum.late_ns))?;
    }
    if sum.failed > 0 { write!(line, "; {} not published: no memory", sum.failed) } else { Ok(()) }
}
