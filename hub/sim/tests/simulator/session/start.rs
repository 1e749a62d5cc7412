//! Tests of the start of a session, from the first request to the stream. At the start, the scanner is idle at some
//! rate, streams already, streams in another mode, or is in installation mode. The line may have a fixed rate.

use scanhub_drivers::line::{Control, ScannerSession as _, State};
use scanhub_drivers::lms;
use scanhub_drivers::lms::command::Request;
use scanhub_drivers::lms::variant::{Baud, Mode, Unit, Variant};
use scanhub_drivers::lms::{Notice, Problem};
use scanhub_schema::{MICROS, MILLIS, Nanos};
use scanhub_sim::device::Device as _;
use scanhub_sim::machine::{LmsSimulator, ProtocolQuirks, Settings, StartState};
use scanhub_sim::operating::OperatingMode;

use super::{Bench, SESSION_SETTINGS, make_stream, sensor, sensor_with};

#[test]
fn streams_from_each_rate_within_3_s() {
    for baud in Baud::ALL {
        let mut bench = Bench::new(sensor(baud), 0);
        bench.run_until("streaming", 3_000 * MILLIS, Bench::is_streaming);
        let since = bench.now;
        bench.run(1_000 * MILLIS);
        assert!(bench.is_streaming() && bench.session.baud() == Baud::B500000, "{bench}");
        let known = bench.session.sensor();
        assert_eq!(
            (known.mode, known.unit, known.variant),
            (Some(Mode(1)), Some(Unit::Mm), Some(Variant::HALF))
        );
        assert_eq!((known.kind(), known.address), (&b"LMS200;301063;V02.30"[..], Some(0x80)));
        assert_eq!((bench.session.problem(), bench.session.stats().resyncs), (None, 0));
        let scans = bench.received_scans(since);
        assert!(scans.len() >= 36 && scans == bench.intact_scans(since)[..scans.len()], "{bench}");
        // The session changes the rate only if it is not the configured rate.
        assert_eq!(bench.states.contains(&State::Switching), baud != Baud::B500000, "{bench}");
        // A request during the stream would abort a scan. The session sends none after all replies have arrived.
        let aborted = bench.sent.iter().filter(|sent| sent.aborted).count();
        assert_eq!(aborted, 0, "{bench}");
    }
}

#[test]
fn sets_the_configured_variant() {
    let settings = Settings { variant: Variant::ALL[4], baud: Baud::B38400, ..Settings::default() };
    let room = scanhub_sim::room::Room::new(&scanhub_sim::world::World::Random, 3);
    let machine =
        scanhub_sim::machine::LmsSimulator::new(settings, scanhub_sim::operating::ScanSource::Room(room));
    let mut bench = Bench::new(machine, 0);
    bench.run_until("streaming", 3_000 * MILLIS, Bench::is_streaming);
    bench.run(500 * MILLIS);
    assert_eq!(bench.session.sensor().variant, Some(Variant::HALF));
    assert!(bench.received_scans(0).iter().all(|scan| scan.len() == 732), "{bench}");
}

#[test]
fn reports_missing_scanner_and_keeps_searching() {
    // The scanner is switched on at different times in two rounds of the search and in the pauses after them.
    for moment in 0..60 {
        let mut bench = Bench::new(sensor(Baud::B9600), 0);
        bench.to_scanner = Box::new(|_, _| None);
        bench.run_until("reported", 3_000 * MILLIS, |bench| {
            matches!(bench.session.problem(), Some(lms::Problem::NoReply { .. }))
        });
        bench.run((10_000 + 100 * moment) * MILLIS);
        assert_eq!(bench.states, [State::Probing]);
        bench.to_scanner = Box::new(|_, byte| Some(byte));
        bench.run_until("streaming", 4_000 * MILLIS, Bench::is_streaming);
        assert_eq!(bench.session.problem(), None);
    }
}

/// Returns settings of a scanner that replies 60 ms after its ACK, like the faster half of captured replies.
fn fast_settings(baud: Baud, start: StartState) -> Settings {
    let quirks = ProtocolQuirks { reply_delay_ns: 60 * MILLIS, ..ProtocolQuirks::default() };
    Settings { baud, start, quirks, ..Settings::default() }
}

