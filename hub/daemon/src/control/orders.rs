//! What users want of one link, in the link's thread: each request is taken, done and answered. What pausing does to a
//! sensor is the session's business, what a reset does to a background the pipeline's.

use std::os::fd::{AsFd, BorrowedFd};
use std::sync::mpsc::{Receiver, Sender};
use std::sync::{Arc, PoisonError};

use config::Processing;
use lms::{Control, Nanos, Session};
use port::clock;
use schema::{Failure, Kind, Shown, Verb, Wake};

use super::{Changed, Order, Outcome};
use crate::bell::Bell;
use crate::learned::Slot;
use crate::link::LinkThread;
use crate::replay::Player;

/// The link's end of the way from the desk.
pub(crate) struct Orders {
    pub(super) sensor: String,
    pub(super) paused: bool,
    pub(super) queue: Receiver<Order>,
    pub(super) changed: Changed,
    pub(super) bell: Arc<Bell>,
    pub(super) outcomes: Sender<(u64, Outcome)>,
    pub(super) desk: Arc<Bell>,
}

/// Who can be told to pause, to resume, to begin anew.
pub(crate) enum Flow<'a> {
    /// A session with a sensor.
    Session(&'a mut Session),
    /// Nobody, for now.
    Away,
    /// The player of a recording.
    Recording(&'a Player),
}

impl LinkThread<'_> {
    /// Does what users asked for, and takes over what was changed for it.
    pub(crate) fn obey(&mut self, mut flow: Flow<'_>) {
        if let Some(processing) = self.orders.changed() {
            self.change(&processing);
        }
        while let Some(order) = self.orders.take() {
            let control = match order.verb {
                Verb::Pause => Some(Control::Pause),
                Verb::Resume => Some(Control::Resume),
                Verb::Resync => Some(Control::Resync),
                Verb::Show | Verb::Reset | Verb::Freeze | Verb::Thaw | Verb::Load => None,
            };
            let outcome = match control {
                Some(control) => self.orders.control(control, &mut flow).map(|()| None),
                None => {
                    let shown = self.pipeline.obey(&self.link.name, order.verb, &order.model);
                    let kept_wall_ns = self.around.slot.and_then(Slot::kept_wall_ns);
                    shown.map(|model| model.map(|model| Box::new(Shown { model: *model, kept_wall_ns })))
                }
            };
            let now = clock::now();
            if self.topics.background(&mut self.pipeline, now) {
                self.topics.wake(Wake::Status);
            }
            self.orders.answer(order.number, outcome);
        }
    }

    /// From the next scan on. Where none come, the topics say at once how it is now.
    fn change(&mut self, processing: &Processing) {
        self.pipeline.change(processing);
        self.account.set_pose(processing.pose);
        let now = clock::now();
        if self.stale_at == Nanos::MAX {
            self.topics.stale(&mut self.pipeline, now);
        }
        self.topics.background(&mut self.pipeline, now);
        self.topics.wake(Wake::Status);
        self.next_status = now;
    }
}

impl Orders {
    /// Whether a user wants nothing of the sensor for now: a pause outlasts an absence of the port.
    pub(crate) fn is_paused(&self) -> bool {
        self.paused
    }

    fn control(&mut self, control: Control, flow: &mut Flow<'_>) -> Result<(), Failure> {
        match flow {
            Flow::Recording(player) => {
                match control {
                    Control::Pause => player.pause(),
                    Control::Resume => player.resume(),
                    Control::Resync => return Err(self.refusal("a recording has no session to restart")),
                }
                return Ok(());
            }
            Flow::Away if control == Control::Resync => return Err(self.refusal("the port is away")),
            Flow::Away => {}
            Flow::Session(session) => session.control(control, clock::now()),
        }
        self.paused = control == Control::Pause;
        Ok(())
    }

    fn changed(&self) -> Option<Box<Processing>> {
        self.bell.hush();
        self.changed.lock().unwrap_or_else(PoisonError::into_inner).take()
    }

    fn take(&self) -> Option<Order> {
        self.bell.hush();
        self.queue.try_recv().ok()
    }

    fn answer(&self, number: u64, outcome: Outcome) {
        // A desk that is closed has no client that waits.
        if self.outcomes.send((number, outcome)).is_ok() {
            self.desk.ring();
        }
    }

    fn refusal(&self, why: &str) -> Failure {
        let hint = format!("`scanhub info {}` shows its state", self.sensor);
        Failure::new(Kind::Failed, format!("{}: {why}", self.sensor), hint)
    }
}

impl AsFd for Orders {
    /// Readable as long as an order waits.
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.bell.as_fd()
    }
}
