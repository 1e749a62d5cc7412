//! Receives the topics of a verb: [`Following`] returns what arrives, one [`Event`] after the other, until the bounds are reached.

use std::collections::VecDeque;
use std::rc::Rc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use scanhub_client::streams::{Follower, GRACE, Sample, Session, Source, Who};
use scanhub_client::{Wait, clock};
use scanhub_schema::{Failure, Kind, Status, Topic, is_remote};
use scanhub_shm::Domain;

use crate::discovery::Discovery;
use crate::names::{TopicName, no_sensor, no_such_topic};
use crate::output::{End, Output};
pub use crate::receive_stats::ReceiveStats;
use crate::receive_stats::{Line, Loss};
use crate::{json, text};

/// Limits after which a verb ends by itself: arguments of every verb that follows topics.
#[derive(clap::Args, Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Bounds {
    /// Stop after this number of samples
    #[arg(short = 'n', value_name = "COUNT", value_parser = clap::value_parser!(u64).range(1..))]
    pub count: Option<u64>,
    /// Stop after this time, for example 10s, 250ms, 5m
    #[arg(long = "for", value_name = "DURATION", value_parser = crate::duration::parse)]
    pub run_for: Option<Duration>,
    /// Exit with 3 after this time without a sample
    #[arg(long, value_name = "DURATION", value_parser = crate::duration::parse)]
    pub timeout: Option<Duration>,
}

impl Bounds {
    /// Returns whether the run ends by itself. Then it fails if there is no hub at its start, or if it is interrupted.
    pub fn bounded(&self) -> bool {
        self.count.is_some() || self.run_for.is_some()
    }
}

/// An event of a run that follows topics.
#[expect(
    clippy::large_enum_variant,
    reason = "nearly every event is a sample, which a box would only slow down"
)]
pub enum Event {
    /// The run follows this topic from now on.
    Begun(Rc<TopicName>),
    /// The hub has the topic. The run receives what is sent from now on.
    Subscribed(Rc<TopicName>),
    /// A sample, or one that stands for a silence and does not count. Drop it before the next event.
    Sample(Rc<TopicName>, Sample, Arrival),
    /// Something went wrong, or right again, in these topics. If there are none, nothing is known of the topics yet.
    Notice(Vec<Rc<TopicName>>, Notice),
    /// The run cannot follow this topic for lack of memory, descriptors or places, and will try again
    /// ([`Following::despite_shortage`]).
    Short(Rc<TopicName>, Failure),
    /// A status of a sensor ([`Following::with_lines`]).
    Line(String, Box<Status>),
    /// Comes after each round of samples, and about ten times a second if there are none.
    Tick(Instant),
}

/// Time at which this process received a sample.
#[derive(Clone, Copy, Debug, Default)]
pub struct Arrival {
    /// CLOCK_MONOTONIC, in ns.
    pub monotonic_ns: u64,
    /// The wall clock, in ns since 1970.
    pub wall_ns: u64,
}

/// A problem of a stream, or its end.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Notice {
    /// Number of samples that were sent and not received.
    Missed(u64),
    /// The topic has been silent for longer than its samples are apart.
    Stale,
    /// No hub runs in the domain when the verb starts, so the verb waits for one. The failure names the places that were
    /// searched, and the hubs of other users.
    NoHub(Failure),
    /// The hub of the domain has ended.
    HubGone,
    /// A hub runs in the domain again.
    HubBack,
}

impl Notice {
    /// Writes the notice for `names`, or for the domain if `names` is empty: lines of JSON to `out`, or text to `notes`.
    pub fn tell(
        &self,
        names: &[Rc<TopicName>],
        is_json: bool,
        out: &mut Output<'_>,
        notes: &mut Output<'_>,
    ) -> Result<(), End> {
        match is_json {
            true => json::notices(out, names, self),
            false => notes.line(|line| text::notice(line, names, self)),
        }
    }
}

