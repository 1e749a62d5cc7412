//! The start of a session, from the first request to the stream. The scanner is idle at some rate, streams already,
//! streams in another mode or is in installation mode. The line may have a fixed rate.

use scanhub_drivers::line::{Control, Session as _, State};
use scanhub_drivers::lms;
use scanhub_drivers::lms::command::Request;
use scanhub_drivers::lms::variant::{Baud, Mode, Unit, Variant};
use scanhub_drivers::lms::{Notice, Trouble};
use scanhub_schema::{MICROS, MILLIS, Nanos};
use scanhub_sim::device::Device as _;
use scanhub_sim::machine::{LmsSimulator, ProtocolQuirks, Settings, Start};
use scanhub_sim::operating::Operating;

use super::{Bench, WANTED, make_stream, sensor, sensor_with};

#[test]
fn from_each_rate_to_a_stream_within_three_seconds() {
    for baud in Baud::ALL {
        let mut bench = Bench::new(sensor(baud), 0);
        bench.until("streaming", 3_000 * MILLIS, Bench::is_streaming);
        let since = bench.now;
        bench.run(1_000 * MILLIS);
        assert!(bench.is_streaming() && bench.session.baud() == Baud::B500000, "{bench}");
        let known = bench.session.sensor();
        assert_eq!(
            (known.mode, known.unit, known.variant),
            (Some(Mode(1)), Some(Unit::Mm), Some(Variant::HALF))
        );
        assert_eq!((known.kind(), known.address), (&b"LMS200;301063;V02.30"[..], Some(0x80)));
        assert_eq!((bench.session.trouble(), bench.session.account().resyncs), (None, 0));
        let scans = bench.received_scans(since);
        assert!(scans.len() >= 36 && scans == bench.intact_scans(since)[..scans.len()], "{bench}");
        // A rate is changed only where it has to be.
        assert_eq!(bench.states.contains(&State::Switching), baud != Baud::B500000, "{bench}");
        // Nothing is asked of a sensor whose questions are all answered.
        let aborted = bench.sent.iter().filter(|sent| sent.aborted).count();
        assert_eq!(aborted, 0, "{bench}");
    }
}

#[test]
fn a_sensor_with_another_variant_is_set_to_the_wanted_one() {
    let settings = Settings { variant: Variant::ALL[4], baud: Baud::B38400, ..Settings::default() };
    let room = scanhub_sim::room::Room::new(&scanhub_sim::world::World::Random, 3);
    let machine =
        scanhub_sim::machine::LmsSimulator::new(settings, scanhub_sim::operating::Source::Room(room));
    let mut bench = Bench::new(machine, 0);
    bench.until("streaming", 3_000 * MILLIS, Bench::is_streaming);
    bench.run(500 * MILLIS);
    assert_eq!(bench.session.sensor().variant, Some(Variant::HALF));
    assert!(bench.received_scans(0).iter().all(|scan| scan.len() == 732), "{bench}");
}

#[test]
fn nobody_there_is_said_and_the_search_goes_on() {
    // It gets its power at any moment of two rounds and the pauses after them.
    for moment in 0..60 {
        let mut bench = Bench::new(sensor(Baud::B9600), 0);
        bench.to_sensor = Box::new(|_, _| None);
        bench.until("said", 3_000 * MILLIS, |bench| {
            matches!(bench.session.trouble(), Some(lms::Trouble::NoAnswer { .. }))
        });
        bench.run((10_000 + 100 * moment) * MILLIS);
        assert_eq!(bench.states, [State::Probing]);
        bench.to_sensor = Box::new(|_, byte| Some(byte));
        bench.until("streaming", 4_000 * MILLIS, Bench::is_streaming);
        assert_eq!(bench.session.trouble(), None);
    }
}

/// A sensor that answers 60 ms after its ACK, as the faster half of those captured.
fn prompt(baud: Baud, start: Start) -> Settings {
    let quirks = ProtocolQuirks { answer_ns: 60 * MILLIS, ..ProtocolQuirks::default() };
    Settings { baud, start, quirks, ..Settings::default() }
}

