//! Sends one request after another, and returns the replies. [`crate::lms::inquiry`] and a change of the configuration
//! use it.

use crate::line::Output;
use crate::lms::framer::{Advance, Framer, Tally, TelegramSpan};
pub use crate::lms::outgoing::{MODE_TIMEOUT, MORE_TRIES, Say, TRIES};
use crate::lms::outgoing::{NAK_PAUSE, Outgoing, SOON};
use crate::lms::reply::REFUSED;
use crate::lms::telegram::{REPLY, Telegram};
use crate::lms::variant::Baud;
use scanhub_schema::Nanos;

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
        self.open.as_ref().is_some_and(|open| now >= open.give_up_at())
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
                None => until = until.min(open.give_up_at()),
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lms::command::Request;
    use scanhub_schema::{MILLIS, line_time};

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
}
