//! Baud rates of a session: the current rate of the line, the target rate for the stream, and the order in which the
//! search tries all rates.
//!
//! A line such as RS-232 cannot carry 500,000 baud. On such a line, the scanner acknowledges the switch to 500,000 baud
//! and is then unreachable until a power cycle. After [`MAX_SILENT_SWITCHES`] consecutive switches with this result, a
//! session with an automatic rate streams at 38,400 baud, the highest rate of RS-232. The count survives boot messages,
//! sessions and runs of the hub, because the scanner's power is often cycled together with the host's power.
//!
//! The port may not support 500,000 baud either. On a link with a configured LMS, such a port fails to open at this
//! rate. If a search has found the scanner at another rate, the port is open at that rate. The session then tests the
//! port: it sets the port to 500,000 baud for a moment before it switches the scanner.

use scanhub_schema::{MILLIS, Nanos};

use crate::line::KnownRate;
use crate::lms::sensor::Problem;
use crate::lms::session::Settings;
use crate::lms::variant::Baud;

/// Baud rate of the port, with the rates that the session requests.
#[derive(Clone, Debug)]
pub(crate) struct LineRate {
    pub(crate) baud: Baud,
    /// Whether the port must still be set to `baud`.
    pub(crate) needs_change: bool,
    /// Whether the rate of the port cannot be changed.
    is_fixed: bool,
    /// Rate for the stream.
    pub(crate) target: Baud,
    /// Rate for the stream, if the line can carry this rate.
    preferred: Baud,
    /// Whether the session keeps the preferred rate even if the line cannot carry it.
    is_preferred_forced: bool,
    /// Most likely rate of a scanner that does not stream when a session begins.
    idle_rate: Baud,
    /// Rate that the search tries first.
    first_tried: Baud,
    /// Rate at which the search received its last reply.
    found_at: Option<Baud>,
    fast_switches: FastSwitches,
    trial: Trial,
}

/// Test of whether the port supports the target rate.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Trial {
    /// The port is open at the target rate, or the test is complete.
    Done,
    Due,
    /// The port was set to the target rate, and no error has been reported yet.
    Running,
    /// The port does not support the target rate.
    Failed,
}

impl LineRate {
    /// Creates the state for a port that is open at the rate of `settings`.
    pub(crate) fn new(settings: &Settings) -> LineRate {
        let &Settings { baud, fixed_rate, listen_only, keep_baud, .. } = settings;
        LineRate {
            baud,
            needs_change: false,
            is_fixed: fixed_rate,
            target: baud,
            preferred: baud,
            is_preferred_forced: keep_baud || listen_only || fixed_rate,
            idle_rate: POWER_ON_BAUD,
            first_tried: POWER_ON_BAUD,
            found_at: None,
            fast_switches: FastSwitches::default(),
            trial: Trial::Done,
        }
    }

    /// Returns the rate to which the port must be set now. Returns `None` if the port has the right rate.
    pub(crate) fn take_change(&mut self) -> Option<Baud> {
        match self.trial {
            Trial::Due => {
                self.trial = Trial::Running;
                return Some(self.target);
            }
            Trial::Running => {
                self.trial = Trial::Done;
                self.needs_change = true;
            }
            Trial::Failed | Trial::Done => {}
        }
        core::mem::take(&mut self.needs_change).then_some(self.baud)
    }

    /// Handles the port's rejection of the rate that [`LineRate::take_change`] returned.
    pub(crate) fn reject(&mut self) {
        if self.trial == Trial::Running {
            (self.trial, self.target, self.needs_change) = (Trial::Failed, RS232_BAUD, true);
        }
    }

    /// Changes the rate, unless the rate of the port is fixed.
    pub(crate) fn set(&mut self, baud: Baud) {
        if self.baud != baud && !self.is_fixed {
            (self.baud, self.needs_change) = (baud, true);
        }
    }

    /// Starts at `baud`. The port is open at this rate, and a search has found the scanner at this rate.
    pub(crate) fn set_start_rate(&mut self, baud: Baud) {
        (self.idle_rate, self.first_tried) = (baud, baud);
        (self.baud, self.needs_change) = (baud, false);
        if baud != self.target && !self.is_preferred_forced {
            self.trial = Trial::Due;
        }
    }

