//! One request after the other, and what comes back: what [`crate::lms::inquiry`] and a change of the configuration have in common. Knows
//! pace, tries and bytes; refuses to know what is asked, and why.

use crate::line::Output;
use crate::lms::framer::{Advance, Framer, Tally, TelegramSpan};
pub use crate::lms::outgoing::{MODE_TIMEOUT, Say};
use crate::lms::outgoing::{NAK_PAUSE, Outgoing, SOON};
pub use crate::lms::phase::{MORE_TRIES, TRIES};
use crate::lms::reply::REFUSED;
use crate::lms::telegram::{REPLY, Telegram};
use crate::lms::variant::Baud;
use schema::Nanos;

/// A line with at most one open request.
#[derive(Clone, Debug)]
pub struct Exchange<R> {
    framer: Framer,
    open: Option<Outgoing<R>>,
    change_baud: bool,
    /// The rate that the port is to have.
    pub baud: Baud,
    /// When it was last told something.
    pub now: Nanos,
    last_byte: Nanos,
    /// The sensor's own address, once it has said it; 0 is for all.
    pub address: u8,
    /// Behind a server, whose first sign of a reply may be all of it.
    pub behind_server: bool,
}

impl<R: Say> Exchange<R> {
    /// On a port that is open at `baud`.
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

    /// A read found nothing; returns whether the open request has waited long enough.
    pub fn handle_timeout(&mut self, now: Nanos) -> bool {
        self.now = now;
        self.framer.release(now.saturating_sub(self.last_byte));
        self.open.as_ref().is_some_and(|open| now >= open.give_up_at())
    }

    /// As [`Protocol::restart_if_late`](crate::line::Protocol::restart_if_late). Behind a server, the gaps on the line are not known.
    pub fn restart_if_late(&mut self, now: Nanos) -> bool {
        self.now = now;
        !self.behind_server && self.open.as_mut().is_some_and(|open| open.restart_if_late(now, self.baud))
    }

    /// As [`Protocol::transmitted`](crate::line::Protocol::transmitted).
    pub fn transmitted(&mut self, now: Nanos) {
        self.now = now;
        if let Some(open) = &mut self.open {
            open.transmitted(now, self.baud);
            if self.behind_server {
                open.hear(self.baud);
            }
        }
    }

    /// Changes the rate, if it is another one.
    pub fn set_baud(&mut self, baud: Baud) {
        self.change_baud |= self.baud != baud;
        self.baud = baud;
    }

    /// Says `request` from `not_before` on, at most `tries` times.
    pub fn ask(&mut self, request: R, not_before: Nanos, tries: u8) {
        self.open = Some(Outgoing::new(request, self.address, not_before, tries));
    }

    /// Says the open request once more from `at` on; `false` if its tries are used up or there is none.
    pub fn again(&mut self, at: Nanos) -> bool {
        let more = self.open.as_mut().is_some_and(|open| open.again(at));
        if !more {
            self.open = None;
        }
        more
    }

    /// A NAK came that is to be believed; returns whether there was a request, and whether it will be said again.
    pub fn refused_checksum(&mut self) -> Option<bool> {
        self.open.as_ref().is_some_and(Outgoing::is_out).then(|| self.again(self.now + NAK_PAUSE))
    }

    /// Takes the open request if `telegram` answers it, or refuses it.
    pub fn answered(&mut self, command: u8) -> Option<R> {
        let answers = |open: &mut Outgoing<R>| {
            open.is_out() && (command == REFUSED || command == open.request.command() | REPLY)
        };
        self.open.take_if(answers).map(|open| open.request)
    }

    /// The next thing found in the bytes; an acknowledgement is taken note of.
    pub fn advance(&mut self) -> Option<Heard> {
        // Another rate is about to be set: what came at the old one is not looked at.
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

    /// The telegram that was found last.
    pub fn view(&self, span: TelegramSpan) -> Telegram<'_> {
        self.framer.view(span).telegram
    }

    /// What it wants, with a deadline of its user's own.
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

    /// What became of the bytes, and how many are open.
    pub fn tally(&self) -> (&Tally, usize) {
        (self.framer.tally(), self.framer.buffered())
    }
}

/// What came.
#[derive(Clone, Copy, Debug)]
pub enum Heard {
    /// A telegram, to be seen by [`Exchange::view`].
    Telegram(TelegramSpan),
    /// A NAK.
    Nak,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lms::command::Request;
    use schema::{MILLIS, line_time};

    #[test]
    fn a_server_that_packs_the_longest_reply_is_waited_for() {
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
