//! Measures how long a receiver takes to check the datagrams of a scan, with the checksum alone and with the MAC, too:
//! `cargo run --release -p scanhub-network --example mac_cost`. A scan of 361 beams fits into one datagram. A scan of
//! 3,240 beams with exact angles is sent in parts. The example prints the times of the fastest of many runs.
#![allow(clippy::print_stdout)]

use std::hint::black_box;
use std::time::Instant;

use scanhub_network::lan::Key;
use scanhub_schema::datagram::{Datagram, HEADER_LEN, Head, MAC_LEN, MTU_SAFE};

/// Number of scans that are checked in each run.
const SCAN_COUNT: u32 = 200;
/// Number of runs. Only the fastest one is printed.
const RUN_COUNT: usize = 40;

/// Returns the datagrams that a payload of `len` bytes is sent in, each with a MAC.
fn datagrams(key: &Key, len: usize) -> Vec<Vec<u8>> {
    let room = MTU_SAFE - HEADER_LEN - MAC_LEN;
    let payload: Vec<u8> = (0..len).map(|at| (at * 7) as u8).collect();
    let parts = len.div_ceil(room) as u8;
    let part = |(part, payload): (usize, &[u8])| {
        let mut buffer = [0; MTU_SAFE];
        buffer[HEADER_LEN..HEADER_LEN + payload.len()].copy_from_slice(payload);
        let head = Head { topic: 2, revision: 1, part: part as u8, parts, ..Head::default() };
        head.seal_with(&mut buffer, payload.len(), |covered| key.mac(covered)).expect("room").to_vec()
    };
    payload.chunks(room).enumerate().map(part).collect()
}

/// Returns the shortest time that `work` takes for all datagrams of a scan, in ns.
fn min_ns(datagrams: &[Vec<u8>], work: impl Fn(&[u8])) -> f64 {
    let run = |_| {
        let begin = Instant::now();
        for _ in 0..SCAN_COUNT {
            datagrams.iter().for_each(|bytes| work(black_box(bytes)));
        }
        begin.elapsed().as_nanos() as f64 / f64::from(SCAN_COUNT)
    };
    (0..RUN_COUNT).map(run).fold(f64::INFINITY, f64::min)
}

fn main() {
    let key = Key::new(&[7; Key::LEN]);
    for (beams, of_beam) in [(361, 3), (3_240, 7)] {
        let datagrams = datagrams(&key, 64 + beams * of_beam);
        let checksum = min_ns(&datagrams, |bytes| {
            black_box(Datagram::read(bytes).is_ok());
        });
        let both = min_ns(&datagrams, |bytes| {
            let mac = Datagram::read(bytes).ok().and_then(|datagram| datagram.mac);
            assert!(mac.is_some_and(|mac| key.is_of(bytes, mac)));
        });
        let (count, bytes) = (datagrams.len(), datagrams.iter().map(Vec::len).sum::<usize>());
        let of = |ns: f64| ns / count as f64;
        println!(
            "{beams} beams, {count} datagrams, {bytes} bytes: checksum {:.0} ns, with MAC {:.0} ns a datagram; {:.1} and {:.1} us a scan",
            of(checksum),
            of(both),
            checksum / 1e3,
            both / 1e3
        );
    }
}
