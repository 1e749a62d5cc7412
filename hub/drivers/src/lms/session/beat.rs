//! The beat of a stream: when its scans are due. Refuses to know what a scan says.

use super::Session;
use crate::line::{Session as _, State};
use crate::lms::arrival::Stamp;
use crate::lms::reply::Reply;
use crate::lms::telegram::Telegram;
use crate::lms::variant::Variant;
use schema::Nanos;

impl Session {
    /// Time between two scans like `telegram`, which says `reply`, if it is one of a stream whose beat is known.
    pub(super) fn period(&self, telegram: Telegram<'_>, reply: Option<&Reply<'_>>) -> Option<Nanos> {
        let Some(Reply::Measured(measured)) = reply.filter(|_| self.is_live()) else { return None };
        let variant = Variant::of_beams(measured.count()).filter(|_| measured.partial().is_none())?;
        Some(variant.period(telegram.bytes().len(), self.dialogue.baud.rate()))
    }

    /// When the scan at `offset` of `len` bytes began, if it waited with others for a host that did not run: by its place
    /// among them, as far as when it was read allows.
    pub(super) fn due(&self, first: &Stamp, offset: u64, len: u64) -> Option<Nanos> {
        let latest = first.latest?;
        let slots = (offset - self.last_scan + len / 2) / len;
        self.cadence.after(slots).map(|due| due.clamp(first.at, latest))
    }

    /// Whether a sensor streams, not a recording.
    pub(super) fn is_live(&self) -> bool {
        self.state() == State::Streaming && !self.dialogue.settings.listen_only
    }

    /// Whether what is read comes as often, and is on the line for as long, as the wanted rate says.
    pub(super) fn is_at_rate(&self) -> bool {
        // What was read before a change came at the rate before it.
        self.dialogue.change_baud.is_none() && self.dialogue.baud == self.dialogue.settings.baud
    }

    /// Neither a recording nor a network has the pace of a line.
    pub(super) fn has_pace(&self) -> bool {
        !(self.dialogue.settings.listen_only || self.dialogue.settings.fixed_rate)
    }
}
