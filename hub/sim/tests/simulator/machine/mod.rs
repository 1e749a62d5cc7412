//! Tests of a simulated LMS in virtual time: its replies, the times at which bytes have left the line, the effect of
//! requests on its stream, and the line itself.

mod states;

use proptest::prelude::*;
use scanhub_drivers::lms;
use scanhub_drivers::lms::command::{EEPROM_WRITES, Request};
use scanhub_drivers::lms::measured::MeasuredValues;
use scanhub_drivers::lms::reply::Reply;
use scanhub_drivers::lms::telegram::{ACK, NAK, Telegram, Writer};
use scanhub_drivers::lms::variant::{Baud, MIRROR_PERIOD, Mode, Unit, Variant};
use scanhub_schema::{MICROS, MILLIS, Nanos, line_time};
use scanhub_sim::device::{Chunk, ChunkKind, Device as _, SentTelegram};
use scanhub_sim::fault::{Fault, Faults};
use scanhub_sim::line_model::LineModel;
use scanhub_sim::machine::{LmsSimulator, Settings, StartState};
use scanhub_sim::operating::{OperatingMode, ScanSource};
use scanhub_sim::room::Room;
use scanhub_sim::world::World;
use scanhub_sim::{Arrival, ChunkSize, DroppedRequest};

/// A simulated scanner with its clock, and everything that it has sent.
pub(crate) struct Bench {
    pub(crate) machine: LmsSimulator,
    pub(crate) now: Nanos,
    pub(crate) chunks: Vec<(Nanos, Chunk)>,
}

impl Bench {
    pub(crate) fn new(settings: Settings) -> Bench {
        Bench::with_source(settings, ScanSource::Room(Room::new(&"room".parse().unwrap(), 1)))
    }

    pub(crate) fn with_source(settings: Settings, source: ScanSource) -> Bench {
        Bench { machine: LmsSimulator::new(settings, source), now: 0, chunks: Vec::new() }
    }

    pub(crate) fn run_until(&mut self, end: Nanos) {
        while let Some(at) = self.machine.poll_timeout().filter(|&at| at <= end) {
            self.now = self.now.max(at);
            while let Some(chunk) = self.machine.poll_transmit(self.now) {
                self.chunks.push((self.now, chunk));
            }
        }
        self.now = end;
    }

    /// Sends `bytes` to the scanner. The line is idle for `gap` before each byte.
    pub(crate) fn send(&mut self, bytes: &[u8], gap: Nanos) {
        for &byte in bytes {
            self.run_until(self.now + line_time(1, self.machine.baud().rate()) + gap);
            self.machine.receive(byte, Arrival::at(self.now));
        }
    }

    /// Sends a request with correct timing, and returns the bytes that arrive in the next half second.
    pub(crate) fn ask(&mut self, bytes: &[u8]) -> Vec<u8> {
        let before = self.chunks.len();
        self.send(bytes, 60 * MICROS);
        self.run_until(self.now + 500 * MILLIS);
        self.bytes_from(before)
    }

    pub(crate) fn bytes_from(&self, first: usize) -> Vec<u8> {
        self.chunks[first..].iter().flat_map(|(_, chunk)| chunk.bytes.clone()).collect()
    }

    pub(crate) fn sent(&self) -> Vec<(Nanos, SentTelegram)> {
        let end = |(at, chunk): &(Nanos, Chunk)| match &chunk.part {
            ChunkKind::End(sent) => Some((*at, sent.clone())),
            ChunkKind::Acknowledge | ChunkKind::Telegram => None,
        };
        self.chunks.iter().filter_map(end).collect()
    }
}

/// Decodes the reply in `bytes`, which must be an ACK and one telegram.
pub(crate) fn reply(bytes: &[u8]) -> Reply<'_> {
    assert_eq!(bytes[0], ACK);
    Reply::decode(Telegram::check(&bytes[1..]).expect("a whole telegram")).expect("a reply")
}

pub(crate) fn fast_settings() -> Settings {
    Settings { baud: Baud::B500000, ..Settings::default() }
}