#[test]
fn scanner_just_powered_on_streams_within_500_ms() {
    // The rate of the scanner is unknown, or saved from the previous session.
    for (seed, first, within) in (0..20).flat_map(|seed| [(seed, None, 500), (seed, Some(Baud::B9600), 500)])
    {
        let settings =
            Settings { seed, ..fast_settings(Baud::B9600, StartState::Operating(OperatingMode::OnRequest)) };
        let mut bench = Bench::new(sensor_with(settings), 0);
        first.into_iter().for_each(|baud| bench.set_first_probe_rate(baud));
        let elapsed = bench.run_until("a scan", within * MILLIS, |bench| !bench.received_scans(0).is_empty());
        assert_eq!(bench.discovered_rate(), Some(Baud::B9600));
        assert!(bench.received.last().is_some_and(|got| got.range_bits == Some(13)), "{elapsed}: {bench}");
        let known = bench.session.sensor();
        assert_eq!((known.kind(), known.unit), (&b"LMS200;301063;V02.30"[..], Some(Unit::Mm)));
        // At 9600, the session sends only requests with short replies: for the type, and to change the rate.
        let replies: Vec<u8> =
            bench.sent.iter().filter(|sent| sent.is_reply).map(|sent| sent.telegram[4]).collect();
        assert_eq!(replies, [0xBA, 0xA0, 0xB1, 0xA0], "{bench}");
    }
}

#[test]
fn starts_without_type_status_or_configuration() {
    for baud in Baud::ALL {
        for start in [OperatingMode::OnRequest, OperatingMode::All, OperatingMode::Installation] {
            for refused in [0x3A, 0x31, 0x74] {
                let settings = fast_settings(baud, StartState::Operating(start.clone()));
                let quirks = ProtocolQuirks { refused_commands: vec![refused], ..settings.quirks.clone() };
                let mut bench = Bench::new(sensor_with(Settings { quirks, ..settings }), 0);
                bench.run_until("streaming", 4_000 * MILLIS, Bench::is_streaming);
                bench.run(1_500 * MILLIS);
                assert!(bench.is_streaming() && bench.session.problem().is_none(), "{refused:02x}: {bench}");
                assert_eq!(bench.session.sensor().mode, Some(Mode(1)), "{refused:02x}: {bench}");
            }
        }
    }
}

#[test]
fn saved_rate_is_tried_first_but_not_assumed() {
    for first in Baud::ALL {
        for baud in Baud::ALL {
            let mut bench = Bench::new(
                sensor_with(fast_settings(baud, StartState::Operating(OperatingMode::OnRequest))),
                0,
            );
            bench.set_first_probe_rate(first);
            let elapsed = bench.run_until("streaming", 1_500 * MILLIS, Bench::is_streaming);
            assert!(first != baud || elapsed < 500 * MILLIS, "{first:?}: {elapsed}");
            assert_eq!((bench.discovered_rate(), bench.session.problem()), (Some(baud), None));
            let mut machine = sensor(baud);
            let now = make_stream(&mut machine);
            let mut bench = Bench::new(machine, now);
            bench.set_first_probe_rate(first);
            // A session receives a stream at the configured rate before it sends its first request.
            let within = if baud == Baud::B500000 { 60 } else { 4_000 };
            bench.run_until("streaming", within * MILLIS, Bench::is_streaming);
            assert_eq!(bench.discovered_rate().is_none(), baud == Baud::B500000);
        }
    }
}

/// The scanner does not reply at all to a request for its type, although even a refusal would show its rate. The
/// session therefore also requests the status at every rate.
#[test]
fn finds_scanner_by_status_if_type_is_unanswered() {
    for baud in Baud::ALL {
        let mut bench =
            Bench::new(sensor_with(fast_settings(baud, StartState::Operating(OperatingMode::OnRequest))), 0);
        let mut sent = Vec::new();
        // The line loses the command byte of every request for the type.
        bench.to_scanner = Box::new(move |_, byte| {
            sent.push(byte);
            (!sent.ends_with(&[0x02, 0x00, 0x01, 0x00, 0x3A])).then_some(byte)
        });
        bench.run_until("streaming", 6_000 * MILLIS, Bench::is_streaming);
        bench.run(1_000 * MILLIS);
        assert!(bench.is_streaming() && bench.session.problem().is_none(), "{baud:?}: {bench}");
    }
}

