//! `scanhub probe`: finds the scanner at a port, whatever its family, by the search of the hub, and then requests what
//! it reports of itself. Changes no settings. `SuggestedLink` is the link that a configuration needs for the scanner, as
//! a command for the shell and as a section of a file.

mod description;

use std::fmt;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use clap::Args;
use scanhub_drivers::search::{self, Coverage};
use scanhub_drivers::{Inquiry, Report, features, inquiry};
use scanhub_port::{
    Candidate, Port, PortError, PortlessAdapter, Source, all_holders, candidates, check_tty, clock, found_in,
};
use scanhub_schema::{Failure, Family, Kind};
use scanhub_shm::Domain;
use serde::Serialize;

use crate::doctor::Hub;
use crate::driver::{self, DetectedScanner, NotFound, Procedure, detect, drive, not_detected};
use crate::terminal::{Progress, print};
use description::link_settings;
use description::{Description, Found, Turning};
pub(crate) use description::{hex, measuring};

/// Show the sensor at a port; without a port, list the ports
#[derive(Args, Debug)]
#[command(after_help = EXAMPLES)]
pub struct ProbeArgs {
    /// Port to look at: a tty or tcp:HOST:PORT; without one, the ports of this machine are listed
    #[arg(value_name = "PORT")]
    port: Option<String>,
    /// Print only the link for a configuration file
    #[arg(long, requires = "port", conflicts_with = "json")]
    toml: bool,
}

const EXAMPLES: &str = "\
Examples:
  scanhub probe
  scanhub probe /dev/ttyUSB0
  scanhub probe /dev/ttyUSB0 --toml >> scanhub.toml";

impl ProbeArgs {
    /// Prints the scanner at the port, or the ports of this machine without opening any. `places` returns the locations in
    /// which a client would search for the domain of a hub.
    ///
    /// # Errors
    ///
    /// Returns the kinds of a port that cannot be used, including [`Kind::PortBusy`] if another process has it open. Returns
    /// [`Kind::PortMissing`] if there is no port to list, [`Kind::Timeout`] if no scanner replies, and [`Kind::Interrupted`]
    /// if `stop` is set.
    pub fn run(
        &self,
        json: bool,
        places: impl FnOnce() -> Result<Vec<Domain>, Failure>,
        out: &mut dyn Write,
        stop: &AtomicBool,
    ) -> Result<(), Failure> {
        let Some(port) = &self.port else { return list_ports(json, out) };
        let places = places()?;
        let mut progress = Progress::on_stderr();
        let found =
            probe(&source(port)?, &places, stop, |rate| progress.show(&format!("looking at {rate} Bd")));
        if found.is_err() {
            progress.leave();
        }
        drop(progress);
        let found = found?;
        print(out, json, &found, || match self.toml {
            true => found.link.toml(),
            false => format!("{port}\n{found}"),
        })
    }
}

/// Prints the serial lines of this machine, and the adapters that have none.
fn list_ports(json: bool, out: &mut dyn Write) -> Result<(), Failure> {
    const PLUG_IN: &str =
        "plug in an adapter for RS-422 (500 kBd) or RS-232; `dmesg` shows whether the kernel saw it";
    let (candidates, portless) = (candidates(), PortlessAdapter::all(Path::new("/")));
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
    /// The process that has it open.
    holder: Option<u32>,
    program: Option<&'a str>,
    /// The name below by-id that another adapter has too.
    shared_name: Option<String>,
    caution: Option<String>,
    remedy: Option<String>,
}