#[test]
fn a_sensor_that_just_got_its_power_streams_soon() {
    // Never seen before, or where it was the last time.
    for (seed, first, within) in (0..20).flat_map(|seed| [(seed, None, 500), (seed, Some(Baud::B9600), 500)])
    {
        let settings = Settings { seed, ..prompt(Baud::B9600, Start::In(Operating::OnRequest)) };
        let mut bench = Bench::new(sensor_with(settings), 0);
        first.into_iter().for_each(|baud| bench.seek_first(baud));
        let took = bench.until("a scan", within * MILLIS, |bench| !bench.received_scans(0).is_empty());
        assert_eq!(bench.found_at(), Some(Baud::B9600));
        assert!(bench.received.last().is_some_and(|got| got.range_bits == Some(13)), "{took}: {bench}");
        let known = bench.session.sensor();
        assert_eq!((known.kind(), known.unit), (&b"LMS200;301063;V02.30"[..], Some(Unit::Mm)));
        // At 9600 nothing long is said: a type and a change of rate.
        let replies: Vec<u8> =
            bench.sent.iter().filter(|sent| sent.is_reply).map(|sent| sent.telegram[4]).collect();
        assert_eq!(replies, [0xBA, 0xA0, 0xB1, 0xA0], "{bench}");
    }
}

#[test]
fn what_does_not_tell_its_type_or_its_status_is_started_all_the_same() {
    for baud in Baud::ALL {
        for start in [Operating::OnRequest, Operating::All, Operating::Installation] {
            for refused in [0x3A, 0x31, 0x74] {
                let settings = prompt(baud, Start::In(start.clone()));
                let quirks = ProtocolQuirks { refuses: vec![refused], ..settings.quirks.clone() };
                let mut bench = Bench::new(sensor_with(Settings { quirks, ..settings }), 0);
                bench.until("streaming", 4_000 * MILLIS, Bench::is_streaming);
                bench.run(1_500 * MILLIS);
                assert!(bench.is_streaming() && bench.session.trouble().is_none(), "{refused:02x}: {bench}");
                assert_eq!(bench.session.sensor().mode, Some(Mode(1)), "{refused:02x}: {bench}");
            }
        }
    }
}

#[test]
fn where_it_was_the_last_time_is_asked_and_not_believed() {
    for first in Baud::ALL {
        for baud in Baud::ALL {
            let mut bench = Bench::new(sensor_with(prompt(baud, Start::In(Operating::OnRequest))), 0);
            bench.seek_first(first);
            let took = bench.until("streaming", 1_500 * MILLIS, Bench::is_streaming);
            assert!(first != baud || took < 500 * MILLIS, "{first:?}: {took}");
            assert_eq!((bench.found_at(), bench.session.trouble()), (Some(baud), None));
            let mut machine = sensor(baud);
            let now = make_stream(&mut machine);
            let mut bench = Bench::new(machine, now);
            bench.seek_first(first);
            // A stream at the wanted rate is heard before anything is asked.
            let within = if baud == Baud::B500000 { 60 } else { 4_000 };
            bench.until("streaming", within * MILLIS, Bench::is_streaming);
            assert_eq!(bench.found_at().is_none(), baud == Baud::B500000);
        }
    }
}

/// It does not answer at all where others say that they cannot: at every rate it is asked for its status too.
#[test]
fn what_has_no_answer_for_its_type_is_found_by_its_status() {
    for baud in Baud::ALL {
        let mut bench = Bench::new(sensor_with(prompt(baud, Start::In(Operating::OnRequest))), 0);
        let mut heard = Vec::new();
        // Every request for the type is lost.
        bench.to_sensor = Box::new(move |_, byte| {
            heard.push(byte);
            (!heard.ends_with(&[0x02, 0x00, 0x01, 0x00, 0x3A])).then_some(byte)
        });
        bench.until("streaming", 6_000 * MILLIS, Bench::is_streaming);
        bench.run(1_000 * MILLIS);
        assert!(bench.is_streaming() && bench.session.trouble().is_none(), "{baud:?}: {bench}");
    }
}

