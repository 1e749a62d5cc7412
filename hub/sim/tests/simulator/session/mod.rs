//! Bench and tests of a session: a session and a simulated scanner at the two ends of a line, in virtual time. Each
//! test defines how the line changes bytes. The bench checks the invariants of a session at every step.

mod control;
mod losses;
mod power;
mod problems;
mod property;
mod start;

use std::collections::VecDeque;

use scanhub_drivers::line::{Action, Event, KnownRate, Protocol as _, ScannerSession as _, State, Values};
use scanhub_drivers::lms::command::Request;
use scanhub_drivers::lms::variant::{Baud, Variant};
use scanhub_drivers::lms::{LmsSession, Settings};
use scanhub_drivers::{line, lms};
use scanhub_schema::{MICROS, MILLIS, Nanos, line_time};
use scanhub_sim::device::{ChunkKind, Device as _};
use scanhub_sim::fault::{Fault, Faults};
use scanhub_sim::line_model::{BaudMismatch, Delivery, LineModel};
use scanhub_sim::machine::LmsSimulator;
use scanhub_sim::operating::ScanSource;
use scanhub_sim::room::Room;
use scanhub_sim::{Arrival, machine};

/// Changes a chunk from scanner to host that has left the line at the given time.
pub(crate) type HostFilter = Box<dyn FnMut(Nanos, Vec<u8>) -> Vec<u8>>;
/// Changes the byte with the given index from host to scanner. If it returns `None`, the byte is lost.
pub(crate) type SensorFilter = Box<dyn FnMut(usize, u8) -> Option<u8>>;

/// A session, a scanner, the line between them, and records of the bytes and telegrams on the line.
pub(crate) struct Bench {
    pub(crate) session: LmsSession,
    pub(crate) machine: LmsSimulator,
    /// Faults of the line.
    pub(crate) line: LineModel,
    pub(crate) now: Nanos,
    pub(crate) to_host: HostFilter,
    pub(crate) to_scanner: SensorFilter,
    /// Bytes that the session sent, with their times.
    pub(crate) sent_bytes: Vec<(Nanos, u8)>,
    /// Times at which the scanner received the last byte of a request.
    pub(crate) request_times: Vec<Nanos>,
    /// Received ACKs and NAKs with their times.
    pub(crate) acknowledged: Vec<(Nanos, u8)>,
    /// Number of bytes that the host received between telegrams, although the scanner did not send them.
    pub(crate) foreign: usize,
    pub(crate) sent: Vec<SentTelegram>,
    pub(crate) received: Vec<ReceivedTelegram>,
    /// States of the session in order. Equal consecutive states are listed once.
    pub(crate) states: Vec<State>,
    port: Baud,
    /// Size of the host's input buffer in bytes. As in a tty, bytes that arrive while the buffer is full are lost.
    pub(crate) buffer_len: usize,
    /// Bytes in the host's input buffer.
    inbox: VecDeque<u8>,
    baud_mismatch: BaudMismatch,
    damaged: bool,
    fault: Option<Fault>,
    /// Whether the session has streamed since the start of the telegram on the line.
    was_streaming: bool,
    read: u64,
    reads: u32,
    /// Bytes of the current request that have been sent.
    request: Vec<u8>,
}

/// A telegram as the scanner sent it.
#[derive(Clone, Debug)]
pub(crate) struct SentTelegram {
    /// Time at which the line had carried the last byte of the telegram.
    pub(crate) at: Nanos,
    pub(crate) telegram: Vec<u8>,
    pub(crate) is_reply: bool,
    pub(crate) aborted: bool,
    /// Whether the line damaged the telegram.
    pub(crate) damaged: bool,
    /// Fault that the line applied to the telegram.
    #[allow(dead_code, reason = "for the tests of faults")]
    pub(crate) fault: Option<Fault>,
    /// Whether the session streamed while the telegram arrived, so that only the line can have lost it.
    #[allow(dead_code, reason = "for the tests of faults")]
    pub(crate) was_streaming: bool,
}

