//! Probe that finds the baud rate of an LMS and requests its identity and state. It does not change the scanner's
//! mode, baud rate or settings. A scanner that streams continues to stream, but each reply costs a scan.
//!
//! The probe listens first, because a stream at the port's rate needs no request. Then it requests the status at each
//! rate. There are two rounds of these requests, because a scanner may overlook a request. If telegrams arrived at a
//! rate, the probe sends more requests at this rate.

use scanhub_schema::{Nanos, line_time};

use crate::line::family::table;
use crate::line::{Action, Protocol};
use crate::lms::command::Request;
use crate::lms::configuration::Configuration;
use crate::lms::framer::{FramerCounters, TelegramSpan};
use crate::lms::header::is_data;
use crate::lms::lms_model::LmsModel;
use crate::lms::protocol_state::LISTEN_TIME;
use crate::lms::rate::SETTLE_TIME;
use crate::lms::reply::Reply;
use crate::lms::request_channel::{ChannelEvent, RequestChannel, TRIES};
use crate::lms::status::{DIRTY_BELOW_PERCENT, Errors, StatusByte, StatusReport};
use crate::lms::telegram::{EncodedTelegram, MAX_TELEGRAM, REPLY};
use crate::lms::variant::Baud;

/// State machine of the probe.
#[derive(Clone, Debug)]
pub struct IdentityProbe {
    channel: RequestChannel<Request>,
    phase: Phase,
    /// Baud rates in the order of the search.
    rates: [Baud; Baud::ALL.len()],
    /// Number of entries of `rates` that the probe tries.
    count: usize,
    /// Number of telegrams that arrived without a request, for each entry of `rates`.
    unrequested: [u32; Baud::ALL.len()],
    /// Remaining number of additional requests at rates at which telegrams arrived.
    extra_requests: u8,
    report: Report,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    Listening {
        give_up_at: Nanos,
    },
    Searching {
        attempt: usize,
    },
    Requesting {
        index: usize,
    },
    /// Bytes have arrived, but none of them were a reply. The probe checks at each rate whether the bytes are a stream.
    ListeningPerRate {
        attempt: usize,
        give_up_at: Nanos,
    },
    Done,
}

impl IdentityProbe {
    /// All baud rates of a scanner.
    pub const RATES: [u32; Baud::ALL.len()] = table!(Baud::ALL, Baud::rate);

    /// Creates a probe on a port that is open at `rate`, in bits per second. `rate` is `None` for a serial server,
    /// on which the user sets the rate.
    pub fn begin(rate: Option<u32>, now: Nanos) -> Self {
        match rate {
            Some(rate) => IdentityProbe::new(Baud::of_rate(rate).unwrap_or(Baud::B500000), now),
            // The scanner's status will contain the baud rate. Timeouts for the slowest rate are long enough for every
            // rate.
            None => IdentityProbe::at_fixed_rate(Baud::B9600, now),
        }
    }

    /// Creates a probe on a port that is open at `first`. The probe tries all baud rates, starting with `first`.
    pub fn new(first: Baud, now: Nanos) -> Self {
        let mut rates = Baud::ALL;
        if let Some(at) = rates.iter().position(|&baud| baud == first) {
            rates[..=at].rotate_right(1);
        }
        IdentityProbe::with_rates(rates, rates.len(), now)
    }

    /// Creates a probe on the line of a serial server, whose baud rate is fixed at `baud`.
    pub fn at_fixed_rate(baud: Baud, now: Nanos) -> Self {
        let mut probe = IdentityProbe::with_rates([baud; Baud::ALL.len()], 1, now);
        probe.channel.is_behind_server = true;
        probe
    }

    fn with_rates(rates: [Baud; Baud::ALL.len()], count: usize, now: Nanos) -> Self {
        IdentityProbe {
            channel: RequestChannel::new(rates[0], now),
            phase: Phase::Listening { give_up_at: now + LISTEN_TIME },
            rates,
            count,
            unrequested: [0; Baud::ALL.len()],
            extra_requests: MAX_EXTRA_REQUESTS,
            report: Report::default(),
        }
    }

    /// Returns the report. It is complete when the probe [is done](Protocol::is_done).
    pub fn report(&self) -> &Report {
        &self.report
    }

    /// Returns the baud rate that the probe tries now.
    pub fn baud(&self) -> Baud {
        self.channel.baud
    }

    /// Returns the counters of bytes, and the number of buffered bytes, which no other counter includes yet.
    pub fn byte_counters(&self) -> (&FramerCounters, usize) {
        self.channel.byte_counters()
    }

