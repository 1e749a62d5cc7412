//! Subscription loop of the verbs: [`TopicRun`] returns each [`Event`] of its topics until the limits are reached.

use std::collections::VecDeque;
use std::rc::Rc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use scanhub_client::streams::{DomainHolder, STARTUP_GRACE, Sample, Session, Source, TopicReader};
use scanhub_client::{Wait, clock};
use scanhub_schema::{Failure, Kind, Status, Topic, is_remote};
use scanhub_shm::Domain;

use crate::discovery::Discovery;
use crate::names::{TopicName, no_sensor, no_such_topic};
use crate::output::{ExitReason, Output};
pub use crate::receive_stats::ReceiveStats;
use crate::receive_stats::{LineLossCounter, Loss};
use crate::{json, text};

/// Limits at which a verb ends by itself. They are arguments of every verb that subscribes to topics.
#[derive(clap::Args, Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RunLimits {
    /// Stop after this number of samples of all topics together
    #[arg(short = 'n', value_name = "COUNT", value_parser = clap::value_parser!(u64).range(1..))]
    pub count: Option<u64>,
    /// Stop after this time, for example 10s, 250ms, 5m
    #[arg(long = "for", value_name = "DURATION", value_parser = crate::duration::parse)]
    pub run_for: Option<Duration>,
    /// Exit with code 3 if no sample arrives for this time
    #[arg(long, value_name = "DURATION", value_parser = crate::duration::parse)]
    pub timeout: Option<Duration>,
}

impl RunLimits {
    /// Returns whether the run ends by itself. A bounded run fails if no hub runs at its start, or if a signal stops
    /// it.
    pub fn is_bounded(&self) -> bool {
        self.count.is_some() || self.run_for.is_some()
    }
}

/// An event of a run.
#[expect(
    clippy::large_enum_variant,
    reason = "nearly every event is a sample, which a box would only slow down"
)]
pub enum Event {
    /// The run will subscribe to this topic when it is available.
    Added(Rc<TopicName>),
    /// The run has subscribed to the topic. The run receives samples that are sent from now on.
    Subscribed(Rc<TopicName>),
    /// A sample, or, during a silence, the substitute for a sample. A substitute does not count as a received sample.
    /// Drop the sample before the next call.
    Sample(Rc<TopicName>, Sample, Arrival),
    /// A problem of these topics, or the end of a problem. The list is empty if the run has no topics yet.
    Notice(Vec<Rc<TopicName>>, Notice),
    /// The run cannot subscribe to this topic because memory, descriptors or slots ran out. The run will try again
    /// ([`TopicRun::tolerating_shortage`]).
    ResourceExhausted(Rc<TopicName>, Failure),
    /// A status of a sensor. Only a run [`with_lines`](TopicRun::with_lines) returns this event.
    Line(String, Box<Status>),
    /// End of a round over all topics. Even without samples, about ten rounds per second end.
    Tick(Instant),
}

/// Time at which this process received a sample.
#[derive(Clone, Copy, Debug, Default)]
pub struct Arrival {
    /// Time on CLOCK_MONOTONIC in ns.
    pub monotonic_ns: u64,
    /// Wall clock time in ns since 1970.
    pub wall_ns: u64,
}

/// A problem of a topic, or the end of a problem.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Notice {
    /// Number of samples that were published, but that this process did not receive.
    Missed(u64),
    /// No sample has arrived for longer than the topic allows.
    Stale,
    /// No hub runs in the domain, so the verb waits for a hub. The failure names the searched locations and the hubs of
    /// other users.
    NoHub(Failure),
    /// The hub of the domain has exited.
    HubGone,
    /// A hub runs in the domain again.
    HubBack,
}

impl Notice {
    /// Writes the notice for `names`, or for the domain if `names` is empty, as JSON lines to `out` or as text to
    /// `notes`.
    pub fn report(
        &self,
        names: &[Rc<TopicName>],
        is_json: bool,
        out: &mut Output<'_>,
        notes: &mut Output<'_>,
    ) -> Result<(), ExitReason> {
        match is_json {
            true => json::notices(out, names, self),
            false => notes.line(|line| text::notice(line, names, self)),
        }
    }
}

