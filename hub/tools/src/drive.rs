//! Drives a conversation on an open port until it is over. A link's thread does the same forever and for consumers; this
//! does it once, for a person at a terminal.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use port::{Port, clock};
use rustix::event::{PollFd, PollFlags, poll};
use scanhub_drivers::lms::exchange::{Conversation, Output};
use schema::{Failure, Kind, MILLIS, Nanos};

/// Drives `talk` on `port`; `look` sees it whenever it waits. A rate that the port cannot have is passed over.
///
/// [`Kind::PortMissing`] if the port goes away, [`Kind::Interrupted`] if `stop` is set.
pub(crate) fn drive<C: Conversation>(
    port: &Port,
    talk: &mut C,
    stop: &AtomicBool,
    mut look: impl FnMut(&C),
) -> Result<(), Failure> {
    let mut refused = Vec::new();
    while let Some(until) = drain(port, talk, &mut refused).map_err(|error| gone(port, &error))? {
        look(talk);
        if stop.load(Ordering::Relaxed) {
            return Err(Failure::new(Kind::Interrupted, "interrupted", ""));
        }
        let now = clock::now();
        let mut fds = [PollFd::new(port, PollFlags::IN)];
        // An interrupted wait is a short one.
        let _ = poll(&mut fds, Some(&clock::span(now, until.min(now + LOOK))));
        let len = port.read(talk.spare()).map_err(|error| gone(port, &error))?;
        let now = clock::now();
        talk.commit(now, len);
        if len == 0 && now >= until {
            talk.handle_timeout(now);
        }
    }
    Ok(())
}

/// Carries out the actions of `talk` until it waits or ends. A rate that the port refuses is logged if it is not among those
/// `refused`.
fn drain<C: Conversation>(
    port: &Port,
    talk: &mut C,
    refused: &mut Vec<u32>,
) -> std::io::Result<Option<Nanos>> {
    loop {
        match talk.poll_output() {
            Output::SetBaud(baud) => {
                if let Some(error) = port.try_baud(baud.rate())?
                    && !refused.contains(&baud.rate())
                {
                    refused.push(baud.rate());
                    match port {
                        Port::Tty(tty) => tracing::warn!("{}: {error}", tty.device().display()),
                        Port::Tcp(_) => tracing::warn!("{error}"),
                    }
                }
            }
            Output::Transmit { byte, not_before } => {
                let now = clock::now();
                if not_before > now {
                    std::thread::sleep(Duration::from_nanos(not_before - now));
                }
                if talk.restart_if_late(clock::now()) {
                    continue;
                }
                port.write(byte)?;
                talk.transmitted(clock::now());
            }
            Output::Wait { until } => return Ok(Some(until)),
            Output::Done => return Ok(None),
        }
    }
}

/// Why `port` can be used no more. A serial server that has a client closes the connection of another one.
pub(crate) fn gone(port: &Port, error: &std::io::Error) -> Failure {
    if let Port::Tcp(_) = port {
        return Failure::new(
            Kind::PortBusy,
            format!("the connection is over: {error}"),
            "a serial server has one client at a time: end the other program that is connected to it, such as a hub, and try \
             again; if there is none, was the server switched off?",
        );
    }
    Failure::new(
        Kind::PortMissing,
        format!("the port went away: {error}"),
        "was it unplugged? plug it in and try again",
    )
}

/// Between two looks whether somebody wants to stop, or see how far it is.
const LOOK: Nanos = 100 * MILLIS;
