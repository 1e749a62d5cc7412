//! The rate of the line: the one to stream at, and the order in which the search for a scanner tries the others.
//!
//! A line may not be able to carry 500,000 baud, such as RS-232. There, the scanner acknowledges the switch, and then
//! does not communicate before its power is cycled. After [`MAX_SILENT_SWITCHES`] such switches in a row, a session with an
//! automatic rate streams at 38,400 baud, the highest rate of RS-232. The count outlives boot messages, sessions and
//! runs of the hub: the power of a scanner is often cycled together with that of its host.
//!
//! The port may not be able to have 500,000 baud either. A named LMS is refused there when the port is opened. If a
//! search has found the scanner at another rate, the port is set to 500,000 baud for a moment before the scanner is
//! switched to it.

use scanhub_schema::{MILLIS, Nanos};

use crate::line::KnownRate;
use crate::lms::sensor::Problem;
use crate::lms::session::Settings;
use crate::lms::variant::Baud;

/// The rate of the line.
#[derive(Clone, Debug)]
pub(crate) struct LineRate {
    pub(crate) baud: Baud,
    /// Whether the port does not have the rate yet.
    pub(crate) needs_change: bool,
    /// Whether the port has one rate and no other.
    is_fixed: bool,
    /// Rate to stream at.
    pub(crate) target: Baud,
    /// Rate to stream at if the line can carry it.
    preferred: Baud,
    /// Whether to keep to the wanted rate even if the line cannot carry it.
    is_preferred_forced: bool,
    /// The most likely rate of a scanner that does not stream when a session begins.
    idle_rate: Baud,
    /// The rate that the search tries first.
    first_tried: Baud,
    /// The rate at which the search had its last reply.
    found_at: Option<Baud>,
    fast_switches: FastSwitches,
    trial: Trial,
}

/// Trial whether the port can have the rate to stream at.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Trial {
    /// The port is open at that rate, or it was tried.
    Done,
    Due,
    /// The port was set to that rate.
    Running,
    /// The port cannot have that rate.
    Failed,
}

impl LineRate {
    /// Creates the rate of a port that is open at the rate of `settings`.
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

    /// Returns the rate if the port has to be set to it.
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

    /// Handles that the port cannot have the rate to which it was to be set.
    pub(crate) fn reject(&mut self) {
        if self.trial == Trial::Running {
            (self.trial, self.target, self.needs_change) = (Trial::Failed, RS232_BAUD, true);
        }
    }

    /// Changes the rate, unless the port has only one.
    pub(crate) fn set(&mut self, baud: Baud) {
        if self.baud != baud && !self.is_fixed {
            (self.baud, self.needs_change) = (baud, true);
        }
    }

    /// Begins at `baud`, at which the port is open and a search has found the scanner.
    pub(crate) fn begin_at(&mut self, baud: Baud) {
        (self.idle_rate, self.first_tried) = (baud, baud);
        (self.baud, self.needs_change) = (baud, false);
        if baud != self.target && !self.is_preferred_forced {
            self.trial = Trial::Due;
        }
    }

    /// Begins at the rate to stream at. If there is no stream, the search tries that rate first if the scanner was
    /// stopped there (`is_stopped`), otherwise the most likely one.
    pub(crate) fn begin(&mut self, is_stopped: bool) {
        self.first_tried = if is_stopped { self.target } else { self.idle_rate };
        self.set(self.target);
    }

    /// Makes the search try the rate to stream at first, because the scanner fell silent there.
    pub(crate) fn expect_target(&mut self) {
        self.first_tried = self.target;
    }

    /// Returns the rate number `turn` of a round of the search: the most likely one, the one to stream at, the others.
    pub(crate) fn nth_rate(&self, position: usize) -> Baud {
        let (first, target) = (self.first_tried, self.target);
        let second = (first != target).then_some(target);
        let others = SEARCH_ORDER.into_iter().filter(|&baud| baud != first && baud != target);
        [first].into_iter().chain(second).chain(others).nth(position).unwrap_or(target)
    }

    /// Handles that the search had a reply.
    pub(crate) fn note_found(&mut self) {
        self.found_at = Some(self.baud);
    }

    /// Handles a telegram.
    pub(crate) fn note_telegram(&mut self) {
        let is_fast = self.baud == FAST_BAUD && !self.needs_change;
        if self.fast_switches.receive(is_fast) {
            self.target = self.preferred;
            self.save_count();
        }
    }

    /// Changes to the rate to stream at, because the scanner has acknowledged the switch.
    pub(crate) fn switch_to_target(&mut self) {
        self.set(self.target);
        if self.target == FAST_BAUD {
            self.fast_switches.acknowledge();
        }
    }

    /// Handles a request that got no reply in all its tries.
    pub(crate) fn note_no_reply(&mut self) {
        if self.baud == FAST_BAUD {
            self.fast_switches.note_no_reply();
            self.save_count();
            self.limit_to_rs232();
        }
    }

