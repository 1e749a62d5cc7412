//! Sends one request after another, and returns the replies. [`crate::lms::inquiry`] and a change of the configuration
//! use [`Exchange`]. A session only uses `Outgoing`, the request that is being sent, or whose reply is expected.
//!
//! The scanner requires at least 55 us and at most 6 ms between bytes, and may overlook a request while its mirror rotates
//! (Telegram listing 4.3). So a request is sent byte by byte.

use scanhub_schema::{MICROS, MILLIS, Nanos, line_time};

use crate::line::Output;
use crate::lms::command::Request;
use crate::lms::framer::{Advance, Framer, Tally, TelegramSpan};
use crate::lms::reply::REFUSED;
use crate::lms::telegram::{Encoded, REPLY, Telegram};
use crate::lms::variant::Baud;

/// A line with at most one open request.
#[derive(Clone, Debug)]
pub struct Exchange<R> {
    framer: Framer,
    open: Option<Outgoing<R>>,
    change_baud: bool,
    /// Rate of the port.
    pub baud: Baud,
    /// Time of the last call.
    pub now: Nanos,
    last_byte: Nanos,
    /// Address of the scanner, once it is known; 0 is for all.
    pub address: u8,
    /// Whether the port is a serial server on the network, whose first bytes of a reply may be all of it.
    pub behind_server: bool,
}

impl<R: Say> Exchange<R> {
    /// Creates it on a port that is open at `baud`.
    pub fn new(baud: Baud, now: Nanos) -> Self {
        Exchange {
            framer: Framer::default(),
            open: None,
            change_baud: false,
            baud,
            now,
            last_byte: now,
            address: 0,
            behind_server: false,
        }
    }

    /// Returns the buffer of the next read, like [`Protocol::spare`](crate::line::Protocol::spare).
    pub fn spare(&mut self) -> &mut [u8] {
        self.framer.spare()
    }

    /// Handles a read of `len` bytes, like [`Protocol::commit`](crate::line::Protocol::commit).
    pub fn commit(&mut self, now: Nanos, len: usize) {
        self.now = now;
        if len > 0 {
            self.framer.commit(len);
            self.last_byte = now;
            let baud = self.baud;
            self.open.iter_mut().for_each(|open| open.hear(baud));
        }
    }

    /// Handles a read that found nothing. Returns whether the wait for the reply has ended.
    pub fn handle_timeout(&mut self, now: Nanos) -> bool {
        self.now = now;
        self.framer.release(now.saturating_sub(self.last_byte));
        self.open.as_ref().is_some_and(|open| now >= open.give_up_at)
    }

    /// Handles that a byte is about to be written, like
    /// [`Protocol::restart_if_late`](crate::line::Protocol::restart_if_late). For a serial server, the gaps on the line
    /// are not known.
    pub fn restart_if_late(&mut self, now: Nanos) -> bool {
        self.now = now;
        !self.behind_server && self.open.as_mut().is_some_and(|open| open.restart_if_late(now, self.baud))
    }

    /// Handles that a byte was written, like [`Protocol::transmitted`](crate::line::Protocol::transmitted).
    pub fn transmitted(&mut self, now: Nanos) {
        self.now = now;
        if let Some(open) = &mut self.open {
            open.transmitted(now, self.baud);
            if self.behind_server {
                open.hear(self.baud);
            }
        }
    }

    /// Changes the rate.
    pub fn set_baud(&mut self, baud: Baud) {
        self.change_baud |= self.baud != baud;
        self.baud = baud;
    }

    /// Sends `request` from `not_before` on, at most `tries` times.
    pub fn ask(&mut self, request: R, not_before: Nanos, tries: u8) {
        self.open = Some(Outgoing::new(request, self.address, not_before, tries));
    }

    /// Sends the open request once more, from `at` on. Returns whether there is one, and it had a try left.
    pub fn again(&mut self, at: Nanos) -> bool {
        let more = self.open.as_mut().is_some_and(|open| open.again(at));
        if !more {
            self.open = None;
        }
        more
    }

    /// Handles a NAK that counts. Returns whether the request will be sent again. `None` if there was none.
    pub fn refused_checksum(&mut self) -> Option<bool> {
        self.open.as_ref().is_some_and(Outgoing::is_out).then(|| self.again(self.now + NAK_PAUSE))
    }