/// Its rate may not be changed in the mode in which it is, which was not asked yet: it is stopped first.
#[test]
fn what_refuses_another_rate_is_stopped_first() {
    for baud in [Baud::B9600, Baud::B19200, Baud::B38400] {
        let settings = prompt(baud, Start::In(Operating::Installation));
        let willing = settings.quirks.clone();
        let quirks = ProtocolQuirks { refuses: vec![0x20], ..willing.clone() };
        let mut bench = Bench::new(sensor_with(Settings { quirks, ..settings }), 0);
        bench.until("refused", 2_000 * MILLIS, |bench| {
            bench.received.iter().any(|got| got.telegram[4] == lms::reply::REFUSED)
        });
        bench.machine.set_quirks(willing);
        bench.until("streaming", 2_000 * MILLIS, Bench::is_streaming);
        bench.run(500 * MILLIS);
        assert!(bench.is_streaming() && bench.session.trouble().is_none(), "{bench}");
        // Whoever refuses it always is told of, and asked again.
        let quirks = ProtocolQuirks { refuses: vec![0x20], ..ProtocolQuirks::default() };
        let settings = prompt(baud, Start::In(Operating::OnRequest));
        let mut bench = Bench::new(sensor_with(Settings { quirks, ..settings }), 0);
        bench.until("said", 4_000 * MILLIS, |bench| {
            matches!(bench.session.trouble(), Some(lms::Trouble::Refused(_)))
        });
        bench.run(5_000 * MILLIS);
        bench.machine.set_quirks(ProtocolQuirks::default());
        bench.until("streaming", 4_000 * MILLIS, Bench::is_streaming);
        assert_eq!(bench.session.trouble(), None);
    }
}

#[test]
fn at_the_wanted_rate_it_is_taken_as_it_streams() {
    // Begun at any moment of a scan's period.
    for phase in 0..28 {
        let mut machine = sensor(Baud::B500000);
        let begun = make_stream(&mut machine) + phase * 970 * MICROS;
        let mut bench = Bench::new(machine, begun);
        bench.until("streaming", 60 * MILLIS, Bench::is_streaming);
        bench.run(2_000 * MILLIS);
        assert!(bench.said.iter().all(|(at, _)| *at >= bench.received[0].at), "spoke before it listened");
        assert_eq!(bench.states, [State::Probing, State::Streaming], "{bench}");
        // Two questions, for measuring mode and type.
        let aborted = bench.sent.iter().filter(|sent| sent.aborted).count();
        assert!(aborted <= 2, "{aborted} scans were broken off");
        assert!(bench.session.sensor().mode.is_some() && !bench.session.sensor().kind().is_empty());
        // The session does not deliver the scan that was on the line at its start, but all others.
        let (scans, intact) = (bench.received_scans(0), bench.intact_scans(begun));
        let skipped = intact.iter().position(|scan| scans.first() == Some(scan)).expect("was sent");
        assert_eq!(scans, intact[skipped..][..scans.len()], "{bench}");
        assert!(skipped <= 1 && intact.len() - skipped - scans.len() <= 1, "{bench}");
        assert_eq!(bench.session.account().began_with_a_cut, skipped == 1, "{bench}");
    }
}

#[test]
fn at_another_rate_it_is_found_and_brought_to_the_wanted_one() {
    for baud in [Baud::B9600, Baud::B19200, Baud::B38400] {
        for phase in 0..30 {
            let mut machine = sensor(baud);
            let begun = make_stream(&mut machine) + phase * 27 * MILLIS;
            let mut bench = Bench::new(machine, begun);
            let took = bench.until("streaming", 4_000 * MILLIS, Bench::is_streaming);
            bench.run(500 * MILLIS);
            assert_eq!((bench.session.baud(), bench.machine.baud()), (Baud::B500000, Baud::B500000));
            assert!(bench.is_streaming() && bench.received_scans(0).len() > 15, "{took} ns: {bench}");
            assert_eq!(bench.session.trouble(), None);
        }
    }
}