/// The topics to which a verb subscribes, in the first of several domains in which a hub runs.
pub struct TopicRun<'a> {
    session: Session,
    topics: Vec<TopicState>,
    /// Serial lines of the sensors; `None` unless the run has lines.
    lines: Option<Vec<LineState>>,
    /// Number of topics in `topics` whose serial lines were added to `lines`.
    topics_with_line: usize,
    /// Topics to which the run subscribes for each sensor of the hub.
    all_sensor_topics: &'a [Topic],
    paused_topics: Vec<Topic>,
    discovery: Discovery,
    /// Whether the run receives samples before it checks the hub.
    receives_first: bool,
    tolerates_shortage: bool,
    limits: &'a RunLimits,
    stop: &'a AtomicBool,
    next_step: Step,
    round: Round,
    events: VecDeque<Event>,
    /// Result of a run that has ended. `next` returns it after the remaining `events`.
    end: Option<Result<(), ExitReason>>,
    started: Instant,
    last_sample: Instant,
    hub_started_at: Option<Instant>,
    /// Time at which the run first found a hub. A listener does not count as a hub.
    hub_running_since: Option<Instant>,
    /// Time of the last list of sensors.
    listed_at: Option<Instant>,
    is_waiting_reported: bool,
    received: u64,
    /// End of the pause after memory, descriptors or slots ran out. During the pause, the run creates no subscriptions.
    short_until: Option<Instant>,
}

/// The next step of a run.
#[derive(Clone, Copy, PartialEq)]
enum Step {
    Start,
    CheckHub,
    Receive,
    AfterRound,
    Check,
    Wait,
}

/// Progress of a round over all topics.
#[derive(Default)]
struct Round {
    /// Index of the current topic.
    topic: usize,
    /// Number of samples received from the current topic in this round.
    taken: usize,
    /// Whether this round has subscribed to a topic.
    subscribed: bool,
    /// Whether samples may still wait after this round.
    more: bool,
}

impl Round {
    fn next_topic(&mut self) {
        self.topic += 1;
        self.taken = 0;
    }
}

/// A topic of a sensor.
struct TopicState {
    name: Rc<TopicName>,
    source: Source,
    stats: ReceiveStats,
    /// Time, on CLOCK_MONOTONIC in ns, since which the run has been ready to receive. Earlier samples have waited, so
    /// their arrival times are too late.
    since_ns: u64,
}

/// Serial line of a sensor, with the statuses of this sensor. These statuses do not count for the limits of the run. An
/// error while receiving them does not end the run.
struct LineState {
    sensor: String,
    /// Reader of the statuses; `None` after an error.
    source: Option<TopicReader<Status>>,
    losses: LineLossCounter,
}

/// Maximum number of samples that a round receives from one topic before it goes to the next topic.
const BATCH_SIZE: usize = 32;
/// Maximum time until every listener has announced its remote sensors. A listener announces them once a second.
const ANNOUNCEMENT_TIMEOUT: Duration = Duration::from_secs(3);
/// Interval between lists of sensors while a sensor is missing. A list takes milliseconds, and samples wait during this
/// time.
const LIST_INTERVAL: Duration = Duration::from_millis(500);
/// Time without new subscriptions after memory, descriptors or slots ran out. An attempt to subscribe takes as long as
/// receiving a thousand samples.
const SHORTAGE_PAUSE: Duration = Duration::from_secs(1);