    /// Removes the open request if a telegram with this `command` is its reply, or a refusal.
    pub fn answered(&mut self, command: u8) -> Option<R> {
        let answers = |open: &mut Outgoing<R>| {
            open.is_out() && (command == REFUSED || command == open.request.command() | REPLY)
        };
        self.open.take_if(answers).map(|open| open.request)
    }

    /// Returns the next telegram or NAK in the received bytes, and handles acknowledgments.
    pub fn advance(&mut self) -> Option<Heard> {
        // Bytes that arrived before a change of the rate are not checked.
        while !self.change_baud {
            match self.framer.advance()? {
                Advance::Telegram(span) => return Some(Heard::Telegram(span)),
                Advance::Nak => return Some(Heard::Nak),
                Advance::Ack => {
                    if let Some(open) = self.open.as_mut().filter(|open| open.is_out()) {
                        open.acknowledged(self.now, self.baud);
                    }
                }
            }
        }
        None
    }

    /// Returns the telegram that was found last.
    pub fn view(&self, span: TelegramSpan) -> Telegram<'_> {
        self.framer.view(span).telegram
    }

    /// Returns the next action. `own` is an additional deadline of the caller.
    pub fn output(&mut self, own: Nanos) -> Output<'_> {
        if core::mem::take(&mut self.change_baud) {
            self.framer.clear();
            return Output::SetRate(self.baud.rate());
        }
        self.framer.await_acknowledge(self.open.is_some());
        let mut until = own;
        if let Some(open) = &self.open {
            match open.next_at() {
                Some(not_before) if not_before <= self.now + SOON => {
                    return Output::Transmit { bytes: open.next_byte(), not_before };
                }
                Some(not_before) => until = until.min(not_before),
                None => until = until.min(open.give_up_at),
            }
        }
        if let Some(hold) = self.framer.hold() {
            until = until.min(self.last_byte + hold);
        }
        Output::Wait { until }
    }

    /// Returns the counters of bytes, and the number of bytes that are not assigned yet.
    pub fn tally(&self) -> (&Tally, usize) {
        (self.framer.tally(), self.framer.buffered())
    }
}

/// A received telegram or NAK.
#[derive(Clone, Copy, Debug)]
pub enum Heard {
    /// A telegram. [`Exchange::view`] returns it.
    Telegram(TelegramSpan),
    /// A NAK.
    Nak,
}

/// A telegram that has a reply.
pub trait Say {
    /// Encodes it for the scanner at `address`.
    fn encode(&self, address: u8) -> Encoded;
    /// Returns its command byte.
    fn command(&self) -> u8;
    /// Returns the maximum time from the acknowledgment to the reply.
    fn work(&self) -> Nanos;
    /// Returns the maximum time to the acknowledgment, or to the first byte of a reply without one.
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
    /// Number of times that the request was started over because a byte was late.
    restarts: u8,
    tries: u8,
    tries_left: u8,
    /// Additional time for each wait for the acknowledgment.
    patience: Nanos,
    pub(crate) acknowledged: bool,
    /// Whether a byte has arrived since the last one was sent.
    is_heard: bool,
    /// Time at which the last byte was sent.
    pub(crate) out_at: Option<Nanos>,
    /// End of the wait for the reply, which begins with the last byte.
    pub(crate) give_up_at: Nanos,
}

impl<R: Say> Outgoing<R> {
    /// Creates `request` for the scanner at `address`, to be sent from `not_before` on, at most `tries` times.
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

    /// Extends the wait for the acknowledgment by `patience`.
    pub(crate) fn be_patient(&mut self, patience: Nanos) {
        self.patience = patience;
    }

    /// Returns the next byte. Empty if all of them were sent.
    pub(crate) fn next_byte(&self) -> &[u8] {
        self.encoded.bytes().get(self.sent..=self.sent).unwrap_or_default()
    }

    /// Returns the earliest time of the next byte.
    pub(crate) fn next_at(&self) -> Option<Nanos> {
        (!self.is_out()).then_some(self.not_before)
    }

