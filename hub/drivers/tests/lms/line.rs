//! Simulated line that loses bytes in bursts, in virtual time. The line contains the chunks that a reader receives and
//! the telegrams that the scanner sent. [`TelegramCounts`] runs a parser on the line and counts the result for each
//! telegram.
//!
//! Two ordinary parsers serve as a comparison. Both parsers check headers as strictly as the framer. The parsers differ
//! only in how they treat bytes that are not a telegram. The test of the framer and the benches `line_loss` and
//! `host_load` use this file.
//!
//! Losses come in bursts (paper III.B.4: 0.135 % of the bytes are lost, and 40.8 % of the telegrams are damaged). A
//! burst begins at a byte with probability 7.14e-4, and the length of the burst has a geometric distribution with mean
//! 1.89. The scanner sends 508 bytes of a telegram, pauses, and sends the rest. The reader receives chunks of 16 bytes,
//! as the FIFO of a UART passes them on.

use fastrand::Rng;
use scanhub_drivers::line::suspect;
use scanhub_drivers::lms::framer::{Framer, FramerEvent};
use scanhub_drivers::lms::header::{ExpectedHeaders, StreamHeader};
use scanhub_drivers::lms::measured;
use scanhub_drivers::lms::telegram::{STX, Telegram};
use scanhub_drivers::lms::variant::{BYTES_PER_REVOLUTION, MIRROR_PERIOD, Unit};
use scanhub_schema::{MICROS, MILLIS, Nanos};

/// Number of bytes of each telegram, with 361 beams.
pub(crate) const TELEGRAM_LEN: usize = 732;
/// Time from the first byte of a telegram to the first byte of the next telegram: 361 beams take two revolutions.
const TELEGRAM_PERIOD: Nanos = 2 * MIRROR_PERIOD;
/// Transmission time of a byte at 500,000 baud.
const BYTE_TIME: Nanos = 20 * MICROS;
/// Number of bytes that a UART collects before it passes them on.
const UART_PIECE_LEN: usize = 16;
/// Time without a byte after which a UART passes on fewer bytes than [`UART_PIECE_LEN`].
const UART_FLUSH_TIME: Nanos = 4 * BYTE_TIME;

/// A chunk of bytes that become readable at the same time.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ReadablePiece {
    /// Time at which the bytes become readable.
    pub(crate) at: Nanos,
    /// End of the chunk in [`SimulatedLine::received`]. The chunk begins at the end of the previous chunk.
    pub(crate) end: usize,
}

/// Telegrams that were sent on a line, and the bytes that arrived.
pub(crate) struct SimulatedLine {
    /// All bytes that the scanner sent.
    pub(crate) sent: Vec<u8>,
    /// Bytes that arrived.
    pub(crate) received: Vec<u8>,
    /// Chunks of the received bytes in their order.
    pub(crate) pieces: Vec<ReadablePiece>,
    /// Header of every telegram.
    pub(crate) header: StreamHeader,
    /// Start and end of each run of lost bytes in `sent`, ascending. The end is exclusive.
    lost_runs: Vec<(usize, usize)>,
    /// For each run of lost bytes, its position in `received`.
    cuts: Vec<usize>,
    /// For each run of lost bytes, the number of bytes lost up to the end of this run.
    lost: Vec<usize>,
}

impl SimulatedLine {
    /// Creates a line with `telegrams` telegrams of `scene`. The same seed creates the same line.
    pub(crate) fn new(scene: LineContent, telegrams: usize, seed: u64) -> SimulatedLine {
        let mut rng = Rng::with_seed(seed);
        let sent = scene.telegrams(telegrams, &mut rng);
        let header = sent[..7].try_into().expect("a telegram has a header");
        let lost_runs = normalize_runs(&sent, bursts(sent.len(), &mut rng));
        let mut line = SimulatedLine {
            received: Vec::with_capacity(sent.len()),
            pieces: Vec::new(),
            header,
            cuts: Vec::with_capacity(lost_runs.len()),
            lost: Vec::with_capacity(lost_runs.len()),
            lost_runs,
            sent,
        };
        line.transmit();
        line
    }

    /// Returns the index in `sent` of the received byte with the index `received`.
    pub(crate) fn origin(&self, received: usize) -> usize {
        let holes = self.cuts.partition_point(|&cut| cut <= received);
        received + holes.checked_sub(1).map_or(0, |last| self.lost[last])
    }