/// The scanner refuses a change of rate in its current operating mode, which the session does not know. The session
/// therefore stops the scanner before it changes the rate.
#[test]
fn scanner_that_refuses_a_rate_is_stopped_first() {
    for baud in [Baud::B9600, Baud::B19200, Baud::B38400] {
        let settings = fast_settings(baud, StartState::Operating(OperatingMode::Installation));
        let willing = settings.quirks.clone();
        let quirks = ProtocolQuirks { refused_commands: vec![0x20], ..willing.clone() };
        let mut bench = Bench::new(sensor_with(Settings { quirks, ..settings }), 0);
        bench.run_until("refused", 2_000 * MILLIS, |bench| {
            bench.received.iter().any(|got| got.telegram[4] == lms::reply::REFUSED)
        });
        bench.machine.set_quirks(willing);
        bench.run_until("streaming", 2_000 * MILLIS, Bench::is_streaming);
        bench.run(500 * MILLIS);
        assert!(bench.is_streaming() && bench.session.problem().is_none(), "{bench}");
        // If a scanner always refuses the request, the session reports the refusal and repeats the request.
        let quirks = ProtocolQuirks { refused_commands: vec![0x20], ..ProtocolQuirks::default() };
        let settings = fast_settings(baud, StartState::Operating(OperatingMode::OnRequest));
        let mut bench = Bench::new(sensor_with(Settings { quirks, ..settings }), 0);
        bench.run_until("reported", 4_000 * MILLIS, |bench| {
            matches!(bench.session.problem(), Some(lms::Problem::Refused(_)))
        });
        bench.run(5_000 * MILLIS);
        bench.machine.set_quirks(ProtocolQuirks::default());
        bench.run_until("streaming", 4_000 * MILLIS, Bench::is_streaming);
        assert_eq!(bench.session.problem(), None);
    }
}

#[test]
fn takes_over_stream_at_target_rate_without_requests() {
    // Start the session at different times within the period of a scan.
    for phase in 0..28 {
        let mut machine = sensor(Baud::B500000);
        let started = make_stream(&mut machine) + phase * 970 * MICROS;
        let mut bench = Bench::new(machine, started);
        bench.run_until("streaming", 60 * MILLIS, Bench::is_streaming);
        bench.run(2_000 * MILLIS);
        assert!(
            bench.sent_bytes.iter().all(|(at, _)| *at >= bench.received[0].at),
            "sent a byte before it received one"
        );
        assert_eq!(bench.states, [State::Probing, State::Streaming], "{bench}");
        // Only two requests abort a scan: the requests for the measuring mode and for the type.
        let aborted = bench.sent.iter().filter(|sent| sent.aborted).count();
        assert!(aborted <= 2, "{aborted} scans were aborted");
        assert!(bench.session.sensor().mode.is_some() && !bench.session.sensor().kind().is_empty());
        // The session delivers all scans except the one that was on the line at its start.
        let (scans, intact) = (bench.received_scans(0), bench.intact_scans(started));
        let skipped = intact.iter().position(|scan| scans.first() == Some(scan)).expect("was sent");
        assert_eq!(scans, intact[skipped..][..scans.len()], "{bench}");
        assert!(skipped <= 1 && intact.len() - skipped - scans.len() <= 1, "{bench}");
        assert_eq!(bench.session.stats().first_frame_truncated, skipped == 1, "{bench}");
    }
}

#[test]
fn finds_streams_at_other_rates_and_changes_the_rate() {
    for baud in [Baud::B9600, Baud::B19200, Baud::B38400] {
        for phase in 0..30 {
            let mut machine = sensor(baud);
            let started = make_stream(&mut machine) + phase * 27 * MILLIS;
            let mut bench = Bench::new(machine, started);
            let elapsed = bench.run_until("streaming", 4_000 * MILLIS, Bench::is_streaming);
            bench.run(500 * MILLIS);
            assert_eq!((bench.session.baud(), bench.machine.baud()), (Baud::B500000, Baud::B500000));
            assert!(bench.is_streaming() && bench.received_scans(0).len() > 15, "{elapsed} ns: {bench}");
            assert_eq!(bench.session.problem(), None);
        }
    }
}

