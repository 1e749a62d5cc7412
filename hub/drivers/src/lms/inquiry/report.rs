//! What a sensor said of itself, reply by reply as it came. Refuses to know how it was asked.

use crate::lms::command::Request;
use crate::lms::condition::Condition;
use crate::lms::configuration::Configuration;
use crate::lms::errors::Errors;
use crate::lms::reply::Reply;
use crate::lms::status_report::{DIRTY, StatusReport};
use crate::lms::telegram::Encoded;
use crate::lms::variant::Baud;

/// What a sensor said of itself, as it said it.
#[derive(Clone, Debug, Default)]
pub struct Report {
    /// The rate at which it talks; `None` if nothing was heard at any.
    pub baud: Option<Baud>,
    /// Its own address, 0 to 127.
    pub address: Option<u8>,
    /// Whether telegrams came unasked.
    pub streams: bool,
    /// The last status byte that came.
    pub status_byte: Option<u8>,
    /// Bytes that came in all.
    pub bytes: u64,
    replies: [Option<Encoded>; QUESTIONS.len()],
}

impl Report {
    /// Whether it answered at all. One that streams and does not answer does not hear us.
    pub fn answers(&self) -> bool {
        self.replies.iter().any(Option::is_some)
    }

    /// The reply to `request`, if that was asked and answered; a refusal is an answer.
    pub fn reply(&self, request: Request) -> Option<Reply<'_>> {
        Reply::decode(self.replies[place_of(request)?].as_ref()?.telegram())
    }

    /// Its status.
    pub fn status(&self) -> Option<StatusReport<'_>> {
        match self.reply(Request::Status)? {
            Reply::Status(status) => Some(status),
            _ => None,
        }
    }

    /// Type, number and firmware, such as `LMS200;S18063;V02.19`; ASCII by custom.
    pub fn kind(&self) -> Option<&[u8]> {
        match self.reply(Request::Type)? {
            Reply::Type(kind) => Some(kind),
            _ => None,
        }
    }

    /// The first part of its configuration.
    pub fn configuration(&self) -> Option<Configuration<'_>> {
        match self.reply(Request::Configuration)? {
            Reply::Configuration(configuration) => Some(configuration),
            _ => None,
        }
    }

    /// What is wrong with it, and what was.
    pub fn errors(&self) -> Option<Errors<'_>> {
        match self.reply(Request::Errors)? {
            Reply::Errors(errors) => Some(errors),
            _ => None,
        }
    }

    /// Whether its window is dirty, as its status byte says or its status measured; `None` if it told neither.
    pub fn is_polluted(&self) -> Option<bool> {
        let told = self.status_byte.map(|byte| Condition(byte).is_polluted());
        let measured =
            self.status().and_then(|status| status.window_percent()).map(|percent| percent < DIRTY);
        told.max(measured)
    }

    /// Keeps the `reply` to one of the questions.
    pub(super) fn keep(&mut self, request: Request, reply: Encoded) {
        if let Some(place) = place_of(request).and_then(|at| self.replies.get_mut(at)) {
            *place = Some(reply);
        }
    }
}

/// Which question `request` is.
pub(super) fn place_of(request: Request) -> Option<usize> {
    QUESTIONS.iter().position(|&question| question == request)
}

/// What is asked, in this order; the first one finds the rate.
pub(super) const QUESTIONS: [Request; 5] =
    [Request::Status, Request::Type, Request::Configuration, Request::Errors, Request::Counters];