/// A telegram as the session delivered it.
#[derive(Clone, Debug)]
pub(crate) struct ReceivedTelegram {
    pub(crate) at: Nanos,
    pub(crate) telegram: Vec<u8>,
    /// Number of range bits in the values of a scan. `None` if the session did not know the measuring mode at the time
    /// of delivery, or if the telegram is not a scan.
    pub(crate) range_bits: Option<u8>,
    /// Reasons why the telegram is suspect; 0 if it is clean.
    #[allow(dead_code, reason = "for the tests of faults")]
    pub(crate) reasons: u8,
    /// Time that the session reported for the first byte of the telegram.
    #[allow(dead_code, reason = "for the tests of stamps")]
    pub(crate) first: Nanos,
    #[allow(dead_code, reason = "for the tests of stamps")]
    pub(crate) estimated: bool,
    /// Number of reads since the previous telegram.
    pub(crate) reads_since_last: u32,
}

/// Settings of the session in all tests of this module.
pub(crate) const SESSION_SETTINGS: Settings = Settings {
    variant: Variant::HALF,
    baud: Baud::B500000,
    listen_only: false,
    fixed_rate: false,
    keep_baud: false,
    mode: None,
};

/// Creates a scanner in a room. Its line has the rate `baud`.
pub(crate) fn sensor(baud: Baud) -> LmsSimulator {
    let settings = machine::Settings { baud, seed: 1, ..machine::Settings::default() };
    LmsSimulator::new(settings, ScanSource::Room(Room::new(&"room".parse().unwrap(), 1)))
}

/// Creates a scanner with `settings` in a room.
pub(crate) fn sensor_with(settings: machine::Settings) -> LmsSimulator {
    LmsSimulator::new(settings, ScanSource::Room(Room::new(&"room".parse().unwrap(), 1)))
}

/// Makes `machine` stream, as a previous host. Returns the time on the machine's clock afterwards.
pub(crate) fn make_stream(machine: &mut LmsSimulator) -> Nanos {
    let mut now = 10 * MILLIS;
    for &byte in Request::Stream.encode(0).bytes() {
        now += line_time(1, machine.baud().rate()) + 60 * MICROS;
        machine.receive(byte, Arrival::at(now));
    }
    // Wait until the scanner has sent the reply and some scans.
    now += 2_000 * MILLIS;
    while machine.poll_transmit(now).is_some() {}
    now
}

impl Bench {
    /// Creates a session that starts at the time `now` of the machine's clock, on a line without faults.
    pub(crate) fn new(machine: LmsSimulator, now: Nanos) -> Bench {
        Bench::with_settings(SESSION_SETTINGS, machine, now)
    }

    /// Creates a session like [`Bench::new`], with other settings.
    pub(crate) fn with_settings(settings: Settings, mut machine: LmsSimulator, now: Nanos) -> Bench {
        while machine.poll_transmit(now).is_some() {}
        Bench {
            session: LmsSession::new(settings, now),
            machine,
            line: LineModel::new(&Faults::default(), 0),
            now,
            to_host: Box::new(|_, bytes| bytes),
            to_scanner: Box::new(|_, byte| Some(byte)),
            sent_bytes: Vec::new(),
            request_times: Vec::new(),
            acknowledged: Vec::new(),
            foreign: 0,
            sent: Vec::new(),
            received: Vec::new(),
            states: Vec::new(),
            port: settings.baud,
            buffer_len: usize::MAX,
            inbox: VecDeque::new(),
            baud_mismatch: BaudMismatch::default(),
            damaged: false,
            fault: None,
            was_streaming: true,
            read: 0,
            reads: 0,
            request: Vec::new(),
        }
    }

    /// Makes the session try `baud` first, as in a hub that has found the scanner at this rate before.
    pub(crate) fn set_first_probe_rate(&mut self, baud: Baud) {
        let silent_switches = self.session.silent_switches();
        self.session.hint_rate(KnownRate { baud: baud.rate(), silent_switches });
    }

    /// Returns the rate at which the session has found the scanner.
    pub(crate) fn discovered_rate(&self) -> Option<Baud> {
        self.session.known_rate().and_then(|known| Baud::of_rate(known.baud))
    }

    /// Connects the machine to a session that has run before. The session must not be in the middle of a request.
    pub(crate) fn with_session(session: LmsSession, machine: LmsSimulator, now: Nanos) -> Bench {
        let (port, read) = (session.baud(), session.framer_counters().read);
        Bench { port, read, session, ..Bench::new(machine, now) }
    }

    /// Runs for `span`.
    pub(crate) fn run(&mut self, span: Nanos) {
        let end = self.now + span;
        while self.now < end {
            self.step(end);
        }
    }

