//! `scanhub probe`: finds the scanner at a port, whatever its family. Opens the port, listens for scanners that stream
//! without a request, and then sends requests. Changes no settings.

mod description;
mod suggestion;

use std::fmt;
use std::path::Path;
use std::sync::atomic::AtomicBool;

use port::{Candidate, Port, PortlessAdapter, Source, candidates, clock, found_in};
use scanhub_drivers::lms::inquiry::{Inquiry, Report};
use scanhub_drivers::lms::variant::Baud;
use schema::{Failure, Family, Kind};
use serde::Serialize;

use crate::driver::{DetectedScanner, Procedure, detect, drive, not_detected, turning};
pub use description::{Description, Found, Turning};
pub(crate) use description::{hex, measuring};
pub use suggestion::SuggestedLink;
use suggestion::candidate_of;

/// Scanner at a port, with the link that a configuration needs for it; class `probe`.
#[derive(Clone, Debug, Serialize)]
pub struct Probed {
    #[serde(flatten)]
    found: Found,
    /// Value of `--link`.
    #[serde(rename = "link")]
    flag: String,
    /// Link for a configuration.
    #[serde(skip)]
    pub link: SuggestedLink,
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

/// The ports of this machine, and the adapters that have none.
#[derive(Clone, Debug)]
pub struct Ports {
    /// The serial lines.
    pub candidates: Vec<Candidate>,
    /// USB serial adapters without a port.
    pub portless: Vec<PortlessAdapter>,
}

impl Ports {
    /// Lists the ports of this machine, without opening any.
    pub fn of_machine() -> Ports {
        Ports { candidates: candidates(), portless: PortlessAdapter::all(Path::new("/")) }
    }

    /// Checks that there is a serial line.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::PortMissing`] if there is none.
    pub fn check(&self) -> Result<(), Failure> {
        const PLUG_IN: &str =
            "plug in an adapter for RS-422 (500 kBd) or RS-232; `dmesg` shows whether the kernel saw it";
        if !self.candidates.is_empty() {
            return Ok(());
        }
        let remedy = self.portless.first().map_or(PLUG_IN.to_owned(), PortlessAdapter::remedy);
        Err(Failure::new(Kind::PortMissing, "no serial line on this machine", remedy))
    }
}

/// Finds the scanner at `source`. Listens for scanners that stream without a request before it sends one. Calls `look`
/// with each rate at which it searches.
///
/// # Errors
///
/// Returns the kinds of a port that cannot be used, [`Kind::Timeout`] if no scanner replies, and [`Kind::Interrupted`]
/// if `stop` is set.
pub fn probe(source: &Source, stop: &AtomicBool, look: impl FnMut(u32)) -> Result<Probed, Failure> {
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
            let found = Found::Lms(Box::new(Description::new(source.name(), &report)));
            Probed::new(found, SuggestedLink::for_lms(source, &there, &report, first), caution)
        }
        Answer::Detected(heard) => {
            let found = Found::Turning(Box::new(Turning::new(source.name(), &heard)));
            Probed::new(found, SuggestedLink::for_turning(source, &there, &heard), caution)
        }
    })
}

/// The scanner that was found.
pub(crate) enum Answer {
    /// An LMS, with its replies to the requests.
    Asked(Box<Report>),
    /// A rotating scanner.
    Detected(Box<DetectedScanner>),
}

/// Finds the scanner at `port`, which is open at `first`. The scanner may be of any family, or of `only` one. Listens
/// for scanners that stream without a request before it sends one.
///
/// # Errors
///
/// Returns [`Kind::Timeout`] if no scanner replies; the other kinds are those of [`probe`].
pub(crate) fn find(
    port: &Port,
    first: Baud,
    source: &Source,
    only: Option<Family>,
    stop: &AtomicBool,
    mut look: impl FnMut(u32),
) -> Result<Answer, Failure> {
    let mut missed = Vec::new();
    for (family, features) in
        turning().into_iter().filter(|(family, _)| only.is_none_or(|only| only == *family))
    {
        match detect(port, (family, features), stop, &mut look)? {
            Ok(heard) => return Ok(Answer::Detected(Box::new(heard))),
            Err(bytes) if only.is_some() => {
                return Err(not_detected(&source.name(), family, features, bytes));
            }
            Err(_) => missed.push(family.name()),
        }
    }
    let _ = port.set_baud(first.rate());
    match request_report(port, first, source, stop, look) {
        Ok(report) => Ok(Answer::Asked(Box::new(report))),
        Err(failure) if failure.kind == Kind::Timeout && !missed.is_empty() => {
            let message = format!("{}; no sensor of family {} either", failure.message, missed.join(", "));
            Err(Failure { message, ..failure })
        }
        Err(failure) => Err(failure),
    }
}

