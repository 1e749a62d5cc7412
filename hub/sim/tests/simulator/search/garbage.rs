//! Bytes that no scanner has sent never end a search.

use scanhub_drivers::line::{Output, Protocol as _};
use scanhub_drivers::search::{PortKind, Search};
use scanhub_schema::{MILLIS, Nanos};

/// Passes `bytes` to a search on `port`, in reads of at most `most` bytes, until `seconds` have passed.
fn feed(
    port: PortKind,
    seed: u64,
    most: usize,
    seconds: u64,
    mut bytes: impl FnMut(&mut fastrand::Rng) -> u8,
) -> usize {
    let mut random = fastrand::Rng::with_seed(seed);
    let mut search = Search::new(port, None, 0);
    let (mut now, mut count): (Nanos, usize) = (0, 0);
    while now < seconds * 1_000 * MILLIS {
        let until = loop {
            match search.poll_output() {
                Output::SetRate(_) => {}
                Output::Transmit { not_before, .. } => {
                    now = now.max(not_before);
                    search.transmitted(now);
                }
                Output::Wait { until } => break until,
                output => panic!("{output:?}"),
            }
        };
        assert_eq!(search.found(), None, "in garbage, seed {seed}");
        now = (now + random.u64(..5 * MILLIS)).min(until);
        let len = random.usize(..=most).min(search.spare().len());
        search.spare()[..len].fill_with(|| bytes(&mut random));
        search.commit(now, len);
        count += len;
        if len == 0 && now >= until {
            search.handle_timeout(now);
        }
    }
    count
}

#[test]
fn garbage_is_not_a_scanner() {
    let mut count = 0;
    for port in [PortKind::Serial, PortKind::Server, PortKind::Recording] {
        for seed in 0..6 {
            count += feed(port, seed, 200, 20, |random| random.u8(..));
            // Bytes that begin telegrams and packets of the families, among others.
            let heads = [0x02, 0x80, 0x81, 0xB0, 0xBA, 0x06, 0x54, 0x2C, 0xA5, 0x5A, 0x14, 0x04, 0x00, 0xFF];
            count += feed(port, seed, 200, 20, |random| heads[random.usize(..heads.len())]);
            count +=
                feed(port, seed, 200, 20, |random| if random.u8(..4) > 0 { 0x00 } else { random.u8(..) });
            for byte in [0x00, 0xFF, 0x02, 0x54, 0xA5] {
                count += feed(port, seed, 200, 2, |_| byte);
            }
        }
    }
    println!("{count} bytes");
}
