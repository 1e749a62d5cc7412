//! The sensor's side of the conversation, without a line and without a clock: host bytes and times go in, chunks of
//! bytes with the time at which they are through come out. What it measures comes from [`Source`]; what is lost on
//! the way is not its affair.
//!
//! Drive it like this: call [`Machine::poll_transmit`] until it answers `None`, hear the host's bytes, and come back
//! at [`Machine::poll_timeout`].

use std::collections::VecDeque;

use lms::telegram::{ACK, NAK, REPLY, Telegram};
use lms::variant::{Baud, MIRROR_TURN, Mode, Unit, Variant};
use lms::{MILLIS, Nanos};

use crate::answer::Answer;
use crate::ear::{Arrival, Ear};
use crate::source::Source;
use crate::transmission::{ChunkSize, Transmission};

/// What the sensor is when the power comes on, and the hardware at the host's end of its line.
#[derive(Clone, Debug)]
pub struct Settings {
    /// The sensor's own address, 0 to 127; it answers to this one and to 0.
    pub address: u8,
    /// What it says of itself to 3Ah: 21 ASCII characters by custom.
    pub type_name: String,
    /// Rate of the line at power-on.
    pub baud: Baud,
    /// Angle and resolution at power-on.
    pub variant: Variant,
    /// Unit of the ranges.
    pub unit: Unit,
    /// How the 16 bits of a value are split.
    pub mode: Mode,
    /// How many bytes come at once.
    pub chunk: ChunkSize,
    /// How many times faster the machine's time runs than the host's, which keeps the gaps of its requests by its own
    /// clock.
    pub speed: f64,
    /// Seed of the delays before replies.
    pub seed: u64,
}

impl Default for Settings {
    /// An LMS 200 as it left the factory, except for mode 1: millimetres and reflector levels.
    fn default() -> Self {
        Settings {
            address: 0,
            type_name: "LMS200;301063;V02.30 ".into(),
            baud: Baud::B9600,
            variant: Variant::HALF,
            unit: Unit::Mm,
            mode: Mode(1),
            chunk: ChunkSize::Uart,
            speed: 1.0,
            seed: 0,
        }
    }
}

/// Bytes that the host's hardware hands over at once.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Chunk {
    /// Up to 62 bytes; none at the end of a telegram that was broken off between two bursts.
    pub bytes: Vec<u8>,
    /// The rate they were sent at.
    pub baud: Baud,
    /// Whether the line is idle after them.
    pub idle_after: bool,
    /// What they are part of.
    pub part: Part,
}

/// Where a chunk stands.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Part {
    /// A single ACK or NAK.
    Acknowledge,
    /// Bytes of a telegram, not its last ones.
    Telegram,
    /// The last bytes of a telegram that leave.
    End(Sent),
}

/// A telegram that has left.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Sent {
    /// Measured values of the stream, or a reply.
    pub is_reply: bool,
    /// The telegram as it should have been.
    pub telegram: Vec<u8>,
    /// Whether a request broke it off.
    pub aborted: bool,
}

/// The sensor.
pub struct Machine {
    pub(crate) settings: Settings,
    pub(crate) source: Source,
    /// The byte after the last 20h.
    pub(crate) operating_mode: u8,
    pub(crate) eeprom_writes: u64,
    baud: Baud,
    ear: Ear,
    random: fastrand::Rng,
    queue: VecDeque<Transmission<Tag>>,
    /// When the next scan of the stream begins to leave; `None` while there is no stream.
    next_scan_ns: Option<Nanos>,
}

/// What a transmission is.
#[derive(Clone, Copy, Debug)]
enum Tag {
    Acknowledge,
    Scan,
    /// A reply, and the rate of the line after it.
    Reply(Option<Baud>),
}

impl Machine {
    /// A sensor that was powered on at time 0 and is through with its start-up.
    pub fn new(settings: Settings, source: Source) -> Self {
        Machine {
            baud: settings.baud,
            ear: Ear::new(settings.speed),
            random: fastrand::Rng::with_seed(settings.seed),
            settings,
            source,
            operating_mode: crate::answer::ON_REQUEST,
            eeprom_writes: 0,
            queue: VecDeque::new(),
            next_scan_ns: None,
        }
    }

    /// Rate of the line at which it hears now.
    pub fn baud(&self) -> Baud {
        self.baud
    }

    /// Requests heard that would write its EEPROM (40 42 46 66 77 7C), done or refused.
    pub fn eeprom_writes(&self) -> u64 {
        self.eeprom_writes
    }