    /// Handles that the next byte was sent at `now`.
    pub(crate) fn transmitted(&mut self, now: Nanos, baud: Baud) {
        self.sent += 1;
        self.not_before = now + line_time(1, baud.rate()) + GAP;
        if self.sent == self.encoded.bytes().len() {
            self.out_at = Some(now);
            // A slow scanner needs a longer wait, not more tries, because each try interrupts the last one.
            let tried = Nanos::from(self.tries - self.tries_left - 1);
            self.give_up_at = now + self.request.sign() + tried * ACKNOWLEDGE_TIMEOUT + self.patience;
        }
    }

    /// Handles that bytes arrived. After the beginning of a scan that the request interrupted, the acknowledgment is
    /// not detected, only the reply, which may have begun now.
    pub(crate) fn hear(&mut self, baud: Baud) {
        if self.is_out() && !core::mem::replace(&mut self.is_heard, true) {
            self.give_up_at += line_time(1 + LONGEST_REPLY, baud.rate());
        }
    }

    /// Handles an acknowledgment, after which the reply may take longer. Only the first one counts: a stream at another
    /// rate looks like endless acknowledgments, which must not extend the deadline again and again.
    pub(crate) fn acknowledged(&mut self, now: Nanos, baud: Baud) {
        if core::mem::replace(&mut self.acknowledged, true) {
            return;
        }
        self.give_up_at = now + self.request.work() + line_time(LONGEST_REPLY, baud.rate());
    }

    /// Begins again, not before `at`. Returns whether there was a try left.
    pub(crate) fn again(&mut self, at: Nanos) -> bool {
        self.sent = 0;
        self.not_before = at;
        self.acknowledged = false;
        self.is_heard = false;
        self.out_at = None;
        self.give_up_at = Nanos::MAX;
        self.tries_left.checked_sub(1).map(|left| self.tries_left = left).is_some()
    }

    /// Starts over with the first byte if `now` is too late for the next one, and returns whether it is. The sensor has
    /// dropped the request, and it cannot have received its last byte. This does not count as a try. After
    /// [`MAX_RESTARTS`] the request is sent to its end anyway, so that the wait for its reply ends.
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

    /// Returns the command byte of its reply.
    pub(crate) fn reply(&self) -> u8 {
        self.request.command() | REPLY
    }

    /// Returns whether some of its bytes were sent, but not all.
    pub(crate) fn is_partly_out(&self) -> bool {
        self.sent > 0 && !self.is_out()
    }

    /// Returns whether all of it was sent.
    pub(crate) fn is_out(&self) -> bool {
        self.sent >= self.encoded.bytes().len()
    }
}

/// Number of tries. A scanner may overlook a request while its mirror rotates. All drivers give it three tries.
pub const TRIES: u8 = 3;
/// Number of tries of requests without which there is no stream.
pub const MORE_TRIES: u8 = 5;
/// The scanner drops a partial request after 6 ms (Telegram listing 4.3).
pub(crate) const FORGOTTEN: Nanos = 10 * MILLIS;
/// Time from the end of a byte to the next one: more than 55 us, far less than 6 ms (Telegram listing 4.3).
const GAP: Nanos = 120 * MICROS;
/// Maximum number of times that a request starts over because a byte was late. A machine that is late more often cannot
/// send it.
const MAX_RESTARTS: u8 = 50;
/// Longest time between the end of a byte and the next one: 6 ms (Telegram listing 4.3), less the time of the write.
const MOST_GAP: Nanos = 5 * MILLIS;
/// A byte that may be sent within this time is requested at once. A later one has a deadline like everything else.
pub(crate) const SOON: Nanos = 5 * MILLIS;
/// ACK or NAK arrives within 60 ms (Telegram listing 4.3), and captured replies begin within 100 ms. The rest is for
/// adapters.
const ACKNOWLEDGE_TIMEOUT: Nanos = 150 * MILLIS;
/// A captured reply to a stop takes 94 ms, and its acknowledgment is hidden in the stream. Waiting is cheap: a scanner
/// that overlooked the stop continues to stream.
const STOP_TIMEOUT: Nanos = 300 * MILLIS;
/// Captured replies with type, status and configuration take up to 158 ms.
pub(crate) const REPLY_TIMEOUT: Nanos = 500 * MILLIS;
/// A change of mode takes up to 3 s (Telegram listing 7.3), but mostly 0.1 s. A request for the mode before its end
/// returns the previous mode, and undoes the change.
pub const MODE_TIMEOUT: Nanos = 3_200 * MILLIS;
/// Length of the status reply, in bytes.
const LONGEST_REPLY: usize = 160;
/// The scanner requires a pause of 30 ms after a NAK (Telegram listing 4.3).
pub(crate) const NAK_PAUSE: Nanos = 30 * MILLIS;