/// Parses the name of a port: a tty, or `tcp:HOST:PORT`.
///
/// # Errors
///
/// Returns [`Kind::Configuration`] if `text` does not name a port.
pub fn source(text: &str) -> Result<Source, Failure> {
    Source::parse(text).map_err(|what| {
        Failure::new(
            Kind::Configuration,
            format!("{text}: {what}"),
            "name a tty (scanhub probe lists them), or tcp:HOST:PORT",
        )
    })
}

/// Opens `source` at the highest rate that it supports, unless `stop` is set before it is open.
pub(crate) fn open(source: &Source, stop: &AtomicBool) -> Result<(Port, Baud), Failure> {
    let open = |baud: Baud| Port::open(source, baud.rate(), stop).map(|port| (port, baud));
    let (port, baud) = open(Baud::B500000).or_else(|failure| match failure.kind {
        Kind::PortRate => open(Baud::B38400),
        _ => Err(failure),
    })?;
    // Bytes in the input buffer may be older than the scanner's last power-on. Setting the rate discards them.
    let _ = port.set_baud(baud.rate());
    Ok((port, baud))
}

/// Requests identity, settings and state of the LMS at `port`, which is open at `first`.
///
/// # Errors
///
/// Returns [`Kind::Timeout`] if no scanner replies; the other kinds are those of [`probe`].
pub(crate) fn request_report(
    port: &Port,
    first: Baud,
    source: &Source,
    stop: &AtomicBool,
    mut look: impl FnMut(u32),
) -> Result<Report, Failure> {
    let is_server = matches!(source, Source::Tcp { .. });
    // The scanner reports the rate of a serial server later. The slowest rate waits long enough for any.
    let now = clock::now();
    let mut inquiry = if is_server { Inquiry::at(Baud::B9600, now) } else { Inquiry::new(first, now) };
    let mut shown = None;
    let mut procedure = Procedure::new(|inquiry: &Inquiry| {
        if shown != Some(inquiry.baud()) && !is_server {
            shown = Some(inquiry.baud());
            look(inquiry.baud().rate());
        }
    });
    drive(port, &mut inquiry, &mut procedure, stop)?;
    let mut report = inquiry.report().clone();
    if is_server {
        report.baud = report.status().and_then(|status| status.baud()).or(report.baud);
    }
    if report.answers() { Ok(report) } else { Err(silence(source, first, &report)) }
}

/// Returns the failure for a scanner that did not reply, with possible reasons. The highest rate of the port is
/// `first`.
fn silence(source: &Source, first: Baud, report: &Report) -> Failure {
    let name = source.name();
    let came = match report.bytes {
        0 => "no byte arrived".to_owned(),
        bytes => format!("{bytes} bytes arrived, without a telegram"),
    };
    let rates = match first {
        Baud::B500000 => "9600, 19200, 38400 or 500000 Bd",
        _ => "9600, 19200 or 38400 Bd",
    };
    let (what, remedy) = match (report.baud, source) {
        (Some(_), Source::Tcp { .. }) => (
            format!("{name}: a sensor streams but does not answer"),
            "it does not receive from the serial server: check the wire to its receiver",
        ),
        (Some(baud), _) => (
            format!("{name}: a sensor streams at {} Bd but does not answer", baud.rate()),
            "it does not receive from this port: check the wire to its receiver",
        ),
        (None, Source::Tcp { .. }) => (
            format!("{name}: connected, but no answer; {came}"),
            "set the serial server to the sensor's rate, 8 bits, no parity; check power and cable; a server that has another \
             client already may let this one wait: end that program first",
        ),
        (None, _) if report.bytes == 0 => (
            format!("{name}: no answer at {rates}; {came}"),
            "check power, cable, jumper 7-8 for RS-422; after power-on a sensor takes up to a minute",
        ),
        (None, _) => (
            format!("{name}: no answer at {rates}; {came}"),
            "another device, RS-232 instead of RS-422, or a missing wire?",
        ),
    };
    Failure::new(Kind::Timeout, what, remedy)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_only_rates_that_the_port_has() {
        let report = Inquiry::new(Baud::B38400, 0).report().clone();
        let message = |first| silence(&Source::Tty("/dev/ttyS0".into()), first, &report).message;
        assert!(message(Baud::B500000).contains("38400 or 500000 Bd; no byte"));
        assert!(message(Baud::B38400).contains("no answer at 9600, 19200 or 38400 Bd; no byte"));
    }
}
