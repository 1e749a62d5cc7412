//! Changes a sensor's EEPROM settings. It checks that the settings are still those of the plan, enters installation
//! mode, writes, leaves that mode, reads the settings back, and restores the earlier operating mode. After any failure
//! it tries to leave installation mode, and its outcome says what is known of the sensor's state.
//!
//! The only code that sends a request of [`crate::eeprom`], and it needs [`Consent`]. A write that was not
//! acknowledged is not simply repeated: first the configuration is read, to see whether it was done.

use scanhub_drivers::line::{Action, Protocol};
use scanhub_drivers::lms::command::{self, Request};
use scanhub_drivers::lms::framer::TelegramSpan;
use scanhub_drivers::lms::operating::{ON_REQUEST, Operating, PARTIAL, STREAM};
use scanhub_drivers::lms::reply::Reply;
use scanhub_drivers::lms::request_channel::{
    ChannelEvent, ESSENTIAL_TRIES, EncodeRequest, MODE_TIMEOUT, RequestChannel, TRIES,
};
use scanhub_drivers::lms::telegram::EncodedTelegram;
use scanhub_schema::{MILLIS, Nanos};

use crate::eeprom::{EepromWrite, PowerOn};
use crate::plan::{Consent, OwnedConfiguration, Plan};

/// A change under way; it cannot be copied, as consent is to one.
#[derive(Debug)]
pub struct Change {
    plan: Plan,
    channel: RequestChannel<CurrentRequest>,
    step: Step,
    /// How often more the configuration may be written.
    writes_left: u8,
    /// The sensor sends nothing unasked. Before that the rest of a scan may look like a NAK.
    is_stopped: bool,
    outcome: Outcome,
}

/// How far a change is, in its order.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Step {
    /// Whether it is still the sensor that the plan was made for: a person takes time to answer.
    Compare,
    /// Into installation mode.
    Enter,
    /// The configuration is written.
    Write,
    /// Nobody said whether it was: the configuration is read.
    Check,
    /// The rate after power-on is written.
    PowerOn,
    /// Out of installation mode.
    Leave,
    /// The configuration that is in force now.
    ReadBack,
    /// Whether another rate than 9600 comes after power-on.
    ReadStatus,
    /// Back to the stream that was found.
    Restore,
    /// Over.
    Done,
}

/// What became of it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Outcome {
    /// The step that failed first, and how; `None` if all went well.
    pub failed: Option<(Step, ChangeError)>,
    /// Whether a write may have reached the sensor.
    pub written: bool,
    /// The configuration as it was read back.
    pub configuration: Option<OwnedConfiguration>,
    /// Whether a rate other than 9600 comes after power-on, if that was to change and could be read back.
    pub permanent_baud: Option<bool>,
    /// The operating mode in which the sensor is now; `None` if it may still be in installation mode.
    pub operating_mode: Option<u8>,
}

/// How a step failed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ChangeError {
    /// No reply, or none that can be read.
    Unanswered,
    /// The sensor refused; at [`Step::Enter`]: the password is wrong.
    Refused,
    /// The settings read back differ from those written; at [`Step::Compare`]: from those of the plan.
    Mismatch,
}

#[derive(Clone, Debug)]
enum CurrentRequest {
    Request(Request),
    WriteConfiguration(OwnedConfiguration),
    WritePowerOn(PowerOn),
}

impl CurrentRequest {
    /// What of it is written.
    fn write(&self) -> Option<EepromWrite<'_>> {
        match self {
            CurrentRequest::Request(_) => None,
            CurrentRequest::WriteConfiguration(new) => Some(EepromWrite::Configuration(new.bytes())),
            CurrentRequest::WritePowerOn(power_on) => Some(EepromWrite::PowerOn(*power_on)),
        }
    }
}

impl EncodeRequest for CurrentRequest {
    fn encode(&self, address: u8) -> EncodedTelegram {
        let request = match self {
            CurrentRequest::Request(request) => *request,
            // Which configuration there is does no harm to ask; but none is longer than a write may be.
            CurrentRequest::WriteConfiguration(_) | CurrentRequest::WritePowerOn(_) => Request::Configuration,
        };
        let write = self.write().and_then(|write| write.encode(address));
        write.unwrap_or_else(|| request.encode(address))
    }

    fn command(&self) -> u8 {
        match self {
            CurrentRequest::Request(request) => request.command(),
            CurrentRequest::WriteConfiguration(new) => EepromWrite::Configuration(new.bytes()).command(),
            CurrentRequest::WritePowerOn(power_on) => EepromWrite::PowerOn(*power_on).command(),
        }
    }