    /// Returns the time at which the received byte with the index `received` became readable.
    pub(crate) fn readable_at(&self, received: usize) -> Nanos {
        self.pieces[self.pieces.partition_point(|piece| piece.end <= received)].at
    }

    /// Returns whether no byte of telegram number `telegram` was lost.
    pub(crate) fn is_intact(&self, telegram: usize) -> bool {
        let (start, end) = (telegram * TELEGRAM_LEN, (telegram + 1) * TELEGRAM_LEN);
        let after = self.lost_runs.partition_point(|hole| hole.1 <= start);
        self.lost_runs.get(after).is_none_or(|hole| hole.0 >= end)
    }

    /// Returns the bytes of telegram number `telegram` as they were sent.
    pub(crate) fn telegram(&self, telegram: usize) -> &[u8] {
        &self.sent[telegram * TELEGRAM_LEN..(telegram + 1) * TELEGRAM_LEN]
    }

    /// Returns the number of sent telegrams.
    pub(crate) fn telegrams(&self) -> usize {
        self.sent.len() / TELEGRAM_LEN
    }

    fn transmit(&mut self) {
        let mut next = 0;
        let mut piece_begin = 0;
        let mut last = 0;
        for (start, end) in self.lost_runs.iter().copied().chain([(self.sent.len(), self.sent.len())]) {
            for number in next..start {
                let now = sent_at(number);
                let len = self.received.len() - piece_begin;
                if len == UART_PIECE_LEN || (len > 0 && now - last > UART_FLUSH_TIME) {
                    piece_begin = self.received.len();
                    self.pieces.push(ReadablePiece { at: last, end: piece_begin });
                }
                self.received.push(self.sent[number]);
                last = now;
            }
            if end > start {
                self.cuts.push(self.received.len());
                self.lost.push(end - self.received.len());
            }
            next = end;
        }
        self.pieces.push(ReadablePiece { at: last, end: self.received.len() });
    }
}

/// Returns the time at which the scanner has sent the byte at index `number`.
pub(crate) fn sent_at(number: usize) -> Nanos {
    let (telegram, byte) = ((number / TELEGRAM_LEN) as Nanos, number % TELEGRAM_LEN);
    let (turn, in_turn) =
        ((byte / BYTES_PER_REVOLUTION) as Nanos, (byte % BYTES_PER_REVOLUTION + 1) as Nanos);
    telegram * TELEGRAM_PERIOD + turn * MIRROR_PERIOD + in_turn * BYTE_TIME
}

/// Draws the runs of lost bytes among `len` bytes. Probabilities are multiples of 2^-32, so every machine draws the
/// same line.
fn bursts(len: usize, rng: &mut Rng) -> Vec<(usize, usize)> {
    let chance = |probability: f64| (probability * 4_294_967_296.0) as u32;
    let (begins, goes_on) = (chance(7.14e-4), chance(1.0 - 1.0 / 1.89));
    let mut holes = Vec::new();
    let mut at = 0;
    while at < len {
        if rng.u32(..) < begins {
            let start = at;
            at += 1;
            while at < len && rng.u32(..) < goes_on {
                at += 1;
            }
            holes.push((start, at));
        }
        at += 1;
    }
    holes
}

/// Gives equivalent losses the same form. If a byte is lost next to an equal byte that arrived, the reader sees the
/// same bytes as if the other byte was lost. At the border of two telegrams, the two cases would count different
/// telegrams as damaged. Each run of lost bytes is therefore moved to the left as long as the bytes are equal. A run
/// that reaches another run is merged with it.
fn normalize_runs(sent: &[u8], runs: Vec<(usize, usize)>) -> Vec<(usize, usize)> {
    let mut slid: Vec<(usize, usize)> = Vec::with_capacity(runs.len());
    for (mut start, mut end) in runs {
        loop {
            if let Some(&(before, limit)) = slid.last()
                && limit == start
            {
                slid.pop();
                start = before;
            } else if start > 0 && sent[start - 1] == sent[end - 1] {
                start -= 1;
                end -= 1;
            } else {
                break;
            }
        }
        slid.push((start, end));
    }
    slid
}

