//! Tests of requests for the identity of a simulated scanner, in virtual time. The probe finds a scanner at any rate
//! and in any mode, and leaves the scanner in the state in which it was. Some tests have a line that loses bytes, a
//! scanner that overlooks requests, or no scanner.

mod change;
mod random;

use std::collections::VecDeque;

use scanhub_drivers::line::{Action, Protocol};
use scanhub_drivers::lms::IdentityProbe;
use scanhub_drivers::lms::command::Request;
use scanhub_drivers::lms::telegram::{EncodedTelegram, FRAME_LEN, Writer};
use scanhub_drivers::lms::variant::{Baud, Mode, Unit};
use scanhub_schema::{MICROS, MILLIS, Nanos, line_time};
use scanhub_sim::Arrival;
use scanhub_sim::device::{ChunkKind, Device as _};
use scanhub_sim::fault::Faults;
use scanhub_sim::line_model::{BaudMismatch, Delivery, LineModel};
use scanhub_sim::machine::{LmsSimulator, ProtocolQuirks, Settings, StartState};
use scanhub_sim::operating::{OperatingMode, ScanSource};
use scanhub_sim::room::Room;

/// Changes bytes on the line: returns the bytes that arrive if the given bytes are sent.
pub(crate) type ByteFilter = Box<dyn FnMut(Vec<u8>) -> Vec<u8>>;

/// A host that runs a protocol, a scanner, and the line between them.
pub(crate) struct Bench<C> {
    pub(crate) protocol: C,
    pub(crate) machine: LmsSimulator,
    pub(crate) now: Nanos,
    /// Faults of the line.
    pub(crate) line: LineModel,
    pub(crate) to_host: ByteFilter,
    pub(crate) to_scanner: ByteFilter,
    /// Telegrams that the host sent.
    pub(crate) sent_requests: Vec<Vec<u8>>,
    port: Baud,
    inbox: VecDeque<u8>,
    baud_mismatch: BaudMismatch,
    request: Vec<u8>,
    last: Nanos,
}

/// Creates a scanner in a room. Its line has the rate `baud`.
pub(crate) fn sensor(baud: Baud) -> LmsSimulator {
    machine(Settings { baud, seed: 1, ..Settings::default() })
}

/// Creates a scanner in a room.
pub(crate) fn machine(settings: Settings) -> LmsSimulator {
    LmsSimulator::new(settings, ScanSource::Room(Room::new(&"room".parse().unwrap(), 1)))
}

/// Sends `request` to `machine`, as a previous host. Returns the time on the machine's clock afterwards.
pub(crate) fn send(machine: &mut LmsSimulator, request: &EncodedTelegram) -> Nanos {
    let mut now = 10 * MILLIS;
    for &byte in request.bytes() {
        now += line_time(1, machine.baud().rate()) + 60 * MICROS;
        machine.receive(byte, Arrival::at(now));
    }
    now += 2_000 * MILLIS;
    while machine.poll_transmit(now).is_some() {}
    now
}

/// Makes `machine` stream. Returns the time on the machine's clock afterwards.
pub(crate) fn make_stream(machine: &mut LmsSimulator) -> Nanos {
    send(machine, &Request::Stream.encode(0))
}

impl<C: Protocol> Bench<C> {
    /// Creates a bench at a port with the rate `port`. The bench starts at the time `now` of the machine's clock.
    pub(crate) fn new(protocol: C, port: Baud, machine: LmsSimulator, now: Nanos) -> Self {
        Bench {
            protocol,
            machine,
            now,
            line: LineModel::new(&Faults::default(), 0),
            to_host: Box::new(|bytes| bytes),
            to_scanner: Box::new(|bytes| bytes),
            sent_requests: Vec::new(),
            port,
            inbox: VecDeque::new(),
            baud_mismatch: BaudMismatch::default(),
            request: Vec::new(),
            last: now,
        }
    }

    /// Runs until the protocol is complete, which must happen within `span`. Returns the duration.
    pub(crate) fn finish(&mut self, span: Nanos) -> Nanos {
        let started = self.now;
        while let Some(until) = self.drain() {
            assert!(self.now < started + span, "not complete within {} ms", span / MILLIS);
            self.wait(until);
            let spare = self.protocol.read_buffer();
            let len = spare.len().min(self.inbox.len());
            for (place, byte) in spare.iter_mut().zip(self.inbox.drain(..len)) {
                *place = byte;
            }
            self.protocol.commit(self.now, len);
            if len == 0 && self.now >= until {
                self.protocol.handle_timeout(self.now);
            }
        }
        self.now - started
    }

