//! Bench and tests of a search: a search and a simulated scanner at the two ends of a line, in virtual time. If the
//! rates of port and scanner differ, bytes in both directions arrive garbled.

mod finding;
mod port;

use std::collections::VecDeque;

use scanhub_drivers::line::{Action, Protocol};
use scanhub_drivers::lms::variant::Baud;
use scanhub_drivers::search::{FoundScanner, Memory, PortKind, Search};
use scanhub_drivers::{ld, line};
use scanhub_schema::{MICROS, MILLIS, Nanos, line_time};
use scanhub_sim::device::Device;
use scanhub_sim::fault::Faults;
use scanhub_sim::ld::{LdSettings, LdSimulator};
use scanhub_sim::line_model::{BaudMismatch, LineModel};
use scanhub_sim::machine::{LmsSimulator, StartState};
use scanhub_sim::operating::OperatingMode;
use scanhub_sim::room::Room;
use scanhub_sim::rplidar::{Model, RplidarSettings, RplidarSimulator, RplidarStart};
use scanhub_sim::{Arrival, machine};

/// Host at the end of the line: a search, or a session with which the tests compare the search.
pub(crate) trait Host {
    type Result;

    fn protocol(&mut self) -> &mut impl Protocol;

    fn poll(&mut self) -> HostAction<Self::Result>;

    fn commit(&mut self, now: Nanos, len: usize) {
        self.protocol().commit(now, len);
    }
}

/// Next action of a host.
pub(crate) enum HostAction<R> {
    SetRate(u32),
    Transmit(Vec<u8>, Nanos),
    Wait(Nanos),
    SleepUntil(Nanos),
    Done(R),
}

impl<R> HostAction<R> {
    /// Returns the next action that `protocol` requests. `event` handles the events of `protocol`. If it returns a
    /// result, the host ends with this result.
    pub(crate) fn next_action(
        protocol: &mut impl Protocol,
        mut event: impl FnMut(line::Event<'_>) -> Option<R>,
    ) -> HostAction<R> {
        loop {
            return match protocol.poll_action() {
                Action::SetRate(rate) => HostAction::SetRate(rate),
                Action::SetDtr(_) => continue,
                Action::Transmit { bytes, not_before } => HostAction::Transmit(bytes.to_vec(), not_before),
                Action::Wait { until } => HostAction::Wait(until),
                Action::SleepUntil(until) => HostAction::SleepUntil(until),
                Action::Event(received) => match event(received) {
                    Some(result) => HostAction::Done(result),
                    None => continue,
                },
            };
        }
    }
}

impl Host for Search {
    type Result = FoundScanner;

    fn protocol(&mut self) -> &mut impl Protocol {
        self
    }

    fn poll(&mut self) -> HostAction<FoundScanner> {
        let event = HostAction::next_action(self, |event| panic!("{event:?}"));
        self.found().map_or(event, HostAction::Done)
    }
}

/// A session of a named family. The host ends when the session delivers the first telegram or scan.
pub(crate) struct NamedFamily<S>(pub(crate) S);

impl<S: line::ScannerSession> Host for NamedFamily<S> {
    type Result = ();

    fn protocol(&mut self) -> &mut impl Protocol {
        &mut self.0
    }

