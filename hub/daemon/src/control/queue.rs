//! The requests of users to one link, in the link's thread: taken one by one, and answered. What pausing does to a sensor is
//! the session's business. Refuses to know what a link is.

use std::os::fd::{AsFd, BorrowedFd};
use std::sync::mpsc::{Receiver, Sender};
use std::sync::{Arc, PoisonError};

use config::Processing;
use scanhub_drivers::PortSession;
use scanhub_drivers::line::{Control, Session as _};
use schema::{Failure, Kind, Nanos};

use super::{Changed, Outcome, QueuedRequest};
use crate::event_fd::EventFd;
use crate::player::Player;

/// The link's end of the queue.
pub struct ControlQueue {
    pub(super) sensor: String,
    pub(super) paused: bool,
    pub(super) queue: Receiver<QueuedRequest>,
    pub(super) changed: Changed,
    pub(super) event: Arc<EventFd>,
    pub(super) outcomes: Sender<(u64, Outcome)>,
    pub(super) server: Arc<EventFd>,
}

/// Who can be told to pause, to resume, to resync.
pub(crate) enum Flow<'a> {
    /// A session with a sensor.
    Session(&'a mut PortSession),
    /// Nobody, for now.
    Away,
    /// The player of a recording.
    Recording(&'a Player),
}

impl ControlQueue {
    /// Whether a user wants nothing of the sensor for now: a pause outlasts an absence of the port.
    pub(crate) fn is_paused(&self) -> bool {
        self.paused
    }

    /// Has `flow` do what `control` says, at `now`.
    ///
    /// # Errors
    ///
    /// [`Kind::Failed`] if there is nobody to do it.
    pub(crate) fn control(
        &mut self,
        control: Control,
        flow: &mut Flow<'_>,
        now: Nanos,
    ) -> Result<(), Failure> {
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
            Flow::Session(session) => session.control(control, now),
        }
        self.paused = control == Control::Pause;
        Ok(())
    }

    /// What is to be made of scans from now on, if that was changed since it was last asked.
    pub(crate) fn changed(&self) -> Option<Box<Processing>> {
        self.event.clear();
        self.changed.lock().unwrap_or_else(PoisonError::into_inner).take()
    }

    /// The next request.
    pub(crate) fn take(&self) -> Option<QueuedRequest> {
        self.event.clear();
        self.queue.try_recv().ok()
    }

    /// Request `number` was done, or was not.
    pub(crate) fn answer(&self, number: u64, outcome: Outcome) {
        // A server that has ended has no client that waits.
        if self.outcomes.send((number, outcome)).is_ok() {
            self.server.signal();
        }
    }

    fn refusal(&self, why: &str) -> Failure {
        let hint = format!("`scanhub info {}` shows its state", self.sensor);
        Failure::new(Kind::Failed, format!("{}: {why}", self.sensor), hint)
    }
}

impl AsFd for ControlQueue {
    /// Readable as long as a request waits.
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.event.as_fd()
    }
}