#[test]
fn telegrams_at_another_rate_give_no_scans() {
    let mut machine = sensor(Baud::B9600);
    let started = make_stream(&mut machine);
    let mut bench = Bench::new(machine, started);
    bench.set_first_probe_rate(SESSION_SETTINGS.baud);
    // The session requests the status at the configured rate and at the scanner's rate. The scanner replies once and
    // receives no later requests, so the session cannot stop it.
    let request_len = 2 * Request::Status.encode(0).bytes().len();
    bench.to_scanner = Box::new(move |number, byte| (number < request_len).then_some(byte));
    // The host stops from time to time, so that several scans are in its buffer when it changes its rate.
    for pause in 1..60 {
        bench.run(pause * 70 * MILLIS);
        bench.stop_host(1_700 * MILLIS);
    }
    assert!(bench.session.sensor().mode.is_some() && bench.received_scans(started).len() > 20, "{bench}");
    assert!(bench.received.iter().all(|received| received.range_bits.is_none()), "{bench}");
    assert!(!bench.states.contains(&State::Streaming), "{bench}");
    bench.to_scanner = Box::new(|_, byte| Some(byte));
    bench.run_until("streaming", 10_000 * MILLIS, Bench::is_streaming);
    bench.run_until("scans", 1_000 * MILLIS, |bench| {
        bench.received.last().is_some_and(|last| last.range_bits.is_some())
    });
}

#[test]
fn waits_for_a_telegram_on_a_slow_line() {
    // A telegram takes 0.19 s at 38400, where the period is 0.21 s, and 0.76 s at 9600, where the period is 0.77 s.
    for baud in [Baud::B9600, Baud::B38400] {
        let mut machine = sensor(baud);
        let started = make_stream(&mut machine) + 100 * MILLIS;
        let mut bench = Bench::with_settings(lms::Settings { baud, ..SESSION_SETTINGS }, machine, started);
        bench.run_until("streaming", 2_000 * MILLIS, Bench::is_streaming);
        let first = bench.received[0].at;
        assert!(
            bench.sent_bytes.iter().all(|(at, _)| *at >= first),
            "sent a byte before it received one: {bench}"
        );
        bench.run(10_000 * MILLIS);
        assert_eq!(bench.states, [State::Probing, State::Streaming], "{bench}");
    }
}

#[test]
fn restored_identity_gives_scans_without_waiting() {
    for phase in 0..28 {
        let mut last = Bench::new(sensor(Baud::B500000), 0);
        last.run_until("known", 4_000 * MILLIS, |bench| bench.session.identity().is_some());
        last.run(1_000 * MILLIS + phase * 970 * MICROS);
        let known = last.session.identity().expect("it streams");
        let started = last.now;
        let mut bench = Bench::new(last.machine, started);
        bench.session.restore_identity(known);
        bench.run_until("a scan", 60 * MILLIS, |bench| !bench.received_scans(0).is_empty());
        bench.run(2_000 * MILLIS);
        assert!(bench.scans(0).all(|got| got.range_bits == Some(13)), "{bench}");
        assert_eq!(bench.states, [State::Probing, State::Streaming], "{bench}");
        assert_eq!(bench.session.sensor().kind(), b"LMS200;301063;V02.30");
        assert_eq!((bench.session.sensor().defective, bench.session.identity()), (Some(false), Some(known)));
        // Although the identity is known, the session requests the status, which may abort one scan.
        let aborted = bench.sent.iter().filter(|sent| sent.aborted).count();
        assert!(aborted <= 1, "{aborted} scans were aborted");
    }
}

#[test]
fn restored_identity_of_another_scanner_is_replaced() {
    let mut last = Bench::new(sensor(Baud::B500000), 0);
    last.run_until("known", 4_000 * MILLIS, |bench| bench.session.identity().is_some());
    let known = last.session.identity().expect("it streams");
    // The saved identity is that of another scanner, whose scans start with other bytes than those of this scanner.
    let centimetres = Settings { baud: Baud::B500000, unit: Unit::Cm, mode: Mode(4), ..Settings::default() };
    let mut other = sensor_with(centimetres);
    let started = make_stream(&mut other);
    let mut bench = Bench::new(other, started);
    bench.session.restore_identity(known);
    bench.run_until("its mode", 2_000 * MILLIS, |bench| bench.session.sensor().mode.is_some());
    bench.run(200 * MILLIS);
    assert!(bench.received.iter().filter_map(|got| got.range_bits).all(|bits| bits == 14), "{bench}");
    // Now the scans of both scanners start with the same bytes, but their values have different meanings. The session
    // detects this from the status.
    let mut other = sensor_with(Settings { baud: Baud::B500000, mode: Mode(4), ..Settings::default() });
    let started = make_stream(&mut other);
    let mut bench = Bench::new(other, started);
    bench.session.restore_identity(known);
    bench.run_until("its mode", 600 * MILLIS, |bench| bench.session.sensor().mode == Some(Mode(4)));
    // A scanner that does not stream must reply first. The reply makes the session drop the saved identity.
    let mut bench = Bench::new(sensor(Baud::B500000), 0);
    bench.session.restore_identity(known);
    bench.run_until("a reply", 4_000 * MILLIS, |bench| !bench.received.is_empty());
    assert_eq!(bench.session.sensor().kind(), b"");
}

