//! A line that loses bytes in bursts, as the paper's did: what is intact is delivered, in order and bit for bit.

use scanhub_drivers::line::Session as _;
use scanhub_drivers::lms::variant::Baud;
use scanhub_schema::{MILLIS, Nanos};
use scanhub_sim::fault::{Faults, Loss};

use super::bench::{Bench, sensor};

/// Runs with these losses for some time, and holds what came against what was sent intact.
fn delivered(faults: Faults, seed: u64, span: Nanos) -> (usize, usize) {
    let mut bench = Bench::new(sensor(Baud::B500000), 0);
    bench.until("streaming", 3_000 * MILLIS, Bench::is_streaming);
    bench.run(500 * MILLIS);
    let begun = bench.now;
    let mut loss = Loss::new(faults, seed);
    bench.to_host = Box::new(move |at, mut bytes| {
        if at < begun + span {
            loss.apply(&mut bytes);
        }
        bytes
    });
    bench.run(span);
    // What was held back by damage is out after some whole ones, and the last one after a pause.
    bench.run(200 * MILLIS);
    bench.to_host = Box::new(|_, _| Vec::new());
    bench.run(60 * MILLIS);
    let (intact, scans) = (bench.intact_scans(begun), bench.received_scans(begun));
    assert!(scans == intact, "{} received, {} intact: {bench}", scans.len(), intact.len());
    let sent = bench.sent.iter().filter(|sent| sent.at > begun && !sent.is_reply).count();
    assert_eq!(bench.session.account().resyncs, 0);
    (sent, intact.len())
}

#[test]
fn the_losses_of_the_paper_cost_only_what_they_damage() {
    for seed in 1..=4 {
        let (sent, intact) =
            delivered(Faults { loss: 0.00135, burst: 1.89, ..Faults::default() }, seed, 30_000 * MILLIS);
        let share = 1.0 - intact as f64 / sent as f64;
        assert!(sent > 1100 && (0.33..0.47).contains(&share), "{share} of {sent} were damaged");
    }
}

#[test]
fn long_bursts_and_single_bytes_too() {
    for (loss, burst) in [(0.0005, 1.0), (0.002, 3.34), (0.02, 200.0), (0.1, 1000.0)] {
        let (sent, intact) = delivered(Faults { loss, burst, ..Faults::default() }, 9, 20_000 * MILLIS);
        assert!(intact > 0 && intact < sent, "{loss} {burst}: {intact} of {sent}");
    }
}