impl<'a> CandidateLine<'a> {
    fn of(candidate: &'a Candidate) -> CandidateLine<'a> {
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

/// Returns the caution about a port, including one about the name that it shares.
fn caution(candidate: &Candidate) -> Option<(String, String)> {
    candidate.caution(candidate.shared_name.as_ref().unwrap_or(&candidate.name))
}

fn describe(candidate: &Candidate) -> String {
    let Candidate { name, device, driver, product, holder, is_permitted, .. } = candidate;
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
struct Probed {
    #[serde(flatten)]
    found: Found,
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

impl Probed {
    fn new(found: Found, link: SuggestedLink, caution: Option<(String, String)>) -> Probed {
        Probed { found, flag: link.flag(), link, caution }
    }
}

impl fmt::Display for Probed {
    /// Writes the rows, and then the next command.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.found)?;
        if let Some((what, remedy)) = &self.caution {
            writeln!(f, "  {:<16}{what}; {remedy}", "port")?;
        }
        write!(f, "next: {}", self.link.command())
    }
}

/// Finds the scanner at `source`. Until its family is known, it gets only the requests of the search. Calls `look` with
/// each rate at which it searches.
fn probe(
    source: &Source,
    places: &[Domain],
    stop: &AtomicBool,
    look: impl FnMut(u32),
) -> Result<Probed, Failure> {
    check_unused(source, places)?;
    let (port, first) = open(source, stop)?;
    let there = found_in(Path::new("/"));
    let caution = candidate_of(source, &there).and_then(|port| port.caution(Path::new(&source.name())));
    let answer = find(&port, first, source, None, stop, look).map_err(|failure| match &caution {
        Some((what, remedy)) if failure.kind == Kind::Timeout => {
            Failure { hint: format!("it is {what}; {remedy}; or {}", failure.hint), ..failure }
        }
        _ => failure,
    })?;
    Ok(match answer {
        Answer::Asked(report) => {
            // The rate of a serial server is set there.
            let rate = if is_server(source) { report.baud.map(|baud| baud.rate()) } else { None };
            let settings = link_settings(&report, rate.unwrap_or(first));
            let found = Found::Asked(Box::new(Description::new(source.name(), &report)));
            Probed::new(found, SuggestedLink::new(source, &there, settings), caution)
        }
        Answer::Detected(heard) => {
            let found = Found::Turning(Box::new(Turning::new(source.name(), &heard)));
            let family = ("family", heard.family.name().to_owned());
            let model = heard.model.map(|model| ("model", model.name.to_owned()));
            let settings = std::iter::once(family).chain(model).collect();
            Probed::new(found, SuggestedLink::new(source, &there, settings), caution)
        }
    })
}

/// The scanner that was found.
pub(crate) enum Answer {
    /// A scanner that reports its settings on request, with its replies.
    Asked(Box<Report>),
    /// A rotating scanner.
    Detected(Box<DetectedScanner>),
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
    source: &Source,
    only: Option<Family>,
    stop: &AtomicBool,
    mut look: impl FnMut(u32),
) -> Result<Answer, Failure> {
    // An inquiry finds the rate, too.
    let known = only.filter(|&family| features(family).has_inquiry);
    let found = match known {
        Some(family) => search::Found { family, model: None, rate: None },
        None => driver::search(port, only, stop, &mut look)?
            .map_err(|not_found| nothing_found(source, only.is_some(), &not_found))?,
    };
    let rate = (!is_server(source)).then_some(found.rate.unwrap_or(first));
    if let Some(inquiry) = inquiry(found.family, rate, clock::now()) {
        let report = request_report(port, first, inquiry, (source, only.is_some()), stop, look)?;
        return Ok(Answer::Asked(Box::new(report)));
    }
    let detected = detect(port, found, stop)?;
    let heard = detected.map_err(|bytes| not_detected(&source.name(), found, bytes))?;
    Ok(Answer::Detected(Box::new(heard)))
}

/// Returns the failure for a port at which a search has found no scanner. The message lists the families and rates of the
/// search, and the hint what to check at a scanner of each family. If a family was named, the scanner may belong to another one.
fn nothing_found(source: &Source, is_named: bool, NotFound { bytes, coverage }: &NotFound) -> Failure {
    let (possible, impossible): (Vec<_>, Vec<_>) = coverage.iter().partition(|it| !it.rates.is_empty());
    let at_rates = |it: &&Coverage| format!("{} at {} Bd", it.family.name(), listed(&it.rates));
    let looked_for: Vec<String> = possible.iter().map(at_rates).collect();
    let arrived = match bytes {
        0 => "no byte arrived".to_owned(),
        bytes => format!("{bytes} bytes arrived that scanhub does not recognize"),
    };
    let mut message = format!("{}: no scanner replies; {arrived}", source.name());
    if !looked_for.is_empty() {
        message += &format!("; looked for {}", looked_for.join(", "));
    }
    let mut remedies = vec![match (source, bytes) {
        (Source::Tcp { .. }, _) => {
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
        let (family, rates) = (it.family.name(), listed(&it.rejected));
        message += &format!(
            "; this port cannot have {rates} Bd, so scanners of family {family} cannot be found here"
        );
        remedies.push(format!("{family}: use an adapter with a CP2102N, FT232R or newer"));
    }
    Failure::new(Kind::Timeout, message, remedies.join("; "))
}

/// Returns the remedy for a port at which no scanner of the named family replies.
fn other_scanner(source: &Source) -> String {
    format!("is it another scanner? Try: scanhub probe {}", scanhub_shm::shell_word(&source.name()))
}

/// Lists `rates`, as in "9600, 19200 or 38400".
fn listed(rates: &[u32]) -> String {
    let mut words: Vec<String> = rates.iter().map(u32::to_string).collect();
    let last = words.pop().unwrap_or_default();
    if words.is_empty() { last } else { format!("{} or {last}", words.join(", ")) }
}

/// Parses the name of a port: a tty, or `tcp:HOST:PORT`.
///
/// # Errors
///
/// Returns [`Kind::Configuration`] if `text` does not name a port.
pub(crate) fn source(text: &str) -> Result<Source, Failure> {
    Source::parse(text).map_err(|what| {
        Failure::new(
            Kind::Configuration,
            format!("{text}: {what}"),
            "name a tty (scanhub probe lists them), or tcp:HOST:PORT",
        )
    })
}

/// Checks that no other process has `source` open, whether or not it has locked it: each of the two would get only a
/// part of the bytes. `places` are the locations in which a client would search for the domain of a hub.
///
/// # Errors
///
/// Returns [`Kind::PortBusy`] with the process. If it is a hub, the failure states what the hub reports about its link.
pub(crate) fn check_unused(source: &Source, places: &[Domain]) -> Result<(), Failure> {
    let holders = match source {
        // Many processes have a device such as /dev/null open. The failure to open it is the reason.
        Source::Tty(path) if check_tty(path).is_err() => return Ok(()),
        Source::Tty(path) => all_holders(path),
        // Another process may be connected to the server from anywhere. Only a hub of this machine reports it.
        Source::Tcp { .. } | Source::File { .. } => Vec::new(),
    };
    match Hub::at(source, &holders, places) {
        Some(hub) => Err(hub.refuse(source, &holders)),
        None if holders.is_empty() => Ok(()),
        None => Err(PortError::Busy.explain(source)),
    }
}

/// Opens `source` at the highest rate of an inquiry that it supports, in bits per second, unless `stop` is set before it is open.
pub(crate) fn open(source: &Source, stop: &AtomicBool) -> Result<(Port, u32), Failure> {
    let open = |rate: u32| Port::open(source, rate, stop).map(|port| (port, rate));
    let (port, rate) = open(HIGHEST_RATE).or_else(|failure| match failure.kind {
        Kind::PortRate => open(RATE_OF_EVERY_PORT),
        _ => Err(failure),
    })?;
    // Bytes in the input buffer may be older than the scanner's last power-on. Setting the rate discards them.
    let _ = port.set_baud(rate);
    Ok((port, rate))
}

/// Requests identity, settings and state of the scanner at `port` by `inquiry`. The highest rate of the port is `first`, in
/// bits per second. If the family was named, the scanner may belong to another one.
///
/// # Errors
///
/// Returns [`Kind::Timeout`] if no scanner replies; the other kinds are those of [`probe`].
pub(crate) fn request_report(
    port: &Port,
    first: u32,
    mut inquiry: Inquiry,
    (source, is_named): (&Source, bool),
    stop: &AtomicBool,
    mut look: impl FnMut(u32),
) -> Result<Report, Failure> {
    let mut shown = None;
    let mut procedure = Procedure::new(|inquiry: &Inquiry| {
        if shown != Some(inquiry.baud()) && !is_server(source) {
            shown = Some(inquiry.baud());
            look(inquiry.baud().rate());
        }
        true
    });
    drive(port, &mut inquiry, &mut procedure, stop)?;
    let report = inquiry.report().clone();
    let streams_at = report.baud.map(|baud| baud.rate());
    if report.answers() {
        return Ok(report);
    }
    let failure = silence(source, first, streams_at, report.bytes);
    let may_be_other = is_named && streams_at.is_none();
    let hint =
        if may_be_other { format!("{}; {}", other_scanner(source), failure.hint) } else { failure.hint };
    Err(Failure { hint, ..failure })
}

fn is_server(source: &Source) -> bool {
    matches!(source, Source::Tcp { .. })
}

/// Returns the failure for a scanner that did not reply to an inquiry, with possible reasons, after `bytes` bytes arrived.
/// It may stream at `streams_at`. The highest rate of the port is `first`. Rates are in bits per second.
fn silence(source: &Source, first: u32, streams_at: Option<u32>, bytes: u64) -> Failure {
    let name = source.name();
    let came = match bytes {
        0 => "no byte arrived".to_owned(),
        bytes => format!("{bytes} bytes arrived, without a telegram"),
    };
    let lower: Vec<_> = Inquiry::RATES.iter().filter(|&&rate| rate < first).map(u32::to_string).collect();
    let rates = format!("{} or {first} Bd", lower.join(", "));
    let (what, remedy) = match (streams_at, source) {
        (Some(_), Source::Tcp { .. }) => (
            format!("{name}: a sensor streams but does not answer"),
            "it does not receive from the serial server: check the wire to its receiver",
        ),
        (Some(rate), _) => (
            format!("{name}: a sensor streams at {rate} Bd but does not answer"),
            "it does not receive from this port: check the wire to its receiver",
        ),
        (None, Source::Tcp { .. }) => (
            format!("{name}: connected, but no answer; {came}"),
            "set the serial server to the sensor's rate, 8 bits, no parity; check power and cable; a server that has another \
             client already may let this one wait: end that program first",
        ),
        (None, _) if bytes == 0 => (
            format!("{name}: no answer at {rates}; {came}"),
            "check power, cable, jumper 7-8 for RS-422; after power-on a sensor takes up to a minute",
        ),
        (None, _) => (
            format!("{name}: no answer at {rates}; {came}"),
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
    /// Creates the link for a scanner at `source`, with keys and values besides name and port.
    pub(crate) fn new(
        source: &Source,
        there: &[Candidate],
        settings: Vec<(&'static str, String)>,
    ) -> SuggestedLink {
        SuggestedLink { port: permanent_name(source, there), settings }
    }

    /// Returns the value of `--link`.
    fn flag(&self) -> String {
        let settings = self.settings.iter().map(|(key, value)| format!(",{key}={value}"));
        format!("{NAME}={}{}", self.port, settings.collect::<String>())
    }

    /// Returns the command that runs a hub for this scanner, as a shell takes it.
    fn command(&self) -> String {
        format!("scanhub run --link {}", scanhub_shm::shell_word(&self.flag()))
    }

    /// Returns the section of a configuration file, without the end of its last line.
    fn toml(&self) -> String {
        let mut text = format!("[[link]]\nname = \"{NAME}\"\nport = {}", toml_string(&self.port));
        for (key, value) in &self.settings {
            let is_number = value.parse::<u32>().is_ok();
            text += &format!("\n{key} = {}", if is_number { value.clone() } else { toml_string(value) });
        }
        text
    }
}

/// Returns the serial line of this machine that `source` names.
fn candidate_of<'a>(source: &Source, there: &'a [Candidate]) -> Option<&'a Candidate> {
    let Source::Tty(path) = source else { return None };
    let device = path.canonicalize().ok()?;
    there.iter().find(|candidate| candidate.device == device)
}

/// Returns the name by which a configuration should name `source`: the one that stays, whatever is plugged in next.
fn permanent_name(source: &Source, there: &[Candidate]) -> String {
    let Source::Tty(path) = source else { return source.name() };
    let path: PathBuf = std::path::absolute(path).unwrap_or_else(|_| path.clone());
    let name = match candidate_of(source, there) {
        // A link elsewhere was made by the user, who knows what it stands for.
        Some(candidate) if path == candidate.device || is_by_udev(&path) => &candidate.name,
        _ => &path,
    };
    name.display().to_string()
}

/// Returns whether udev's own rules made the name.
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

/// Highest rate of an inquiry, in bits per second.
pub(crate) const HIGHEST_RATE: u32 = Inquiry::RATES[Inquiry::RATES.len() - 1];
/// Highest rate of an inquiry that every serial port supports, in bits per second.
const RATE_OF_EVERY_PORT: u32 = Inquiry::RATES[Inquiry::RATES.len() - 2];
/// Name of the sensor; the user may choose another one.
const NAME: &str = "front";

#[cfg(test)]
mod tests {
    use scanhub_config::{Config, Link, Sources};
    use scanhub_drivers::lms::family::Family as Type;

    use super::*;

    #[test]
    fn a_search_without_result_states_what_it_looked_for_and_what_to_check() {
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
            nothing_found(&Source::parse(source).expect("a port"), false, &not_found)
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
        // A port that has no rate of one family, and lacks one rate of another.
        let slow = failure("/dev/ttyS0", 0, &[230_400, 921_600, 500_000]);
        let cannot =
            "; this port cannot have 230400 or 921600 Bd, so scanners of family ld cannot be found here";
        assert!(slow.message.ends_with(cannot) && !slow.message.contains("500000"), "{slow}");
        assert!(slow.hint.ends_with("; ld: use an adapter with a CP2102N, FT232R or newer"), "{slow}");
        // A link that names its family.
        let mut only = coverage(&[230_400, 921_600]);
        only.retain(|it| it.family == Family::Ld);
        let not_found = NotFound { bytes: 0, coverage: only };
        let only = nothing_found(&Source::Tty("/dev/ttyS0".into()), true, &not_found);
        assert!(only.hint.starts_with("is it another scanner? Try: scanhub probe /dev/ttyS0; "), "{only}");
        assert_eq!(only.message, format!("/dev/ttyS0: no scanner replies; no byte arrived{cannot}"));
    }

    #[test]
    fn names_only_rates_that_the_port_has() {
        let message = |first| silence(&Source::Tty("/dev/ttyS0".into()), first, None, 0).message;
        assert!(message(HIGHEST_RATE).contains("38400 or 500000 Bd; no byte"));
        assert!(message(RATE_OF_EVERY_PORT).contains("no answer at 9600, 19200 or 38400 Bd; no byte"));
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
    fn a_command_is_quoted_where_a_shell_needs_it() {
        let plain = link("/dev/serial/by-path/pci-0000:00:14.0-usb-0:1:1.0-port0", &[("family", "ld")]);
        assert_eq!(plain.command(), format!("scanhub run --link {}", plain.flag()));
        let brackets = link("tcp:[::1]:4001", &[("family", "ld")]);
        assert_eq!(brackets.command(), "scanhub run --link 'front=tcp:[::1]:4001,family=ld'");
        assert_eq!(link("/dev/it's", &[]).command(), r"scanhub run --link 'front=/dev/it'\''s'");
    }

    #[test]
    fn a_name_that_changes_is_replaced() {
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
        let mut there = [Candidate {
            name: by_id.clone(),
            device: device.clone(),
            shared_name: None,
            driver: None,
            product: None,
            holder: None,
            is_permitted: true,
        }];
        let name = |path: &Path, there: &[Candidate]| permanent_name(&Source::Tty(path.to_owned()), there);
        assert_eq!(name(&device, &there), by_id.display().to_string());
        let own = root.join("lidar");
        assert_eq!(name(&own, &there), own.display().to_string(), "the user's own name stays");
        // Another adapter has the same serial number.
        (there[0].name, there[0].shared_name) = (by_path.clone(), Some(by_id.clone()));
        assert_eq!(name(&by_id, &there), by_path.display().to_string());
        assert_eq!(name(Path::new("/dev/no-such-port"), &there), "/dev/no-such-port");
    }
}
