//! `scanhub configure`: changes the EEPROM settings of an LMS. Reads the settings, shows each difference, asks a
//! person, writes, reads back, and reports the settings and the state of the scanner, above all after a failure.

mod ask;
mod settings;

use std::fmt;
use std::sync::atomic::AtomicBool;

use lms_configure::eeprom::PowerOn;
use lms_configure::{Change, Failing, Outcome, OwnedConfiguration, Plan, Step};
use port::{Source, clock};
use scanhub_drivers::Inquiry;
use scanhub_drivers::lms::configuration::{Item, availability_words};
use scanhub_drivers::lms::family::Family;
use scanhub_drivers::lms::operating;
use scanhub_drivers::lms::parameters::Password;
use scanhub_drivers::lms::variant::{Mode, Unit};
use schema::{Failure, Kind};
use serde::Serialize;
use shm::Domain;

use crate::driver::{Procedure, drive};
use crate::probe::{check_unused, hex, measuring, open, request_report};
use settings::{AVAILABILITY, MODE, SENSITIVITIES, SENSITIVITY, SettingsRequest, UNIT};

/// The settings to change, and the port of the scanner.
#[derive(Clone, Debug)]
pub struct Order {
    /// The port.
    pub source: Source,
    /// The locations in which a client would search for the domain of a hub, which may use the port.
    pub places: Vec<Domain>,
    /// `KEY=VALUE`, as given.
    pub settings: Vec<String>,
    /// Password of the installation mode: 8 ASCII characters.
    pub password: String,
}

/// Progress and results to report.
#[derive(Debug)]
pub enum News<'a> {
    /// The scanner is searched for at this rate.
    Looking(u32),
    /// One value that would change.
    Difference(&'a Difference),
    /// All differences were reported, and a person must confirm them now.
    Asking,
    /// The step that runs now, as text.
    Doing(&'static str),
    /// The change succeeded, or there was nothing to change.
    Configured(&'a Configured),
}

/// Carries out `order`; calls `tell` with progress and results.
///
/// # Errors
///
/// Returns an error of one of these kinds:
///
/// - [`Kind::Configuration`] for a key or a value that is unknown, or that this type of scanner does not support.
///   Nothing has been written then.
/// - [`Kind::Usage`] if there is no terminal at which a person could confirm.
/// - The kinds of a port that cannot be used, [`Kind::Timeout`] if no scanner replies, and [`Kind::Interrupted`].
/// - [`Kind::Failed`] with the state of the scanner, if the change failed or was not confirmed.
pub fn configure(order: &Order, stop: &AtomicBool, tell: &mut dyn FnMut(News<'_>)) -> Result<(), Failure> {
    let requested = SettingsRequest::parse(&order.settings)?;
    let password = password(&order.password)?;
    check_unused(&order.source, &order.places)?;
    let (port, first) = open(&order.source, stop)?;
    let rate = if let Source::Tcp { .. } = order.source { None } else { Some(first) };
    let inquiry = Inquiry::begin(rate, clock::now());
    let report =
        request_report(&port, first, inquiry, (&order.source, true), stop, |rate| tell(News::Looking(rate)))?;
    let name = order.source.name();
    let Some(mut plan) = Plan::of(&report) else {
        return Err(Failure::new(
            Kind::Timeout,
            format!("{name}: the sensor does not report its configuration"),
            "nothing was written; power it off and on, then try again",
        ));
    };
    plan.password = password;
    let family = report.kind().and_then(Family::of_type);
    requested.apply(&mut plan, family, &report)?;
    if plan.is_empty() {
        tell(News::Configured(&Configured::nothing(&name, &plan)));
        return Ok(());
    }
    let was_permanent = report.status().map(|status| status.has_permanent_baud());
    for difference in Difference::all(&name, &plan, family, was_permanent) {
        tell(News::Difference(&difference));
    }
    tell(News::Asking);
    let consent = ask::person(plan, stop)?;
    // A scanner that streams has filled the input buffer in the meantime.
    port.discard_input(plan.baud.rate()).map_err(|error| lost_before_writing(&name, &error))?;
    let mut change = Change::new(consent, clock::now());
    if let Source::Tcp { .. } = order.source {
        change = change.behind_server();
    }
    let mut shown = None;
    // An interrupt would leave the change incomplete. It takes seconds, and ends in any case.
    let never_stop = AtomicBool::new(false);
    let mut procedure = Procedure::new(|change: &Change| {
        if shown != Some(change.step()) {
            shown = Some(change.step());
            tell(News::Doing(describe_step(change.step())));
        }
        true
    });
    let result = drive(&port, &mut change, &mut procedure, &never_stop);
    result.map_err(|failure| lost_while_writing(&name, &change, &failure))?;
    let configured = Configured::of(&name, &plan, was_permanent, change.outcome())?;
    tell(News::Configured(&configured));
    Ok(())
}

/// One value that would change; class `difference`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Difference {
    class: &'static str,
    port: String,
    item: &'static str,
    /// Index of its first byte in the configuration; `None` if the scanner keeps it elsewhere.
    offset: Option<usize>,
    before: String,
    after: String,
}

impl fmt::Display for Difference {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Difference { item, before, after, .. } = self;
        write!(f, "{item}: {before} -> {after}")
    }
}

impl Difference {
    /// Returns everything that `plan` changes in the scanner at `port`.
    ///
    /// `was_permanent` states whether the scanner has started at another rate than 9600 Bd so far, if it reported that.
    fn all(port: &str, plan: &Plan, family: Option<Family>, was_permanent: Option<bool>) -> Vec<Difference> {
        let difference = |item, offset, before, after| Difference {
            class: "difference",
            port: port.to_owned(),
            item,
            offset,
            before,
            after,
        };
        let items = plan.old.differences(&plan.new);
        let mut differences: Vec<Difference> = items
            .map(|item| {
                let value = |bytes: &[u8]| describe_value(item, bytes, family);
                difference(item.name, Some(item.at), value(plan.old.bytes()), value(plan.new.bytes()))
            })
            .collect();
        differences.extend(plan.power_on.map(|power_on| {
            let before = match was_permanent {
                Some(false) => "9600 Bd",
                Some(true) => "not 9600 Bd; the sensor does not report the rate",
                None => "not reported by the sensor",
            };
            let after = match power_on {
                PowerOn::KeepBaud => {
                    format!("{} Bd: the present rate of the line becomes permanent", plan.baud.rate())
                }
                _ => "9600 Bd".to_owned(),
            };
            difference("rate after power-on", None, before.to_owned(), after)
        }));
        differences
    }
}

/// Result of a change that succeeded, or that had nothing to change; class `configured`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Configured {
    class: &'static str,
    port: String,
    /// Whether anything was written.
    written: bool,
    /// The configuration before the change, in hex.
    before: String,
    /// The configuration as it was read back, in hex.
    after: String,
    /// The operating mode of the scanner now.
    operating_mode: u8,
    /// The operating mode in which the scanner was found.
    found_mode: u8,
    /// The settings that undo the change; only the text has them.
    #[serde(skip)]
    undo: UndoSettings,
}