#[test]
fn what_comes_at_another_rate_gives_no_scans() {
    let mut machine = sensor(Baud::B9600);
    let begun = make_stream(&mut machine);
    let mut bench = Bench::new(machine, begun);
    bench.seek_first(WANTED.baud);
    // The session sends requests at the configured and at the current rate. The scanner returns its status and ignores
    // all later requests, so it cannot be stopped.
    let asked = 2 * Request::Status.encode(0).bytes().len();
    bench.to_sensor = Box::new(move |number, byte| (number < asked).then_some(byte));
    // The host stands still at times, so that several scans wait where it changes its rate.
    for pause in 1..60 {
        bench.run(pause * 70 * MILLIS);
        bench.stop(1_700 * MILLIS);
    }
    assert!(bench.session.sensor().mode.is_some() && bench.received_scans(begun).len() > 20, "{bench}");
    assert!(bench.received.iter().all(|received| received.range_bits.is_none()), "{bench}");
    assert!(!bench.states.contains(&State::Streaming), "{bench}");
    bench.to_sensor = Box::new(|_, byte| Some(byte));
    bench.until("streaming", 10_000 * MILLIS, Bench::is_streaming);
    bench.until("scans", 1_000 * MILLIS, |bench| {
        bench.received.last().is_some_and(|last| last.range_bits.is_some())
    });
}

#[test]
fn on_a_slow_line_it_is_waited_for() {
    // A telegram takes 0.19 s at 38400 and 0.76 s at 9600, the next one comes 0.21 and 0.77 s later.
    for baud in [Baud::B9600, Baud::B38400] {
        let mut machine = sensor(baud);
        let begun = make_stream(&mut machine) + 100 * MILLIS;
        let mut bench = Bench::wanting(lms::Settings { baud, ..WANTED }, machine, begun);
        bench.until("streaming", 2_000 * MILLIS, Bench::is_streaming);
        let first = bench.received[0].at;
        assert!(bench.said.iter().all(|(at, _)| *at >= first), "spoke before it listened: {bench}");
        bench.run(10_000 * MILLIS);
        assert_eq!(bench.states, [State::Probing, State::Streaming], "{bench}");
    }
}

#[test]
fn what_the_last_session_knew_is_not_waited_for() {
    for phase in 0..28 {
        let mut last = Bench::new(sensor(Baud::B500000), 0);
        last.until("known", 4_000 * MILLIS, |bench| bench.session.identity().is_some());
        last.run(1_000 * MILLIS + phase * 970 * MICROS);
        let known = last.session.identity().expect("it streams");
        let begun = last.now;
        let mut bench = Bench::new(last.machine, begun);
        bench.session.restore_identity(known);
        bench.until("a scan", 60 * MILLIS, |bench| !bench.received_scans(0).is_empty());
        bench.run(2_000 * MILLIS);
        assert!(bench.scans(0).all(|got| got.range_bits == Some(13)), "{bench}");
        assert_eq!(bench.states, [State::Probing, State::Streaming], "{bench}");
        assert_eq!(bench.session.sensor().kind(), b"LMS200;301063;V02.30");
        assert_eq!((bench.session.sensor().defective, bench.session.identity()), (Some(false), Some(known)));
        // The session requests its status anyway.
        let aborted = bench.sent.iter().filter(|sent| sent.aborted).count();
        assert!(aborted <= 1, "{aborted} scans were broken off");
    }
}