#[test]
fn scanner_starts_at_9600_and_streams_at_500k() {
    let mut bench = Bench::new(Settings::default());
    bench.run_until(5_000 * MILLIS);
    assert!(bench.chunks.is_empty(), "streams unasked");
    let Reply::Status(_) = reply(&bench.ask(Request::Status.encode(0).bytes())) else { panic!("no status") };
    let bytes = bench.ask(Request::Status.encode(0).bytes());
    let Reply::Status(status) = reply(&bytes) else { panic!("no status") };
    assert_eq!((status.operating_mode(), status.mode(), status.unit()), (0x25, Mode(1), Some(Unit::Mm)));
    assert_eq!(status.variant(), Some(Variant::HALF));
    let bytes = bench.ask(Request::Type.encode(0).bytes());
    assert_eq!(reply(&bytes), Reply::Type(b"LMS200;301063;V02.30"));
    let bytes = bench.ask(Request::Configuration.encode(0).bytes());
    let Reply::Configuration(configuration) = reply(&bytes) else { panic!("no configuration") };
    assert_eq!((configuration.mode(), configuration.unit()), (Mode(1), Some(Unit::Mm)));
    let whole_degrees = Variant::new(180, 100).unwrap();
    let bytes = bench.ask(Request::Variant(whole_degrees).encode(0).bytes());
    assert_eq!(reply(&bytes), Reply::Variant { done: true, angle_deg: 180, resolution_cdeg: 100 });

    let first = bench.chunks.len();
    let bytes = bench.ask(Request::Baud(Baud::B500000).encode(0).bytes());
    assert_eq!(reply(&bytes), Reply::Mode { done: true });
    assert!(bench.chunks[first..].iter().all(|(_, chunk)| chunk.rate == 9_600), "not at the old rate");
    assert_eq!(bench.machine.baud(), Baud::B500000);

    let first = bench.sent().len();
    bench.ask(Request::Stream.encode(0).bytes());
    let sent = bench.sent().split_off(first);
    assert!(sent[0].1.is_reply && sent.len() > 20);
    for pair in sent[1..].windows(2) {
        assert_eq!(
            pair[1].0 - pair[0].0,
            MIRROR_PERIOD,
            "181 beams at 500k arrive once per revolution of the mirror"
        );
        assert_eq!(pair[1].1.telegram.len(), 372);
    }
    assert_eq!(bench.machine.eeprom_writes(), 0);
}

#[test]
fn reply_times_are_within_their_limits() {
    for (request, min, max) in
        [(Request::Status, 55 * MILLIS, 160 * MILLIS), (Request::Stop, 55 * MILLIS, 100 * MILLIS)]
    {
        let mut bench = Bench::new(fast_settings());
        bench.send(request.encode(0).bytes(), 60 * MICROS);
        let requested_at = bench.now;
        bench.run_until(requested_at + 3_000 * MILLIS);
        assert_eq!(
            (&bench.chunks[0].1.bytes[..], &bench.chunks[0].1.part),
            (&[ACK][..], &ChunkKind::Acknowledge)
        );
        assert!(bench.chunks[0].0 - requested_at <= 60 * MILLIS);
        let answered = bench.chunks.last().unwrap().0 - requested_at;
        assert!((min..=max).contains(&answered), "{request:?} after {answered} ns");
    }
}

#[test]
fn stream_keeps_its_grid_and_pauses_with_the_mirror() {
    let mut bench = Bench::new(fast_settings());
    bench.ask(Request::Stream.encode(0).bytes());
    bench.run_until(60_000 * MILLIS);
    let sent: Vec<_> = bench.sent().into_iter().filter(|(_, sent)| !sent.is_reply).collect();
    let (first, last) = (sent[0].0, sent[sent.len() - 1].0);
    assert_eq!(last - first, (sent.len() as Nanos - 1) * 2 * MIRROR_PERIOD, "drifts");
    assert!(sent.iter().all(|(_, sent)| !sent.aborted && Telegram::check(&sent.telegram).is_some()));
    // The scanner sends 508 bytes of the last telegram in 10.16 ms, pauses, and sends the rest in the next revolution
    // of the mirror.
    let start = last - MIRROR_PERIOD - line_time(224, 500_000);
    let mut through = 0;
    let mut pauses = 0;
    for (at, chunk) in bench.chunks.iter().filter(|(at, _)| (start..=last).contains(at)) {
        assert!(chunk.bytes.len() <= 16);
        through += chunk.bytes.len();
        if through == 508 {
            assert_eq!((*at - start, chunk.idle_after), (10_160 * MICROS, true));
            pauses += 1;
        }
    }
    assert_eq!((through, pauses), (732, 1));
}

