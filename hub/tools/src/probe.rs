//! `scanhub probe`: finds the scanner at a port with the search of the hub, for scanners of any family. Then requests
//! the identity, settings and state that the scanner reports. Changes no settings. `SuggestedLink` is the link that a
//! configuration needs for the scanner, as a command for the shell and as a section of a file.

mod description;

use std::fmt;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use clap::Args;
use scanhub_drivers::search::{self, Coverage};
use scanhub_drivers::{IdentityProbe, Report, features, identity_probe};
use scanhub_port::{
    Port, PortError, PortSpec, PortlessAdapter, SerialPortInfo, all_holders, check_tty, clock, serial_ports,
    serial_ports_in,
};
use scanhub_schema::{Failure, Family, Kind};
use scanhub_shm::Domain;
use serde::Serialize;

use crate::doctor::Hub;
use crate::driver::{self, DetectedScanner, NotFound, Procedure, detect, not_detected, run_protocol};
use crate::terminal::{Progress, print};
use description::link_settings;
use description::{Description, FoundDescription, RotatingDescription};
pub(crate) use description::{describe_mode, hex};

/// List the ports, or identify the scanner at one port
#[derive(Args, Debug)]
#[command(after_help = EXAMPLES)]
pub struct ProbeArgs {
    /// Port of the scanner: a tty or tcp:HOST:PORT. Without a port, the ports of this machine are listed
    #[arg(value_name = "PORT")]
    port: Option<String>,
    /// Print only the section of the link for a configuration file
    #[arg(long, requires = "port", conflicts_with = "json")]
    toml: bool,
}

const EXAMPLES: &str = "\
Examples:
  scanhub probe
  scanhub probe /dev/ttyUSB0
  scanhub probe /dev/ttyUSB0 --toml >> scanhub.toml";

impl ProbeArgs {
    /// Prints the scanner at the port, or the ports of this machine without opening any. `locations` returns the
    /// locations in which a client would search for the domain of a hub.
    ///
    /// # Errors
    ///
    /// Returns the failures of a port that cannot be used, including [`Kind::PortBusy`] if another process has it open.
    /// Returns [`Kind::PortMissing`] if there is no port to list, [`Kind::Timeout`] if no scanner replies, and
    /// [`Kind::Interrupted`] if `stop` is set.
    pub fn run(
        &self,
        json: bool,
        locations: impl FnOnce() -> Result<Vec<Domain>, Failure>,
        out: &mut dyn Write,
        stop: &AtomicBool,
    ) -> Result<(), Failure> {
        let Some(port) = &self.port else { return list_ports(json, out) };
        let locations = locations()?;
        let mut progress = Progress::on_stderr();
        let found =
            probe(&source(port)?, &locations, stop, |rate| progress.show(&format!("trying {rate} Bd")));
        if found.is_err() {
            progress.keep_text();
        }
        drop(progress);
        let found = found?;
        print(out, json, &found, || match self.toml {
            true => found.link.toml(),
            false => format!("{port}\n{found}"),
        })
    }
}

/// Prints the serial lines of this machine, and the adapters that have no serial line.
fn list_ports(json: bool, out: &mut dyn Write) -> Result<(), Failure> {
    const PLUG_IN: &str =
        "plug in an adapter for RS-422 (500 kBd) or RS-232; `dmesg` shows whether the kernel saw it";
    let (candidates, portless) = (serial_ports(), PortlessAdapter::all(Path::new("/")));
    for candidate in &candidates {
        print(out, json, &CandidateLine::of(candidate), || describe(candidate))?;
    }
    for adapter in &portless {
        let remedy = adapter.remedy();
        print(out, json, &AdapterLine::of(adapter), || format!("{adapter}\n  {remedy}"))?;
    }
    if !candidates.is_empty() {
        return Ok(());
    }
    let remedy = portless.first().map_or(PLUG_IN.to_owned(), PortlessAdapter::remedy);
    Err(Failure::new(Kind::PortMissing, "no serial line on this machine", remedy))
}

/// Class `candidate`.
#[derive(Serialize)]
struct CandidateLine<'a> {
    class: &'static str,
    port: String,
    device: String,
    driver: Option<&'a str>,
    product: Option<&'a str>,
    permitted: bool,
    /// ID of the process that has the port open.
    holder: Option<u32>,
    program: Option<&'a str>,
    /// Name in /dev/serial/by-id that another adapter has, too.
    shared_name: Option<String>,
    caution: Option<String>,
    remedy: Option<String>,
}