    /// Starts at the target rate. If no stream arrives, the search first tries the most likely rate. If the scanner was
    /// stopped at the target rate (`is_stopped`), the search first tries the target rate.
    pub(crate) fn begin(&mut self, is_stopped: bool) {
        self.first_tried = if is_stopped { self.target } else { self.idle_rate };
        self.set(self.target);
    }

    /// Makes the search try the target rate first, because the scanner fell silent at that rate.
    pub(crate) fn expect_target(&mut self) {
        self.first_tried = self.target;
    }

    /// Returns the rate at `position` in a round of the search. The order is the most likely rate, the target rate, and
    /// the other rates.
    pub(crate) fn nth_rate(&self, position: usize) -> Baud {
        let (first, target) = (self.first_tried, self.target);
        let second = (first != target).then_some(target);
        let others = SEARCH_ORDER.into_iter().filter(|&baud| baud != first && baud != target);
        [first].into_iter().chain(second).chain(others).nth(position).unwrap_or(target)
    }

    /// Records that the scanner replied at the current rate during the search.
    pub(crate) fn note_found(&mut self) {
        self.found_at = Some(self.baud);
    }

    /// Records the arrival of a telegram.
    pub(crate) fn note_telegram(&mut self) {
        let is_fast = self.baud == FAST_BAUD && !self.needs_change;
        if self.fast_switches.receive(is_fast) {
            self.target = self.preferred;
            self.save_count();
        }
    }

    /// Changes to the target rate, because the scanner has acknowledged the switch.
    pub(crate) fn switch_to_target(&mut self) {
        self.set(self.target);
        if self.target == FAST_BAUD {
            self.fast_switches.acknowledge();
        }
    }

    /// Records that no try of a request got a reply.
    pub(crate) fn note_no_reply(&mut self) {
        if self.baud == FAST_BAUD {
            self.fast_switches.note_no_reply();
            self.save_count();
            self.limit_to_rs232();
        }
    }

    /// Restores the rate at which an earlier session found the scanner. The search tries this rate first.
    pub(crate) fn restore(&mut self, baud: Baud) {
        (self.idle_rate, self.first_tried) = (baud, baud);
    }

    /// Restores the [number of silent switches](Self::silent_switches). Returns whether this number has changed the
    /// target rate.
    pub(crate) fn restore_silent_switches(&mut self, count: u8) -> bool {
        self.fast_switches.silent_switches = count;
        self.limit_to_rs232()
    }

    /// Returns the number of consecutive silent switches to 500,000 baud, at most [`MAX_SILENT_SWITCHES`].
    pub(crate) fn silent_switches(&self) -> u8 {
        self.fast_switches.silent_switches
    }

    /// Returns the rate that the next session should try first, and the number of silent switches. If the line cannot
    /// carry 500,000 baud, the first rate to try is the rate that the session uses instead. Returns `None` if there was
    /// no search.
    pub(crate) fn known(&self) -> Option<KnownRate> {
        let baud = self.replacement().or(self.found_at)?;
        Some(KnownRate { baud: baud.rate(), silent_switches: self.silent_switches() })
    }

    /// Returns whether the scanner has been silent since a switch, so that it needs a power cycle.
    pub(crate) fn has_lost_scanner(&self) -> bool {
        self.fast_switches.have_lost()
    }

    /// Returns the problem that the port or the line does not support the requested rate.
    pub(crate) fn problem(&self) -> Option<Problem> {
        if self.trial == Trial::Failed {
            return Some(Problem::PortLacksRate { fallback: self.target });
        }
        let has_failed = self.preferred == FAST_BAUD && self.fast_switches.have_failed();
        has_failed.then(|| Problem::NeedsRs422 { fallback: self.replacement() })
    }

    /// Returns the rate that replaces the requested rate if the line or the port does not support the requested rate.
    fn replacement(&self) -> Option<Baud> {
        Some(self.target).filter(|&baud| baud != self.preferred)
    }

    /// Makes [`known`](Self::known) return a rate even without a search, so that the next session gets the number of
    /// silent switches.
    fn save_count(&mut self) {
        self.found_at = self.found_at.or(Some(self.idle_rate));
    }

