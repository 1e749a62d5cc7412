//! Who is there? Finds the rate at which a sensor talks and asks it what it is, without changing anything in it: no
//! mode, no rate, no setting. A sensor that streams goes on streaming; each question costs it a scan.
//!
//! It listens first, because a stream at the port's rate tells itself. Then it asks for the status at each rate, and
//! once more round: a sensor may overlook a request. A rate at which telegrams were heard is not left so easily.

mod report;

use crate::line::{Output, Protocol};
use crate::lms::command::Request;
use crate::lms::exchange::{Exchange, Heard};
use crate::lms::family::Family;
use crate::lms::framer::{Tally, TelegramSpan};
use crate::lms::header::is_data;
use crate::lms::phase::{LISTEN, SETTLE, TRIES};
use crate::lms::reply::Reply;
use crate::lms::telegram::{Encoded, MAX_TELEGRAM, REPLY};
use crate::lms::variant::Baud;
pub use report::Report;
use report::{QUESTIONS, place_of};
use schema::{Nanos, line_time};

/// The questions, and how far it is with them.
#[derive(Clone, Debug)]
pub struct Inquiry {
    exchange: Exchange<Request>,
    phase: Phase,
    /// The rates to try, in their order.
    rates: [Baud; Baud::ALL.len()],
    /// How many of them are tried.
    count: usize,
    /// Telegrams heard unasked at each of them.
    heard: [u32; Baud::ALL.len()],
    /// How often more it asks at a rate at which it heard telegrams.
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
    /// Bytes came and nobody answered: whether there is a stream that can be read.
    Overhearing {
        attempt: usize,
        give_up_at: Nanos,
    },
    Done,
}

impl Inquiry {
    /// On a port that is open at `first`: all rates, that one first.
    pub fn new(first: Baud, now: Nanos) -> Self {
        let mut rates = Baud::ALL;
        if let Some(at) = rates.iter().position(|&baud| baud == first) {
            rates[..=at].rotate_right(1);
        }
        Inquiry::with(rates, rates.len(), now)
    }

    /// On the line of a serial server, whose rate cannot be changed from here.
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
            heard: [0; Baud::ALL.len()],
            patience: PATIENCE,
            report: Report::default(),
        }
    }

    /// What is known; all there is to know when it [is done](Protocol::is_done).
    pub fn report(&self) -> &Report {
        &self.report
    }

    /// The rate at which it looks.
    pub fn baud(&self) -> Baud {
        self.exchange.baud
    }

    /// What became of the bytes, and how many are not yet decided.
    pub fn tally(&self) -> (&Tally, usize) {
        self.exchange.tally()
    }

    fn on_telegram(&mut self, span: TelegramSpan) {
        let telegram = self.exchange.view(span);
        let (command, address, status) = (telegram.command(), telegram.address() & !REPLY, telegram.status());
        let is_status = matches!(Reply::decode(telegram), Some(Reply::Status(_)));
        let reply = Encoded::of(telegram);
        // The checksum is weak, and noise of another rate may pass it: there only a whole status proves the rate.
        let may_answer = is_status || matches!(self.phase, Phase::Asking { .. });
        let Some(request) = may_answer.then(|| self.exchange.answered(command)).flatten() else {
            return self.on_unasked(command);
        };
        self.report.keep(request, reply);
        self.report.baud = Some(self.exchange.baud);
        self.report.address = Some(address);
        self.report.status_byte = status;
        self.exchange.address = address;
        self.ask_after(request);
    }

    fn on_unasked(&mut self, command: u8) {
        self.report.streams |= is_data(command);
        if let Some(at) = self.rates.iter().position(|&baud| baud == self.exchange.baud) {
            self.heard[at] += 1;
        }
        match self.phase {
            Phase::Listening { .. } => self.seek(0, self.exchange.now),
            Phase::Overhearing { .. } => self.give_up(),
            Phase::Seeking { .. } | Phase::Asking { .. } | Phase::Done => {}
        }
    }

    /// Asks what comes after `request`.
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

    /// What is of no known type would refuse them itself.
    fn has_counters(&self) -> bool {
        let family = self.report.kind().and_then(Family::of_type);
        family.is_none_or(|family| family.refuses(Request::Counters).is_none())
    }

    /// The status at the next rate.
    fn seek(&mut self, attempt: usize, not_before: Nanos) {
        if attempt >= self.count * ROUNDS {
            return self.overhear(0);
        }
        self.phase = Phase::Seeking { attempt };
        self.exchange.set_baud(self.rates[attempt % self.count]);
        // The second time round it is asked twice.
        let tries = 1 + (attempt / self.count) as u8;
        self.exchange.ask(Request::Status, not_before, tries);
    }

    /// Waits for any telegram at one rate after the other, each as long as two of the longest take: unless the line is
    /// silent, or something was heard before.
    fn overhear(&mut self, attempt: usize) {
        let is_silent = self.exchange.tally().0.read == 0;
        if is_silent || attempt >= self.count || self.heard.iter().any(|&heard| heard > 0) {
            return self.give_up();
        }
        let baud = self.rates[attempt];
        self.exchange.set_baud(baud);
        let give_up_at = self.exchange.now + LISTEN + 2 * line_time(MAX_TELEGRAM, baud.rate());
        self.phase = Phase::Overhearing { attempt, give_up_at };
    }

    /// Nobody answers; what streams all the same tells its rate.
    fn give_up(&mut self) {
        self.phase = Phase::Done;
        let loudest = self.heard.iter().zip(self.rates).max_by_key(|(heard, _)| **heard);
        self.report.baud = loudest.filter(|(heard, _)| **heard > 0).map(|(_, baud)| baud);
    }

    fn on_silence(&mut self) {
        let now = self.exchange.now;
        if self.exchange.again(now) {
            return;
        }
        match self.phase {
            Phase::Seeking { attempt } if self.heard[attempt % self.count] > 0 && self.patience > 0 => {
                self.patience -= 1;
                self.exchange.ask(Request::Status, now, 1);
            }
            Phase::Seeking { attempt } => self.seek(attempt + 1, now + SETTLE),
            Phase::Asking { question } => self.ask_after(QUESTIONS[question]),
            Phase::Listening { .. } | Phase::Overhearing { .. } | Phase::Done => {}
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
            Phase::Overhearing { attempt, give_up_at } if now >= give_up_at => self.overhear(attempt + 1),
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
                // While the rate is sought, noise has such bytes too.
                Heard::Nak if matches!(self.phase, Phase::Asking { .. }) => {
                    if self.exchange.refused_checksum() == Some(false) {
                        self.on_silence();
                    }
                }
                Heard::Nak => {}
            }
        }
        match self.phase {
            Phase::Listening { give_up_at } | Phase::Overhearing { give_up_at, .. } => {
                self.exchange.output(give_up_at)
            }
            Phase::Seeking { .. } | Phase::Asking { .. } => self.exchange.output(Nanos::MAX),
            Phase::Done => Output::Wait { until: Nanos::MAX },
        }
    }
}

/// How often all rates are tried.
const ROUNDS: usize = 2;
/// More tries at a rate at which telegrams were heard.
const PATIENCE: u8 = 5;