#[test]
fn replaced_scanner_is_not_mistaken_for_the_first() {
    for resync in [false, true] {
        let mut bench = Bench::new(sensor(Baud::B500000), 0);
        bench.run_until("streaming", 3_000 * MILLIS, Bench::is_streaming);
        assert_eq!(bench.session.sensor().mode, Some(Mode(1)));
        // The new scanner streams like the first one, but its values have another meaning.
        let mut other = sensor_with(Settings {
            baud: Baud::B500000,
            start: StartState::Operating(OperatingMode::All),
            mode: Mode(4),
            type_name: "LMS291;S05063;V02.30 ".into(),
            ..Settings::default()
        });
        let now = bench.now;
        let back = now + if resync { 300 * MILLIS } else { 1_050 * MILLIS };
        bench.to_host = Box::new(move |at, bytes| if at < back { Vec::new() } else { bytes });
        bench.run(back - now);
        while other.poll_timeout().is_some_and(|at| at < back) {
            while other.poll_transmit(back).is_some() {}
        }
        bench.machine = other;
        if resync {
            bench.session.control(Control::Resync, bench.now);
        }
        let since = bench.now;
        bench.states.clear();
        bench.run_until("streaming", 3_000 * MILLIS, |bench| bench.received_scans(since).len() > 4);
        let known = bench.session.sensor();
        assert_eq!((known.mode, known.kind()), (Some(Mode(4)), &b"LMS291;S05063;V02.30"[..]), "{bench}");
        let scans = bench.received.iter().filter(|got| got.at > since);
        assert!(scans.filter_map(|got| got.range_bits).all(|bits| bits == 14), "{bench}");
        assert!(!bench.states.contains(&State::Starting), "the stream was not taken over: {bench}");
    }
}

fn modes() -> [OperatingMode; 9] {
    [
        OperatingMode::All,
        OperatingMode::Partial,
        OperatingMode::Means(2),
        OperatingMode::Means(250),
        OperatingMode::Range(27, 299),
        OperatingMode::MeanRange(3, 1, 100),
        OperatingMode::MeanRange(250, 1, 100),
        OperatingMode::Fields(1, 100),
        OperatingMode::Reflectivity(vec![(1, 181)]),
    ]
}

/// Returns a scanner that has streamed in mode `operating` from time 0 until `since`, and this time.
fn streaming(settings: Settings, operating: &OperatingMode, since: Nanos) -> (LmsSimulator, Nanos) {
    let mut machine =
        sensor_with(Settings { start: StartState::Operating(operating.clone()), seed: since, ..settings });
    while let Some(at) = machine.poll_timeout().filter(|&at| at < since) {
        while machine.poll_transmit(at).is_some() {}
    }
    (machine, since)
}

/// Returns the time from the start of the session to the configured stream. Checks that the stream continues.
fn takeover_time(bench: &mut Bench, limit: Nanos) -> Nanos {
    let elapsed = bench.run_until("streaming", limit, Bench::is_streaming);
    let since = bench.now;
    bench.run(500 * MILLIS + 3 * bench.scan_period());
    assert!(bench.is_streaming() && bench.session.problem().is_none(), "{bench}");
    assert!(bench.machine.operating() == &OperatingMode::All, "{:?}: {bench}", bench.machine.operating());
    let mut intact = bench.intact_scans(since);
    let scans = bench.received_scans(since);
    intact.truncate(scans.len());
    assert!(scans.len() > 1 && scans == intact, "{} scans: {bench}", scans.len());
    elapsed
}

