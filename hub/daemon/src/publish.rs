//! What a link makes of a telegram: the telegram itself, its scan, and what follows from that. Refuses to know whether it
//! came down a line or was recorded, and when the next one comes.

use lms::Nanos;
use lms::reply::Reply;
use lms::session::Received;
use lms::telegram::Telegram;
use lms::variant::{Mode, Variant};
use port::clock;
use schema::{Flags, Scan};

use crate::link::LinkThread;

/// What a recording knows of a telegram and nobody could ask a line for; by default nothing.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Past {
    /// The mode of a sensor that cannot be asked.
    pub(crate) mode: Option<Mode>,
    /// Wall clock of its first byte.
    pub(crate) wall_ns: Option<u64>,
    /// Nominal time to the next scan, if it is not that of the link's rate.
    pub(crate) period_us: Option<u32>,
    /// The time to the next scan is longer than nominal, and known.
    pub(crate) gap_us: u32,
    /// How many times longer than then everything takes.
    pub(crate) stretch: f64,
    /// Of its [`Flags`] that it came from a pty.
    pub(crate) flags: u16,
}

impl LinkThread<'_> {
    /// Publishes a telegram and, if it is measured data that can be read, its scan and what is made of it. The time for
    /// which the verdict stands, where there is one.
    pub(crate) fn publish(&mut self, received: &Received<'_>, past: &Past) -> Option<Nanos> {
        let measured = match Reply::decode(received.telegram) {
            Some(Reply::Measured(measured)) => Some(measured),
            _ => None,
        };
        let mode = received.mode.or(past.mode).filter(|mode| mode.has_ranges());
        let forbidden =
            measured.zip(mode).is_some_and(|(measured, mode)| scanner::is_forbidden(&measured, mode));
        let reasons = received.reasons | if forbidden { lms::framer::suspect::FORBIDDEN_BITS } else { 0 };
        self.account.suspect += u64::from(reasons != 0);
        let variant = measured.and_then(|measured| Variant::of_beams(measured.count()));
        let nominal = || scanner::period_us(variant, self.link.baud.rate());
        let period_us = past.period_us.unwrap_or_else(nominal).max(past.gap_us);
        let period_us =
            if past.stretch > 1.0 { (f64::from(period_us) * past.stretch) as u32 } else { period_us };
        if let Some(wall_ns) = past.wall_ns {
            self.topics.recall(wall_ns, Flags::REPLAYED | past.flags);
        }
        self.topics.telegram(received, reasons, period_us);
        // Better no range than a wrong one.
        let (measured, mode) = measured.zip(mode)?;
        self.account.scans += 1;
        let fill = |scan: &mut Scan| scanner::decode(&measured, mode, scan);
        // How it looks around the robot now, what waited in the port does not tell.
        self.pipeline.zones.doubt(self.is_behind);
        if let Some(anew) = self.topics.scan(fill, &mut self.pipeline) {
            tracing::warn!("{}: the background is learned again: {anew}", self.link.name);
        }
        let is_blind = self.pipeline.zones.is_blind();
        if std::mem::replace(&mut self.is_blind, is_blind) != is_blind && is_blind {
            tracing::warn!("{}: zones unknown: too few beams see into the largest circle", self.link.name);
        }
        let limit = limit(period_us);
        // Telegrams that had to wait for the hub are late, but scans do not stay out.
        self.stale_at = clock::now().saturating_add(limit);
        Some(limit)
    }

    /// Lets all that has a memory learn from a telegram which is not published.
    pub(crate) fn learn(&mut self, telegram: Telegram<'_>, mode: Option<Mode>) {
        let Some(mode) = mode.filter(|mode| mode.has_ranges()) else { return };
        if let Some(Reply::Measured(measured)) = Reply::decode(telegram) {
            self.topics.learn(|scan| scanner::decode(&measured, mode, scan), &mut self.pipeline);
        }
    }
}

/// For how long after a scan the verdict on it stands, if scans come every `period_us`.
pub(crate) fn limit(period_us: u32) -> Nanos {
    if period_us == 0 { NO_PERIOD } else { 2000 * Nanos::from(period_us) + GRACE }
}

/// A verdict stands for two scan periods and so much longer.
const GRACE: Nanos = 20 * lms::MILLIS;
/// The same for scans of no variant, which have no nominal period: two of 361 beams at 38400 baud and the grace.
const NO_PERIOD: Nanos = 480 * lms::MILLIS;
