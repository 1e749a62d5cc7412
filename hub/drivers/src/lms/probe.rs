//! Recognizes an LMS by any telegram with a right checksum: of its stream, its boot message, or the reply to a request for
//! its type or status. Both requests change nothing in the scanner.

use scanhub_schema::{Family, MICROS, MILLIS, Nanos};

use crate::line::probe::{Approach, Asks, Evidence, Listen};
use crate::lms::command;
use crate::lms::framer::{Advance, Framer};
use crate::lms::header::{Reject, State};
use crate::lms::reply::Reply;
use crate::lms::telegram::MAX_TELEGRAM;
use crate::lms::variant::Baud;

/// Recognizer of LMS telegrams.
#[derive(Clone, Debug, Default)]
pub struct Probe {
    framer: Framer,
    is_found: bool,
    /// Whether the scanner has acknowledged the request, and nothing has arrived since.
    is_acknowledged: bool,
}

impl Probe {
    fn check(&mut self) {
        while let Some(found) = self.framer.advance() {
            self.is_acknowledged = false;
            match found {
                Advance::Telegram(span) => {
                    self.is_found |= Reply::decode(self.framer.view(span).telegram).is_some();
                }
                Advance::Ack => self.is_acknowledged = true,
                Advance::Nak => {}
            }
        }
    }
}

impl crate::line::probe::Probe for Probe {
    fn approach(&self) -> &'static Approach {
        &APPROACH
    }

    fn clear(&mut self) {
        *self = Probe::default();
    }

    fn expect_reply(&mut self, is_expected: bool) {
        self.framer.await_acknowledge(is_expected);
        self.is_acknowledged = false;
    }

    fn receive(&mut self, bytes: &[u8]) {
        for byte in bytes {
            self.framer.spare()[0] = *byte;
            self.framer.commit(1);
            self.is_acknowledged = false;
            self.check();
        }
    }

    fn hold(&self) -> Option<Nanos> {
        self.framer.hold()
    }

    fn release(&mut self, idle: Nanos) {
        self.framer.release(idle);
        self.check();
    }

    fn evidence(&self) -> Evidence {
        let is_begun = matches!(self.framer.state(), State::Body | State::Crc);
        if self.is_found {
            Evidence::Found(None)
        } else if is_begun || self.is_acknowledged {
            Evidence::Begun
        } else if self.framer.tally().rejected[Reject::Crc as usize] > 0 {
            Evidence::Damaged
        } else {
            Evidence::None
        }
    }
}

const APPROACH: Approach = Approach {
    family: Family::Lms,
    // Only at this rate does a listening step contain several telegrams of a stream.
    listens: &[Listen { rate: 500_000, span: 120 * MILLIS, needs_bytes: true }],
    asks: Some(Asks {
        // At power-on, after a hub, and the rest.
        rates: &[9_600, 500_000, 38_400, 19_200],
        settle: 20 * MILLIS,
        stop: None,
        requests: &[
            &[0x02, 0x00, 0x01, 0x00, command::TYPE, 0x1E, 0x12],
            &[0x02, 0x00, 0x01, 0x00, command::STATUS, 0x15, 0x12],
        ],
        // At least 55 us and at most 6 ms (Telegram listing 4.3), less the time of the write.
        gap: Some((120 * MICROS, 5 * MILLIS)),
        // The acknowledgement arrives within 60 ms (Telegram listing 4.3), and captured replies began within 150 ms.
        reply: 150 * MILLIS,
        patience: 250 * MILLIS,
        // The rest of the captured times, and a status at 9,600 baud.
        extension: 300 * MILLIS,
        repeats: 1,
    }),
    // Without another setting in its EEPROM, the scanner starts at this rate (Telegram listing 7.1).
    boot_rate: Some(9_600),
    max_transmission: MAX_TELEGRAM,
    advice: "RS-422 needs jumper 7-8, and after power-on it takes up to a minute",
};

const _: () = assert!(Baud::ALL.len() == 4);

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lms::command::Request;

    #[test]
    fn requests_are_those_for_type_and_status() {
        let asks = APPROACH.asks.unwrap();
        assert_eq!(asks.requests[0], Request::Type.encode(0).bytes());
        assert_eq!(asks.requests[1], Request::Status.encode(0).bytes());
        assert!(asks.rates.iter().all(|&rate| Baud::of_rate(rate).is_some()));
    }
}
