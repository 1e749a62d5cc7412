//! Finds the rate of a scanner, and requests what it is, without changing its mode, its rate or a setting. A scanner
//! that streams continues; each reply costs a scan.
//!
//! The inquiry listens first, because a stream at the port's rate needs no request. Then it requests the status at each
//! rate, in two rounds, because a scanner may overlook a request. A rate at which telegrams arrived is tried more
//! often.

use scanhub_schema::{Nanos, line_time};

use crate::line::family::table;
use crate::line::{Output, Protocol};
use crate::lms::command::Request;
use crate::lms::configuration::Configuration;
use crate::lms::dialogue::LISTEN;
use crate::lms::exchange::{Exchange, Heard, TRIES};
use crate::lms::family::Family;
use crate::lms::framer::{Tally, TelegramSpan};
use crate::lms::header::is_data;
use crate::lms::rate::SETTLE;
use crate::lms::reply::Reply;
use crate::lms::status::{Condition, DIRTY, Errors, StatusReport};
use crate::lms::telegram::{Encoded, MAX_TELEGRAM, REPLY};
use crate::lms::variant::Baud;

/// Progress of an inquiry.
#[derive(Clone, Debug)]
pub struct Inquiry {
    exchange: Exchange<Request>,
    phase: Phase,
    /// The rates in the order of the search.
    rates: [Baud; Baud::ALL.len()],
    /// Number of rates that are tried.
    count: usize,
    /// Number of telegrams that arrived without a request at each of them.
    unasked: [u32; Baud::ALL.len()],
    /// Number of further requests at a rate at which telegrams arrived.
    patience: u8,
    report: Report,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    Listening {
        give_up_at: Nanos,
    },
    Seeking {
        attempt: usize,
    },
    Asking {
        question: usize,
    },
    /// Bytes arrived, but no reply. The inquiry checks whether they are a stream.
    ListeningAgain {
        attempt: usize,
        give_up_at: Nanos,
    },
    Done,
}

impl Inquiry {
    /// All rates of a scanner, in bits per second.
    pub const RATES: [u32; Baud::ALL.len()] = table!(Baud::ALL, Baud::rate);

    /// Creates an inquiry on a port that is open at `rate`, in bits per second. Without a rate, the port is a serial
    /// server, whose rate is set there.
    pub fn begin(rate: Option<u32>, now: Nanos) -> Self {
        match rate {
            Some(rate) => Inquiry::new(Baud::of_rate(rate).unwrap_or(Baud::B500000), now),
            // The scanner reports the rate later. The slowest rate waits long enough for any.
            None => Inquiry::at(Baud::B9600, now),
        }
    }

    /// Creates an inquiry on a port that is open at `first`. It tries all rates, that one first.
    pub fn new(first: Baud, now: Nanos) -> Self {
        let mut rates = Baud::ALL;
        if let Some(at) = rates.iter().position(|&baud| baud == first) {
            rates[..=at].rotate_right(1);
        }
        Inquiry::with(rates, rates.len(), now)
    }

    /// Creates an inquiry on the line of a serial server, whose rate is fixed.
    pub fn at(baud: Baud, now: Nanos) -> Self {
        let mut inquiry = Inquiry::with([baud; Baud::ALL.len()], 1, now);
        inquiry.exchange.behind_server = true;
        inquiry
    }

    fn with(rates: [Baud; Baud::ALL.len()], count: usize, now: Nanos) -> Self {
        Inquiry {
            exchange: Exchange::new(rates[0], now),
            phase: Phase::Listening { give_up_at: now + LISTEN },
            rates,
            count,
            unasked: [0; Baud::ALL.len()],
            patience: PATIENCE,
            report: Report::default(),
        }
    }

    /// Returns the report, which is complete when the inquiry [is done](Protocol::is_done).
    pub fn report(&self) -> &Report {
        &self.report
    }

    /// Returns the rate that the inquiry tries now.
    pub fn baud(&self) -> Baud {
        self.exchange.baud
    }

    /// Returns the counters of bytes, and the number of bytes that are not assigned yet.
    pub fn tally(&self) -> (&Tally, usize) {
        self.exchange.tally()
    }