    fn poll(&mut self) -> HostAction<()> {
        HostAction::next_action(&mut self.0, |_| Some(()))
    }
}

/// A host, a scanner, the line between them, and records of the host's actions.
pub(crate) struct Bench<H = Search> {
    pub(crate) host: H,
    /// The scanner; `None` if no scanner is connected.
    pub(crate) device: Option<Box<dyn Device>>,
    line: LineModel,
    /// Time at which the scanner gets power.
    power_at: Nanos,
    is_powered: bool,
    pub(crate) opened_at: Nanos,
    pub(crate) now: Nanos,
    port: PortKind,
    rate: u32,
    /// Rates that the port does not support.
    pub(crate) unsupported_rates: Vec<u32>,
    to_host: BaudMismatch,
    to_device: BaudMismatch,
    /// Time at which the line has carried the last byte of the host.
    last_sent_at: Nanos,
    /// Whether the scanner's receiver was informed that the line is idle since then.
    is_flushed: bool,
    inbox: VecDeque<u8>,
    /// Additional random bytes: the time of the next byte, and the mean time between two bytes. `None` without such
    /// bytes.
    noise: Option<(Nanos, Nanos)>,
    random: fastrand::Rng,
    /// Bytes that the search has sent, with their times and rates.
    pub(crate) written: Vec<(Nanos, u32, u8)>,
    /// Bytes that the host has read at the current rate, with their times.
    pub(crate) read: Vec<(Nanos, Vec<u8>)>,
    /// Rates that the search has set, with their times.
    pub(crate) rates: Vec<(Nanos, u32)>,
}

pub(crate) fn room(seed: u64) -> Room {
    Room::new(&"random".parse().expect("a world"), seed)
}

/// Creates an LMS at `baud`, which streams if `streams` is set and is idle otherwise.
pub(crate) fn lms(baud: Baud, streams: bool, seed: u64) -> Box<dyn Device> {
    let operating = if streams { OperatingMode::All } else { OperatingMode::OnRequest };
    let settings = machine::Settings {
        baud,
        start: StartState::Operating(operating),
        seed,
        ..machine::Settings::default()
    };
    Box::new(LmsSimulator::new(settings, scanhub_sim::operating::ScanSource::Room(room(seed))))
}

pub(crate) fn ld(model: ld::Model, seed: u64) -> Box<dyn Device> {
    let settings = LdSettings { seed, ..LdSettings::of(model) };
    Box::new(LdSimulator::new(settings, room(seed)))
}

/// Creates an RPLIDAR, which streams if `streams` is set, and reports the health status `health`.
pub(crate) fn rplidar(model: Model, streams: bool, health: u8, seed: u64) -> Box<dyn Device> {
    let start = if streams { RplidarStart::Streaming } else { RplidarStart::Idle };
    let settings = RplidarSettings { start, health: (health, 1), seed, ..RplidarSettings::of(model) };
    Box::new(RplidarSimulator::new(settings, room(seed)))
}

impl Bench {
    /// Opens a port with a scanner that has been on for a time that depends on `seed`.
    pub(crate) fn new(
        device: Option<Box<dyn Device>>,
        port: PortKind,
        memory: Option<Memory>,
        seed: u64,
    ) -> Bench {
        Bench::with_faults(device, port, memory, "", seed)
    }

    pub(crate) fn with_faults(
        device: Option<Box<dyn Device>>,
        port: PortKind,
        memory: Option<Memory>,
        faults: &str,
        seed: u64,
    ) -> Bench {
        let rate = match port {
            PortKind::Serial => Search::opening_rate(memory),
            PortKind::Server | PortKind::Recording => device.as_ref().map_or(9_600, |device| device.rate()),
        };
        let faults = faults.parse().expect("faults");
        Bench::with_host(|now| Search::new(port, memory, now), device, port, rate, &faults, seed)
    }
}

impl<S: line::ScannerSession> Bench<NamedFamily<S>> {
    /// Opens a serial port for a session of a named family, which `begin` creates. Returns the time until the session
    /// delivers the first telegram or scan.
    pub(crate) fn find_named(begin: impl FnOnce(Nanos) -> S, device: Box<dyn Device>, seed: u64) -> Nanos {
        let mut rate = 0;
        let begin = |now| {
            let session = begin(now);
            rate = session.rate();
            NamedFamily(session)
        };
        let mut bench = Bench::with_host(begin, Some(device), PortKind::Serial, 0, &Faults::default(), seed);
        bench.rate = rate;
        bench.run(bench.now + 20_000 * MILLIS).expect("something arrives");
        bench.now - bench.opened_at
    }
}

impl<H: Host> Bench<H> {
    /// Opens a serial port for a session that searches for the scanner.
    pub(crate) fn with_search(
        begin: impl FnOnce(Nanos) -> H,
        device: Option<Box<dyn Device>>,
        memory: Option<Memory>,
        seed: u64,
    ) -> Bench<H> {
        let rate = Search::opening_rate(memory);
        Bench::with_host(begin, device, PortKind::Serial, rate, &Faults::default(), seed)
    }