impl<'a> CandidateLine<'a> {
    fn of(candidate: &'a SerialPortInfo) -> CandidateLine<'a> {
        let (caution, remedy) = caution(candidate).unzip();
        CandidateLine {
            class: "candidate",
            port: candidate.name.display().to_string(),
            device: candidate.device.display().to_string(),
            driver: candidate.driver.as_deref(),
            product: candidate.product.as_deref(),
            permitted: candidate.is_permitted,
            holder: candidate.holder.as_ref().map(|holder| holder.pid),
            program: candidate.holder.as_ref().map(|holder| holder.program.as_str()),
            shared_name: candidate.shared_name.as_ref().map(|name| name.display().to_string()),
            caution,
            remedy,
        }
    }
}

/// Class `adapter`.
#[derive(Serialize)]
struct AdapterLine<'a> {
    class: &'static str,
    usb: &'a str,
    id: &'a str,
    chip: &'a str,
    module: &'a str,
    problem: String,
    remedy: String,
}

impl<'a> AdapterLine<'a> {
    fn of(adapter: &'a PortlessAdapter) -> AdapterLine<'a> {
        AdapterLine {
            class: "adapter",
            usb: &adapter.usb,
            id: &adapter.id,
            chip: adapter.chip,
            module: adapter.module,
            problem: adapter.to_string(),
            remedy: adapter.remedy(),
        }
    }
}

/// Returns the caution about a port and its remedy, including the caution that another adapter shares the port's name.
fn caution(candidate: &SerialPortInfo) -> Option<(String, String)> {
    candidate.caution(candidate.shared_name.as_ref().unwrap_or(&candidate.name))
}

fn describe(candidate: &SerialPortInfo) -> String {
    let SerialPortInfo { name, device, driver, product, holder, is_permitted, .. } = candidate;
    let state = match (holder, is_permitted) {
        (Some(holder), _) => format!("in use by {holder}"),
        (None, true) => "free".to_owned(),
        (None, false) => format!("no permission: scanhub doctor {} shows the reason", name.display()),
    };
    let device = (name != device).then(|| device.display().to_string());
    let facts: Vec<String> =
        [device, product.clone(), driver.clone(), Some(state)].into_iter().flatten().collect();
    let caution = caution(candidate).map(|(what, remedy)| format!("\n  {what}; {remedy}"));
    format!("{}  {}{}", name.display(), facts.join(", "), caution.unwrap_or_default())
}

/// Scanner at a port, with the link that a configuration needs for it; class `probe`.
#[derive(Clone, Debug, Serialize)]
struct ProbeResult {
    #[serde(flatten)]
    found: FoundDescription,
    /// Value of `--link`.
    #[serde(rename = "link")]
    flag: String,
    /// Link for a configuration.
    #[serde(skip)]
    link: SuggestedLink,
    /// Caution about the port, and its remedy.
    #[serde(skip)]
    caution: Option<(String, String)>,
}

impl ProbeResult {
    fn new(found: FoundDescription, link: SuggestedLink, caution: Option<(String, String)>) -> ProbeResult {
        ProbeResult { found, flag: link.flag(), link, caution }
    }
}

impl fmt::Display for ProbeResult {
    /// Writes the rows, and then the next command.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.found)?;
        if let Some((what, remedy)) = &self.caution {
            writeln!(f, "  {:<16}{what}; {remedy}", "port")?;
        }
        write!(f, "next: {}", self.link.command())
    }
}

