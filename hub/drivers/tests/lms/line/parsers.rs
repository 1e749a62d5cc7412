//! Two parsers as they are usually written, to compare the framer with. Both check headers as strictly as the framer
//! does. They differ only in how they treat bytes that turn out not to be a telegram.

use super::TELEGRAM;
use super::account::{Accepted, Parser};
use scanhub_drivers::lms::header::StreamHeader;
use scanhub_drivers::lms::telegram::{STX, Telegram};

/// A state machine with six states that collects a telegram, and discards what it collected if it turns out not to be a
/// telegram.
pub(crate) struct Discarding {
    header: StreamHeader,
    collected: Vec<u8>,
    read: usize,
}

impl Discarding {
    pub(crate) fn new(header: StreamHeader) -> Self {
        Discarding { header, collected: Vec::with_capacity(TELEGRAM), read: 0 }
    }
}

impl Parser for Discarding {
    fn read(&mut self, bytes: &[u8], accept: &mut dyn FnMut(Accepted<'_>)) {
        for &byte in bytes {
            self.read += 1;
            self.collected.push(byte);
            let fits = match *self.collected.as_slice() {
                [stx] => stx == STX,
                [_, address] => address == self.header[1],
                // The low byte of the length is not checked alone.
                [_, _, _] => true,
                [_, _, low, high] => [low, high] == self.header[2..4],
                ref collected if collected.len() < TELEGRAM => true,
                ref collected => {
                    if Telegram::check(collected).is_some() {
                        accept(Accepted { offset: self.read - TELEGRAM, bytes: collected, reasons: 0 });
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

/// Collects a telegram after a strict header, and returns to the byte after its start byte if it turns out not to be a
/// telegram.
pub(crate) struct Rewinding {
    header: StreamHeader,
    open: Vec<u8>,
    read: usize,
}

impl Rewinding {
    pub(crate) fn new(header: StreamHeader) -> Self {
        Rewinding { header, open: Vec::with_capacity(2 * TELEGRAM), read: 0 }
    }
}

impl Parser for Rewinding {
    fn read(&mut self, bytes: &[u8], accept: &mut dyn FnMut(Accepted<'_>)) {
        self.open.extend(bytes);
        self.read += bytes.len();
        let mut at = 0;
        while at < self.open.len() {
            let open = &self.open[at..];
            let known = open.len().min(self.header.len());
            if open[..known] != self.header[..known] {
                at += 1;
            } else if open.len() < TELEGRAM {
                break;
            } else if Telegram::check(&open[..TELEGRAM]).is_some() {
                accept(Accepted { offset: self.read - open.len(), bytes: &open[..TELEGRAM], reasons: 0 });
                at += TELEGRAM;
            } else {
                at += 1;
            }
        }
        self.open.drain(..at);
    }
}
