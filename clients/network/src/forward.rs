//! Subscribes to the sensors of a hub and passes their samples to a network: sensors as they appear, the absence of the
//! hub, and the selection of topics.

mod selection;

use std::io::Write;
use std::num::NonZeroU64;
use std::time::{Duration, Instant};

use scanhub_client::streams::{GRACE, Sample, Session, Source};
use scanhub_schema::{Failure, Topic, check_sensor};
use scanhub_shm::Domain;
use scanhub_verbs::discovery::Discovery;
use scanhub_verbs::follow::Notice;
use scanhub_verbs::names::no_sensor;
use scanhub_verbs::output::{End, Output};
use serde::Serialize;

use crate::gateway_identity::Life;
use crate::lan::outgoing::{self, Outgoing, PayloadRef, Row};
pub use selection::Selection;

/// A network that takes samples.
pub trait Carrier {
    /// Adds the sensor called `name`. `every` is the thinning factor of each topic, or `None` if it is not sent.
    /// Returns the sensor's position.
    fn follow(&mut self, name: &str, every: &dyn Fn(Topic) -> Option<NonZeroU64>) -> usize;

    /// Returns whether samples of this topic are needed.
    fn wants(&self, sensor: usize, topic: Topic) -> bool;

    /// Sends a sample of the sensor at this position.
    fn sample(&mut self, sensor: usize, sample: &outgoing::Sample<'_>);
}

/// Subscriptions to the hub of a domain, which may exit and start again.
pub struct Forwarder {
    selection: Selection,
    session: Session,
    sensors: Vec<Sensor>,
    started: Instant,
    discovery: Discovery,
    is_there: bool,
    /// Further sensors that must exist, even if nothing of them is sent.
    demanded: Vec<String>,
    /// Whether the named sensors were found in a hub.
    is_checked: bool,
    waiting_said: bool,
}

impl Forwarder {
    /// Subscribes to the selected topics of the hub in the first live one of `places`.
    pub fn new(selection: Selection, places: &[Domain], carrier: &mut impl Carrier) -> Forwarder {
        let named = selection.named().into_iter().map(|name| {
            let maker = selection.maker_of(name);
            Sensor::new(name, |topic| topic.maker() == maker, &selection, carrier)
        });
        let sensors = named.collect();
        Forwarder {
            sensors,
            selection,
            session: Session::new(places.to_vec()),
            started: Instant::now(),
            discovery: Discovery::default(),
            is_there: false,
            demanded: Vec::new(),
            is_checked: false,
            waiting_said: false,
        }
    }

    /// Requires that `sensor` exists, which the user named for another purpose.
    pub fn demand(&mut self, sensor: &str) {
        self.demanded.push(sensor.to_owned());
    }

    /// Passes waiting samples of all sensors to `carrier`. Returns whether there may be more.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Short`](scanhub_schema::Kind) if descriptors or memory are short.
    pub fn forward(&mut self, carrier: &mut impl Carrier) -> Result<bool, Failure> {
        let (mut more, mut subscribed) = (false, false);
        for sensor in &mut self.sensors {
            more |= sensor.forward(&mut self.session, carrier, &mut subscribed)?;
        }
        Ok(more)
    }

    /// Checks whether the hub has exited or started, which it reports to `tell`, and searches the sensors of a new one.
    /// Call it after [`forward`](Forwarder::forward), because it takes longer.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::NoTopic`](scanhub_schema::Kind) if the first hub lacks a named sensor, and the errors of `tell`.
    pub fn look(
        &mut self,
        now: Instant,
        carrier: &mut impl Carrier,
        tell: &mut impl FnMut(Notice) -> Result<(), End>,
    ) -> Result<(), End> {
        let change = self.session.look()?;
        if change.gone.is_some() && self.is_there {
            self.is_there = false;
            self.discovery.end();
            tell(Notice::HubGone)?;
        }
        // Another process may publish sensors of other machines, which are not sent again.
        if change.back.is_some() && self.session.hub_lives() {
            if self.discovery.has_begun() || self.waiting_said {
                tell(Notice::HubBack)?;
            }
            self.is_there = true;
            self.discovery.begin(now);
        }
        if !self.discovery.has_begun() && !self.waiting_said && now - self.started >= GRACE {
            self.waiting_said = true;
            tell(Notice::NoHub(self.session.no_hub().into()))?;
        }
        Ok(self.discover(now, carrier)?)
    }

    /// Waits for a sample or an event, but no longer than `at_most`.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Failed`](scanhub_schema::Kind) if the system cannot wait.
    pub fn wait(&mut self, at_most: Duration) -> Result<(), Failure> {
        let left = self.sensors.iter().filter_map(Sensor::left).chain(self.discovery.left());
        self.session.wait_for(Some(left.fold(at_most, Duration::min)))?;
        Ok(())
    }

    /// Returns whether the hub is running.
    pub fn is_there(&self) -> bool {
        self.is_there
    }