    /// Runs until `is_true` returns true, which must happen within `span`. Returns the duration.
    pub(crate) fn run_until(
        &mut self,
        description: &str,
        span: Nanos,
        is_true: impl Fn(&Bench) -> bool,
    ) -> Nanos {
        let started = self.now;
        while !is_true(self) {
            assert!(self.now < started + span, "not {description} within {} ms: {self}", span / MILLIS);
            self.step(started + span);
        }
        self.now - started
    }

    pub(crate) fn is_streaming(&self) -> bool {
        self.session.state() == State::Streaming
    }

    /// Returns the scans that the scanner sent whole, that the line did not damage, and that ended after `since`.
    pub(crate) fn intact_scans(&self, since: Nanos) -> Vec<&[u8]> {
        let intact =
            |sent: &&SentTelegram| sent.at > since && !(sent.is_reply || sent.aborted || sent.damaged);
        self.sent.iter().filter(intact).map(|sent| &sent.telegram[..]).collect()
    }

    /// Returns the scans that the session delivered after `since`.
    pub(crate) fn received_scans(&self, since: Nanos) -> Vec<&[u8]> {
        self.scans(since).map(|got| &got.telegram[..]).collect()
    }

    /// Returns the scans that the session delivered after `since`, with their stamps and the reasons why they are
    /// suspect.
    pub(crate) fn scans(&self, since: Nanos) -> impl Iterator<Item = &ReceivedTelegram> {
        let is_scan =
            move |got: &&ReceivedTelegram| got.at > since && got.telegram[4] == lms::measured::MEASURED;
        self.received.iter().filter(is_scan)
    }

    /// Stops the host for `span`, while the scanner and the line continue.
    #[allow(dead_code, reason = "for the tests of stamps")]
    pub(crate) fn stop_host(&mut self, span: Nanos) {
        self.advance(self.now + span);
    }

    /// Runs one round of the host: all actions of the session, then a wait, then a read.
    fn step(&mut self, limit: Nanos) {
        let (watch, until) = self.drain();
        self.wait(watch, until.min(limit));
        if !watch && self.now < until {
            return;
        }
        self.reads += 1;
        if watch && self.session.can_defer_read() && self.session.defer_read(self.now, self.inbox.len()) {
            return;
        }
        let spare = self.session.read_buffer();
        let len = spare.len().min(self.inbox.len());
        for (place, byte) in spare.iter_mut().zip(self.inbox.drain(..len)) {
            *place = byte;
        }
        self.read += len as u64;
        self.session.commit(self.now, len);
        if len == 0 && self.now >= until {
            self.session.handle_timeout(self.now);
        }
    }

    fn drain(&mut self) -> (bool, Nanos) {
        let wait = loop {
            match self.session.poll_action() {
                Action::SetDtr(_) => panic!("an LMS does not use DTR"),
                Action::SetRate(baud) => {
                    self.port = self.session.baud();
                    assert_eq!(self.port.rate(), baud);
                    self.damaged |= !self.inbox.is_empty();
                    self.inbox.clear();
                }
                Action::Transmit { bytes, not_before } => {
                    let &[byte] = bytes else { panic!("no gaps between {bytes:?}") };
                    self.transmit(byte, not_before);
                }
                Action::Event(Event::Scan(_)) => panic!("a telegram is a scan"),
                Action::Event(Event::Telegram(received)) => {
                    let line::ReceivedTelegram { bytes, contents: whole, reasons, first, estimated, .. } =
                        received;
                    let telegram = bytes.to_vec();
                    let reads_since_last = std::mem::take(&mut self.reads);
                    let range_bits = whole.and_then(|whole| match whole.scan?.values {
                        Values::Words { range_bits, .. } => Some(range_bits),
                        Values::Points { .. } => None,
                    });
                    let at = self.now;
                    self.received.push(ReceivedTelegram {
                        at,
                        telegram,
                        range_bits,
                        reasons,
                        first,
                        estimated,
                        reads_since_last,
                    });
                }
                Action::SleepUntil(until) => break (false, until),
                Action::Wait { until, .. } => break (true, until),
            }
        };
        let tally = self.session.framer_counters();
        let known = tally.in_telegrams + tally.acknowledge + tally.discarded + self.session.stats().buffered;
        assert_eq!((tally.read, known), (self.read, self.read), "bytes disappeared");
        assert_eq!(self.machine.eeprom_writes(), 0);
        self.was_streaming &= self.is_streaming();
        if self.states.last() != Some(&self.session.state()) {
            self.states.push(self.session.state());
        }
        wait
    }

