//! The hub without ports, threads and waiting: bytes are handed in, with the moment at which they came, and the topics are
//! there, made by the same functions as those of a line. So many sensors can be driven faster than they turn. Refuses to know
//! where the bytes are from; nobody hears what a session would say to a sensor.

use std::sync::atomic::AtomicBool;

use config::Config;
use lms::session::Output;
use lms::{Nanos, Session};
use port::clock;
use rustix::event::{EventfdFlags, eventfd};
use schema::{Domain, Failure, Flags, HubLock, State, ipc, shortage};

use crate::control::ControlServer;
use crate::link::{LinkThread, Surroundings};
use crate::preflight;
use crate::process_telegram::RecordedContext;
use crate::service::Service;
use crate::topics::Topics;

/// A link that is driven by whoever has it. It streams from the start, as a recording does: its scans are read in the
/// mode that the configuration names.
pub struct DrivenLink<'a> {
    link: LinkThread<'a>,
    session: Session,
    /// When scans stay out, by the clock of whoever drives it.
    stale_at: Nanos,
}

/// Makes the links of `config` in `domain`, whatever their ports are, and gives them to `drive`; ends with it. Requests of
/// users are not answered.
///
/// Stamps are as told to [`DrivenLink::read`]; a status goes out each second of the real clock.
///
/// [`Kind::DomainHeld`](schema::Kind) if a hub has the domain, [`Kind::Short`](schema::Kind) if memory or descriptors
/// are, [`Kind::Failed`](schema::Kind) if shared memory refuses.
pub fn in_memory<T>(
    config: &Config,
    domain: &Domain,
    drive: impl FnOnce(&mut [DrivenLink<'_>]) -> T,
) -> Result<T, Failure> {
    preflight::raise_descriptor_limit();
    let _lock = HubLock::acquire(domain.root())?;
    preflight::check_descriptors(config.links.len())?;
    preflight::check_memory(config.links.len())?;
    let node = ipc::hub_node(domain)?;
    let (_control, queues) = ControlServer::open(&node, config.links.iter().map(|link| link.name.as_str()))?;
    let stop = eventfd(0, EventfdFlags::CLOEXEC).map_err(|error| {
        let message = format!("cannot get an eventfd: {error}");
        Failure::new(schema::Kind::Short, message, "raise `ulimit -n`")
    })?;
    let (service, worked) = (Service::default(), AtomicBool::new(false));
    let around = Surroundings {
        stop: &stop,
        service: &service,
        root: domain.root(),
        slot: None,
        state: None,
        worked: &worked,
    };
    let mut links = Vec::with_capacity(config.links.len());
    for ((number, link), queue) in config.links.iter().enumerate().zip(queues) {
        let mut topics = Topics::new(&node, &link.name, number as u8, 0)?;
        topics.set_flags(Flags::REPLAYED);
        let link = LinkThread::new(link, topics, around, queue);
        let session = Session::new(link.settings(true), clock::now());
        links.push(DrivenLink { link, session, stale_at: Nanos::MAX });
    }
    shortage::allocate(domain)?;
    Ok(drive(&mut links))
}

impl DrivenLink<'_> {
    /// `bytes` came, in one read at `now`: publishes what is complete with them, and before that that scans stayed out, if
    /// they did. How many telegrams that were.
    pub fn read(&mut self, now: Nanos, mut bytes: &[u8]) -> usize {
        if now > self.stale_at {
            self.link.output.publish_stale(self.stale_at);
            self.stale_at = Nanos::MAX;
        }
        if self.session.buffered() > 0 {
            // As a line does while the end of a telegram is near.
            self.link.output.prepare();
        }
        let mut published = 0;
        while !bytes.is_empty() {
            let room = self.session.spare();
            let (piece, rest) = bytes.split_at(bytes.len().min(room.len()));
            room[..piece.len()].copy_from_slice(piece);
            bytes = rest;
            self.session.commit(now, piece.len());
            while let Output::Telegram(received) = self.session.poll_output() {
                let recorded = RecordedContext { mode: self.link.link.mode, ..RecordedContext::default() };
                if let Some(limit) = self.link.publish(&received, &recorded, false) {
                    self.stale_at = now.saturating_add(limit);
                }
                published += 1;
            }
        }
        self.link.show(Some(&self.session), State::Streaming, "");
        published
    }
}
