//! Sends requests, and handles their timeouts and retries. [`crate::lms::identity_probe`] and the code that changes the
//! configuration use [`RequestChannel`]. A session has its own framer and uses only `PendingRequest`.
//!
//! The scanner requires at least 55 us and at most 6 ms between bytes, and may overlook a request while its mirror
//! rotates (Telegram listing 4.3). A request is therefore sent byte by byte.

use scanhub_schema::{MICROS, MILLIS, Nanos, line_time};

use crate::line::Action;
use crate::lms::command::Request;
use crate::lms::framer::{FoundItem, Framer, FramerCounters, TelegramSpan};
use crate::lms::reply::REFUSED;
use crate::lms::telegram::{EncodedTelegram, REPLY, Telegram};
use crate::lms::variant::Baud;

/// Port with a framer and at most one open request.
#[derive(Clone, Debug)]
pub struct RequestChannel<R> {
    framer: Framer,
    open_request: Option<PendingRequest<R>>,
    change_baud: bool,
    /// Baud rate of the port.
    pub baud: Baud,
    /// Time of the last call with a parameter `now`.
    pub now: Nanos,
    last_byte: Nanos,
    /// Address of the scanner, or 0 for all scanners while it is unknown.
    pub address: u8,
    /// Whether the port is a serial server on the network, which may deliver a complete reply in one read.
    pub is_behind_server: bool,
}

impl<R: EncodeRequest> RequestChannel<R> {
    /// Creates a channel on a port that is open at `baud`.
    pub fn new(baud: Baud, now: Nanos) -> Self {
        RequestChannel {
            framer: Framer::default(),
            open_request: None,
            change_baud: false,
            baud,
            now,
            last_byte: now,
            address: 0,
            is_behind_server: false,
        }
    }

    /// Returns the buffer of the next read, like [`Protocol::read_buffer`](crate::line::Protocol::read_buffer).
    pub fn read_buffer(&mut self) -> &mut [u8] {
        self.framer.read_buffer()
    }

    /// Handles a read of `len` bytes, like [`Protocol::commit`](crate::line::Protocol::commit).
    pub fn commit(&mut self, now: Nanos, len: usize) {
        self.now = now;
        if len > 0 {
            self.framer.commit(len);
            self.last_byte = now;
            let baud = self.baud;
            self.open_request.iter_mut().for_each(|open| open.on_byte(baud));
        }
    }

    /// Handles a read without bytes. Returns whether the reply is overdue.
    pub fn handle_timeout(&mut self, now: Nanos) -> bool {
        self.now = now;
        self.framer.release(now.saturating_sub(self.last_byte));
        self.open_request.as_ref().is_some_and(|open| now >= open.deadline)
    }

    /// Restarts the request if its next byte is late, like
    /// [`Protocol::restart_if_late`](crate::line::Protocol::restart_if_late). The channel does not restart requests to
    /// a serial server, because it does not know the gaps on the line of the server.
    pub fn restart_if_late(&mut self, now: Nanos) -> bool {
        self.now = now;
        !self.is_behind_server
            && self.open_request.as_mut().is_some_and(|open| open.restart_if_late(now, self.baud))
    }

    /// Handles the transmission of a byte, like
    /// [`Protocol::handle_transmitted`](crate::line::Protocol::handle_transmitted).
    pub fn handle_transmitted(&mut self, now: Nanos) {
        self.now = now;
        if let Some(open) = &mut self.open_request {
            open.on_byte_sent(now, self.baud);
            if self.is_behind_server {
                open.on_byte(self.baud);
            }
        }
    }

    /// Changes the baud rate of the port.
    pub fn set_baud(&mut self, baud: Baud) {
        self.change_baud |= self.baud != baud;
        self.baud = baud;
    }

    /// Sends `request`, not before `not_before`, at most `tries` times. Replaces an open request.
    pub fn send_request(&mut self, request: R, not_before: Nanos, tries: u8) {
        self.open_request = Some(PendingRequest::new(request, self.address, not_before, tries));
    }