    fn with_host(
        begin: impl FnOnce(Nanos) -> H,
        mut device: Option<Box<dyn Device>>,
        port: PortKind,
        rate: u32,
        faults: &Faults,
        seed: u64,
    ) -> Bench<H> {
        let mut random = fastrand::Rng::with_seed(seed);
        let now = 100 * MILLIS + random.u64(..1_000 * MILLIS);
        while device.as_mut().is_some_and(|device| device.poll_transmit(now).is_some()) {}
        Bench {
            host: begin(now),
            device,
            line: LineModel::new(faults, seed),
            power_at: 0,
            is_powered: true,
            opened_at: now,
            now,
            port,
            rate,
            unsupported_rates: Vec::new(),
            to_host: BaudMismatch::default(),
            to_device: BaudMismatch::default(),
            last_sent_at: 0,
            is_flushed: true,
            inbox: VecDeque::new(),
            noise: None,
            random,
            written: Vec::new(),
            read: Vec::new(),
            rates: Vec::new(),
        }
    }

    /// Switches the scanner on when the time `after` has passed since the port was opened.
    pub(crate) fn powered_after(mut self, after: Nanos) -> Self {
        (self.power_at, self.is_powered) = (self.now + after, false);
        self
    }

    /// Adds random bytes to the bytes of the scanner, with the mean time `mean` between two random bytes.
    pub(crate) fn with_noise(mut self, mean: Nanos) -> Self {
        self.noise = Some((self.now, mean));
        self
    }

    /// Runs until the host finds the scanner, or for `span`. Returns the result and the time since the port was opened.
    pub(crate) fn find(&mut self, span: Nanos) -> Option<(H::Result, Nanos)> {
        let end = self.now + span;
        let found = self.run(end).map(|found| (found, self.now - self.opened_at));
        self.check_requests();
        found
    }

    /// Runs until the host has a result, or until `end`.
    pub(crate) fn run(&mut self, end: Nanos) -> Option<H::Result> {
        while self.now < end {
            let until = match self.drain() {
                Ok(until) => until,
                Err(found) => return Some(found),
            };
            while self.inbox.is_empty()
                && let Some(at) = self.next_event().filter(|&at| at <= until.min(end))
            {
                self.advance(at);
            }
            let woken = if self.inbox.is_empty() { until.min(end) } else { self.now };
            let latency = self.random.u64(20 * MICROS..3 * MILLIS);
            self.advance(woken.max(self.now) + latency);
            let spare = self.host.protocol().read_buffer();
            assert!(!spare.is_empty());
            let len = spare.len().min(self.inbox.len());
            for (place, byte) in spare.iter_mut().zip(self.inbox.drain(..len)) {
                *place = byte;
            }
            self.read.push((self.now, spare[..len].to_vec()));
            self.host.commit(self.now, len);
            if len == 0 && self.now >= until {
                self.host.protocol().handle_timeout(self.now);
            }
        }
        None
    }

    fn drain(&mut self) -> Result<Nanos, H::Result> {
        loop {
            match self.host.poll() {
                HostAction::SetRate(rate) if self.unsupported_rates.contains(&rate) => {
                    self.host.protocol().reject_rate(self.now);
                }
                HostAction::SetRate(rate) => {
                    assert_eq!(self.port, PortKind::Serial);
                    self.flush();
                    self.rate = rate;
                    self.inbox.clear();
                    self.read.clear();
                    self.rates.push((self.now, rate));
                }
                HostAction::Transmit(bytes, not_before) => self.transmit(&bytes, not_before),
                HostAction::Wait(until) | HostAction::SleepUntil(until) => {
                    self.flush();
                    return Ok(until);
                }
                HostAction::Done(result) => return Err(result),
            }
        }
    }

