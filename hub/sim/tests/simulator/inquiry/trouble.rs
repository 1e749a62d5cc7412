//! A line that loses bytes, a sensor that overlooks requests, one that hears nothing, and none at all.

use scanhub_drivers::lms::Inquiry;
use scanhub_drivers::lms::variant::Baud;
use scanhub_schema::MILLIS;
use scanhub_sim::machine::ProtocolQuirks;

use super::bench::{Bench, make_stream, sensor};

#[test]
fn a_lossy_line_costs_tries_and_tells_no_lies() {
    let mut found = 0;
    for seed in 0..60 {
        let baud = Baud::ALL[seed as usize % 4];
        let mut machine = sensor(baud);
        let now = if seed % 2 == 0 { make_stream(&mut machine) } else { 0 };
        let mut bench = Bench::new(Inquiry::new(Baud::B500000, now), Baud::B500000, machine, now);
        let mut random = fastrand::Rng::with_seed(seed);
        bench.to_host = Box::new(move |bytes| bytes.into_iter().filter(|_| random.f64() > 0.002).collect());
        bench.finish(20_000 * MILLIS);
        let report = bench.talk.report();
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
        let (tally, open) = bench.talk.tally();
        assert_eq!(tally.read, tally.in_telegrams + tally.acknowledge + tally.discarded + open as u64);
    }
    assert!(found >= 57, "{found} of 60 found");
}

#[test]
fn a_request_that_is_overlooked_is_said_again() {
    let mut found = 0;
    for seed in 0..40 {
        let baud = Baud::ALL[seed as usize % 4];
        let mut machine = sensor(baud);
        let now = make_stream(&mut machine);
        let mut bench = Bench::new(Inquiry::new(Baud::B500000, now), Baud::B500000, machine, now);
        // The first byte of a request is lost, and so the whole of it.
        let mut random = fastrand::Rng::with_seed(seed);
        bench.to_sensor =
            Box::new(move |bytes| if bytes[0] == 0x02 && random.f64() < 0.3 { Vec::new() } else { bytes });
        bench.finish(20_000 * MILLIS);
        found += usize::from(bench.talk.report().baud == Some(baud));
    }
    assert!(found >= 38, "{found} of 40 found");
}

#[test]
fn late_doubled_and_refused_replies() {
    for (word, quirks) in [
        ("late", ProtocolQuirks { late_reply_ns: 250 * MILLIS, ..ProtocolQuirks::default() }),
        ("late ACK", ProtocolQuirks { late_acknowledge_ns: 120 * MILLIS, ..ProtocolQuirks::default() }),
        ("doubled", ProtocolQuirks { doubles: 1.0, ..ProtocolQuirks::default() }),
        ("NAK", ProtocolQuirks { naks: 0.3, ..ProtocolQuirks::default() }),
        ("refused", ProtocolQuirks { refuses: vec![0x3A, 0x32], ..ProtocolQuirks::default() }),
    ] {
        for baud in Baud::ALL {
            let mut machine = sensor(baud);
            machine.set_quirks(quirks.clone());
            let mut bench = Bench::new(Inquiry::new(Baud::B500000, 0), Baud::B500000, machine, 0);
            bench.finish(20_000 * MILLIS);
            let report = bench.talk.report();
            assert_eq!(report.baud, Some(baud), "{word}");
            assert!(report.status().is_some() && report.configuration().is_some(), "{word}, {baud:?}");
            assert_eq!(report.kind().is_some(), word != "refused", "{word}, {baud:?}");
        }
    }
}

#[test]
fn silence_is_told_in_bounded_time() {
    let mut bench = Bench::new(Inquiry::new(Baud::B500000, 0), Baud::B500000, sensor(Baud::B9600), 0);
    bench.to_host = Box::new(|_| Vec::new());
    let took = bench.finish(10_000 * MILLIS);
    let report = bench.talk.report();
    assert_eq!((report.baud, report.answers(), report.streams), (None, false, false));
    println!("silence: {} ms", took / MILLIS);
    assert!(took < 5_000 * MILLIS, "{took} ns");
}

#[test]
fn a_sensor_that_streams_and_hears_nothing_tells_its_rate() {
    for baud in Baud::ALL {
        let mut machine = sensor(baud);
        let now = make_stream(&mut machine);
        let mut bench = Bench::new(Inquiry::new(baud, now), baud, machine, now);
        bench.to_sensor = Box::new(|_| Vec::new());
        let took = bench.finish(20_000 * MILLIS);
        let report = bench.talk.report();
        assert_eq!((report.baud, report.answers(), report.streams), (Some(baud), false, true), "{took}");
    }
}