impl<'a> TopicRun<'a> {
    /// Creates a run that subscribes to `names`, and to the topics in `of_all` of every sensor. It uses the first of
    /// `locations` in which a hub runs. The run ends when `limits` are reached or `stop` is set.
    pub fn new(
        names: &[TopicName],
        of_all: &'a [Topic],
        locations: &[Domain],
        limits: &'a RunLimits,
        stop: &'a AtomicBool,
    ) -> TopicRun<'a> {
        let now = Instant::now();
        let topics: Vec<_> = names.iter().map(|name| TopicState::new(Rc::new(name.clone()))).collect();
        TopicRun {
            session: Session::new(locations.to_vec()),
            events: topics.iter().map(|topic| Event::Added(topic.name.clone())).collect(),
            topics,
            lines: None,
            topics_with_line: 0,
            all_sensor_topics: of_all,
            paused_topics: Vec::new(),
            discovery: Discovery::default(),
            receives_first: false,
            tolerates_shortage: false,
            limits,
            stop,
            next_step: Step::Start,
            round: Round::default(),
            end: None,
            started: now,
            last_sample: now,
            hub_started_at: None,
            hub_running_since: None,
            listed_at: None,
            is_waiting_reported: false,
            received: 0,
            short_until: None,
        }
    }

    /// Adds subscriptions to the statuses of the sensors. A status has counters of the losses on the serial line.
    pub fn with_lines(self) -> TopicRun<'a> {
        TopicRun { lines: Some(Vec::new()), ..self }
    }

    /// Receives early warnings together with the zones of their sensors.
    pub fn with_early(mut self) -> TopicRun<'a> {
        for topic in self.topics.iter_mut().filter(|topic| topic.name.topic == Topic::Zones) {
            topic.source = Source::zones_with_early(&topic.name.sensor);
        }
        self
    }

    /// Minimizes the latency: the run uses the method `wait`, and receives samples before it checks the hub. Checking
    /// the hub takes longer than receiving.
    pub fn receiving_first(self, wait: Wait) -> TopicRun<'a> {
        TopicRun { session: self.session.waiting_by(wait), receives_first: true, ..self }
    }

    /// Makes the run return [`Event::ResourceExhausted`] and continue if memory, descriptors or slots for a topic run
    /// out. Without this call, the run fails.
    pub fn tolerating_shortage(self) -> TopicRun<'a> {
        TopicRun { tolerates_shortage: true, ..self }
    }

    /// Starts or ends the subscriptions to `topic`.
    pub fn set_subscribed(&mut self, topic: Topic, is_subscribed: bool) {
        self.paused_topics.retain(|paused| *paused != topic);
        if !is_subscribed {
            self.paused_topics.push(topic);
        }
    }

    /// Returns whether the run had received all waiting samples at the last [`Event::Tick`].
    pub fn is_caught_up(&self) -> bool {
        !self.round.more
    }

    /// Waits for the next event, and returns it. Returns `None` after the last event. At `wake_at`, returns an
    /// [`Event::Tick`] even if nothing has happened.
    ///
    /// # Errors
    ///
    /// - [`Kind::NoTopic`] if a sensor or topic does not exist; the message names the sensors.
    /// - [`Kind::NoHub`] if the run is bounded and no hub runs at its start.
    /// - [`Kind::Timeout`] if the samples do not arrive in time.
    /// - [`Kind::Interrupted`] if a bounded run is stopped before its end.
    /// - [`Kind::ResourceExhausted`] if memory, descriptors or slots run out.
    pub fn next(&mut self, wake_at: Option<Instant>) -> Result<Option<Event>, ExitReason> {
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

    /// Calls `summary` for each topic at the end of the run, unless the reader has closed the output. `end` is the
    /// result of the run, which is returned.
    ///
    /// # Errors
    ///
    /// Returns the error of `summary` or, if all calls of `summary` succeed, the error in `end`.
    pub fn finish(
        mut self,
        end: Result<(), ExitReason>,
        mut summary: impl FnMut(&TopicName, &ReceiveStats) -> Result<(), ExitReason>,
    ) -> Result<(), ExitReason> {
        if !matches!(end, Err(ExitReason::ReaderClosed)) {
            self.receive_lines();
            for topic in &self.topics {
                let mut stats = topic.stats.clone();
                stats.loss = self.loss(&topic.name.sensor);
                summary(&topic.name, &stats)?;
            }
        }
        end
    }

    fn step(&mut self, wake_at: Option<Instant>) -> Result<(), ExitReason> {
        self.next_step = match self.next_step {
            Step::Start => {
                self.check_hub()?;
                Step::CheckHub
            }
            Step::CheckHub => {
                if !self.receives_first {
                    self.check_hub()?;
                }
                self.round = Round::default();
                Step::Receive
            }
            Step::Receive if self.round.topic < self.topics.len() => {
                self.receive()?;
                Step::Receive
            }
            Step::Receive => {
                self.events.push_back(Event::Tick(Instant::now()));
                Step::AfterRound
            }
            Step::AfterRound => {
                let is_stopped = self.stop.load(Ordering::Relaxed);
                let is_in_time = self.limits.run_for.is_none_or(|limit| self.started.elapsed() < limit);
                if self.round.more && !is_stopped && is_in_time {
                    self.round = Round::default();
                    Step::Receive
                } else {
                    Step::Check
                }
            }
            Step::Check => {
                self.check()?;
                Step::Wait
            }
            Step::Wait => {
                self.session.wait(self.wake_at().into_iter().chain(wake_at).min())?;
                Step::CheckHub
            }
        };
        Ok(())
    }

    /// Checks whether the hub has started or exited, and whether there are new sensors.
    fn check_hub(&mut self) -> Result<(), ExitReason> {
        let change = self.session.check_hub()?;
        if let Some(holder) = change.ended {
            self.discovery.on_hub_ended();
            self.notice(Notice::HubGone, |name| publishes(name, holder));
        }
        if let Some(holder) = change.started {
            if self.hub_started_at.is_some() || self.is_waiting_reported {
                self.notice(Notice::HubBack, |name| publishes(name, holder));
            }
            self.hub_started_at = Some(Instant::now());
            // Samples that the new hub sent earlier have waited, so their arrival times are too late.
            let now_ns = clock::now_ns();
            for topic in self.topics.iter_mut().filter(|topic| topic.source.subscribed()) {
                topic.since_ns = now_ns;
            }
            self.discovery.on_hub_started(Instant::now());
        }
        self.discover()
    }

    /// Adds topics of new sensors, if the run subscribes to all sensors.
    fn discover(&mut self) -> Result<(), ExitReason> {
        let Some(domain) = self.session.domain().filter(|_| !self.all_sensor_topics.is_empty()) else {
            return Ok(());
        };
        let called = match self.discovery.poll(domain, Instant::now()) {
            Err(failure) if failure.kind == Kind::ResourceExhausted && self.tolerates_shortage => {
                return Ok(());
            }
            called => called?,
        };
        let Some(called) = called else { return Ok(()) };
        for sensor in &called.sensors {
            for &topic in self.all_sensor_topics.iter().filter(|topic| called.may_have(sensor, **topic)) {
                let name = TopicName { sensor: sensor.clone(), topic };
                if self.topics.iter().all(|topic| *topic.name != name) {
                    let name = Rc::new(name);
                    self.events.push_back(Event::Added(name.clone()));
                    self.topics.push(TopicState::new(name));
                }
            }
        }
        Ok(())
    }

    /// Receives one sample of the current topic, or goes to the next topic.
    fn receive(&mut self) -> Result<(), ExitReason> {
        let is_short = self.is_short();
        let round = &mut self.round;
        let topic = &mut self.topics[round.topic];
        let was_subscribed = topic.source.subscribed();
        if self.paused_topics.contains(&topic.name.topic) {
            topic.unsubscribe();
            round.next_topic();
            return Ok(());
        }
        // Subscribing takes a thousand times as long as receiving. Therefore receive from other topics before the next
        // subscription.
        if !was_subscribed && (round.subscribed || is_short) {
            round.more |= round.subscribed;
            round.next_topic();
            return Ok(());
        }
        let received = match topic.source.receive(&mut self.session).map_err(Failure::from) {
            Err(failure) if failure.kind == Kind::ResourceExhausted && self.tolerates_shortage => {
                self.short_until = Some(Instant::now() + SHORTAGE_PAUSE);
                self.events.push_back(Event::ResourceExhausted(topic.name.clone(), failure));
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
            topic.stats.count(now, missed, sample.period_us(), sample.is_older_than(topic.since_ns));
            if missed > 0 {
                self.events.push_back(Event::Notice(vec![topic.name.clone()], Notice::Missed(missed)));
            }
            if let Some(lines) = self.lines.as_mut().filter(|_| topic.name.is_robot()) {
                follow_parts(lines, &sample);
            }
            self.last_sample = now;
            self.received += 1;
            if self.limits.count.is_some_and(|count| self.received >= count) {
                self.end = Some(Ok(()));
            }
        }
        self.events.push_back(Event::Sample(topic.name.clone(), sample, arrival));
        round.taken += 1;
        if round.taken == BATCH_SIZE {
            round.more = true;
            round.next_topic();
        }
        Ok(())
    }

    /// Subscribes to the statuses of all sensors of the run, and receives them.
    fn receive_lines(&mut self) {
        let Some(lines) = &mut self.lines else { return };
        for topic in self.topics[self.topics_with_line..].iter().filter(|topic| !topic.name.is_robot()) {
            follow_line(lines, &topic.name.sensor);
        }
        self.topics_with_line = self.topics.len();
        for LineState { sensor, source, losses: line } in lines {
            while let Some(reader) = source {
                match reader.receive(&mut self.session) {
                    Ok(None) => break,
                    Ok(Some(status)) => {
                        line.note(status.header().boot, &status.counters);
                        // Copy the status, because a subscriber can hold at most four samples of a topic.
                        self.events.push_back(Event::Line(sensor.clone(), Box::new(*status)));
                    }
                    Err(_) => *source = None,
                }
            }
        }
    }

    /// Returns the losses on the line of `sensor` during the run.
    fn loss(&self, sensor: &str) -> Loss {
        let line = self.lines.iter().flatten().find(|line| line.sensor == sensor);
        line.map(|line| line.losses.loss()).unwrap_or_default()
    }

    /// Ends the run at its limits, and reports silences.
    fn check(&mut self) -> Result<(), ExitReason> {
        if self.limits.count == Some(0) {
            self.end = Some(Ok(()));
            return Ok(());
        }
        if self.receives_first {
            self.check_hub()?;
        }
        self.receive_lines();
        let now = Instant::now();
        if self.session.domain().is_some() {
            for topic in &mut self.topics {
                if topic.stats.take_silence(now) {
                    self.events.push_back(Event::Notice(vec![topic.name.clone()], Notice::Stale));
                }
            }
        }
        match self.hub_started_at {
            None if now - self.started >= STARTUP_GRACE => {
                if self.limits.is_bounded() {
                    return Err(self.session.no_hub().into());
                }
                if !self.is_waiting_reported {
                    self.is_waiting_reported = true;
                    self.notice(Notice::NoHub(self.session.no_hub().into()), |_| true);
                }
            }
            Some(seen) if now - seen >= STARTUP_GRACE => self.check_sensors()?,
            _ => {}
        }
        if let Some(limit) = self.limits.timeout.filter(|limit| now - self.last_sample >= *limit) {
            let has_hub = self.session.domain().is_some();
            let hint = if has_hub { "`scanhub info` shows why" } else { "there is no hub" };
            return Err(Failure::new(Kind::Timeout, format!("nothing arrived for {limit:?}"), hint).into());
        }
        if self.stop.load(Ordering::Relaxed) {
            if self.limits.is_bounded() {
                return Err(Failure::new(Kind::Interrupted, "interrupted", "").into());
            }
            self.end = Some(Ok(()));
        } else if self.limits.run_for.is_some_and(|limit| now - self.started >= limit) {
            if let Some(count) = self.limits.count {
                let what = format!("{} of {count} samples arrived in time", self.received);
                return Err(Failure::new(Kind::Timeout, what, "`scanhub info` shows why").into());
            }
            self.end = Some(Ok(()));
        }
        Ok(())
    }

    /// Fails if the run needs a topic or sensor that the hub does not have. A hub that has finished starting has
    /// created all its topics.
    fn check_sensors(&mut self) -> Result<(), ExitReason> {
        // A paused topic is not missing. Skip the list of sensors if possible, because listing takes longer than
        // receiving.
        let (paused_topics, topics) = (&self.paused_topics, &self.topics);
        let is_missing =
            |topic: &TopicState| !paused_topics.contains(&topic.name.topic) && !topic.source.subscribed();
        if !topics.is_empty() && !topics.iter().any(is_missing) {
            return Ok(());
        }
        // Listing the sensors also needs a descriptor.
        if self.session.domain().is_none() || self.is_short() {
            return Ok(());
        }
        if self.listed_at.is_some_and(|at| at.elapsed() < LIST_INTERVAL) {
            return Ok(());
        }
        self.listed_at = Some(Instant::now());
        // On a busy machine, a hub may take seconds to create its topics.
        if self.session.hub_is_starting() {
            return Ok(());
        }
        // A hub that has started after a listener may still need time to create its topics.
        let is_hub_running = self.session.hub_is_running();
        self.hub_running_since =
            if is_hub_running { self.hub_running_since.or(Some(Instant::now())) } else { None };
        let published = match self.session.domain().map(scanhub_shm::published_topics).transpose() {
            // Listing failed because memory, descriptors or slots are short again, which the run tolerates.
            Err(failure) if failure.kind == Kind::ResourceExhausted && self.tolerates_shortage => {
                return Ok(());
            }
            published => published?.unwrap_or_default(),
        };
        let mut sensors: Vec<String> = published.iter().map(|(sensor, _)| sensor.clone()).collect();
        sensors.dedup();
        let wants_all = topics.iter().all(|topic| topic.name.is_robot());
        // If a hub runs, only its sensors count, otherwise only remote sensors.
        let may_come =
            self.may_start(if is_hub_running { DomainHolder::Hub } else { DomainHolder::Listener });
        if wants_all && !may_come && sensors.iter().all(|sensor| is_remote(sensor) == is_hub_running) {
            let (what, hint) = match is_hub_running {
                true => ("the hub has no sensors", "scanhub run --link NAME=PORT"),
                false => ("no remote sensor is published here", "`scanhub listen` shows who sends"),
            };
            return Err(Failure::new(Kind::NoTopic, what, hint).into());
        }
        for topic in topics {
            let sensor = &topic.name.sensor;
            let is_there =
                topic.name.is_robot() || sensors.contains(sensor) || self.may_start(holder_of(sensor));
            if is_missing(topic) && !is_there {
                return Err(no_sensor(sensor, &sensors).into());
            }
            let of_sensor: Vec<Topic> =
                published.iter().filter(|(of, _)| of == sensor).map(|(_, topic)| *topic).collect();
            let publisher_kind = topic.name.topic.publisher_kind();
            if !of_sensor.is_empty() && of_sensor.iter().all(|other| other.publisher_kind() != publisher_kind)
            {
                return Err(no_such_topic(&topic.name, &of_sensor).into());
            }
        }
        Ok(())
    }

    /// Returns whether sensors of a publisher of the kind `holder` may still appear. Sensors of a listener may appear
    /// at any time in an unbounded run, and in the first [`ANNOUNCEMENT_TIMEOUT`] of a bounded run. Sensors of the hub
    /// may appear in an unbounded run until [`STARTUP_GRACE`] after the hub was found.
    fn may_start(&self, holder: DomainHolder) -> bool {
        let unbounded = !self.limits.is_bounded();
        match holder {
            DomainHolder::Listener => unbounded || self.started.elapsed() < ANNOUNCEMENT_TIMEOUT,
            DomainHolder::Hub => {
                unbounded && self.hub_running_since.is_none_or(|since| since.elapsed() < STARTUP_GRACE)
            }
        }
    }

    /// Adds `notice` for all topics for which `concerns` returns true.
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
        let end = self.limits.run_for.and_then(|limit| self.started.checked_add(limit));
        let silence = self.limits.timeout.and_then(|limit| self.last_sample.checked_add(limit));
        let left = self.topics.iter().filter_map(|topic| topic.source.time_left()).min();
        let left = left.into_iter().chain(self.discovery.time_left()).min();
        let wake = left.and_then(|left| Instant::now().checked_add(left));
        [end, silence, wake].into_iter().flatten().min()
    }
}