#[test]
fn period_at_each_rate_and_variant_is_as_listed() {
    for baud in Baud::ALL {
        for variant in Variant::ALL {
            let mut bench =
                Bench::new(Settings { baud, variant, chunk: ChunkSize::Usb, ..Settings::default() });
            bench.ask(Request::Stream.encode(0).bytes());
            bench.run_until(10_000 * MILLIS);
            let sent = bench.sent();
            let period = variant.period(sent[1].1.telegram.len(), baud.rate());
            for pair in sent[1..].windows(2) {
                assert_eq!(pair[1].0 - pair[0].0, period, "{baud:?} {variant:?}");
            }
        }
    }
}

#[test]
fn request_aborts_the_scan_then_a_full_one_is_sent() {
    let mut bench = Bench::new(fast_settings());
    bench.ask(Request::Stream.encode(0).bytes());
    // The request arrives while the scanner sends the first 508 bytes of a scan.
    let next = bench.sent().last().unwrap().0 + 2 * MIRROR_PERIOD - 17_800 * MICROS;
    bench.run_until(next + 3 * MILLIS);
    let (before, sent_before) = (bench.chunks.len(), bench.sent().len());
    let bytes = bench.ask(Request::Type.encode(0).bytes());
    let sent = bench.sent().split_off(sent_before);
    assert_eq!((sent[0].1.is_reply, sent[0].1.aborted), (false, true));
    assert_eq!((sent[1].1.is_reply, sent[1].1.aborted), (true, false));
    assert!(sent[2..].iter().all(|(_, sent)| !sent.is_reply && !sent.aborted));
    // The received bytes are the start of the aborted scan, an ACK, the whole reply, and a whole scan.
    let broken = &sent[0].1.telegram;
    let head = bench.chunks[..before].iter().rev().take_while(|(_, chunk)| chunk.part == ChunkKind::Telegram);
    let head: usize = head.map(|(_, chunk)| chunk.bytes.len()).sum();
    let rest = bytes.iter().zip(&broken[head..]).take_while(|(a, b)| a == b).count();
    assert!(head + rest < 300, "{} bytes of it left", head + rest);
    assert_eq!(bytes[rest], ACK);
    let answer = &bytes[rest + 1..][..29];
    assert_eq!(answer, sent[1].1.telegram);
    assert_eq!(bytes[rest + 30..][..732], sent[2].1.telegram);
    // The new scan starts at the start of a revolution of the mirror.
    assert_eq!((sent[2].0 - 17_800 * MICROS) % (2 * MIRROR_PERIOD), 0);
}

#[test]
fn request_between_bursts_also_aborts_the_scan() {
    let mut bench = Bench::new(fast_settings());
    bench.ask(Request::Stream.encode(0).bytes());
    // The scanner has sent 508 bytes, and waits for the next revolution of the mirror with the rest.
    let next = bench.sent().last().unwrap().0 + 2 * MIRROR_PERIOD - 17_800 * MICROS;
    bench.run_until(next + 11 * MILLIS);
    let sent_before = bench.sent().len();
    bench.ask(Request::Type.encode(0).bytes());
    let sent = bench.sent().split_off(sent_before);
    let kinds: Vec<_> = sent.iter().map(|(_, sent)| (sent.is_reply, sent.aborted)).collect();
    assert_eq!(kinds[..3], [(false, true), (true, false), (false, false)]);
}

