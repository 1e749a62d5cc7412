//! Requests of users to the links of a hub. The supervisor's thread receives each request and puts it into the bounded
//! queue of its link's thread. The supervisor's thread replies when the link has handled the request, and never blocks
//! while it waits for the link.

use std::os::fd::{AsFd, BorrowedFd};
use std::sync::mpsc::{Receiver, Sender, SyncSender, TrySendError, channel, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};

use scanhub_config::Processing;
use scanhub_drivers::PortSession;
use scanhub_drivers::line::{Control, ScannerSession as _};
use scanhub_schema::{Background, Failure, Kind, Nanos, Response, ResponseModel, Verb};
use scanhub_shm::resource_limits;
use scanhub_shm::{IncomingRequest, Node};

use crate::player::Player;
use crate::process::EventFd;

/// Server of control requests. It belongs to the supervisor's thread.
pub(crate) struct ControlServer {
    server: scanhub_shm::ControlServer,
    pub(crate) commands: CommandSender,
    /// Requests whose link has not reported an outcome yet, with their numbers.
    pending: Vec<(u64, IncomingRequest)>,
}

/// Queues to the threads of all links, and the outcomes that these threads report.
pub struct CommandSender {
    links: Vec<LinkQueue>,
    outcomes: Receiver<(u64, Outcome)>,
    event: Arc<EventFd>,
    next: u64,
}

/// The supervisor's end of the queue to one link's thread.
struct LinkQueue {
    sensor: String,
    queue: SyncSender<QueuedRequest>,
    settings: PendingSettings,
    event: Arc<EventFd>,
}

/// New settings of the processors of a link, until the link takes them.
type PendingSettings = Arc<Mutex<Option<Box<Processing>>>>;

/// Outcome of a request: the background model if the request asked for it, or the reason of a failure.
pub type Outcome = Result<Option<Box<ResponseModel>>, Failure>;

/// A request in the queue of a link.
pub(crate) struct QueuedRequest {
    /// Identifies the request in its [`Outcome`].
    pub(crate) id: u64,
    pub(crate) verb: Verb,
    /// The model of [`Verb::Load`]; empty for the other verbs.
    pub(crate) model: Box<Background>,
}

impl CommandSender {
    /// Creates a queue for the link of each sensor in `sensors`. The second value contains the links' ends of the
    /// queues, in the order of `sensors`.
    ///
    /// # Errors
    ///
    /// [`Kind::ResourceExhausted`] if no descriptors are left.
    pub fn new<'a>(
        sensors: impl Iterator<Item = &'a str>,
    ) -> Result<(CommandSender, Vec<ControlQueue>), Failure> {
        let event = Arc::new(EventFd::new()?);
        let (outcome_sender, outcomes) = channel();
        let (mut links, mut ends) = (Vec::new(), Vec::new());
        for sensor in sensors {
            let (sender, queue) = sync_channel(QUEUE_CAPACITY);
            let (own, settings) = (Arc::new(EventFd::new()?), PendingSettings::default());
            links.push(LinkQueue {
                sensor: sensor.to_owned(),
                queue: sender,
                settings: settings.clone(),
                event: own.clone(),
            });
            ends.push(ControlQueue {
                sensor: sensor.to_owned(),
                paused: false,
                queue,
                settings,
                event: own,
                outcomes: outcome_sender.clone(),
                server: event.clone(),
            });
        }
        Ok((CommandSender { links, outcomes, event, next: 0 }, ends))
    }

    /// Gives the link of `sensor` new settings for its processors. They replace settings that the link has not taken
    /// yet.
    pub fn change(&self, sensor: &str, processing: &Processing) {
        if let Some(link) = self.links.iter().find(|link| link.sensor == sensor) {
            let mut pending = link.settings.lock().unwrap_or_else(PoisonError::into_inner);
            *pending = Some(Box::new(processing.clone()));
            link.event.signal();
        }
    }

    /// Queues a request for the link of `sensor`, and returns the number under which [`outcome`](Self::outcome) reports
    /// it. `model` is the model of [`Verb::Load`].
    ///
    /// # Errors
    ///
    /// [`Kind::NoTopic`] if there is no link of `sensor`, [`Kind::ResourceExhausted`] if too many requests wait for the
    /// link, [`Kind::Failed`] if the link has ended.
    pub fn enqueue(&mut self, sensor: &str, verb: Verb, model: Box<Background>) -> Result<u64, Failure> {
        let link = self.links.iter().find(|link| link.sensor == sensor).ok_or_else(|| {
            let sensors: Vec<_> = self.links.iter().map(|link| link.sensor.as_str()).collect();
            let hint = format!("there are {}", sensors.join(", "));
            Failure::new(Kind::NoTopic, format!("the hub has no sensor {sensor}"), hint)
        })?;
        match link.queue.try_send(QueuedRequest { id: self.next, verb, model }) {
            Ok(()) => {}
            Err(TrySendError::Full(_)) => {
                let message = format!("{sensor} already has {QUEUE_CAPACITY} waiting requests");
                return Err(Failure::new(Kind::ResourceExhausted, message, "try again in a moment"));
            }
            Err(TrySendError::Disconnected(_)) => {
                return Err(Failure::new(Kind::Failed, format!("the link {sensor} has ended"), ""));
            }
        }
        link.event.signal();
        self.next += 1;
        Ok(self.next - 1)
    }

    /// Returns the number and the outcome of the next request that a link has handled.
    pub fn outcome(&self) -> Option<(u64, Outcome)> {
        self.outcomes.try_recv().ok()
    }
}

