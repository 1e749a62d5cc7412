//! Sequences of requests: the steps that start the requested stream, and the requests to a scanner that already
//! streams. The session skips settings that the scanner does not have, or does not report after a reset.

use scanhub_schema::{MILLIS, Nanos};

use crate::lms::command::Request;
use crate::lms::reply::Reply;
use crate::lms::request_channel::{ESSENTIAL_TRIES, TRIES};
use crate::lms::sensor::Sensor;
use crate::lms::variant::{Baud, Variant};

/// Step of a [`Start`]. Each step sends one request. The replies to a change of mode and to a change of rate look the
/// same. Another step is therefore always between two changes, so that a late or repeated reply does not count as the
/// reply to the next change.
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

/// Progress of the start of a stream. The scanner already receives requests. The steps stop a running stream, change
/// the scanner's baud rate and settings, and start the requested stream.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Start {
    pub(crate) step: Step,
    /// Number of stop requests that the session may still send.
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

    /// Returns the start after the `reply` to `request`. If a scanner refuses to report its type, the session does not
    /// request the type again.
    pub(crate) fn after_reply(self, request: Request, reply: Option<&Reply<'_>>) -> Start {
        Start {
            has_status: self.has_status || matches!(reply, Some(Reply::Status(_))),
            has_type: self.has_type || request == Request::Type,
            ..self
        }
    }

    /// Returns the start with [`Step::Check`] as its step.
    pub(crate) fn with_check(self) -> Start {
        Start { step: Step::Check, ..self }
    }

    /// Returns whether the scanner may have refused to change its rate because of its mode. This is the case if the
    /// scanner's status is unknown and no stop request was sent.
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

    /// Returns the step for the next setting that may be wrong.
    pub(crate) fn next_setting(mut self, sensor: &Sensor, variant: Variant) -> Start {
        // If no setting is left, the session has already requested the stream, but does not know the result.
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

/// Requests to a scanner that already streams. The session requests the type, because a version S14 has other angles,
/// and the measuring mode, which the status and the configuration contain. A reply costs the scan that it interrupts,
/// so requests become rare after some rounds. The session then continues to send them only while the measuring mode is
/// unknown, because it cannot return scans without the mode.
#[derive(Clone, Copy, Debug)]
pub(crate) struct StreamQueries {
    /// Remaining requests of this round.
    remaining: &'static [Request],
    /// Number of complete rounds.
    rounds: u8,
    /// Earliest time of the next request.
    next_at: Nanos,
}

/// Action that follows from the state of [`StreamQueries`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum NextQuery {
    /// Send this request.
    Send(Request),
    /// Send nothing now. Another round follows.
    Later,
    /// The scanner has reported everything that it can report.
    Done,
    /// The scanner does not report its measuring mode.
    ModeUnknown,
}

impl StreamQueries {
    /// Creates the requests. The first request is sent at `start_at` or later.
    pub(crate) fn new(start_at: Nanos) -> StreamQueries {
        StreamQueries { remaining: STATUS_REQUESTS, rounds: 0, next_at: start_at }
    }

    /// Returns the next action at `now`. Call it right after a scan, while no request is open.
    pub(crate) fn next(&mut self, sensor: &Sensor, now: Nanos) -> NextQuery {
        if now < self.next_at {
            return NextQuery::Later;
        }
        let is_unanswered = |request: Request| match request {
            Request::Type => sensor.kind().is_empty(),
            Request::Status => sensor.defective.is_none() || sensor.needs_confirmation(),
            _ => sensor.mode.is_none(),
        };
        while let Some((&request, rest)) = self.remaining.split_first() {
            self.remaining = rest;
            if is_unanswered(request) {
                return NextQuery::Send(request);
            }
        }
        if STATUS_REQUESTS.iter().any(|&request| is_unanswered(request)) && self.rounds < ROUNDS - 1 {
            self.rounds += 1;
            self.remaining = STATUS_REQUESTS;
            NextQuery::Later
        } else if sensor.mode.is_some() {
            self.next_at = Nanos::MAX;
            NextQuery::Done
        } else {
            self.next_at = now + ROUND_PAUSE;
            self.remaining = STATUS_REQUESTS;
            NextQuery::ModeUnknown
        }
    }
}

/// Maximum number of stop requests after the first one. A scanner that still streams after all these requests does not
/// receive requests.
pub(crate) const MAX_STOPS: u8 = 2;
const STATUS_REQUESTS: &[Request] = &[Request::Type, Request::Status, Request::Configuration];
/// Number of rounds of requests before the first pause.
const ROUNDS: u8 = 5;
/// Pause between later rounds.
const ROUND_PAUSE: Nanos = 10_000 * MILLIS;