/// Finds the scanner at `source`. Until the family is known, the scanner gets only the requests of the search. Calls
/// `on_rate` with each rate at which it searches.
fn probe(
    source: &PortSpec,
    locations: &[Domain],
    stop: &AtomicBool,
    on_rate: impl FnMut(u32),
) -> Result<ProbeResult, Failure> {
    check_unused(source, locations)?;
    let (port, first) = open(source, stop)?;
    let serial_ports = serial_ports_in(Path::new("/"));
    let caution =
        candidate_of(source, &serial_ports).and_then(|port| port.caution(Path::new(&source.name())));
    let found_scanner =
        find(&port, first, source, None, stop, on_rate).map_err(|failure| match &caution {
            Some((what, remedy)) if failure.kind == Kind::Timeout => {
                Failure { hint: format!("it is {what}; {remedy}; or {}", failure.hint), ..failure }
            }
            _ => failure,
        })?;
    Ok(match found_scanner {
        FoundScanner::Reported(report) => {
            // The rate of a serial server is set at the server, so the link needs the rate at which the scanner
            // replied.
            let rate = if is_server(source) { report.baud.map(|baud| baud.rate()) } else { None };
            let settings = link_settings(&report, rate.unwrap_or(first));
            let found = FoundDescription::Reported(Box::new(Description::new(source.name(), &report)));
            ProbeResult::new(found, SuggestedLink::new(source, &serial_ports, settings), caution)
        }
        FoundScanner::Rotating(scanner) => {
            let found =
                FoundDescription::Rotating(Box::new(RotatingDescription::new(source.name(), &scanner)));
            let family = ("family", scanner.family.name().to_owned());
            let model = scanner.model.map(|model| ("model", model.name.to_owned()));
            let settings = std::iter::once(family).chain(model).collect();
            ProbeResult::new(found, SuggestedLink::new(source, &serial_ports, settings), caution)
        }
    })
}

/// The scanner that was found.
pub(crate) enum FoundScanner {
    /// A scanner that reports its settings on request, with its replies.
    Reported(Box<Report>),
    /// A rotating scanner.
    Rotating(Box<DetectedScanner>),
}

/// Finds the scanner at `port`, whose highest possible rate is `first`, in bits per second. The scanner may be of any
/// family, or of `only` one.
///
/// # Errors
///
/// Returns [`Kind::Timeout`] if no scanner replies; the other kinds are those of [`probe`].
pub(crate) fn find(
    port: &Port,
    first: u32,
    source: &PortSpec,
    only: Option<Family>,
    stop: &AtomicBool,
    mut on_rate: impl FnMut(u32),
) -> Result<FoundScanner, Failure> {
    // A family with a probe needs no search, because its probe also finds the rate.
    let known = only.filter(|&family| features(family).has_identity_probe);
    let found = match known {
        Some(family) => search::FoundScanner { family, model: None, rate: None },
        None => driver::search(port, only, stop, &mut on_rate)?
            .map_err(|not_found| nothing_found(source, only.is_some(), &not_found))?,
    };
    let rate = (!is_server(source)).then_some(found.rate.unwrap_or(first));
    if let Some(probe) = identity_probe(found.family, rate, clock::now()) {
        let report = request_report(port, first, probe, (source, only.is_some()), stop, on_rate)?;
        return Ok(FoundScanner::Reported(Box::new(report)));
    }
    let detected = detect(port, found, stop)?;
    let scanner = detected.map_err(|bytes| not_detected(&source.name(), found, bytes))?;
    Ok(FoundScanner::Rotating(Box::new(scanner)))
}

/// Returns the failure for a port at which a search has found no scanner. The message lists the families and rates of
/// the search, and the hint states what to check at a scanner of each family. If the user named a family (`is_named`),
/// the hint adds that the scanner may belong to another one.
fn nothing_found(source: &PortSpec, is_named: bool, NotFound { bytes, coverage }: &NotFound) -> Failure {
    let (possible, impossible): (Vec<_>, Vec<_>) = coverage.iter().partition(|it| !it.rates.is_empty());
    let at_rates = |it: &&Coverage| format!("{} at {} Bd", it.family.name(), or_list(&it.rates));
    let searched: Vec<String> = possible.iter().map(at_rates).collect();
    let arrived = match bytes {
        0 => "no byte arrived".to_owned(),
        bytes => format!("{bytes} bytes arrived that scanhub does not recognize"),
    };
    let mut message = format!("{}: no scanner replies; {arrived}", source.name());
    if !searched.is_empty() {
        message += &format!("; looked for {}", searched.join(", "));
    }
    let mut remedies = vec![match (source, bytes) {
        (PortSpec::Tcp { .. }, _) => {
            "set the serial server to the scanner's rate, 8 bits, no parity; a server that has another client already may \
             let this one wait: end that program first; check power and cable"
        }
        (_, 0) => "check power and cable, each transmitter to the other's receiver",
        _ => "another device, a line that damages the bytes (ground, RS-232 instead of RS-422), or a missing wire?",
    }
    .to_owned()];
    if is_named {
        remedies.insert(0, other_scanner(source));
    }
    remedies.extend(possible.iter().map(|it| format!("{}: {}", it.family.name(), it.advice)));
    for it in impossible {
        let (family, rates) = (it.family.name(), or_list(&it.rejected));
        message += &format!(
            "; this port cannot have {rates} Bd, so scanners of family {family} cannot be found here"
        );
        remedies.push(format!("{family}: use an adapter with a CP2102N, FT232R or newer"));
    }
    Failure::new(Kind::Timeout, message, remedies.join("; "))
}

