//! Output of `track` and `tilt`: lines of JSON or text, and two topics under the name that the user chooses.

use std::hash::{BuildHasher, RandomState};
use std::io::{self, Write};
use std::rc::Rc;

use scanhub_client::streams::find;
use scanhub_client::{Publication, PublishSession, SensorPublisher};
use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{Failure, Flags, Header};
use scanhub_shm::{Domain, Payload};
use scanhub_verbs::follow::Notice;
use scanhub_verbs::names::{TopicName, position};
use scanhub_verbs::output::{ExitReason, Output};
use serde::Serialize;

/// Topics under which the results are published.
pub(super) struct Topics<A: Payload + ?Sized, B: Payload + ?Sized> {
    // Fields are dropped in this order: first the topics, and then the publisher that wakes the subscribers of the
    // topics.
    pub(super) publications: (Publication<A>, Publication<B>),
    pub(super) sensor: SensorPublisher,
}

/// Output of a run: lines and topics.
pub(super) struct Results<'a, A: Payload + ?Sized, B: Payload + ?Sized> {
    /// Name in all lines.
    pub(super) name: &'a str,
    pub(super) is_json: bool,
    /// Fields that all headers share.
    pub(super) header: Header,
    /// Published topics; `None` until [`publish`](Self::publish) has created the topics.
    pub(super) topics: Option<Topics<A, B>>,
    /// Number of samples of the subscribed topics that were published, but that this run did not receive.
    pub(super) missed: u64,
    out: Output<'a>,
    notes: Output<'a>,
}

impl<'a, A: Payload + ?Sized, B: Payload + ?Sized> Results<'a, A, B> {
    /// Creates the output of a run.
    pub(super) fn new(
        name: &'a str,
        is_json: bool,
        out: &'a mut dyn Write,
        notes: &'a mut dyn Write,
    ) -> Self {
        let hub_pid = std::process::id();
        let boot = RandomState::new().hash_one(hub_pid);
        Results {
            name,
            is_json,
            header: Header { boot, sensor: position(name), hub_pid, ..Header::default() },
            topics: None,
            missed: 0,
            out: Output::new(out),
            notes: Output::new(notes),
        }
    }

    /// Creates the topics in the domain in which a hub or listener runs.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::NoHub`](scanhub_schema::Kind) if neither a hub nor a listener runs, and the errors of
    /// [`PublishSession::open_named`].
    pub(super) fn publish(&mut self, limits: TopicLimits, locations: &[Domain]) -> Result<(), Failure> {
        let sensor = PublishSession::open_named(
            &find(locations)?,
            self.name,
            A::TOPIC.publisher_kind().topics(),
            limits,
        )?;
        self.topics = Some(Topics { publications: (sensor.topic()?, sensor.topic()?), sensor });
        Ok(())
    }

    /// Returns the number of samples that were not published because memory was short.
    pub(super) fn failed(&self) -> u64 {
        self.topics
            .as_ref()
            .map_or(0, |topics| topics.publications.0.failed() + topics.publications.1.failed())
    }

    /// Copies the flags of a scan's `header`, because the results of a simulated or replayed scan need the same flags.
    pub(super) fn take_flags(&mut self, header: &Header) {
        self.header.flags = header.flags & (Flags::SIMULATED | Flags::REPLAYED);
    }

    /// Writes a result to stdout, as JSON or text.
    pub(super) fn result(
        &mut self,
        json: &impl Serialize,
        text: impl FnOnce(&mut Vec<u8>) -> io::Result<()>,
    ) -> Result<(), ExitReason> {
        if self.is_json { self.out.json(json) } else { self.out.line(text) }
    }

    /// Writes a line that is not a result: JSON to stdout, or text to stderr.
    pub(super) fn note(
        &mut self,
        json: &impl Serialize,
        text: impl FnOnce(&mut Vec<u8>) -> io::Result<()>,
    ) -> Result<(), ExitReason> {
        if self.is_json { self.out.json(json) } else { self.notes.line(text) }
    }

    /// Writes a notice about subscribed topics.
    pub(super) fn notice(&mut self, names: &[Rc<TopicName>], notice: &Notice) -> Result<(), ExitReason> {
        if let Notice::Missed(count) = notice {
            self.missed += count;
        }
        notice.report(names, self.is_json, &mut self.out, &mut self.notes)
    }
}
