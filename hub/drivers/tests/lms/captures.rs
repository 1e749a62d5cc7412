//! Tests of the framer on recordings of real scanners. The framer must find every telegram at its position, bit by bit,
//! and nothing else. The framer must have a reason for every rejected start byte. The recordings are not part of this
//! project. Without them, the tests pass without a check.

#[path = "../../../../tests/testkit/skip.rs"]
mod skip;

use scanhub_drivers::lms::framer::{Framer, FramerCounters, FramerEvent, VETO_HOLD_TIME};
use scanhub_drivers::lms::header::{ExpectedHeaders, StreamHeader};
use scanhub_drivers::lms::measured::MEASURED;
use scanhub_drivers::lms::telegram::{ACK, STX};
use skip::skip;
use std::path::PathBuf;

/// Returns the content of a file in `$SCANHUB_DATA/captures` or `../shared/data/captures`, or `None` if the file does
/// not exist.
fn capture(name: &str) -> Option<Vec<u8>> {
    let default_directory = || PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data");
    let path = std::env::var_os("SCANHUB_DATA")
        .map_or_else(default_directory, PathBuf::from)
        .join("captures")
        .join(name);
    match std::fs::read(&path) {
        Ok(bytes) => Some(bytes),
        Err(error) => {
            skip("recordings", format!("{}: {error}", path.display()));
            None
        }
    }
}

/// Returns the offset and the length of each telegram in the table of a recording. `columns` are the columns of offset
/// and length. If there is no column for the length, every length is `every_len`.
fn telegram_ranges(csv: &[u8], columns: (usize, Option<usize>), every_len: usize) -> Vec<(usize, usize)> {
    let text = std::str::from_utf8(csv).expect("a table is text");
    let number = |line: &str, column: usize| line.split(',').nth(column).and_then(|n| n.parse().ok());
    text.lines()
        .skip(1)
        .map(|line| {
            let len = columns.1.map_or(Some(every_len), |column| number(line, column));
            (number(line, columns.0).expect("an offset"), len.expect("a length"))
        })
        .collect()
}

/// A framer, the bytes that it has received, and its results.
#[derive(Default)]
struct FramedCapture {
    framer: Framer,
    /// All bytes so far.
    bytes: Vec<u8>,
    /// Offset and length of each telegram found.
    found: Vec<(usize, usize)>,
    acknowledged: u64,
    suspect: usize,
}

impl FramedCapture {
    fn feed(&mut self, mut bytes: &[u8], max_piece_len: usize) {
        self.bytes.extend(bytes);
        while !bytes.is_empty() {
            let spare = self.framer.read_buffer();
            let n = bytes.len().min(max_piece_len).min(spare.len());
            spare[..n].copy_from_slice(&bytes[..n]);
            self.framer.commit(n);
            bytes = &bytes[n..];
            self.drain();
        }
    }

    fn drain(&mut self) {
        while let Some(found) = self.framer.poll() {
            match found {
                FramerEvent::Telegram(framed) => {
                    let (at, len) = (framed.offset as usize, framed.telegram.bytes().len());
                    assert_eq!(
                        framed.telegram.bytes(),
                        &self.bytes[at..at + len],
                        "other bytes than on the line"
                    );
                    self.found.push((at, len));
                    self.suspect += usize::from(framed.reasons != 0);
                }
                FramerEvent::Ack | FramerEvent::Nak => self.acknowledged += 1,
            }
        }
        let FramerCounters { read, in_telegrams, acknowledge, discarded, .. } = *self.framer.counters();
        assert_eq!(read, in_telegrams + acknowledge + discarded + self.framer.buffered() as u64);
    }

    /// Handles a silence and then the end of the recording. Discards undecided bytes and prints a line of the table.
    fn end(&mut self, legend: &str) -> FramerCounters {
        self.framer.release(VETO_HOLD_TIME);
        self.drain();
        self.framer.clear();
        self.drain();
        let tally = *self.framer.counters();
        let [address, length, command, count, crc, vetoed, superseded] = tally.rejected;
        eprintln!(
            "{legend:<44} {:>7} bytes {:>4} telegrams {:>3} suspect {:>3} ack {:>5} discarded | address {address} \
             length {length} command {command} count {count} crc {crc} vetoed {vetoed} superseded {superseded} \
             aborted {}",
            tally.read, tally.telegrams, self.suspect, tally.acknowledge, tally.discarded, tally.aborted
        );
        assert_eq!(tally.read, self.bytes.len() as u64);
        self.assert_every_start_byte_has_a_reason(&tally);
        tally
    }

    /// Checks that each start byte outside of telegrams was rejected for exactly one reason, or began an aborted scan.
    fn assert_every_start_byte_has_a_reason(&self, tally: &FramerCounters) {
        let inside = |at: usize| self.found.iter().any(|&(start, len)| (start..start + len).contains(&at));
        let starts = (0..self.bytes.len()).filter(|&at| self.bytes[at] == STX && !inside(at)).count();
        assert_eq!(starts as u64, tally.rejected.iter().sum::<u64>() + tally.aborted);
    }
}

fn header_of(scan: &[u8]) -> StreamHeader {
    scan[..7].try_into().expect("a telegram has seven bytes")
}

