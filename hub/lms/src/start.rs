//! From a sensor that hears us, whatever it does, to the stream that is wanted: it is brought to rest, to the wanted
//! rate, to its settings. What some sensors do not have, or do not answer right after a reset, is done without.

use crate::Nanos;
use crate::command::Request;
use crate::dialogue::Dialogue;
use crate::phase::{MORE_TRIES, Phase, SETTLE, STOPS, Step, TRIES};
use crate::reply::Reply;
use crate::sensor::{State, Trouble};

impl Dialogue {
    /// What the sensor does now is known: goes on from there.
    pub(crate) fn proceed(&mut self, stops_left: u8, now: Nanos) {
        let step = match stops_left.checked_sub(1) {
            Some(left) if self.sensor.streams => return self.enter(Step::Stop, left, now),
            _ if self.baud != self.settings.baud => Step::Baud,
            _ => Step::Variant,
        };
        self.enter(step, stops_left, now);
    }

    /// Says what belongs to `step`.
    pub(crate) fn enter(&mut self, step: Step, stops_left: u8, now: Nanos) {
        let (request, tries) = match step {
            Step::Stop => (Request::Stop, MORE_TRIES),
            Step::Check => (Request::Status, MORE_TRIES),
            Step::Baud => (Request::Baud(self.settings.baud), MORE_TRIES),
            Step::Variant if self.sensor.variant == Some(self.settings.variant) => {
                return self.enter(Step::Type, stops_left, now);
            }
            Step::Variant => (Request::Variant(self.settings.variant), TRIES),
            Step::Type => (Request::Type, TRIES),
            Step::Configuration => (Request::Configuration, TRIES),
            Step::Stream => (Request::Stream, MORE_TRIES),
        };
        self.phase = Phase::Starting { step, stops_left };
        self.ask(request, now, tries);
    }

    /// The sensor answered.
    pub(crate) fn on_step(
        &mut self,
        step: Step,
        stops_left: u8,
        request: Request,
        reply: Option<Reply<'_>>,
        now: Nanos,
    ) {
        let failed = matches!(reply, Some(Reply::Refused | Reply::Mode { done: false }));
        match step {
            Step::Stop | Step::Baud | Step::Stream if failed => self.refused(request, now),
            Step::Stop => {
                self.sensor.streams = false;
                self.enter(Step::Check, stops_left, now);
            }
            Step::Check => self.proceed(stops_left, now),
            Step::Baud => {
                self.change_baud(self.settings.baud);
                self.enter(Step::Check, stops_left, now + SETTLE);
            }
            Step::Variant => {
                let done = matches!(reply, Some(Reply::Variant { done: true, .. }));
                self.trouble = (!done).then_some(Trouble::VariantRefused);
                self.enter(Step::Type, stops_left, now);
            }
            Step::Type => self.enter(Step::Configuration, stops_left, now),
            Step::Configuration => self.enter(Step::Stream, stops_left, now),
            // The stream is there when its first telegram is, which is due like one that went missing.
            Step::Stream => {
                self.phase =
                    Phase::Listening { give_up_at: self.silent_at(now), shown: State::Starting, attempt: 0 };
            }
        }
    }

    /// The sensor did not answer in all its tries.
    pub(crate) fn on_no_reply(&mut self, step: Step, stops_left: u8, request: Request, at: Nanos) {
        match step {
            Step::Variant => {
                self.trouble = Some(Trouble::VariantRefused);
                self.enter(Step::Type, stops_left, at);
            }
            Step::Type => self.enter(Step::Configuration, stops_left, at),
            Step::Configuration => self.enter(Step::Stream, stops_left, at),
            Step::Stop | Step::Check | Step::Baud | Step::Stream => {
                self.trouble = Some(Trouble::Unanswered(request));
                self.probe(at, 0);
            }
        }
    }
}

const _: () = assert!(STOPS > 0, "a stream must be stopped once");
