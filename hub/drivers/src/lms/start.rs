//! Sequences of requests: the steps that bring a scanner to the requested stream, and the requests to a scanner that
//! already streams. Settings that the scanner does not have, or does not report after a reset, are skipped.

use scanhub_schema::{MILLIS, Nanos};

use crate::lms::command::Request;
use crate::lms::reply::Reply;
use crate::lms::request_channel::{ESSENTIAL_TRIES, TRIES};
use crate::lms::sensor::Sensor;
use crate::lms::variant::{Baud, Variant};

/// Step of a [`Start`], which sends one request. Between two changes of mode or rate, whose replies look the same,
/// there is always another step, so that a late or repeated reply is not taken for the reply to the next change.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Step {
    /// Ends a stream or the installation mode.
    Stop,
    /// Requests the status, which contains the operating mode and proves that the scanner receives requests at this
    /// rate.
    Check,
    Baud,
    Variant,
    Type,
    Configuration,
    Stream,
}

/// Progress of a start. The scanner receives requests. The steps stop its stream, change its baud rate and its
/// settings, and start the requested stream.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Start {
    pub(crate) step: Step,
    /// Number of stops that may still be sent.
    stops_left: u8,
    /// Remaining steps after the scanner has stopped at the target rate.
    setting_steps: &'static [Step],
    /// Whether the scanner has reported its status, which contains the operating mode and the measuring mode.
    has_status: bool,
    /// Whether the scanner has replied to a request for its type.
    has_type: bool,
}

impl Start {
    /// A start whose first step is a check.
    pub(crate) const CHECK: Start = Start {
        step: Step::Check,
        stops_left: MAX_STOPS + 1,
        setting_steps: &[Step::Variant, Step::Type, Step::Configuration, Step::Stream],
        has_status: false,
        has_type: false,
    };

    /// Returns the request of the step and its number of tries.
    pub(crate) fn request(&self, baud: Baud, variant: Variant) -> (Request, u8) {
        match self.step {
            Step::Stop => (Request::Stop, ESSENTIAL_TRIES),
            Step::Check => (Request::Status, ESSENTIAL_TRIES),
            Step::Baud => (Request::Baud(baud), ESSENTIAL_TRIES),
            Step::Variant => (Request::Variant(variant), TRIES),
            Step::Type => (Request::Type, TRIES),
            Step::Configuration => (Request::Configuration, TRIES),
            Step::Stream => (Request::Stream, ESSENTIAL_TRIES),
        }
    }

    /// Returns the start after the `reply` to `request`. The type is not requested again from a scanner that refuses to
    /// report it.
    pub(crate) fn after_reply(self, request: Request, reply: Option<&Reply<'_>>) -> Start {
        Start {
            has_status: self.has_status || matches!(reply, Some(Reply::Status(_))),
            has_type: self.has_type || request == Request::Type,
            ..self
        }
    }

    /// Returns the start with a check as its step.
    pub(crate) fn with_check(self) -> Start {
        Start { step: Step::Check, ..self }
    }

    /// Returns whether the mode of the scanner may be the reason why it refused to change its rate: its status is
    /// unknown, and no stop was sent.
    pub(crate) fn may_be_in_other_mode(&self) -> bool {
        !self.has_status && self.stops_left > MAX_STOPS
    }

    /// Returns the next step after a check.
    pub(crate) fn proceed(self, sensor: &Sensor, is_at_rate: bool, variant: Variant) -> Start {
        match self.stops_left.checked_sub(1) {
            Some(stops_left) if sensor.streams => Start { step: Step::Stop, stops_left, ..self },
            _ if !is_at_rate => Start { step: Step::Baud, ..self },
            _ => self.next_setting(sensor, variant),
        }
    }

    /// Returns the step for the next setting that is not known to be right.
    pub(crate) fn next_setting(mut self, sensor: &Sensor, variant: Variant) -> Start {
        // If no setting is left, the stream was already requested, and its result is unknown.
        self.step = Step::Stream;
        while let Some((&step, rest)) = self.setting_steps.split_first() {
            self.setting_steps = rest;
            let is_known = match step {
                Step::Variant => sensor.variant == Some(variant),
                Step::Type => self.has_type,
                Step::Configuration => self.has_status,
                _ => false,
            };
            if !is_known {
                return Start { step, ..self };
            }
        }
        self
    }
}

/// Requests to a scanner that already streams: its type, which may imply other angles, and its measuring mode, which
/// two replies report. A reply costs the scan that it interrupts. After some rounds, requests are rare and continue
/// only while the measuring mode is unknown, because there are no scans without it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Questions {
    /// Remaining requests of this round.
    remaining: &'static [Request],
    /// Number of complete rounds.
    rounds: u8,
    /// Earliest time of the next request.
    next_at: Nanos,
}

/// Action that follows from the state of [`Questions`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum NextQuestion {
    /// Send this request.
    Send(Request),
    /// Send nothing now. Another round follows.
    Later,
    /// Everything is known, or as much as the scanner reports.
    Done,
    /// The scanner does not report its measuring mode.
    ModeUnknown,
}

impl Questions {
    /// Creates the requests, not to be sent before `start_at`.
    pub(crate) fn new(start_at: Nanos) -> Questions {
        Questions { remaining: STATUS_REQUESTS, rounds: 0, next_at: start_at }
    }

    /// Returns the next action at `now`, right after a scan, while no request is open.
    pub(crate) fn next(&mut self, sensor: &Sensor, now: Nanos) -> NextQuestion {
        if now < self.next_at {
            return NextQuestion::Later;
        }
        let is_unanswered = |question: Request| match question {
            Request::Type => sensor.kind().is_empty(),
            Request::Status => sensor.defective.is_none() || sensor.needs_confirmation(),
            _ => sensor.mode.is_none(),
        };
        while let Some((&question, rest)) = self.remaining.split_first() {
            self.remaining = rest;
            if is_unanswered(question) {
                return NextQuestion::Send(question);
            }
        }
        if STATUS_REQUESTS.iter().any(|&question| is_unanswered(question)) && self.rounds < ROUNDS - 1 {
            self.rounds += 1;
            self.remaining = STATUS_REQUESTS;
            NextQuestion::Later
        } else if sensor.mode.is_some() {
            self.next_at = Nanos::MAX;
            NextQuestion::Done
        } else {
            self.next_at = now + ROUND_PAUSE;
            self.remaining = STATUS_REQUESTS;
            NextQuestion::ModeUnknown
        }
    }
}

/// Number of stops after the first one. A scanner that continues to stream after them does not receive requests.
pub(crate) const MAX_STOPS: u8 = 2;
const STATUS_REQUESTS: &[Request] = &[Request::Type, Request::Status, Request::Configuration];
/// Number of rounds of requests without a pause.
const ROUNDS: u8 = 5;
/// Pause between later rounds.
const ROUND_PAUSE: Nanos = 10_000 * MILLIS;