impl ControlServer {
    /// Opens the control service for the link of each sensor in `sensors`. The second value contains the links' ends of
    /// the queues, in the order of `sensors`.
    ///
    /// # Errors
    ///
    /// [`Kind::ResourceExhausted`] if no memory or descriptors are left.
    pub(crate) fn open<'a>(
        node: &Node,
        sensors: impl Iterator<Item = &'a str>,
    ) -> Result<(ControlServer, Vec<ControlQueue>), Failure> {
        let server = scanhub_shm::ControlServer::create(node)?;
        let (commands, queues) = CommandSender::new(sensors)?;
        Ok((ControlServer { server, commands, pending: Vec::new() }, queues))
    }

    /// Descriptors that become readable when [`serve`](Self::serve) has something to do.
    pub(crate) fn descriptors(&self) -> [BorrowedFd<'_>; 2] {
        [scanhub_shm::descriptor(self.server.requests()), self.commands.event.as_fd()]
    }

    /// Replies to the requests that links have handled, and queues new ones.
    pub(crate) fn serve(&mut self) {
        self.commands.event.clear();
        while let Some((number, outcome)) = self.commands.outcome() {
            if let Some(at) = self.pending.iter().position(|(open, _)| *open == number) {
                let (_, request) = self.pending.swap_remove(at);
                self.reply(request, outcome);
            }
        }
        self.pending.retain(|(_, request)| request.is_client_waiting());
        let mut was_signaled = scanhub_shm::take_wakeups(&[self.server.requests()]).is_ok_and(|rang| rang);
        loop {
            match self.server.receive() {
                Ok(Some(request)) => {
                    was_signaled = false;
                    self.forward(request);
                }
                Ok(None) => break,
                Err(failure) => return tracing::warn!(%failure, "a request was not received"),
            }
        }
        // iceoryx2 skips a client for whose connection no descriptors are left.
        if was_signaled && let Err(failure) = resource_limits::check_descriptors(CLIENT_DESCRIPTORS) {
            tracing::warn!("a request was not received: {}; {}", failure.message, failure.hint);
        }
    }

    /// Queues the request of `incoming`, or replies that it is refused.
    fn forward(&mut self, incoming: IncomingRequest) {
        match self.enqueue(&incoming) {
            Ok(number) => self.pending.push((number, incoming)),
            Err(refusal) => self.reply(incoming, Err(refusal)),
        }
    }

    /// Puts the request of `incoming` into the queue of its link, and returns its number.
    fn enqueue(&mut self, incoming: &IncomingRequest) -> Result<u64, Failure> {
        let request =
            incoming.request().and_then(|request| Some((request.sensor, request.verb?, request.model)));
        let (sensor, verb, model) = request.ok_or_else(|| {
            let hint = "client and hub have different versions";
            Failure::new(Kind::Failed, "the request is not known to this hub", hint)
        })?;
        self.commands.enqueue(&sensor, verb, model.unwrap_or_default())
    }

    fn reply(&self, incoming: IncomingRequest, outcome: Outcome) {
        let response = Response(outcome.map(|shown| shown.map(|shown| *shown)));
        if let Err(failure) = self.server.respond(incoming, &response) {
            tracing::debug!(%failure, "a reply did not reach its client");
        }
    }
}

