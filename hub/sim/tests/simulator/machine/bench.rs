//! A sensor with a clock of its own, and everything that it has sent.

use scanhub_schema::{MICROS, MILLIS, Nanos, line_time};
use scanhub_sim::Arrival;
use scanhub_sim::device::{Chunk, Device as _, Part, Sent};
use scanhub_sim::machine::{LmsSimulator, Settings};
use scanhub_sim::operating::Source;
use scanhub_sim::room::Room;

/// A machine with a clock of its own and everything that it has sent.
pub(crate) struct Bench {
    pub(crate) machine: LmsSimulator,
    pub(crate) now: Nanos,
    pub(crate) chunks: Vec<(Nanos, Chunk)>,
}

impl Bench {
    pub(crate) fn new(settings: Settings) -> Bench {
        Bench::with(settings, Source::Room(Room::new(&"room".parse().unwrap(), 1)))
    }

    pub(crate) fn with(settings: Settings, source: Source) -> Bench {
        Bench { machine: LmsSimulator::new(settings, source), now: 0, chunks: Vec::new() }
    }

    pub(crate) fn run_until(&mut self, end: Nanos) {
        while let Some(at) = self.machine.poll_timeout().filter(|&at| at <= end) {
            self.now = self.now.max(at);
            while let Some(chunk) = self.machine.poll_transmit(self.now) {
                self.chunks.push((self.now, chunk));
            }
        }
        self.now = end;
    }

    /// Says `bytes` with `gap` of idle time between them.
    pub(crate) fn say(&mut self, bytes: &[u8], gap: Nanos) {
        for &byte in bytes {
            self.run_until(self.now + line_time(1, self.machine.baud().rate()) + gap);
            self.machine.receive(byte, Arrival::at(self.now));
        }
    }

    /// Says `request` as it should be said, and lets half a second pass; returns what came in answer.
    pub(crate) fn ask(&mut self, bytes: &[u8]) -> Vec<u8> {
        let before = self.chunks.len();
        self.say(bytes, 60 * MICROS);
        self.run_until(self.now + 500 * MILLIS);
        self.bytes_from(before)
    }

    pub(crate) fn bytes_from(&self, first: usize) -> Vec<u8> {
        self.chunks[first..].iter().flat_map(|(_, chunk)| chunk.bytes.clone()).collect()
    }

    pub(crate) fn sent(&self) -> Vec<(Nanos, Sent)> {
        let end = |(at, chunk): &(Nanos, Chunk)| match &chunk.part {
            Part::End(sent) => Some((*at, sent.clone())),
            Part::Acknowledge | Part::Telegram => None,
        };
        self.chunks.iter().filter_map(end).collect()
    }
}
