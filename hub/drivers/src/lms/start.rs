//! Sequences of requests: the steps that bring a scanner to the requested stream, and the questions to a scanner that
//! streams already. Settings that a scanner does not have, or does not report right after a reset, are left out.

use scanhub_schema::{MILLIS, Nanos};

use crate::lms::command::Request;
use crate::lms::reply::Reply;
use crate::lms::request_channel::{ESSENTIAL_TRIES, TRIES};
use crate::lms::sensor::Sensor;
use crate::lms::variant::{Baud, Variant};

/// Step of a [`Start`], each a request. Between two changes of mode or rate, whose replies look alike, there is always
/// another one. So a reply that is late, or arrives twice, is not taken for the next one's.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Step {
    /// Ends a stream, or the installation mode.
    Stop,
    /// Requests what the scanner does now, which also shows whether it receives at this rate.
    Check,
    Baud,
    Variant,
    Type,
    Configuration,
    Stream,
}

/// Progress of a start: the scanner receives requests, and is brought to rest, to the rate to stream at, to its
/// settings, and to a stream.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Start {
    pub(crate) step: Step,
    /// Number of stops that may still be sent.
    stops_left: u8,
    /// Steps once the scanner is at rest, at the rate to stream at.
    setting_steps: &'static [Step],
    /// Whether the scanner has reported its status, which contains what it does and how its values are split.
    has_status: bool,
    /// Whether the scanner has replied to a request for its type.
    has_type: bool,
}

impl Start {
    /// A start that begins with a check.
    pub(crate) const CHECK: Start = Start {
        step: Step::Check,
        stops_left: MAX_STOPS + 1,
        setting_steps: &[Step::Variant, Step::Type, Step::Configuration, Step::Stream],
        has_status: false,
        has_type: false,
    };

    /// Returns the request of the step, and its number of tries.
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

    /// Returns the start after the `reply` to `request`. A scanner that refuses to report its type is not asked again.
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

    /// Returns whether a scanner that refused to change its rate may be in a mode that does not allow it, because its
    /// status is not known and it was not stopped.
    pub(crate) fn may_be_in_other_mode(&self) -> bool {
        !self.has_status && self.stops_left > MAX_STOPS
    }

    /// Returns the next step, now that it is known what the scanner does.
    pub(crate) fn proceed(self, sensor: &Sensor, is_at_rate: bool, variant: Variant) -> Start {
        match self.stops_left.checked_sub(1) {
            Some(stops_left) if sensor.streams => Start { step: Step::Stop, stops_left, ..self },
            _ if !is_at_rate => Start { step: Step::Baud, ..self },
            _ => self.next_setting(sensor, variant),
        }
    }

    /// Returns the step for the next setting that is not known to be right.
    pub(crate) fn next_setting(mut self, sensor: &Sensor, variant: Variant) -> Start {
        // Without any left, the stream was requested, and it is not known what came of it.
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

/// Questions to a scanner that streams: who it is, which may say at which angles it measures, and how its values are
/// split, which two replies report. A reply costs the scan that it interrupts. After some rounds, only how values are
/// split is requested, and rarely: without it there are no scans.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Questions {
    /// The rest of this round.
    remaining: &'static [Request],
    /// Number of complete rounds.
    rounds: u8,
    /// Earliest time of the next question.
    next_at: Nanos,
}

/// Action that follows from the questions.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum NextQuestion {
    /// Send this request.
    Send(Request),
    /// Nothing now: the next round follows.
    Later,
    /// All is known, or as much as the scanner reports.
    Done,
    /// The scanner does not report how its values are split.
    ModeUnknown,
}

impl Questions {
    /// Returns the questions from the time `next_at` on.
    pub(crate) fn new(start_at: Nanos) -> Questions {
        Questions { remaining: STATUS_REQUESTS, rounds: 0, next_at: start_at }
    }

    /// Returns what follows at `now`, right after a scan, while no request is open.
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

/// Number of stops after the first one. A scanner that continues after them does not receive them.
pub(crate) const MAX_STOPS: u8 = 2;
const STATUS_REQUESTS: &[Request] = &[Request::Type, Request::Status, Request::Configuration];
/// Number of rounds of questions without a pause.
const ROUNDS: u8 = 5;
/// Pause between later rounds.
const ROUND_PAUSE: Nanos = 10_000 * MILLIS;
