//! Receiving side of `listen` and of the bridge, for any network. Each datagram is refused or counted, and a new sample
//! is printed or published in this machine's domain. Each problem is reported once.

mod epochs;
mod names;
mod publish;
mod report;

use std::collections::HashMap;
use std::net::IpAddr;
use std::time::{Duration, Instant};

use scanhub_schema::datagram::{DatagramError, Head};
use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{Failure, Topic};
use scanhub_shm::{Domain, StateDirectory};
use scanhub_verbs::output::{ExitReason, Output};

use crate::interface::is_of_this_machine;
use crate::lan::address::Address;
use crate::lan::incoming::{Announcement, Incoming, ReceiveOutcome, RemoteSample};
use crate::lan::republish::MAX_SENSORS;
use crate::lan::{Key, MAX_ROWS, MAX_RUNS, WallTimestamp};
use crate::now;
use epochs::Epochs;
use names::Names;
pub use names::received_topics;
use publish::Publication;
pub use report::ClassNames;
pub(crate) use report::Report;

/// Settings of a receiver.
pub struct ReceiverConfig<'a> {
    /// Topics whose samples are received, of all sensors.
    pub topics: Vec<Topic>,
    /// Topics whose announcements are accepted. Samples of other topics do not count as lost if they do not arrive.
    pub announced_topics: Vec<Topic>,
    /// Names of gateways, `NAME=HUB`, in place of their 16 hex digits.
    pub names: &'a [String],
    /// Gateways to receive from, by 16 hex digits or by one of `names`. If the list is empty, all gateways are
    /// received. Datagrams of other gateways are ignored, and not counted.
    pub hubs: &'a [String],
    /// Key that datagrams are authenticated with. Without it, all datagrams are accepted.
    pub key: Option<Key>,
    /// Directory of state that outlives the process; `None` if the environment names none.
    pub state: Option<StateDirectory>,
    /// Domain in which samples are published as `HUB.SENSOR`, instead of being printed.
    pub publish: Option<&'a Domain>,
    /// Limits of the published topics.
    pub limits: TopicLimits,
    /// Bytes of shared memory that all published topics may take together.
    pub memory: u64,
    /// Whether a sensor is published only after its gateway has delivered for a second.
    pub only_proven: bool,
    /// Whether only the counters are printed, and no samples.
    pub stats: bool,
}

/// Origin of a datagram.
#[derive(Clone, Copy, Debug)]
pub struct Origin<'a> {
    /// A number that no other sender has.
    pub sender: u64,
    /// Address of the sender, if the network reports it.
    pub address: Option<IpAddr>,
    /// Name under which the network delivered the datagram, if it has names.
    pub name: Option<Address<'a>>,
    /// Time at which the datagram arrived.
    pub arrival: WallTimestamp,
}

/// Receiving end of a network.
pub struct RemoteReceiver<'a> {
    topics: Vec<Topic>,
    /// Whether only the counters are printed.
    is_stats: bool,
    publication: Option<Publication>,
    /// Problems that were reported.
    reported: Vec<String>,
    incoming: Incoming,
    /// File with the epochs of gateways, if there is a key.
    epochs: Option<Epochs>,
    capacity: CapacityReporter,
    pub(crate) report: Report<'a>,
    /// Time of arrival of the last datagram.
    last_arrival: WallTimestamp,
    /// Samples that were received.
    pub received: u64,
    /// Time at which the last sample was received.
    pub last_sample: Instant,
    /// Datagrams that arrived under a name that is not their own.
    pub foreign: u64,
    /// Buffer for samples that are sent in parts.
    reassembled: Vec<u8>,
    /// Error of reading the kept epochs, until it is reported.
    unreadable: Option<Failure>,
}

const OTHER_VERSION: &str =
    "datagrams of another version were refused: install the same version of scanhub on both machines";
const NEWER_TOPIC: &str = "samples of topics that this version does not know were left out: install the same version of \
                           scanhub on both machines";
const NO_ROOM: &str = "samples of remote sensors were not published, because these need more shared memory than --memory \
                       allows: use a greater --memory; if a machine invents sensors, use --key-file, or --hub to receive only \
                       those that it names";
const CLOCK_AHEAD: &str = "a gateway with the right key was refused because its clock is more than 5 s ahead of this \
                           machine's: synchronize the clocks";