    /// Sends the open request again, not before `not_before`. Returns whether a request was open and had a try left.
    pub fn retry(&mut self, not_before: Nanos) -> bool {
        let has_try = self.open_request.as_mut().is_some_and(|open| open.retry(not_before));
        if !has_try {
            self.open_request = None;
        }
        has_try
    }

    /// Handles a NAK. Returns whether the channel will send the request again. Returns `None` if no request was sent.
    pub fn on_nak(&mut self) -> Option<bool> {
        self.open_request
            .as_ref()
            .is_some_and(PendingRequest::is_sent)
            .then(|| self.retry(self.now + NAK_PAUSE))
    }

    /// Removes and returns the open request, if a telegram with this `command` is its reply or a refusal.
    pub fn take_answered(&mut self, command: u8) -> Option<R> {
        let is_answer = |open: &mut PendingRequest<R>| {
            open.is_sent() && (command == REFUSED || command == open.request.command() | REPLY)
        };
        self.open_request.take_if(is_answer).map(|open| open.request)
    }

    /// Returns the next telegram or NAK in the received bytes. Handles the acknowledgments before this telegram or NAK.
    pub fn advance(&mut self) -> Option<ChannelEvent> {
        // Bytes that arrived before a change of the rate are discarded.
        while !self.change_baud {
            match self.framer.advance()? {
                FoundItem::Telegram(span) => return Some(ChannelEvent::Telegram(span)),
                FoundItem::Nak => return Some(ChannelEvent::Nak),
                FoundItem::Ack => {
                    if let Some(open) = self.open_request.as_mut().filter(|open| open.is_sent()) {
                        open.on_acknowledged(self.now, self.baud);
                    }
                }
            }
        }
        None
    }

    /// Returns the telegram that [`advance`](Self::advance) returned last.
    pub fn view(&self, span: TelegramSpan) -> Telegram<'_> {
        self.framer.telegram_at(span).telegram
    }

    /// Returns the next action. `caller_deadline` is an additional deadline of the caller.
    pub fn poll_action(&mut self, caller_deadline: Nanos) -> Action<'_> {
        if core::mem::take(&mut self.change_baud) {
            self.framer.clear();
            return Action::SetRate(self.baud.rate());
        }
        self.framer.expect_acknowledge(self.open_request.is_some());
        let mut until = caller_deadline;
        if let Some(open) = &self.open_request {
            match open.next_at() {
                Some(not_before) if not_before <= self.now + SEND_AHEAD => {
                    return Action::Transmit { bytes: open.next_byte(), not_before };
                }
                Some(not_before) => until = until.min(not_before),
                None => until = until.min(open.deadline),
            }
        }
        if let Some(hold) = self.framer.hold_time() {
            until = until.min(self.last_byte + hold);
        }
        Action::Wait { until }
    }

    /// Returns the counters of bytes, and the number of buffered bytes, which no other counter includes yet.
    pub fn byte_counters(&self) -> (&FramerCounters, usize) {
        (self.framer.counters(), self.framer.buffered())
    }
}

/// A received telegram or NAK.
#[derive(Clone, Copy, Debug)]
pub enum ChannelEvent {
    /// A telegram, which [`RequestChannel::view`] returns.
    Telegram(TelegramSpan),
    /// A NAK.
    Nak,
}

/// A request that has a reply.
pub trait EncodeRequest {
    /// Encodes the request for the scanner at `address`.
    fn encode(&self, address: u8) -> EncodedTelegram;
    /// Returns the command byte.
    fn command(&self) -> u8;
    /// Returns the maximum time from the acknowledgment to the reply.
    fn reply_timeout(&self) -> Nanos;
    /// Returns the maximum time to the acknowledgment. If the scanner sends no acknowledgment, this is the maximum time
    /// to the first byte of the reply.
    fn acknowledge_timeout(&self) -> Nanos {
        ACKNOWLEDGE_TIMEOUT
    }
}

impl EncodeRequest for Request {
    fn encode(&self, address: u8) -> EncodedTelegram {
        Request::encode(*self, address)
    }

    fn command(&self) -> u8 {
        Request::command(*self)
    }

