//! The sending and the receiving process of a run. Both work with any mechanism: they print when each message was sent
//! or received, and what that cost.

use std::fmt::Write as _;
use std::io::ErrorKind;
use std::os::unix::net::UnixDatagram;
use std::time::Duration;

use rustix::time::{ClockId, clock_gettime};

use super::message::{Label, PHASES, Phase, Way};
use super::{baselines, sockets, topic};
use crate::support::{Outcome, clock};

/// The run that sender and receivers belong to.
pub(crate) struct Task<'a> {
    pub(crate) way: Way,
    /// Bytes of a message.
    pub(crate) payload: usize,
    pub(crate) receivers: usize,
    /// Domain of topics.
    pub(crate) domain: &'a str,
    /// Prefix of the paths of sockets and pipes.
    pub(crate) place: &'a str,
}

/// A mechanism's sending end.
pub(crate) trait Outlet {
    /// Returns what receivers need in order to connect.
    fn address(&self) -> Outcome<String> {
        Ok("-".into())
    }

    /// Connects to all receivers, which are ready now.
    fn open(&mut self) -> Outcome<()>;

    /// Writes a message to where it will be sent from. Mechanisms that carry no data write nothing.
    fn write(&mut self, label: Label) -> Outcome<()>;

    /// Sends the written message to all receivers.
    fn send(&mut self) -> Outcome<()>;

    /// Reports the end of a phase to all receivers.
    fn end(&mut self, label: Label) -> Outcome<()> {
        self.write(label)?;
        self.send()
    }
}

/// Sends until it is told to end. Prints `ready ADDRESS`, `open`, and for each phase `sent BUSY_NS SENDING_NS
/// SENT_NS..`. SENDING_NS leaves out the writing of messages and the waits, and is 0 where it was not measured.
pub(crate) fn send_all(task: &Task) -> Outcome<()> {
    let control_socket = UnixDatagram::bind(control(task.place))?;
    let mut outlet = outlet(task)?;
    println!("ready {}", outlet.address()?);
    await_go(&control_socket)?;
    outlet.open()?;
    println!("open");
    await_go(&control_socket)?;
    for (number, phase) in PHASES.iter().enumerate() {
        let before = busy_ns();
        let sent = send(outlet.as_mut(), phase, number, task.way)?;
        println!("sent {} {}", busy_ns() - before, text(&sent));
        let sent = &sent[1..];
        let end = Label { phase: number, number: sent.len() as u64, is_end: true };
        outlet.end(end)?;
        if task.way.loses() {
            control_socket.set_read_timeout(Some(AGAIN))?;
            while !is_told(&control_socket)? {
                outlet.end(end)?;
            }
            control_socket.set_read_timeout(None)?;
        } else {
            await_go(&control_socket)?;
        }
    }
    drop(outlet);
    std::fs::remove_file(control(task.place))?;
    println!("end");
    Ok(())
}

/// Returns the path of the socket on which the sender is told to continue.
pub(crate) fn control(place: &str) -> String {
    format!("{place}-control")
}

/// Returns the CPU time of this thread, in ns. Schedstat has the same value, but updates it only at the end of a tick
/// or of a sleep.
pub(crate) fn busy_ns() -> u64 {
    let busy = clock_gettime(ClockId::ThreadCPUTime);
    busy.tv_sec as u64 * 1_000_000_000 + busy.tv_nsec as u64
}

fn outlet(task: &Task) -> Outcome<Box<dyn Outlet>> {
    Ok(match task.way {
        Way::Doorbell | Way::Event | Way::Spin => Box::new(topic::Bytes::new(task)?),
        Way::Subscription => Box::new(topic::Scans::new(task)?),
        Way::Multicast | Way::UnixDatagram => Box::new(sockets::Datagrams::new(task)?),
        Way::UnixStream | Way::Tcp | Way::Pipe => Box::new(sockets::Streams::new(task)?),
        Way::FutexBaseline | Way::SpinBaseline => Box::new(baselines::Word::new(task)?),
        Way::EventfdBaseline => Box::new(baselines::Counter::new(task)?),
    })
}

/// Runs a phase. Returns the CPU time of sending alone, and then the time at which each message was sent.
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
        // Reading the clock is a system call, which would slow down a sender that never pauses.
        let before = (phase.period_ns > 0).then(busy_ns);
        sent.push(clock::now());
        outlet.send()?;
        sent[0] += before.map_or(0, |before| busy_ns() - before);
    }
    Ok(sent)
}

/// Returns numbers as one line.
pub(crate) fn text(numbers: &[u64]) -> String {
    let mut text = String::with_capacity(numbers.len() * 16);
    for number in numbers {
        let _ = write!(text, "{number} ");
    }
    text
}

fn await_go(socket: &UnixDatagram) -> Outcome<()> {
    while !is_told(socket)? {}
    Ok(())
}

fn is_told(socket: &UnixDatagram) -> Outcome<bool> {
    match socket.recv(&mut [0; 8]) {
        Ok(_) => Ok(true),
        Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted) => Ok(false),
        Err(error) => Err(error.into()),
    }
}

/// Interval at which the end of a phase is reported again if it can be lost.
const AGAIN: Duration = Duration::from_millis(20);

/// A mechanism's receiving end.
pub(crate) trait Inlet {
    /// Waits for the next message and reads it.
    fn next(&mut self) -> Outcome<Label>;
}

/// Receives all phases. Prints `ready` once no later message can be missed, and for each phase `took BUSY_NS`, then the
/// number and the time of every message.
pub(crate) fn receive_all(task: &Task, number: usize, address: &str) -> Outcome<()> {
    let mut inlet = inlet(task, number, address)?;
    println!("ready");
    for (current, phase) in PHASES.iter().enumerate() {
        let mut took = Vec::with_capacity(2 * phase.count(task.way));
        let before = busy_ns();
        loop {
            let label = inlet.next()?;
            let now = clock::now();
            match label {
                Label { phase, .. } if phase != current => {}
                Label { is_end: true, .. } => break,
                Label { number, .. } => took.extend([number, now]),
            }
        }
        let busy = busy_ns() - before;
        println!("took {busy} {}", text(&took));
    }
    drop(inlet);
    println!("end");
    Ok(())
}

fn inlet(task: &Task, number: usize, address: &str) -> Outcome<Box<dyn Inlet>> {
    Ok(match task.way {
        Way::Doorbell | Way::Event | Way::Spin => Box::new(topic::BytesInlet::new(task)?),
        Way::Subscription => Box::new(topic::ScansInlet::new(task)?),
        Way::Multicast | Way::UnixDatagram => Box::new(sockets::DatagramsInlet::new(task, number, address)?),
        Way::UnixStream | Way::Tcp | Way::Pipe => Box::new(sockets::StreamInlet::new(task, number, address)?),
        Way::FutexBaseline | Way::SpinBaseline => Box::new(baselines::WordInlet::new(task)?),
        Way::EventfdBaseline => Box::new(baselines::CounterInlet::new(task)?),
    })
}
