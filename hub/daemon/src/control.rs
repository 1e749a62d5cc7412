//! Requests from outside on their way to the links: each is handed to its link's thread by a bounded queue and answered
//! when the link has taken it. Never waits for a link; what a request does to a sensor is the session's business.

mod queue;

use std::os::fd::{AsFd, BorrowedFd};
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, channel, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};

use config::Processing;
use schema::ipc::{self, Asked, Node};
use schema::{Background, Failure, Kind, Response, Shown, Verb, shortage};

use crate::event_fd::EventFd;
pub use queue::ControlQueue;
pub(crate) use queue::Flow;

/// Where requests come in; stays in the supervising thread.
pub(crate) struct ControlServer {
    server: ipc::ControlServer,
    pub(crate) orders: Orders,
    /// Requests that a link has not taken yet, by their numbers.
    open: Vec<(u64, Asked)>,
}

/// What users want of links, on its way to them and back.
pub struct Orders {
    links: Vec<LinkQueue>,
    outcomes: Receiver<(u64, Outcome)>,
    event: Arc<EventFd>,
    next: u64,
}

/// The way to a link's thread.
struct LinkQueue {
    sensor: String,
    queue: SyncSender<QueuedRequest>,
    changed: Changed,
    event: Arc<EventFd>,
}

/// What a link shall make of its scans from now on, until it has taken it.
type Changed = Arc<Mutex<Option<Box<Processing>>>>;

/// What came of a request: done, with the model that was asked for, or why not.
pub type Outcome = Result<Option<Box<Shown>>, Failure>;

/// A request on its way to a link.
pub(crate) struct QueuedRequest {
    /// By which it is answered.
    pub(crate) number: u64,
    pub(crate) verb: Verb,
    /// What a request to load brings.
    pub(crate) model: Box<Background>,
}

impl Orders {
    /// For a link of each of `sensors`; what comes for them arrives at the second value.
    ///
    /// # Errors
    ///
    /// [`Kind::Short`] if descriptors are.
    pub fn new<'a>(sensors: impl Iterator<Item = &'a str>) -> Result<(Orders, Vec<ControlQueue>), Failure> {
        let event = Arc::new(EventFd::new()?);
        let (told, outcomes) = channel();
        let (mut links, mut ends) = (Vec::new(), Vec::new());
        for sensor in sensors {
            let (sender, queue) = sync_channel(QUEUE);
            let (own, changed) = (Arc::new(EventFd::new()?), Changed::default());
            links.push(LinkQueue {
                sensor: sensor.to_owned(),
                queue: sender,
                changed: changed.clone(),
                event: own.clone(),
            });
            ends.push(ControlQueue {
                sensor: sensor.to_owned(),
                paused: false,
                queue,
                changed,
                event: own,
                outcomes: told.clone(),
                server: event.clone(),
            });
        }
        Ok((Orders { links, outcomes, event, next: 0 }, ends))
    }

    /// Lets the link of `sensor` make of its scans what `processing` says, as soon as it looks; the last word holds.
    pub fn change(&self, sensor: &str, processing: &Processing) {
        if let Some(link) = self.links.iter().find(|link| link.sensor == sensor) {
            let mut changed = link.changed.lock().unwrap_or_else(PoisonError::into_inner);
            *changed = Some(Box::new(processing.clone()));
            link.event.signal();
        }
    }

    /// Puts `verb`, with the `model` of a request to load, into the queue of the link of `sensor`. The number by which its
    /// [`outcome`](Self::outcome) will be told.
    ///
    /// # Errors
    ///
    /// [`Kind::NoTopic`] if there is no such link, [`Kind::Short`] if too many requests wait for it, [`Kind::Failed`] if it
    /// has ended.
    pub fn ask(&mut self, sensor: &str, verb: Verb, model: Box<Background>) -> Result<u64, Failure> {
        let link = self.links.iter().find(|link| link.sensor == sensor).ok_or_else(|| {
            let sensors: Vec<_> = self.links.iter().map(|link| link.sensor.as_str()).collect();
            let there_are = format!("there are {}", sensors.join(", "));
            Failure::new(Kind::NoTopic, format!("the hub has no sensor {sensor}"), there_are)
        })?;
        match link.queue.try_send(QueuedRequest { number: self.next, verb, model }) {
            Ok(()) => {}
            Err(TrySendError::Full(_)) => {
                let message = format!("{sensor} already has {QUEUE} waiting requests");
                return Err(Failure::new(Kind::Short, message, "try again in a moment"));
            }
            Err(TrySendError::Disconnected(_)) => {
                return Err(Failure::new(Kind::Failed, format!("the link {sensor} has ended"), ""));
            }
        }
        link.event.signal();
        self.next += 1;
        Ok(self.next - 1)
    }

    /// What came of a request that a link has taken, and its number.
    pub fn outcome(&self) -> Option<(u64, Outcome)> {
        self.outcomes.try_recv().ok()
    }
}

