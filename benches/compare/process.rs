//! The sending and the receiving process of a run. Both of them work with any mechanism. They print the time at which
//! each message was sent or received, and the CPU time for sending or receiving.

use std::fmt::Write as _;
use std::io::ErrorKind;
use std::os::unix::net::UnixDatagram;
use std::time::Duration;

use rustix::time::{ClockId, clock_gettime};

use super::message::{Label, Mechanism, PHASES, Phase};
use super::{baselines, sockets, topic};
use crate::support::{Outcome, clock};

/// Parameters of the run to which a sender or a receiver belongs.
pub(crate) struct RunParameters<'a> {
    pub(crate) mechanism: Mechanism,
    /// Length of a message, in bytes.
    pub(crate) payload: usize,
    pub(crate) receivers: usize,
    /// Domain of topics.
    pub(crate) domain: &'a str,
    /// Prefix of the paths of sockets and pipes.
    pub(crate) path_prefix: &'a str,
}

/// Sending end of a mechanism.
pub(crate) trait MessageSender {
    /// Returns the address that receivers need to connect, or "-" if they need none.
    fn address(&self) -> Outcome<String> {
        Ok("-".into())
    }

    /// Connects to all receivers. They are already waiting for the connection.
    fn open(&mut self) -> Outcome<()>;

    /// Writes a message to the memory from which it will be sent. Baselines write nothing.
    fn write(&mut self, label: Label) -> Outcome<()>;

    /// Sends the written message to all receivers.
    fn send(&mut self) -> Outcome<()>;

    /// Reports the end of a phase to all receivers.
    fn end(&mut self, label: Label) -> Outcome<()> {
        self.write(label)?;
        self.send()
    }
}

/// Sends until the control socket reports the end. Prints `ready ADDRESS`, `open`, and for each phase `sent BUSY_NS
/// SENDING_NS SENT_NS..`. BUSY_NS is the whole CPU time. SENDING_NS is the CPU time without the writing of messages and
/// without the waits, or 0 if it was not measured.
pub(crate) fn send_all(task: &RunParameters) -> Outcome<()> {
    let control_socket = UnixDatagram::bind(control_path(task.path_prefix))?;
    let mut outlet = sender(task)?;
    println!("ready {}", outlet.address()?);
    wait_for_go(&control_socket)?;
    outlet.open()?;
    println!("open");
    wait_for_go(&control_socket)?;
    for (number, phase) in PHASES.iter().enumerate() {
        let before = busy_ns();
        let sent = send(outlet.as_mut(), phase, number, task.mechanism)?;
        println!("sent {} {}", busy_ns() - before, text(&sent));
        let sent = &sent[1..];
        let end = Label { phase: number, number: sent.len() as u64, is_end: true };
        outlet.end(end)?;
        if task.mechanism.is_lossy() {
            control_socket.set_read_timeout(Some(END_REPEAT_INTERVAL))?;
            while !is_signaled(&control_socket)? {
                outlet.end(end)?;
            }
            control_socket.set_read_timeout(None)?;
        } else {
            wait_for_go(&control_socket)?;
        }
    }
    drop(outlet);
    std::fs::remove_file(control_path(task.path_prefix))?;
    println!("end");
    Ok(())
}

/// Returns the path of the socket through which the bench makes the sender continue.
pub(crate) fn control_path(path_prefix: &str) -> String {
    format!("{path_prefix}-control")
}

/// Returns the CPU time of this thread, in nanoseconds. The file schedstat has the same value, but the kernel updates
/// the file only at the end of a tick or of a sleep.
pub(crate) fn busy_ns() -> u64 {
    let busy = clock_gettime(ClockId::ThreadCPUTime);
    busy.tv_sec as u64 * 1_000_000_000 + busy.tv_nsec as u64
}