    /// Subscribes to new sensors of the hub if all are selected. The first hub must have all named sensors.
    fn discover(&mut self, now: Instant, carrier: &mut impl Carrier) -> Result<(), Failure> {
        let Some(domain) = self.session.domain().filter(|_| self.is_there) else { return Ok(()) };
        let Some(called) = self.discovery.call(domain, now)? else { return Ok(()) };
        if self.selection.wants_all() {
            for name in &called.sensors {
                // The name of a remote sensor has another form.
                let is_known = self.sensors.iter().any(|sensor| sensor.name == *name);
                if !is_known && check_sensor(name).is_ok() {
                    let may_have = |topic| called.may_have(name, topic);
                    self.sensors.push(Sensor::new(name, may_have, &self.selection, carrier));
                }
            }
        }
        if !self.is_checked && called.age >= GRACE && !self.session.hub_is_starting() {
            let is_there = |name: &&str| called.sensors.iter().any(|it| it == name);
            let demanded = self.demanded.iter().map(String::as_str);
            if let Some(name) =
                self.selection.named().into_iter().chain(demanded).find(|name| !is_there(name))
            {
                return Err(no_sensor(name, &called.sensors));
            }
            self.is_checked = true;
        }
        Ok(())
    }
}

/// Reports a `notice` of the hub: a line of JSON to `out`, or text to `notes`.
///
/// # Errors
///
/// Returns the reason why output cannot be written.
pub fn tell(notice: Notice, json: bool, out: &mut Output<'_>, notes: &mut Output<'_>) -> Result<(), End> {
    notice.tell(&[], json, out, notes)
}

/// A subscribed sensor.
struct Sensor {
    name: String,
    /// Position at the carrier.
    position: usize,
    sources: Vec<Source>,
}

/// Samples that are taken from one topic before the next one has its turn.
const BATCH_SIZE: usize = 32;

impl Sensor {
    /// Creates subscriptions to the selected topics that the sensor `may_have`, and to its status if it is announced
    /// with its type.
    fn new(
        name: &str,
        may_have: impl Fn(Topic) -> bool,
        selection: &Selection,
        carrier: &mut impl Carrier,
    ) -> Sensor {
        let every = |topic| selection.every(name, topic).filter(|_| may_have(topic));
        let position = carrier.follow(name, &every);
        let wanted =
            Topic::ALL.into_iter().filter(|topic| may_have(*topic) && carrier.wants(position, *topic));
        let sources = wanted.map(|topic| Source::new(name, topic)).collect();
        Sensor { name: name.to_owned(), position, sources }
    }

    /// Passes waiting samples to `carrier`, and returns whether there may be more. Attaches at most one subscriber in
    /// each round over all sensors, see `subscribed`, because that takes a thousand times as long as sending.
    ///
    /// # Errors
    ///
    /// Returns the same errors as [`Source::receive`].
    fn forward(
        &mut self,
        session: &mut Session,
        carrier: &mut impl Carrier,
        subscribed: &mut bool,
    ) -> Result<bool, Failure> {
        let mut more = false;
        for source in &mut self.sources {
            let is_new = !source.subscribed();
            if is_new && *subscribed {
                more = true;
                continue;
            }
            for turn in 0..BATCH_SIZE {
                let Some(sample) = source.receive(session)? else { break };
                more |= turn + 1 == BATCH_SIZE;
                carrier.sample(self.position, &borrowed(&sample));
            }
            *subscribed |= is_new && source.subscribed();
        }
        Ok(more)
    }

    /// Returns the time after which there may be a sample to send although the hub sends nothing.
    fn left(&self) -> Option<Duration> {
        self.sources.iter().filter_map(Source::left).min()
    }
}

/// Generates access to the payload of a sample from the table of topics.
macro_rules! payloads {
    ($($topic:ident $payload:tt, $name:ident, $($column:tt),*: $about:literal;)*) => {
        fn payload(sample: &Sample) -> PayloadRef<'_> {
            match sample {
                $(Sample::$topic(sample) => PayloadRef::$topic(payloads!($topic sample)),)*
                Sample::Robot(sample) => PayloadRef::Zones(&sample.heard.zones),
            }
        }
    };
    // Samples of zones have their age in addition.
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

/// Prints the counters of `outgoing` in this run: lines of JSON of this `class`, or text.
///
/// # Errors
///
/// Returns the reason why output cannot be written.
pub fn account(
    outgoing: &Outgoing,
    life: &Life,
    class: &'static str,
    json: bool,
    out: &mut Output<'_>,
) -> Result<(), End> {
    let hub = format!("{:016x}", life.hub);
    for sensor in outgoing.account() {
        for (topic, row) in sensor.used() {
            let topic = topic.map_or("announce", Topic::name);
            let Row { sent, failed, bytes, missed, .. } = *row;
            let replaced = outgoing.tells_replaced().then_some(row.replaced);
            if json {
                let (hub, epoch, sensor) = (&hub, life.epoch, &sensor.name);
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

/// Class `lan` or `bridge` of a sender.
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