impl ControlServer {
    /// Opens the control service, for a link of each of `sensors`; what comes for them arrives at the second value.
    ///
    /// [`Kind::Short`] if memory or descriptors are.
    pub(crate) fn open<'a>(
        node: &Node,
        sensors: impl Iterator<Item = &'a str>,
    ) -> Result<(ControlServer, Vec<ControlQueue>), Failure> {
        let server = ipc::ControlServer::create(node)?;
        let (orders, queues) = Orders::new(sensors)?;
        Ok((ControlServer { server, orders, open: Vec::new() }, queues))
    }

    /// What becomes readable when there is something to [`serve`](Self::serve).
    pub(crate) fn descriptors(&self) -> [BorrowedFd<'_>; 2] {
        [ipc::descriptor(self.server.requests()), self.orders.event.as_fd()]
    }

    /// Answers what the links have taken, and hands on what came in.
    pub(crate) fn serve(&mut self) {
        self.orders.event.clear();
        while let Some((number, outcome)) = self.orders.outcome() {
            if let Some(at) = self.open.iter().position(|(open, _)| *open == number) {
                let (_, asked) = self.open.swap_remove(at);
                self.answer(asked, outcome);
            }
        }
        self.open.retain(|(_, asked)| asked.is_waited_for());
        let mut unheard = ipc::take_wakeups(&[self.server.requests()]).is_ok_and(|rang| rang);
        loop {
            match self.server.receive() {
                Ok(Some(asked)) => {
                    unheard = false;
                    self.hand_on(asked);
                }
                Ok(None) => break,
                Err(failure) => return tracing::warn!(%failure, "a request was not received"),
            }
        }
        // The library leaves out a client that it has no descriptors for.
        if unheard && let Err(failure) = shortage::check_descriptors(CLIENT_DESCRIPTORS) {
            tracing::warn!("a request was not received: {}; {}", failure.message, failure.hint);
        }
    }

    fn hand_on(&mut self, asked: Asked) {
        match self.queue(&asked) {
            Ok(number) => self.open.push((number, asked)),
            Err(refusal) => self.answer(asked, Err(refusal)),
        }
    }

    /// Puts what `asked` wants into the link's queue; the number by which its outcome will be told.
    fn queue(&mut self, asked: &Asked) -> Result<u64, Failure> {
        let request =
            asked.request().and_then(|request| Some((request.sensor, request.verb?, request.model)));
        let (sensor, verb, model) = request.ok_or_else(|| {
            let hint = "client and hub are of different versions";
            Failure::new(Kind::Failed, "the request is not known to this hub", hint)
        })?;
        self.orders.ask(&sensor, verb, model.unwrap_or_default())
    }

    fn answer(&self, asked: Asked, outcome: Outcome) {
        let response = Response(outcome.map(|shown| shown.map(|shown| *shown)));
        if let Err(failure) = self.server.answer(asked, &response) {
            tracing::debug!(%failure, "a client was not answered");
        }
    }
}

/// Descriptors of the connection to a client: both directions, and the memory of its requests.
const CLIENT_DESCRIPTORS: u64 = 4;
/// Requests that wait for a link; whoever asks faster is told to come back.
const QUEUE: usize = 4;