/// Returns the remedy for a port at which no scanner of the named family replies.
fn other_scanner(source: &PortSpec) -> String {
    format!("is it another scanner? Try: scanhub probe {}", scanhub_shm::shell_word(&source.name()))
}

/// Lists `rates`, as in "9600, 19200 or 38400".
fn or_list(rates: &[u32]) -> String {
    let mut words: Vec<String> = rates.iter().map(u32::to_string).collect();
    let last = words.pop().unwrap_or_default();
    if words.is_empty() { last } else { format!("{} or {last}", words.join(", ")) }
}

/// Parses the name of a port: a tty, or `tcp:HOST:PORT`.
///
/// # Errors
///
/// Returns [`Kind::Configuration`] if `text` does not name a port.
pub(crate) fn source(text: &str) -> Result<PortSpec, Failure> {
    PortSpec::parse(text).map_err(|what| {
        Failure::new(
            Kind::Configuration,
            format!("{text}: {what}"),
            "name a tty (scanhub probe lists them), or tcp:HOST:PORT",
        )
    })
}

/// Checks that no other process has `source` open, even without a lock. Otherwise, that process and this one would each
/// get only a part of the bytes. `locations` are the locations in which a client would search for the domain of a hub.
///
/// # Errors
///
/// Returns [`Kind::PortBusy`] with the process. If this process is a hub, the failure contains the hub's report about
/// its link.
pub(crate) fn check_unused(source: &PortSpec, locations: &[Domain]) -> Result<(), Failure> {
    let holders = match source {
        // The path is not a tty. It may be a device such as /dev/null, which many processes have open. Opening the port
        // will fail with a better reason.
        PortSpec::Tty(path) if check_tty(path).is_err() => return Ok(()),
        PortSpec::Tty(path) => all_holders(path),
        // Another process may be connected to the server from anywhere. Only a hub of this machine reports that it is
        // connected.
        PortSpec::Tcp { .. } | PortSpec::File { .. } => Vec::new(),
    };
    match Hub::at(source, &holders, locations) {
        Some(hub) => Err(hub.refuse(source, &holders)),
        None if holders.is_empty() => Ok(()),
        None => Err(PortError::Busy.explain(source)),
    }
}

/// Opens `source` at the highest rate of a probe that it supports, in bits per second, unless `stop` is set before
/// it is open.
pub(crate) fn open(source: &PortSpec, stop: &AtomicBool) -> Result<(Port, u32), Failure> {
    let open = |rate: u32| Port::open(source, rate, stop).map(|port| (port, rate));
    let (port, rate) = open(HIGHEST_RATE).or_else(|failure| match failure.kind {
        Kind::PortRate => open(COMMON_RATE),
        _ => Err(failure),
    })?;
    // Bytes in the input buffer may be older than the scanner's last power-on. Setting the rate discards them.
    let _ = port.set_baud(rate);
    Ok((port, rate))
}

/// Requests identity, settings and state of the scanner at `port` by `probe`. The highest rate of the port is `first`,
/// in bits per second. If the user named the family, the failure adds that the scanner may belong to another one.
///
/// # Errors
///
/// Returns [`Kind::Timeout`] if no scanner replies; the other kinds are those of [`probe`].
pub(crate) fn request_report(
    port: &Port,
    first: u32,
    mut probe: IdentityProbe,
    (source, is_named): (&PortSpec, bool),
    stop: &AtomicBool,
    mut on_rate: impl FnMut(u32),
) -> Result<Report, Failure> {
    let mut shown_rate = None;
    let mut procedure = Procedure::new(|probe: &IdentityProbe| {
        if shown_rate != Some(probe.baud()) && !is_server(source) {
            shown_rate = Some(probe.baud());
            on_rate(probe.baud().rate());
        }
        true
    });
    run_protocol(port, &mut probe, &mut procedure, stop)?;
    let report = probe.report().clone();
    let streams_at = report.baud.map(|baud| baud.rate());
    if report.has_replied() {
        return Ok(report);
    }
    let failure = no_reply(source, first, streams_at, report.bytes);
    let may_be_other = is_named && streams_at.is_none();
    let hint =
        if may_be_other { format!("{}; {}", other_scanner(source), failure.hint) } else { failure.hint };
    Err(Failure { hint, ..failure })
}

