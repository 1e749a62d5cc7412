//! The figure of a start: every rate, idle, streaming or left in installation mode, to the first scan.

use scanhub_drivers::lms::variant::Baud;
use scanhub_schema::MILLIS;
use scanhub_sim::machine::{Settings, Start};
use scanhub_sim::operating::Operating;

use super::bench::{Bench, sensor_with};

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