#[cfg(test)]
mod tests {
    use scanhub_schema::{MILLIS, line_time};

    use super::*;
    use crate::lms::command::Request;

    #[test]
    fn waits_for_a_server_that_packs_the_longest_reply() {
        let until = |behind_server: bool| {
            let mut exchange = Exchange::new(Baud::B9600, 0);
            exchange.behind_server = behind_server;
            exchange.ask(Request::Status, 0, 1);
            loop {
                match exchange.output(Nanos::MAX) {
                    Output::Transmit { not_before, .. } => exchange.transmitted(not_before),
                    Output::Wait { until } => return until - exchange.now,
                    output => panic!("{output:?}"),
                }
            }
        };
        assert_eq!(until(false), 150 * MILLIS);
        assert_eq!(until(true), 150 * MILLIS + line_time(161, 9600));
    }

    #[test]
    fn a_request_whose_next_byte_is_late_starts_over_without_a_try() {
        for (gap, is_late) in [(5 * MILLIS, false), (5 * MILLIS + 1, true)] {
            let byte_ns = line_time(1, 9_600);
            let mut exchange = Exchange::new(Baud::B9600, 0);
            exchange.ask(Request::Status, 0, 1);
            let request = Request::Status.encode(0);
            let (mut written, mut now, mut restarts) = (0, 0, 0);
            while written < request.bytes().len() {
                match exchange.output(Nanos::MAX) {
                    Output::Transmit { bytes, not_before } => {
                        let &[byte] = bytes else { panic!("no gaps between {bytes:?}") };
                        // The fourth byte is late, once.
                        let late = if written == 3 && restarts == 0 { byte_ns + gap } else { 0 };
                        now = (now + late).max(not_before);
                        if exchange.restart_if_late(now) {
                            (written, restarts) = (0, restarts + 1);
                            continue;
                        }
                        assert_eq!(byte, request.bytes()[written]);
                        written += 1;
                        exchange.transmitted(now);
                    }
                    Output::Wait { until } => {
                        // The sensor forgets what it has received.
                        assert_eq!((until - now, written), (10 * MILLIS, 0));
                        now = until;
                        assert!(!exchange.handle_timeout(now));
                    }
                    output => panic!("{output:?}"),
                }
            }
            assert_eq!(restarts, u32::from(is_late), "{gap}");
        }
    }

    #[test]
    fn a_machine_that_is_always_late_does_not_restart_forever() {
        for behind_server in [false, true] {
            let mut exchange = Exchange::new(Baud::B9600, 0);
            exchange.behind_server = behind_server;
            exchange.ask(Request::Status, 0, 1);
            let (mut now, mut restarts) = (0, 0);
            loop {
                match exchange.output(Nanos::MAX) {
                    Output::Transmit { not_before, .. } => {
                        now = now.max(not_before) + 50 * MILLIS;
                        if exchange.restart_if_late(now) {
                            restarts += 1;
                        } else {
                            exchange.transmitted(now);
                        }
                    }
                    Output::Wait { until } => {
                        now = until;
                        if exchange.handle_timeout(now) {
                            break;
                        }
                    }
                    output => panic!("{output:?}"),
                }
            }
            assert_eq!(restarts, if behind_server { 0 } else { 50 });
        }
    }

    #[test]
    fn bytes_are_sent_with_gaps() {
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
        assert_eq!(outgoing.give_up_at, now + ACKNOWLEDGE_TIMEOUT);
        // The bytes may be the start of the longest reply, which starts once.
        for _ in 0..2 {
            outgoing.hear(Baud::B500000);
            assert_eq!(outgoing.give_up_at, now + ACKNOWLEDGE_TIMEOUT + line_time(161, 500_000));
        }
        assert!(outgoing.again(now));
        assert!(!outgoing.is_out() && outgoing.out_at.is_none());
        assert!(!outgoing.again(now));
    }
}