const CLOCK_BEHIND: &str = "a gateway with the right key was refused because its clock is more than 5 s behind this \
                            machine's, or because recorded datagrams were sent again: synchronize the clocks";
/// Maximum number of problems that are reported. It is limited because a sender may cause ever new problems.
const MAX_REPORTED: usize = 16;

impl<'a> RemoteReceiver<'a> {
    /// Opens a receiver. Samples and counters are printed to `out`. Everything else is printed to `notes`, or to `out`
    /// with `json`.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Configuration`](scanhub_schema::Kind) if a name or hub is not valid or the memory is too small
    /// for a sensor, [`Kind::DomainHeld`](scanhub_schema::Kind) if another listener publishes in the domain, and
    /// [`Kind::ResourceExhausted`](scanhub_schema::Kind) if memory is short.
    pub fn open(
        config: ReceiverConfig<'_>,
        json: bool,
        classes: ClassNames,
        out: Output<'a>,
        notes: Output<'a>,
    ) -> Result<RemoteReceiver<'a>, Failure> {
        let names = Names::parse(config.names)?;
        let hubs = names.hubs(config.hubs)?;
        let open = |domain| {
            let publication = publish::open(domain, config.limits, config.memory)?;
            Ok::<_, Failure>(if config.only_proven { publication.only_proven() } else { publication })
        };
        let publication = config.publish.map(open).transpose()?;
        let key_name = config.key.as_ref().map(Key::name);
        let epochs = config.key.as_ref().map(|key| Epochs::of(key, config.state.clone()));
        let (known, unreadable) = match epochs.as_ref().map_or(Ok(HashMap::new()), Epochs::read) {
            Ok(known) => (known, None),
            Err(failure) => (HashMap::new(), Some(failure)),
        };
        let incoming = match config.key {
            Some(key) => Incoming::with_key(&config.announced_topics, key, known),
            None => Incoming::new(&config.announced_topics),
        };
        Ok(RemoteReceiver {
            topics: config.topics,
            is_stats: config.stats,
            publication,
            reported: Vec::new(),
            incoming: incoming.with_hubs(hubs),
            epochs,
            capacity: CapacityReporter::default(),
            report: Report::new(json, classes, out, notes, names, key_name),
            last_arrival: WallTimestamp::default(),
            received: 0,
            last_sample: Instant::now(),
            foreign: 0,
            reassembled: Vec::new(),
            unreadable,
        })
    }

    /// Reports what could not be read when the receiver was opened.
    ///
    /// # Errors
    ///
    /// Returns the reason why output cannot be written.
    pub fn begin(&mut self) -> Result<(), ExitReason> {
        self.unreadable.take().map_or(Ok(()), |failure| self.problem(&failure.to_string()))
    }

    /// Handles `bytes`, a whole datagram. Call [`wake`](RemoteReceiver::wake) when no more datagrams are waiting.
    ///
    /// # Errors
    ///
    /// Returns the reason why output cannot be written.
    pub fn handle_datagram(&mut self, bytes: &[u8], origin: Origin<'_>) -> Result<(), ExitReason> {
        self.last_arrival = origin.arrival;
        let mut whole = std::mem::take(&mut self.reassembled);
        let (name, sender) = (origin.name.as_ref(), origin.sender);
        let arrived = self.incoming.receive_named(bytes, name, sender, origin.arrival, &mut whole);
        let handled = self.handle(arrived, origin.address);
        self.reassembled = whole;
        handled?;
        // The file is written only once in each run of a gateway, because its epoch is new only once.
        match (self.incoming.take_epochs(), &self.epochs) {
            (Some(known), Some(epochs)) => {
                epochs.store(&known).or_else(|failure| self.problem(&failure.to_string()))
            }
            _ => Ok(()),
        }
    }

    /// Wakes the subscribers of the topics that were published.
    pub fn wake(&mut self) {
        if let Some(publication) = &mut self.publication {
            publication.wake();
        }
    }

    /// Does what is due regularly. `more` is true if further datagrams may be waiting.
    ///
    /// # Errors
    ///
    /// Returns the reason why output cannot be written.
    pub fn do_periodic_work(&mut self, now: Instant, more: bool) -> Result<(), ExitReason> {
        if let Some(publication) = &mut self.publication {
            let now = crate::now();
            publication.do_periodic_work(now.monotonic_ns, if more { self.last_arrival } else { now });
        }
        let (gateways, publication) = (self.incoming.gateways(), self.publication.as_ref());
        let so_far = Evictions {
            gateways: gateways.evicted().evicted_active,
            refused: gateways.refused(DatagramError::Capacity),
            sensors: publication.map_or(0, |publication| publication.evicted_active),
            samples: publication.map_or(0, |publication| publication.dropped.capacity),
        };
        self.capacity.check(so_far, now).map_or(Ok(()), |what| self.report.problem(&what))
    }

    /// Prints the counters. `others` are reasons for which datagrams were refused before they reached this receiver.
    ///
    /// # Errors
    ///
    /// Returns the reason why output cannot be written.
    pub fn report_counters(&mut self, others: &[(&'static str, u64)]) -> Result<(), ExitReason> {
        let gateways = self.incoming.gateways();
        self.report.stats(gateways, others)?;
        self.publication.iter().try_for_each(|publication| self.report.publication(publication, gateways))
    }

    /// Draws the counters on a terminal, over the previous ones.
    pub(crate) fn draw(&mut self) -> Result<(), ExitReason> {
        self.report.draw(self.incoming.gateways())
    }

    /// Reports a problem once. Only the first few problems are reported.
    ///
    /// # Errors
    ///
    /// Returns the reason why output cannot be written.
    pub fn problem(&mut self, what: &str) -> Result<(), ExitReason> {
        if self.reported.len() == MAX_REPORTED || self.reported.iter().any(|reported| reported == what) {
            return Ok(());
        }
        self.reported.push(what.to_owned());
        self.report.problem(what)
    }

    /// Handles the result of receiving a datagram.
    fn handle(&mut self, arrived: ReceiveOutcome<'_>, from: Option<IpAddr>) -> Result<(), ExitReason> {
        if let (Some(head), Some(publication)) = (arrived.begins(), &mut self.publication) {
            // A published run with the same number and epoch belongs to another gateway.
            publication.on_run_started(head, now());
        }
        match arrived {
            ReceiveOutcome::Sample(mut sample) => {
                sample.announced = sample.announced.map(|announce| announce.restricted_to(&self.topics));
                self.on_sample(&sample, from)
            }
            ReceiveOutcome::Announced(mut announcement) => {
                announcement.announce = announcement.announce.restricted_to(&self.topics);
                self.on_announcement(&announcement, from)
            }
            ReceiveOutcome::Refused { shared: Some(hub), .. } => {
                let what = duplicate_gateways(&self.report.names.of(hub));
                self.problem(&what)
            }
            ReceiveOutcome::Refused { reason: DatagramError::Version, .. } => self.problem(OTHER_VERSION),
            ReceiveOutcome::Refused { reason: DatagramError::Skipped, .. } => self.problem(NEWER_TOPIC),
            ReceiveOutcome::Untimely { behind_ns } => {
                self.problem(if behind_ns < 0 { CLOCK_AHEAD } else { CLOCK_BEHIND })
            }
            ReceiveOutcome::Foreign => {
                self.foreign += 1;
                Ok(())
            }
            ReceiveOutcome::Refused { .. }
            | ReceiveOutcome::Ignored
            | ReceiveOutcome::Part
            | ReceiveOutcome::Duplicate => Ok(()),
        }
    }

    /// Publishes or prints a new sample.
    fn on_sample(&mut self, sample: &RemoteSample<'_>, from: Option<IpAddr>) -> Result<(), ExitReason> {
        let RemoteSample { remote, missed, .. } = sample;
        let (head, topic) = (&remote.head, remote.topic);
        if !self.topics.contains(&topic) {
            return Ok(());
        }
        self.received += 1;
        self.last_sample = Instant::now();
        if let Some(publication) = &mut self.publication {
            let no_room = publication.dropped.no_room;
            let made = publication.sample(sample, || self.report.names.of(head.hub), now());
            if publication.dropped.no_room > no_room {
                self.incoming.count_no_room(head.hub);
                self.problem(NO_ROOM)?;
            }
            return self.report_publication(head, made, from);
        }
        if self.is_stats {
            return Ok(());
        }
        let sensor = &self.incoming.printed_name(head);
        if *missed > 0 {
            self.report.missed(head, sensor, topic, *missed)?;
        }
        self.report.sample(sensor, remote)
    }

    /// Handles an announcement that is newer than all others of its sensor.
    fn on_announcement(
        &mut self,
        announcement: &Announcement,
        from: Option<IpAddr>,
    ) -> Result<(), ExitReason> {
        let Announcement { head, announce, is_named, behind_ns, .. } = announcement;
        if *is_named {
            self.report.name_announced(head, announce.sensor())?;
        }
        if let Some(behind_ns) = behind_ns {
            self.report.clocks_differ(head, *behind_ns)?;
        }
        let Some(publication) = &mut self.publication else { return Ok(()) };
        let made = publication.on_announcement(announcement, &self.report.names.of(head.hub), now());
        self.report_publication(head, made, from)
    }

    /// Reports that the topics of the sensor that sent `head` were created just now, or why they could not be.
    fn report_publication(
        &mut self,
        head: &Head,
        made: Result<Option<String>, Failure>,
        from: Option<IpAddr>,
    ) -> Result<(), ExitReason> {
        match made {
            Ok(Some(name)) => self.report.published(head, &name, from.is_some_and(is_of_this_machine)),
            Ok(None) => Ok(()),
            Err(failure) => self.problem(&failure.to_string()),
        }
    }
}

/// Returns the report of two gateways that send as `hub`.
fn duplicate_gateways(hub: &str) -> String {
    format!(
        "two gateways send as {hub}, and what one of them sends is refused: was one machine made from a copy of the \
         other's disk? Remove the files gateway-* in the state directory of one of them \
         (~/.local/state/scanhub, or what XDG_STATE_HOME or its service says) and start its gateway again"
    )
}

/// Evictions since the start, and refusals because there was no room.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Evictions {
    /// Gateways that were evicted for others.
    gateways: u64,
    /// Datagrams that were refused because there was no room for their gateway or topic.
    refused: u64,
    /// Published sensors that were evicted for others.
    sensors: u64,
    /// Samples that were dropped because there was no room for their sensor.
    samples: u64,
}

