//! Tests of the framer: first single situations, then property tests. The property tests use any contents, any damage,
//! and any division of the bytes into reads.

use proptest::prelude::*;
use scanhub_drivers::line::suspect;
use scanhub_drivers::lms;
use scanhub_drivers::lms::framer::{Framer, FramerCounters, FramerEvent, SUFFIX_HOLD_TIME, VETO_HOLD_TIME};
use scanhub_drivers::lms::header::{ExpectedHeaders, Reject, State};
use scanhub_drivers::lms::measured;
use scanhub_drivers::lms::reply;
use scanhub_drivers::lms::variant::Unit;

const STREAM_HEADER: [u8; 7] = [0x02, 0x80, 0xD6, 0x02, 0xB0, 0x69, 0x41];
const STREAM_EXPECT: ExpectedHeaders = ExpectedHeaders::Stream { header: STREAM_HEADER, reply: None };

fn scan(value: impl Fn(usize) -> u16) -> Vec<u8> {
    let words: Vec<u16> = (0..361).map(value).collect();
    measured::encode(0, Unit::Mm, &words, 0x10).bytes().to_vec()
}

fn framer(expect: ExpectedHeaders) -> Framer {
    let mut framer = Framer::default();
    framer.expect(expect);
    framer
}

/// Passes `bytes` to the framer in pieces of at most `max_piece_len` bytes. Returns the telegrams that the framer
/// found, with their suspect reasons.
fn feed(framer: &mut Framer, mut bytes: &[u8], max_piece_len: usize) -> Vec<(Vec<u8>, u8)> {
    let mut telegrams = Vec::new();
    while !bytes.is_empty() {
        let spare = framer.read_buffer();
        let n = bytes.len().min(max_piece_len).min(spare.len());
        assert!(n > 0, "a framer that was polled has room");
        spare[..n].copy_from_slice(&bytes[..n]);
        framer.commit(n);
        bytes = &bytes[n..];
        drain(framer, &mut telegrams);
    }
    telegrams
}

fn drain(framer: &mut Framer, telegrams: &mut Vec<(Vec<u8>, u8)>) {
    while let Some(found) = framer.poll() {
        if let FramerEvent::Telegram(framed) = found {
            telegrams.push((framed.telegram.bytes().to_vec(), framed.reasons));
        }
    }
    assert_bytes_conserved(framer);
}

fn assert_bytes_conserved(framer: &Framer) {
    let FramerCounters { read, in_telegrams, acknowledge, discarded, .. } = *framer.counters();
    assert_eq!(read, in_telegrams + acknowledge + discarded + framer.buffered() as u64);
}

#[test]
fn framer_visits_six_states_in_order() {
    let mut framer = framer(STREAM_EXPECT);
    let mut states = vec![framer.state()];
    for byte in scan(|_| 3000) {
        feed(&mut framer, &[byte], 1);
        if states.last() != Some(&framer.state()) {
            states.push(framer.state());
        }
    }
    use State::*;
    assert_eq!(states, [Stx, Address, LengthLow, LengthHigh, Body, Crc, Stx]);
}

#[test]
fn telegram_after_a_shortened_telegram_is_found() {
    for lost in 1..=20 {
        let mut bytes = scan(|i| 2000 + i as u16);
        bytes.drain(300..300 + lost);
        let intact = scan(|i| 4000 + i as u16);
        bytes.extend(&intact);
        let mut framer = framer(STREAM_EXPECT);
        assert_eq!(feed(&mut framer, &bytes, 16), [(intact, 0)], "{lost} bytes lost");
        assert_eq!(framer.counters().discarded, 732 - lost as u64);
    }
}

/// Returns a damaged telegram whose checksum is valid by chance. Its last byte is the first byte of the next telegram.
fn false_frame_that_ends_with(next: &[u8]) -> Vec<u8> {
    // The last two bytes are the checksum. Search for a scan in which the high byte of the checksum is the STX of the
    // next telegram.
    (0..=u16::MAX)
        .map(|seed| scan(|i| if i == 7 { seed & 0x1FFF } else { 100 + (seed >> 13) }))
        .find(|bytes| bytes[731] == next[0])
        .expect("one in 256 has it")
}

