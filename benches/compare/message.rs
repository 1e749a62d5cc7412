//! The mechanisms that the bench compares, the messages that each of them transfers, and the phases in which messages
//! are sent. Sender and receivers both use these definitions.

use std::hint::black_box;

use scanhub_schema::{ArrayFlags, Scan};

use crate::support::Outcome;

/// A mechanism that transfers messages from one process to others, and the way in which the receivers wait.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Mechanism {
    /// A topic of the hub. Receivers sleep on its doorbell.
    Doorbell,
    /// A topic of the hub. Receivers sleep on its event.
    Event,
    /// A topic of the hub. Receivers poll its doorbell without a pause.
    Spin,
    /// The scan topic itself, received with the client library as programs do.
    Subscription,
    /// Datagrams to a UDP multicast group on the loopback.
    Multicast,
    /// A Unix datagram socket for each receiver.
    UnixDatagram,
    /// A Unix stream socket for each receiver.
    UnixStream,
    /// A TCP connection on the loopback for each receiver.
    Tcp,
    /// A pipe for each receiver.
    Pipe,
    /// A wake-up by futex, without a message.
    FutexBaseline,
    /// A wake-up by eventfd, without a message.
    EventfdBaseline,
    /// A cache line that another processor changes, without a message.
    SpinBaseline,
}

impl Mechanism {
    /// All mechanisms in the order of the tables.
    pub(crate) const ALL: [Mechanism; 12] = [
        Mechanism::Doorbell,
        Mechanism::Event,
        Mechanism::Spin,
        Mechanism::Subscription,
        Mechanism::Multicast,
        Mechanism::UnixDatagram,
        Mechanism::UnixStream,
        Mechanism::Tcp,
        Mechanism::Pipe,
        Mechanism::FutexBaseline,
        Mechanism::EventfdBaseline,
        Mechanism::SpinBaseline,
    ];

    /// Returns the name in tables and on command lines.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Mechanism::Doorbell => "topic, doorbell",
            Mechanism::Event => "topic, event",
            Mechanism::Spin => "topic, spinning",
            Mechanism::Subscription => "topic, Subscriber::next",
            Mechanism::Multicast => "UDP multicast",
            Mechanism::UnixDatagram => "Unix datagrams",
            Mechanism::UnixStream => "Unix streams",
            Mechanism::Tcp => "TCP",
            Mechanism::Pipe => "pipes",
            Mechanism::FutexBaseline => "baseline: futex",
            Mechanism::EventfdBaseline => "baseline: eventfd",
            Mechanism::SpinBaseline => "baseline: cache line",
        }
    }

    /// Returns the mechanism of this name.
    pub(crate) fn from_name(name: &str) -> Outcome<Mechanism> {
        Ok(Mechanism::ALL
            .into_iter()
            .find(|mechanism| mechanism.name() == name)
            .ok_or_else(|| format!("unknown mechanism {name}"))?)
    }

    /// Returns whether this is a mechanism that users could choose instead of topics.
    pub(crate) fn is_alternative(self) -> bool {
        matches!(
            self,
            Mechanism::Multicast
                | Mechanism::UnixDatagram
                | Mechanism::UnixStream
                | Mechanism::Tcp
                | Mechanism::Pipe
        )
    }

    /// Returns whether this is a baseline, which wakes the receiver but transfers no message.
    pub(crate) fn is_baseline(self) -> bool {
        matches!(self, Mechanism::FutexBaseline | Mechanism::EventfdBaseline | Mechanism::SpinBaseline)
    }

    /// Returns whether the sender never waits for its receivers, so that slow receivers miss messages.
    pub(crate) fn is_lossy(self) -> bool {
        !self.is_baseline()
            && !matches!(
                self,
                Mechanism::UnixDatagram | Mechanism::UnixStream | Mechanism::Tcp | Mechanism::Pipe
            )
    }

    /// Returns whether the bench runs the mechanism with this number of receivers and with messages of this length. A
    /// receiver that spins needs its own processor, and so does the sender. A baseline has one receiver. The client
    /// library is compared only for messages of the length of a scan.
    pub(crate) fn is_run_with(self, receivers: usize, payload: usize, processors: usize) -> bool {
        match self {
            Mechanism::Spin => receivers < processors,
            Mechanism::SpinBaseline => receivers == 1 && processors > 1,
            Mechanism::FutexBaseline | Mechanism::EventfdBaseline => receivers == 1,
            Mechanism::Subscription => receivers == 1 && payload == SCAN_LEN,
            _ => true,
        }
    }
}

/// Identification of a message. The sender writes it to the start and to the end of the message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Label {
    /// Index in [`PHASES`] of the phase to which the message belongs.
    pub(crate) phase: usize,
    /// Number of the message within its phase, starting at 0.
    pub(crate) number: u64,
    /// Whether the message only reports the end of its phase.
    pub(crate) is_end: bool,
}