    fn reply_timeout(&self) -> Nanos {
        match self {
            CurrentRequest::Request(request) if request.command() == command::MODE => MODE_TIMEOUT,
            CurrentRequest::Request(request) => request.reply_timeout(),
            CurrentRequest::WriteConfiguration(_) | CurrentRequest::WritePowerOn(_) => WRITE_TIMEOUT,
        }
    }

    /// A sensor that writes, or changes its mode, may have acknowledged unheard, behind a scan that it broke off: it is
    /// waited for as long.
    fn acknowledge_timeout(&self) -> Nanos {
        match self {
            CurrentRequest::Request(request) if request.command() == command::MODE => MODE_TIMEOUT,
            CurrentRequest::Request(request) => request.acknowledge_timeout(),
            CurrentRequest::WriteConfiguration(_) | CurrentRequest::WritePowerOn(_) => WRITE_TIMEOUT,
        }
    }
}

impl Change {
    /// Carries out the plan that somebody consented to, on a port that is open at its rate.
    pub fn new(consent: Consent, now: Nanos) -> Self {
        let plan = consent.into_plan();
        let mut exchange = RequestChannel::new(plan.baud, now);
        exchange.address = plan.address;
        let (step, outcome) = (Step::Compare, Outcome::default());
        let mut change =
            Change { plan, channel: exchange, step, writes_left: TRIES, is_stopped: false, outcome };
        change.begin(Step::Compare);
        change
    }

    /// As a change on the line of a serial server, which may pack a reply before it sends it.
    pub fn with_server(mut self) -> Self {
        self.channel.is_behind_server = true;
        self
    }

    /// Returns the current step.
    pub fn step(&self) -> Step {
        self.step
    }

    /// Returns the outcome. It is complete when the change [is done](Protocol::is_done).
    pub fn outcome(&self) -> &Outcome {
        &self.outcome
    }

    /// Begins with `step`, or the first one after it that has something to do.
    fn begin(&mut self, step: Step) {
        self.step = step;
        let plan = self.plan;
        let send = |request| Some((CurrentRequest::Request(request), TRIES));
        // A wrong or lost request does nothing; it is for the next step to find out.
        let send_once = |request| Some((request, 1));
        let next_request = match step {
            Step::Enter => send(Request::Operate(Operating::Installation(plan.password))),
            Step::Write if plan.old == plan.new => None,
            Step::Write => send_once(CurrentRequest::WriteConfiguration(plan.new)),
            Step::Compare | Step::Check | Step::ReadBack => send(Request::Configuration),
            Step::PowerOn => plan.power_on.map(CurrentRequest::WritePowerOn).and_then(send_once),
            Step::Leave => Some((CurrentRequest::Request(Request::Stop), ESSENTIAL_TRIES)),
            Step::ReadStatus if plan.power_on.is_none() => None,
            Step::ReadStatus => send(Request::Status),
            // It may still be in installation mode.
            Step::Restore if self.outcome.operating_mode.is_none() => {
                Some((CurrentRequest::Request(Request::Stop), ESSENTIAL_TRIES))
            }
            Step::Restore => match plan.operating_mode {
                STREAM => send(Request::Stream),
                PARTIAL => send(Request::Operate(Operating::Partial)),
                // What other modes need beside their byte nobody tells.
                _ => None,
            },
            Step::Done => return,
        };
        match next_request {
            Some((request, tries)) => {
                self.outcome.written |= request.write().is_some();
                self.channel.send_request(request, self.channel.now, tries);
            }
            None => self.begin(next_step(step)),
        }
    }