    /// Replaces a target rate of 500,000 baud with 38,400 baud if the line cannot carry 500,000 baud. Returns whether
    /// the target rate changed.
    fn limit_to_rs232(&mut self) -> bool {
        let is_limited =
            self.fast_switches.have_failed() && self.target == FAST_BAUD && !self.is_preferred_forced;
        if is_limited {
            self.target = RS232_BAUD;
        }
        is_limited
    }
}

/// Counter of switches to 500,000 baud that the scanner acknowledged and after which the line was silent.
#[derive(Clone, Copy, Debug, Default)]
struct FastSwitches {
    /// Number of consecutive silent switches.
    silent_switches: u8,
    /// Whether the scanner acknowledged a switch, but no telegram has arrived at the new rate yet.
    is_pending: bool,
    /// Whether the line was silent after the last switch, and no telegram has arrived at any rate since then. The
    /// scanner may need a power cycle.
    is_lost: bool,
}

impl FastSwitches {
    /// Records that the scanner acknowledged a switch to 500,000 baud.
    fn acknowledge(&mut self) {
        self.is_pending = true;
    }

    /// Records the arrival of a telegram. A telegram at 500,000 baud (`is_fast`) proves that the line can carry this
    /// rate. Returns whether the number of silent switches changed.
    fn receive(&mut self, is_fast: bool) -> bool {
        self.is_lost = false;
        if is_fast {
            self.is_pending = false;
            return core::mem::take(&mut self.silent_switches) > 0;
        }
        false
    }

    /// Records that no try of a request got a reply.
    fn note_no_reply(&mut self) {
        if core::mem::take(&mut self.is_pending) {
            self.silent_switches = self.silent_switches.saturating_add(1).min(MAX_SILENT_SWITCHES);
            self.is_lost = true;
        }
    }

    /// Returns whether the session assumes that the line cannot carry 500,000 baud.
    fn have_failed(self) -> bool {
        self.silent_switches >= MAX_SILENT_SWITCHES
    }

    /// Returns whether the last silent switch lost the scanner, and the session assumes that the line cannot carry
    /// 500,000 baud.
    fn have_lost(self) -> bool {
        self.have_failed() && self.is_lost
    }
}

/// Number of silent switches after which the session assumes that the line cannot carry 500,000 baud.
const MAX_SILENT_SWITCHES: u8 = 2;
/// Baud rate that needs RS-422.
const FAST_BAUD: Baud = Baud::B500000;
/// Highest baud rate of RS-232.
const RS232_BAUD: Baud = Baud::B38400;
/// Baud rate of a scanner after power-on, unless the scanner's EEPROM contains another rate.
pub(crate) const POWER_ON_BAUD: Baud = Baud::B9600;
/// Baud rates in the order of a search, the most likely rates first: the rate after power-on, the rate at which an
/// earlier hub may have left the scanner, and the other rates.
pub(crate) const SEARCH_ORDER: [Baud; 4] = [Baud::B9600, Baud::B500000, Baud::B38400, Baud::B19200];
/// Pause after a change of the baud rate, for the UARTs of scanner and adapter.
pub(crate) const SETTLE_TIME: Nanos = 20 * MILLIS;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_only_silent_switches_in_a_row() {
        let mut switches = FastSwitches::default();
        let switch = |switches: &mut FastSwitches, is_silent: bool| {
            switches.acknowledge();
            if is_silent {
                switches.note_no_reply()
            } else {
                assert!(switches.receive(true) || switches.silent_switches == 0)
            }
        };
        switches.note_no_reply();
        assert_eq!(switches.silent_switches, 0, "no switch was acknowledged");
        for is_silent in [true, false, true] {
            switch(&mut switches, is_silent);
        }
        assert_eq!((switches.silent_switches, switches.have_failed()), (1, false));
        assert!(!switches.receive(false), "the boot message at 9,600 baud proves nothing");
        switch(&mut switches, true);
        assert!(switches.have_failed() && switches.have_lost());
        switches.receive(false);
        assert!(switches.have_failed() && !switches.have_lost());
        assert!(switches.receive(true) && !switches.have_failed());
    }
}