    fn on_telegram(&mut self, span: TelegramSpan) {
        let telegram = self.channel.view(span);
        let (command, address, status) = (telegram.command(), telegram.address() & !REPLY, telegram.status());
        let is_status = matches!(Reply::decode(telegram), Some(Reply::Status(_)));
        let reply = EncodedTelegram::of(telegram);
        // The checksum is weak, so bytes that arrive at a wrong rate may pass it. During the search, only a complete
        // status proves the rate.
        let may_be_reply = is_status || matches!(self.phase, Phase::Requesting { .. });
        let Some(request) = may_be_reply.then(|| self.channel.take_answered(command)).flatten() else {
            return self.on_unrequested(command);
        };
        self.report.store_reply(request, reply);
        self.report.baud = Some(self.channel.baud);
        if self.channel.is_behind_server {
            self.report.baud = self.report.status().and_then(|status| status.baud()).or(self.report.baud);
        }
        self.report.address = Some(address);
        self.report.status_byte = status;
        self.channel.address = address;
        self.request_next(request);
    }

    fn on_unrequested(&mut self, command: u8) {
        self.report.streams |= is_data(command);
        if let Some(at) = self.rates.iter().position(|&baud| baud == self.channel.baud) {
            self.unrequested[at] += 1;
        }
        match self.phase {
            Phase::Listening { .. } => self.search(0, self.channel.now),
            Phase::ListeningPerRate { .. } => self.end_without_reply(),
            Phase::Searching { .. } | Phase::Requesting { .. } | Phase::Done => {}
        }
    }

    /// Sends the request that follows `request` in [`REQUESTS`], or ends the probe.
    fn request_next(&mut self, request: Request) {
        let index = request_index(request).map_or(REQUESTS.len(), |at| at + 1);
        match REQUESTS.get(index) {
            Some(Request::Counters) if !self.has_counters() => self.phase = Phase::Done,
            Some(&request) => {
                self.phase = Phase::Requesting { index };
                self.channel.send_request(request, self.channel.now, TRIES);
            }
            None => self.phase = Phase::Done,
        }
    }

    /// Returns whether the scanner may have counters. If the scanner's model is unknown, the probe sends the request,
    /// and the scanner can refuse it.
    fn has_counters(&self) -> bool {
        let family = self.report.kind().and_then(LmsModel::of_type);
        family.is_none_or(|family| family.refuses(Request::Counters).is_none())
    }

    /// Requests the status at the baud rate of `attempt`, not before `not_before`.
    fn search(&mut self, attempt: usize, not_before: Nanos) {
        if attempt >= self.count * ROUNDS {
            return self.listen_per_rate(0);
        }
        self.phase = Phase::Searching { attempt };
        self.channel.set_baud(self.rates[attempt % self.count]);
        // The request is sent once in the first round and twice in the second round.
        let tries = 1 + (attempt / self.count) as u8;
        self.channel.send_request(Request::Status, not_before, tries);
    }

    /// Waits for a telegram at each baud rate. At each rate, the probe waits for [`LISTEN_TIME`] and the duration of
    /// two telegrams of the maximum length. If the line is silent, or if telegrams have already arrived, ends the probe
    /// instead.
    fn listen_per_rate(&mut self, attempt: usize) {
        let is_silent = self.channel.byte_counters().0.read == 0;
        if is_silent || attempt >= self.count || self.unrequested.iter().any(|&count| count > 0) {
            return self.end_without_reply();
        }
        let baud = self.rates[attempt];
        self.channel.set_baud(baud);
        let give_up_at = self.channel.now + LISTEN_TIME + 2 * line_time(MAX_TELEGRAM, baud.rate());
        self.phase = Phase::ListeningPerRate { attempt, give_up_at };
    }

    /// Ends the probe without a reply. If the probe found a stream, the report contains the stream's baud rate.
    fn end_without_reply(&mut self) {
        self.phase = Phase::Done;
        let busiest = self.unrequested.iter().zip(self.rates).max_by_key(|(count, _)| **count);
        self.report.baud = busiest.filter(|(count, _)| **count > 0).map(|(_, baud)| baud);
    }

    fn on_no_reply(&mut self) {
        let now = self.channel.now;
        if self.channel.retry(now) {
            return;
        }
        match self.phase {
            Phase::Searching { attempt }
                if self.unrequested[attempt % self.count] > 0 && self.extra_requests > 0 =>
            {
                self.extra_requests -= 1;
                self.channel.send_request(Request::Status, now, 1);
            }
            Phase::Searching { attempt } => self.search(attempt + 1, now + SETTLE_TIME),
            Phase::Requesting { index } => self.request_next(REQUESTS[index]),
            Phase::Listening { .. } | Phase::ListeningPerRate { .. } | Phase::Done => {}
        }
    }
}

