//! From a sensor that hears us, whatever it does, to the stream that is wanted: it is brought to rest, to the wanted
//! rate, to its settings. What some sensors do not have, or do not answer right after a reset, is done without.

use crate::line::State;
use crate::lms::command::Request;
use crate::lms::dialogue::{Dialogue, FAST};
use crate::lms::phase::{MORE_TRIES, Phase, Progress, SETTLE, STOPS, Step, TRIES};
use crate::lms::reply::Reply;
use crate::lms::sensor::Trouble;
use schema::Nanos;

impl Dialogue {
    /// What the sensor does now is known: goes on from there.
    pub(crate) fn proceed(&mut self, progress: Progress, now: Nanos) {
        match progress.stops_left.checked_sub(1) {
            Some(stops_left) if self.sensor.streams => {
                self.enter(Step::Stop, Progress { stops_left, ..progress }, now);
            }
            _ if self.baud != self.settings.baud => self.enter(Step::Baud, progress, now),
            _ => self.settle(progress, now),
        }
    }

    /// The next of the settings that is not as it should be.
    fn settle(&mut self, mut progress: Progress, now: Nanos) {
        while let Some((&step, rest)) = progress.settings.split_first() {
            progress.settings = rest;
            let is_known = match step {
                Step::Variant => self.sensor.variant == Some(self.settings.variant),
                Step::Type => progress.has_type,
                Step::Configuration => progress.has_status,
                _ => false,
            };
            if !is_known {
                return self.enter(step, progress, now);
            }
        }
        // The stream was asked for, and what came of it is not known.
        self.enter(Step::Stream, progress, now);
    }

    /// Says what belongs to `step`.
    pub(crate) fn enter(&mut self, step: Step, progress: Progress, now: Nanos) {
        let (request, tries) = match step {
            Step::Stop => (Request::Stop, MORE_TRIES),
            Step::Check => (Request::Status, MORE_TRIES),
            Step::Baud => (Request::Baud(self.settings.baud), MORE_TRIES),
            Step::Variant => (Request::Variant(self.settings.variant), TRIES),
            Step::Type => (Request::Type, TRIES),
            Step::Configuration => (Request::Configuration, TRIES),
            Step::Stream => (Request::Stream, MORE_TRIES),
        };
        self.streamed_at = None;
        self.phase = Phase::Starting { step, progress };
        self.ask(request, now, tries);
    }

    /// The sensor answered.
    pub(crate) fn on_step(
        &mut self,
        step: Step,
        progress: Progress,
        request: Request,
        reply: Option<Reply<'_>>,
        now: Nanos,
    ) {
        let failed = matches!(reply, Some(Reply::Refused | Reply::Mode { done: false }));
        let was_told = progress.has_status;
        let progress = progress.after(request, reply.as_ref());
        match step {
            // Not in the mode in which it is, which was not asked yet.
            Step::Baud if failed && !was_told && progress.stops_left > STOPS => {
                self.enter(Step::Check, progress, now);
            }
            Step::Stop | Step::Baud | Step::Stream if failed => self.refused(request, now),
            Step::Stop => {
                self.sensor.streams = false;
                self.enter(Step::Check, progress, now);
            }
            Step::Check => self.proceed(progress, now),
            Step::Baud => {
                self.change_baud(self.settings.baud);
                if self.settings.baud == FAST {
                    self.fast_switches.acknowledge();
                }
                self.enter(Step::Check, progress, now + SETTLE);
            }
            Step::Variant => {
                self.variant_refused = !matches!(reply, Some(Reply::Variant { done: true, .. }));
                self.settle(progress, now);
            }
            Step::Type | Step::Configuration => self.settle(progress, now),
            // The stream is there when its first telegram is, which is due like one that went missing.
            Step::Stream => {
                let until = self.silent_at(now);
                self.phase = Phase::Listening {
                    give_up_at: until,
                    quiet_at: until,
                    shown: State::Starting,
                    attempt: 0,
                };
            }
        }
    }

    /// The sensor did not answer in all its tries, or `heard` the request and did not say what it did.
    pub(crate) fn on_no_reply(
        &mut self,
        step: Step,
        progress: Progress,
        request: Request,
        heard: bool,
        at: Nanos,
    ) {
        match step {
            Step::Variant | Step::Type | Step::Configuration => {
                self.variant_refused |= step == Step::Variant;
                self.doubt(progress, at);
            }
            Step::Stop | Step::Stream if heard => self.doubt(progress, at),
            Step::Stop | Step::Check | Step::Baud | Step::Stream => {
                if self.baud == FAST {
                    self.fast_switches.give_up();
                    // Report a rate even if the scanner was found by its boot message, so that the count is saved with it.
                    self.found_at = self.found_at.or(Some(self.rest_at));
                    self.limit_rate();
                }
                let is_lost = self.fast_switches.have_lost();
                self.trouble = (!is_lost).then_some(Trouble::Unanswered(request));
                self.probe(at, 0);
            }
        }
    }

    /// The sensor may have gone: asks whether it is there, but not for long.
    fn doubt(&mut self, progress: Progress, at: Nanos) {
        self.phase = Phase::Starting { step: Step::Check, progress };
        self.ask(Request::Status, at, TRIES);
    }
}
