//! `scanhub probe`: what is at the other end of a port. Opens it, lets the sensor tell of itself, and leaves it as it was.

mod description;

use std::sync::atomic::AtomicBool;

use lms::inquiry::{Inquiry, Report};
use lms::variant::Baud;
use schema::{Failure, Kind};

use crate::clock;
use crate::config::Source;
use crate::converse::converse;
use crate::port::{Candidate, Port, candidates};
pub use description::Description;

/// The serial lines of this machine.
///
/// [`Kind::PortMissing`] if there is none.
pub fn list() -> Result<Vec<Candidate>, Failure> {
    let found = candidates();
    if found.is_empty() {
        return Err(Failure::new(
            Kind::PortMissing,
            "no serial line on this machine",
            "plug in an adapter for RS-422 (500 kBd) or RS-232; `dmesg` shows whether the kernel saw it",
        ));
    }
    Ok(found)
}

/// Asks the sensor at `source` what it is. `look` is told the rate at which it is looked for, whenever that changes.
///
/// The port kinds if the port cannot be used, [`Kind::Timeout`] if nobody answers, [`Kind::Interrupted`] if `stop` is
/// set.
pub fn probe(source: &Source, stop: &AtomicBool, look: impl FnMut(u32)) -> Result<Description, Failure> {
    let (port, first) = open(source)?;
    let report = ask(&port, first, source, stop, look)?;
    Ok(Description::new(source.name(), &report))
}

/// The port that `text` names: a tty.
///
/// [`Kind::Configuration`] if it can be none.
pub fn source(text: &str) -> Result<Source, Failure> {
    Source::parse(text).map_err(|what| {
        Failure::new(Kind::Configuration, format!("{text}: {what}"), "name a tty; scanhub probe lists them")
    })
}

/// Opens `source` at the greatest rate that it can have.
pub(crate) fn open(source: &Source) -> Result<(Port, Baud), Failure> {
    let open = |baud: Baud| Port::open(source, baud.rate()).map(|port| (port, baud));
    open(Baud::B500000).or_else(|failure| match failure.kind {
        Kind::PortRate => open(Baud::B38400),
        _ => Err(failure),
    })
}

/// As [`inquire`], and [`Kind::Timeout`] if nobody answers.
pub(crate) fn ask(
    port: &Port,
    first: Baud,
    source: &Source,
    stop: &AtomicBool,
    look: impl FnMut(u32),
) -> Result<Report, Failure> {
    let report = inquire(port, first, stop, look)?;
    if report.answers() { Ok(report) } else { Err(silence(source, &report)) }
}

/// Asks the sensor at `port`, which is open at `first`.
pub(crate) fn inquire(
    port: &Port,
    first: Baud,
    stop: &AtomicBool,
    mut look: impl FnMut(u32),
) -> Result<Report, Failure> {
    let mut inquiry = Inquiry::new(first, clock::now());
    let mut shown = None;
    converse(port, &mut inquiry, stop, |inquiry| {
        if shown != Some(inquiry.baud()) {
            shown = Some(inquiry.baud());
            look(inquiry.baud().rate());
        }
    })?;
    Ok(inquiry.report().clone())
}

/// Why a sensor that did not answer may have been silent.
pub(crate) fn silence(source: &Source, report: &Report) -> Failure {
    let name = source.name();
    let (what, remedy) = match (report.baud, report.bytes) {
        (Some(baud), _) => (
            format!("{name}: a sensor streams at {} Bd and answers nothing", baud.rate()),
            "it does not hear this port: look at the wire that goes to it",
        ),
        (None, 0) => (
            format!("{name}: no answer at 9600, 19200, 38400 or 500000 Bd, and not a byte"),
            "power, cable, jumper 7-8 for RS-422? after power-on a sensor takes up to a minute",
        ),
        (None, bytes) => (
            format!(
                "{name}: no answer at 9600, 19200, 38400 or 500000 Bd; {bytes} bytes came, no telegram in them"
            ),
            "another device, RS-232 against RS-422, or a wire too few?",
        ),
    };
    Failure::new(Kind::Timeout, what, remedy)
}
