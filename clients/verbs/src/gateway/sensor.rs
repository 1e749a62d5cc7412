//! One sensor of the hub on its way out: which of its samples become datagrams, and what is announced of it. Refuses to
//! know what a datagram looks like.

use std::num::NonZeroU64;
use std::time::{Duration, Instant};

use scanhub_client::clock;
use scanhub_client::streams::{Sample, Session, Source};
use schema::datagram::{Announce, Announced, Head, LanFlags, PORT, Packed, group};
use schema::{Background, Failure, Flags, Header, Quality, Topic, Verdict};

use super::network::Lan;
use super::selection::Selection;

/// A sensor that is being followed.
pub(super) struct Sensor {
    pub(super) name: String,
    tracks: Vec<Track>,
    /// Of what came last; nothing as long as nothing did.
    heard: Option<Header>,
    /// As its status says; empty if unknown.
    kind: String,
    model: Option<Model>,
    is_announced: bool,
}

struct Track {
    topic: Topic,
    source: Source,
    /// Every how manieth sample goes out; nothing if none do.
    every: Option<NonZeroU64>,
    last: Option<Header>,
    /// The last zones that went out were unknown.
    is_unknown: bool,
}

/// The background as it went out last.
struct Model {
    background: Background,
    header: Header,
    sent_at: Instant,
}

/// Samples taken from one topic before the next one has its turn.
const TURN: usize = 32;

impl Sensor {
    /// Will follow what goes out of the sensor called `name`; its status too if it `is_announced`, for its type.
    pub(super) fn new(name: &str, selection: &Selection, is_announced: bool) -> Sensor {
        let track = |topic| {
            let every = selection.every(name, topic);
            let is_followed = every.is_some() || (is_announced && topic == Topic::Status);
            let source = || Source::new(name, topic);
            is_followed.then(|| Track { topic, source: source(), every, last: None, is_unknown: false })
        };
        let tracks = Topic::ALL.into_iter().filter_map(track).collect();
        Sensor { name: name.to_owned(), tracks, heard: None, kind: String::new(), model: None, is_announced }
    }

    /// Sends what waits; whether more may. If nothing `subscribed` to a topic yet in this round it may, and says so: that takes
    /// a thousand times as long as sending, so that what waits of others has its turn before the next one. Failures as
    /// [`Source::receive`].
    pub(super) fn forward(
        &mut self,
        session: &mut Session,
        lan: &mut Lan,
        subscribed: &mut bool,
    ) -> Result<bool, Failure> {
        let mut more = false;
        for at in 0..self.tracks.len() {
            let is_new = !self.tracks[at].source.subscribed();
            if is_new && *subscribed {
                more = true;
                continue;
            }
            for turn in 0..TURN {
                let Some(sample) = self.tracks[at].source.receive(session)? else { break };
                more |= turn + 1 == TURN;
                self.take(at, &sample, lan);
            }
            *subscribed |= is_new && self.tracks[at].source.subscribed();
        }
        Ok(more)
    }

    /// Sends the background again if it went out longer than `every` ago.
    pub(super) fn repeat(&mut self, every: Duration, now: Instant, lan: &mut Lan) {
        let Some(model) = self.model.as_mut().filter(|model| now - model.sent_at >= every) else { return };
        if lan.is_claimed(model.header.sensor, &self.name) {
            model.sent_at = now;
            let head = head(Topic::Background, &model.header, model.header.wall_ns);
            lan.send(head, |room| model.background.pack(room));
        }
    }

    /// Says who this is and which number each topic has next; nothing as long as nothing was heard of it.
    pub(super) fn announce(&self, lan: &mut Lan) {
        let heard = self.heard.filter(|heard| self.is_announced && lan.is_claimed(heard.sensor, &self.name));
        let Some(heard) = heard else { return };
        let mut announce = Announce::new(heard.boot, &self.name, &self.kind);
        for topic in self.tracks.iter().filter(|track| track.every.is_some()).map(|track| track.topic) {
            announce.add(Announced {
                topic: topic.number(),
                group: group(topic),
                port: PORT,
                next: lan.next(heard.sensor, topic),
            });
        }
        let head = Head {
            topic: Announce::NUMBER,
            flags: flags(&heard) & !LanFlags::SUSPECT,
            revision: 1,
            ..head(Topic::Status, &heard, clock::wall_ns())
        };
        lan.send(head, |room| announce.pack(room));
    }

