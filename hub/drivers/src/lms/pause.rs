//! Handles a user's requests while a session runs, above all the pause: finds the sensor if necessary, stops it, and
//! repeats the stop while it continues to stream. In the end it reports whether the sensor stopped, or that this is
//! not known.

use crate::line::{Control, State};
use crate::lms::command::Request;
use crate::lms::dialogue::Dialogue;
use crate::lms::phase::{Phase, STOPS, Step, TRIES};
use crate::lms::reply::Reply;
use crate::lms::sensor::Trouble;
use schema::Nanos;

impl Dialogue {
    pub(crate) fn control(&mut self, control: Control, now: Nanos) {
        match (control, self.phase) {
            (_, Phase::Following) => {}
            (Control::Pause, phase) if !self.is_paused => {
                self.is_paused = true;
                self.trouble = None;
                match phase {
                    // At which rate it hears is not known, or changes at this moment.
                    Phase::Probing { .. }
                    | Phase::Listening { shown: State::Probing, .. }
                    | Phase::Starting { step: Step::Baud, .. } => self.probe(now, 0),
                    _ => self.stop(now),
                }
            }
            (Control::Resume, _) if self.is_paused => self.begin(now),
            (Control::Resync, _) => {
                self.resyncs += 1;
                self.begin(now);
            }
            (Control::Pause | Control::Resume, _) => {}
        }
    }

    /// The sensor hears at this rate, and shall stop.
    pub(crate) fn stop(&mut self, now: Nanos) {
        self.phase = Phase::Paused { stops_left: STOPS };
        self.streamed_at = None;
        self.heard = false;
        self.ask(Request::Stop, now, TRIES);
    }

    /// The sensor continues, or nothing that it sent shows that it stopped.
    pub(crate) fn stop_again(&mut self, now: Nanos) {
        match self.phase {
            // Nobody is there, or a sensor at rest.
            _ if !self.heard => {}
            Phase::Paused { stops_left: 0 } => self.trouble = Some(Trouble::NotStopped),
            Phase::Paused { stops_left } => {
                self.stop(now);
                self.phase = Phase::Paused { stops_left: stops_left - 1 };
            }
            _ => {}
        }
    }

    /// The sensor answered the stop.
    pub(crate) fn on_stopped(&mut self, reply: Option<Reply<'_>>, now: Nanos) {
        if matches!(reply, Some(Reply::Mode { done: true })) {
            self.sensor.streams = false;
            self.trouble = None;
        } else {
            self.stop_again(now);
        }
    }

    /// Nobody answered at any rate: what sends all the same does not listen.
    pub(crate) fn nobody_to_stop(&mut self) {
        self.phase = Phase::Paused { stops_left: 0 };
        self.trouble = self.heard.then_some(Trouble::NotStopped);
    }

    /// The sensor has just got its power, and is at rest.
    pub(crate) fn come_to_rest(&mut self) {
        self.open = None;
        self.phase = Phase::Paused { stops_left: STOPS };
        self.trouble = None;
    }
}