#[test]
fn finds_all_telegrams_without_knowing_the_mode() {
    let (Some(bytes), Some(csv)) = (capture("lms200_38400.bin"), capture("lms200_38400.csv")) else { return };
    let places = telegram_ranges(&csv, (2, Some(3)), 0);
    assert_eq!(places.len(), 427);
    for awaits in [false, true] {
        for piece in [1, 16, 333, 1628] {
            let mut line = FramedCapture::default();
            line.framer.expect_acknowledge(awaits);
            line.feed(&bytes, piece);
            let tally = line.end(&format!("lms200_38400, anything, ack {awaits}, by {piece}"));
            assert_eq!(line.found, places);
            assert_eq!((tally.discarded, tally.acknowledge, line.suspect), (0, 0, 0));
        }
    }
}

#[test]
fn finds_telegrams_of_seven_captured_sessions() {
    let (Some(bytes), Some(csv)) = (capture("lms200_38400.bin"), capture("lms200_38400.csv")) else { return };
    let places = telegram_ranges(&csv, (2, Some(3)), 0);
    let command = |&(at, _): &(usize, usize)| bytes[at + 4];
    let mut line = FramedCapture::default();
    let (mut stream, mut expected) = (None, Vec::new());
    for (i, &(at, len)) in places.iter().enumerate() {
        let telegram = &bytes[at..at + len];
        if telegram[4] == MEASURED {
            stream = Some(header_of(telegram));
            line.framer.expect_acknowledge(false);
        } else {
            // The recording does not contain the ACK before each reply.
            line.framer.expect_acknowledge(true);
            line.feed(&[ACK], 1);
        }
        expected.push((line.bytes.len(), len));
        // The acceptable headers change in the middle of a scan while a request is sent, or after a reply.
        let open = places.get(i + 1).map(command).filter(|&command| command != MEASURED);
        let (before, after) = telegram.split_at(if telegram[4] == MEASURED { len / 2 } else { len });
        line.feed(before, 16);
        if let Some(header) = stream {
            line.framer.expect(ExpectedHeaders::Stream { header, reply: open });
            line.framer.expect_acknowledge(open.is_some() || telegram[4] != MEASURED);
        }
        line.feed(after, 16);
    }
    let tally = line.end("lms200_38400, as a session, with ack");
    let replies = places.iter().filter(|place| command(place) != MEASURED).count() as u64;
    assert_eq!(line.found, expected);
    assert_eq!((tally.acknowledge, tally.discarded, line.suspect), (replies, 0, 0));
}

#[test]
fn finds_captured_scans_with_reflector_levels() {
    let (Some(bytes), Some(csv)) =
        (capture("reflector_levels_cm_18s.bin"), capture("reflector_levels_cm_18s.csv"))
    else {
        return;
    };
    let places = telegram_ranges(&csv, (2, None), 732);
    assert_eq!(places.len(), 675);
    for expect in
        [ExpectedHeaders::Anything, ExpectedHeaders::Stream { header: header_of(&bytes), reply: None }]
    {
        for piece in [1, 16, 560] {
            let mut line = FramedCapture::default();
            line.framer.expect(expect);
            line.feed(&bytes, piece);
            let known = if expect == ExpectedHeaders::Anything { "anything" } else { "stream" };
            let tally = line.end(&format!("reflector_levels, {known}, by {piece}"));
            assert_eq!(line.found, places);
            assert_eq!(tally.discarded, 0);
        }
    }
}

#[test]
fn capture_at_a_wrong_rate_has_no_telegram() {
    let Some(bytes) = capture("host19200_while_sensor_38400.bin") else { return };
    let header = [0x02, 0x80, 0xD6, 0x02, 0xB0, 0x69, 0x41];
    for expect in [ExpectedHeaders::Anything, ExpectedHeaders::Stream { header, reply: None }] {
        for awaits in [false, true] {
            let mut line = FramedCapture::default();
            line.framer.expect(expect);
            line.framer.expect_acknowledge(awaits);
            line.feed(&bytes, 16);
            let known = if expect == ExpectedHeaders::Anything { "anything" } else { "stream" };
            let tally = line.end(&format!("host19200_while_sensor_38400, {known}, ack {awaits}"));
            assert_eq!(line.found, []);
            assert_eq!(tally.discarded + tally.acknowledge, bytes.len() as u64);
            assert_eq!(tally.acknowledge, line.acknowledged);
        }
    }
}

#[test]
fn captured_scan_aborted_by_a_reply_is_counted() {
    let Some(bytes) = capture("scan_interrupted_by_reply.bin") else { return };
    let header = header_of(&bytes);
    for expect in [ExpectedHeaders::Anything, ExpectedHeaders::Stream { header, reply: Some(0xBA) }] {
        for piece in [1, 16, 732] {
            let mut line = FramedCapture::default();
            line.framer.expect(expect);
            line.framer.expect_acknowledge(true);
            line.feed(&bytes, piece);
            let known = if expect == ExpectedHeaders::Anything { "anything" } else { "stream" };
            // The bytes are 15 bytes of a scan, an ACK, a reply of 29 bytes, and the beginning of the next scan.
            assert_eq!((line.found.as_slice(), bytes[20]), (&[(16, 29)][..], 0xBA));
            assert_eq!(line.framer.buffered(), 687);
            let tally = line.end(&format!("scan_interrupted_by_reply, {known}, by {piece}"));
            assert_eq!(line.found.len(), 1);
            assert_eq!((tally.aborted, tally.acknowledge, line.acknowledged), (1, 1, 0));
        }
    }
}
