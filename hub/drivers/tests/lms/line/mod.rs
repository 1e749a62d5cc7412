//! A line that loses bytes in bursts, on a virtual clock: what a reader gets when, and what the sensor had sent.
//! Shared by the test of the framer's promises and by the benches `line_loss` and `host_load`.
//!
//! Losses come in bursts (paper III.B.4: 0.135 % of the bytes, 40.8 % of the telegrams): one begins at a byte with
//! probability 7.14e-4, its length is geometric with mean 1.89. The sensor sends 508 bytes of a telegram, pauses,
//! sends the rest; the reader sees pieces of 16, as a UART's FIFO hands them over.

pub(crate) mod account;
pub(crate) mod parsers;
pub(crate) mod scene;

use fastrand::Rng;
use scanhub_drivers::lms::header::StreamHeader;
use scanhub_drivers::lms::variant::{BYTES_PER_TURN, MIRROR_TURN};
use scanhub_schema::{MICROS, Nanos};
use scene::Scene;

/// Bytes of each telegram: 361 beams.
pub(crate) const TELEGRAM: usize = 732;
/// Time from the first byte of a telegram to the first of the next: 361 beams take two turns.
const PERIOD: Nanos = 2 * MIRROR_TURN;
/// Time of a byte at 500 kBd.
const BYTE: Nanos = 20 * MICROS;
/// Bytes that a UART collects before it hands them over.
const PIECE: usize = 16;
/// A UART hands over what it has when nothing came for four byte times.
const FLUSH: Nanos = 4 * BYTE;

/// Bytes that become readable together.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Piece {
    /// When.
    pub(crate) at: Nanos,
    /// End of the piece in [`Line::received`]; it begins where the one before ended.
    pub(crate) end: usize,
}

/// The history of a line: a number of telegrams, and what was left of them.
pub(crate) struct Line {
    /// All that the sensor sent.
    pub(crate) sent: Vec<u8>,
    /// What arrived of it.
    pub(crate) received: Vec<u8>,
    /// How what arrived becomes readable, in order.
    pub(crate) pieces: Vec<Piece>,
    /// Header of every telegram.
    pub(crate) header: StreamHeader,
    /// First and last + 1 of each run of lost bytes in `sent`, ascending.
    holes: Vec<(usize, usize)>,
    /// For each hole where it lies in `received`.
    cuts: Vec<usize>,
    /// For each hole how many bytes were lost up to its end.
    lost: Vec<usize>,
}

impl Line {
    /// `telegrams` telegrams of `scene` and their fate; the same seed makes the same line.
    pub(crate) fn new(scene: Scene, telegrams: usize, seed: u64) -> Line {
        let mut rng = Rng::with_seed(seed);
        let sent = scene.telegrams(telegrams, &mut rng);
        let header = sent[..7].try_into().expect("a telegram has a header");
        let holes = slide_left(&sent, bursts(sent.len(), &mut rng));
        let mut line = Line {
            received: Vec::with_capacity(sent.len()),
            pieces: Vec::new(),
            header,
            cuts: Vec::with_capacity(holes.len()),
            lost: Vec::with_capacity(holes.len()),
            holes,
            sent,
        };
        line.transmit();
        line
    }

    /// Number of the byte among those sent that arrived as number `received`.
    pub(crate) fn origin(&self, received: usize) -> usize {
        let holes = self.cuts.partition_point(|&cut| cut <= received);
        received + holes.checked_sub(1).map_or(0, |last| self.lost[last])
    }

    /// When the byte that arrived as number `received` became readable.
    pub(crate) fn readable_at(&self, received: usize) -> Nanos {
        self.pieces[self.pieces.partition_point(|piece| piece.end <= received)].at
    }

    /// Whether no byte of telegram number `telegram` was lost.
    pub(crate) fn is_intact(&self, telegram: usize) -> bool {
        let (start, end) = (telegram * TELEGRAM, (telegram + 1) * TELEGRAM);
        let after = self.holes.partition_point(|hole| hole.1 <= start);
        self.holes.get(after).is_none_or(|hole| hole.0 >= end)
    }

    /// The bytes of telegram number `telegram` as they were sent.
    pub(crate) fn telegram(&self, telegram: usize) -> &[u8] {
        &self.sent[telegram * TELEGRAM..(telegram + 1) * TELEGRAM]
    }

    /// Number of telegrams sent.
    pub(crate) fn telegrams(&self) -> usize {
        self.sent.len() / TELEGRAM
    }

    fn transmit(&mut self) {
        let mut next = 0;
        let mut piece_begin = 0;
        let mut last = 0;
        for (start, end) in self.holes.iter().copied().chain([(self.sent.len(), self.sent.len())]) {
            for number in next..start {
                let now = sent_at(number);
                let len = self.received.len() - piece_begin;
                if len == PIECE || (len > 0 && now - last > FLUSH) {
                    piece_begin = self.received.len();
                    self.pieces.push(Piece { at: last, end: piece_begin });
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
        self.pieces.push(Piece { at: last, end: self.received.len() });
    }
}

/// When the sensor has sent byte `number`.
pub(crate) fn sent_at(number: usize) -> Nanos {
    let (telegram, byte) = ((number / TELEGRAM) as Nanos, number % TELEGRAM);
    let (turn, in_turn) = ((byte / BYTES_PER_TURN) as Nanos, (byte % BYTES_PER_TURN + 1) as Nanos);
    telegram * PERIOD + turn * MIRROR_TURN + in_turn * BYTE
}

/// Runs of lost bytes among `len`. Chances are whole numbers of 2^32, so every machine draws the same line.
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

/// A lost byte that equals a kept neighbour could as well be that neighbour: the reader sees the same bytes. At a
/// telegram's border the two histories blame different telegrams, so all that look alike are told alike: the hole
/// is moved left as far as the bytes are equal, and joined with one it meets.
fn slide_left(sent: &[u8], holes: Vec<(usize, usize)>) -> Vec<(usize, usize)> {
    let mut slid: Vec<(usize, usize)> = Vec::with_capacity(holes.len());
    for (mut start, mut end) in holes {
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
