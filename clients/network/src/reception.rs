//! What becomes of datagrams of other machines, by whatever network they came: each is refused or counted, and a new sample
//! is written or published in this machine's domain. Tells what is wrong, each thing once. Refuses to know sockets.

mod crowd;
mod duplicate_gateways;
mod epochs;
mod names;
mod publish;
mod received_topics;
mod remote;
mod report;

use std::collections::HashMap;
use std::net::IpAddr;
use std::time::Instant;

use crate::lan::incoming::{Announcement, Arrived, Incoming, RemoteSample};
use crate::lan::{Key, Stamp};
use scanhub_schema::datagram::{DatagramError, Head};
use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{Failure, Topic};
use scanhub_shm::{Domain, StateDirectory};

use crate::interface::is_of_this_machine;
use crate::stamp;
use crowd::{Crowd, Crowding};
use epochs::Epochs;
use names::{Hubs, Names};
use publish::Publication;
pub use received_topics::received_topics;
pub(crate) use report::Report;
pub use report::Words;
use scanhub_verbs::output::{End, Output};

/// What is wanted of what comes.
pub struct Wanted<'a> {
    /// The topics whose samples are, of all sensors.
    pub topics: Vec<Topic>,
    /// The topics whose announcements are believed: what does not come of the others is not lost.
    pub heard: Vec<Topic>,
    /// `NAME=HUB`: what to call a gateway, instead of its 16 hex digits.
    pub names: &'a [String],
    /// The gateways to hear, by 16 hex digits or by one of `names`; none: all. What others send is passed over, before the
    /// account.
    pub hubs: &'a [String],
    /// The key without which nothing is believed; none: everything is.
    pub key: Option<Key>,
    /// Where it keeps what has to survive it, if anywhere.
    pub state: Option<StateDirectory>,
    /// Instead of writing samples, publish them in this domain, as `HUB.SENSOR`.
    pub publish: Option<&'a Domain>,
    /// What the topics are made for that are published.
    pub limits: TopicLimits,
    /// Bytes of shared memory that all published topics may take together.
    pub memory: u64,
    /// Whether only sensors of gateways are published that have delivered for a second.
    pub only_proven: bool,
    /// Only the account, no samples.
    pub stats: bool,
}

/// Where a datagram came from, and when.
#[derive(Clone, Copy, Debug)]
pub struct Origin {
    /// A number that no other sender has.
    pub sender: u64,
    /// Its address, if the network tells that.
    pub address: Option<IpAddr>,
    /// When it came.
    pub arrival: Stamp,
}

/// The receiving end of a network.
pub struct Reception<'a> {
    wanted: Vec<Topic>,
    is_quiet: bool,
    hubs: Hubs,
    publication: Option<Publication>,
    /// What was told that is wrong here.
    told: Vec<String>,
    incoming: Incoming,
    /// Where the epochs of gateways are kept that had the key, if there is one.
    epochs: Option<Epochs>,
    crowd: Crowd,
    pub(crate) report: Report<'a>,
    /// When the last datagram came that was taken.
    taken: Stamp,
    /// Samples that came and were wanted.
    pub received: u64,
    /// When the last of them came.
    pub last_sample: Instant,
    /// Where a sample is put together of its parts.
    whole: Vec<u8>,
    /// What could not be read of what was kept.
    unreadable: Option<Failure>,
}

/// What is wrong where a datagram is of another version.
const OTHER_VERSION: &str = "somebody sends datagrams of another version, which are refused: install the same version of \
                             scanhub on both machines";
/// What is wrong where a datagram is of a topic that is not known here.
const NEWER_TOPIC: &str = "somebody sends topics that this version does not know, which are left out: install the same \
                           version of scanhub on both machines";
/// Message if a sensor does not fit into the memory that remote sensors may use.
const NO_ROOM: &str = "samples of remote sensors were not published, because these need more shared memory than --memory \
                       allows: use a greater --memory; if someone invents sensors, use --key-file, or --hub to receive only \
                       those that it names";
/// The most things that are told to be wrong: it may be the network that makes them.
const TOLD: usize = 16;

