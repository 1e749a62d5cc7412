//! Forwards a hub's samples to a network. The forwarder subscribes to the selected topics of each sensor when the
//! sensor appears. It continues after the hub has exited and started again.

mod selection;

use std::io::Write;
use std::num::NonZeroU64;
use std::time::{Duration, Instant};

use scanhub_client::streams::{STARTUP_GRACE, Sample, Session, Source};
use scanhub_schema::{Failure, Topic, check_sensor};
use scanhub_shm::Domain;
use scanhub_verbs::discovery::Discovery;
use scanhub_verbs::follow::Notice;
use scanhub_verbs::names::no_sensor;
use scanhub_verbs::output::{ExitReason, Output};
use serde::Serialize;

use crate::gateway_identity::GatewayIdentity;
use crate::lan::outgoing::{self, Outgoing, PayloadRef, TopicStats};
pub use selection::Selection;

/// A network that takes samples.
pub trait SampleSink {
    /// Adds the sensor called `name`. `every` returns the thinning factor of a topic, or `None` if the topic is not
    /// sent. Returns the sensor's position in the sink, which identifies the sensor from now on.
    fn follow(&mut self, name: &str, every: &dyn Fn(Topic) -> Option<NonZeroU64>) -> usize;

    /// Returns whether the sink needs samples of `topic` from the sensor at position `sensor`.
    fn needs(&self, sensor: usize, topic: Topic) -> bool;

    /// Sends a sample of the sensor at position `sensor`.
    fn sample(&mut self, sensor: usize, sample: &outgoing::Sample<'_>);
}

/// Subscriptions to the hub of a domain. The hub may exit and start again.
pub struct Forwarder {
    selection: Selection,
    session: Session,
    sensors: Vec<Sensor>,
    started: Instant,
    discovery: Discovery,
    is_hub_running: bool,
    /// Further sensors that the hub must have, even if none of their topics is sent.
    required: Vec<String>,
    /// Whether a hub was found to have all named and required sensors.
    is_checked: bool,
    is_waiting_reported: bool,
}

impl Forwarder {
    /// Subscribes to the selected topics of the hub in the first one of `locations` at which a hub runs.
    pub fn new(selection: Selection, locations: &[Domain], sink: &mut impl SampleSink) -> Forwarder {
        let named = selection.named_sensors().into_iter().map(|name| {
            let publisher_kind = selection.publisher_kind(name);
            Sensor::new(name, |topic| topic.publisher_kind() == publisher_kind, &selection, sink)
        });
        let sensors = named.collect();
        Forwarder {
            sensors,
            selection,
            session: Session::new(locations.to_vec()),
            started: Instant::now(),
            discovery: Discovery::default(),
            is_hub_running: false,
            required: Vec::new(),
            is_checked: false,
            is_waiting_reported: false,
        }
    }

    /// Requires that the first hub has `sensor`, which the user named for a purpose other than sending its topics.
    pub fn require(&mut self, sensor: &str) {
        self.required.push(sensor.to_owned());
    }

    /// Passes waiting samples of all sensors to `sink`. Returns whether more may wait.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::ResourceExhausted`](scanhub_schema::Kind) if descriptors or memory are short.
    pub fn forward(&mut self, sink: &mut impl SampleSink) -> Result<bool, Failure> {
        let (mut more, mut subscribed) = (false, false);
        for sensor in &mut self.sensors {
            more |= sensor.forward(&mut self.session, sink, &mut subscribed)?;
        }
        Ok(more)
    }