    /// Returns the telegrams that end within `span`, while the host sends no request.
    pub(crate) fn collect_telegrams(&mut self, span: Nanos) -> Vec<Vec<u8>> {
        let mut sent = Vec::new();
        let end = self.now + span;
        while let Some(at) = self.line.poll_timeout(&self.machine, self.now).filter(|&at| at <= end) {
            self.now = self.now.max(at);
            while let Some(carried) = self.line.poll_transmit(&mut self.machine, self.now) {
                if let Some(ChunkKind::End(whole)) = carried.part {
                    sent.push(whole.telegram);
                }
            }
        }
        self.now = end;
        sent
    }

    fn drain(&mut self) -> Option<Nanos> {
        loop {
            match self.protocol.poll_action() {
                Action::SetRate(rate) => {
                    self.port = Baud::of_rate(rate).expect("a rate of an LMS");
                    self.inbox.clear();
                }
                Action::Transmit { bytes, not_before } => {
                    let &[byte] = bytes else { panic!("no gaps between {bytes:?}") };
                    self.transmit(byte, not_before);
                }
                Action::Wait { until } => return (!self.protocol.is_done()).then_some(until),
                output => panic!("{output:?}"),
            }
        }
    }

    fn wait(&mut self, until: Nanos) {
        while self.inbox.is_empty() {
            match self.line.poll_timeout(&self.machine, self.now) {
                Some(at) if at <= until => self.advance(at),
                _ => return self.advance(until.max(self.now) + WAKE_DELAY),
            }
        }
        self.advance(self.now + WAKE_DELAY);
    }

    fn transmit(&mut self, byte: u8, not_before: Nanos) {
        self.advance(not_before);
        let byte_ns = line_time(1, self.port.rate());
        if !self.request.is_empty() {
            let gap = self.now - self.last - byte_ns;
            assert!((55 * MICROS..=6 * MILLIS).contains(&gap), "{gap} ns between two bytes of a request");
        }
        self.last = self.now;
        self.request.push(byte);
        if let [_, _, low, high, ..] = self.request[..]
            && self.request.len() == usize::from(u16::from_le_bytes([low, high])) + FRAME_LEN
        {
            self.sent_requests.push(std::mem::take(&mut self.request));
        }
        self.protocol.handle_transmitted(self.now);
        self.advance(self.now + byte_ns);
        for byte in (self.to_scanner)(vec![byte]) {
            if self.machine.baud() == self.port {
                self.line.receive(&mut self.machine, byte, Arrival::at(self.now));
            }
        }
    }

    fn advance(&mut self, to: Nanos) {
        while let Some(at) = self.line.poll_timeout(&self.machine, self.now).filter(|&at| at <= to) {
            self.now = self.now.max(at);
            while let Some(carried) = self.line.poll_transmit(&mut self.machine, self.now) {
                self.carry(carried);
            }
        }
        self.now = self.now.max(to);
    }

    fn carry(&mut self, carried: Delivery) {
        let Delivery { bytes, rate, idle_after, .. } = carried;
        let mut bytes = (self.to_host)(bytes);
        if rate != self.port.rate() {
            bytes = self.baud_mismatch.receive((rate, self.port.rate()), &bytes, idle_after);
        }
        self.inbox.extend(bytes);
    }
}

/// Time from an event, such as the arrival of bytes, until the host runs.
const WAKE_DELAY: Nanos = 50 * MICROS;

/// Returns the request 20h 00h with the factory password.
fn installation_request() -> EncodedTelegram {
    Writer::new(0, 0x20).byte(0).slice(b"SICK_LMS").finish()
}

#[test]
fn identifies_scanner_at_each_rate_and_in_each_mode() {
    for first in Baud::ALL {
        for baud in Baud::ALL {
            for (word, mode) in [("idle", 0x25), ("streaming", 0x24), ("installation mode", 0x00)] {
                let mut machine = sensor(baud);
                let now = match mode {
                    0x24 => make_stream(&mut machine),
                    0x00 => send(&mut machine, &installation_request()),
                    _ => 0,
                };
                let mut bench = Bench::new(IdentityProbe::new(first, now), first, machine, now);
                let elapsed = bench.finish(5_000 * MILLIS);
                let report = bench.protocol.report();
                let status =
                    report.status().unwrap_or_else(|| panic!("{first:?} {baud:?} {word}: {report:?}"));
                assert_eq!((report.baud, status.operating_mode()), (Some(baud), mode), "{word}");
                assert_eq!((report.address, report.status_byte), (Some(0), Some(0x10)));
                assert_eq!(report.kind(), Some(&b"LMS200;301063;V02.30"[..]));
                let configuration = report.configuration().expect("was requested");
                assert_eq!((configuration.mode(), configuration.unit()), (Mode(1), Some(Unit::Mm)));
                println!("port at {first:?}, {word} at {baud:?}: {} ms", elapsed / MILLIS);
                // The scanner is in the same state as before the probe.
                assert_eq!((bench.machine.baud(), bench.machine.eeprom_writes()), (baud, 0));
                let scans = bench.collect_telegrams(2_000 * MILLIS);
                assert_eq!(scans.is_empty(), mode != 0x24, "{word}");
            }
        }
    }
}

