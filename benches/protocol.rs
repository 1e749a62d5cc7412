//! CPU time for a telegram of 361 beams between the port and shared memory: framing, checksum, and decoding. The
//! targets are 2 us for framing and checksum together, and 0.3 us for decoding.

#![allow(missing_docs)] // The macros of criterion create public functions.

use criterion::{Criterion, criterion_group, criterion_main};
use fastrand::Rng;
use scanhub_drivers::lms::framer::{Framer, FramerEvent};
use scanhub_drivers::lms::header::ExpectedHeaders;
use scanhub_drivers::lms::measured::{self, MeasuredValues};
use scanhub_drivers::lms::telegram::{Telegram, crc};
use scanhub_drivers::lms::variant::{Mode, Unit};
use scanhub_schema::{ArrayFlags, Scan};
use std::hint::black_box;

/// Lengths of the reads for one telegram in the hub, which reads most of a telegram late.
const READ_LENS: [usize; 3] = [16, 560, 156];
/// Lengths of the reads for one telegram from a UART, which delivers 16 bytes at a time.
const UART_READ_LENS: [usize; 46] = {
    let mut pieces = [16; 46];
    pieces[45] = 732 - 45 * 16;
    pieces
};

/// Returns telegrams of a room with noise, which are all different. No telegram ends with a start byte, because the
/// framer would hold such a telegram.
fn telegrams() -> Vec<Vec<u8>> {
    let mut rng = Rng::with_seed(1);
    let mut scan = || {
        let words: [u16; 361] = std::array::from_fn(|i| 2000 + 10 * (i as u16 % 90) + rng.u16(..16));
        measured::encode(0, Unit::Mm, &words, 0x10).bytes().to_vec()
    };
    std::iter::repeat_with(&mut scan).filter(|bytes| bytes.last() != Some(&0x02)).take(64).collect()
}

fn framing(c: &mut Criterion) {
    let telegrams = telegrams();
    let mut group = c.benchmark_group("telegram of 732 bytes");
    for (name, reads) in
        [("framer and crc, 3 reads", &READ_LENS[..]), ("framer and crc, 46 reads", &UART_READ_LENS[..])]
    {
        let mut framer = Framer::default();
        let header = telegrams[0][..7].try_into().expect("a telegram has a header");
        framer.expect(ExpectedHeaders::Stream { header, reply: None });
        let mut next = telegrams.iter().cycle();
        group.bench_function(name, |b| {
            b.iter(|| {
                let mut bytes = next.next().expect("an endless sequence").as_slice();
                let mut found = 0;
                for &len in reads {
                    let (read, rest) = bytes.split_at(len);
                    framer.read_buffer()[..len].copy_from_slice(read);
                    framer.commit(len);
                    while let Some(FramerEvent::Telegram(framed)) = framer.poll() {
                        black_box(framed.telegram.bytes());
                        found += 1;
                    }
                    bytes = rest;
                }
                assert_eq!(found, 1);
            });
        });
    }
    let mut next = telegrams.iter().cycle();
    group.bench_function("crc", |b| {
        b.iter(|| crc(black_box(&next.next().expect("an endless sequence")[..730])));
    });
    group.finish();
}

fn decoding(c: &mut Criterion) {
    let telegrams = telegrams();
    let telegram = Telegram::check(&telegrams[0]).expect("a telegram");
    let mut scan = Scan::zeroed(Scan::len(361, ArrayFlags::UPPER));
    c.bench_function("decode of 361 beams", |b| {
        b.iter(|| {
            let measured = MeasuredValues::decode(black_box(telegram)).expect("a scan");
            measured.scan(black_box(Mode(1))).write(&mut scan);
            black_box(&mut scan);
        });
    });
}

criterion_group!(benches, framing, decoding);
criterion_main!(benches);