    fn on_telegram(&mut self, span: TelegramSpan) {
        let telegram = self.channel.view(span);
        let reply = Reply::decode(telegram);
        let configuration = match &reply {
            Some(Reply::Configuration(it) | Reply::ConfigurationWritten { configuration: it, .. }) => {
                OwnedConfiguration::new(it.bytes())
            }
            _ => None,
        };
        let done = match &reply {
            Some(Reply::Mode { done } | Reply::ConfigurationWritten { done, .. }) => Some(*done),
            // The documents disagree about its first byte: the status has the result afterwards.
            Some(Reply::PowerOnSet { .. } | Reply::Status(_) | Reply::Configuration(_)) => Some(true),
            Some(Reply::Refused) => Some(false),
            _ => None,
        };
        let is_changed = matches!(reply, Some(Reply::Mode { done: true }));
        let permanent = match &reply {
            Some(Reply::Status(status)) => Some(status.has_permanent_baud()),
            _ => None,
        };
        let command = telegram.command();
        if self.channel.take_answered(command).is_none() {
            return;
        }
        self.is_stopped |= is_changed;
        match self.step {
            _ if done == Some(false) => self.handle_failure(ChangeError::Refused),
            // An answer that cannot be read says no more than none.
            Step::Write if done.is_none() => self.check_written(),
            _ if done.is_none() => self.handle_failure(ChangeError::Unanswered),
            Step::Compare if configuration != Some(self.plan.old) => {
                self.handle_failure(ChangeError::Mismatch)
            }
            Step::Check if configuration == Some(self.plan.new) => self.begin(Step::PowerOn),
            Step::Check if self.writes_left > 0 => self.begin(Step::Write),
            Step::Check => {
                self.step = Step::Write;
                self.handle_failure(ChangeError::Unanswered);
            }
            Step::Leave => {
                self.outcome.operating_mode = Some(ON_REQUEST);
                self.begin(Step::ReadBack);
            }
            Step::ReadBack => {
                self.outcome.configuration = configuration;
                if configuration != Some(self.plan.new) {
                    self.record_failure(ChangeError::Mismatch);
                }
                self.begin(Step::ReadStatus);
            }
            Step::ReadStatus => {
                self.outcome.permanent_baud = permanent;
                let expected = self.plan.power_on.map(|power_on| power_on == PowerOn::KeepBaud);
                if expected != permanent {
                    self.record_failure(ChangeError::Mismatch);
                }
                self.begin(Step::Restore);
            }
            Step::Restore if self.outcome.operating_mode.is_none() => {
                self.outcome.operating_mode = Some(ON_REQUEST);
                self.begin(Step::Restore);
            }
            Step::Restore => {
                self.outcome.operating_mode = Some(self.plan.operating_mode);
                self.begin(Step::Done);
            }
            step => self.begin(next_step(step)),
        }
    }

    fn on_no_reply(&mut self) {
        if self.channel.retry(self.channel.now) {
            return;
        }
        match self.step {
            Step::Write => self.check_written(),
            _ => self.handle_failure(ChangeError::Unanswered),
        }
    }

    fn check_written(&mut self) {
        self.writes_left = self.writes_left.saturating_sub(1);
        self.begin(Step::Check);
    }

    fn handle_failure(&mut self, error: ChangeError) {
        self.record_failure(error);
        match self.step {
            // Nothing was said that changes anything.
            Step::Compare => {
                self.outcome.operating_mode = Some(self.plan.operating_mode);
                self.begin(Step::Done);
            }
            // Whether it heard that or not, it may be in installation mode.
            Step::Enter | Step::Write | Step::Check | Step::PowerOn => self.begin(Step::Leave),
            Step::Leave => self.begin(Step::ReadBack),
            step => self.begin(next_step(step)),
        }
    }

    /// The first failure is the cause of the others.
    fn record_failure(&mut self, error: ChangeError) {
        self.outcome.failed.get_or_insert((self.step, error));
    }
}

impl Protocol for Change {
    fn read_buffer(&mut self) -> &mut [u8] {
        self.channel.read_buffer()
    }

    fn commit(&mut self, now: Nanos, len: usize) {
        self.channel.commit(now, len);
    }

    fn handle_timeout(&mut self, now: Nanos) {
        if self.channel.handle_timeout(now) {
            self.on_no_reply();
        }
    }

    fn restart_if_late(&mut self, now: Nanos) -> bool {
        self.channel.restart_if_late(now)
    }

    fn handle_transmitted(&mut self, now: Nanos) {
        self.channel.handle_transmitted(now);
    }

    fn is_done(&self) -> bool {
        self.step == Step::Done
    }

    fn poll_action(&mut self) -> Action<'_> {
        while let Some(event) = self.channel.advance() {
            match event {
                ChannelEvent::Telegram(span) => self.on_telegram(span),
                // While it may be writing, only time says no: noise is not worth a second write.
                ChannelEvent::Nak if !self.is_stopped || matches!(self.step, Step::Write | Step::PowerOn) => {
                }
                ChannelEvent::Nak => {
                    if self.channel.on_nak() == Some(false) {
                        self.on_no_reply();
                    }
                }
            }
        }
        match self.step {
            Step::Done => Action::Wait { until: Nanos::MAX },
            _ => self.channel.poll_action(Nanos::MAX),
        }
    }
}

/// The step after one that went as it should.
fn next_step(step: Step) -> Step {
    match step {
        Step::Compare => Step::Enter,
        Step::Enter => Step::Write,
        Step::Write | Step::Check => Step::PowerOn,
        Step::PowerOn => Step::Leave,
        Step::Leave => Step::ReadBack,
        Step::ReadBack => Step::ReadStatus,
        Step::ReadStatus => Step::Restore,
        Step::Restore | Step::Done => Step::Done,
    }
}

/// A change of unit was seen to take 7 s (QM), one driver waits 15 s.
const WRITE_TIMEOUT: Nanos = 15_000 * MILLIS;