#[test]
fn sends_only_requests_that_change_nothing() {
    for baud in Baud::ALL {
        let mut bench = Bench::new(IdentityProbe::new(Baud::B500000, 0), Baud::B500000, sensor(baud), 0);
        bench.finish(5_000 * MILLIS);
        for telegram in &bench.sent_requests {
            assert!([0x31, 0x32, 0x35, 0x3A, 0x74].contains(&telegram[4]), "{telegram:02X?}");
        }
    }
}

#[test]
fn probe_keeps_every_operating_mode() {
    for operating in [
        OperatingMode::All,
        OperatingMode::Partial,
        OperatingMode::Means(3),
        OperatingMode::Range(10, 90),
        OperatingMode::Fields(1, 50),
        OperatingMode::Reflectivity(vec![(1, 40), (60, 80)]),
        OperatingMode::Installation,
    ] {
        for baud in Baud::ALL {
            let start = StartState::Operating(operating.clone());
            let settings = Settings { baud, start, seed: 4, ..Settings::default() };
            let mut bench =
                Bench::new(IdentityProbe::new(Baud::B500000, 0), Baud::B500000, machine(settings), 0);
            bench.finish(20_000 * MILLIS);
            let report = bench.protocol.report();
            let mode = report.status().map(|status| status.operating_mode());
            assert_eq!((report.baud, mode), (Some(baud), Some(operating.code())), "{operating:?}");
            assert_eq!((report.kind().is_some(), report.errors().is_some()), (true, true), "{operating:?}");
            assert_eq!(*bench.machine.operating(), operating);
            let is_silent = operating == OperatingMode::Installation;
            assert_eq!(
                bench.collect_telegrams(3_000 * MILLIS).is_empty(),
                is_silent,
                "{operating:?} {baud:?}"
            );
        }
    }
}

#[test]
fn reports_faults_and_settings_of_a_used_scanner() {
    let settings = Settings {
        baud: Baud::B38400,
        permanent_baud: Some(Baud::B38400),
        type_name: "LMS291;S05123;V02.10 ".into(),
        errors: vec![(0x84, 22), (2, 18)],
        status: 0x92,
        configuration_len: 32,
        ..Settings::default()
    };
    let mut bench = Bench::new(IdentityProbe::new(Baud::B9600, 0), Baud::B9600, machine(settings), 0);
    bench.finish(20_000 * MILLIS);
    let report = bench.protocol.report();
    assert_eq!(report.status().map(|status| status.has_permanent_baud()), Some(true));
    assert_eq!(report.configuration().map(|configuration| configuration.bytes().len()), Some(32));
    assert_eq!(report.status_byte, Some(0x92));
    let faults: Vec<_> = report.errors().expect("was requested").iter().map(|fault| fault.number).collect();
    assert_eq!(faults, [22, 18]);
    assert!(report.reply(Request::Counters).is_some(), "an LMS 291 counts its hours");
}

#[test]
fn scanner_address_is_read_and_used() {
    let settings = Settings { address: 5, baud: Baud::B19200, ..Settings::default() };
    let mut bench = Bench::new(IdentityProbe::new(Baud::B9600, 0), Baud::B9600, machine(settings), 0);
    bench.finish(5_000 * MILLIS);
    assert_eq!(bench.protocol.report().address, Some(5));
    assert_eq!(bench.sent_requests.last().map(|telegram| telegram[1]), Some(5));
}

#[test]
fn probe_keeps_a_fixed_rate() {
    let mut bench =
        Bench::new(IdentityProbe::at_fixed_rate(Baud::B38400, 0), Baud::B38400, sensor(Baud::B38400), 0);
    bench.finish(5_000 * MILLIS);
    assert!(bench.protocol.report().status().is_some());
    let mut bench =
        Bench::new(IdentityProbe::at_fixed_rate(Baud::B38400, 0), Baud::B38400, sensor(Baud::B9600), 0);
    bench.finish(5_000 * MILLIS);
    assert!(!bench.protocol.report().has_replied());
    assert_eq!(bench.protocol.baud(), Baud::B38400);
}

#[test]
fn report_has_replies_only_to_sent_requests() {
    let mut bench = Bench::new(IdentityProbe::new(Baud::B9600, 0), Baud::B9600, sensor(Baud::B9600), 0);
    bench.finish(5_000 * MILLIS);
    let report = bench.protocol.report();
    assert!(report.reply(Request::Type).is_some());
    assert_eq!(report.reply(Request::Stop), None);
}