impl Protocol for IdentityProbe {
    fn read_buffer(&mut self) -> &mut [u8] {
        self.channel.read_buffer()
    }

    fn commit(&mut self, now: Nanos, len: usize) {
        self.channel.commit(now, len);
        self.report.bytes += len as u64;
    }

    fn handle_timeout(&mut self, now: Nanos) {
        let is_reply_overdue = self.channel.handle_timeout(now);
        match self.phase {
            Phase::Listening { give_up_at } if now >= give_up_at => self.search(0, now),
            Phase::ListeningPerRate { attempt, give_up_at } if now >= give_up_at => {
                self.listen_per_rate(attempt + 1)
            }
            _ if is_reply_overdue => self.on_no_reply(),
            _ => {}
        }
    }

    fn restart_if_late(&mut self, now: Nanos) -> bool {
        self.channel.restart_if_late(now)
    }

    fn handle_transmitted(&mut self, now: Nanos) {
        self.channel.handle_transmitted(now);
    }

    fn is_done(&self) -> bool {
        matches!(self.phase, Phase::Done)
    }

    fn poll_action(&mut self) -> Action<'_> {
        while let Some(event) = self.channel.advance() {
            match event {
                ChannelEvent::Telegram(span) => self.on_telegram(span),
                // While the baud rate is unknown, noise can contain NAK bytes too.
                ChannelEvent::Nak if matches!(self.phase, Phase::Requesting { .. }) => {
                    if self.channel.on_nak() == Some(false) {
                        self.on_no_reply();
                    }
                }
                ChannelEvent::Nak => {}
            }
        }
        match self.phase {
            Phase::Listening { give_up_at } | Phase::ListeningPerRate { give_up_at, .. } => {
                self.channel.poll_action(give_up_at)
            }
            Phase::Searching { .. } | Phase::Requesting { .. } => self.channel.poll_action(Nanos::MAX),
            Phase::Done => Action::Wait { until: Nanos::MAX },
        }
    }
}

/// Result of a probe.
#[derive(Clone, Debug, Default)]
pub struct Report {
    /// Baud rate of the scanner. `None` if no telegram arrived at any rate.
    pub baud: Option<Baud>,
    /// Address of the scanner, 0 to 127.
    pub address: Option<u8>,
    /// Whether telegrams arrived without a request.
    pub streams: bool,
    /// Status byte of the last reply.
    pub status_byte: Option<u8>,
    /// Number of received bytes.
    pub bytes: u64,
    replies: [Option<EncodedTelegram>; REQUESTS.len()],
}

impl Report {
    /// Returns whether the scanner has replied. If a scanner streams but does not reply, it does not receive the
    /// requests.
    pub fn has_replied(&self) -> bool {
        self.replies.iter().any(Option::is_some)
    }

    /// Returns the reply to `request`. The reply may be a refusal.
    pub fn reply(&self, request: Request) -> Option<Reply<'_>> {
        Reply::decode(self.replies[request_index(request)?].as_ref()?.telegram())
    }

    /// Returns the status.
    pub fn status(&self) -> Option<StatusReport<'_>> {
        match self.reply(Request::Status)? {
            Reply::Status(status) => Some(status),
            _ => None,
        }
    }

    /// Returns model, number and firmware, such as `LMS200;S18063;V02.19`, usually in ASCII.
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

    /// Returns whether the front window is dirty, according to the status byte or to the window's transmission in the
    /// status. Returns `None` if the scanner reported neither.
    pub fn is_polluted(&self) -> Option<bool> {
        let reported = self.status_byte.map(|byte| StatusByte(byte).is_polluted());
        let measured = self
            .status()
            .and_then(|status| status.window_percent())
            .map(|percent| percent < DIRTY_BELOW_PERCENT);
        reported.max(measured)
    }

    /// Stores the `reply` to one of [`REQUESTS`].
    fn store_reply(&mut self, request: Request, reply: EncodedTelegram) {
        if let Some(slot) = request_index(request).and_then(|at| self.replies.get_mut(at)) {
            *slot = Some(reply);
        }
    }
}

/// Returns the index of `request` in [`REQUESTS`].
fn request_index(request: Request) -> Option<usize> {
    REQUESTS.iter().position(|&other| other == request)
}

/// Requests of a probe, in the order in which it sends them. The reply to the first request proves the baud rate.
const REQUESTS: [Request; 5] =
    [Request::Status, Request::Type, Request::Configuration, Request::Errors, Request::Counters];
/// Number of rounds through all baud rates.
const ROUNDS: usize = 2;
/// Maximum number of additional requests at rates at which telegrams arrived.
const MAX_EXTRA_REQUESTS: u8 = 5;
