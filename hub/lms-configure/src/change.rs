//! Protocol that changes the EEPROM settings of a scanner. The protocol checks that the settings are still the same as
//! in the plan, enters installation mode, writes, leaves that mode, reads the settings back, and restores the earlier
//! operating mode. After any failure it tries to leave installation mode. Its outcome states what is known about the
//! scanner's state.
//!
//! Only this module sends a request of [`crate::eeprom`], and sending requires a [`Consent`]. If the scanner does not
//! acknowledge a write, the protocol first reads the configuration to check whether the write was done. It does not
//! simply repeat the write.

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

/// Change in progress. It cannot be copied, because a consent is valid for only one change.
#[derive(Debug)]
pub struct Change {
    plan: Plan,
    channel: RequestChannel<CurrentRequest>,
    step: Step,
    /// Number of times that the configuration may still be written.
    writes_left: u8,
    /// Whether the scanner has stopped sending scans. Before that, the rest of a scan may look like a NAK.
    is_stopped: bool,
    outcome: Outcome,
}

/// Step of a change, in the order of execution.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Step {
    /// Check that the scanner still has the settings of the plan. A person may have taken some time to confirm the
    /// plan.
    Compare,
    /// Enter installation mode.
    Enter,
    /// Write the configuration.
    Write,
    /// Read the configuration, because the scanner has not reported whether it was written.
    Check,
    /// Write the setting for the baud rate after power-on.
    PowerOn,
    /// Leave installation mode.
    Leave,
    /// Read the configuration that is now in effect.
    ReadBack,
    /// Read whether the scanner will use a baud rate other than 9600 after power-on.
    ReadStatus,
    /// Restore the earlier operating mode.
    Restore,
    /// The change is complete.
    Done,
}

/// Outcome of a change.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Outcome {
    /// First step that failed, and its error. `None` if every step succeeded.
    pub failed: Option<(Step, ChangeError)>,
    /// Whether a write may have reached the scanner.
    pub written: bool,
    /// Configuration as it was read back.
    pub configuration: Option<OwnedConfiguration>,
    /// Whether the scanner uses a baud rate other than 9600 after power-on. `None` if the plan does not change this
    /// setting, or it could not be read back.
    pub permanent_baud: Option<bool>,
    /// Current operating mode of the scanner. `None` if it may still be in installation mode.
    pub operating_mode: Option<u8>,
}

/// Reason why a step failed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ChangeError {
    /// The scanner sent no reply, or only a reply that cannot be decoded.
    Unanswered,
    /// The scanner rejected the request. At [`Step::Enter`], the password is wrong.
    Refused,
    /// The settings that were read back differ from those that were written. At [`Step::Compare`], they differ from the
    /// settings of the plan.
    Mismatch,
}

#[derive(Clone, Debug)]
enum CurrentRequest {
    Request(Request),
    WriteConfiguration(OwnedConfiguration),
    WritePowerOn(PowerOn),
}

impl CurrentRequest {
    /// Returns the EEPROM write of this request. Returns `None` if the request does not write.
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
            // This request is never used, because every configuration fits into a write. A request for the
            // configuration would do no harm.
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

    /// Returns the maximum time for the acknowledgment. A scanner that writes or changes its mode may first abort a
    /// scan and acknowledge only then. An acknowledgment after an aborted scan may not be recognized. The maximum time
    /// is therefore the same as for the reply.
    fn acknowledge_timeout(&self) -> Nanos {
        match self {
            CurrentRequest::Request(request) if request.command() == command::MODE => MODE_TIMEOUT,
            CurrentRequest::Request(request) => request.acknowledge_timeout(),
            CurrentRequest::WriteConfiguration(_) | CurrentRequest::WritePowerOn(_) => WRITE_TIMEOUT,
        }
    }
}

impl Change {
    /// Creates the change of a plan that a person has confirmed, on a port that is open at the scanner's baud rate.
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

    /// Sets that the line belongs to a serial server. A serial server may collect a reply before it forwards the reply.
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

    /// Starts `step`, or the first step after it that sends a request.
    fn begin(&mut self, step: Step) {
        self.step = step;
        let plan = self.plan;
        let send = |request| Some((CurrentRequest::Request(request), TRIES));
        // Send a write only once. The next step checks whether it was done.
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
            // The scanner may still be in installation mode.
            Step::Restore if self.outcome.operating_mode.is_none() => {
                Some((CurrentRequest::Request(Request::Stop), ESSENTIAL_TRIES))
            }
            Step::Restore => match plan.operating_mode {
                STREAM => send(Request::Stream),
                PARTIAL => send(Request::Operate(Operating::Partial)),
                // The documents do not state which parameters other modes need.
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
            // The documents disagree about the first byte of this reply. The status, which is read later, has the
            // result.
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
            // A reply that cannot be decoded is as useless as no reply.
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
            // The requests of this step do not change anything.
            Step::Compare => {
                self.outcome.operating_mode = Some(self.plan.operating_mode);
                self.begin(Step::Done);
            }
            // The scanner may be in installation mode, whether or not it received the request.
            Step::Enter | Step::Write | Step::Check | Step::PowerOn => self.begin(Step::Leave),
            Step::Leave => self.begin(Step::ReadBack),
            step => self.begin(next_step(step)),
        }
    }

    /// Stores the first failure, which is the cause of any later ones.
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
                // While the scanner may be writing, only the timeout counts as a failure. A second write because of
                // noise would wear the EEPROM.
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

/// Returns the step that follows `step` if it succeeded.
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

/// Timeout for a write. A change of unit was observed to take 7 s (QM), and one driver waits 15 s.
const WRITE_TIMEOUT: Nanos = 15_000 * MILLIS;
