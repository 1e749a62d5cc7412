//! Baselines in which a process wakes another process and does nothing else. One kind uses a word in shared memory on
//! which the other process sleeps or spins. It costs one addition and one system call. The other kind uses an eventfd.
//! Every compared mechanism contains one of these wake-ups. The rest of the mechanism's time is the cost of the
//! mechanism itself.

use std::io::{IoSlice, IoSliceMut};
use std::mem::MaybeUninit;
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::net::{UnixListener, UnixStream};

use rustix::event::{EventfdFlags, eventfd};
use rustix::net::{
    RecvAncillaryBuffer, RecvAncillaryMessage, RecvFlags, SendAncillaryBuffer, SendAncillaryMessage,
    SendFlags, recvmsg, sendmsg,
};
use scanhub_schema::{DoorbellWord, WakeEvent};
use scanhub_shm::{Domain, Environment, HubLock};
use scanhub_shm::{Doorbell, Node, WakeSender};

use super::message::{Label, Mechanism, PHASES};
use super::process::{MessageReceiver, MessageSender, RunParameters};
use super::sockets::listening_path;
use super::topic::SENSOR;
use crate::support::{Outcome, clock};

/// The writer of a futex word.
pub(crate) struct FutexWriter {
    waker: WakeSender,
    _node: Node,
    _lock: HubLock,
}

impl FutexWriter {
    pub(crate) fn new(task: &RunParameters) -> Outcome<FutexWriter> {
        let domain = Domain::of_hub(task.domain, None, &Environment::of_process())?;
        let lock = HubLock::acquire(domain.root())?;
        let node = scanhub_shm::hub_node(&domain)?;
        Ok(FutexWriter { waker: WakeSender::new(&node, SENSOR)?, _node: node, _lock: lock })
    }
}

impl MessageSender for FutexWriter {
    fn open(&mut self) -> Outcome<()> {
        Ok(())
    }

    fn write(&mut self, _: Label) -> Outcome<()> {
        Ok(())
    }

    fn send(&mut self) -> Outcome<()> {
        self.waker.ring(DoorbellWord::First);
        Ok(self.waker.notify(WakeEvent::Telegram)?)
    }
}

/// The reader of a futex word.
pub(crate) struct FutexReader {
    doorbell: Doorbell,
    last_count: u32,
    is_spinning: bool,
    matcher: WakeupMatcher,
    _node: Node,
}

impl FutexReader {
    pub(crate) fn new(task: &RunParameters) -> Outcome<FutexReader> {
        let node = scanhub_shm::client_node(&Domain::of_hub(task.domain, None, &Environment::of_process())?)?;
        let doorbell = Doorbell::open(&node, SENSOR)?.ok_or("no doorbell")?;
        let last_count = doorbell.ring_count(DoorbellWord::First);
        Ok(FutexReader {
            doorbell,
            last_count,
            is_spinning: task.mechanism == Mechanism::SpinBaseline,
            matcher: WakeupMatcher::new(task),
            _node: node,
        })
    }
}

impl MessageReceiver for FutexReader {
    fn next(&mut self) -> Outcome<Label> {
        while !self.matcher.is_waiting() {
            let ring_count = self.doorbell.ring_count(DoorbellWord::First);
            if ring_count != self.last_count {
                self.matcher.add(u64::from(ring_count.wrapping_sub(self.last_count)));
                self.last_count = ring_count;
            } else if self.is_spinning {
                std::hint::spin_loop();
            } else {
                let until = clock::now() + STEP_TIMEOUT_NS;
                scanhub_shm::wait_on_doorbells(&[(&self.doorbell, DoorbellWord::First, ring_count)], until)
                    .map_err(|error| format!("{error:?}"))?;
            }
        }
        Ok(self.matcher.take())
    }
}

/// The writing end of an eventfd.
pub(crate) struct EventfdWriter {
    eventfd: OwnedFd,
    listener: UnixListener,
    path: String,
}