fn is_server(source: &PortSpec) -> bool {
    matches!(source, PortSpec::Tcp { .. })
}

/// Returns the failure for a scanner that did not reply to a probe, with possible reasons, after `bytes` bytes arrived.
/// The scanner may stream at `streams_at`. The highest rate of the port is `first`. Rates are in bits per second.
fn no_reply(source: &PortSpec, first: u32, streams_at: Option<u32>, bytes: u64) -> Failure {
    let name = source.name();
    let received_text = match bytes {
        0 => "no byte arrived".to_owned(),
        bytes => format!("{bytes} bytes arrived, without a telegram"),
    };
    let lower: Vec<_> =
        IdentityProbe::RATES.iter().filter(|&&rate| rate < first).map(u32::to_string).collect();
    let rates = format!("{} or {first} Bd", lower.join(", "));
    let (what, remedy) = match (streams_at, source) {
        (Some(_), PortSpec::Tcp { .. }) => (
            format!("{name}: a sensor streams but does not answer"),
            "it does not receive from the serial server: check the wire to its receiver",
        ),
        (Some(rate), _) => (
            format!("{name}: a sensor streams at {rate} Bd but does not answer"),
            "it does not receive from this port: check the wire to its receiver",
        ),
        (None, PortSpec::Tcp { .. }) => (
            format!("{name}: connected, but no answer; {received_text}"),
            "set the serial server to the sensor's rate, 8 bits, no parity; check power and cable; a server that has another \
             client already may let this one wait: end that program first",
        ),
        (None, _) if bytes == 0 => (
            format!("{name}: no reply at {rates}; {received_text}"),
            "check power, cable, jumper 7-8 for RS-422; after power-on a sensor takes up to a minute",
        ),
        (None, _) => (
            format!("{name}: no reply at {rates}; {received_text}"),
            "another device, a line that damages the bytes (ground, RS-232 instead of RS-422), or a missing wire?",
        ),
    };
    Failure::new(Kind::Timeout, what, remedy)
}

/// A link for the scanner at a port.
#[derive(Clone, Debug, PartialEq, Eq)]
struct SuggestedLink {
    /// The port, by a name that does not change.
    port: String,
    /// Keys and values besides name and port.
    settings: Vec<(&'static str, String)>,
}

impl SuggestedLink {
    /// Creates the link for a scanner at `source`, with the keys and values in `settings` besides name and port.
    pub(crate) fn new(
        source: &PortSpec,
        serial_ports: &[SerialPortInfo],
        settings: Vec<(&'static str, String)>,
    ) -> SuggestedLink {
        SuggestedLink { port: permanent_name(source, serial_ports), settings }
    }

    /// Returns the value of `--link`.
    fn flag(&self) -> String {
        let settings = self.settings.iter().map(|(key, value)| format!(",{key}={value}"));
        format!("{SENSOR_NAME}={}{}", self.port, settings.collect::<String>())
    }

    /// Returns the command that runs a hub for this scanner, as a shell takes it.
    fn command(&self) -> String {
        format!("scanhub run --link {}", scanhub_shm::shell_word(&self.flag()))
    }

    /// Returns the section of a configuration file, without the end of its last line.
    fn toml(&self) -> String {
        let mut text = format!("[[link]]\nname = \"{SENSOR_NAME}\"\nport = {}", toml_string(&self.port));
        for (key, value) in &self.settings {
            let is_number = value.parse::<u32>().is_ok();
            text += &format!("\n{key} = {}", if is_number { value.clone() } else { toml_string(value) });
        }
        text
    }
}

/// Returns the serial line of this machine that `source` names.
fn candidate_of<'a>(source: &PortSpec, serial_ports: &'a [SerialPortInfo]) -> Option<&'a SerialPortInfo> {
    let PortSpec::Tty(path) = source else { return None };
    let device = path.canonicalize().ok()?;
    serial_ports.iter().find(|candidate| candidate.device == device)
}

