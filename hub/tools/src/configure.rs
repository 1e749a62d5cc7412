//! `scanhub configure`: changes the EEPROM settings of an LMS. Reads the settings, shows each difference, asks a
//! person, writes, reads back, and reports the settings and the state of the scanner, above all after a failure.
//!
//! `request_consent` is the only place that creates consent: nothing is written into a scanner unless a person has
//! typed `yes`.

use std::fmt;
use std::io::{IsTerminal, Write, stderr, stdin};
use std::os::fd::AsFd;
use std::sync::atomic::{AtomicBool, Ordering};

use clap::Args;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::termios::{QueueSelector, tcflush};
use scanhub_drivers::IdentityProbe;
use scanhub_drivers::lms::command::Password;
use scanhub_drivers::lms::configuration::{Item, availability_text};
use scanhub_drivers::lms::identity_probe::Report;
use scanhub_drivers::lms::lms_model::LmsModel;
use scanhub_drivers::lms::operating;
use scanhub_drivers::lms::variant::{Mode, Unit};
use scanhub_lms_configure::eeprom::PowerOn;
use scanhub_lms_configure::{Change, ChangeError, Consent, Outcome, OwnedConfiguration, Plan, Step};
use scanhub_port::{PortSpec, clock};
use scanhub_schema::{Failure, Kind};
use scanhub_shm::Domain;
use serde::Serialize;

use crate::driver::{Procedure, run_protocol};
use crate::probe::{check_unused, describe_mode, hex, open, request_report, source};
use crate::terminal::{Progress, print};

/// Change the EEPROM settings of a scanner. Shows the difference and asks first
#[derive(Args, Debug)]
#[command(after_help = AFTER_HELP)]
pub struct ConfigureArgs {
    /// Port of the scanner: a tty or tcp:HOST:PORT
    #[arg(value_name = "PORT")]
    port: String,
    /// Settings to write: unit=mm|cm, mode=NAME|0x01, availability=1|2|3, indices=on|off,
    /// sensitivity=standard|medium|low|high, power_on_baud=9600|keep, configuration=HEX
    #[arg(value_name = "KEY=VALUE")]
    settings: Vec<String>,
    /// Password of the installation mode
    #[arg(long, default_value = "SICK_LMS", value_name = "WORD")]
    password: String,
}

/// Text about the confirmation, for the end of the help.
const AFTER_HELP: &str = "\
Example:
  scanhub configure /dev/ttyUSB0 unit=mm

A person must confirm. If stdin or stderr is not a terminal, the difference is \
                           shown, nothing is written, and the exit code is 2";

impl ConfigureArgs {
    /// Changes the settings, and prints differences and the result to `out`. `locations` are the locations in which a
    /// client would search for the domain of a hub, which may use the port.
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
    pub fn run(
        &self,
        json: bool,
        locations: &[Domain],
        out: &mut (impl Write + AsFd),
        stop: &AtomicBool,
    ) -> Result<(), Failure> {
        // The person who confirms must see the differences, even if stdout is redirected.
        let repeats = !out.as_fd().is_terminal() && stderr().is_terminal();
        let mut progress = Progress::on_stderr();
        let result = self.configure(json, locations, out, repeats, &mut progress, stop);
        if result.is_err() {
            progress.keep_text();
        }
        result
    }