    fn reply_timeout(&self) -> Nanos {
        match self {
            Request::Stream | Request::Stop | Request::Baud(_) => MODE_TIMEOUT,
            _ => REPLY_TIMEOUT,
        }
    }

    fn acknowledge_timeout(&self) -> Nanos {
        if *self == Request::Stop { STOP_TIMEOUT } else { ACKNOWLEDGE_TIMEOUT }
    }
}

/// The open request, with its progress and its deadlines.
#[derive(Clone, Debug)]
pub(crate) struct PendingRequest<R = Request> {
    pub(crate) request: R,
    encoded: EncodedTelegram,
    sent: usize,
    not_before: Nanos,
    /// Earliest time at which the last byte can have left the port, see [`PendingRequest::restart_if_late`].
    min_sent_at: Nanos,
    /// Number of restarts because a byte was late.
    restarts: u8,
    max_tries: u8,
    tries_left: u8,
    /// Additional time until the acknowledgment, for each try.
    extra_time: Nanos,
    pub(crate) is_acknowledged: bool,
    /// Whether a byte has arrived since the last byte of the request was sent.
    has_received: bool,
    /// Time at which the last byte of the request was sent.
    pub(crate) sent_at: Option<Nanos>,
    /// End of the wait for the reply. This wait begins when the last byte of the request was sent.
    pub(crate) deadline: Nanos,
}

impl<R: EncodeRequest> PendingRequest<R> {
    /// Creates `request` for the scanner at `address`. It is sent not before `not_before`, at most `tries` times.
    pub(crate) fn new(request: R, address: u8, not_before: Nanos, tries: u8) -> Self {
        let encoded = request.encode(address);
        PendingRequest {
            request,
            encoded,
            sent: 0,
            not_before,
            min_sent_at: 0,
            restarts: 0,
            max_tries: tries,
            tries_left: tries - 1,
            extra_time: 0,
            is_acknowledged: false,
            has_received: false,
            sent_at: None,
            deadline: Nanos::MAX,
        }
    }

    /// Extends the wait for the acknowledgment by `extra_time`.
    pub(crate) fn extend_timeout(&mut self, extra_time: Nanos) {
        self.extra_time = extra_time;
    }

    /// Returns the next byte, or an empty slice if all bytes were sent.
    pub(crate) fn next_byte(&self) -> &[u8] {
        self.encoded.bytes().get(self.sent..=self.sent).unwrap_or_default()
    }

    /// Returns the earliest time of the next byte. Returns `None` if all bytes were sent.
    pub(crate) fn next_at(&self) -> Option<Nanos> {
        (!self.is_sent()).then_some(self.not_before)
    }

    /// Records that the next byte was sent at `now`.
    pub(crate) fn on_byte_sent(&mut self, now: Nanos, baud: Baud) {
        self.sent += 1;
        self.not_before = now + line_time(1, baud.rate()) + BYTE_GAP;
        if self.sent == self.encoded.bytes().len() {
            self.sent_at = Some(now);
            // A slow scanner needs a longer wait, not more tries, because each try interrupts the try before it.
            let previous_tries = Nanos::from(self.max_tries - self.tries_left - 1);
            self.deadline = now
                + self.request.acknowledge_timeout()
                + previous_tries * ACKNOWLEDGE_TIMEOUT
                + self.extra_time;
        }
    }

    /// Records the arrival of bytes, and extends the deadline once. If the request interrupted a scan, the framer does
    /// not detect the acknowledgment. The bytes may then be the beginning of the reply.
    pub(crate) fn on_byte(&mut self, baud: Baud) {
        if self.is_sent() && !core::mem::replace(&mut self.has_received, true) {
            self.deadline += line_time(1 + MAX_REPLY_LEN, baud.rate());
        }
    }

    /// Handles an acknowledgment, after which the reply may take longer. Only the first acknowledgment extends the
    /// deadline, because a stream at another rate looks like endless acknowledgments.
    pub(crate) fn on_acknowledged(&mut self, now: Nanos, baud: Baud) {
        if core::mem::replace(&mut self.is_acknowledged, true) {
            return;
        }
        self.deadline = now + self.request.reply_timeout() + line_time(MAX_REPLY_LEN, baud.rate());
    }