    /// Waits until `until`. With `watch`, the arrival of bytes ends the wait.
    fn wait(&mut self, watch: bool, until: Nanos) {
        while !watch || self.inbox.is_empty() {
            match self.line.poll_timeout(&self.machine, self.now) {
                Some(at) if at <= until => self.advance(at),
                _ => break,
            }
        }
        let woken = if watch && !self.inbox.is_empty() { self.now } else { until };
        self.advance(woken.max(self.now) + WAKE_DELAY);
    }

    fn transmit(&mut self, byte: u8, not_before: Nanos) {
        self.advance(not_before);
        let byte_ns = line_time(1, self.port.rate());
        if !self.request.is_empty() {
            let (last, _) = self.sent_bytes[self.sent_bytes.len() - 1];
            let gap = self.now - last - byte_ns;
            assert!((55 * MICROS..=6 * MILLIS).contains(&gap), "{gap} ns between two bytes of a request");
        }
        self.request.push(byte);
        let mut is_whole = false;
        if let [_, _, low, high, ..] = self.request[..]
            && self.request.len() == usize::from(u16::from_le_bytes([low, high])) + lms::telegram::FRAME_LEN
        {
            self.request.clear();
            is_whole = true;
        }
        let number = self.sent_bytes.len();
        self.sent_bytes.push((self.now, byte));
        self.session.handle_transmitted(self.now);
        self.advance(self.now + byte_ns);
        if let Some(byte) = (self.to_scanner)(number, byte)
            && self.machine.baud() == self.port
        {
            self.line.receive(&mut self.machine, byte, Arrival::at(self.now));
            self.request_times.extend(is_whole.then_some(self.now));
        }
    }

    /// Advances the time to `to`, and delivers the bytes that arrive until then. If the time is already later, it does
    /// not change.
    fn advance(&mut self, to: Nanos) {
        while let Some(at) = self.line.poll_timeout(&self.machine, self.now).filter(|&at| at <= to) {
            self.now = self.now.max(at);
            while let Some(carried) = self.line.poll_transmit(&mut self.machine, self.now) {
                self.deliver(carried);
            }
        }
        self.now = self.now.max(to);
    }

    /// Handles the bytes that the line delivers.
    fn deliver(&mut self, delivery: Delivery) {
        if delivery.is_telegram() {
            self.fault = self.fault.or(delivery.fault);
        }
        let Delivery { bytes: brought, rate, idle_after, part, .. } = delivery;
        let mut bytes = (self.to_host)(self.now, brought.clone());
        if rate != self.port.rate() {
            bytes = self.baud_mismatch.receive((rate, self.port.rate()), &bytes, idle_after);
        }
        bytes.truncate(self.buffer_len - self.inbox.len());
        self.damaged |= bytes != brought;
        self.inbox.extend(bytes);
        match part {
            None => self.foreign += brought.len(),
            Some(ChunkKind::Telegram) => {}
            Some(ChunkKind::Acknowledge) => {
                self.damaged = false;
                self.acknowledged.extend(brought.first().map(|&byte| (self.now, byte)));
            }
            Some(ChunkKind::End(scanhub_sim::device::SentTelegram { is_reply, telegram, aborted })) => {
                let fault = self.fault.take();
                let damaged = std::mem::take(&mut self.damaged) || fault.is_some();
                let streams = self.is_streaming();
                let was_streaming = std::mem::replace(&mut self.was_streaming, streams);
                self.sent.push(SentTelegram {
                    at: self.now,
                    telegram,
                    is_reply,
                    aborted,
                    damaged,
                    fault,
                    was_streaming,
                });
            }
        }
    }
}

impl std::fmt::Display for Bench {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Bench { session, now, states, .. } = self;
        let problem = session.problem();
        write!(
            f,
            "at {} us, {:?}: {states:?}, {problem:?}, {:?}",
            now / MICROS,
            session.baud(),
            session.framer_counters()
        )
    }
}

/// Time from an event, such as the arrival of bytes, until the host runs.
const WAKE_DELAY: Nanos = 50 * MICROS;
