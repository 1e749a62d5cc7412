//! `scanhub control`: asks the hub to pause a sensor, to resume its stream, or to restart the session with it. It ends
//! when the link has accepted the request; `info` shows the progress.

use std::io::Write;
use std::sync::atomic::AtomicBool;

use scanhub_client::request;
use scanhub_schema::{Failure, Request, Verb, check_sensor};
use scanhub_shm::Domain;

use crate::json;
use crate::names::as_word;
use crate::output::{Output, quiet};

/// What `control` is asked for.
#[derive(Clone, Debug)]
pub struct ControlOptions {
    /// The sensor.
    pub sensor: String,
    /// What its link shall do.
    pub verb: Verb,
    /// An object instead of text.
    pub json: bool,
    /// Where the domain may be, see [`Domain::candidates`].
    pub places: Vec<Domain>,
}

/// Sends the request, waits until the link has taken it, and writes a line to `out`.
///
/// Failures as [`request`].
pub fn control(options: &ControlOptions, out: &mut dyn Write, stop: &AtomicBool) -> Result<(), Failure> {
    let ControlOptions { sensor, verb, .. } = options;
    as_word(check_sensor(sensor))?;
    request(&options.places, &Request::new(sensor, *verb), stop)?;
    let mut output = Output::new(out);
    quiet(if options.json {
        output.json(&json::control(sensor, *verb))
    } else {
        output.line(|line| write!(line, "{sensor}: {}", done(*verb)))
    })
}

/// Returns the past form of `verb`, for the line that confirms an accepted request.
pub(crate) fn done(verb: Verb) -> &'static str {
    match verb {
        Verb::Pause => "paused",
        Verb::Resume => "resumed",
        Verb::Resync => "session restarted",
        Verb::Show => "background shown",
        Verb::Reset => "background reset",
        Verb::Freeze => "background frozen",
        Verb::Thaw => "background learning resumed",
        Verb::Load => "background loaded",
    }
}