    /// After which time there may be something to send although the hub sends nothing.
    pub(super) fn left(&self) -> Option<Duration> {
        self.tracks.iter().filter_map(|track| track.source.left()).min()
    }

    fn take(&mut self, at: usize, sample: &Sample, lan: &mut Lan) {
        let Sensor { name, tracks, heard, kind, .. } = self;
        let track = &mut tracks[at];
        let Some(header) = sample.header().copied() else {
            // A silence has no header of its own: it is one of the last sample's sensor, if that still is this one.
            let last = track.last.filter(|last| lan.is_claimed(last.sensor, name));
            if let Some(last) = last.filter(|_| track.every.is_some()) {
                track.is_unknown = true;
                lan.send(head(track.topic, &last, clock::wall_ns()), |room| sample.pack(room));
            }
            return;
        };
        // What came from another machine is not sent on: it would go round in circles.
        if header.flags & Flags::REMOTE != 0 {
            return;
        }
        let is_new = heard.is_none_or(|heard| (heard.boot, heard.sensor) != (header.boot, header.sensor));
        if is_new {
            lan.claim(header.sensor, name);
        } else if !lan.is_claimed(header.sensor, name) {
            // What is left of a hub's life that is over: the number is another sensor's.
            return;
        }
        *heard = Some(header);
        track.last = Some(header);
        if let Sample::Status(status) = sample {
            status.sensor_type().clone_into(kind);
        }
        // Before its first sample: listeners would take that for one of whoever had the number before.
        if is_new {
            self.announce(lan);
        }
        let Sensor { tracks, model, .. } = self;
        let track = &mut tracks[at];
        let Some(every) = track.every else { return };
        lan.miss(header.sensor, track.topic, sample.missed());
        let mut stamp_ns = header.wall_ns;
        let mut is_due = header.seq.is_multiple_of(every.get());
        match sample {
            Sample::Status(_) => stamp_ns = clock::wall_ns(),
            Sample::Zones(heard) => {
                // That nothing is known is never thinned away.
                let is_unknown = heard.zones.verdict() == Verdict::Unknown;
                is_due |= is_unknown && !track.is_unknown;
                track.is_unknown = if is_due { is_unknown } else { track.is_unknown };
            }
            Sample::Background(background) => {
                let same = |model: &Model| {
                    (model.header.boot, model.background.generation) == (header.boot, background.generation)
                };
                is_due = !model.as_ref().is_some_and(same);
                let sent_at =
                    model.as_ref().filter(|_| !is_due).map_or_else(Instant::now, |model| model.sent_at);
                *model = Some(Model { background: **background, header, sent_at });
            }
            _ => {}
        }
        if is_due {
            lan.send(head(track.topic, &header, stamp_ns), |room| sample.pack(room));
        }
    }
}

/// What stands before a sample of `topic`.
fn head(topic: Topic, header: &Header, stamp_ns: u64) -> Head {
    Head {
        topic: topic.number(),
        flags: flags(header),
        stamp_ns,
        sensor: header.sensor,
        revision: topic.revision() as u16,
        counter: header.seq as u32,
        ..Head::default()
    }
}

fn flags(header: &Header) -> u8 {
    let known = Flags::SIMULATED | Flags::REPLAYED | Flags::STAMP_ESTIMATED;
    let suspect = if header.quality() == Quality::Suspect { LanFlags::SUSPECT } else { 0 };
    (header.flags & known) as u8 | suspect
}

// The bits are the same in both forms.
const _: () = assert!(
    Flags::SIMULATED == LanFlags::SIMULATED as u16
        && Flags::REPLAYED == LanFlags::REPLAYED as u16
        && Flags::STAMP_ESTIMATED == LanFlags::STAMP_ESTIMATED as u16
);