    /// Checks whether the hub has exited or started, passes each change to `report`, and searches for the sensors of a
    /// new hub. Call this method after [`forward`](Forwarder::forward), because it takes longer and would delay waiting
    /// samples.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::NoTopic`](scanhub_schema::Kind) if the first hub lacks a named sensor, and the errors of
    /// `report`.
    pub fn check_hub(
        &mut self,
        now: Instant,
        sink: &mut impl SampleSink,
        report: &mut impl FnMut(Notice) -> Result<(), ExitReason>,
    ) -> Result<(), ExitReason> {
        let change = self.session.check_hub()?;
        if change.ended.is_some() && self.is_hub_running {
            self.is_hub_running = false;
            self.discovery.on_hub_ended();
            report(Notice::HubGone)?;
        }
        // Without a hub, a listener has started. The remote sensors that it publishes are not sent to a network again.
        if change.started.is_some() && self.session.hub_is_running() {
            if self.discovery.has_seen_hub() || self.is_waiting_reported {
                report(Notice::HubBack)?;
            }
            self.is_hub_running = true;
            self.discovery.on_hub_started(now);
        }
        if !self.discovery.has_seen_hub() && !self.is_waiting_reported && now - self.started >= STARTUP_GRACE
        {
            self.is_waiting_reported = true;
            report(Notice::NoHub(self.session.no_hub().into()))?;
        }
        Ok(self.discover(now, sink)?)
    }

    /// Waits for a sample or an event, but no longer than `at_most`.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Failed`](scanhub_schema::Kind) if the system cannot wait.
    pub fn wait(&mut self, at_most: Duration) -> Result<(), Failure> {
        let left = self.sensors.iter().filter_map(Sensor::time_left).chain(self.discovery.time_left());
        self.session.wait_for(Some(left.fold(at_most, Duration::min)))?;
        Ok(())
    }

    /// Returns whether the hub is running.
    pub fn is_hub_running(&self) -> bool {
        self.is_hub_running
    }

    /// Subscribes to new sensors of the hub, if the selection includes sensors that are not named. Returns an error if
    /// the first hub lacks a named or required sensor.
    fn discover(&mut self, now: Instant, carrier: &mut impl SampleSink) -> Result<(), Failure> {
        let Some(domain) = self.session.domain().filter(|_| self.is_hub_running) else { return Ok(()) };
        let Some(called) = self.discovery.poll(domain, now)? else { return Ok(()) };
        if self.selection.includes_unnamed() {
            for name in &called.sensors {
                // `check_sensor` rejects the names of remote sensors, which are not sent.
                let is_known = self.sensors.iter().any(|sensor| sensor.name == *name);
                if !is_known && check_sensor(name).is_ok() {
                    let may_have = |topic| called.may_have(name, topic);
                    self.sensors.push(Sensor::new(name, may_have, &self.selection, carrier));
                }
            }
        }
        if !self.is_checked && called.age >= STARTUP_GRACE && !self.session.hub_is_starting() {
            let is_there = |name: &&str| called.sensors.iter().any(|it| it == name);
            let demanded = self.required.iter().map(String::as_str);
            if let Some(name) =
                self.selection.named_sensors().into_iter().chain(demanded).find(|name| !is_there(name))
            {
                return Err(no_sensor(name, &called.sensors));
            }
            self.is_checked = true;
        }
        Ok(())
    }
}

/// Reports a `notice` about the hub: as a line of JSON to `out` if `json` is set, otherwise as text to `notes`.
///
/// # Errors
///
/// Returns the reason why output cannot be written.
pub fn report_notice(
    notice: Notice,
    json: bool,
    out: &mut Output<'_>,
    notes: &mut Output<'_>,
) -> Result<(), ExitReason> {
    notice.report(&[], json, out, notes)
}

/// A subscribed sensor.
struct Sensor {
    name: String,
    /// Position in the sink.
    position: usize,
    sources: Vec<Source>,
}

/// Maximum number of samples that are taken from one topic before the next topic is read.
const BATCH_SIZE: usize = 32;

impl Sensor {
    /// Creates subscriptions to the selected topics that the sensor `may_have`. Also subscribes to the sensor's status
    /// if the sink announces sensors, because announcements contain the type from the status.
    fn new(
        name: &str,
        may_have: impl Fn(Topic) -> bool,
        selection: &Selection,
        sink: &mut impl SampleSink,
    ) -> Sensor {
        let every = |topic| selection.every(name, topic).filter(|_| may_have(topic));
        let position = sink.follow(name, &every);
        let needed = Topic::ALL.into_iter().filter(|topic| may_have(*topic) && sink.needs(position, *topic));
        let sources = needed.map(|topic| Source::new(name, topic)).collect();
        Sensor { name: name.to_owned(), position, sources }
    }