#[test]
fn lossy_line_never_leads_to_a_wrong_report() {
    let mut found = 0;
    for seed in 0..60 {
        let baud = Baud::ALL[seed as usize % 4];
        let mut machine = sensor(baud);
        let now = if seed % 2 == 0 { make_stream(&mut machine) } else { 0 };
        let mut bench = Bench::new(IdentityProbe::new(Baud::B500000, now), Baud::B500000, machine, now);
        let mut random = fastrand::Rng::with_seed(seed);
        bench.to_host = Box::new(move |bytes| bytes.into_iter().filter(|_| random.f64() > 0.002).collect());
        bench.finish(20_000 * MILLIS);
        let report = bench.protocol.report();
        if let Some(status) = report.status() {
            found += 1;
            assert_eq!(
                (report.baud, status.operating_mode()),
                (Some(baud), if now > 0 { 0x24 } else { 0x25 })
            );
        }
        if let Some(kind) = report.kind() {
            assert_eq!(kind, b"LMS200;301063;V02.30");
        }
        let (tally, open) = bench.protocol.byte_counters();
        assert_eq!(tally.read, tally.in_telegrams + tally.acknowledge + tally.discarded + open as u64);
    }
    assert!(found >= 57, "{found} of 60 found");
}

#[test]
fn repeats_an_overlooked_request() {
    let mut found = 0;
    for seed in 0..40 {
        let baud = Baud::ALL[seed as usize % 4];
        let mut machine = sensor(baud);
        let now = make_stream(&mut machine);
        let mut bench = Bench::new(IdentityProbe::new(Baud::B500000, now), Baud::B500000, machine, now);
        // Lose the first byte of some requests, which makes them invalid.
        let mut random = fastrand::Rng::with_seed(seed);
        bench.to_scanner =
            Box::new(move |bytes| if bytes[0] == 0x02 && random.f64() < 0.3 { Vec::new() } else { bytes });
        bench.finish(20_000 * MILLIS);
        found += usize::from(bench.protocol.report().baud == Some(baud));
    }
    assert!(found >= 38, "{found} of 40 found");
}

#[test]
fn probe_handles_late_repeated_and_refused_replies() {
    for (word, quirks) in [
        ("late", ProtocolQuirks { late_reply_ns: 250 * MILLIS, ..ProtocolQuirks::default() }),
        ("late ACK", ProtocolQuirks { late_acknowledge_ns: 120 * MILLIS, ..ProtocolQuirks::default() }),
        ("doubled", ProtocolQuirks { doubled_share: 1.0, ..ProtocolQuirks::default() }),
        ("NAK", ProtocolQuirks { nak_share: 0.3, ..ProtocolQuirks::default() }),
        ("refused", ProtocolQuirks { refused_commands: vec![0x3A, 0x32], ..ProtocolQuirks::default() }),
    ] {
        for baud in Baud::ALL {
            let mut machine = sensor(baud);
            machine.set_quirks(quirks.clone());
            let mut bench = Bench::new(IdentityProbe::new(Baud::B500000, 0), Baud::B500000, machine, 0);
            bench.finish(20_000 * MILLIS);
            let report = bench.protocol.report();
            assert_eq!(report.baud, Some(baud), "{word}");
            assert!(report.status().is_some() && report.configuration().is_some(), "{word}, {baud:?}");
            assert_eq!(report.kind().is_some(), word != "refused", "{word}, {baud:?}");
        }
    }
}

#[test]
fn reports_silence_within_5_s() {
    let mut bench = Bench::new(IdentityProbe::new(Baud::B500000, 0), Baud::B500000, sensor(Baud::B9600), 0);
    bench.to_host = Box::new(|_| Vec::new());
    let elapsed = bench.finish(10_000 * MILLIS);
    let report = bench.protocol.report();
    assert_eq!((report.baud, report.has_replied(), report.streams), (None, false, false));
    println!("silence: {} ms", elapsed / MILLIS);
    assert!(elapsed < 5_000 * MILLIS, "{elapsed} ns");
}

#[test]
fn reports_rate_of_a_stream_that_ignores_requests() {
    for baud in Baud::ALL {
        let mut machine = sensor(baud);
        let now = make_stream(&mut machine);
        let mut bench = Bench::new(IdentityProbe::new(baud, now), baud, machine, now);
        bench.to_scanner = Box::new(|_| Vec::new());
        let elapsed = bench.finish(20_000 * MILLIS);
        let report = bench.protocol.report();
        assert_eq!(
            (report.baud, report.has_replied(), report.streams),
            (Some(baud), false, true),
            "{elapsed}"
        );
    }
}