/// The topics that a verb follows, in the first of several domains in which a hub runs.
pub struct Following<'a> {
    session: Session,
    topics: Vec<Followed>,
    /// The lines of the followed sensors, for a run with lines.
    lines: Option<Vec<FollowedLine>>,
    /// Number of `topics` whose lines are followed.
    topics_with_line: usize,
    /// Which topics of each sensor of the hub the run follows.
    of_all_sensors: &'a [Topic],
    unwanted: Vec<Topic>,
    discovery: Discovery,
    /// Whether the run receives samples before it looks for the hub.
    closely: bool,
    despite_shortage: bool,
    bounds: &'a Bounds,
    stop: &'a AtomicBool,
    stage: Stage,
    round: Round,
    events: VecDeque<Event>,
    /// Result of a run that has ended. `next` returns it after all `events`.
    end: Option<Result<(), End>>,
    started: Instant,
    last_sample: Instant,
    hub_seen: Option<Instant>,
    /// Time at which the run first saw a hub, and not only a listener.
    hub_lives_since: Option<Instant>,
    /// When the run looked last which sensors there are.
    asked_at: Option<Instant>,
    waiting_said: bool,
    received: u64,
    /// End of the pause in which the run subscribes to no topic, because memory, descriptors or places are short.
    short_until: Option<Instant>,
}

/// The next step of a run.
#[derive(Clone, Copy, PartialEq)]
enum Stage {
    Start,
    Look,
    Receive,
    AfterRound,
    Check,
    Wait,
}

/// Progress of a round over all topics.
#[derive(Default)]
struct Round {
    /// The topic that has its turn.
    topic: usize,
    /// Number of samples that it gave.
    taken: usize,
    /// The round has subscribed to a topic.
    subscribed: bool,
    /// Samples may be waiting after this round.
    more: bool,
}

impl Round {
    fn next_topic(&mut self) {
        self.topic += 1;
        self.taken = 0;
    }
}

/// A topic of a sensor.
struct Followed {
    name: Rc<TopicName>,
    source: Source,
    stats: ReceiveStats,
    /// CLOCK_MONOTONIC since when samples are received as they are sent, in ns.
    since_ns: u64,
}

/// The serial line of a sensor. Bounds do not count its statuses, and the run does not fail without them.
struct FollowedLine {
    sensor: String,
    /// `None` if its statuses cannot be received.
    source: Option<Follower<Status>>,
    line: Line,
}

/// Samples taken from one topic before the next one has its turn.
const TURN: usize = 32;
/// Time in which a listener announces the sensors of other machines. It announces them once a second.
const ANNOUNCED: Duration = Duration::from_secs(3);
/// Interval at which the run lists the sensors while one is missing. A look takes milliseconds, in which samples wait.
const ASK_EVERY: Duration = Duration::from_millis(500);
/// Pause after a shortage, in which the run subscribes to no topic: a try takes as long as receiving a thousand samples.
const SHORTAGE_PAUSE: Duration = Duration::from_secs(1);

