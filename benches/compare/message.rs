//! What is sent by every mechanism: bytes with a number at both ends. Refuses to know how they travel.

use std::hint::black_box;

use schema::{Contents, Scan};

use crate::support::Outcome;

/// What a message says of itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Label {
    /// Position of its phase in the schedule.
    pub(crate) phase: usize,
    /// Number in its phase, from 0.
    pub(crate) number: u64,
    /// It only says that the phase is over.
    pub(crate) is_end: bool,
}

impl Label {
    /// Writes itself into both ends of `bytes`.
    pub(crate) fn write(self, bytes: &mut [u8]) {
        let kind = self.phase as u64 * 2 + u64::from(self.is_end);
        let number = self.number.to_le_bytes();
        let tail = bytes.len() - NUMBER;
        bytes[..NUMBER].copy_from_slice(&number);
        bytes[NUMBER..HEAD].copy_from_slice(&kind.to_le_bytes());
        bytes[tail..].copy_from_slice(&number);
    }

    /// What the message in `bytes` says, once all of it has been looked at: a byte of each cache line. An error if its
    /// ends are of different messages.
    pub(crate) fn read(bytes: &[u8]) -> Outcome<Label> {
        black_box(bytes.iter().step_by(CACHE_LINE).fold(0u64, |sum, byte| sum + u64::from(*byte)));
        let [number, kind] = [&bytes[..NUMBER], &bytes[NUMBER..HEAD]].map(word);
        if word(&bytes[bytes.len() - NUMBER..]) != number {
            return Err(format!("message {number} is torn").into());
        }
        Ok(Label { phase: kind as usize / 2, number, is_end: kind % 2 == 1 })
    }
}

fn word(bytes: &[u8]) -> u64 {
    bytes.iter().rev().fold(0, |word, byte| word << 8 | u64::from(*byte))
}

/// A message in the sender's own memory, written anew each time: what is sent was just computed.
pub(crate) struct Draft {
    contents: Vec<u8>,
    bytes: Vec<u8>,
}

impl Draft {
    /// Of messages of `len` bytes.
    pub(crate) fn new(len: usize) -> Draft {
        Draft { contents: contents(len), bytes: contents(len) }
    }

    /// What was written.
    pub(crate) fn bytes(&self) -> &[u8] {
        &self.bytes
    }

    /// Writes a whole message.
    pub(crate) fn write(&mut self, label: Label) {
        self.bytes.copy_from_slice(&self.contents);
        label.write(&mut self.bytes);
    }

    /// Writes one that is no longer than it must be.
    pub(crate) fn write_short(&mut self, label: Label) -> &[u8] {
        let bytes = &mut self.bytes[..SHORT];
        label.write(bytes);
        bytes
    }
}

/// What a message of `len` bytes says between its ends.
pub(crate) fn contents(len: usize) -> Vec<u8> {
    (0..len).map(|i| i as u8).collect()
}

/// Beams of the hub's own messages: 180 degrees in halves.
pub(crate) const BEAMS: usize = 361;
/// Length of a scan of so many.
pub(crate) const SCAN: usize = Scan::len(BEAMS, Contents::UPPER);
/// Length of the shortest message.
pub(crate) const SHORT: usize = HEAD + NUMBER;
const NUMBER: usize = size_of::<u64>();
const HEAD: usize = 2 * NUMBER;
const CACHE_LINE: usize = 64;
