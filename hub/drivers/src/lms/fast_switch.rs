//! Detects a line that cannot carry 500,000 baud, such as RS-232.
//!
//! There, the scanner acknowledges the switch, and then receives and sends nothing until its power is cycled. After
//! [`MOST_SILENT`] such switches in a row, a session with an automatic rate streams at 38,400 baud, the highest rate of
//! RS-232. The count outlives boot messages, sessions and runs of the hub: the power of a scanner is often cycled together
//! with that of its host.

/// Switches to 500,000 baud that the scanner acknowledged, and after which no telegram arrived.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct FastSwitches {
    /// Number of silent switches in a row.
    silent: u8,
    /// Whether a switch was acknowledged, and no telegram has arrived at the new rate yet.
    is_pending: bool,
    /// Whether the last switch was silent, and no telegram has arrived at any rate since. The scanner may need a power cycle.
    is_lost: bool,
}

impl FastSwitches {
    /// Restores the number of silent switches that an earlier session counted.
    pub(crate) fn restore(&mut self, silent: u8) {
        self.silent = silent;
    }

    /// Handles the acknowledgment of a switch to 500,000 baud.
    pub(crate) fn acknowledge(&mut self) {
        self.is_pending = true;
    }

    /// Handles a telegram. If it arrived at 500,000 baud (`is_fast`), the line can carry that rate. Returns whether that is
    /// news.
    pub(crate) fn receive(&mut self, is_fast: bool) -> bool {
        self.is_lost = false;
        if is_fast {
            self.is_pending = false;
            return core::mem::take(&mut self.silent) > 0;
        }
        false
    }

    /// Handles a request that got no reply in all its tries.
    pub(crate) fn give_up(&mut self) {
        if core::mem::take(&mut self.is_pending) {
            self.silent = self.silent.saturating_add(1).min(MOST_SILENT);
            self.is_lost = true;
        }
    }

    /// Returns the number of silent switches in a row, at most [`MOST_SILENT`].
    pub(crate) fn silent(self) -> u8 {
        self.silent
    }

    /// Returns whether the line counts as one that cannot carry 500,000 baud.
    pub(crate) fn have_failed(self) -> bool {
        self.silent >= MOST_SILENT
    }

    /// Returns whether the scanner was lost in the switch that made the line count as one that cannot carry 500,000 baud,
    /// or in a later one.
    pub(crate) fn have_lost(self) -> bool {
        self.have_failed() && self.is_lost
    }
}

/// Silent switches after which the line counts as one that cannot carry 500,000 baud.
pub(crate) const MOST_SILENT: u8 = 2;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_only_silent_switches_in_a_row() {
        let mut switches = FastSwitches::default();
        let switch = |switches: &mut FastSwitches, is_silent: bool| {
            switches.acknowledge();
            if is_silent {
                switches.give_up()
            } else {
                assert!(switches.receive(true) || switches.silent == 0)
            }
        };
        switches.give_up();
        assert_eq!(switches.silent(), 0, "no switch was acknowledged");
        for is_silent in [true, false, true] {
            switch(&mut switches, is_silent);
        }
        assert_eq!((switches.silent(), switches.have_failed()), (1, false));
        assert!(!switches.receive(false), "the boot message at 9,600 baud proves nothing");
        switch(&mut switches, true);
        assert!(switches.have_failed() && switches.have_lost());
        switches.receive(false);
        assert!(switches.have_failed() && !switches.have_lost());
        assert!(switches.receive(true) && !switches.have_failed());
    }
}