impl<'a> Reception<'a> {
    /// Opens the end for what is `wanted`; it tells to `out`, and what is no account to `notes` if that is not `json`, in these
    /// `words`.
    ///
    /// # Errors
    ///
    /// [`Kind::Configuration`](scanhub_schema::Kind) if a name or hub is not possible, or too little memory is allowed for a sensor;
    /// [`Kind::DomainHeld`](scanhub_schema::Kind) if another listener publishes in the domain, [`Kind::Short`](scanhub_schema::Kind) if there is
    /// too little memory.
    pub fn open(
        wanted: Wanted<'_>,
        json: bool,
        words: Words,
        out: Output<'a>,
        notes: Output<'a>,
    ) -> Result<Reception<'a>, Failure> {
        let names = Names::parse(wanted.names)?;
        let hubs = Hubs::parse(wanted.hubs, &names)?;
        let open = |domain| {
            let publication = publish::open(domain, wanted.limits, wanted.memory)?;
            Ok(if wanted.only_proven { publication.only_proven() } else { publication })
        };
        let publication = wanted.publish.map(open).transpose()?;
        let key_name = wanted.key.as_ref().map(Key::name);
        let epochs = wanted.key.as_ref().map(|key| Epochs::of(key, wanted.state.clone()));
        let (known, unreadable) = match epochs.as_ref().map_or(Ok(HashMap::new()), Epochs::read) {
            Ok(known) => (known, None),
            Err(failure) => (HashMap::new(), Some(failure)),
        };
        let incoming = match wanted.key {
            Some(key) => Incoming::with_key(&wanted.heard, key, known),
            None => Incoming::new(&wanted.heard),
        };
        Ok(Reception {
            wanted: wanted.topics,
            is_quiet: wanted.stats,
            hubs,
            publication,
            told: Vec::new(),
            incoming,
            epochs,
            crowd: Crowd::default(),
            report: Report::new(json, words, out, notes, names, key_name),
            taken: Stamp::default(),
            received: 0,
            last_sample: Instant::now(),
            whole: Vec::new(),
            unreadable,
        })
    }

    /// Says what could not be read when it was opened.
    ///
    /// # Errors
    ///
    /// As [`take`](Reception::take).
    pub fn begin(&mut self) -> Result<(), End> {
        match self.unreadable.take() {
            Some(failure) => self.trouble(&failure.to_string()),
            None => Ok(()),
        }
    }

    /// Returns what is known of who sends.
    pub fn incoming(&self) -> &Incoming {
        &self.incoming
    }

    /// Takes `bytes`, a whole datagram. To be followed by [`wake`](Reception::wake) when nothing more waits.
    ///
    /// # Errors
    ///
    /// If it cannot be told any more what came.
    pub fn take(&mut self, bytes: &[u8], origin: Origin) -> Result<(), End> {
        self.taken = origin.arrival;
        if !self.hubs.want(bytes) {
            return Ok(());
        }
        let mut whole = std::mem::take(&mut self.whole);
        let taken = self.arrived(bytes, origin, &mut whole);
        self.whole = whole;
        taken?;
        self.keep_epochs()
    }

    /// Wakes the consumers of what was published.
    pub fn wake(&mut self) {
        if let Some(publication) = &mut self.publication {
            publication.wake();
        }
    }

    /// Does what is due now and then; `more` may wait.
    ///
    /// # Errors
    ///
    /// As [`take`](Reception::take).
    pub fn look(&mut self, now: Instant, more: bool) -> Result<(), End> {
        if let Some(publication) = &mut self.publication {
            let now = stamp::now();
            publication.look(now.monotonic_ns, if more { self.taken } else { now });
        }
        let so_far = self.crowding();
        match self.crowd.look(so_far, now) {
            Some(what) => self.report.trouble(&what),
            None => Ok(()),
        }
    }

    /// Tells the account so far; `others` are reasons for which something was refused before it came here.
    ///
    /// # Errors
    ///
    /// As [`take`](Reception::take).
    pub fn tell(&mut self, others: &[(&'static str, u64)]) -> Result<(), End> {
        self.report.stats(self.incoming.stats(), self.incoming.peers(), others)?;
        self.publication.iter().try_for_each(|publication| self.report.publication(publication))
    }

    /// Draws the account on a terminal, over the one before.
    pub(crate) fn draw(&mut self) -> Result<(), End> {
        self.report.draw(self.incoming.stats(), self.incoming.peers())
    }

    /// Tells what is wrong here, once; of ever new things only the first ones.
    ///
    /// # Errors
    ///
    /// As [`take`](Reception::take).
    pub fn trouble(&mut self, what: &str) -> Result<(), End> {
        if self.told.len() == TOLD || self.told.iter().any(|told| told == what) {
            return Ok(());
        }
        self.told.push(what.to_owned());
        self.report.trouble(what)
    }

    fn arrived(&mut self, bytes: &[u8], origin: Origin, whole: &mut Vec<u8>) -> Result<(), End> {
        let arrived = self.incoming.receive(bytes, origin.sender, origin.arrival, whole);
        if let (Some(head), Some(publication)) = (arrived.begins(), &mut self.publication) {
            // If a life of the same epoch went on until now, that was another sender's.
            publication.begun(head, stamp::now());
        }
        match arrived {
            Arrived::Sample(mut sample) => {
                sample.announced = sample.announced.map(|announce| announce.only(&self.wanted));
                self.sample(&sample, origin)
            }
            Arrived::Announced(mut announcement) => {
                announcement.announce = announcement.announce.only(&self.wanted);
                self.announced(&announcement, origin)
            }
            Arrived::Refused { shared: Some(hub), .. } => self.is_shared(hub),
            Arrived::Refused { why: DatagramError::Version, .. } => self.trouble(OTHER_VERSION),
            Arrived::Refused { why: DatagramError::Skipped, .. } => self.trouble(NEWER_TOPIC),
            Arrived::Untimely { behind_ns } => self.trouble(untimely(behind_ns)),
            Arrived::Refused { shared: None, .. } | Arrived::Part | Arrived::Known => Ok(()),
        }
    }

    /// Keeps the epochs of gateways that had the key, if one is new: once in a life of a gateway.
    fn keep_epochs(&mut self) -> Result<(), End> {
        let kept = match (self.incoming.take_epochs(), &self.epochs) {
            (Some(known), Some(epochs)) => epochs.keep(known),
            _ => return Ok(()),
        };
        kept.or_else(|failure| self.trouble(&failure.to_string()))
    }

    /// A sample that was not there before.
    fn sample(&mut self, sample: &RemoteSample<'_>, origin: Origin) -> Result<(), End> {
        let RemoteSample { remote, missed, .. } = sample;
        let (head, topic) = (&remote.datagram.head, remote.topic);
        if !self.wanted.contains(&topic) {
            return Ok(());
        }
        self.received += 1;
        self.last_sample = Instant::now();
        if let Some(publication) = &mut self.publication {
            let made = publication.sample(sample, || self.report.names.of(head.hub), stamp::now());
            if publication.left_out.no_room > 0 {
                self.trouble(NO_ROOM)?;
            }
            return self.made(head, made, origin);
        }
        if self.is_quiet {
            return Ok(());
        }
        let sensor = &self.incoming.written(head);
        if *missed > 0 {
            self.report.missed(head, sensor, topic, *missed)?;
        }
        self.report.sample(sensor, remote)
    }

    /// A sensor was announced, in newer words than before.
    fn announced(&mut self, announcement: &Announcement, origin: Origin) -> Result<(), End> {
        let Announcement { head, announce, is_named, behind_ns, .. } = announcement;
        if *is_named {
            self.report.named(head, announce.sensor())?;
        }
        if let Some(behind_ns) = behind_ns {
            self.report.clocks_differ(head, *behind_ns)?;
        }
        let Some(publication) = &mut self.publication else { return Ok(()) };
        let made = publication.announced(announcement, &self.report.names.of(head.hub), stamp::now());
        self.made(head, made, origin)
    }

    /// What became of the topics of the sensor that sent `head`: they may have been `made` just now.
    fn made(
        &mut self,
        head: &Head,
        made: Result<Option<String>, Failure>,
        origin: Origin,
    ) -> Result<(), End> {
        match made {
            Ok(Some(name)) => {
                let is_here = origin.address.is_some_and(is_of_this_machine);
                self.report.published(head, &name, is_here)
            }
            Ok(None) => Ok(()),
            Err(failure) => self.trouble(&failure.to_string()),
        }
    }

    /// Two gateways send as `hub`, and what one of them sends is refused.
    fn is_shared(&mut self, hub: u64) -> Result<(), End> {
        let what = duplicate_gateways::remedy(&self.report.names.of(hub));
        self.trouble(&what)
    }

    fn crowding(&self) -> Crowding {
        let publication = self.publication.as_ref();
        Crowding {
            gateways: self.incoming.stats().given_up().displaced,
            refused: self.incoming.stats().refused(DatagramError::Capacity),
            sensors: publication.map_or(0, |publication| publication.displaced),
            samples: publication.map_or(0, |publication| publication.left_out.capacity),
        }
    }
}

/// What is wrong where an announcement has the key and is not believed; in so few words that it is told once.
fn untimely(behind_ns: i64) -> &'static str {
    match behind_ns < 0 {
        true => {
            "a gateway has the key, and its clock is more than 5 s ahead of this machine's: it is not believed; set the clocks"
        }
        false => {
            "a gateway has the key, and its clock is more than 5 s behind this machine's, or somebody sends again what was \
             recorded: it is not believed; set the clocks"
        }
    }
}