#[test]
fn stop_ends_stream_and_newer_request_replaces_older() {
    let mut bench = Bench::new(fast_settings());
    bench.ask(Request::Stream.encode(0).bytes());
    bench.ask(Request::Stop.encode(0).bytes());
    let chunks = bench.chunks.len();
    bench.run_until(bench.now + 5_000 * MILLIS);
    assert_eq!(bench.chunks.len(), chunks);
    assert_eq!(bench.machine.poll_timeout(), None);
    let replies = bench.sent().len();
    bench.send(Request::Status.encode(0).bytes(), 60 * MICROS);
    bench.ask(Request::Type.encode(0).bytes());
    let sent = bench.sent().split_off(replies);
    assert_eq!(sent.len(), 1);
    assert_eq!(sent[0].1.telegram[4], 0xBA);
}

#[test]
fn ignores_or_refuses_invalid_requests() {
    let mut bench = Bench::new(Settings { address: 5, ..fast_settings() });
    let status = Request::Status.encode(0);
    bench.send(status.bytes(), 7 * MILLIS);
    bench.run_until(bench.now + 500 * MILLIS);
    assert!(bench.chunks.is_empty(), "a request with long gaps was accepted");
    assert_eq!(bench.machine.take_dropped(), Some(DroppedRequest::LongGap { after: 1 }));
    assert!(bench.ask(Request::Status.encode(4).bytes()).is_empty(), "another address");
    let mut wrong = status.bytes().to_vec();
    wrong[6] ^= 1;
    assert_eq!(bench.ask(&wrong), [NAK]);
    let bytes = bench.ask(Request::Status.encode(5).bytes());
    assert_eq!(Telegram::check(&bytes[1..]).unwrap().address(), 0x85);
    for impossible in [Writer::new(0, 0x20).byte(0x2C).finish(), Writer::new(0, 0x55).finish()] {
        assert_eq!(reply(&bench.ask(impossible.bytes())), Reply::Refused);
    }
    let no_variant = Writer::new(0, 0x3B).word(180).word(25).finish();
    let in_force = Reply::Variant { done: false, angle_deg: 180, resolution_cdeg: 50 };
    assert_eq!(reply(&bench.ask(no_variant.bytes())), in_force);
    let errors = bench.ask(&[0x02, 0, 1, 0, 0x32, 0x16, 0x12]);
    assert_eq!(errors[5], 0xB2);
}

#[test]
fn counts_refused_and_executed_eeprom_writes() {
    let mut bench = Bench::new(fast_settings());
    for (count, command) in EEPROM_WRITES.into_iter().enumerate() {
        assert_eq!(reply(&bench.ask(Writer::new(0, command).byte(0).finish().bytes())), Reply::Refused);
        assert_eq!(bench.machine.eeprom_writes(), count as u64 + 1);
    }
    let wrong = Writer::new(0, 0x20).byte(0).slice(b"SICK_XXX").finish();
    assert_eq!(reply(&bench.ask(wrong.bytes())), Reply::Mode { done: false });
    let installation = Writer::new(0, 0x20).byte(0).slice(b"SICK_LMS").finish();
    assert_eq!(reply(&bench.ask(installation.bytes())), Reply::Mode { done: true });
    let centimetres = Writer::new(0, 0x77).slice(&[0, 0, 0x70, 0, 0, 4, 0]).finish();
    let before = bench.chunks.len();
    bench.ask(centimetres.bytes());
    // A change of the unit takes longer than other requests.
    bench.run_until(bench.now + 1_000 * MILLIS);
    let written = bench.bytes_from(before);
    assert_eq!((written[5], written[6], written.len()), (0xF7, 1, 44));
    let bytes = bench.ask(Request::Configuration.encode(0).bytes());
    let Reply::Configuration(configuration) = reply(&bytes) else { panic!("no configuration") };
    assert_eq!((configuration.mode(), configuration.unit()), (Mode(4), Some(Unit::Cm)));
    assert_eq!(bench.machine.eeprom_writes(), 7);
}

