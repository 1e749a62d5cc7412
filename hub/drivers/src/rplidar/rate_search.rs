//! The rate of the line, and the search for it: one rate after the other, until the scanner responds.
//!
//! A scanner that lost its power is soon back at the rate of its last stream, and sends a boot message there. So that
//! rate is remembered.

use scanhub_schema::{MILLIS, Nanos};

use crate::rplidar::model::Model;
use crate::rplidar::session::{DRAIN, FEATURES, Trouble};
use crate::settings::Settings;

/// The rate of the line, and the state of the search for it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct RateSearch {
    baud: u32,
    /// Whether the port has this rate and no other, or nothing can be sent.
    is_fixed: bool,
    /// Whether the port does not have the rate yet.
    is_changed: bool,
    /// Time since which no response has arrived, and the number of bytes read by then.
    quiet_since: Option<(Nanos, u64)>,
    /// Rate of the last stream, until a boot message is received or the session restarts the scanner.
    streamed_at: Option<u32>,
}

impl RateSearch {
    /// Creates a search on a port that is open at the rate of `settings`.
    pub(crate) fn new(settings: &Settings) -> RateSearch {
        RateSearch {
            baud: Model::of(settings).map_or(FEATURES.auto.baud, Model::baud),
            is_fixed: settings.fixed_rate || settings.listen_only,
            is_changed: false,
            quiet_since: None,
            streamed_at: None,
        }
    }

    /// Begins at `baud`, which the port has.
    pub(crate) fn begin_at(&mut self, baud: u32) {
        self.baud = baud;
    }

    /// Returns the rate in bits per second.
    pub(crate) fn baud(&self) -> u32 {
        self.baud
    }

    /// Returns the rate if the port has to be set to it.
    pub(crate) fn take_change(&mut self) -> Option<u32> {
        core::mem::take(&mut self.is_changed).then_some(self.baud)
    }

    /// Returns whether the port has to be set to another rate.
    pub(crate) fn is_changed(&self) -> bool {
        self.is_changed
    }

    /// Ends the search, because the scanner has responded.
    pub(crate) fn end(&mut self) {
        self.quiet_since = None;
    }

    /// Tries the next rate, because no response arrived. `read` is the number of bytes read so far. Returns since when
    /// no response has arrived.
    pub(crate) fn advance(&mut self, now: Nanos, read: u64) -> Nanos {
        let (since, read_before) = *self.quiet_since.get_or_insert((now, read));
        // Stay at the rate of the last stream for a while, so that the boot message is received.
        let may_boot = self.streamed_at == Some(self.baud) && read == read_before && now < since + POWER_ON;
        if let Some(baud) = self.next().filter(|_| !may_boot) {
            self.baud = baud;
            self.is_changed = true;
        }
        since
    }

    /// Returns whether the search is young. During this time, a scanner that streams on after the stop request is not
    /// asked at this rate, because at the right rate it would have stopped. Later a request is sent, because the line
    /// may never be quiet.
    pub(crate) fn is_quick(&self, now: Nanos) -> bool {
        self.quiet_since.is_none_or(|(since, _)| now < since + ROUNDS) && self.next().is_some()
    }

    /// Returns the message that no response has arrived since `since`, after a second.
    pub(crate) fn no_answer(&self, since: Nanos, now: Nanos) -> Option<Trouble> {
        let seconds = (now.saturating_sub(since) / (1_000 * MILLIS)) as u32;
        let baud = self.next().is_none().then_some(self.baud);
        (seconds > 0).then(|| Trouble::NoAnswer { baud, seconds: 1 << seconds.ilog2() })
    }

    /// Handles packets, which arrived at this rate.
    pub(crate) fn note_stream(&mut self) {
        self.streamed_at = Some(self.baud);
    }

    /// Forgets the rate of the last stream if it is this rate. Returns whether it is.
    pub(crate) fn take_stream(&mut self) -> bool {
        self.streamed_at.take_if(|baud| *baud == self.baud).is_some()
    }

    /// Forgets the rate of the last stream.
    pub(crate) fn forget_stream(&mut self) {
        self.streamed_at = None;
    }

    /// Returns the rate after this one. `None` if there is no choice.
    fn next(&self) -> Option<u32> {
        const RATES: [u32; 4] = [115_200, 256_000, 460_800, 1_000_000];
        let at = RATES.iter().position(|rate| *rate == self.baud)?;
        (!self.is_fixed).then(|| RATES[(at + 1) % RATES.len()])
    }
}

/// Maximum time from power-on to the boot message.
const POWER_ON: Nanos = 3_000 * MILLIS;
/// All rates are tried twice in this time if bytes arrive at each of them, because a stop request can be lost.
const ROUNDS: Nanos = 8 * DRAIN;
