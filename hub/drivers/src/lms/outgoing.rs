//! One request on its way: paced byte by byte, acknowledged or not, tried again or given up. The sensor wants at
//! least 55 us and at most 6 ms between bytes and may overlook a request while its mirror turns (Telegram listing
//! 4.3), so a request is never just written.

use crate::lms::command::Request;
use crate::lms::telegram::{Encoded, REPLY};
use crate::lms::variant::Baud;
use schema::{MICROS, MILLIS, Nanos, line_time};

/// What can be said: a telegram that has a reply, which takes its time.
pub trait Say {
    /// The telegram that says it to the sensor at `address`.
    fn encode(&self, address: u8) -> Encoded;
    /// Its command byte.
    fn command(&self) -> u8;
    /// How long the sensor may work between acknowledgement and reply.
    fn work(&self) -> Nanos;
    /// How long the first sign of an answer may take.
    fn sign(&self) -> Nanos {
        ACKNOWLEDGE_TIMEOUT
    }
}

impl Say for Request {
    fn encode(&self, address: u8) -> Encoded {
        Request::encode(*self, address)
    }

    fn command(&self) -> u8 {
        Request::command(*self)
    }

    fn work(&self) -> Nanos {
        match self {
            Request::Stream | Request::Stop | Request::Baud(_) => MODE_TIMEOUT,
            _ => REPLY_TIMEOUT,
        }
    }

    fn sign(&self) -> Nanos {
        if *self == Request::Stop { STOP_TIMEOUT } else { ACKNOWLEDGE_TIMEOUT }
    }
}

/// The open request.
#[derive(Clone, Debug)]
pub(crate) struct Outgoing<R = Request> {
    pub(crate) request: R,
    encoded: Encoded,
    sent: usize,
    not_before: Nanos,
    /// Earliest time at which the byte before the next one can have left, see [`Outgoing::restart_if_late`].
    left_at: Nanos,
    /// How often the request was started over because a byte was late.
    restarts: u8,
    tries: u8,
    tries_left: u8,
    /// Added to every wait for the acknowledgement.
    patience: Nanos,
    acknowledged: bool,
    /// Whether a byte came since it was out.
    is_heard: bool,
    /// When its last byte left.
    out_at: Option<Nanos>,
    /// When its reply is given up; counts from the last byte.
    give_up_at: Nanos,
}

impl<R: Say> Outgoing<R> {
    /// `request` to the sensor at `address`, from `not_before` on, at most `tries` times.
    pub(crate) fn new(request: R, address: u8, not_before: Nanos, tries: u8) -> Self {
        let encoded = request.encode(address);
        Outgoing {
            request,
            encoded,
            sent: 0,
            not_before,
            left_at: 0,
            restarts: 0,
            tries,
            tries_left: tries - 1,
            patience: 0,
            acknowledged: false,
            is_heard: false,
            out_at: None,
            give_up_at: Nanos::MAX,
        }
    }

    /// The sensor has so much more time to begin its answer.
    pub(crate) fn be_patient(&mut self, patience: Nanos) {
        self.patience = patience;
    }

    /// Returns the next byte. Empty if all of them left.
    pub(crate) fn next_byte(&self) -> &[u8] {
        self.encoded.bytes().get(self.sent..=self.sent).unwrap_or_default()
    }

    /// Returns when the next byte may leave at the earliest.
    pub(crate) fn next_at(&self) -> Option<Nanos> {
        (!self.is_out()).then_some(self.not_before)
    }

    /// The byte left at `now`.
    pub(crate) fn transmitted(&mut self, now: Nanos, baud: Baud) {
        self.sent += 1;
        self.not_before = now + line_time(1, baud.rate()) + GAP;
        if self.sent == self.encoded.bytes().len() {
            self.out_at = Some(now);
            // A sensor that is slower than it should be needs a longer wait, not more tries: each breaks off the last.
            let tried = Nanos::from(self.tries - self.tries_left - 1);
            self.give_up_at = now + self.request.sign() + tried * ACKNOWLEDGE_TIMEOUT + self.patience;
        }
    }

    /// A byte came. Behind the head of a scan that the request broke off, the acknowledgement is not seen: the reply is,
    /// which may have begun now.
    pub(crate) fn hear(&mut self, baud: Baud) {
        if self.is_out() && !core::mem::replace(&mut self.is_heard, true) {
            self.give_up_at += line_time(1 + LONGEST_REPLY, baud.rate());
        }
    }

    /// The sensor acknowledged: its reply may take longer. It does so once; a stream at another rate looks like
    /// acknowledgements without end, which must not put the deadline off again and again.
    pub(crate) fn acknowledged(&mut self, now: Nanos, baud: Baud) {
        if core::mem::replace(&mut self.acknowledged, true) {
            return;
        }
        self.give_up_at = now + self.request.work() + line_time(LONGEST_REPLY, baud.rate());
    }