    fn on_telegram(&mut self, span: TelegramSpan) {
        let telegram = self.exchange.view(span);
        let (command, address, status) = (telegram.command(), telegram.address() & !REPLY, telegram.status());
        let is_status = matches!(Reply::decode(telegram), Some(Reply::Status(_)));
        let reply = Encoded::of(telegram);
        // The checksum is weak, and bytes of another rate may pass it. There, only a complete status proves the rate.
        let may_answer = is_status || matches!(self.phase, Phase::Asking { .. });
        let Some(request) = may_answer.then(|| self.exchange.answered(command)).flatten() else {
            return self.on_unasked(command);
        };
        self.report.keep(request, reply);
        self.report.baud = Some(self.exchange.baud);
        if self.exchange.behind_server {
            self.report.baud = self.report.status().and_then(|status| status.baud()).or(self.report.baud);
        }
        self.report.address = Some(address);
        self.report.status_byte = status;
        self.exchange.address = address;
        self.ask_after(request);
    }

    fn on_unasked(&mut self, command: u8) {
        self.report.streams |= is_data(command);
        if let Some(at) = self.rates.iter().position(|&baud| baud == self.exchange.baud) {
            self.unasked[at] += 1;
        }
        match self.phase {
            Phase::Listening { .. } => self.seek(0, self.exchange.now),
            Phase::ListeningAgain { .. } => self.give_up(),
            Phase::Seeking { .. } | Phase::Asking { .. } | Phase::Done => {}
        }
    }

    /// Sends the request after `request`.
    fn ask_after(&mut self, request: Request) {
        let question = place_of(request).map_or(QUESTIONS.len(), |at| at + 1);
        match QUESTIONS.get(question) {
            Some(Request::Counters) if !self.has_counters() => self.phase = Phase::Done,
            Some(&request) => {
                self.phase = Phase::Asking { question };
                self.exchange.ask(request, self.exchange.now, TRIES);
            }
            None => self.phase = Phase::Done,
        }
    }

    /// Returns whether the scanner may have counters. A scanner of an unknown type refuses the request itself.
    fn has_counters(&self) -> bool {
        let family = self.report.kind().and_then(Family::of_type);
        family.is_none_or(|family| family.refuses(Request::Counters).is_none())
    }

    /// Requests the status at the rate of `attempt`.
    fn seek(&mut self, attempt: usize, not_before: Nanos) {
        if attempt >= self.count * ROUNDS {
            return self.listen_again(0);
        }
        self.phase = Phase::Seeking { attempt };
        self.exchange.set_baud(self.rates[attempt % self.count]);
        // In the second round, the request is sent twice.
        let tries = 1 + (attempt / self.count) as u8;
        self.exchange.ask(Request::Status, not_before, tries);
    }

    /// Waits for any telegram at one rate after the other, each for the time of the two longest ones. Not if the line
    /// is silent, or telegrams have arrived before.
    fn listen_again(&mut self, attempt: usize) {
        let is_silent = self.exchange.tally().0.read == 0;
        if is_silent || attempt >= self.count || self.unasked.iter().any(|&count| count > 0) {
            return self.give_up();
        }
        let baud = self.rates[attempt];
        self.exchange.set_baud(baud);
        let give_up_at = self.exchange.now + LISTEN + 2 * line_time(MAX_TELEGRAM, baud.rate());
        self.phase = Phase::ListeningAgain { attempt, give_up_at };
    }

    /// Ends without a reply. A stream reveals its rate.
    fn give_up(&mut self) {
        self.phase = Phase::Done;
        let loudest = self.unasked.iter().zip(self.rates).max_by_key(|(count, _)| **count);
        self.report.baud = loudest.filter(|(count, _)| **count > 0).map(|(_, baud)| baud);
    }

    fn on_silence(&mut self) {
        let now = self.exchange.now;
        if self.exchange.again(now) {
            return;
        }
        match self.phase {
            Phase::Seeking { attempt } if self.unasked[attempt % self.count] > 0 && self.patience > 0 => {
                self.patience -= 1;
                self.exchange.ask(Request::Status, now, 1);
            }
            Phase::Seeking { attempt } => self.seek(attempt + 1, now + SETTLE),
            Phase::Asking { question } => self.ask_after(QUESTIONS[question]),
            Phase::Listening { .. } | Phase::ListeningAgain { .. } | Phase::Done => {}
        }
    }
}

impl Protocol for Inquiry {
    fn spare(&mut self) -> &mut [u8] {
        self.exchange.spare()
    }

    fn commit(&mut self, now: Nanos, len: usize) {
        self.exchange.commit(now, len);
        self.report.bytes += len as u64;
    }