    /// Hears a byte of the host. Call it after [`Machine::poll_transmit`] answered `None` for `arrival.not_after`.
    pub fn receive(&mut self, byte: u8, arrival: Arrival) {
        let Some(bytes) = self.ear.hear(byte, arrival, self.baud.rate()) else { return };
        if bytes[1] != 0 && bytes[1] != self.settings.address {
            return;
        }
        let free_ns = self.interrupt(arrival.not_after);
        let first_ns = free_ns + self.random.u64(2 * MILLIS..8 * MILLIS);
        let Some(request) = Telegram::check(&bytes) else {
            self.send(vec![NAK], first_ns, Tag::Acknowledge);
            return;
        };
        let Answer { reply, delay_ns, baud } = self.answer(request);
        let acknowledged_ns = self.send(vec![ACK], first_ns, Tag::Acknowledge);
        let reply_ns = acknowledged_ns + delay_ns + self.random.u64(..3 * MILLIS);
        self.send(reply.bytes().to_vec(), reply_ns, Tag::Reply(baud));
    }

    /// The next bytes that are through at `now`.
    pub fn poll_transmit(&mut self, now: Nanos) -> Option<Chunk> {
        if self.queue.is_empty() {
            self.start_scan(now);
        }
        let front = self.queue.front_mut()?;
        let baud = front.baud();
        let (bytes, idle_after) = front.take_chunk(now)?;
        let bytes = bytes.to_vec();
        let part = match front.tag {
            Tag::Acknowledge => Part::Acknowledge,
            Tag::Scan | Tag::Reply(_) => Part::Telegram,
        };
        let part = if front.is_done() { self.finish_front(part) } else { part };
        Some(Chunk { bytes, baud, idle_after, part })
    }

    /// When there will be something to transmit.
    pub fn poll_timeout(&self) -> Option<Nanos> {
        self.queue.front().map(Transmission::next_chunk_ns).or(self.next_scan_ns)
    }

    /// Puts the next scan of the stream on the line if it is due.
    fn start_scan(&mut self, now: Nanos) {
        let Some(start_ns) = self.next_scan_ns.filter(|&at| at <= now) else { return };
        // At the end of a recording there is none: the line stays open and silent.
        self.next_scan_ns = None;
        let Some(telegram) = self.source.telegram(start_ns, &self.settings) else { return };
        let period_ns = self.settings.variant.period(telegram.len(), self.baud.rate());
        self.next_scan_ns = Some(start_ns + period_ns);
        self.send(telegram, start_ns, Tag::Scan);
    }

    /// Takes the finished transmission off the line and does what follows from it.
    fn finish_front(&mut self, part: Part) -> Part {
        let Some(front) = self.queue.pop_front() else { return part };
        let (end_ns, aborted) = (front.end_ns(), front.is_broken());
        if let Tag::Reply(Some(baud)) = front.tag {
            self.baud = baud;
        }
        if self.queue.is_empty() && self.is_streaming() && !matches!(front.tag, Tag::Scan) {
            // The stream goes on with a whole scan, where the mirror begins one.
            let scan_ns = self.settings.variant.turns() * MIRROR_TURN;
            self.next_scan_ns = Some(end_ns.next_multiple_of(scan_ns));
        }
        let (telegram, tag) = front.into_parts();
        match tag {
            Tag::Acknowledge => part,
            Tag::Scan | Tag::Reply(_) => {
                Part::End(Sent { is_reply: matches!(tag, Tag::Reply(_)), telegram, aborted })
            }
        }
    }

    /// The host is master: what is being sent ends with the byte in the transmitter, what was to be sent is not.
    /// Returns when the line is free.
    fn interrupt(&mut self, now: Nanos) -> Nanos {
        self.next_scan_ns = None;
        self.queue.retain(|transmission| transmission.start_ns() <= now);
        self.queue.truncate(1);
        let Some(front) = self.queue.front_mut() else { return now };
        front.break_off(now);
        front.end_ns().max(now)
    }

    /// Queues `bytes` from `start_ns` on; returns when the last one is through.
    fn send(&mut self, bytes: Vec<u8>, start_ns: Nanos, tag: Tag) -> Nanos {
        let transmission = Transmission::new(bytes, start_ns, self.baud, self.settings.chunk, tag);
        let end_ns = transmission.end_ns();
        self.queue.push_back(transmission);
        end_ns
    }

    fn is_streaming(&self) -> bool {
        self.operating_mode == crate::answer::STREAM
    }

    /// Address byte of what it sends.
    pub(crate) fn reply_address(&self) -> u8 {
        self.settings.address | REPLY
    }
}
