//! A hub that is followed by what carries its samples away, over whatever network: its sensors as they come, its absence,
//! and which topics go out. Refuses to know where samples go.

mod account;
mod life;
mod machine;
mod selection;
mod sensor;

use std::num::NonZeroU64;
use std::path::Path;
use std::time::{Duration, Instant};

use crate::lan::outgoing::Sample;
use scanhub_client::clock;
use scanhub_client::streams::{GRACE, Session};
use scanhub_schema::{Failure, Topic, check_sensor};
use scanhub_shm::Domain;

pub use account::account;
pub use life::Life;
use scanhub_verbs::discovery::Discovery;
use scanhub_verbs::follow::Notice;
use scanhub_verbs::names::no_sensor;
use scanhub_verbs::output::{End, Output};
pub use selection::Selection;
use sensor::Sensor;

/// What carries samples away.
pub trait Carrier {
    /// Takes the sensor called `name`, of whose topics every so many samples go out; nothing: none do. Returns its position,
    /// by which it is named from now on.
    fn follow(&mut self, name: &str, every: &dyn Fn(Topic) -> Option<NonZeroU64>) -> usize;

    /// Returns whether samples of this topic are wanted.
    fn wants(&self, sensor: usize, topic: Topic) -> bool;

    /// Takes a sample of the sensor at this position.
    fn sample(&mut self, sensor: usize, sample: &Sample<'_>);
}

/// The hub of a domain, as long as it is there and whenever it is again.
pub struct Forwarder {
    selection: Selection,
    session: Session,
    sensors: Vec<Sensor>,
    started: Instant,
    discovery: Discovery,
    is_there: bool,
    /// More sensors that have to be there, whatever goes out of them.
    demanded: Vec<String>,
    /// The sensors that are named were found in a hub.
    is_checked: bool,
    waiting_said: bool,
}

impl Forwarder {
    /// Follows what is selected of the hub in the first live one of `places`.
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

    /// Says that the user named `sensor` for something else than what goes out: it has to be there, too.
    pub fn demand(&mut self, sensor: &str) {
        self.demanded.push(sensor.to_owned());
    }

    /// Hands on what waits of all sensors; returns whether there may be more.
    ///
    /// # Errors
    ///
    /// [`Kind::Short`](scanhub_schema::Kind) if descriptors or memory are.
    pub fn forward(&mut self, carrier: &mut impl Carrier) -> Result<bool, Failure> {
        let (mut more, mut subscribed) = (false, false);
        for sensor in &mut self.sensors {
            more |= sensor.forward(&mut self.session, carrier, &mut subscribed)?;
        }
        Ok(more)
    }

    /// Looks for news of the hub, which go to `tell`, and for the sensors of one that came. To be called after
    /// [`forward`](Forwarder::forward), as it takes longer.
    ///
    /// # Errors
    ///
    /// [`Kind::NoTopic`](scanhub_schema::Kind) if the first hub that is met has not all sensors that are named, and what `tell` says.
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
        // Somebody else may bring the sensors of other machines, which are not sent on.
        if change.back.is_some() && self.session.hub_lives() {
            if self.discovery.has_begun() || self.waiting_said {
                tell(Notice::HubBack)?;
            }
            self.is_there = true;
            self.discovery.begin(now);
        }
        if !self.discovery.has_begun() && !self.waiting_said && now - self.started >= GRACE {
            self.waiting_said = true;
            tell(Notice::NoHub(self.session.no_hub()))?;
        }
        Ok(self.discover(now, carrier)?)
    }

    /// Waits until there is something to hand on or to look at, and no longer than `at_most`.
    ///
    /// # Errors
    ///
    /// [`Kind::Failed`](scanhub_schema::Kind) if the system does not let it wait.
    pub fn wait(&mut self, at_most: Duration) -> Result<(), Failure> {
        let left = self.sensors.iter().filter_map(Sensor::left).chain(self.discovery.left());
        self.session.wait_for(Some(left.fold(at_most, Duration::min)))?;
        Ok(())
    }

    /// Returns whether the hub is there.
    pub fn is_there(&self) -> bool {
        self.is_there
    }

    /// Follows the sensors of the hub if all are wanted; those that are named have to be there in the first hub.
    fn discover(&mut self, now: Instant, carrier: &mut impl Carrier) -> Result<(), Failure> {
        let Some(domain) = self.session.domain().filter(|_| self.is_there) else { return Ok(()) };
        let Some(called) = self.discovery.call(domain, now)? else { return Ok(()) };
        if self.selection.wants_all() {
            for name in &called.sensors {
                // One that came from another machine has another name.
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

/// Tells a `notice` of the hub: a line of JSON to `out`, or text to `notes`.
///
/// # Errors
///
/// If it cannot be written.
pub fn tell(notice: Notice, json: bool, out: &mut Output<'_>, notes: &mut Output<'_>) -> Result<(), End> {
    notice.tell(&[], json, out, notes)
}

/// Begins a life of the gateway of `domain` by this `way`, as `Life::begin`, on this machine and now.
///
/// # Errors
///
/// As `Life::begin`, and if the environment names no place for its number.
pub fn begin_life(domain: &str, way: &str) -> Result<Life, Failure> {
    let now_s = clock::wall_ns() / 1_000_000_000;
    Life::begin(&life::directory()?, domain, way, now_s, machine::machine(Path::new(machine::ID)))
}