#[test]
fn what_the_last_session_knew_of_another_one_is_not_believed() {
    let mut last = Bench::new(sensor(Baud::B500000), 0);
    last.until("known", 4_000 * MILLIS, |bench| bench.session.identity().is_some());
    let known = last.session.identity().expect("it streams");
    // Its scans begin otherwise.
    let centimetres = Settings { baud: Baud::B500000, unit: Unit::Cm, mode: Mode(4), ..Settings::default() };
    let mut other = sensor_with(centimetres);
    let begun = make_stream(&mut other);
    let mut bench = Bench::new(other, begun);
    bench.session.restore_identity(known);
    bench.until("its mode", 2_000 * MILLIS, |bench| bench.session.sensor().mode.is_some());
    bench.run(200 * MILLIS);
    assert!(bench.received.iter().filter_map(|got| got.range_bits).all(|bits| bits == 14), "{bench}");
    // They begin in the same way, and mean something else: its status tells.
    let mut other = sensor_with(Settings { baud: Baud::B500000, mode: Mode(4), ..Settings::default() });
    let begun = make_stream(&mut other);
    let mut bench = Bench::new(other, begun);
    bench.session.restore_identity(known);
    bench.until("its mode", 600 * MILLIS, |bench| bench.session.sensor().mode == Some(Mode(4)));
    // No scanner streams, so a reply replaces the saved identity.
    let mut bench = Bench::new(sensor(Baud::B500000), 0);
    bench.session.restore_identity(known);
    bench.until("an answer", 4_000 * MILLIS, |bench| !bench.received.is_empty());
    assert_eq!(bench.session.sensor().kind(), b"");
}