/// A frame that a parser has accepted.
#[derive(Clone, Copy, Debug)]
pub(crate) struct AcceptedFrame<'a> {
    /// Offset of the frame's first byte among all bytes read.
    pub(crate) offset: usize,
    /// Bytes of the frame.
    pub(crate) bytes: &'a [u8],
    /// Bits of [`suspect`].
    pub(crate) reasons: u8,
}

/// A parser of the comparison.
pub(crate) trait Parser {
    /// Reads `bytes` and passes each accepted frame to `accept`.
    fn read(&mut self, bytes: &[u8], accept: &mut dyn FnMut(AcceptedFrame<'_>));

    /// Returns the time without bytes after which [`Parser::release`] may accept more frames.
    fn hold_time(&self) -> Option<Nanos> {
        None
    }

    /// Handles `idle` ns without a byte.
    fn release(&mut self, _idle: Nanos, _accept: &mut dyn FnMut(AcceptedFrame<'_>)) {}
}

impl Parser for Framer {
    fn read(&mut self, mut bytes: &[u8], accept: &mut dyn FnMut(AcceptedFrame<'_>)) {
        while !bytes.is_empty() {
            let spare = self.read_buffer();
            let len = bytes.len().min(spare.len());
            spare[..len].copy_from_slice(&bytes[..len]);
            self.commit(len);
            bytes = &bytes[len..];
            drain(self, accept);
        }
    }

    fn hold_time(&self) -> Option<Nanos> {
        Framer::hold_time(self)
    }

    fn release(&mut self, idle: Nanos, accept: &mut dyn FnMut(AcceptedFrame<'_>)) {
        Framer::release(self, idle);
        drain(self, accept);
    }
}

fn drain(framer: &mut Framer, accept: &mut dyn FnMut(AcceptedFrame<'_>)) {
    while let Some(found) = framer.poll() {
        if let FramerEvent::Telegram(framed) = found {
            let (offset, bytes) = (framed.offset as usize, framed.telegram.bytes());
            accept(AcceptedFrame { offset, bytes, reasons: framed.reasons });
        }
    }
}

/// Creates a framer with the session's settings for this stream.
pub(crate) fn framer(line: &SimulatedLine) -> Framer {
    let mut framer = Framer::default();
    framer.expect(ExpectedHeaders::Stream { header: line.header, reply: None });
    framer
}

/// Fate of the telegrams of one or more lines.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct TelegramCounts {
    /// Number of telegrams sent.
    pub(crate) telegrams: u64,
    /// Number of telegrams that lost a byte.
    pub(crate) damaged: u64,
    /// Number of telegrams that were not delivered.
    pub(crate) lost: u64,
    /// Number of telegrams that were not delivered although every byte arrived.
    pub(crate) intact_lost: u64,
    /// Number of delivered frames that are not a sent telegram.
    pub(crate) wrong: u64,
    /// Number of wrong frames without a suspect mark.
    pub(crate) wrong_clean: u64,
    /// Number of delivered frames that were held because of a header inside them.
    pub(crate) held: u64,
    /// Sum of the times from the arrival of the last byte to the delivery, for telegrams that were not held.
    pub(crate) extra_time: Nanos,
    /// Maximum time from the arrival of the last byte to the delivery, for telegrams that were not held.
    pub(crate) extra_time_max: Nanos,
}

impl TelegramCounts {
    /// Runs `parser` on the whole `line`, as a session does. Passes each chunk to the parser when the chunk becomes
    /// readable. Calls `release` when no byte has arrived for the parser's hold time.
    pub(crate) fn run_parser(&mut self, line: &SimulatedLine, parser: &mut impl Parser) {
        let mut delivered = vec![false; line.telegrams()];
        let mut begin = 0;
        for (number, piece) in line.pieces.iter().enumerate() {
            parser.read(&line.received[begin..piece.end], &mut |accepted| {
                self.add_frame(line, accepted, piece.at, &mut delivered);
            });
            begin = piece.end;
            let next = line.pieces.get(number + 1).map_or(Nanos::MAX, |next| next.at);
            while let Some(hold) = parser.hold_time().filter(|hold| piece.at + hold < next) {
                parser.release(hold, &mut |accepted| {
                    self.add_frame(line, accepted, piece.at + hold, &mut delivered);
                });
            }
        }
        self.telegrams += line.telegrams() as u64;
        for (number, delivered) in delivered.into_iter().enumerate() {
            let intact = line.is_intact(number);
            self.damaged += u64::from(!intact);
            self.lost += u64::from(!delivered);
            self.intact_lost += u64::from(!delivered && intact);
        }
    }

    /// Returns the mean time from the arrival of the last byte to the delivery, in ms, over `telegrams - lost - held`.
    pub(crate) fn extra_mean_ms(&self) -> f64 {
        self.extra_time as f64 / MILLIS as f64 / (self.telegrams - self.lost - self.held).max(1) as f64
    }

    /// Returns the maximum time from the arrival of the last byte to the delivery, in ms, for telegrams that were not
    /// held.
    pub(crate) fn extra_max_ms(&self) -> f64 {
        self.extra_time_max as f64 / MILLIS as f64
    }

    fn add_frame(
        &mut self,
        line: &SimulatedLine,
        accepted: AcceptedFrame<'_>,
        now: Nanos,
        delivered: &mut [bool],
    ) {
        let AcceptedFrame { offset, bytes, reasons } = accepted;
        let last = offset + bytes.len() - 1;
        assert_eq!(bytes, &line.received[offset..=last], "a parser invents nothing");
        let number = line.origin(offset) / TELEGRAM_LEN;
        let held = reasons & suspect::HEADER_INSIDE != 0;
        self.held += u64::from(held);
        // Only the bytes decide whether a frame is the sent telegram. If equal bytes of the next telegram complete a
        // damaged telegram, the result equals the telegram that the scanner sent.
        if bytes == line.telegram(number) && !delivered[number] {
            delivered[number] = true;
            let extra = now - line.readable_at(last);
            if !held {
                self.extra_time += extra;
                self.extra_time_max = self.extra_time_max.max(extra);
            }
            return;
        }
        self.wrong += 1;
        // If the telegram was slow, the session adds reason `SLOW` to the framer's reasons.
        let transmit_time = sent_at(line.origin(last)) - sent_at(line.origin(offset));
        let slow = transmit_time > sent_at(TELEGRAM_LEN - 1) - sent_at(0) + SUSPECT_DELAY;
        self.wrong_clean += u64::from(reasons == 0 && !slow);
    }
}

impl core::ops::AddAssign for TelegramCounts {
    fn add_assign(&mut self, other: TelegramCounts) {
        self.telegrams += other.telegrams;
        self.damaged += other.damaged;
        self.lost += other.lost;
        self.intact_lost += other.intact_lost;
        self.wrong += other.wrong;
        self.wrong_clean += other.wrong_clean;
        self.held += other.held;
        self.extra_time += other.extra_time;
        self.extra_time_max = self.extra_time_max.max(other.extra_time_max);
    }
}

/// Maximum additional transmission time of a telegram that is not suspect.
const SUSPECT_DELAY: Nanos = 8 * MILLIS;

/// A parser with six states that collects a telegram. If the collected bytes are not a telegram, the parser discards
/// all of them.
pub(crate) struct DiscardingParser {
    header: StreamHeader,
    collected: Vec<u8>,
    read: usize,
}

impl DiscardingParser {
    pub(crate) fn new(header: StreamHeader) -> Self {
        DiscardingParser { header, collected: Vec::with_capacity(TELEGRAM_LEN), read: 0 }
    }
}

impl Parser for DiscardingParser {
    fn read(&mut self, bytes: &[u8], accept: &mut dyn FnMut(AcceptedFrame<'_>)) {
        for &byte in bytes {
            self.read += 1;
            self.collected.push(byte);
            let fits = match *self.collected.as_slice() {
                [stx] => stx == STX,
                [_, address] => address == self.header[1],
                // The low byte of the length is checked together with the high byte.
                [_, _, _] => true,
                [_, _, low, high] => [low, high] == self.header[2..4],
                ref collected if collected.len() < TELEGRAM_LEN => true,
                ref collected => {
                    if Telegram::check(collected).is_some() {
                        accept(AcceptedFrame {
                            offset: self.read - TELEGRAM_LEN,
                            bytes: collected,
                            reasons: 0,
                        });
                    }
                    false
                }
            };
            if !fits {
                self.collected.clear();
            }
        }
    }
}

/// A parser that collects a telegram after a strict header. If the collected bytes are not a telegram, the parser
/// continues with the byte after the start byte.
pub(crate) struct RewindingParser {
    header: StreamHeader,
    open: Vec<u8>,
    read: usize,
}

impl RewindingParser {
    pub(crate) fn new(header: StreamHeader) -> Self {
        RewindingParser { header, open: Vec::with_capacity(2 * TELEGRAM_LEN), read: 0 }
    }
}

impl Parser for RewindingParser {
    fn read(&mut self, bytes: &[u8], accept: &mut dyn FnMut(AcceptedFrame<'_>)) {
        self.open.extend(bytes);
        self.read += bytes.len();
        let mut at = 0;
        while at < self.open.len() {
            let open = &self.open[at..];
            let known = open.len().min(self.header.len());
            if open[..known] != self.header[..known] {
                at += 1;
            } else if open.len() < TELEGRAM_LEN {
                break;
            } else if Telegram::check(&open[..TELEGRAM_LEN]).is_some() {
                accept(AcceptedFrame {
                    offset: self.read - open.len(),
                    bytes: &open[..TELEGRAM_LEN],
                    reasons: 0,
                });
                at += TELEGRAM_LEN;
            } else {
                at += 1;
            }
        }
        self.open.drain(..at);
    }
}

const BEAM_COUNT: usize = 361;

/// Content of the scans on a line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum LineContent {
    /// Walls and furniture with noise, in mm, as in an ordinary room.
    Furnished,
    /// Only a few grains of dust are in range. The telegrams have long runs of equal bytes. In such a run, different
    /// losses look the same.
    Empty,
    /// A wall at 640 cm in all directions. The value of each beam equals the first two bytes of a header.
    Wall,
    /// Random words, with every byte value at every position.
    Random,
}

impl LineContent {
    /// All contents.
    pub(crate) const ALL: [LineContent; 4] =
        [LineContent::Furnished, LineContent::Empty, LineContent::Wall, LineContent::Random];

    /// Returns the name for tables.
    pub(crate) fn name(self) -> &'static str {
        match self {
            LineContent::Furnished => "furnished",
            LineContent::Empty => "empty",
            LineContent::Wall => "wall at 640 cm",
            LineContent::Random => "random words",
        }
    }

    /// Returns the bytes of `count` consecutive telegrams.
    pub(crate) fn telegrams(self, count: usize, rng: &mut Rng) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(count * TELEGRAM_LEN);
        let mut room = [0; BEAM_COUNT];
        for number in 0..count {
            if number % SCANS_PER_PLACE == 0 {
                room = furniture(rng);
            }
            let words = match self {
                LineContent::Furnished => room.map(|range| range + rng.u16(..10)),
                LineContent::Empty => [NO_RETURN; BEAM_COUNT]
                    .map(|far| with_chance(rng, 200).map_or(far, |rng| rng.u16(20..4000))),
                LineContent::Wall => {
                    [640; BEAM_COUNT].map(|wall| with_chance(rng, 40).map_or(wall, |rng| rng.u16(639..642)))
                }
                LineContent::Random => [0; BEAM_COUNT].map(|_: u16| rng.u16(..)),
            };
            let unit = if self == LineContent::Wall { Unit::Cm } else { Unit::Mm };
            bytes.extend(measured::encode(0, unit, &words, 0x10).bytes());
        }
        bytes
    }
}

/// Draws flat surfaces. Each surface is a run of beams whose ranges rise or fall evenly.
fn furniture(rng: &mut Rng) -> [u16; BEAM_COUNT] {
    let mut ranges = [0; BEAM_COUNT];
    let mut at = 0;
    while at < BEAM_COUNT {
        let beams = rng.usize(8..60).min(BEAM_COUNT - at);
        let (near, slope) = (rng.i32(500..7000), rng.i32(-15..16));
        for (i, range) in ranges[at..at + beams].iter_mut().enumerate() {
            *range = (near + slope * i as i32).clamp(20, 8000) as u16;
        }
        at += beams;
    }
    ranges
}

fn with_chance(rng: &mut Rng, n: u32) -> Option<&mut Rng> {
    (rng.u32(..n) == 0).then_some(rng)
}

/// Code of a beam without a return, with 13 range bits.
const NO_RETURN: u16 = 0x1FFF;
/// Number of scans after which a moving robot sees another part of the room.
const SCANS_PER_PLACE: usize = 100;