    /// Starts the request again, not before `not_before`. Returns whether a try was left.
    pub(crate) fn retry(&mut self, not_before: Nanos) -> bool {
        self.sent = 0;
        self.not_before = not_before;
        self.is_acknowledged = false;
        self.has_received = false;
        self.sent_at = None;
        self.deadline = Nanos::MAX;
        self.tries_left.checked_sub(1).map(|left| self.tries_left = left).is_some()
    }

    /// Restarts the request if `now` is too late for its next byte. The scanner has then discarded the incomplete
    /// request. Returns whether the request was restarted. A restart does not use up a try. After [`MAX_RESTARTS`]
    /// restarts, the whole request is sent even if bytes are late, so that the wait for its reply ends.
    pub(crate) fn restart_if_late(&mut self, now: Nanos, baud: Baud) -> bool {
        let is_gap =
            self.is_partly_sent() && now > self.min_sent_at + line_time(1, baud.rate()) + MAX_BYTE_GAP;
        self.min_sent_at = now;
        let is_late = is_gap && self.restarts < MAX_RESTARTS;
        if is_late {
            self.restarts += 1;
            (self.sent, self.not_before) = (0, now + PARTIAL_REQUEST_TIMEOUT);
        }
        is_late
    }

    /// Returns the command byte of the reply.
    pub(crate) fn reply(&self) -> u8 {
        self.request.command() | REPLY
    }

    /// Returns whether some bytes were sent, but not all bytes.
    pub(crate) fn is_partly_sent(&self) -> bool {
        self.sent > 0 && !self.is_sent()
    }

    /// Returns whether all bytes were sent.
    pub(crate) fn is_sent(&self) -> bool {
        self.sent >= self.encoded.bytes().len()
    }
}

/// Number of tries of a request. A scanner may overlook a request while its mirror rotates. All known drivers try three
/// times.
pub const TRIES: u8 = 3;
/// Number of tries of requests that are necessary for a stream.
pub const ESSENTIAL_TRIES: u8 = 5;
/// Time after which the scanner has certainly discarded a partly sent request. The scanner discards such a request
/// after 6 ms (Telegram listing 4.3).
pub(crate) const PARTIAL_REQUEST_TIMEOUT: Nanos = 10 * MILLIS;
/// Time from the end of a byte to the start of the next byte: more than 55 us, and much less than 6 ms (Telegram
/// listing 4.3).
const BYTE_GAP: Nanos = 120 * MICROS;
/// Maximum number of restarts of a request because a byte was late. If a machine is late more often, it cannot send the
/// request.
const MAX_RESTARTS: u8 = 50;
/// Maximum time from the end of a byte to the start of the next byte: 6 ms (Telegram listing 4.3), minus the duration
/// of the write.
const MAX_BYTE_GAP: Nanos = 5 * MILLIS;
/// Maximum time before a byte is due at which the session returns the byte. Until then, the session returns a deadline.
pub(crate) const SEND_AHEAD: Nanos = 5 * MILLIS;
/// Timeout of the acknowledgment. An ACK or NAK arrives within 60 ms (Telegram listing 4.3), and captured replies begin
/// within 100 ms. The remaining time is for adapters.
const ACKNOWLEDGE_TIMEOUT: Nanos = 150 * MILLIS;
/// Timeout of the acknowledgment of a stop request. A captured reply takes 94 ms, and the stream hides the
/// acknowledgment. A long timeout costs little, because a scanner that overlooked the request continues to stream.
const STOP_TIMEOUT: Nanos = 300 * MILLIS;
/// Timeout of a reply. Captured replies with type, status and configuration take up to 158 ms.
pub(crate) const REPLY_TIMEOUT: Nanos = 500 * MILLIS;
/// Timeout of a change of mode. The change takes up to 3 s (Telegram listing 7.3), but usually 0.1 s. A status request
/// before the end of the change returns the previous mode and undoes the change.
pub const MODE_TIMEOUT: Nanos = 3_200 * MILLIS;
/// Length of the longest expected reply, the status, in bytes.
const MAX_REPLY_LEN: usize = 160;
/// Pause after a NAK: the scanner requires 30 ms (Telegram listing 4.3).
pub(crate) const NAK_PAUSE: Nanos = 30 * MILLIS;