impl Label {
    /// Writes the label to the start and to the end of `bytes`.
    pub(crate) fn write(self, bytes: &mut [u8]) {
        let kind = self.phase as u64 * 2 + u64::from(self.is_end);
        let number = self.number.to_le_bytes();
        let tail = bytes.len() - NUMBER_LEN;
        bytes[..NUMBER_LEN].copy_from_slice(&number);
        bytes[NUMBER_LEN..LABEL_LEN].copy_from_slice(&kind.to_le_bytes());
        bytes[tail..].copy_from_slice(&number);
    }

    /// Reads a byte of each cache line of a message, and returns its label. Fails if the labels at both ends of `bytes`
    /// are different.
    pub(crate) fn read(bytes: &[u8]) -> Outcome<Label> {
        black_box(bytes.iter().step_by(CACHE_LINE_LEN).fold(0u64, |sum, byte| sum + u64::from(*byte)));
        let [number, kind] = [&bytes[..NUMBER_LEN], &bytes[NUMBER_LEN..LABEL_LEN]].map(word);
        if word(&bytes[bytes.len() - NUMBER_LEN..]) != number {
            return Err(format!("message {number} is torn").into());
        }
        Ok(Label { phase: kind as usize / 2, number, is_end: kind % 2 == 1 })
    }
}

fn word(bytes: &[u8]) -> u64 {
    bytes.iter().rev().fold(0, |word, byte| word << 8 | u64::from(*byte))
}

/// A message in the sender's own memory. The sender writes the message again before each send, because a real sender
/// would have just computed its data.
pub(crate) struct MessageBuffer {
    contents: Vec<u8>,
    bytes: Vec<u8>,
}

impl MessageBuffer {
    /// Creates a buffer for messages of `len` bytes.
    pub(crate) fn new(len: usize) -> MessageBuffer {
        MessageBuffer { contents: contents(len), bytes: contents(len) }
    }

    /// Returns the message.
    pub(crate) fn bytes(&self) -> &[u8] {
        &self.bytes
    }

    /// Writes a complete message.
    pub(crate) fn write(&mut self, label: Label) {
        self.bytes.copy_from_slice(&self.contents);
        label.write(&mut self.bytes);
    }

    /// Writes a message of the minimum length, and returns it.
    pub(crate) fn write_short(&mut self, label: Label) -> &[u8] {
        let bytes = &mut self.bytes[..MIN_MESSAGE_LEN];
        label.write(bytes);
        bytes
    }
}

/// Returns the content of a message of `len` bytes. The label then overwrites the start and the end.
pub(crate) fn contents(len: usize) -> Vec<u8> {
    (0..len).map(|i| i as u8).collect()
}

/// Number of beams in the hub's own messages: 180 degrees in steps of 0.5 degrees.
pub(crate) const BEAM_COUNT: usize = 361;
/// Length of a scan of [`BEAM_COUNT`] beams.
pub(crate) const SCAN_LEN: usize = Scan::len(BEAM_COUNT, ArrayFlags::UPPER);
/// Length of the shortest message.
pub(crate) const MIN_MESSAGE_LEN: usize = LABEL_LEN + NUMBER_LEN;
const NUMBER_LEN: usize = size_of::<u64>();
const LABEL_LEN: usize = 2 * NUMBER_LEN;
const CACHE_LINE_LEN: usize = 64;

/// A series of messages at one rate.
pub(crate) struct Phase {
    /// Name in tables.
    pub(crate) name: &'static str,
    /// Time from one message to the next, in nanoseconds, or 0 for messages without a pause.
    pub(crate) period_ns: u64,
    /// Maximum number of messages.
    max_count: usize,
    /// Maximum duration of the phase, in nanoseconds. The limit exists because some mechanisms cannot keep the rate.
    max_ns: u64,
}

impl Phase {
    /// Returns the number of messages that `mechanism` sends. Baselines send only in phases with a rate, because a
    /// wake-up can be counted only while the receiver waits.
    pub(crate) fn count(&self, mechanism: Mechanism) -> usize {
        if mechanism.is_baseline() && self.period_ns == 0 { 0 } else { self.max_count }
    }

    /// Returns the maximum duration of the phase with `mechanism`, in nanoseconds. It is not limited for baselines,
    /// whose receivers detect the end only by the number of wake-ups.
    pub(crate) fn max_ns(&self, mechanism: Mechanism) -> u64 {
        if mechanism.is_baseline() { u64::MAX } else { self.max_ns }
    }
}

/// The phases in their order. The first phase only fills memory and caches, so its results do not count.
pub(crate) const PHASES: [Phase; 4] = [
    Phase { name: "warm-up", period_ns: 1_000_000, max_count: 20, max_ns: 40_000_000 },
    Phase { name: "37.5 Hz", period_ns: 26_666_667, max_count: 28, max_ns: 900_000_000 },
    Phase { name: "1 kHz", period_ns: 1_000_000, max_count: 400, max_ns: 500_000_000 },
    Phase { name: "flat out", period_ns: 0, max_count: 2000, max_ns: 300_000_000 },
];