impl TopicState {
    fn new(name: Rc<TopicName>) -> TopicState {
        TopicState {
            source: Source::new(&name.sensor, name.topic),
            stats: ReceiveStats::new(name.topic),
            name,
            since_ns: u64::MAX,
        }
    }

    /// Ends the subscription.
    fn unsubscribe(&mut self) {
        if self.source.subscribed() {
            *self = TopicState::new(self.name.clone());
        }
    }
}

/// Adds the serial lines of the sensors in a combined verdict.
fn follow_parts(lines: &mut Vec<LineState>, sample: &Sample) {
    if let Sample::Robot(update) = sample
        && update.robot.sensors().count() != lines.len()
    {
        update.robot.sensors().for_each(|(sensor, _)| follow_line(lines, sensor));
    }
}

fn follow_line(lines: &mut Vec<LineState>, sensor: &str) {
    if lines.iter().all(|line| line.sensor != sensor) {
        let source = Some(TopicReader::new(sensor));
        lines.push(LineState { sensor: sensor.to_owned(), source, losses: LineLossCounter::default() });
    }
}

/// Returns the kind of process that publishes `sensor`.
fn holder_of(sensor: &str) -> DomainHolder {
    if is_remote(sensor) { DomainHolder::Listener } else { DomainHolder::Hub }
}

/// Returns whether `holder` publishes `name`. The sensors of a robot may come from any publisher.
fn publishes(name: &TopicName, holder: DomainHolder) -> bool {
    name.is_robot() || holder_of(&name.sensor) == holder
}
