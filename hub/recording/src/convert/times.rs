//! Times for telegrams that have none: one scan period apart, so that the last one ends when the file was last written.
//! Refuses to know how they are used.

use lms::variant::{Baud, Variant};
use schema::{Flags, Header};

use crate::{Frame, Recording};

/// A clock that moves on by telegrams.
pub(super) struct Times {
    wall_ns: u64,
    begin_ns: u64,
    boot: u64,
    variant: Variant,
}

impl Times {
    /// For `recording`, from its beginning.
    pub(super) fn of(recording: &Recording) -> Times {
        let contents = recording.contents();
        let variant = contents.variant.unwrap_or(Variant::HALF);
        let took_ns = contents.scanner_ns.unwrap_or(contents.scans * scan_ns(variant));
        let begin_ns = match contents.span {
            Some((first_ns, _)) => first_ns,
            None => recording.written_ns().saturating_sub(took_ns),
        };
        // Any number that is another one for another recording.
        let boot = begin_ns.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1;
        Times { wall_ns: begin_ns, begin_ns, boot, variant }
    }

    /// When `frame`, the next one, was measured.
    pub(super) fn wall_ns(&mut self, frame: &Frame) -> u64 {
        let of_scanner = frame.scanner_ns.map(|ns| self.begin_ns.saturating_add(ns));
        let at_ns = frame.wall_ns.or(of_scanner).unwrap_or(self.wall_ns);
        let step_ns = if frame.is_scan() { scan_ns(self.variant) } else { line_ns(frame) };
        self.wall_ns = at_ns.saturating_add(step_ns);
        at_ns
    }

    /// What a hub might have said of `frame`, the next one, which has this `number`, before one at `next_ns`: logs leave
    /// scans out, and nothing newer than a scan can be known until the next one.
    pub(super) fn header(&mut self, frame: &Frame, number: u64, next_ns: Option<u64>) -> Header {
        let wall_ns = self.wall_ns(frame);
        let first_ns = wall_ns.saturating_add(UPTIME_NS).saturating_sub(self.begin_ns);
        let gap_ns = next_ns.map_or(0, |next_ns| next_ns.saturating_sub(wall_ns));
        let period_ns = scan_ns(self.variant).max(gap_ns).min(LONGEST_PERIOD_NS);
        Header {
            seq: number,
            topic_seq: number,
            stamp_first_ns: first_ns,
            stamp_last_ns: first_ns.saturating_add(line_ns(frame)),
            wall_ns,
            boot: self.boot,
            flags: Flags::STAMP_ESTIMATED,
            family: frame.family,
            quality: u8::from(frame.reasons != 0),
            reasons: frame.reasons,
            // Packets are no scans.
            period_us: if frame.scanner_ns.is_some() { 0 } else { (period_ns / 1000) as u32 },
            ..Header::default()
        }
    }
}

/// Time between two scans at the usual rate.
fn scan_ns(variant: Variant) -> u64 {
    variant.period(2 * variant.beams() + 10, Baud::B500000.rate())
}

fn line_ns(frame: &Frame) -> u64 {
    lms::line_time(frame.telegram.len(), Baud::B500000.rate())
}

/// What a header has room for, and what nobody waits for.
const LONGEST_PERIOD_NS: u64 = 3_600_000_000_000;
/// Monotonic clock at the first telegram: that of a machine that has just started.
const UPTIME_NS: u64 = 10_000_000_000;