/// Reporter of the number of evictions. It reports the first eviction at once, and then at most once a minute, because
/// a sender may cause a thousand evictions per second.
#[derive(Default)]
struct CapacityReporter {
    reported: Evictions,
    reported_at: Option<Instant>,
}

/// Minimum time between two reports of evictions.
const REPORT_INTERVAL: Duration = Duration::from_secs(60);

impl CapacityReporter {
    /// Returns the next report, if one is due.
    fn check(&mut self, so_far: Evictions, now: Instant) -> Option<String> {
        let is_recent = self.reported_at.is_some_and(|at| now - at < REPORT_INTERVAL);
        if so_far == self.reported || is_recent {
            return None;
        }
        let before = std::mem::replace(&mut self.reported, so_far);
        let parts = [
            (so_far.gateways - before.gateways, "gateways were evicted for others"),
            (so_far.refused - before.refused, "datagrams of others were refused"),
            (so_far.sensors - before.sensors, "published sensors were evicted for others"),
            (so_far.samples - before.samples, "samples of other sensors were not published"),
        ];
        let parts = parts.iter().filter(|(count, _)| *count > 0);
        let parts: Vec<_> = parts.map(|(count, what)| format!("{count} {what}")).collect();
        self.reported_at = Some(now);
        Some(format!(
            "more is sent than there is room for ({MAX_RUNS} gateways, {MAX_ROWS} of their sensors and topics; {MAX_SENSORS} \
             published sensors): {}; gateways that are known to deliver stay. If someone invents them, use --hub to receive \
             only those that it names",
            parts.join(", ")
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reports_at_once_and_then_once_a_minute() {
        let (mut capacity, start) = (CapacityReporter::default(), Instant::now());
        let mut reported = Vec::new();
        for n in 0..180_000_u64 {
            // Nothing happens in the second minute.
            let gateways = n.min(60_000) + n.saturating_sub(120_000);
            let so_far = Evictions { gateways, ..Evictions::default() };
            if let Some(line) = capacity.check(so_far, start + Duration::from_millis(n)) {
                assert!(line.contains(" gateways were evicted") && !line.contains("samples"), "{line}");
                reported.push(n);
            }
        }
        assert_eq!(reported, [1, 60_001, 120_001]);
    }
}