    /// Passes waiting samples to `sink`, and returns whether more may wait. Sets `subscribed` after attaching a
    /// subscriber, and attaches none if it is already set. [`Forwarder::forward`] therefore attaches at most one
    /// subscriber per call, because attaching takes a thousand times as long as sending.
    ///
    /// # Errors
    ///
    /// Returns the same errors as [`Source::receive`].
    fn forward(
        &mut self,
        session: &mut Session,
        sink: &mut impl SampleSink,
        subscribed: &mut bool,
    ) -> Result<bool, Failure> {
        let mut more = false;
        for source in &mut self.sources {
            let is_new = !source.subscribed();
            if is_new && *subscribed {
                more = true;
                continue;
            }
            for taken in 0..BATCH_SIZE {
                let Some(sample) = source.receive(session)? else { break };
                more |= taken + 1 == BATCH_SIZE;
                sink.sample(self.position, &borrowed(&sample));
            }
            *subscribed |= is_new && source.subscribed();
        }
        Ok(more)
    }

    /// Returns the time after which the sensor may have a sample to send even if the hub publishes nothing, such as a
    /// verdict that becomes unknown. `None` if there is no such time.
    fn time_left(&self) -> Option<Duration> {
        self.sources.iter().filter_map(Source::time_left).min()
    }
}

/// Generates access to the payload of a sample from the table of topics.
macro_rules! payloads {
    ($($topic:ident $payload:tt, $name:ident, $($column:tt),*: $about:literal;)*) => {
        fn payload(sample: &Sample) -> PayloadRef<'_> {
            match sample {
                $(Sample::$topic(sample) => PayloadRef::$topic(payloads!($topic sample)),)*
                Sample::Robot(sample) => PayloadRef::Zones(&sample.update.zones),
            }
        }
    };
    // A sample of `zones` also contains its age, so the payload is one of its fields.
    (Zones $sample:ident) => {
        &$sample.zones
    };
    ($topic:ident $sample:ident) => {
        $sample
    };
}

scanhub_schema::for_each_topic!(payloads);

fn borrowed(sample: &Sample) -> outgoing::Sample<'_> {
    outgoing::Sample { header: sample.header(), missed: sample.missed(), payload: payload(sample) }
}

/// Prints the counters of `outgoing` since the start of the run: as lines of JSON of class `class` if `json` is set,
/// otherwise as text.
///
/// # Errors
///
/// Returns the reason why output cannot be written.
pub fn write_counters(
    outgoing: &Outgoing,
    identity: &GatewayIdentity,
    class: &'static str,
    json: bool,
    out: &mut Output<'_>,
) -> Result<(), ExitReason> {
    let hub = format!("{:016x}", identity.hub);
    for sensor in outgoing.counters() {
        for (topic, row) in sensor.used_topics() {
            let topic = topic.map_or("announce", Topic::name);
            let TopicStats { sent, failed, bytes, missed, .. } = *row;
            let replaced = outgoing.announces_replaced().then_some(row.replaced);
            if json {
                let (hub, epoch, sensor) = (&hub, identity.epoch, &sensor.name);
                let send_failed = failed;
                out.json(&SentLine {
                    class,
                    hub,
                    epoch,
                    sensor,
                    topic,
                    sent,
                    send_failed,
                    bytes,
                    missed,
                    replaced,
                })?;
                continue;
            }
            out.line(|line| {
                write!(line, "{}/{topic}: {sent} sent, ", sensor.name)?;
                replaced.map_or(Ok(()), |replaced| write!(line, "{replaced} replaced, "))?;
                write!(line, "{failed} failed, {bytes} bytes")?;
                if missed > 0 { write!(line, ", {missed} missed") } else { Ok(()) }
            })?;
        }
    }
    Ok(())
}

/// JSON line with the counters of one topic. Its class is `lan` for a gateway and `bridge` for a bridge.
#[derive(Serialize)]
struct SentLine<'a> {
    class: &'static str,
    hub: &'a str,
    epoch: u32,
    sensor: &'a str,
    topic: &'static str,
    sent: u64,
    send_failed: u64,
    bytes: u64,
    missed: u64,
    #[serde(skip_serializing_if = "Option::is_none")]
    replaced: Option<u64>,
}