#[test]
fn recording_is_sent_once_despite_host_requests() {
    let telegrams: Vec<Vec<u8>> =
        (0..30u16).map(|i| lms::measured::encode(0, Unit::Cm, &[i; 181], 0x10).bytes().to_vec()).collect();
    let variant = Variant::new(180, 100).unwrap();
    let source = ScanSource::Recorded { variant, telegrams: Box::new(telegrams.clone().into_iter()) };
    let mut bench = Bench::with_source(Settings { variant, ..fast_settings() }, source);
    let bytes = bench.ask(Request::Variant(Variant::HALF).encode(0).bytes());
    assert_eq!(reply(&bytes), Reply::Variant { done: false, angle_deg: 180, resolution_cdeg: 100 });
    bench.send(Request::Stream.encode(0).bytes(), 60 * MICROS);
    bench.run_until(bench.now + 200 * MILLIS);
    bench.ask(Request::Type.encode(0).bytes());
    let data = bench.sent().into_iter().filter(|(_, sent)| !sent.is_reply).map(|(_, sent)| sent.telegram);
    assert_eq!(data.collect::<Vec<_>>(), telegrams);
    assert_eq!(bench.machine.poll_timeout(), None, "the line is silent after the last telegram");
    let bytes = bench.ask(Request::Status.encode(0).bytes());
    assert!(matches!(reply(&bytes), Reply::Status(_)));
}

proptest! {
    /// Without faults, every telegram that the scanner sends arrives intact, for any settings, even if the test polls
    /// the scanner late.
    #[test]
    fn sent_telegrams_without_faults_are_intact(
        seed in any::<u64>(),
        world in 0..World::names().count(),
        variant in 0..Variant::ALL.len(),
        baud in 0..Baud::ALL.len(),
        usb in any::<bool>(),
        steps in proptest::collection::vec(1..40_000_000u64, 20..60),
    ) {
        let settings = Settings {
            baud: Baud::ALL[baud],
            variant: Variant::ALL[variant],
            chunk: if usb { ChunkSize::Usb } else { ChunkSize::Uart },
            seed,
            ..Settings::default()
        };
        let world: World = World::names().nth(world).unwrap().parse().unwrap();
        let mut machine = LmsSimulator::new(settings, ScanSource::Room(Room::new(&world, seed)));
        let mut now = 0;
        for &byte in Request::Stream.encode(0).bytes() {
            now += line_time(1, machine.baud().rate()) + 60 * MICROS;
            machine.receive(byte, Arrival::at(now));
        }
        let mut bytes = Vec::new();
        for step in steps {
            now += step;
            while let Some(chunk) = machine.poll_transmit(now) {
                bytes.extend_from_slice(&chunk.bytes);
                match chunk.part {
                    ChunkKind::Acknowledge => bytes.clear(),
                    ChunkKind::Telegram => {}
                    ChunkKind::End(sent) => {
                        prop_assert!(!sent.aborted);
                        prop_assert_eq!(&bytes, &sent.telegram);
                        let telegram = Telegram::check(&bytes).expect("intact");
                        prop_assert_eq!(MeasuredValues::decode(telegram).is_none(), sent.is_reply);
                        bytes.clear();
                    }
                }
            }
        }
    }
}

/// A telegram that the scanner sent, the bytes that arrived while the scanner sent it, and its fault.
struct TransmittedTelegram {
    telegram: Vec<u8>,
    arrived: Vec<u8>,
    fault: Option<Fault>,
}

/// Returns all telegrams that a scanner sends within `span` over a line with `faults`.
fn transmit(faults: &str, seed: u64, chunk: ChunkSize, span: Nanos) -> Vec<TransmittedTelegram> {
    let settings = Settings {
        baud: Baud::B500000,
        start: StartState::Operating(OperatingMode::All),
        chunk,
        ..Settings::default()
    };
    let mut machine = LmsSimulator::new(settings, ScanSource::Room(Room::new(&World::Random, 1)));
    let mut wire = LineModel::new(&faults.parse::<Faults>().unwrap(), seed);
    let (mut now, mut arrived, mut fault, mut transmitted) = (0, Vec::new(), None, Vec::new());
    while let Some(at) = wire.poll_timeout(&machine, now).filter(|&at| at <= span) {
        assert!(at > now || now == 0, "no progress at {at}");
        now = at;
        while let Some(carried) = wire.poll_transmit(&mut machine, now) {
            fault = fault.or(carried.fault);
            arrived.extend(carried.bytes);
            if let Some(ChunkKind::End(sent)) = carried.part {
                let (arrived, fault) = (std::mem::take(&mut arrived), fault.take());
                transmitted.push(TransmittedTelegram { telegram: sent.telegram, arrived, fault });
            }
        }
    }
    transmitted
}

