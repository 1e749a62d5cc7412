//! The classes of `--json` as text for people: one line per sample, the most important values first. Not a contract.

mod people;
mod processed;
mod tilted;

use std::f64::consts::TAU;
use std::fmt;
use std::io::{self, Write};
use std::rc::Rc;

use scanhub_client::streams::Sample;
use scanhub_schema::{Failure, Flags, Header, PacketFacts, Reasons, Scan, Status, Telegram, in_degrees};

use crate::follow::Notice;
use crate::names::TopicName;
use crate::receive_stats::ReceiveStats;
use crate::show;

pub use people::*;
pub(crate) use processed::*;
pub use tilted::*;

/// Bytes as lower hex, without spaces.
pub(crate) struct Hex<'a>(pub(crate) &'a [u8]);

impl fmt::Display for Hex<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

/// One sample.
pub(crate) fn sample(line: &mut Vec<u8>, name: &TopicName, sample: &Sample) -> io::Result<()> {
    write!(line, "{name} ")?;
    show::text(sample, line)
}

/// One notice, for stderr; news of the hub are the same for all streams.
pub(crate) fn notice(line: &mut Vec<u8>, names: &[Rc<TopicName>], notice: &Notice) -> io::Result<()> {
    match notice {
        Notice::NoHub(Failure { message, hint, .. }) => {
            return write!(line, "{message}, waiting for one: {hint}");
        }
        Notice::HubGone => return write!(line, "no hub, waiting for one"),
        Notice::HubBack => return write!(line, "the hub is here"),
        Notice::Missed(_) | Notice::Stale => {}
    }
    for name in names {
        write!(line, "{name}: ")?;
    }
    match notice {
        Notice::Missed(missed) => write!(line, "missed {missed}"),
        _ => write!(line, "nothing arrives any more"),
    }
}

/// The end of a run.
pub(crate) fn summary(line: &mut Vec<u8>, name: &TopicName, stats: &ReceiveStats) -> io::Result<()> {
    write!(line, "{name}: {} received, {} lost in {:.1} s", stats.received, stats.lost, stats.seconds())?;
    if let Some(hz) = stats.hz() {
        write!(line, ", {hz:.2} Hz")?;
    }
    // That nothing was is not worth a word.
    if let Some(lost) = stats.loss.lost_on_line.filter(|&lost| lost > 0) {
        write!(line, ", {lost} lost on the line")?;
    }
    match stats.loss.damaged.filter(|&share| share > 0.0) {
        Some(share) => write!(line, ", {:.2} % of its bytes damaged", 100.0 * share),
        None => Ok(()),
    }
}

fn numbers(line: &mut Vec<u8>, header: &Header) -> io::Result<()> {
    let seconds = header.stamp_first_ns as f64 / 1e9;
    write!(
        line,
        "seq {} topic_seq {} at {seconds:.6} {}",
        header.seq,
        header.topic_seq,
        header.quality().name()
    )?;
    for reason in Reasons::names(header.reasons) {
        write!(line, " {reason}")?;
    }
    if header.flags & Flags::STAMP_ESTIMATED != 0 { write!(line, " stamp_estimated") } else { Ok(()) }
}

/// What follows the name of a sample of topic `telegram`.
pub(crate) fn telegram(line: &mut Vec<u8>, header: &Header, bytes: &[u8]) -> io::Result<()> {
    const SHOWN: usize = 16;
    numbers(line, header)?;
    let telegram = Telegram { family: header.family(), bytes };
    if telegram.is_lms() {
        write!(line, " address {:02x} command {:02x}", telegram.address(), telegram.command())?;
    }
    match telegram.packets() {
        Some(PacketFacts { kind, packets: 1, .. }) => write!(line, " {kind} of 1 packet")?,
        Some(PacketFacts { kind, packets, .. }) => write!(line, " {kind} of {packets} packets")?,
        None => {}
    }
    write!(line, " {} bytes ", bytes.len())?;
    write!(line, "{}", Hex(&bytes[..bytes.len().min(SHOWN)]))?;
    if bytes.len() > SHOWN { write!(line, "...") } else { Ok(()) }
}

/// What follows the name of a sample of topic `scan`.
pub(crate) fn scan(line: &mut Vec<u8>, header: &Header, scan: &Scan) -> io::Result<()> {
    numbers(line, header)?;
    let beams = scan.beams();
    // Those of the grid: exact ones of the first beams may be a turn more or less.
    let (first, last) = (scan.first_angle, scan.first_angle + scan.step * beams.saturating_sub(1) as f64);
    if (last - first).abs() + scan.step.abs() > TAU - 1e-6 {
        write!(line, " {beams} beams all around")?;
    } else {
        write!(line, " {beams} beams {} to {} deg", in_degrees(first), in_degrees(last))?;
    }
    let valid = (0..beams).filter_map(|i| Some((scan.distance_mm(i)?, i)));
    write!(line, " {} valid", valid.clone().count())?;
    match valid.min() {
        Some((mm, i)) => {
            // The shorter way around from ahead.
            let angle = scan.angle(i);
            let turns = (angle / TAU).round();
            write!(line, " nearest {mm} mm at {} deg", in_degrees(angle - TAU * turns))
        }
        None => Ok(()),
    }
}

/// What follows the name of a sample of topic `status`.
pub(crate) fn status(line: &mut Vec<u8>, status: &Status) -> io::Result<()> {
    let state = status.state().map_or("unknown", |state| state.name());
    write!(line, "{state} {} Bd ", status.baud)?;
    if let Some(hz) = status.rate_hz() {
        write!(line, "{hz:.2} Hz ")?;
    }
    write!(line, "{}", status.port())?;
    if let Some(loss) = status.line_loss() {
        write!(line, " {loss}")?;
    }
    if !status.last_error().is_empty() {
        write!(line, " last error: {}", status.last_error())?;
    }
    Ok(())
}