#[test]
fn frame_ending_in_stx_waits_for_the_next_byte() {
    let next = scan(|i| 4000 + i as u16);
    let ends_with_stx = false_frame_that_ends_with(&next);
    // The next byte refutes the header.
    let mut framer = framer(STREAM_EXPECT);
    assert_eq!(feed(&mut framer, &ends_with_stx, 16), []);
    assert_eq!(framer.hold_time(), Some(SUFFIX_HOLD_TIME));
    assert_eq!(feed(&mut framer, &next[..1], 1), [(ends_with_stx.clone(), 0)]);
    // No byte follows, so the framer releases the frame after the idle time and not earlier.
    let mut framer = self::framer(STREAM_EXPECT);
    feed(&mut framer, &ends_with_stx, 999);
    framer.release(SUFFIX_HOLD_TIME - 1);
    assert!(framer.poll().is_none());
    framer.release(SUFFIX_HOLD_TIME);
    let mut late = Vec::new();
    drain(&mut framer, &mut late);
    assert_eq!(late, [(ends_with_stx.clone(), 0)]);
    // The start byte belongs to the next telegram, which is delivered instead.
    let mut framer = self::framer(STREAM_EXPECT);
    let mut bytes = ends_with_stx;
    bytes.extend(&next[1..]);
    assert_eq!(feed(&mut framer, &bytes, 16), [(next, 0)]);
    assert_eq!(framer.counters().rejected[Reject::Vetoed as usize], 1);
}

#[test]
fn frame_is_held_until_the_inner_header_fails() {
    // The values of this scan look like a header. A scan of a real room may have these values, too.
    let spelled = scan(|i| match i {
        200 => 0x8002,
        201 => 0x02D6,
        202 => 0x69B0,
        203 => 0x1041,
        _ => 3000,
    });
    let mut framer = framer(STREAM_EXPECT);
    assert_eq!(feed(&mut framer, &spelled, 16), []);
    assert_eq!(framer.hold_time(), Some(VETO_HOLD_TIME));
    framer.release(VETO_HOLD_TIME - 1);
    assert!(framer.poll().is_none());
    framer.release(VETO_HOLD_TIME);
    let mut late = Vec::new();
    drain(&mut framer, &mut late);
    assert_eq!(late, [(spelled.clone(), suspect::HEADER_INSIDE)]);
    // If the next telegram arrives completely, it refutes the header, because the false telegram would overlap it.
    let next = scan(|_| 4000);
    let mut framer = self::framer(STREAM_EXPECT);
    let mut bytes = spelled.clone();
    bytes.extend(&next);
    assert_eq!(feed(&mut framer, &bytes, 16), [(spelled, suspect::HEADER_INSIDE), (next, 0)]);
    assert_eq!(framer.counters().held, 1);
}

#[test]
fn scan_interrupted_by_reply_counts_as_aborted() {
    let reply = reply::type_reply(0, b"LMS200;S18063;V02.19 ", 0x10);
    let next = scan(|_| 4000);
    let mut bytes = scan(|_| 3000)[..15].to_vec();
    bytes.push(0x06);
    bytes.extend(reply.bytes());
    bytes.extend(&next);
    let mut framer = framer(ExpectedHeaders::Stream { header: STREAM_HEADER, reply: Some(0xBA) });
    framer.expect_acknowledge(true);
    assert_eq!(feed(&mut framer, &bytes, 16), [(reply.bytes().to_vec(), 0), (next, 0)]);
    let tally = framer.counters();
    assert_eq!((tally.aborted, tally.acknowledge, tally.discarded), (1, 1, 15));
    // The high byte of the telegram's length is also a start byte.
    let mut rejected = [0; Reject::COUNT];
    rejected[Reject::Address as usize] = 1;
    assert_eq!(tally.rejected, rejected);
}

#[test]
fn acknowledgements_count_only_while_they_are_awaited() {
    let mut framer = framer(ExpectedHeaders::Anything);
    framer.expect_acknowledge(true);
    framer.read_buffer()[..3].copy_from_slice(&[0x06, 0x33, 0x15]);
    framer.commit(3);
    assert!(matches!(framer.poll(), Some(FramerEvent::Ack)));
    assert!(matches!(framer.poll(), Some(FramerEvent::Nak)));
    framer.expect_acknowledge(false);
    feed(&mut framer, &[0x06], 1);
    assert_eq!((framer.counters().acknowledge, framer.counters().discarded), (2, 2));
}

#[test]
fn every_rejected_frame_is_counted_by_reason() {
    let mut framer = framer(STREAM_EXPECT);
    feed(&mut framer, &[0x02, 0x02, 0x80, 0xD7, 0x02, 0x02, 0x80, 0xD6, 0x02, 0xB1], 3);
    feed(&mut framer, &[0x02, 0x80, 0xD6, 0x02, 0xB0, 0x69, 0x40, 0, 0, 0, 0], 3);
    let mut wrong = scan(|_| 3000);
    wrong[400] ^= 1;
    feed(&mut framer, &wrong, 100);
    let mut expected = [0; Reject::COUNT];
    // Five start bytes are rejected because the next byte is not the address: the first byte of 02 02, and the high
    // byte of a length in D7 02 02, in D6 02 B1, and twice in D6 02 B0.
    expected[Reject::Length as usize] = 1;
    expected[Reject::Command as usize] = 1;
    expected[Reject::Count as usize] = 1;
    expected[Reject::Crc as usize] = 1;
    expected[Reject::Address as usize] = framer.counters().rejected[Reject::Address as usize];
    assert_eq!(framer.counters().rejected, expected);
    assert_eq!(expected[Reject::Address as usize], 5);
}

