//! The sending process: opens its end, sends phase by phase when it is told to, and says when each message left and what
//! that cost it. Refuses to know by what it sends.

use std::fmt::Write as _;
use std::io::ErrorKind;
use std::os::unix::net::UnixDatagram;
use std::time::Duration;

use rustix::time::{ClockId, clock_gettime};

use super::message::Label;
use super::schedule::{PHASES, Phase};
use super::way::Way;
use super::{datagrams, floors, streams, topic};
use crate::support::{Outcome, clock};

/// What a run is of, as sender and receivers are told it.
pub(crate) struct Task<'a> {
    pub(crate) way: Way,
    /// Bytes of a message.
    pub(crate) payload: usize,
    pub(crate) receivers: usize,
    /// The domain of topics.
    pub(crate) domain: &'a str,
    /// How the paths of sockets and pipes begin.
    pub(crate) place: &'a str,
}

/// A mechanism's sending end.
pub(crate) trait Outlet {
    /// What receivers need in order to connect.
    fn address(&self) -> Outcome<String> {
        Ok("-".into())
    }

    /// Connects to all receivers, which are there now.
    fn open(&mut self) -> Outcome<()>;

    /// Writes a message where it will be sent from; one that carries nothing has nothing to write.
    fn write(&mut self, label: Label) -> Outcome<()>;

    /// Sends what was written to all receivers.
    fn send(&mut self) -> Outcome<()>;

    /// Tells all that a phase is over.
    fn end(&mut self, label: Label) -> Outcome<()> {
        self.write(label)?;
        self.send()
    }
}

/// Sends until it is told to end. Prints `ready ADDRESS`, `open`, and for each phase `sent
/// BUSY_NS SENDING_NS SENT_NS..`, the second without the writing of messages and the waits; 0 where that was not looked at.
pub(crate) fn play(task: &Task) -> Outcome<()> {
    let told = UnixDatagram::bind(control(task.place))?;
    let mut outlet = outlet(task)?;
    println!("ready {}", outlet.address()?);
    await_word(&told)?;
    outlet.open()?;
    println!("open");
    await_word(&told)?;
    for (number, phase) in PHASES.iter().enumerate() {
        let before = busy_ns();
        let sent = send(outlet.as_mut(), phase, number, task.way)?;
        println!("sent {} {}", busy_ns() - before, text(&sent));
        let sent = &sent[1..];
        let end = Label { phase: number, number: sent.len() as u64, is_end: true };
        outlet.end(end)?;
        if task.way.loses() {
            told.set_read_timeout(Some(AGAIN))?;
            while !heard(&told)? {
                outlet.end(end)?;
            }
            told.set_read_timeout(None)?;
        } else {
            await_word(&told)?;
        }
    }
    drop(outlet);
    std::fs::remove_file(control(task.place))?;
    println!("end");
    Ok(())
}

/// Where the sender is told to go on.
pub(crate) fn control(place: &str) -> String {
    format!("{place}-control")
}

/// Processor time of this thread, in ns: what schedstat says too, but only at the end of a tick or of a sleep.
pub(crate) fn busy_ns() -> u64 {
    let busy = clock_gettime(ClockId::ThreadCPUTime);
    busy.tv_sec as u64 * 1_000_000_000 + busy.tv_nsec as u64
}

fn outlet(task: &Task) -> Outcome<Box<dyn Outlet>> {
    Ok(match task.way {
        Way::Doorbell | Way::Event | Way::Spin => Box::new(topic::Bytes::new(task)?),
        Way::Subscription => Box::new(topic::Scans::new(task)?),
        Way::Multicast | Way::UnixDatagram => Box::new(datagrams::Datagrams::new(task)?),
        Way::UnixStream | Way::Tcp | Way::Pipe => Box::new(streams::Streams::new(task)?),
        Way::FutexFloor | Way::SpinFloor => Box::new(floors::Word::new(task)?),
        Way::EventfdFloor => Box::new(floors::Counter::new(task)?),
    })
}

/// A phase: processor time of sending alone, then when each message was sent.
fn send(outlet: &mut dyn Outlet, phase: &Phase, position: usize, way: Way) -> Outcome<Vec<u64>> {
    let count = phase.count(way);
    let mut sent = Vec::with_capacity(1 + count);
    sent.push(0);
    let begin = clock::now();
    while sent.len() <= count {
        let number = sent.len() as u64 - 1;
        let due = begin + (number + 1) * phase.period_ns;
        if phase.period_ns > 0 && clock::now() < due {
            clock::rest(due);
        } else if clock::now() - begin > phase.most_ns(way) {
            break;
        }
        outlet.write(Label { phase: position, number, is_end: false })?;
        // Looking at it costs a system call, which would slow down who sends all the time.
        let before = (phase.period_ns > 0).then(busy_ns);
        sent.push(clock::now());
        outlet.send()?;
        sent[0] += before.map_or(0, |before| busy_ns() - before);
    }
    Ok(sent)
}

/// Numbers in one line.
pub(crate) fn text(numbers: &[u64]) -> String {
    let mut text = String::with_capacity(numbers.len() * 16);
    for number in numbers {
        let _ = write!(text, "{number} ");
    }
    text
}

fn await_word(told: &UnixDatagram) -> Outcome<()> {
    while !heard(told)? {}
    Ok(())
}

fn heard(told: &UnixDatagram) -> Outcome<bool> {
    match told.recv(&mut [0; 8]) {
        Ok(_) => Ok(true),
        Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted) => Ok(false),
        Err(error) => Err(error.into()),
    }
}

/// So often it is said that a phase is over where that may get lost, too.
const AGAIN: Duration = Duration::from_millis(20);