impl<'a> Following<'a> {
    /// Makes a run that follows `names`, and the topics `of_all` of each sensor that the hub has, in the first live one of `places`,
    /// until `bounds` are reached or `stop` is set.
    pub fn new(
        names: &[TopicName],
        of_all: &'a [Topic],
        places: &[Domain],
        bounds: &'a Bounds,
        stop: &'a AtomicBool,
    ) -> Following<'a> {
        let now = Instant::now();
        let topics: Vec<_> = names.iter().map(|name| Followed::new(Rc::new(name.clone()))).collect();
        Following {
            session: Session::new(places.to_vec()),
            events: topics.iter().map(|topic| Event::Begun(topic.name.clone())).collect(),
            topics,
            lines: None,
            topics_with_line: 0,
            of_all_sensors: of_all,
            unwanted: Vec::new(),
            discovery: Discovery::default(),
            closely: false,
            despite_shortage: false,
            bounds,
            stop,
            stage: Stage::Start,
            round: Round::default(),
            end: None,
            started: now,
            last_sample: now,
            hub_seen: None,
            hub_lives_since: None,
            asked_at: None,
            waiting_said: false,
            received: 0,
            short_until: None,
        }
    }

    /// Follows the statuses of the sensors, too. They count the losses on the serial lines.
    pub fn with_lines(self) -> Following<'a> {
        Following { lines: Some(Vec::new()), ..self }
    }

    /// Receives zones with the early warnings of their sensors.
    pub fn with_early(mut self) -> Following<'a> {
        for topic in self.topics.iter_mut().filter(|topic| topic.name.topic == Topic::Zones) {
            topic.source = Source::zones_with_early(&topic.name.sensor);
        }
        self
    }

    /// Is woken by `wait`, for the shortest latency: the run receives before it looks for the hub, which takes longer.
    pub fn closely(self, wait: Wait) -> Following<'a> {
        Following { session: self.session.by(wait), closely: true, ..self }
    }

    /// Goes on if it cannot follow a topic for lack of memory, descriptors or places, with [`Event::Short`]. Otherwise, the run
    /// fails.
    pub fn despite_shortage(self) -> Following<'a> {
        Following { despite_shortage: true, ..self }
    }

    /// Subscribes to `topic` again, or ends its subscriptions until it is wanted again.
    pub fn want(&mut self, topic: Topic, is_wanted: bool) {
        self.unwanted.retain(|unwanted| *unwanted != topic);
        if !is_wanted {
            self.unwanted.push(topic);
        }
    }

    /// Returns whether the run has received all samples that waited before the last [`Event::Tick`].
    pub fn is_caught_up(&self) -> bool {
        !self.round.more
    }

    /// Waits for the next event, and returns it; `None` after the last one. At `wake_at` there is a [`Event::Tick`], whatever comes.
    ///
    /// # Errors
    ///
    /// [`Kind::NoTopic`] with the names of the sensors; [`Kind::NoHub`] if the run is bounded and no hub runs at its start;
    /// [`Kind::Timeout`]; [`Kind::Interrupted`] if it is bounded and was stopped before; [`Kind::Short`].
    pub fn next(&mut self, wake_at: Option<Instant>) -> Result<Option<Event>, End> {
        loop {
            if let Some(event) = self.events.pop_front() {
                return Ok(Some(event));
            }
            if let Some(end) = self.end.take() {
                return end.map(|()| None);
            }
            if let Err(failure) = self.step(wake_at) {
                self.end = Some(Err(failure));
            }
        }
    }

    /// Writes a `summary` of each topic at the end of the run, unless the reader of the output has closed it. `end` is the result
    /// of the run.
    ///
    /// # Errors
    ///
    /// Those of `summary`, or else `end`.
    pub fn finish(
        mut self,
        end: Result<(), End>,
        mut summary: impl FnMut(&TopicName, &ReceiveStats) -> Result<(), End>,
    ) -> Result<(), End> {
        if !matches!(end, Err(End::ReaderGone)) {
            self.receive_lines();
            for topic in &self.topics {
                let mut stats = topic.stats.clone();
                stats.loss = self.loss(&topic.name.sensor);
                summary(&topic.name, &stats)?;
            }
        }
        end
    }

    fn step(&mut self, wake_at: Option<Instant>) -> Result<(), End> {
        self.stage = match self.stage {
            Stage::Start => {
                self.look()?;
                Stage::Look
            }
            Stage::Look => {
                if !self.closely {
                    self.look()?;
                }
                self.round = Round::default();
                Stage::Receive
            }
            Stage::Receive if self.round.topic < self.topics.len() => {
                self.receive()?;
                Stage::Receive
            }
            Stage::Receive => {
                self.events.push_back(Event::Tick(Instant::now()));
                Stage::AfterRound
            }
            Stage::AfterRound => {
                let is_stopped = self.stop.load(Ordering::Relaxed);
                let is_in_time = self.bounds.run_for.is_none_or(|limit| self.started.elapsed() < limit);
                if self.round.more && !is_stopped && is_in_time {
                    self.round = Round::default();
                    Stage::Receive
                } else {
                    Stage::Check
                }
            }
            Stage::Check => {
                self.check()?;
                Stage::Wait
            }
            Stage::Wait => {
                self.session.wait(self.wake_at().into_iter().chain(wake_at).min())?;
                Stage::Look
            }
        };
        Ok(())
    }

    /// Looks for news of the hub, and for the sensors of a new one.
    fn look(&mut self) -> Result<(), End> {
        let change = self.session.look()?;
        if let Some(who) = change.gone {
            self.discovery.end();
            self.notice(Notice::HubGone, |name| is_of(name, who));
        }
        if let Some(who) = change.back {
            if self.hub_seen.is_some() || self.waiting_said {
                self.notice(Notice::HubBack, |name| is_of(name, who));
            }
            self.hub_seen = Some(Instant::now());
            // Samples that the new hub sent before this moment waited for the run, and arrive late.
            let now_ns = clock::now_ns();
            for topic in self.topics.iter_mut().filter(|topic| topic.source.subscribed()) {
                topic.since_ns = now_ns;
            }
            self.discovery.begin(Instant::now());
        }
        self.discover()
    }

    /// Follows the sensors of the hub that are not followed yet, if the run follows all.
    fn discover(&mut self) -> Result<(), End> {
        let Some(domain) = self.session.domain().filter(|_| !self.of_all_sensors.is_empty()) else {
            return Ok(());
        };
        let called = match self.discovery.call(domain, Instant::now()) {
            Err(failure) if failure.kind == Kind::Short && self.despite_shortage => return Ok(()),
            called => called?,
        };
        let Some(called) = called else { return Ok(()) };
        for sensor in &called.sensors {
            for &topic in self.of_all_sensors.iter().filter(|topic| called.may_have(sensor, **topic)) {
                let name = TopicName { sensor: sensor.clone(), topic };
                if self.topics.iter().all(|topic| *topic.name != name) {
                    let name = Rc::new(name);
                    self.events.push_back(Event::Begun(name.clone()));
                    self.topics.push(Followed::new(name));
                }
            }
        }
        Ok(())
    }

    /// Receives one sample of the topic that has its turn, or ends its turn.
    fn receive(&mut self) -> Result<(), End> {
        let is_short = self.is_short();
        let round = &mut self.round;
        let topic = &mut self.topics[round.topic];
        let was_subscribed = topic.source.subscribed();
        if self.unwanted.contains(&topic.name.topic) {
            topic.unsubscribe();
            round.next_topic();
            return Ok(());
        }
        // Subscribing takes a thousand times as long as receiving: samples of other topics come before the next subscription.
        if !was_subscribed && (round.subscribed || is_short) {
            round.more |= round.subscribed;
            round.next_topic();
            return Ok(());
        }
        let received = match topic.source.receive(&mut self.session).map_err(Failure::from) {
            Err(failure) if failure.kind == Kind::Short && self.despite_shortage => {
                self.short_until = Some(Instant::now() + SHORTAGE_PAUSE);
                self.events.push_back(Event::Short(topic.name.clone(), failure));
                None
            }
            received => received?,
        };
        if !was_subscribed && topic.source.subscribed() {
            round.subscribed = true;
            topic.since_ns = clock::now_ns();
            self.events.push_back(Event::Subscribed(topic.name.clone()));
        }
        let Some(sample) = received else {
            round.next_topic();
            return Ok(());
        };
        let arrival = Arrival { monotonic_ns: clock::now_ns(), wall_ns: clock::wall_ns() };
        if !sample.is_silence() {
            let (now, missed) = (Instant::now(), sample.missed());
            topic.stats.count(now, missed, sample.period_us(), sample.is_of_before(topic.since_ns));
            if missed > 0 {
                self.events.push_back(Event::Notice(vec![topic.name.clone()], Notice::Missed(missed)));
            }
            if let Some(lines) = self.lines.as_mut().filter(|_| topic.name.is_robot()) {
                follow_parts(lines, &sample);
            }
            self.last_sample = now;
            self.received += 1;
            if self.bounds.count.is_some_and(|count| self.received >= count) {
                self.end = Some(Ok(()));
            }
        }
        self.events.push_back(Event::Sample(topic.name.clone(), sample, arrival));
        round.taken += 1;
        if round.taken == TURN {
            round.more = true;
            round.next_topic();
        }
        Ok(())
    }

    /// Follows the lines of all sensors that are followed by now, and receives their statuses.
    fn receive_lines(&mut self) {
        let Some(lines) = &mut self.lines else { return };
        for topic in self.topics[self.topics_with_line..].iter().filter(|topic| !topic.name.is_robot()) {
            follow_line(lines, &topic.name.sensor);
        }
        self.topics_with_line = self.topics.len();
        for FollowedLine { sensor, source, line } in lines {
            while let Some(follower) = source {
                match follower.receive(&mut self.session) {
                    Ok(None) => break,
                    Ok(Some(status)) => {
                        line.note(status.header().boot, &status.counters);
                        // A copy: the hub lends four samples of a topic at most.
                        self.events.push_back(Event::Line(sensor.clone(), Box::new(*status)));
                    }
                    Err(_) => *source = None,
                }
            }
        }
    }

    /// Returns what the line of `sensor` took away in the run.
    fn loss(&self, sensor: &str) -> Loss {
        let line = self.lines.iter().flatten().find(|line| line.sensor == sensor);
        line.map(|line| line.line.loss()).unwrap_or_default()
    }

    /// Ends the run at its bounds, and finds the reason for a silence.
    fn check(&mut self) -> Result<(), End> {
        if self.bounds.count == Some(0) {
            self.end = Some(Ok(()));
            return Ok(());
        }
        if self.closely {
            self.look()?;
        }
        self.receive_lines();
        let now = Instant::now();
        if self.session.domain().is_some() {
            for topic in &mut self.topics {
                if topic.stats.stale(now) {
                    self.events.push_back(Event::Notice(vec![topic.name.clone()], Notice::Stale));
                }
            }
        }
        match self.hub_seen {
            None if now - self.started >= GRACE => {
                if self.bounds.bounded() {
                    return Err(self.session.no_hub().into());
                }
                if !self.waiting_said {
                    self.waiting_said = true;
                    self.notice(Notice::NoHub(self.session.no_hub().into()), |_| true);
                }
            }
            Some(seen) if now - seen >= GRACE => self.check_sensors()?,
            _ => {}
        }
        if let Some(limit) = self.bounds.timeout.filter(|limit| now - self.last_sample >= *limit) {
            let has_hub = self.session.domain().is_some();
            let hint = if has_hub { "`scanhub info` shows why" } else { "there is no hub" };
            return Err(Failure::new(Kind::Timeout, format!("nothing arrived for {limit:?}"), hint).into());
        }
        if self.stop.load(Ordering::Relaxed) {
            if self.bounds.bounded() {
                return Err(Failure::new(Kind::Interrupted, "interrupted before it was done", "").into());
            }
            self.end = Some(Ok(()));
        } else if self.bounds.run_for.is_some_and(|limit| now - self.started >= limit) {
            if let Some(count) = self.bounds.count {
                let what = format!("{} of {count} samples arrived in time", self.received);
                return Err(Failure::new(Kind::Timeout, what, "`scanhub info` shows why").into());
            }
            self.end = Some(Ok(()));
        }
        Ok(())
    }

    /// Fails if the run follows a sensor that the hub does not have: a hub that is up has all its topics.
    fn check_sensors(&mut self) -> Result<(), End> {
        // A topic that is not wanted now is not missing: asking costs more than following.
        let (unwanted, topics) = (&self.unwanted, &self.topics);
        let is_missing =
            |topic: &Followed| !unwanted.contains(&topic.name.topic) && !topic.source.subscribed();
        if !topics.is_empty() && !topics.iter().any(is_missing) {
            return Ok(());
        }
        // A list of the sensors needs a descriptor, too.
        if self.session.domain().is_none() || self.is_short() {
            return Ok(());
        }
        if self.asked_at.is_some_and(|at| at.elapsed() < ASK_EVERY) {
            return Ok(());
        }
        self.asked_at = Some(Instant::now());
        // On a busy machine, a hub may take seconds to create its topics.
        if self.session.hub_is_starting() {
            return Ok(());
        }
        // A hub that starts after a listener creates its topics first.
        let lives = self.session.hub_lives();
        self.hub_lives_since = if lives { self.hub_lives_since.or(Some(Instant::now())) } else { None };
        let published = match self.session.domain().map(scanhub_shm::published).transpose() {
            // Since the pause after the last shortage, the run has not tried to subscribe again.
            Err(failure) if failure.kind == Kind::Short && self.despite_shortage => return Ok(()),
            published => published?.unwrap_or_default(),
        };
        let mut sensors: Vec<String> = published.iter().map(|(sensor, _)| sensor.clone()).collect();
        sensors.dedup();
        let wants_all = topics.iter().all(|topic| topic.name.is_robot());
        // Those of the hub, or without a hub those of other machines.
        let may_come = self.may_come(if lives { Who::Hub } else { Who::Listener });
        if wants_all && !may_come && sensors.iter().all(|sensor| is_remote(sensor) == lives) {
            let (what, hint) = match lives {
                true => ("the hub has no sensors", "scanhub run --link NAME=PORT"),
                false => {
                    ("no sensor of another machine is published here", "`scanhub listen` shows who sends")
                }
            };
            return Err(Failure::new(Kind::NoTopic, what, hint).into());
        }
        for topic in topics {
            let sensor = &topic.name.sensor;
            let is_there =
                topic.name.is_robot() || sensors.contains(sensor) || self.may_come(publisher(sensor));
            if is_missing(topic) && !is_there {
                return Err(no_sensor(sensor, &sensors).into());
            }
            let of_sensor: Vec<Topic> =
                published.iter().filter(|(of, _)| of == sensor).map(|(_, topic)| *topic).collect();
            let maker = topic.name.topic.maker();
            if !of_sensor.is_empty() && of_sensor.iter().all(|other| other.maker() != maker) {
                return Err(no_such_topic(&topic.name, &of_sensor).into());
            }
        }
        Ok(())
    }

    /// Returns whether `who` may still start: another machine at any time, or the hub after a listener.
    fn may_come(&self, who: Who) -> bool {
        let unbounded = !self.bounds.bounded();
        match who {
            Who::Listener => unbounded || self.started.elapsed() < ANNOUNCED,
            Who::Hub => unbounded && self.hub_lives_since.is_none_or(|since| since.elapsed() < GRACE),
        }
    }

    /// Tells `notice` of the topics that it `concerns`.
    fn notice(&mut self, notice: Notice, concerns: impl Fn(&TopicName) -> bool) {
        let names: Vec<_> =
            self.topics.iter().map(|topic| &topic.name).filter(|name| concerns(name)).cloned().collect();
        if !names.is_empty() || self.topics.is_empty() {
            self.events.push_back(Event::Notice(names, notice));
        }
    }

    fn is_short(&self) -> bool {
        self.short_until.is_some_and(|until| Instant::now() < until)
    }

    fn wake_at(&self) -> Option<Instant> {
        let end = self.bounds.run_for.and_then(|limit| self.started.checked_add(limit));
        let silence = self.bounds.timeout.and_then(|limit| self.last_sample.checked_add(limit));
        let left = self.topics.iter().filter_map(|topic| topic.source.left()).min();
        let left = left.into_iter().chain(self.discovery.left()).min();
        let unheard = left.and_then(|left| Instant::now().checked_add(left));
        [end, silence, unheard].into_iter().flatten().min()
    }
}

