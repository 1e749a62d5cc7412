//! A request to the hub: sends it, and waits until the link has accepted it.

use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::sleep;
use std::time::{Duration, Instant};

use scanhub_schema::{Kind, Request, ResponseModel};
use scanhub_shm::{ControlClient, Node};
use scanhub_shm::{Domain, hub_pid};

use crate::error::Error;
use crate::hub_finder::{STARTUP_GRACE, find};

/// Sends `request` to the hub at the first of `places` where one runs, and returns its answer.
///
/// # Examples
///
/// ```no_run
/// use std::sync::atomic::AtomicBool;
///
/// use scanhub_client::{Error, Request, Verb, domain_candidates, request};
///
/// fn main() -> Result<(), Error> {
///     // Set by a signal, for example.
///     let stop = AtomicBool::new(false);
///     request(&domain_candidates(None, None)?, &Request::new("front", Verb::Reset), &stop)?;
///     Ok(())
/// }
/// ```
///
/// # Errors
///
/// - [`ErrorKind::NoHub`](crate::ErrorKind) within a second if no hub runs, or if it ends before it answers.
/// - [`ErrorKind::NoTopic`](crate::ErrorKind) with the sensors that exist.
/// - [`ErrorKind::ResourceExhausted`](crate::ErrorKind) if there are too many requests at a time.
/// - [`ErrorKind::Failed`](crate::ErrorKind) if the link cannot do it.
/// - [`ErrorKind::Timeout`](crate::ErrorKind) if the hub does not answer, because it lacks memory or descriptors, or
///   because the link is busy.
/// - [`ErrorKind::Interrupted`](crate::ErrorKind) if `stop` is set.
pub fn request(
    locations: &[Domain],
    request: &Request,
    stop: &AtomicBool,
) -> Result<Option<ResponseModel>, Error> {
    let domain = find(locations)?;
    let node = scanhub_shm::client_node(&domain)?;
    send_request(&open(&node)?, &domain, request, stop)
}

/// The control service; waits for the service of a hub that is just starting.
fn open(node: &Node) -> Result<ControlClient, Error> {
    let deadline = Instant::now() + STARTUP_GRACE;
    loop {
        if let Some(client) = ControlClient::open(node)? {
            return Ok(client);
        }
        if Instant::now() >= deadline {
            return Err(Error::new(Kind::NoHub, "the hub takes no requests", "it may be an older one"));
        }
        sleep(RETRY_INTERVAL);
    }
}

fn send_request(
    client: &ControlClient,
    domain: &Domain,
    request: &Request,
    stop: &AtomicBool,
) -> Result<Option<ResponseModel>, Error> {
    let pending = client.send(request)?;
    let deadline = Instant::now() + RESPONSE_TIMEOUT;
    loop {
        scanhub_shm::take_wakeups(&[client.responses()])?;
        // In this order, because a hub may exit just after its answer.
        let is_hub_running = pending.is_open() && hub_pid(domain.root())?.is_some();
        if let Some(response) = pending.try_receive()? {
            return Ok(response.0?);
        }
        if !is_hub_running {
            let hint = "the result is not known: `scanhub info` shows the sensor's state";
            return Err(Error::new(Kind::NoHub, "the hub went away before it answered", hint));
        }
        if stop.load(Ordering::Relaxed) {
            return Err(Error::new(Kind::Interrupted, "interrupted before the hub answered", ""));
        }
        if Instant::now() >= deadline {
            let message =
                format!("the hub did not answer for {} in {} s", request.sensor, RESPONSE_TIMEOUT.as_secs());
            let hint = format!(
                "its log says whether something is short; `scanhub info {}` shows its state",
                request.sensor
            );
            return Err(Error::new(Kind::Timeout, message, hint));
        }
        scanhub_shm::sleep(&[client.responses()], POLL_INTERVAL)?;
    }
}

/// Time limit of an answer. A link takes a request within milliseconds; one that opens its port may need longer.
const RESPONSE_TIMEOUT: Duration = Duration::from_secs(5);
/// Interval of the checks for the hub and for the request to stop.
const POLL_INTERVAL: Duration = Duration::from_millis(100);
/// Interval of the attempts to open a service that does not exist yet.
const RETRY_INTERVAL: Duration = Duration::from_millis(10);