    /// Restores the rate at which an earlier session found the scanner.
    pub(crate) fn restore(&mut self, baud: Baud) {
        (self.idle_rate, self.first_tried) = (baud, baud);
    }

    /// Restores the [number of silent switches](Self::silent_switches). Returns whether the rate to stream at has
    /// changed because of them.
    pub(crate) fn restore_silent_switches(&mut self, count: u8) -> bool {
        self.fast_switches.silent_switches = count;
        self.limit_to_rs232()
    }

    /// Returns the number of silent switches to 500,000 baud in a row, at most [`MAX_SILENT_SWITCHES`].
    pub(crate) fn silent_switches(&self) -> u8 {
        self.fast_switches.silent_switches
    }

    /// Returns what the next search should know. For a line that cannot carry 500,000 baud, it is the rate in use.
    /// `None` if there was no search.
    pub(crate) fn known(&self) -> Option<KnownRate> {
        let baud = self.replacement().or(self.found_at)?;
        Some(KnownRate { baud: baud.rate(), silent_switches: self.silent_switches() })
    }

    /// Returns whether the scanner was lost in a switch, and needs a power cycle.
    pub(crate) fn has_lost_scanner(&self) -> bool {
        self.fast_switches.have_lost()
    }

    /// Returns the message that the port or the line cannot have the wanted rate, if so.
    pub(crate) fn problem(&self) -> Option<Problem> {
        if self.trial == Trial::Failed {
            return Some(Problem::PortLacksRate { fallback: self.target });
        }
        let has_failed = self.preferred == FAST_BAUD && self.fast_switches.have_failed();
        has_failed.then(|| Problem::NeedsRs422 { fallback: self.replacement() })
    }

    /// Returns the rate that is used in place of the wanted one, if the line cannot carry that one.
    fn replacement(&self) -> Option<Baud> {
        Some(self.target).filter(|&baud| baud != self.preferred)
    }

    /// Has [`known`](Self::known) return a rate even without a search, so that the number of silent switches is saved
    /// with it.
    fn save_count(&mut self) {
        self.found_at = self.found_at.or(Some(self.idle_rate));
    }

    /// Streams at 38,400 baud in place of 500,000 baud from now on if the line cannot carry that rate. Returns whether
    /// it is a change.
    fn limit_to_rs232(&mut self) -> bool {
        let is_limited =
            self.fast_switches.have_failed() && self.target == FAST_BAUD && !self.is_preferred_forced;
        if is_limited {
            self.target = RS232_BAUD;
        }
        is_limited
    }
}

/// Switches to 500,000 baud that the scanner acknowledged, and after which no telegram arrived.
#[derive(Clone, Copy, Debug, Default)]
struct FastSwitches {
    /// Number of silent switches in a row.
    silent_switches: u8,
    /// Whether a switch was acknowledged, and no telegram has arrived at the new rate yet.
    is_pending: bool,
    /// Whether the last switch was silent, and no telegram has arrived at any rate since. The scanner may need a power
    /// cycle.
    is_lost: bool,
}

impl FastSwitches {
    /// Handles the acknowledgment of a switch to 500,000 baud.
    fn acknowledge(&mut self) {
        self.is_pending = true;
    }

    /// Handles a telegram. If it arrived at 500,000 baud (`is_fast`), the line can carry that rate. Returns whether
    /// that is news.
    fn receive(&mut self, is_fast: bool) -> bool {
        self.is_lost = false;
        if is_fast {
            self.is_pending = false;
            return core::mem::take(&mut self.silent_switches) > 0;
        }
        false
    }

    /// Handles a request that got no reply in all its tries.
    fn note_no_reply(&mut self) {
        if core::mem::take(&mut self.is_pending) {
            self.silent_switches = self.silent_switches.saturating_add(1).min(MAX_SILENT_SWITCHES);
            self.is_lost = true;
        }
    }

    /// Returns whether the line counts as one that cannot carry 500,000 baud.
    fn have_failed(self) -> bool {
        self.silent_switches >= MAX_SILENT_SWITCHES
    }

    /// Returns whether the scanner was lost in the switch that made the line count as one that cannot carry 500,000
    /// baud, or in a later one.
    fn have_lost(self) -> bool {
        self.have_failed() && self.is_lost
    }
}

/// Silent switches after which the line counts as one that cannot carry 500,000 baud.
const MAX_SILENT_SWITCHES: u8 = 2;
/// The rate that needs RS-422.
const FAST_BAUD: Baud = Baud::B500000;
/// The highest rate of RS-232.
const RS232_BAUD: Baud = Baud::B38400;
/// A scanner begins at this rate, unless its EEPROM contains another one.
pub(crate) const POWER_ON_BAUD: Baud = Baud::B9600;
/// The rates in the order of a search, the most likely ones first: after power-on, after a hub, the others.
pub(crate) const SEARCH_ORDER: [Baud; 4] = [Baud::B9600, Baud::B500000, Baud::B38400, Baud::B19200];
/// After a change of the rate, the UARTs of scanner and adapter need a moment.
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
