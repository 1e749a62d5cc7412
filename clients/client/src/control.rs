//! Requests to the hub. The library sends a request, and waits until the link has handled it.

use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::sleep;
use std::time::{Duration, Instant};

use scanhub_schema::{Kind, Request, ResponseModel};
use scanhub_shm::{ControlClient, Node};
use scanhub_shm::{Domain, hub_pid};

use crate::error::Error;
use crate::hub_finder::{STARTUP_GRACE, find};

/// Sends `request` to the hub at the first one of `locations` at which a hub runs, and returns the hub's reply.
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
/// - [`ErrorKind::NoHub`](crate::ErrorKind) if no hub runs, after at most a second, or if the hub ends before it
///   replies.
/// - [`ErrorKind::NoTopic`](crate::ErrorKind) if the hub has no such sensor. The error names the sensors that exist.
/// - [`ErrorKind::ResourceExhausted`](crate::ErrorKind) if the hub has too many requests at the same time.
/// - [`ErrorKind::Failed`](crate::ErrorKind) if the link cannot execute the request.
/// - [`ErrorKind::Timeout`](crate::ErrorKind) if the hub does not reply, because it lacks memory or descriptors, or
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

/// Opens the control service. If a hub is just starting, waits until the hub has created the service.
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
        // Check whether the hub runs before reading the reply, because a hub may exit just after it has replied.
        let is_hub_running = pending.is_open() && hub_pid(domain.root())?.is_some();
        if let Some(response) = pending.try_receive()? {
            return Ok(response.0?);
        }
        if !is_hub_running {
            let hint = "the result is not known: `scanhub info` shows the sensor's state";
            return Err(Error::new(Kind::NoHub, "the hub stopped before it replied", hint));
        }
        if stop.load(Ordering::Relaxed) {
            return Err(Error::new(Kind::Interrupted, "interrupted before the hub replied", ""));
        }
        if Instant::now() >= deadline {
            let message =
                format!("the hub did not reply for {} in {} s", request.sensor, RESPONSE_TIMEOUT.as_secs());
            let hint = format!(
                "its log says whether it lacks a resource; `scanhub info {}` shows its state",
                request.sensor
            );
            return Err(Error::new(Kind::Timeout, message, hint));
        }
        scanhub_shm::sleep(&[client.responses()], POLL_INTERVAL)?;
    }
}

/// Timeout for the reply. A link handles a request within milliseconds, but needs longer while it opens its port.
const RESPONSE_TIMEOUT: Duration = Duration::from_secs(5);
/// Interval at which the library checks, during the wait for a reply, whether the hub still runs and the caller wants
/// to stop.
const POLL_INTERVAL: Duration = Duration::from_millis(100);
/// Interval between attempts to open a service that does not exist yet.
const RETRY_INTERVAL: Duration = Duration::from_millis(10);