/// The settings of `configure` that undo a change.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
struct UndoSettings {
    settings: Vec<String>,
    /// Whether the previous rate after power-on was overwritten although the scanner did not report it.
    is_rate_lost: bool,
}

impl UndoSettings {
    /// Returns the settings that undo `plan`. `was_permanent` has the meaning as in [`Difference::all`].
    fn of(plan: &Plan, was_permanent: Option<bool>) -> UndoSettings {
        let mut undo = UndoSettings::default();
        if plan.new != plan.old {
            undo.settings.push(format!("configuration={}", hex(plan.old.bytes())));
        }
        match (plan.power_on, was_permanent) {
            (None, _) => {}
            (Some(_), Some(false)) => undo.settings.push("power_on_baud=9600".to_owned()),
            (Some(_), _) => undo.is_rate_lost = true,
        }
        undo
    }
}

impl Configured {
    /// Creates the result of a plan that changes nothing.
    fn nothing(port: &str, plan: &Plan) -> Configured {
        Configured {
            class: "configured",
            port: port.to_owned(),
            written: false,
            before: hex(plan.old.bytes()),
            after: hex(plan.old.bytes()),
            operating_mode: plan.operating_mode,
            found_mode: plan.operating_mode,
            undo: UndoSettings::default(),
        }
    }