    fn handle_timeout(&mut self, now: Nanos) {
        let unanswered = self.exchange.handle_timeout(now);
        match self.phase {
            Phase::Listening { give_up_at } if now >= give_up_at => self.seek(0, now),
            Phase::ListeningAgain { attempt, give_up_at } if now >= give_up_at => {
                self.listen_again(attempt + 1)
            }
            _ if unanswered => self.on_silence(),
            _ => {}
        }
    }

    fn restart_if_late(&mut self, now: Nanos) -> bool {
        self.exchange.restart_if_late(now)
    }

    fn transmitted(&mut self, now: Nanos) {
        self.exchange.transmitted(now);
    }

    fn is_done(&self) -> bool {
        matches!(self.phase, Phase::Done)
    }

    fn poll_output(&mut self) -> Output<'_> {
        while let Some(heard) = self.exchange.advance() {
            match heard {
                Heard::Telegram(span) => self.on_telegram(span),
                // During the search for the rate, noise contains such bytes too.
                Heard::Nak if matches!(self.phase, Phase::Asking { .. }) => {
                    if self.exchange.refused_checksum() == Some(false) {
                        self.on_silence();
                    }
                }
                Heard::Nak => {}
            }
        }
        match self.phase {
            Phase::Listening { give_up_at } | Phase::ListeningAgain { give_up_at, .. } => {
                self.exchange.output(give_up_at)
            }
            Phase::Seeking { .. } | Phase::Asking { .. } => self.exchange.output(Nanos::MAX),
            Phase::Done => Output::Wait { until: Nanos::MAX },
        }
    }
}

/// Replies of a scanner.
#[derive(Clone, Debug, Default)]
pub struct Report {
    /// Rate of the scanner. `None` if no telegram arrived at any.
    pub baud: Option<Baud>,
    /// Address of the scanner, 0 to 127.
    pub address: Option<u8>,
    /// Whether telegrams arrived without a request.
    pub streams: bool,
    /// The last status byte.
    pub status_byte: Option<u8>,
    /// Number of received bytes.
    pub bytes: u64,
    replies: [Option<Encoded>; QUESTIONS.len()],
}

impl Report {
    /// Returns whether the scanner has replied. One that streams and does not reply does not receive requests.
    pub fn answers(&self) -> bool {
        self.replies.iter().any(Option::is_some)
    }

    /// Returns the reply to `request`, which may be a refusal.
    pub fn reply(&self, request: Request) -> Option<Reply<'_>> {
        Reply::decode(self.replies[place_of(request)?].as_ref()?.telegram())
    }

    /// Returns the status.
    pub fn status(&self) -> Option<StatusReport<'_>> {
        match self.reply(Request::Status)? {
            Reply::Status(status) => Some(status),
            _ => None,
        }
    }

    /// Returns type, number and firmware, such as `LMS200;S18063;V02.19`, usually in ASCII.
    pub fn kind(&self) -> Option<&[u8]> {
        match self.reply(Request::Type)? {
            Reply::Type(kind) => Some(kind),
            _ => None,
        }
    }

    /// Returns the first part of the configuration.
    pub fn configuration(&self) -> Option<Configuration<'_>> {
        match self.reply(Request::Configuration)? {
            Reply::Configuration(configuration) => Some(configuration),
            _ => None,
        }
    }

    /// Returns present and past errors.
    pub fn errors(&self) -> Option<Errors<'_>> {
        match self.reply(Request::Errors)? {
            Reply::Errors(errors) => Some(errors),
            _ => None,
        }
    }

    /// Returns whether the window is dirty, by the status byte or by the measured value in the status. `None` if
    /// neither was reported.
    pub fn is_polluted(&self) -> Option<bool> {
        let reported = self.status_byte.map(|byte| Condition(byte).is_polluted());
        let measured =
            self.status().and_then(|status| status.window_percent()).map(|percent| percent < DIRTY);
        reported.max(measured)
    }

    /// Stores the `reply` to one of the questions.
    fn keep(&mut self, request: Request, reply: Encoded) {
        if let Some(place) = place_of(request).and_then(|at| self.replies.get_mut(at)) {
            *place = Some(reply);
        }
    }
}

/// Returns the index of `request` among the questions.
fn place_of(request: Request) -> Option<usize> {
    QUESTIONS.iter().position(|&question| question == request)
}

/// The requests in their order. The first one finds the rate.
const QUESTIONS: [Request; 5] =
    [Request::Status, Request::Type, Request::Configuration, Request::Errors, Request::Counters];
/// Number of rounds through all rates.
const ROUNDS: usize = 2;
/// Number of further requests at a rate at which telegrams arrived.
const PATIENCE: u8 = 5;
