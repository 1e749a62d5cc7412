//! What becomes of a picture: it gets a number, and goes out as topics if the tracker has a name for them. Refuses to know how
//! it is told.

use std::hash::{BuildHasher, RandomState};

use crate::track::{PICTURE_NS, Picture, Site};
use scanhub_client::streams::find;
use scanhub_client::{Publication, PublishSession, SensorPublisher, clock};
use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{Event, Failure, Flags, Header, Maker, Tracks, Wake};
use scanhub_shm::Domain;

use scanhub_verbs::names::position;

/// Pictures as samples.
pub(super) struct Samples {
    /// Of the last one.
    header: Header,
    tracks: Box<Tracks>,
    events: Vec<(Header, Event)>,
    next: Numbers,
    topics: Option<Topics>,
}

/// Numbers of the next samples.
#[derive(Default)]
struct Numbers {
    tracks: u64,
    events: u64,
}

struct Topics {
    // Before what wakes their consumers.
    tracks: Publication<Tracks>,
    events: Publication<Event>,
    sensor: SensorPublisher,
}

impl Samples {
    /// Of a tracker called `name`.
    pub(super) fn new(name: &str) -> Samples {
        let sensor = position(name);
        let boot = RandomState::new().hash_one(std::process::id());
        let period_us = (PICTURE_NS / 1000) as u32;
        let header = Header { boot, sensor, period_us, hub_pid: std::process::id(), ..Header::default() };
        Samples { header, tracks: Box::default(), events: Vec::new(), next: Numbers::default(), topics: None }
    }

    /// Makes the topics of `name` in the domain where a hub or listener lives.
    ///
    /// [`Kind::NoHub`](scanhub_schema::Kind) if none does, [`Kind::Configuration`](scanhub_schema::Kind) if the name is not possible,
    /// [`Kind::NameHeld`](scanhub_schema::Kind) if another process has it, [`Kind::Short`](scanhub_schema::Kind) if memory or descriptors are short.
    pub(super) fn publish(&mut self, name: &str, places: &[Domain]) -> Result<(), Failure> {
        let (topics, limits) = (Maker::Tracker.topics(), TopicLimits::default());
        let sensor = PublishSession::beside(&find(places)?, name, topics, limits)?;
        self.topics = Some(Topics { tracks: sensor.topic()?, events: sensor.topic()?, sensor });
        Ok(())
    }

    /// The topics are there.
    pub(super) fn is_published(&self) -> bool {
        self.topics.is_some()
    }

    /// Takes a picture that is of scans with these `flags`, and sends it if it is published.
    pub(super) fn take(&mut self, picture: &Picture, site: &Site, flags: u8) {
        let now_ns = clock::now_ns();
        self.header = Header {
            seq: self.next.tracks,
            topic_seq: self.next.tracks,
            stamp_first_ns: now_ns,
            stamp_last_ns: now_ns,
            wall_ns: picture.wall_ns,
            flags: flags & (Flags::SIMULATED | Flags::REPLAYED),
            ..self.header
        };
        self.next.tracks += 1;
        *self.tracks = picture.payload(site);
        self.events.clear();
        for event in &picture.events {
            let header = Header { topic_seq: self.next.events, wall_ns: event.wall_ns, ..self.header };
            self.events.push((header, event.payload(site)));
            self.next.events += 1;
        }
        let Some(Topics { tracks, events, sensor }) = &mut self.topics else { return };
        // A sample without memory is a number that is missing, and who cannot be woken looks ten times a second.
        for (header, event) in &self.events {
            let _ = events.send_with(header, |sample| *sample = *event);
        }
        let _ = tracks.send_with(&self.header, |sample| *sample = *self.tracks);
        let _ = sensor.wake(Wake::Telegram);
    }

    /// Who is where in the last picture.
    pub(super) fn tracks(&self) -> (&Header, &Tracks) {
        (&self.header, &self.tracks)
    }

    /// What happened before it.
    pub(super) fn events(&self) -> &[(Header, Event)] {
        &self.events
    }

    /// Pictures so far.
    pub(super) fn pictures(&self) -> u64 {
        self.next.tracks
    }

    /// Samples that were not sent for lack of memory.
    pub(super) fn failed(&self) -> u64 {
        self.topics.as_ref().map_or(0, |topics| topics.tracks.failed() + topics.events.failed())
    }
}