/// Returns the name by which a configuration should name `source`: the name that stays when other devices are plugged
/// in.
fn permanent_name(source: &PortSpec, serial_ports: &[SerialPortInfo]) -> String {
    let PortSpec::Tty(path) = source else { return source.name() };
    let path: PathBuf = std::path::absolute(path).unwrap_or_else(|_| path.clone());
    let name = match candidate_of(source, serial_ports) {
        // The user created a symlink in another directory, so keep its name.
        Some(candidate) if path == candidate.device || is_by_udev(&path) => &candidate.name,
        _ => &path,
    };
    name.display().to_string()
}

/// Returns whether udev's own rules created the name `path`.
fn is_by_udev(path: &Path) -> bool {
    path.parent().is_some_and(|parent| parent.ends_with("serial/by-id") || parent.ends_with("serial/by-path"))
}

/// Returns `text` as a string of TOML.
fn toml_string(text: &str) -> String {
    let mut string = String::from("\"");
    for c in text.chars() {
        match c {
            '"' | '\\' => string.extend(['\\', c]),
            c if c.is_control() => string += &format!("\\u{:04X}", u32::from(c)),
            c => string.push(c),
        }
    }
    string + "\""
}

/// Highest rate of a probe, in bits per second.
pub(crate) const HIGHEST_RATE: u32 = IdentityProbe::RATES[IdentityProbe::RATES.len() - 1];
/// Highest rate of a probe that every serial port supports, in bits per second.
const COMMON_RATE: u32 = IdentityProbe::RATES[IdentityProbe::RATES.len() - 2];
/// Name of the sensor in the suggested link; the user may choose another name.
const SENSOR_NAME: &str = "front";

#[cfg(test)]
mod tests {
    use scanhub_config::{Config, Link, Sources};
    use scanhub_drivers::lms::lms_model::LmsModel as Type;

    use super::*;

    #[test]
    fn failed_probe_lists_searched_rates_and_remedies() {
        let coverage = |rejected: &[u32]| {
            let port = search::PortKind::Serial;
            let mut coverage = search::Search::new(port, None, 0).coverage();
            for it in &mut coverage {
                (it.rejected, it.rates) = it.rates.iter().partition(|rate| rejected.contains(rate));
            }
            coverage
        };
        let failure = |source: &str, bytes, rejected: &[u32]| {
            let not_found = NotFound { bytes, coverage: coverage(rejected) };
            nothing_found(&PortSpec::parse(source).expect("a port"), false, &not_found)
        };
        let silent = failure("/dev/ttyUSB0", 0, &[]);
        let looked_for = "/dev/ttyUSB0: no scanner replies; no byte arrived; looked for lms at 9600, 19200, 38400 or 500000 \
                          Bd, ld at 230400 or 921600 Bd, rplidar at 115200, 256000, 460800 or 1000000 Bd";
        assert_eq!(silent.message, looked_for);
        for family in Family::ALL {
            assert!(silent.hint.contains(&format!("{}: ", family.name())), "{silent}");
        }
        assert!(silent.hint.contains("power and cable") && silent.hint.contains("jumper 7-8"), "{silent}");
        let noisy = failure("/dev/ttyUSB0", 7, &[]);
        assert!(noisy.message.contains("7 bytes arrived that scanhub does not recognize"), "{noisy}");
        let server = failure("tcp:box:4001", 0, &[]);
        assert!(server.hint.starts_with("set the serial server to the scanner's rate"), "{server}");
        // The port supports no rate of one family, and lacks one rate of another family.
        let slow = failure("/dev/ttyS0", 0, &[230_400, 921_600, 500_000]);
        let cannot =
            "; this port cannot have 230400 or 921600 Bd, so scanners of family ld cannot be found here";
        assert!(slow.message.ends_with(cannot) && !slow.message.contains("500000"), "{slow}");
        assert!(slow.hint.ends_with("; ld: use an adapter with a CP2102N, FT232R or newer"), "{slow}");
        // The link names its family.
        let mut only = coverage(&[230_400, 921_600]);
        only.retain(|it| it.family == Family::Ld);
        let not_found = NotFound { bytes: 0, coverage: only };
        let only = nothing_found(&PortSpec::Tty("/dev/ttyS0".into()), true, &not_found);
        assert!(only.hint.starts_with("is it another scanner? Try: scanhub probe /dev/ttyS0; "), "{only}");
        assert_eq!(only.message, format!("/dev/ttyS0: no scanner replies; no byte arrived{cannot}"));
    }