impl Bench {
    fn scan_period(&self) -> Nanos {
        Variant::HALF.period(734, self.session.baud().rate())
    }
}

#[test]
fn takes_over_any_stream_at_500k_within_1_s() {
    for operating in modes() {
        for age in [1_000, 1_019] {
            for (address, availability) in [(0, 0), (5, 2)] {
                let settings = Settings { baud: Baud::B500000, address, availability, ..Settings::default() };
                let (machine, now) = streaming(settings, &operating, age * MILLIS);
                let mut bench = Bench::new(machine, now);
                let limit = if operating == OperatingMode::All { 500 } else { 1_000 };
                let elapsed = takeover_time(&mut bench, limit * MILLIS);
                let adopted = bench.states == [State::Probing, State::Streaming];
                assert_eq!(
                    adopted,
                    operating == OperatingMode::All,
                    "{operating:?} in {elapsed} ns: {bench}"
                );
                let scan = bench.received_scans(0).pop().map(|scan| (scan.len(), scan[1]));
                assert_eq!(scan, Some((732 + usize::from(availability), 0x80 + address)), "{bench}");
            }
        }
    }
}

#[test]
fn switches_another_variant_within_1_s() {
    for variant in Variant::ALL {
        for operating in [OperatingMode::All, OperatingMode::Partial] {
            let settings = Settings { baud: Baud::B500000, variant, ..Settings::default() };
            let (machine, now) = streaming(settings, &operating, 1_005 * MILLIS);
            let mut bench = Bench::new(machine, now);
            takeover_time(&mut bench, 1_000 * MILLIS);
            assert_eq!(bench.session.sensor().variant, Some(Variant::HALF), "{variant:?}: {bench}");
        }
    }
}

#[test]
fn takes_over_stream_at_another_rate_within_5_s() {
    for baud in [Baud::B9600, Baud::B19200, Baud::B38400] {
        for operating in modes() {
            for age in [1_000, 1_357] {
                let settings = Settings { baud, address: 1, ..Settings::default() };
                let (machine, now) = streaming(settings, &operating, age * MILLIS);
                let mut bench = Bench::new(machine, now);
                takeover_time(&mut bench, 5_000 * MILLIS);
            }
        }
    }
}

#[test]
fn slow_link_takes_over_any_stream() {
    for settings in [Baud::B9600, Baud::B19200, Baud::B38400] {
        for baud in Baud::ALL {
            for operating in [OperatingMode::All, OperatingMode::Partial, OperatingMode::Means(250)] {
                let (machine, now) =
                    streaming(Settings { baud, ..Settings::default() }, &operating, 1_003 * MILLIS);
                let mut bench =
                    Bench::with_settings(lms::Settings { baud: settings, ..SESSION_SETTINGS }, machine, now);
                takeover_time(&mut bench, 6_000 * MILLIS);
                assert_eq!(bench.session.baud(), settings);
            }
        }
    }
}

#[test]
fn scanner_leaves_installation_mode() {
    for baud in Baud::ALL {
        for strict in [false, true] {
            let quirks = ProtocolQuirks { is_strict: strict, ..ProtocolQuirks::default() };
            let start = StartState::Operating(OperatingMode::Installation);
            let settings = Settings { baud, start, quirks, ..Settings::default() };
            let mut bench = Bench::new(sensor_with(settings), 0);
            bench.run_until("streaming", 3_000 * MILLIS, Bench::is_streaming);
            bench.run(1_000 * MILLIS);
            assert!(bench.is_streaming() && bench.machine.operating() == &OperatingMode::All, "{bench}");
            assert_eq!(bench.session.problem(), None);
        }
    }
}

#[test]
fn leaves_installation_mode_without_a_status_reply() {
    for baud in Baud::ALL {
        let quirks = ProtocolQuirks { refused_commands: vec![0x31], ..ProtocolQuirks::default() };
        let start = StartState::Operating(OperatingMode::Installation);
        let mut bench = Bench::new(sensor_with(Settings { baud, start, quirks, ..Settings::default() }), 0);
        bench.run_until("stopped", 3_000 * MILLIS, |bench| {
            bench.machine.operating() == &OperatingMode::OnRequest
        });
        bench.run_until("streaming", 3_000 * MILLIS, Bench::is_streaming);
        bench.run(1_000 * MILLIS);
        assert!(bench.is_streaming() && bench.session.problem().is_none(), "{bench}");
    }
}

