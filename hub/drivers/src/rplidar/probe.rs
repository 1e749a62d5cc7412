//! Recognizes an RPLIDAR by its reply to `A5 50`, sent after `A5 25`, which stops a stream: a scanner that measures does not
//! reply. Packets alone do not prove a scanner, because those of one point have no checksum.

use scanhub_schema::{Family, MILLIS};

use crate::line::probe::{Approach, Asks, Evidence, Stop};
use crate::rplidar::device_info::Info;
use crate::rplidar::framer::{Expect, Found, Framer};
use crate::rplidar::packet::Kind;
use crate::rplidar::request::{Answer, Head};

/// Recognizer of RPLIDAR replies.
#[derive(Clone, Debug)]
pub struct Probe {
    framer: Framer,
    is_asked: bool,
    /// Whether packets have arrived.
    is_stream: bool,
    /// The identity that the scanner has reported.
    info: Option<Info>,
}

impl Default for Probe {
    fn default() -> Self {
        Probe { framer: Framer::new(Expect::Anything(None)), is_asked: false, is_stream: false, info: None }
    }
}

impl crate::line::probe::Probe for Probe {
    fn approach(&self) -> &'static Approach {
        &APPROACH
    }

    fn clear(&mut self) {
        *self = Probe::default();
    }

    // A fragment of an earlier reply would take the descriptor of the next one along, so nothing of it is kept.
    fn expect_reply(&mut self, is_expected: bool) {
        let expect = if is_expected { Expect::Answers } else { Expect::Anything(None) };
        *self = Probe { framer: Framer::new(expect), is_asked: is_expected, ..Probe::default() };
    }

    fn receive(&mut self, mut bytes: &[u8]) {
        while !bytes.is_empty() {
            let spare = self.framer.spare();
            let len = spare.len().min(bytes.len());
            spare[..len].copy_from_slice(&bytes[..len]);
            self.framer.commit(len);
            bytes = &bytes[len..];
            while let Some(found) = self.framer.advance(1) {
                match found {
                    Found::Reply(Answer::Info, span) => {
                        self.info = Info::parse(&self.framer.bytes(span)[Head::LEN..]);
                    }
                    Found::Packets(..) | Found::Stream(_) => self.is_stream = true,
                    Found::Reply(..) | Found::Greeting { .. } => {}
                }
            }
            self.is_stream |= self.framer.is_alike();
        }
    }

    fn evidence(&self) -> Evidence {
        match self.info {
            Some(info) => Evidence::Found(info.model().map(|model| model.name())),
            None if self.is_stream => Evidence::Stream,
            None if self.is_asked && self.framer.buffered() > 0 => Evidence::Begun,
            None => Evidence::None,
        }
    }
}

const APPROACH: Approach = Approach {
    family: Family::Rplidar,
    listens: &[],
    asks: Some(Asks {
        rates: &[115_200, 256_000, 460_800, 1_000_000],
        settle: 0,
        stop: Some(Stop { request: &[0xA5, 0x25], quiet: 15 * MILLIS, at_most: 60 * MILLIS }),
        requests: &[&[0xA5, 0x50]],
        gap: None,
        // A reply takes some milliseconds, and an adapter that collects bytes adds 16, twice.
        reply: 70 * MILLIS,
        patience: 0,
        extension: 20 * MILLIS,
        repeats: 2,
    }),
    boot_rate: None,
    max_transmission: Kind::LONGEST,
    advice: "it needs 5 V for the scanner and its motor",
};

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rplidar::request::Request;

    #[test]
    fn requests_are_those_to_stop_and_for_the_identity() {
        let asks = APPROACH.asks.unwrap();
        assert_eq!(asks.stop.unwrap().request, Request::STOP.bytes());
        assert_eq!(asks.requests, [Request::INFO.bytes()]);
    }
}