impl Followed {
    fn new(name: Rc<TopicName>) -> Followed {
        Followed {
            source: Source::new(&name.sensor, name.topic),
            stats: ReceiveStats::new(name.topic),
            name,
            since_ns: u64::MAX,
        }
    }

    /// Ends the subscription.
    fn unsubscribe(&mut self) {
        if self.source.subscribed() {
            *self = Followed::new(self.name.clone());
        }
    }
}

/// Follows the lines of the sensors of a verdict over several.
fn follow_parts(lines: &mut Vec<FollowedLine>, sample: &Sample) {
    if let Sample::Robot(heard) = sample
        && heard.robot.sensors().count() != lines.len()
    {
        heard.robot.sensors().for_each(|(sensor, _)| follow_line(lines, sensor));
    }
}

fn follow_line(lines: &mut Vec<FollowedLine>, sensor: &str) {
    if lines.iter().all(|line| line.sensor != sensor) {
        let source = Some(Follower::new(sensor));
        lines.push(FollowedLine { sensor: sensor.to_owned(), source, line: Line::default() });
    }
}

/// Returns who publishes the sensor that is called so.
fn publisher(sensor: &str) -> Who {
    if is_remote(sensor) { Who::Listener } else { Who::Hub }
}

/// Returns whether `who` publishes `name`. The sensors of a robot may come from any publisher.
fn is_of(name: &TopicName, who: Who) -> bool {
    name.is_robot() || publisher(&name.sensor) == who
}