    /// Begins again not before `at`; `false` if all tries are used up.
    pub(crate) fn again(&mut self, at: Nanos) -> bool {
        self.sent = 0;
        self.not_before = at;
        self.acknowledged = false;
        self.is_heard = false;
        self.out_at = None;
        self.give_up_at = Nanos::MAX;
        self.tries_left.checked_sub(1).map(|left| self.tries_left = left).is_some()
    }

    /// When to call [`Outgoing::again`], if no reply came; never while it still leaves.
    pub(crate) fn give_up_at(&self) -> Nanos {
        self.give_up_at
    }

    /// Whether the sensor heard it.
    pub(crate) fn is_acknowledged(&self) -> bool {
        self.acknowledged
    }

    /// Starts over with the first byte if `now` is too late for the next one, and returns whether it is. The sensor has
    /// dropped the request, and it cannot have received its last byte. This does not count as a try. After [`MAX_RESTARTS`] the
    /// request is sent to its end anyway, so that the wait for its reply ends.
    pub(crate) fn restart_if_late(&mut self, now: Nanos, baud: Baud) -> bool {
        let is_gap = self.is_partly_out() && now > self.left_at + line_time(1, baud.rate()) + MOST_GAP;
        self.left_at = now;
        let is_late = is_gap && self.restarts < MAX_RESTARTS;
        if is_late {
            self.restarts += 1;
            (self.sent, self.not_before) = (0, now + FORGOTTEN);
        }
        is_late
    }

    /// When its last byte left; `None` while there are more.
    pub(crate) fn out_at(&self) -> Option<Nanos> {
        self.out_at
    }

    /// Command byte of its reply.
    pub(crate) fn reply(&self) -> u8 {
        self.request.command() | REPLY
    }

    /// Whether it began to leave and has not ended.
    pub(crate) fn is_partly_out(&self) -> bool {
        self.sent > 0 && !self.is_out()
    }

    /// Whether all of it left.
    pub(crate) fn is_out(&self) -> bool {
        self.sent >= self.encoded.bytes().len()
    }
}

/// A request that stops in the middle is dropped by the sensor after 6 ms (Telegram listing 4.3).
pub(crate) const FORGOTTEN: Nanos = 10 * MILLIS;
/// Between the end of a byte and the next: more than 55 us, far less than 6 ms (Telegram listing 4.3).
const GAP: Nanos = 120 * MICROS;
/// So often a request is started over because a byte was late. A machine that is late more often cannot send it.
const MAX_RESTARTS: u8 = 50;
/// Longest time between the end of a byte and the next one: 6 ms (Telegram listing 4.3), less the time of the write.
const MOST_GAP: Nanos = 5 * MILLIS;
/// A byte that may leave within so long is asked for at once; a later one is waited for as for anything else.
pub(crate) const SOON: Nanos = 5 * MILLIS;
/// ACK or NAK comes within 60 ms (Telegram listing 4.3), and a reply was captured to begin within 100 ms; the rest is
/// for adapters.
const ACKNOWLEDGE_TIMEOUT: Nanos = 150 * MILLIS;
/// The reply to a stop was captured to take 94 ms, and its acknowledgement is hidden where it is needed. Waiting is
/// cheap: a sensor that overlooked the stop continues to stream.
const STOP_TIMEOUT: Nanos = 300 * MILLIS;
/// Type, status and configuration were captured to take up to 158 ms.
pub(crate) const REPLY_TIMEOUT: Nanos = 500 * MILLIS;
/// A change of mode takes up to 3 s (Telegram listing 7.3), but mostly a tenth of one. Who asks what became of it before
/// it is over finds the mode that was, and undoes the change.
pub const MODE_TIMEOUT: Nanos = 3_200 * MILLIS;
/// Bytes of the status reply.
const LONGEST_REPLY: usize = 160;
/// After a NAK the sensor wants 30 ms of peace (Telegram listing 4.3).
pub(crate) const NAK_PAUSE: Nanos = 30 * MILLIS;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_leave_with_their_gap() {
        let mut outgoing = Outgoing::new(Request::Status, 0, 5, 2);
        let mut now = 5;
        for &expected in Request::Status.encode(0).bytes() {
            let (byte, not_before) = (outgoing.next_byte()[0], outgoing.next_at().unwrap());
            assert_eq!(byte, expected);
            assert!(not_before >= now);
            now = not_before + 7;
            outgoing.transmitted(now, Baud::B500000);
        }
        assert!(outgoing.is_out());
        assert_eq!(outgoing.give_up_at(), now + ACKNOWLEDGE_TIMEOUT);
        // What came may be the begin of the longest reply; it begins once.
        for _ in 0..2 {
            outgoing.hear(Baud::B500000);
            assert_eq!(outgoing.give_up_at(), now + ACKNOWLEDGE_TIMEOUT + line_time(161, 500_000));
        }
        assert!(outgoing.again(now));
        assert!(!outgoing.is_out() && outgoing.out_at().is_none());
        assert!(!outgoing.again(now));
    }
}