    fn transmit(&mut self, bytes: &[u8], not_before: Nanos) {
        self.advance(not_before);
        self.host.protocol().handle_transmitted(self.now);
        for &byte in bytes {
            self.written.push((self.now, self.rate, byte));
            if self.now > self.last_sent_at {
                self.flush();
            }
            self.last_sent_at = self.now.max(self.last_sent_at) + line_time(1, self.rate);
            self.is_flushed = false;
            self.deliver(&[byte], false);
        }
    }

    /// Informs the scanner's receiver that the line is idle, so that it completes a garbled byte.
    fn flush(&mut self) {
        if !std::mem::replace(&mut self.is_flushed, true) {
            self.deliver(&[], true);
        }
    }

    /// Delivers bytes of the host to the scanner, garbled if the rates differ.
    fn deliver(&mut self, bytes: &[u8], is_idle: bool) {
        let Some(device) = self.device.as_mut().filter(|_| self.is_powered) else { return };
        let bytes = match device.rate() {
            rate if rate == self.rate => bytes.to_vec(),
            rate => self.to_device.receive((self.rate, rate), bytes, is_idle),
        };
        for byte in bytes {
            self.line.receive(&mut **device, byte, Arrival::at(self.last_sent_at));
        }
    }

    fn next_event(&self) -> Option<Nanos> {
        let noise = self.noise.map(|(at, _)| at);
        let device = self.device.as_ref().map(|device| match self.is_powered {
            true => self.line.poll_timeout(&**device, self.now),
            false => Some(self.power_at),
        });
        noise.into_iter().chain(device.flatten()).min().map(|at| at.max(self.now))
    }

    fn advance(&mut self, to: Nanos) {
        while let Some(at) = self.next_event().filter(|&at| at <= to) {
            self.now = self.now.max(at);
            if let Some((at, mean)) = self.noise.filter(|(at, _)| *at <= self.now) {
                self.inbox.push_back(self.random.u8(..));
                self.noise = Some((at + self.random.u64(1..=2 * mean), mean));
            }
            let Some(device) = &mut self.device else { continue };
            if !self.is_powered {
                if self.now >= self.power_at {
                    self.is_powered = true;
                    device.power_cycle(self.now);
                }
                continue;
            }
            while let Some(carried) = self.line.poll_transmit(&mut **device, self.now) {
                let bytes = match carried.rate {
                    rate if rate == self.rate => carried.bytes,
                    rate => self.to_host.receive((rate, self.rate), &carried.bytes, carried.idle_after),
                };
                self.inbox.extend(bytes);
            }
        }
        self.now = self.now.max(to);
    }

    /// Checks that the search sent only requests that an unknown scanner may receive, and no request just after the
    /// port was opened.
    fn check_requests(&self) {
        const ALLOWED: [(&[u8], &[u32]); 4] = [
            (&[0x02, 0x00, 0x01, 0x00, 0x3A, 0x1E, 0x12], &[9_600, 19_200, 38_400, 500_000]),
            (&[0x02, 0x00, 0x01, 0x00, 0x31, 0x15, 0x12], &[9_600, 19_200, 38_400, 500_000]),
            (&[0xA5, 0x25], &[115_200, 256_000, 460_800, 1_000_000]),
            (&[0xA5, 0x50], &[115_200, 256_000, 460_800, 1_000_000]),
        ];
        assert!(self.written.iter().all(|(at, ..)| *at >= self.opened_at + 150 * MILLIS));
        let mut rest = &self.written[..];
        while let Some(&(_, rate, _)) = rest.first() {
            let sent: Vec<u8> = rest.iter().map(|(.., byte)| *byte).collect();
            let is_one = |(request, rates): &&(&[u8], &[u32])| {
                let is_at_rate = self.port != PortKind::Serial || rates.contains(&rate);
                is_at_rate && (sent.starts_with(request) || request.starts_with(&sent))
            };
            let request = ALLOWED.iter().find(is_one);
            let (request, _) = request.unwrap_or_else(|| panic!("{sent:02X?} at {rate}"));
            rest = &rest[request.len().min(rest.len())..];
        }
        assert_eq!(self.device.as_ref().map_or(0, |device| device.eeprom_writes()), 0);
    }
}