#[test]
fn another_one_is_not_taken_for_the_first() {
    for resync in [false, true] {
        let mut bench = Bench::new(sensor(Baud::B500000), 0);
        bench.until("streaming", 3_000 * MILLIS, Bench::is_streaming);
        assert_eq!(bench.session.sensor().mode, Some(Mode(1)));
        // It streams as the first one did, but what its values mean is something else.
        let mut other = sensor_with(Settings {
            baud: Baud::B500000,
            start: Start::In(Operating::All),
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
        bench.until("streaming", 3_000 * MILLIS, |bench| bench.received_scans(since).len() > 4);
        let known = bench.session.sensor();
        assert_eq!((known.mode, known.kind()), (Some(Mode(4)), &b"LMS291;S05063;V02.30"[..]), "{bench}");
        let told = bench.received.iter().filter(|got| got.at > since);
        assert!(told.filter_map(|got| got.range_bits).all(|bits| bits == 14), "{bench}");
        assert!(!bench.states.contains(&State::Starting), "it was adopted: {bench}");
    }
}

fn modes() -> [Operating; 9] {
    [
        Operating::All,
        Operating::Partial,
        Operating::Means(2),
        Operating::Means(250),
        Operating::Range(27, 299),
        Operating::MeanRange(3, 1, 100),
        Operating::MeanRange(250, 1, 100),
        Operating::Fields(1, 100),
        Operating::Reflectivity(vec![(1, 181)]),
    ]
}

/// A sensor that does this since `age`.
fn streaming(settings: Settings, operating: &Operating, age: Nanos) -> (LmsSimulator, Nanos) {
    let mut machine = sensor_with(Settings { start: Start::In(operating.clone()), seed: age, ..settings });
    while let Some(at) = machine.poll_timeout().filter(|&at| at < age) {
        while machine.poll_transmit(at).is_some() {}
    }
    (machine, age)
}

/// Returns the time from the start of the session to the configured stream, which then continues.
fn taken_over(bench: &mut Bench, limit: Nanos) -> Nanos {
    let took = bench.until("streaming", limit, Bench::is_streaming);
    let since = bench.now;
    bench.run(500 * MILLIS + 3 * bench.scan_period());
    assert!(bench.is_streaming() && bench.session.trouble().is_none(), "{bench}");
    assert!(bench.machine.operating() == &Operating::All, "{:?}: {bench}", bench.machine.operating());
    let mut intact = bench.intact_scans(since);
    let scans = bench.received_scans(since);
    intact.truncate(scans.len());
    assert!(scans.len() > 1 && scans == intact, "{} scans: {bench}", scans.len());
    took
}

impl Bench {
    fn scan_period(&self) -> Nanos {
        Variant::HALF.period(734, self.session.baud().rate())
    }
}

#[test]
fn whatever_streams_at_500k_is_the_wanted_stream_within_a_second() {
    for operating in modes() {
        for age in [1_000, 1_019] {
            for (address, availability) in [(0, 0), (5, 2)] {
                let settings = Settings { baud: Baud::B500000, address, availability, ..Settings::default() };
                let (machine, now) = streaming(settings, &operating, age * MILLIS);
                let mut bench = Bench::new(machine, now);
                let limit = if operating == Operating::All { 500 } else { 1_000 };
                let took = taken_over(&mut bench, limit * MILLIS);
                let adopted = bench.states == [State::Probing, State::Streaming];
                assert_eq!(adopted, operating == Operating::All, "{operating:?} in {took} ns: {bench}");
                let scan = bench.received_scans(0).pop().map(|scan| (scan.len(), scan[1]));
                assert_eq!(scan, Some((732 + usize::from(availability), 0x80 + address)), "{bench}");
            }
        }
    }
}

#[test]
fn another_variant_is_switched_within_a_second() {
    for variant in Variant::ALL {
        for operating in [Operating::All, Operating::Partial] {
            let settings = Settings { baud: Baud::B500000, variant, ..Settings::default() };
            let (machine, now) = streaming(settings, &operating, 1_005 * MILLIS);
            let mut bench = Bench::new(machine, now);
            taken_over(&mut bench, 1_000 * MILLIS);
            assert_eq!(bench.session.sensor().variant, Some(Variant::HALF), "{variant:?}: {bench}");
        }
    }
}

#[test]
fn whatever_streams_at_another_rate_is_found_within_five_seconds() {
    for baud in [Baud::B9600, Baud::B19200, Baud::B38400] {
        for operating in modes() {
            for age in [1_000, 1_357] {
                let settings = Settings { baud, address: 1, ..Settings::default() };
                let (machine, now) = streaming(settings, &operating, age * MILLIS);
                let mut bench = Bench::new(machine, now);
                taken_over(&mut bench, 5_000 * MILLIS);
            }
        }
    }
}

#[test]
fn a_slow_link_takes_over_what_streams_too() {
    for wanted in [Baud::B9600, Baud::B19200, Baud::B38400] {
        for baud in Baud::ALL {
            for operating in [Operating::All, Operating::Partial, Operating::Means(250)] {
                let (machine, now) =
                    streaming(Settings { baud, ..Settings::default() }, &operating, 1_003 * MILLIS);
                let mut bench = Bench::wanting(lms::Settings { baud: wanted, ..WANTED }, machine, now);
                taken_over(&mut bench, 6_000 * MILLIS);
                assert_eq!(bench.session.baud(), wanted);
            }
        }
    }
}

#[test]
fn the_installation_mode_is_left() {
    for baud in Baud::ALL {
        for strict in [false, true] {
            let quirks = ProtocolQuirks { strict, ..ProtocolQuirks::default() };
            let start = Start::In(Operating::Installation);
            let settings = Settings { baud, start, quirks, ..Settings::default() };
            let mut bench = Bench::new(sensor_with(settings), 0);
            bench.until("streaming", 3_000 * MILLIS, Bench::is_streaming);
            bench.run(1_000 * MILLIS);
            assert!(bench.is_streaming() && bench.machine.operating() == &Operating::All, "{bench}");
            assert_eq!(bench.session.trouble(), None);
        }
    }
}

#[test]
fn it_is_left_too_by_a_sensor_that_does_not_tell_it() {
    for baud in Baud::ALL {
        let quirks = ProtocolQuirks { refuses: vec![0x31], ..ProtocolQuirks::default() };
        let start = Start::In(Operating::Installation);
        let mut bench = Bench::new(sensor_with(Settings { baud, start, quirks, ..Settings::default() }), 0);
        bench.until("stopped", 3_000 * MILLIS, |bench| bench.machine.operating() == &Operating::OnRequest);
        bench.until("streaming", 3_000 * MILLIS, Bench::is_streaming);
        bench.run(1_000 * MILLIS);
        assert!(bench.is_streaming() && bench.session.trouble().is_none(), "{bench}");
    }
}

#[test]
fn a_permanent_rate_is_found_worked_with_and_kept() {
    for permanent in Baud::ALL {
        let permanent_baud = (permanent != Baud::B9600).then_some(permanent);
        let settings = Settings { baud: permanent, permanent_baud, ..Settings::default() };
        let mut bench = Bench::new(sensor_with(settings), 0);
        bench.until("streaming", 3_000 * MILLIS, Bench::is_streaming);
        bench.run(500 * MILLIS);
        // That is a notice and not a problem.
        let is_said = bench.session.sensor().notices().eq([Notice::PermanentBaud]);
        assert_eq!(is_said, permanent != Baud::B9600, "{permanent:?}: {bench}");
        assert_eq!(bench.session.sensor().permanent_baud, Some(is_said));
        assert_eq!(bench.session.trouble(), None);
        // It comes back at its own rate, and is found again.
        let now = bench.now;
        bench.machine.power_cycle(now);
        bench.until("silent", 1_200 * MILLIS, |bench| !bench.is_streaming());
        bench.until("streaming", 8_000 * MILLIS, Bench::is_streaming);
        bench.run(500 * MILLIS);
        assert!(bench.is_streaming() && bench.session.baud() == Baud::B500000, "{permanent:?}: {bench}");
    }
}

fn wanted(baud: Baud) -> lms::Settings {
    lms::Settings { baud, fixed_rate: true, ..WANTED }
}

#[test]
fn a_sensor_at_that_rate_streams() {
    for baud in Baud::ALL {
        let mut bench = Bench::wanting(wanted(baud), sensor(baud), 0);
        bench.until("streaming", 5_000 * MILLIS, Bench::is_streaming);
        assert!(!bench.states.contains(&State::Switching), "{bench}");
        let mut machine = sensor(baud);
        let now = make_stream(&mut machine);
        let mut bench = Bench::wanting(wanted(baud), machine, now);
        bench.until("streaming", 2_000 * MILLIS, Bench::is_streaming);
    }
}

#[test]
fn a_sensor_at_another_rate_is_said_to_be_mute_and_not_sought_elsewhere() {
    let mut bench = Bench::wanting(wanted(Baud::B38400), sensor(Baud::B9600), 0);
    bench.until("said", 10_000 * MILLIS, |bench| {
        matches!(bench.session.trouble(), Some(Trouble::NoAnswer { baud: Some(Baud::B38400), .. }))
    });
    for _ in 0..100 {
        bench.run(100 * MILLIS);
        assert_eq!(bench.session.baud(), Baud::B38400, "{bench}");
    }
    assert_eq!(bench.states, [State::Probing]);
}

#[test]
fn twelve_of_twelve_stream_within_five_seconds() {
    let left = [
        ("idle", Operating::OnRequest),
        ("streaming", Operating::All),
        ("installation", Operating::Installation),
    ];
    println!(
        "{:>8} {:>10} {:>10} {:>13}   ms to the first scan, mean and longest",
        "baud", left[0].0, left[1].0, left[2].0
    );
    for baud in Baud::ALL {
        let mut cells = Vec::new();
        for (name, operating) in &left {
            let mut took = Vec::new();
            for seed in 0..10 {
                let start = Start::In(operating.clone());
                let settings = Settings { baud, start, seed, ..Settings::default() };
                // Begun at any moment of a scan.
                let begun = seed * 83 * MILLIS;
                let mut bench = Bench::new(sensor_with(settings), begun);
                let ms = bench.until("streaming", 5_000 * MILLIS, Bench::is_streaming) / MILLIS;
                let stale = *name == "streaming" && baud == Baud::B500000;
                assert!(!stale || ms <= 500, "{ms} ms: {bench}");
                bench.run(200 * MILLIS);
                assert!(bench.is_streaming() && bench.session.trouble().is_none(), "{bench}");
                took.push(ms);
            }
            let mean = took.iter().sum::<u64>() / took.len() as u64;
            cells.push(format!("{mean} {}", took.iter().max().copied().unwrap_or_default()));
        }
        println!("{:>8} {:>10} {:>10} {:>13}", baud.rate(), cells[0], cells[1], cells[2]);
    }
}