#[test]
fn flood_of_headers_is_bounded() {
    let mut framer = framer(ExpectedHeaders::Anything);
    let flood: Vec<u8> = [0x02, 0x80, 0x03].into_iter().cycle().take(100_000).collect();
    for piece in [1, 7, 814, 1628] {
        assert_eq!(feed(&mut framer, &flood, piece), []);
    }
    let good = scan(|_| 3000);
    // Headers of the flood announce up to 814 bytes. The framer must still find the telegram after them.
    assert_eq!(feed(&mut framer, &good, 16).len(), 1);
}

#[test]
fn overlapping_frames_do_not_fill_the_buffer() {
    // These frames have the maximum length. Each has a valid checksum, and each begins eight bytes before the end of
    // the previous frame.
    let header = [0x02, 0x80, 0x28, 0x03, 0xB1];
    let frame = |begins_with: &[u8]| {
        let mut writer = lms::telegram::Writer::new(0x80, 0xB1).slice(begins_with);
        for _ in 0..806 - begins_with.len() - header.len() {
            writer = writer.byte(0x33);
        }
        writer.slice(&header).byte(0x10).finish().bytes().to_vec()
    };
    let mut bytes = frame(&[]);
    for _ in 0..3 {
        let shared = bytes.len() - 8;
        let next = frame(&bytes[shared + 5..]);
        assert_eq!(next[..8], bytes[shared..]);
        bytes.extend(&next[8..]);
    }
    for piece in [1, 16, 1628] {
        let mut framer = framer(ExpectedHeaders::Anything);
        feed(&mut framer, &bytes, piece);
        assert!(!framer.read_buffer().is_empty());
    }
}

prop_compose! {
    fn scan_content()(kind in 0..4, seed in any::<u64>()) -> Vec<u8> {
        let mut state = seed | 1;
        let mut random = move || {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            state
        };
        let words: Vec<u16> = (0..361).map(|i| match kind {
            0 => 1000 + i + (random() % 8) as u16,
            1 => 8191,
            2 => 0x0280,
            _ => random() as u16,
        }).collect();
        measured::encode(0, Unit::Mm, &words, 0x10).bytes().to_vec()
    }
}

prop_compose! {
    /// Generates telegrams, some of them with lost bytes. Returns the bytes and the intact telegrams.
    fn damaged_stream()(
        scans in prop::collection::vec((scan_content(), prop::option::of((0usize..732, 1usize..12))), 1..8),
    ) -> (Vec<u8>, Vec<Vec<u8>>) {
        let (mut bytes, mut intact) = (Vec::new(), Vec::new());
        for (mut scan, hole) in scans {
            match hole {
                Some((at, len)) => { scan.drain(at..(at + len).min(732)); }
                None => intact.push(scan.clone()),
            }
            bytes.extend(scan);
        }
        (bytes, intact)
    }
}

proptest! {
    #[test]
    fn result_does_not_depend_on_read_boundaries((bytes, _) in damaged_stream(), piece in 1usize..1628, any in any::<bool>()) {
        let expect = if any { ExpectedHeaders::Anything } else { STREAM_EXPECT };
        let (mut whole, mut cut) = (framer(expect), framer(expect));
        prop_assert_eq!(feed(&mut whole, &bytes, 1), feed(&mut cut, &bytes, piece));
    }

    #[test]
    fn every_intact_telegram_is_found_in_order((mut bytes, intact) in damaged_stream(), piece in 1usize..1628) {
        let last = scan(|_| 3000);
        bytes.extend(&last);
        let mut framer = framer(STREAM_EXPECT);
        let mut found: Vec<_> = feed(&mut framer, &bytes, piece).into_iter().map(|(bytes, _)| bytes).collect();
        framer.release(VETO_HOLD_TIME);
        let mut late = Vec::new();
        drain(&mut framer, &mut late);
        found.extend(late.into_iter().map(|(bytes, _)| bytes));
        let mut expected = intact.iter().chain([&last]).peekable();
        for telegram in &found {
            expected.next_if(|intact| *intact == telegram);
        }
        prop_assert!(expected.next().is_none());
    }

    #[test]
    fn garbage_is_discarded_and_counted(bytes in prop::collection::vec(prop_oneof![Just(0x02u8), Just(0x80), any::<u8>()], 0..5000)) {
        for expect in [ExpectedHeaders::Anything, STREAM_EXPECT] {
            let mut framer = framer(expect);
            feed(&mut framer, &bytes, 16);
            framer.clear();
            assert_bytes_conserved(&framer);
            prop_assert_eq!(framer.buffered(), 0);
        }
    }
}