/// The link's end of its queue.
pub struct ControlQueue {
    sensor: String,
    /// Whether a user has paused the sensor.
    paused: bool,
    queue: Receiver<QueuedRequest>,
    settings: PendingSettings,
    event: Arc<EventFd>,
    outcomes: Sender<(u64, Outcome)>,
    server: Arc<EventFd>,
}

/// The source of a link's data. A user can pause, resume or restart it.
pub(crate) enum PauseTarget<'a> {
    /// A session with a sensor.
    Session(&'a mut PortSession),
    /// The port is missing.
    NoPort,
    /// The player of a recording.
    Recording(&'a Player),
}

impl ControlQueue {
    /// Returns whether a user has paused the sensor. A pause continues while the port is missing.
    pub(crate) fn is_paused(&self) -> bool {
        self.paused
    }

    /// Applies `control` to `target` at `now`.
    ///
    /// # Errors
    ///
    /// [`Kind::Failed`] if a session must be restarted, but the port is missing.
    pub(crate) fn control(
        &mut self,
        control: Control,
        target: &mut PauseTarget<'_>,
        now: Nanos,
    ) -> Result<(), Failure> {
        match target {
            PauseTarget::Recording(player) => {
                match control {
                    Control::Pause => player.pause(),
                    Control::Resume => player.resume(),
                    Control::Resync => return Err(self.refusal("a recording has no session to restart")),
                }
                return Ok(());
            }
            PauseTarget::NoPort if control == Control::Resync => {
                return Err(self.refusal("the port is unavailable"));
            }
            PauseTarget::NoPort => {}
            PauseTarget::Session(session) => session.control(control, now),
        }
        self.paused = control == Control::Pause;
        Ok(())
    }

    /// Takes the new settings of the processors, if they were changed since the last call.
    pub(crate) fn take_settings(&self) -> Option<Box<Processing>> {
        self.event.clear();
        self.settings.lock().unwrap_or_else(PoisonError::into_inner).take()
    }

    /// Takes the next request from the queue.
    pub(crate) fn take(&self) -> Option<QueuedRequest> {
        self.event.clear();
        self.queue.try_recv().ok()
    }

    /// Reports the outcome of request `id` to the server.
    pub(crate) fn report_outcome(&self, id: u64, outcome: Outcome) {
        // If the server no longer exists, no client waits for the outcome.
        if self.outcomes.send((id, outcome)).is_ok() {
            self.server.signal();
        }
    }

    fn refusal(&self, reason: &str) -> Failure {
        let hint = format!("`scanhub info {}` shows its state", self.sensor);
        Failure::new(Kind::Failed, format!("{}: {reason}", self.sensor), hint)
    }
}

impl AsFd for ControlQueue {
    /// Readable while a request or new settings wait.
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.event.as_fd()
    }
}

/// Number of descriptors that the connection to one client needs: for both directions, and for the shared memory of its
/// requests.
const CLIENT_DESCRIPTORS: u64 = 4;
/// Maximum number of waiting requests for each link. Further requests are refused.
const QUEUE_CAPACITY: usize = 4;