#[test]
fn permanent_rate_is_found_and_kept() {
    for permanent in Baud::ALL {
        let permanent_baud = (permanent != Baud::B9600).then_some(permanent);
        let settings = Settings { baud: permanent, permanent_baud, ..Settings::default() };
        let mut bench = Bench::new(sensor_with(settings), 0);
        bench.run_until("streaming", 3_000 * MILLIS, Bench::is_streaming);
        bench.run(500 * MILLIS);
        // The session reports another permanent rate than 9600 as a notice, and not as a problem.
        let is_noticed = bench.session.sensor().notices().eq([Notice::PermanentBaud]);
        assert_eq!(is_noticed, permanent != Baud::B9600, "{permanent:?}: {bench}");
        assert_eq!(bench.session.sensor().permanent_baud, Some(is_noticed));
        assert_eq!(bench.session.problem(), None);
        // After a power cycle, the scanner starts at its permanent rate, and the session finds it again.
        let now = bench.now;
        bench.machine.power_cycle(now);
        bench.run_until("silent", 1_200 * MILLIS, |bench| !bench.is_streaming());
        bench.run_until("streaming", 8_000 * MILLIS, Bench::is_streaming);
        bench.run(500 * MILLIS);
        assert!(bench.is_streaming() && bench.session.baud() == Baud::B500000, "{permanent:?}: {bench}");
    }
}

fn settings_at(baud: Baud) -> lms::Settings {
    lms::Settings { baud, fixed_rate: true, ..SESSION_SETTINGS }
}

#[test]
fn scanner_at_the_fixed_rate_streams() {
    for baud in Baud::ALL {
        let mut bench = Bench::with_settings(settings_at(baud), sensor(baud), 0);
        bench.run_until("streaming", 5_000 * MILLIS, Bench::is_streaming);
        assert!(!bench.states.contains(&State::Switching), "{bench}");
        let mut machine = sensor(baud);
        let now = make_stream(&mut machine);
        let mut bench = Bench::with_settings(settings_at(baud), machine, now);
        bench.run_until("streaming", 2_000 * MILLIS, Bench::is_streaming);
    }
}

#[test]
fn fixed_rate_session_does_not_search_other_rates() {
    let mut bench = Bench::with_settings(settings_at(Baud::B38400), sensor(Baud::B9600), 0);
    bench.run_until("reported", 10_000 * MILLIS, |bench| {
        matches!(bench.session.problem(), Some(Problem::NoReply { baud: Some(Baud::B38400), .. }))
    });
    for _ in 0..100 {
        bench.run(100 * MILLIS);
        assert_eq!(bench.session.baud(), Baud::B38400, "{bench}");
    }
    assert_eq!(bench.states, [State::Probing]);
}

#[test]
fn every_rate_and_state_streams_within_5_s() {
    let left = [
        ("idle", OperatingMode::OnRequest),
        ("streaming", OperatingMode::All),
        ("installation", OperatingMode::Installation),
    ];
    println!(
        "{:>8} {:>10} {:>10} {:>13}   ms to the first scan, mean and longest",
        "baud", left[0].0, left[1].0, left[2].0
    );
    for baud in Baud::ALL {
        let mut cells = Vec::new();
        for (name, operating) in &left {
            let mut elapsed = Vec::new();
            for seed in 0..10 {
                let start = StartState::Operating(operating.clone());
                let settings = Settings { baud, start, seed, ..Settings::default() };
                // Start the session at different times within a scan.
                let started = seed * 83 * MILLIS;
                let mut bench = Bench::new(sensor_with(settings), started);
                let ms = bench.run_until("streaming", 5_000 * MILLIS, Bench::is_streaming) / MILLIS;
                let stale = *name == "streaming" && baud == Baud::B500000;
                assert!(!stale || ms <= 500, "{ms} ms: {bench}");
                bench.run(200 * MILLIS);
                assert!(bench.is_streaming() && bench.session.problem().is_none(), "{bench}");
                elapsed.push(ms);
            }
            let mean = elapsed.iter().sum::<u64>() / elapsed.len() as u64;
            cells.push(format!("{mean} {}", elapsed.iter().max().copied().unwrap_or_default()));
        }
        println!("{:>8} {:>10} {:>10} {:>13}", baud.rate(), cells[0], cells[1], cells[2]);
    }
}
