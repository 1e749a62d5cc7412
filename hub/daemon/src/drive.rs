//! Drives a session with a sensor on an open port, until the hub ends or the port is gone. The way of a scan, from the line
//! to whoever sleeps for it, is here:
//!
//! - **read**: [`Driver::stream`] waits for the port and reads into the session's buffer;
//! - **frame**: [`Driver::drain`] asks the session what the bytes are, and gets a telegram in that buffer, decoded once;
//! - **loan**, **decode**, **process**, **send**: [`LinkOutput::process`](crate::process_telegram::LinkOutput::process)
//!   sends the telegram, then takes loans of shared memory, writes the scan and what the processors make of it in place, and
//!   sends them (`topics.rs`, `pipeline.rs`);
//! - **ring**: [`LinkThread::publish`] wakes the consumers, once a telegram.
//!
//! Nothing on this way allocates, locks or logs. Refuses to know how the port came to be open.

use std::io;
use std::os::fd::AsFd;

use lms::framer::suspect;
use lms::session::Output;
use lms::variant::Baud;
use lms::{Identity, Nanos, Session};
use port::{LineErrors, Port, Source, clock};
use rustix::event::PollFlags;
use schema::State;

use crate::control::Flow;
use crate::identity_cache::IdentityCache;
use crate::last_rate::LastRate;
use crate::link::{LinkThread, Woken};
use crate::process_telegram::RecordedContext;

/// What outlives a session on a port, for the next one.
pub(crate) struct Driver {
    /// What the next hub would like to know.
    identity: IdentityCache,
    /// Where the sensor was found the last time; nothing on a line whose rate cannot be changed.
    last_rate: Option<LastRate>,
    /// Rates that the port cannot have, as was said.
    refused: Vec<Baud>,
    line_errors: LineErrors,
    /// What is read waited in the port for an unknown time.
    is_behind: bool,
}

impl Driver {
    /// For the port of `link`.
    pub(crate) fn new(link: &LinkThread<'_>) -> Driver {
        let (name, port) = (&link.link.name, link.link.port.name());
        let identity = IdentityCache::open(link.around.root, name, &port);
        let is_tty = matches!(link.link.port, Source::Tty(_));
        let last_rate = is_tty.then(|| LastRate::open(link.around.state, name, &port));
        Driver {
            identity,
            last_rate,
            refused: Vec::new(),
            line_errors: LineErrors::default(),
            is_behind: false,
        }
    }

    /// What the hub before this one knew of the sensor, if that was just now.
    pub(crate) fn recall(&self) -> Option<Identity> {
        self.identity.recall(clock::now())
    }

    /// The rate to begin with where the sensor has to be sought.
    pub(crate) fn last_rate(&self) -> Option<Baud> {
        self.last_rate.as_ref().and_then(LastRate::baud)
    }

    /// Drives `session` on `port` until the hub shall end; an error says that the port is gone.
    pub(crate) fn stream(
        &mut self,
        link: &mut LinkThread<'_>,
        port: &Port,
        session: &mut Session,
    ) -> io::Result<()> {
        self.is_behind = false;
        let mut allowance = port.allowance(link.link.baud.rate());
        loop {
            let (watch, until) = self.drain(link, port, session)?;
            let rest = allowance.as_mut().and_then(|allowance| allowance.rest(clock::now(), until));
            // Also while bytes are left alone the port may go away.
            let events = if watch && rest.is_none() { PollFlags::IN } else { PollFlags::empty() };
            match link.wait(Some((port.as_fd(), events)), rest.unwrap_or(until)) {
                Woken::Stop => return Ok(()),
                Woken::Request => {
                    link.handle_requests(Flow::Session(session));
                    continue;
                }
                Woken::Ready | Woken::Timeout => {}
            }
            if !watch {
                // The telegram's end is near: what can be done before it is not done after it.
                link.output.prepare();
            }
            if watch
                && session.may_leave()
                && let Some(waiting) = port.waiting()
                && session.leave(clock::now(), waiting)
            {
                continue;
            }
            let mut spare = session.spare();
            if let Some(allowance) = &allowance {
                let most = spare.len().min(allowance.bytes(clock::now()).max(1));
                spare = &mut spare[..most];
            }
            let room = spare.len();
            let len = port.read(spare)?;
            let now = clock::now();
            session.commit(now, len);
            if let Some(allowance) = &mut allowance {
                allowance.take(len, room, now);
                self.is_behind = allowance.is_behind(now);
                link.diagnosis.watch_flood(allowance.is_flooded(now));
            }
            if len == 0 && now >= until {
                session.handle_timeout(now);
            }
        }
    }

    /// Does what the session wants, until it wants to wait: whether for bytes, and until when.
    fn drain(
        &mut self,
        link: &mut LinkThread<'_>,
        port: &Port,
        session: &mut Session,
    ) -> io::Result<(bool, Nanos)> {
        let mut published = false;
        let (watch, until) = loop {
            match session.poll_output() {
                Output::SetBaud(baud) => self.set_baud(link, port, baud)?,
                Output::Transmit { byte, not_before } => {
                    pause(not_before);
                    port.write(byte)?;
                    session.transmitted(clock::now());
                }
                Output::Telegram(mut received) => {
                    let counted = port.line_errors();
                    link.stats.line_errors += counted;
                    let is_hit = self.line_errors.note(counted);
                    received.estimated |= self.is_behind;
                    received.reasons |= if is_hit { suspect::LINE_ERROR } else { 0 };
                    link.publish(&received, &RecordedContext::default(), self.is_behind);
                    published = true;
                }
                Output::Rest(until) => break (false, until),
                Output::Wait { until, .. } => break (true, until),
            }
        };
        if published {
            self.line_errors.wait();
        }
        self.identity.keep_first(session);
        let (state, is_new) = link.diagnosis.examine(session);
        if is_new {
            self.last_rate.iter_mut().for_each(|last| last.keep(session));
        }
        if (is_new || link.is_due(clock::now())) && link.show_session(session, state) {
            self.identity.keep(session, clock::now());
        }
        // While telegrams come there is no need for wake-ups of the status' own.
        let bound = if state == State::Streaming { Nanos::MAX } else { link.next_status() };
        Ok((watch, until.min(bound)))
    }

    /// The sensor is looked for at those rates that the port can have; of another one it is said once that it cannot.
    fn set_baud(&mut self, link: &LinkThread<'_>, port: &Port, baud: Baud) -> io::Result<()> {
        if let Some(error) = port.try_baud(baud.rate())?
            && !self.refused.contains(&baud)
        {
            self.refused.push(baud);
            tracing::warn!("{}: {error}", link.link.name);
        }
        Ok(())
    }
}

/// Sleeps until `not_before`, too short a time to watch anything meanwhile.
fn pause(not_before: Nanos) {
    let now = clock::now();
    if not_before > now {
        std::thread::sleep(std::time::Duration::from_nanos(not_before - now));
    }
}