    #[test]
    fn names_only_rates_that_the_port_has() {
        let message = |first| no_reply(&PortSpec::Tty("/dev/ttyS0".into()), first, None, 0).message;
        assert!(message(HIGHEST_RATE).contains("38400 or 500000 Bd; no byte"));
        assert!(message(COMMON_RATE).contains("no reply at 9600, 19200 or 38400 Bd; no byte"));
    }

    fn link(port: &str, settings: &[(&'static str, &str)]) -> SuggestedLink {
        let settings = settings.iter().map(|(key, value)| (*key, (*value).to_owned())).collect();
        SuggestedLink { port: port.to_owned(), settings }
    }

    /// Returns the link as `run` loads it, from the flag and from the section.
    fn loaded(link: &SuggestedLink) -> Link {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(&file, link.toml()).unwrap();
        let load = |sources: Sources| Config::load(&sources).map(|config| config.links);
        let by_file = load(Sources { files: vec![file.path().to_owned()], ..Sources::default() });
        let by_flag = load(Sources { links: vec![link.flag()], ..Sources::default() });
        assert_eq!(by_file, by_flag, "{}", link.toml());
        let [loaded] = &by_flag.unwrap_or_else(|failure| panic!("{}: {failure}", link.flag()))[..] else {
            panic!("one link")
        };
        loaded.clone()
    }

    #[test]
    fn every_suggestion_is_a_valid_link() {
        for family in Family::ALL {
            let models = features(family).models;
            for model in models {
                let link = loaded(&link("/dev/x", &[("family", family.name()), ("model", model.name)]));
                assert_eq!((link.family(), link.scanner.model().name), (Some(family), model.name));
            }
            assert_eq!(loaded(&link("/dev/x", &[("family", family.name())])).family(), Some(family));
        }
        for kind in Type::ALL.into_iter().filter(|kind| kind.factory_variant().is_some()) {
            let suggested =
                link("tcp:[::1]:4001", &[("family", "lms"), ("type", kind.name()), ("baud", "38400")]);
            let link = loaded(&suggested);
            assert_eq!(
                (link.scanner.settings.expected_type, link.rate(), link.port.name()),
                (Some(kind.name()), 38_400, suggested.port)
            );
        }
        for port in ["/dev/serial/by-id/usb-a_b\\x20c#1,2-if00", "/dev/it's \"one\"", "/dev/a,b c"] {
            let suggested = link(port, &[("family", "ld")]);
            assert_eq!(loaded(&suggested).port.name(), port);
        }
    }

    #[test]
    fn command_is_quoted_where_a_shell_needs_it() {
        let plain = link("/dev/serial/by-path/pci-0000:00:14.0-usb-0:1:1.0-port0", &[("family", "ld")]);
        assert_eq!(plain.command(), format!("scanhub run --link {}", plain.flag()));
        let brackets = link("tcp:[::1]:4001", &[("family", "ld")]);
        assert_eq!(brackets.command(), "scanhub run --link 'front=tcp:[::1]:4001,family=ld'");
        assert_eq!(link("/dev/it's", &[]).command(), r"scanhub run --link 'front=/dev/it'\''s'");
    }

    #[test]
    fn name_that_changes_is_replaced() {
        let directory = tempfile::tempdir().unwrap();
        let root = directory.path().canonicalize().unwrap();
        let (by_id, by_path) = (root.join("serial/by-id/a"), root.join("serial/by-path/b"));
        for path in [&by_id, &by_path] {
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        }
        let device = root.join("ttyUSB0");
        std::fs::write(&device, "").unwrap();
        for link in [&by_id, &by_path, &root.join("lidar")] {
            std::os::unix::fs::symlink(&device, link).unwrap();
        }
        let mut candidates = [SerialPortInfo {
            name: by_id.clone(),
            device: device.clone(),
            shared_name: None,
            driver: None,
            product: None,
            holder: None,
            is_permitted: true,
        }];
        let name =
            |path: &Path, there: &[SerialPortInfo]| permanent_name(&PortSpec::Tty(path.to_owned()), there);
        assert_eq!(name(&device, &candidates), by_id.display().to_string());
        let own = root.join("lidar");
        assert_eq!(name(&own, &candidates), own.display().to_string(), "the user's own name stays");
        // Another adapter has the same serial number.
        (candidates[0].name, candidates[0].shared_name) = (by_path.clone(), Some(by_id.clone()));
        assert_eq!(name(&by_id, &candidates), by_path.display().to_string());
        assert_eq!(name(Path::new("/dev/no-such-port"), &candidates), "/dev/no-such-port");
    }
}
