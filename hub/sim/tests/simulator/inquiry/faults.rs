//! The fault table against conversations that come to an end: they end, what they tell is true, and a change writes no
//! more often than it may and never unnoticed.

use scanhub_drivers::lms::Inquiry;
use scanhub_drivers::lms::variant::Baud;
use scanhub_lms_configure::Change;
use scanhub_schema::MILLIS;
use scanhub_sim::device::Device as _;
use scanhub_sim::fault::Faults;
use scanhub_sim::machine::{LmsSimulator, ProtocolQuirks};
use scanhub_sim::wire::LineModel;

use super::bench::{Bench, make_stream, sensor};
use super::change::{again, change, other_values, plan};

/// What goes wrong, and how many of 8 conversations must come to what they are for: an inquiry, a change.
const SCENES: &[(&str, [usize; 2])] = &[
    ("loss=0.001,burst=3", [7, 7]),
    ("flip=0.001", [7, 7]),
    ("insert=0.001,insert_burst=3", [7, 7]),
    ("double=0.001", [7, 7]),
    ("repeat=0.5", [7, 7]),
    ("truncate=0.2", [7, 6]),
    ("length=0.2", [7, 6]),
    ("abort=0.3", [7, 6]),
    ("flood=300,flood_every=0.5", [5, 4]),
    ("wall=300,wall_every=0.5", [5, 2]),
    ("silence=0.2,silence_at=0.3,silence_every=1", [7, 7]),
    ("stall=0.3,stall_at=0.2,stall_every=2", [7, 7]),
    ("delay=0.02", [7, 7]),
    ("power_every=2", [2, 0]),
    ("unplug=0.3,unplug_at=0.2,unplug_every=2", [7, 7]),
    ("late_mode=2.5,late_write=6", [7, 6]),
    ("late=0.3,twice=0.3", [7, 7]),
    ("late_ack=0.052,strict=1", [7, 7]),
    ("overlook=0.2,nak=0.1", [7, 7]),
];

/// The sensor of `seed`, idle or streaming, and when it is.
fn any_sensor(seed: u64) -> (Baud, LmsSimulator, u64, bool) {
    let baud = Baud::ALL[seed as usize % 4];
    let mut machine = sensor(baud);
    let is_streaming = seed % 8 >= 4;
    let now = if is_streaming { make_stream(&mut machine) } else { 0 };
    (baud, machine, now, is_streaming)
}

/// `bench` with `faults`, the sensor's own and the line's.
fn troubled<C>(mut bench: Bench<C>, faults: &Faults, seed: u64) -> Bench<C> {
    bench.machine.set_quirks(faults.quirks());
    let fresh = LineModel::new(faults, seed);
    bench.wire = fresh;
    bench
}

#[test]
fn an_inquiry_tells_what_is_so() {
    for (text, [least, _]) in SCENES {
        let faults: Faults = text.parse().expect("faults");
        let mut found = 0;
        for seed in 0..SEEDS {
            let (baud, machine, now, is_streaming) = any_sensor(seed);
            let inquiry = Bench::new(Inquiry::new(Baud::B500000, now), Baud::B500000, machine, now);
            let mut bench = troubled(inquiry, &faults, seed);
            bench.finish(60_000 * MILLIS);
            let report = bench.talk.report();
            if let Some(status) = report.status() {
                found += 1;
                // The power may have gone since.
                if faults.power_every == 0.0 {
                    let mode = if is_streaming { 0x24 } else { 0x25 };
                    assert_eq!((report.baud, status.operating_mode()), (Some(baud), mode), "{text}, {seed}");
                }
            }
            if let Some(kind) = report.kind() {
                assert_eq!(kind, b"LMS200;301063;V02.30", "{text}, {seed}");
            }
            let (tally, open) = bench.talk.tally();
            let known = tally.in_telegrams + tally.acknowledge + tally.discarded + open as u64;
            assert_eq!((tally.read, bench.machine.eeprom_writes()), (known, 0), "{text}, {seed}");
        }
        println!("{text}: {found} of {SEEDS} found");
        assert!(found >= *least, "{text}: {found} of {SEEDS} found");
    }
}

#[test]
fn a_change_knows_what_it_did() {
    for (text, [_, least]) in SCENES {
        let faults: Faults = text.parse().expect("faults");
        let mut done = 0;
        for seed in 0..SEEDS {
            let (_, machine, now, _) = any_sensor(seed);
            let (mut plan, machine, now) = plan(machine, now);
            other_values(&mut plan);
            let mut bench: Bench<Change> = troubled(change(plan, machine, now), &faults, seed);
            bench.finish(300_000 * MILLIS);
            let outcome = *bench.talk.outcome();
            let writes = bench.machine.eeprom_writes();
            assert!(writes <= 3 && (outcome.written || writes == 0), "{text}, {seed}: {writes} writes");
            bench.wire.set_faults(&Faults::default(), 0);
            bench.machine.set_quirks(ProtocolQuirks::default());
            bench.overhear(10_000 * MILLIS);
            let (found, _, _) = again(bench);
            if let Some(kept) = outcome.configuration {
                assert_eq!(found.old, kept, "{text}, {seed}: {outcome:?}");
            }
            if outcome.failed.is_none() {
                done += 1;
                assert_eq!((found.old, outcome.configuration), (plan.new, Some(plan.new)), "{text}, {seed}");
            }
            if outcome.operating_mode.is_some() {
                assert_ne!(
                    found.operating_mode, 0x00,
                    "left in installation mode: {text}, {seed}: {outcome:?}"
                );
            }
        }
        println!("{text}: {done} of {SEEDS} done");
        assert!(done >= *least, "{text}: {done} of {SEEDS} done");
    }
}

/// Each rate, idle and streaming.
const SEEDS: u64 = 8;
