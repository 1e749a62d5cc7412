//! The baselines: a process wakes another one, and nothing more. It does so by a word in shared memory on which the
//! other sleeps or spins, which is one addition and one system call, or by an eventfd. Every mechanism does at least
//! one of these; the rest of its time is its own.

use std::io::{IoSlice, IoSliceMut};
use std::mem::MaybeUninit;
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::net::{UnixListener, UnixStream};

use rustix::event::{EventfdFlags, eventfd};
use rustix::net::{
    RecvAncillaryBuffer, RecvAncillaryMessage, RecvFlags, SendAncillaryBuffer, SendAncillaryMessage,
    SendFlags, recvmsg, sendmsg,
};
use scanhub_schema::{Ring, Wake};
use scanhub_shm::{Bell, Node, Waker};
use scanhub_shm::{Domain, Environment, HubLock};

use super::message::{Label, PHASES, Way};
use super::process::{Inlet, Outlet, Task};
use super::sockets::listening_path;
use super::topic::SENSOR;
use crate::support::{Outcome, clock};

/// The writer of a futex word.
pub(crate) struct Word {
    waker: Waker,
    _node: Node,
    _lock: HubLock,
}

impl Word {
    pub(crate) fn new(task: &Task) -> Outcome<Word> {
        let domain = Domain::of_hub(task.domain, None, &Environment::of_process())?;
        let lock = HubLock::acquire(domain.root())?;
        let node = scanhub_shm::hub_node(&domain)?;
        Ok(Word { waker: Waker::new(&node, SENSOR)?, _node: node, _lock: lock })
    }
}

impl Outlet for Word {
    fn open(&mut self) -> Outcome<()> {
        Ok(())
    }

    fn write(&mut self, _: Label) -> Outcome<()> {
        Ok(())
    }

    fn send(&mut self) -> Outcome<()> {
        self.waker.ring(Ring::First);
        Ok(self.waker.tell(Wake::Telegram)?)
    }
}

/// The reader of a futex word.
pub(crate) struct WordInlet {
    bell: Bell,
    rung: u32,
    spins: bool,
    counted: Counted,
    _node: Node,
}

impl WordInlet {
    pub(crate) fn new(task: &Task) -> Outcome<WordInlet> {
        let node = scanhub_shm::client_node(&Domain::of_hub(task.domain, None, &Environment::of_process())?)?;
        let bell = Bell::open(&node, SENSOR)?.ok_or("no bell")?;
        let rung = bell.rung(Ring::First);
        Ok(WordInlet {
            bell,
            rung,
            spins: task.way == Way::SpinBaseline,
            counted: Counted::new(task),
            _node: node,
        })
    }
}

impl Inlet for WordInlet {
    fn next(&mut self) -> Outcome<Label> {
        while !self.counted.is_waiting() {
            let rung = self.bell.rung(Ring::First);
            if rung != self.rung {
                self.counted.add(u64::from(rung.wrapping_sub(self.rung)));
                self.rung = rung;
            } else if self.spins {
                std::hint::spin_loop();
            } else {
                let until = clock::now() + LONG_NS;
                scanhub_shm::sleep_at_bells(&[(&self.bell, Ring::First, rung)], until)
                    .map_err(|error| format!("{error:?}"))?;
            }
        }
        Ok(self.counted.take())
    }
}

/// The writing end of an eventfd.
pub(crate) struct Counter {
    eventfd: OwnedFd,
    listener: UnixListener,
    path: String,
}

impl Counter {
    pub(crate) fn new(task: &Task) -> Outcome<Counter> {
        let path = listening_path(task.place);
        let eventfd = eventfd(0, EventfdFlags::CLOEXEC)?;
        Ok(Counter { eventfd, listener: UnixListener::bind(&path)?, path })
    }
}

impl Outlet for Counter {
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

impl Drop for Counter {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.path);
    }
}

/// The reading end of an eventfd.
pub(crate) struct CounterInlet {
    stream: UnixStream,
    eventfd: Option<OwnedFd>,
    counted: Counted,
}

impl CounterInlet {
    pub(crate) fn new(task: &Task) -> Outcome<CounterInlet> {
        let stream = UnixStream::connect(listening_path(task.place))?;
        Ok(CounterInlet { stream, eventfd: None, counted: Counted::new(task) })
    }
}

impl Inlet for CounterInlet {
    fn next(&mut self) -> Outcome<Label> {
        if self.eventfd.is_none() {
            self.eventfd = Some(received_descriptor(&self.stream)?);
        }
        while let (false, Some(eventfd)) = (self.counted.is_waiting(), &self.eventfd) {
            let mut told = [0; 8];
            rustix::io::read(eventfd, &mut told)?;
            self.counted.add(u64::from_ne_bytes(told));
        }
        Ok(self.counted.take())
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
    Ok(received_descriptor.ok_or("no eventfd came")?)
}

/// Finds out which message a wake-up belongs to: only a count arrives.
struct Counted {
    way: Way,
    told: u64,
    taken: u64,
    phase: usize,
}

impl Counted {
    fn new(task: &Task) -> Counted {
        Counted { way: task.way, told: 0, taken: 0, phase: 0 }
    }

    fn add(&mut self, told: u64) {
        self.told += told;
    }

    fn is_waiting(&self) -> bool {
        self.taken < self.told
    }

    fn take(&mut self) -> Label {
        let number = self.taken;
        self.taken += 1;
        let label =
            Label { phase: self.phase, number, is_end: number == PHASES[self.phase].count(self.way) as u64 };
        if label.is_end {
            self.phase += 1;
            self.told -= self.taken;
            self.taken = 0;
        }
        label
    }
}

/// Longer than any step takes.
const LONG_NS: u64 = 10_000_000_000;