    /// Changes the settings. A line that cannot be written to `out` does not stop a change. `repeats` states whether
    /// differences are also written to stderr.
    fn configure(
        &self,
        json: bool,
        locations: &[Domain],
        out: &mut dyn Write,
        repeats: bool,
        progress: &mut Progress,
        stop: &AtomicBool,
    ) -> Result<(), Failure> {
        let source = source(&self.port)?;
        let requested = SettingsRequest::parse(&self.settings)?;
        let password = parse_password(&self.password)?;
        check_unused(&source, locations)?;
        let (port, first) = open(&source, stop)?;
        let rate = if let PortSpec::Tcp { .. } = source { None } else { Some(first) };
        let probe = IdentityProbe::begin(rate, clock::now());
        let report = request_report(&port, first, probe, (&source, true), stop, |rate| {
            progress.show(&format!("trying {rate} Bd"))
        })?;
        let name = source.name();
        let Some(mut plan) = Plan::from_report(&report) else {
            return Err(Failure::new(
                Kind::Timeout,
                format!("{name}: the sensor does not report its configuration"),
                "nothing was written; power it off and on, then try again",
            ));
        };
        plan.password = password;
        let family = report.kind().and_then(LmsModel::of_type);
        requested.apply(&mut plan, family, &report)?;
        if plan.is_empty() {
            progress.clear();
            let nothing = ConfigureReport::nothing(&name, &plan);
            let _ = print(out, json, &nothing, || nothing.to_string());
            return Ok(());
        }
        let was_permanent = report.status().map(|status| status.has_permanent_baud());
        progress.clear();
        for difference in Difference::all(&name, &plan, family, was_permanent) {
            let _ = print(out, json, &difference, || difference.to_string());
            if repeats {
                let _ = print(&mut stderr(), false, &difference, || difference.to_string());
            }
        }
        let consent = request_consent(plan, stop)?;
        // A scanner that streams has filled the input buffer while the person decided.
        port.discard_input(plan.baud.rate()).map_err(|error| lost_before_writing(&name, &error))?;
        let mut change = Change::new(consent, clock::now());
        if let PortSpec::Tcp { .. } = source {
            change = change.with_server();
        }
        let mut shown = None;
        // An interrupt would leave the change incomplete. The change takes only seconds, and always ends.
        let never_stop = AtomicBool::new(false);
        let mut procedure = Procedure::new(|change: &Change| {
            if shown != Some(change.step()) {
                shown = Some(change.step());
                progress.show(describe_step(change.step()));
            }
            true
        });
        let result = run_protocol(&port, &mut change, &mut procedure, &never_stop);
        result.map_err(|failure| lost_while_writing(&name, &change, &failure))?;
        let configured = ConfigureReport::of(&name, &plan, was_permanent, change.outcome())?;
        progress.clear();
        let _ = print(out, json, &configured, || configured.to_string());
        Ok(())
    }
}