#[cfg(test)]
mod tests {
    use scanhub_schema::{MILLIS, line_time};

    use super::*;
    use crate::lms::command::Request;

    #[test]
    fn reply_timeout_is_longer_behind_a_serial_server() {
        let until = |behind_server: bool| {
            let mut exchange = RequestChannel::new(Baud::B9600, 0);
            exchange.is_behind_server = behind_server;
            exchange.send_request(Request::Status, 0, 1);
            loop {
                match exchange.poll_action(Nanos::MAX) {
                    Action::Transmit { not_before, .. } => exchange.handle_transmitted(not_before),
                    Action::Wait { until } => return until - exchange.now,
                    output => panic!("{output:?}"),
                }
            }
        };
        assert_eq!(until(false), 150 * MILLIS);
        assert_eq!(until(true), 150 * MILLIS + line_time(161, 9600));
    }

    #[test]
    fn late_byte_restarts_request_without_using_a_try() {
        for (gap, is_late) in [(5 * MILLIS, false), (5 * MILLIS + 1, true)] {
            let byte_ns = line_time(1, 9_600);
            let mut exchange = RequestChannel::new(Baud::B9600, 0);
            exchange.send_request(Request::Status, 0, 1);
            let request = Request::Status.encode(0);
            let (mut written, mut now, mut restarts) = (0, 0, 0);
            while written < request.bytes().len() {
                match exchange.poll_action(Nanos::MAX) {
                    Action::Transmit { bytes, not_before } => {
                        let &[byte] = bytes else { panic!("no gaps between {bytes:?}") };
                        // The fourth byte is late once.
                        let late = if written == 3 && restarts == 0 { byte_ns + gap } else { 0 };
                        now = (now + late).max(not_before);
                        if exchange.restart_if_late(now) {
                            (written, restarts) = (0, restarts + 1);
                            continue;
                        }
                        assert_eq!(byte, request.bytes()[written]);
                        written += 1;
                        exchange.handle_transmitted(now);
                    }
                    Action::Wait { until } => {
                        // The scanner drops the bytes that it has received.
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
    fn restarts_late_request_at_most_50_times() {
        for behind_server in [false, true] {
            let mut exchange = RequestChannel::new(Baud::B9600, 0);
            exchange.is_behind_server = behind_server;
            exchange.send_request(Request::Status, 0, 1);
            let (mut now, mut restarts) = (0, 0);
            loop {
                match exchange.poll_action(Nanos::MAX) {
                    Action::Transmit { not_before, .. } => {
                        now = now.max(not_before) + 50 * MILLIS;
                        if exchange.restart_if_late(now) {
                            restarts += 1;
                        } else {
                            exchange.handle_transmitted(now);
                        }
                    }
                    Action::Wait { until } => {
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
        let mut outgoing = PendingRequest::new(Request::Status, 0, 5, 2);
        let mut now = 5;
        for &expected in Request::Status.encode(0).bytes() {
            let (byte, not_before) = (outgoing.next_byte()[0], outgoing.next_at().unwrap());
            assert_eq!(byte, expected);
            assert!(not_before >= now);
            now = not_before + 7;
            outgoing.on_byte_sent(now, Baud::B500000);
        }
        assert!(outgoing.is_sent());
        assert_eq!(outgoing.deadline, now + ACKNOWLEDGE_TIMEOUT);
        // The bytes may be the beginning of the longest reply. A reply begins only once, so the second call does not
        // extend the deadline.
        for _ in 0..2 {
            outgoing.on_byte(Baud::B500000);
            assert_eq!(outgoing.deadline, now + ACKNOWLEDGE_TIMEOUT + line_time(161, 500_000));
        }
        assert!(outgoing.retry(now));
        assert!(!outgoing.is_sent() && outgoing.sent_at.is_none());
        assert!(!outgoing.retry(now));
    }
}
