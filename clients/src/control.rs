//! `scanhub control`: asks the hub to stop a sensor, to let it stream again, or to begin anew with it. Done is what the
//! link has taken; `info` tells how far it is.

use std::io::Write;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::sleep;
use std::time::{Duration, Instant};

use schema::ipc::{self, ControlClient, Node};
use schema::{Domain, Failure, Kind, Request, Shown, Verb, check_sensor, holder};

use crate::json;
use crate::names::as_word;
use crate::output::{Output, quiet};
use crate::presence::{GRACE, find};

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
/// [`Kind::NoHub`] within a second if there is none, or if it ends before it answers; [`Kind::NoTopic`] with the sensors
/// that there are; [`Kind::Short`] if too much is asked at a time; [`Kind::Failed`] if the link cannot do it;
/// [`Kind::Timeout`] if the hub does not answer: it is short of something, or the link is busy;
/// [`Kind::Interrupted`] if `stop` is set.
pub fn control(options: &ControlOptions, out: &mut dyn Write, stop: &AtomicBool) -> Result<(), Failure> {
    let ControlOptions { sensor, verb, .. } = options;
    as_word(check_sensor(sensor))?;
    request(&options.places, &Request::new(sensor, *verb), stop)?;
    let mut output = Output::new(out);
    quiet(if options.json {
        output.json(&json::control(sensor, *verb))
    } else {
        output.line(|line| write!(line, "{sensor}: {} taken", verb.name()))
    })
}

/// Asks the hub at the first live one of `places` for `request`, and answers what it answered. Failures as [`control`].
pub(crate) fn request(
    places: &[Domain],
    request: &Request,
    stop: &AtomicBool,
) -> Result<Option<Shown>, Failure> {
    let domain = find(places)?;
    let node = ipc::client_node(&domain)?;
    ask(&open(&node)?, &domain, request, stop)
}

/// The control service; that of a hub that is just starting is waited for.
fn open(node: &Node) -> Result<ControlClient, Failure> {
    let give_up_at = Instant::now() + GRACE;
    loop {
        if let Some(client) = ControlClient::open(node)? {
            return Ok(client);
        }
        if Instant::now() >= give_up_at {
            return Err(Failure::new(Kind::NoHub, "the hub takes no requests", "it may be an older one"));
        }
        sleep(ASK_AGAIN);
    }
}

fn ask(
    client: &ControlClient,
    domain: &Domain,
    request: &Request,
    stop: &AtomicBool,
) -> Result<Option<Shown>, Failure> {
    let pending = client.ask(request)?;
    let give_up_at = Instant::now() + PATIENCE;
    loop {
        ipc::take_wakeups(&[client.responses()])?;
        // In this order: what was answered before the hub went is an answer.
        let lives = pending.is_open() && holder(domain.root())?.is_some();
        if let Some(response) = pending.response()? {
            return response.0;
        }
        if !lives {
            let hint = "whether it was done is not known: `scanhub info` tells how the sensor is";
            return Err(Failure::new(Kind::NoHub, "the hub went away before it answered", hint));
        }
        if stop.load(Ordering::Relaxed) {
            return Err(Failure::new(Kind::Interrupted, "interrupted before the hub answered", ""));
        }
        if Instant::now() >= give_up_at {
            let message =
                format!("the hub did not answer for {} in {} s", request.sensor(), PATIENCE.as_secs());
            let hint = format!(
                "its log tells if it is short of something; `scanhub info {}` how it is",
                request.sensor()
            );
            return Err(Failure::new(Kind::Timeout, message, hint));
        }
        ipc::sleep(&[client.responses()], LOOK_EVERY)?;
    }
}

/// A link takes a request within milliseconds; one that opens its port may need longer.
const PATIENCE: Duration = Duration::from_secs(5);
/// How often the hub's life and the wish to stop are looked at.
const LOOK_EVERY: Duration = Duration::from_millis(100);
/// How often a service that is not there is asked for.
const ASK_AGAIN: Duration = Duration::from_millis(10);
