//! What is wrong with a link, in words for its status: the session's trouble, a unit that is not the configured one,
//! more bytes than its line can bring, consumers that get nothing. Refuses to know when a status goes out.

use lms::{Session, Trouble};

use crate::link::LinkThread;

impl LinkThread<'_> {
    /// Whether the port may go away again before it brings anything, as it did the last time: a serial server that
    /// serves somebody else takes each connection and closes it. Then it is not said anew that it is there.
    pub(crate) fn is_doubtful(&self, session: &Session) -> bool {
        let is_silent = session.tally().read == 0 && session.trouble().is_none();
        !self.doubt.is_empty() && is_silent && session.state() == lms::State::Probing
    }

    /// What is wrong, in words; empty if nothing is.
    pub(crate) fn trouble(&self, session: &Session) -> String {
        if self.is_doubtful(session) {
            return self.doubt.clone();
        }
        if self.is_flooded {
            return format!(
                "the server sends more than a line of {} baud carries; the hub reads at most twice that; the serial \
                 server must be in raw mode at that rate",
                self.link.baud.rate()
            );
        }
        let unit = session.sensor().unit;
        match (session.trouble(), unit, self.link.unit) {
            (Some(Trouble::NoAnswer { .. }), _, _) if self.settings(false).fixed_rate => format!(
                "no answer at {} baud, the rate set in the serial server: check power, cable, rate",
                self.link.baud.rate()
            ),
            (Some(trouble), _, _) => trouble.to_string(),
            (None, Some(is), Some(expected)) if is != expected => format!(
                "the sensor measures in units of {} mm, the configuration says {} mm; the unit is stored in its EEPROM, \
                 which the hub never writes",
                is.mm(),
                expected.mm()
            ),
            _ if self.unreached >= UNREACHED_LIMIT => self.unserved(),
            _ => {
                let fault = session.sensor().notices().find(|notice| notice.is_fault());
                fault.map_or_else(String::new, |notice| notice.to_string())
            }
        }
    }

    /// Says once that the measuring mode has no marks, which is no error, and what changes it.
    pub(crate) fn tell_mode(&mut self) {
        let status = self.account.last();
        if std::mem::replace(&mut self.told_mode, status.mode) != status.mode
            && let Some(remedy) = status.reflector_remedy()
        {
            let name = &self.link.name;
            tracing::info!("{name}: marks are unavailable; stop the hub and run `{remedy}`");
        }
    }

    /// Notices consumers that stay without samples.
    pub(crate) fn watch_reach(&mut self) {
        let before = self.unreached;
        self.unreached = if self.unreached_now() > 0 { before.saturating_add(1) } else { 0 };
        if self.unreached == UNREACHED_LIMIT || before >= UNREACHED_LIMIT && self.unreached == 0 {
            // Whoever is served shall read it in the status.
            self.facts = None;
        }
        if self.unreached == UNREACHED_LIMIT {
            tracing::warn!("{}: {}", self.link.name, self.unserved());
        }
    }

    /// Notices that the port brings more than its line can, or does not any more.
    pub(crate) fn watch_flood(&mut self, is_flooded: bool) {
        if std::mem::replace(&mut self.is_flooded, is_flooded) != is_flooded {
            self.facts = None;
        }
    }

    fn unreached_now(&self) -> usize {
        self.topics.unreached(self.account.is_streaming())
    }

    fn unserved(&self) -> String {
        let count = self.unreached_now();
        format!(
            "{count} consumers are attached but get nothing: raise the limit of open descriptors (ulimit -n)"
        )
    }
}

/// Statuses after which unreached consumers are more than ones that are just attaching.
const UNREACHED_LIMIT: u32 = 3;