fn sender(task: &RunParameters) -> Outcome<Box<dyn MessageSender>> {
    Ok(match task.mechanism {
        Mechanism::Doorbell | Mechanism::Event | Mechanism::Spin => Box::new(topic::BytesSender::new(task)?),
        Mechanism::Subscription => Box::new(topic::ScanSender::new(task)?),
        Mechanism::Multicast | Mechanism::UnixDatagram => Box::new(sockets::DatagramSender::new(task)?),
        Mechanism::UnixStream | Mechanism::Tcp | Mechanism::Pipe => {
            Box::new(sockets::StreamSender::new(task)?)
        }
        Mechanism::FutexBaseline | Mechanism::SpinBaseline => Box::new(baselines::FutexWriter::new(task)?),
        Mechanism::EventfdBaseline => Box::new(baselines::EventfdWriter::new(task)?),
    })
}

/// Runs a phase. Returns the CPU time of sending without writing and waits, followed by the time at which each message
/// was sent.
fn send(
    sender: &mut dyn MessageSender,
    phase: &Phase,
    position: usize,
    mechanism: Mechanism,
) -> Outcome<Vec<u64>> {
    let count = phase.count(mechanism);
    let mut sent = Vec::with_capacity(1 + count);
    sent.push(0);
    let begin = clock::now();
    while sent.len() <= count {
        let number = sent.len() as u64 - 1;
        let due = begin + (number + 1) * phase.period_ns;
        if phase.period_ns > 0 && clock::now() < due {
            clock::sleep_until(due);
        } else if clock::now() - begin > phase.max_ns(mechanism) {
            break;
        }
        sender.write(Label { phase: position, number, is_end: false })?;
        // Read the CPU time only in phases with a rate, because reading it is a system call that would slow down a
        // sender without pauses.
        let before = (phase.period_ns > 0).then(busy_ns);
        sent.push(clock::now());
        sender.send()?;
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

fn wait_for_go(socket: &UnixDatagram) -> Outcome<()> {
    while !is_signaled(socket)? {}
    Ok(())
}

fn is_signaled(socket: &UnixDatagram) -> Outcome<bool> {
    match socket.recv(&mut [0; 8]) {
        Ok(_) => Ok(true),
        Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted) => Ok(false),
        Err(error) => Err(error.into()),
    }
}

/// Interval at which the sender reports the end of a phase again. The sender repeats the report only if the mechanism
/// can lose messages.
const END_REPEAT_INTERVAL: Duration = Duration::from_millis(20);

/// Receiving end of a mechanism.
pub(crate) trait MessageReceiver {
    /// Waits for the next message and reads it.
    fn next(&mut self) -> Outcome<Label>;
}

/// Receives all phases. Prints `ready` when it can no longer miss a message. For each phase, prints `took BUSY_NS`,
/// followed by the number and the time of every message.
pub(crate) fn receive_all(task: &RunParameters, number: usize, address: &str) -> Outcome<()> {
    let mut inlet = receiver(task, number, address)?;
    println!("ready");
    for (current, phase) in PHASES.iter().enumerate() {
        let mut received_times = Vec::with_capacity(2 * phase.count(task.mechanism));
        let before = busy_ns();
        loop {
            let label = inlet.next()?;
            let now = clock::now();
            match label {
                Label { phase, .. } if phase != current => {}
                Label { is_end: true, .. } => break,
                Label { number, .. } => received_times.extend([number, now]),
            }
        }
        let busy = busy_ns() - before;
        println!("took {busy} {}", text(&received_times));
    }
    drop(inlet);
    println!("end");
    Ok(())
}

fn receiver(task: &RunParameters, number: usize, address: &str) -> Outcome<Box<dyn MessageReceiver>> {
    Ok(match task.mechanism {
        Mechanism::Doorbell | Mechanism::Event | Mechanism::Spin => {
            Box::new(topic::BytesReceiver::new(task)?)
        }
        Mechanism::Subscription => Box::new(topic::ScanReceiver::new(task)?),
        Mechanism::Multicast | Mechanism::UnixDatagram => {
            Box::new(sockets::DatagramReceiver::new(task, number, address)?)
        }
        Mechanism::UnixStream | Mechanism::Tcp | Mechanism::Pipe => {
            Box::new(sockets::StreamReceiver::new(task, number, address)?)
        }
        Mechanism::FutexBaseline | Mechanism::SpinBaseline => Box::new(baselines::FutexReader::new(task)?),
        Mechanism::EventfdBaseline => Box::new(baselines::EventfdReader::new(task)?),
    })
}