/// One value that would change; class `difference`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Difference {
    class: &'static str,
    port: String,
    item: &'static str,
    /// Index of the value's first byte in the configuration; `None` if the scanner stores the value elsewhere.
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
    /// `was_permanent` states whether the scanner has so far used another rate than 9600 Bd after power-on. `None` if
    /// the scanner did not report it.
    fn all(
        port: &str,
        plan: &Plan,
        family: Option<LmsModel>,
        was_permanent: Option<bool>,
    ) -> Vec<Difference> {
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
pub struct ConfigureReport {
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

impl ConfigureReport {
    /// Creates the result of a plan that changes nothing.
    fn nothing(port: &str, plan: &Plan) -> ConfigureReport {
        ConfigureReport {
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
    ) -> Result<ConfigureReport, Failure> {
        if let Some((step, failing)) = outcome.failed {
            return Err(failure(port, plan, outcome, step, failing));
        }
        Ok(ConfigureReport {
            written: true,
            after: hex(outcome.configuration.as_ref().map_or(&[], OwnedConfiguration::bytes)),
            operating_mode: outcome.operating_mode.unwrap_or_default(),
            undo: UndoSettings::of(plan, was_permanent),
            ..ConfigureReport::nothing(port, plan)
        })
    }
}

impl fmt::Display for ConfigureReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let ConfigureReport { port, undo, .. } = self;
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
fn parse_password(text: &str) -> Result<Password, Failure> {
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

/// Returns the value of `item` in hex, with its meaning if that is known.
fn describe_value(item: Item, bytes: &[u8], family: Option<LmsModel>) -> String {
    let value = bytes.get(item.at..item.at + item.len).unwrap_or_default();
    let byte = value.first().copied().unwrap_or_default();
    let meaning = match item.at {
        SENSITIVITY if family == Some(LmsModel::Lms291) => {
            SENSITIVITIES.get(usize::from(byte)).map_or(String::new(), |name| (*name).to_owned())
        }
        AVAILABILITY => availability_text(byte).to_owned(),
        MODE => describe_mode(Mode(byte)),
        UNIT => Unit::of_code(byte).map_or(String::new(), |unit| format!("{} mm", unit.mm())),
        _ => String::new(),
    };
    let hex = hex(value);
    if meaning.is_empty() { format!("{hex}h") } else { format!("{hex}h ({meaning})") }
}

/// Returns the failure of a change in `step`, with the state of the scanner.
fn failure(port: &str, plan: &Plan, outcome: &Outcome, step: Step, failing: ChangeError) -> Failure {
    let what = match (step, failing) {
        (Step::Enter, ChangeError::Refused) => {
            "the sensor refuses the installation mode: wrong password?".into()
        }
        (Step::Compare, ChangeError::Mismatch) => {
            "its settings changed since you confirmed: is this another sensor?".into()
        }
        (_, ChangeError::Mismatch) => "the settings read back differ from those written".into(),
        (step, ChangeError::Refused) => format!("{}: the sensor refuses", describe_step(step)),
        (step, ChangeError::Unanswered) => format!("{}: no answer", describe_step(step)),
    };
    if step == Step::Compare {
        return Failure::new(Kind::Failed, format!("{port}: {what}"), "nothing was written");
    }
    let eeprom_state = match outcome.configuration {
        _ if !outcome.written => "nothing was written".into(),
        None => format!("the settings in the EEPROM are unknown; before: {}", hex(plan.old.bytes())),
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
    Failure::new(Kind::Failed, format!("{port}: {what}"), format!("{eeprom_state}; {mode}"))
}

/// Returns the failure for a port that failed before anything was sent.
fn lost_before_writing(port: &str, error: &std::io::Error) -> Failure {
    Failure::new(Kind::PortMissing, format!("{port}: {error}"), "nothing was written")
}

/// Returns the failure for a port that disappeared during `change`.
fn lost_while_writing(port: &str, change: &Change, failure: &Failure) -> Failure {
    let eeprom_state = if change.outcome().written {
        "whether it was written is not known: scanhub probe shows it"
    } else {
        "nothing was written"
    };
    let what = format!("{port}: {}: {}", describe_step(change.step()), failure.message);
    Failure::new(failure.kind, what, format!("{eeprom_state}; {UNKNOWN_MODE}"))
}

/// All settings that the command line requests.
#[derive(Clone, Debug)]
pub(crate) struct SettingsRequest(Vec<Setting>);

#[derive(Clone, Debug, PartialEq)]
enum Setting {
    Unit(Unit),
    Mode(Mode),
    /// Level 1, 2 or 3.
    Availability(u8),
    Indices(bool),
    Sensitivity(u8),
    PowerOn(PowerOn),
    Configuration(OwnedConfiguration),
}

impl SettingsRequest {
    /// Parses settings of the form `KEY=VALUE`.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Configuration`] with key, value and the valid values if a setting is invalid, and
    /// [`Kind::Usage`] if `settings` is empty.
    pub(crate) fn parse(settings: &[String]) -> Result<SettingsRequest, Failure> {
        if settings.is_empty() {
            let keys: Vec<String> = KEYS.iter().map(|(key, values, _)| format!("{key}={values}")).collect();
            return Err(Failure::new(Kind::Usage, "nothing to change", keys.join(", ")));
        }
        settings.iter().map(|setting| parse_setting(setting)).collect::<Result<_, _>>().map(SettingsRequest)
    }

    /// Applies every setting to `plan`.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Configuration`] if this scanner does not support a setting.
    fn apply(&self, plan: &mut Plan, family: Option<LmsModel>, report: &Report) -> Result<(), Failure> {
        let bits = |plan: &mut Plan, mask: u8, bits: u8| {
            let byte = plan.new.bytes().get(AVAILABILITY).copied().unwrap_or_default();
            plan.new.set(AVAILABILITY, byte & !mask | bits);
        };
        for setting in &self.0 {
            match *setting {
                Setting::Unit(unit) => plan.new.set(UNIT, unit.code()),
                Setting::Mode(mode) => plan.new.set(MODE, mode.0),
                Setting::Availability(3) => bits(plan, LEVEL_2 | LEVEL_3, LEVEL_3),
                Setting::Availability(2) => bits(plan, LEVEL_2 | LEVEL_3, LEVEL_2),
                Setting::Availability(_) => bits(plan, LEVEL_2 | LEVEL_3, 0),
                Setting::Indices(is_on) => bits(plan, INDICES, if is_on { INDICES } else { 0 }),
                Setting::Sensitivity(byte) => {
                    let reason = match family {
                        Some(family) => family.refuses_sensitivity(),
                        None => Some("its type is not known"),
                    };
                    if let Some(reason) = reason {
                        return Err(refused("sensitivity", reason));
                    }
                    plan.new.set(SENSITIVITY, byte);
                }
                Setting::PowerOn(power_on) => {
                    let is_set = report.status().is_some_and(|status| status.has_permanent_baud());
                    // The scanner does not report which rate it uses after power-on, so a request to keep the present
                    // rate always counts as a change.
                    let needed = power_on == PowerOn::KeepBaud || is_set;
                    plan.power_on = needed.then_some(power_on);
                }
                Setting::Configuration(given) if given.bytes().len() != plan.old.bytes().len() => {
                    let (is, given) = (plan.old.bytes().len(), given.bytes().len());
                    return Err(refused("configuration", &format!("it has {is} bytes, not {given}")));
                }
                Setting::Configuration(given) => plan.new = given,
            }
        }
        Ok(())
    }
}

fn parse_setting(text: &str) -> Result<Setting, Failure> {
    let refuse =
        |what: &str, remedy: String| Failure::new(Kind::Configuration, format!("{text}: {what}"), remedy);
    let (key, value) = text
        .split_once('=')
        .ok_or_else(|| refuse("no = in it", "write KEY=VALUE, for example unit=mm".into()))?;
    let Some((_, values, parse_value)) = KEYS.iter().find(|(known, ..)| *known == key) else {
        let keys: Vec<&str> = KEYS.iter().map(|(key, ..)| *key).collect();
        let nearest =
            keys.iter().max_by(|a, b| strsim::jaro_winkler(a, key).total_cmp(&strsim::jaro_winkler(b, key)));
        let near = nearest.filter(|known| strsim::jaro_winkler(known, key) > 0.75);
        let near = near.map_or(String::new(), |known| format!("did you mean {known}? "));
        return Err(refuse("unknown key", format!("{near}there are: {}", keys.join(", "))));
    };
    parse_value(value).ok_or_else(|| refuse("not possible", values.to_string()))
}

fn refused(key: &str, reason: &str) -> Failure {
    let message = format!("{key} cannot be set on this sensor: {reason}");
    Failure::new(Kind::Configuration, message, "nothing was written")
}

type Parse = fn(&str) -> Option<Setting>;

/// Parses a measuring mode by name or number (Telegram listing, 77h block D).
fn parse_mode(value: &str) -> Option<u8> {
    const NAMES: [(&str, u8); 9] = [
        ("fields-abd", 0x00),
        ("reflector3", 0x01),
        ("fields-abc", 0x02),
        ("reflector2", 0x03),
        ("fields-ab", 0x04),
        ("reflector1", 0x05),
        ("field-a", 0x06),
        ("range", 0x0F),
        ("energy", 0x3F),
    ];
    if let Some((_, byte)) = NAMES.iter().find(|(name, _)| *name == value) {
        return Some(*byte);
    }
    let byte = match value.strip_prefix("0x") {
        Some(hex) => u8::from_str_radix(hex, 16).ok()?,
        None => value.parse().ok()?,
    };
    (NAMES.iter().any(|(_, known)| *known == byte) || matches!(byte, 0x0D | 0x0E)).then_some(byte)
}

/// Asks a person for consent to `plan`, whose differences were shown.
///
/// # Errors
///
/// Returns [`Kind::Usage`] if stdin, or stderr with the question, is not a terminal, [`Kind::Interrupted`] if `stop` is
/// set, and [`Kind::Failed`] if the answer is not `yes`.
fn request_consent(plan: Plan, stop: &AtomicBool) -> Result<Consent, Failure> {
    let input = stdin();
    if !input.is_terminal() || !stderr().is_terminal() {
        return Err(Failure::new(
            Kind::Usage,
            "nothing was written: a person must confirm it",
            "run the same command in a terminal, with stdin and stderr not redirected",
        ));
    }
    // Input that was typed before the question does not count as an answer.
    let _ = tcflush(&input, QueueSelector::IFlush);
    let question = "The EEPROM wears out after a few thousand writes. Write this? Type yes: ";
    let _ = stderr().write_all(question.as_bytes());
    loop {
        if stop.load(Ordering::Relaxed) {
            let _ = stderr().write_all(b"\n");
            return Err(Failure::new(Kind::Interrupted, "interrupted, nothing was written", ""));
        }
        // A terminal becomes readable once it has a whole line.
        let mut fds = [PollFd::new(&input, PollFlags::IN)];
        if poll(&mut fds, Some(&STOP_CHECK_INTERVAL)).is_ok_and(|ready| ready > 0) {
            break;
        }
    }
    let mut answer = String::new();
    let read = input.read_line(&mut answer);
    // An answer without a newline, such as Ctrl-D, leaves the cursor on the line of the question.
    if !answer.ends_with('\n') {
        let _ = stderr().write_all(b"\n");
    }
    if read.is_ok() && answer.trim() == "yes" {
        return Ok(Consent::confirmed_by_person(plan));
    }
    Err(Failure::new(Kind::Failed, "not confirmed: nothing was written", "to write, answer: yes"))
}

/// Remedy for a scanner whose operating mode is unknown.
const UNKNOWN_MODE: &str = "it may be in installation mode: scanhub run leaves it, or power it off and on";
/// The keys, their valid values as text, and their parsers.
const KEYS: [(&str, &str, Parse); 7] = [
    ("unit", "mm or cm", |value| match value {
        "mm" => Some(Setting::Unit(Unit::Mm)),
        "cm" => Some(Setting::Unit(Unit::Cm)),
        _ => None,
    }),
    (
        "mode",
        "fields-abd (0x00), reflector3 (0x01), fields-abc (0x02), reflector2 (0x03), fields-ab (0x04), \
         reflector1 (0x05), field-a (0x06), range (0x0F), energy (0x3F), or 0x0D and 0x0E",
        |value| parse_mode(value).map(Mode).map(Setting::Mode),
    ),
    ("availability", "1, 2 or 3", |value| match value.parse() {
        Ok(level @ 1..=3) => Some(Setting::Availability(level)),
        _ => None,
    }),
    ("indices", "on or off", |value| match value {
        "on" => Some(Setting::Indices(true)),
        "off" => Some(Setting::Indices(false)),
        _ => None,
    }),
    ("sensitivity", "standard, medium, low or high", |value| {
        let at = SENSITIVITIES.iter().position(|name| *name == value)?;
        Some(Setting::Sensitivity(at as u8))
    }),
    ("power_on_baud", "9600, or keep for the present rate", |value| match value {
        "9600" => Some(Setting::PowerOn(PowerOn::Baud9600)),
        "keep" => Some(Setting::PowerOn(PowerOn::KeepBaud)),
        _ => None,
    }),
    ("configuration", "all 32 or 34 bytes in hex, as probe shows them", |value| {
        let digits: Vec<u8> = value.chars().map(|c| Some(c.to_digit(16)? as u8)).collect::<Option<_>>()?;
        let bytes: Vec<u8> =
            digits.chunks(2).map(|pair| pair.iter().fold(0, |sum, d| sum << 4 | d)).collect();
        digits
            .len()
            .is_multiple_of(2)
            .then(|| OwnedConfiguration::new(&bytes))
            .flatten()
            .map(Setting::Configuration)
    }),
];
/// Sensitivities of the LMS 291 by their number: 30, 25, 20 and 42 m at 10 % (Telegram listing, 77h block C).
const SENSITIVITIES: [&str; 4] = ["standard", "medium", "low", "high"];
/// Index of the sensitivity in the configuration. All indices are from the Telegram listing, 77h blocks C to E.
const SENSITIVITY: usize = 3;
/// See [`SENSITIVITY`].
const AVAILABILITY: usize = 4;
/// See [`SENSITIVITY`].
const MODE: usize = 5;
/// See [`SENSITIVITY`].
pub(crate) const UNIT: usize = 6;
const LEVEL_3: u8 = 1;
const INDICES: u8 = 2;
const LEVEL_2: u8 = 4;
/// Interval between checks for an interrupt.
const STOP_CHECK_INTERVAL: Timespec = Timespec { tv_sec: 0, tv_nsec: 100_000_000 };

#[cfg(test)]
mod tests {
    use scanhub_drivers::lms::configuration::factory_configuration;
    use scanhub_drivers::lms::variant::Baud;

    use super::*;

    fn plan() -> Plan {
        let old = OwnedConfiguration::new(&factory_configuration(Mode(1), Unit::Mm)).unwrap();
        Plan {
            baud: Baud::B9600,
            address: 0,
            operating_mode: 0x25,
            old,
            new: old,
            power_on: None,
            password: Password::FACTORY,
        }
    }

    fn applied(settings: &[&str], family: Option<LmsModel>) -> Result<Plan, Failure> {
        let settings: Vec<String> = settings.iter().map(|setting| (*setting).to_owned()).collect();
        let mut plan = plan();
        SettingsRequest::parse(&settings)?.apply(&mut plan, family, &Report::default())?;
        Ok(plan)
    }

    #[test]
    fn each_setting_changes_its_byte() {
        let byte = |setting: &str, at: usize| {
            let plan = applied(&[setting], Some(LmsModel::Lms291)).unwrap();
            plan.new.bytes()[at]
        };
        assert_eq!((byte("unit=cm", 6), byte("unit=mm", 6)), (0, 1));
        assert_eq!((byte("mode=reflector1", 5), byte("mode=0x0F", 5), byte("mode=13", 5)), (5, 15, 13));
        assert_eq!((byte("availability=3", 4), byte("availability=2", 4)), (1, 4));
        assert_eq!((byte("indices=on", 4), byte("sensitivity=high", 3)), (2, 3));
        let both = applied(&["indices=on", "availability=3", "indices=off"], None).unwrap();
        assert_eq!(both.new.bytes()[4], 1);
        assert!(applied(&["unit=mm", "mode=1", "power_on_baud=9600"], None).unwrap().is_empty());
        assert_eq!(applied(&["power_on_baud=keep"], None).unwrap().power_on, Some(PowerOn::KeepBaud));
        let hex = "00".repeat(34);
        assert_eq!(applied(&[&format!("configuration={hex}")], None).unwrap().new.bytes(), [0; 34]);
    }

    #[test]
    fn rejects_invalid_settings_with_valid_ones() {
        let refusal = |setting: &str, family| {
            let failure = applied(&[setting], family).unwrap_err();
            assert_eq!(failure.kind, Kind::Configuration);
            failure.to_string()
        };
        for (setting, words) in [
            ("unit", "KEY=VALUE"),
            ("units=mm", "did you mean unit?"),
            ("unit=dm", "mm or cm"),
            ("mode=7", "reflector3 (0x01)"),
            ("mode=0x100", "reflector3"),
            ("availability=4", "1, 2 or 3"),
            ("power_on_baud=500000", "9600, or keep"),
            ("configuration=00", "32 or 34 bytes"),
            ("sensitivity=high", "only the LMS 291"),
        ] {
            let text = refusal(setting, Some(LmsModel::Lms200));
            assert!(text.contains(words), "{setting}: {text}");
        }
        assert!(refusal("sensitivity=low", None).contains("not known"));
        let old = format!("configuration={}", "00".repeat(32));
        assert!(refusal(&old, None).contains("34 bytes, not 32"));
        assert_eq!(SettingsRequest::parse(&[]).unwrap_err().kind, Kind::Usage);
    }
}