    /// Creates the result of `plan` from the `outcome` of the change. `was_permanent` has the meaning as in
    /// [`Difference::all`].
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Failed`] with the state of the scanner if a step failed.
    fn of(
        port: &str,
        plan: &Plan,
        was_permanent: Option<bool>,
        outcome: &Outcome,
    ) -> Result<Configured, Failure> {
        if let Some((step, failing)) = outcome.failed {
            return Err(failure(port, plan, outcome, step, failing));
        }
        Ok(Configured {
            written: true,
            after: hex(outcome.configuration.as_ref().map_or(&[], OwnedConfiguration::bytes)),
            operating_mode: outcome.operating_mode.unwrap_or_default(),
            undo: UndoSettings::of(plan, was_permanent),
            ..Configured::nothing(port, plan)
        })
    }
}

impl fmt::Display for Configured {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Configured { port, undo, .. } = self;
        if !self.written {
            return write!(f, "{port}: nothing to change, nothing was written");
        }
        let now = operating::name(self.operating_mode);
        write!(f, "{port}: written, read back and correct; now at: {now}")?;
        if self.operating_mode != self.found_mode {
            write!(f, "\n  it was found at: {}", operating::name(self.found_mode))?;
        }
        if !undo.settings.is_empty() {
            write!(f, "\n  to go back: scanhub configure {port} {}", undo.settings.join(" "))?;
        }
        if undo.is_rate_lost {
            f.write_str(
                "\n  the earlier rate after power-on cannot be restored: the sensor did not report it",
            )?;
        }
        Ok(())
    }
}

/// Parses the password of the installation mode.
fn password(text: &str) -> Result<Password, Failure> {
    let refuse = |_| {
        let message = format!("--password: {} characters", text.chars().count());
        Failure::new(Kind::Configuration, message, "a password has 8 ASCII characters, such as SICK_LMS")
    };
    text.as_bytes().try_into().map(Password).map_err(refuse)
}

/// Returns the action of `step`, as text.
fn describe_step(step: Step) -> &'static str {
    match step {
        Step::Compare => "checking that nothing has changed",
        Step::Enter => "entering installation mode",
        Step::Write => "writing, which takes up to 15 s",
        Step::Check => "checking what was written",
        Step::PowerOn => "setting the rate after power-on",
        Step::Leave => "leaving installation mode",
        Step::ReadBack | Step::ReadStatus => "reading back",
        Step::Restore => "restarting the stream",
        Step::Done => "done",
    }
}

/// Returns the value of `item` in hex, with its meaning if it has one.
fn describe_value(item: Item, bytes: &[u8], family: Option<Family>) -> String {
    let value = bytes.get(item.at..item.at + item.len).unwrap_or_default();
    let byte = value.first().copied().unwrap_or_default();
    let meaning = match item.at {
        SENSITIVITY if family == Some(Family::Lms291) => {
            SENSITIVITIES.get(usize::from(byte)).map_or(String::new(), |name| (*name).to_owned())
        }
        AVAILABILITY => availability_words(byte).to_owned(),
        MODE => measuring(Mode(byte)),
        UNIT => Unit::of_code(byte).map_or(String::new(), |unit| format!("{} mm", unit.mm())),
        _ => String::new(),
    };
    let hex = hex(value);
    if meaning.is_empty() { format!("{hex}h") } else { format!("{hex}h ({meaning})") }
}

/// Returns the failure of a change in `step`, with the state of the scanner.
/// Returns the failure of a change in `step`, with the state of the scanner.
fn failure(port: &str, plan: &Plan, outcome: &Outcome, step: Step, failing: Failing) -> Failure {
    let what = match (step, failing) {
        (Step::Enter, Failing::Refused) => "the sensor refuses the installation mode: wrong password?".into(),
        (Step::Compare, Failing::Differs) => {
            "its settings changed since you confirmed: is this another sensor?".into()
        }
        (_, Failing::Differs) => "the settings read back differ from those written".into(),
        (step, Failing::Refused) => format!("{}: the sensor refuses", describe_step(step)),
        (step, Failing::Unanswered) => format!("{}: no answer", describe_step(step)),
    };
    if step == Step::Compare {
        return Failure::new(Kind::Failed, format!("{port}: {what}"), "nothing was written");
    }
    let kept = match outcome.configuration {
        _ if !outcome.written => "nothing was written".into(),
        None => format!("the settings in the EEPROM are not known now; before: {}", hex(plan.old.bytes())),
        Some(kept) if kept == plan.old && plan.old != plan.new => {
            "the EEPROM has the old configuration".into()
        }
        Some(kept) if kept == plan.new => "the EEPROM has the new configuration".into(),
        Some(kept) => format!("the EEPROM has {}; before: {}", hex(kept.bytes()), hex(plan.old.bytes())),
    };
    let mode = match outcome.operating_mode {
        Some(mode) => format!("it is at: {}", operating::name(mode)),
        None => UNKNOWN_MODE.to_owned(),
    };
    Failure::new(Kind::Failed, format!("{port}: {what}"), format!("{kept}; {mode}"))
}

/// Returns the failure for a port that failed before anything was sent.
fn lost_before_writing(port: &str, error: &std::io::Error) -> Failure {
    Failure::new(Kind::PortMissing, format!("{port}: {error}"), "nothing was written")
}

/// Returns the failure for a port that disappeared during `change`.
fn lost_while_writing(port: &str, change: &Change, failure: &Failure) -> Failure {
    let kept = if change.outcome().written {
        "whether it was written is not known: scanhub probe shows it"
    } else {
        "nothing was written"
    };
    let what = format!("{port}: {}: {}", describe_step(change.step()), failure.message);
    Failure::new(failure.kind, what, format!("{kept}; {UNKNOWN_MODE}"))
}

/// Remedy for a scanner whose operating mode is unknown.
const UNKNOWN_MODE: &str = "it may be in installation mode: scanhub run leaves it, or power it off and on";