impl EventfdWriter {
    pub(crate) fn new(task: &RunParameters) -> Outcome<EventfdWriter> {
        let path = listening_path(task.path_prefix);
        let eventfd = eventfd(0, EventfdFlags::CLOEXEC)?;
        Ok(EventfdWriter { eventfd, listener: UnixListener::bind(&path)?, path })
    }
}

impl MessageSender for EventfdWriter {
    fn open(&mut self) -> Outcome<()> {
        let (stream, _) = self.listener.accept()?;
        let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(1))];
        let mut control = SendAncillaryBuffer::new(&mut space);
        let fds = [self.eventfd.as_fd()];
        control.push(SendAncillaryMessage::ScmRights(&fds));
        sendmsg(&stream, &[IoSlice::new(&[0])], &mut control, SendFlags::empty())?;
        Ok(())
    }

    fn write(&mut self, _: Label) -> Outcome<()> {
        Ok(())
    }

    fn send(&mut self) -> Outcome<()> {
        rustix::io::write(&self.eventfd, &1u64.to_ne_bytes())?;
        Ok(())
    }
}

impl Drop for EventfdWriter {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.path);
    }
}

/// The reading end of an eventfd.
pub(crate) struct EventfdReader {
    stream: UnixStream,
    eventfd: Option<OwnedFd>,
    matcher: WakeupMatcher,
}

impl EventfdReader {
    pub(crate) fn new(task: &RunParameters) -> Outcome<EventfdReader> {
        let stream = UnixStream::connect(listening_path(task.path_prefix))?;
        Ok(EventfdReader { stream, eventfd: None, matcher: WakeupMatcher::new(task) })
    }
}

impl MessageReceiver for EventfdReader {
    fn next(&mut self) -> Outcome<Label> {
        if self.eventfd.is_none() {
            self.eventfd = Some(received_descriptor(&self.stream)?);
        }
        while let (false, Some(eventfd)) = (self.matcher.is_waiting(), &self.eventfd) {
            let mut count_bytes = [0; 8];
            rustix::io::read(eventfd, &mut count_bytes)?;
            self.matcher.add(u64::from_ne_bytes(count_bytes));
        }
        Ok(self.matcher.take())
    }
}

/// Returns the descriptor that is sent through `stream`.
fn received_descriptor(stream: &UnixStream) -> Outcome<OwnedFd> {
    let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(1))];
    let mut control = RecvAncillaryBuffer::new(&mut space);
    recvmsg(stream, &mut [IoSliceMut::new(&mut [0])], &mut control, RecvFlags::CMSG_CLOEXEC)?;
    let received_descriptor = control.drain().find_map(|message| match message {
        RecvAncillaryMessage::ScmRights(mut fds) => fds.next(),
        _ => None,
    });
    Ok(received_descriptor.ok_or("no eventfd arrived")?)
}

/// Determines the message to which each wake-up belongs. The wake-up itself has only a count.
struct WakeupMatcher {
    mechanism: Mechanism,
    wakeup_count: u64,
    matched_count: u64,
    phase: usize,
}

impl WakeupMatcher {
    fn new(task: &RunParameters) -> WakeupMatcher {
        WakeupMatcher { mechanism: task.mechanism, wakeup_count: 0, matched_count: 0, phase: 0 }
    }

    fn add(&mut self, wakeup_count: u64) {
        self.wakeup_count += wakeup_count;
    }

    fn is_waiting(&self) -> bool {
        self.matched_count < self.wakeup_count
    }

    fn take(&mut self) -> Label {
        let number = self.matched_count;
        self.matched_count += 1;
        let label = Label {
            phase: self.phase,
            number,
            is_end: number == PHASES[self.phase].count(self.mechanism) as u64,
        };
        if label.is_end {
            self.phase += 1;
            self.wakeup_count -= self.matched_count;
            self.matched_count = 0;
        }
        label
    }
}

/// Timeout of a wait, in nanoseconds. It is longer than any step of the bench takes.
const STEP_TIMEOUT_NS: u64 = 10_000_000_000;