fn contains(bytes: &[u8], part: &[u8]) -> bool {
    bytes.windows(part.len()).any(|window| window == part)
}

#[test]
fn truth_has_a_fault_for_each_damaged_telegram() {
    for (faults, named) in [
        ("", None),
        ("loss=0.001,burst=2", Some(Fault::Loss)),
        ("flip=0.001,flip_bits=4", Some(Fault::Flip)),
        ("insert=0.001,insert_burst=4", Some(Fault::Insert)),
        ("double=0.001", Some(Fault::Double)),
        ("truncate=0.3", Some(Fault::Truncated)),
        ("length=0.3", Some(Fault::Length)),
        ("abort=0.3", Some(Fault::Aborted)),
        ("flood=100,flood_every=0.05", Some(Fault::Flood)),
        ("wall=100,wall_every=0.05", Some(Fault::Wall)),
        ("silence=0.03,silence_every=0.2", Some(Fault::Silence)),
        ("unplug=0.03,unplug_every=0.2", Some(Fault::Unplug)),
        ("power_at=0.51", Some(Fault::Power)),
        ("stall=0.3,stall_every=1,delay=0.01", None),
        ("flood=100,flood_every=0.01,wall=50,wall_every=0.01,inside=0", None),
    ] {
        let transmitted = transmit(faults, 3, ChunkSize::Uart, 5_000 * MILLIS);
        let mut damaged = 0;
        for TransmittedTelegram { telegram, arrived, fault } in &transmitted {
            assert_eq!(fault.is_none(), contains(arrived, telegram), "{faults}: {fault:?}");
            assert!(fault.is_none() || *fault == named, "{faults}: {fault:?}");
            damaged += usize::from(fault.is_some());
        }
        assert_eq!(damaged > 0, named.is_some(), "{faults}");
        assert!(transmitted.len() - damaged > 10, "{faults}: {damaged} of {}", transmitted.len());
    }
}

#[test]
fn damage_depends_on_seed_and_not_on_chunk_size() {
    let faults =
        "loss=0.001,burst=2,flip=0.0005,flip_bits=3,insert=0.0005,double=0.0005,truncate=0.1,length=0.1";
    let cut = |chunk, seed| -> Vec<(Vec<u8>, Option<Fault>)> {
        let transmitted = transmit(faults, seed, chunk, 3_000 * MILLIS);
        transmitted.into_iter().map(|sent| (sent.arrived, sent.fault)).collect()
    };
    let (uart, usb) = (cut(ChunkSize::Uart, 7), cut(ChunkSize::Usb, 7));
    assert!(uart.len() > 100 && uart == usb);
    assert!(uart != cut(ChunkSize::Uart, 8));
}

#[test]
fn repeated_telegram_has_a_separate_truth_record() {
    let transmitted = transmit("repeat=0.5", 3, ChunkSize::Uart, 3_000 * MILLIS);
    let repeated = transmitted.windows(2).filter(|pair| pair[0].telegram == pair[1].telegram).count();
    assert!((30..80).contains(&repeated), "{repeated} of {}", transmitted.len());
    assert!(transmitted.iter().all(|sent| sent.fault.is_none() && sent.arrived == sent.telegram));
}

#[test]
fn stalled_telegrams_arrive_late_but_in_order() {
    let transmitted = transmit("stall=0.5,stall_at=1", 3, ChunkSize::Uart, 3_000 * MILLIS);
    let smooth = transmit("", 3, ChunkSize::Uart, 3_000 * MILLIS);
    assert_eq!(transmitted.len(), smooth.len());
    assert!(transmitted.iter().zip(&smooth).all(|(late, smooth)| late.arrived == smooth.telegram));
}
