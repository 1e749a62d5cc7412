//! Feed of the server: updates a scene from the topics of a hub, and publishes the scene and the samples on channels.

use std::collections::BTreeMap;
use std::rc::Rc;
use std::time::{Duration, Instant};

use scanhub_client::clock;
use scanhub_client::streams::{DomainHolder, Sample, Session};
use scanhub_schema::{Failure, Kind, PublisherKind, Topic, Verdict};
use scanhub_shm::Domain;
use scanhub_verbs::follow::{Event, Notice, TopicRun};
use scanhub_verbs::names::TopicName;
use scanhub_verbs::output::ExitReason;

use super::Reporter;
use super::channels::{SensorChannels, TiltChannels};
use crate::live_scene::LiveScene;
use crate::scene::{Circle, Problem, Scene, Sensor, SensorPlacement, circles, verdict};
use crate::server::player::{self, Playback, Progress};
use crate::server::{ChannelPublisher, ChannelStore, messages};

/// Interval at which the verdict and the distance are repeated. If no message arrives for half a second, the page shows
/// the verdict as unknown. A changed verdict is published at once. A changed distance waits for the interval, because
/// users cannot read a distance that changes with every scan.
const ROBOT_INTERVAL: Duration = Duration::from_millis(90);
/// Minimum interval between messages of the player if only its position has changed.
const PROGRESS_INTERVAL: Duration = Duration::from_millis(50);
/// Minimum interval between messages of circles, marks or line features. One message has the figures of all sensors.
const OVERLAY_INTERVAL: Duration = Duration::from_millis(50);
/// Interval at which unchanged circles are repeated, because viewers delete them after a second.
const CIRCLES_INTERVAL: Duration = Duration::from_millis(300);
/// Interval between messages with the state of a sensor.
const STATUS_INTERVAL: Duration = Duration::from_millis(500);

/// Feed of the channels from a hub.
pub(super) struct Feed<'a> {
    channels: &'a ChannelStore,
    /// Locations where the domain may be.
    locations: &'a [Domain],
    live: LiveScene,
    sensors: SensorFeed<'a>,
    trackers: BTreeMap<String, ChannelPublisher<'a>>,
    tilted: TiltChannels<'a>,
    overlays: Overlays<'a>,
    robot: RobotFeed<'a>,
    player: Option<PlayerFeed<'a>>,
    reporter: Reporter<'a>,
}

impl<'a> Feed<'a> {
    pub(super) fn new(
        channels: &'a ChannelStore,
        locations: &'a [Domain],
        player: Option<&'a dyn Playback>,
        reporter: Reporter<'a>,
    ) -> Feed<'a> {
        let now = Instant::now();
        let player = player.map(|player| PlayerFeed::new(player, channels, now));
        Feed {
            channels,
            locations,
            live: LiveScene::default(),
            trackers: BTreeMap::new(),
            tilted: TiltChannels::new(channels),
            robot: RobotFeed::new(channels, now),
            overlays: Overlays::new(channels, now),
            sensors: SensorFeed::new(channels, now),
            player,
            reporter,
        }
    }

    /// Returns the channel of `tracker`, and opens it if it is new.
    fn tracker(&mut self, tracker: &str) -> ChannelPublisher<'a> {
        let open = || self.channels.open(messages::tracks_channel(tracker));
        *self.trackers.entry(tracker.to_owned()).or_insert_with(open)
    }

    fn publish_people(&mut self, tracker: &str, wall_ns: u64) {
        let channel = self.tracker(tracker);
        let people = self.live.scene.trackers.iter().find(|(name, _)| name == tracker);
        if let Some((_, people)) = people.filter(|_| channel.is_subscribed()) {
            channel.publish(wall_ns, &messages::tracks(people, wall_ns));
        }
    }

    /// Removes messages whose contents the scene has deleted.
    fn clear(&mut self) {
        let scene = &self.live.scene;
        scene
            .sensors
            .iter()
            .filter(|sensor| sensor.scan.is_none())
            .for_each(|sensor| self.sensors.clear(sensor));
        for (tracker, channel) in &self.trackers {
            let mut trackers = scene.trackers.iter();
            if !trackers.any(|(name, people)| name == tracker && !people.people().is_empty()) {
                channel.clear();
            }
        }
        self.overlays.set_new();
    }

    /// Publishes all messages that are due, apart from samples.
    fn publish(&mut self, now: Instant) {
        let wall_ns = clock::wall_ns();
        self.overlays.publish(&self.live.scene, now, wall_ns);
        if !self.overlays.lines.channel.is_subscribed() {
            self.live.scene.delete_lines();
        }
        if self.sensors.is_due(now) {
            self.robot.problem = problem(&self.live.scene, self.locations);
            self.live.measure_hub(now);
            self.sensors.publish(&self.live.scene, now, wall_ns);
        }
        let domain = self.locations.first().map(Domain::name).unwrap_or_default();
        self.robot.publish(&self.live.scene, domain, now, wall_ns);
    }
}

impl Feed<'_> {
    /// Handles samples and events until the run ends.
    pub(super) fn follow(&mut self, following: &mut TopicRun<'_>) -> Result<(), ExitReason> {
        loop {
            following.set_subscribed(Topic::Lines, self.overlays.lines.channel.is_subscribed());
            for topic in [PublisherKind::Mount, PublisherKind::Tilted].iter().flat_map(|kind| kind.topics()) {
                following.set_subscribed(*topic, self.tilted.needs(*topic));
            }
            let Some(event) = following.next(None)? else { return Ok(()) };
            match event {
                Event::Added(name) => self.begin(&name),
                Event::Sample(name, sample, _) => self.sample(&name, &sample),
                Event::Notice(names, notice) => self.notice(&names, &notice)?,
                // Keep the topics that are already subscribed to.
                Event::ResourceExhausted(name, failure) => self.reporter.not_served(&name, &failure)?,
                Event::Tick(now) => {
                    if following.is_caught_up() {
                        self.live.expire_joins();
                    }
                    self.tick(now)?;
                }
                Event::Subscribed(_) | Event::Line(..) => {}
            }
        }
    }

    fn begin(&mut self, name: &TopicName) {
        self.live.begin(name);
        match name.topic.publisher_kind() {
            PublisherKind::Link => drop(self.sensors.channels_of(&name.sensor)),
            PublisherKind::Tracker => drop(self.tracker(&name.sensor)),
            PublisherKind::Mount | PublisherKind::Tilted => self.tilted.begin(name),
        }
        self.sensors.are_poses_new = true;
    }

    fn sample(&mut self, name: &TopicName, sample: &Sample) {
        if let PublisherKind::Mount | PublisherKind::Tilted = name.topic.publisher_kind() {
            return self.tilted.publish(name, sample);
        }
        // Only these topics contain poses.
        let has_poses = matches!(sample, Sample::Tracks(_) | Sample::Status(_));
        let before = if has_poses { placements(&self.live.scene) } else { Vec::new() };
        let pair = self.live.take(name, sample);
        self.sensors.are_poses_new |= has_poses && placements(&self.live.scene) != before;
        if let Sample::Tracks(tracks) = sample {
            return self.publish_people(&name.sensor, tracks.header().wall_ns);
        }
        let sensor = self.sensors.channels_of(&name.sensor);
        match sample {
            Sample::Scan(scan) => sensor.publish_scan(scan.header(), scan),
            Sample::Background(model) => sensor.publish_background(model.header().wall_ns, model),
            Sample::Status(_) => self.sensors.publish_at = Instant::now(),
            Sample::Zones(_) => self.overlays.zones.is_new = true,
            Sample::Marks(_) => self.overlays.marks.is_new = true,
            Sample::Lines(_) => self.overlays.lines.is_new = true,
            _ => {}
        }
        if let Some(pair) = pair {
            self.sensors.channels_of(&name.sensor).publish_foreground(&pair);
        }
    }

    fn notice(&mut self, names: &[Rc<TopicName>], notice: &Notice) -> Result<(), ExitReason> {
        self.live.take_notice(names, notice);
        if let Notice::NoHub(failure) = notice {
            self.reporter.no_hub(failure)?;
        }
        if matches!(notice, Notice::NoHub(_) | Notice::HubGone) {
            self.clear();
            self.sensors.publish_at = Instant::now();
        }
        Ok(())
    }

    fn tick(&mut self, now: Instant) -> Result<(), ExitReason> {
        self.reporter.report_events()?;
        let is_held = self.player.as_mut().is_some_and(|player| player.publish(now).is_held());
        if !is_held && self.live.expire() {
            self.clear();
        }
        self.publish(now);
        self.channels.wake_if_new();
        Ok(())
    }
}

fn placements(scene: &Scene) -> Vec<SensorPlacement> {
    scene.sensors.iter().map(|sensor| sensor.placement).collect()
}

/// Returns the reason why the scene is empty: no hub runs, or the hub has no sensors.
fn problem(scene: &Scene, locations: &[Domain]) -> Option<Problem> {
    if scene.hub_is_running {
        let what = || "the hub has no sensors".to_owned();
        let remedy = || "scanhub run --link front=/dev/ttyUSB0".to_owned();
        return scene.sensors.is_empty().then(|| Problem { description: what(), remedy: remedy() });
    }
    let mut session = Session::new(locations.to_vec());
    let failure = session.check_hub().err().map(Failure::from);
    let Failure { message, hint, .. } = match session.domain_holder() {
        None => failure.unwrap_or_else(|| session.no_hub_here().into()),
        Some(DomainHolder::Hub) => return None,
        Some(DomainHolder::Listener) => Failure::new(
            Kind::NoTopic,
            "no remote sensor is published here yet",
            "on that machine: scanhub gateway --interface NAME; here, scanhub listen shows who sends",
        ),
    };
    Some(Problem { description: message, remedy: hint })
}

/// Channels of all sensors, and the channel of their poses.
struct SensorFeed<'a> {
    channels: &'a ChannelStore,
    sensors: BTreeMap<String, SensorChannels<'a>>,
    poses: ChannelPublisher<'a>,
    /// Whether poses have changed since they were last published.
    are_poses_new: bool,
    /// Time of the next message with the state of each sensor.
    publish_at: Instant,
}

impl<'a> SensorFeed<'a> {
    fn new(channels: &'a ChannelStore, now: Instant) -> SensorFeed<'a> {
        let poses = channels.open(messages::transforms_channel());
        SensorFeed { channels, sensors: BTreeMap::new(), poses, are_poses_new: true, publish_at: now }
    }

    /// Returns the channels of `sensor`, and opens them if it is new.
    fn channels_of(&mut self, sensor: &str) -> &mut SensorChannels<'a> {
        let open = || SensorChannels::open(self.channels, sensor);
        self.sensors.entry(sensor.to_owned()).or_insert_with(open)
    }

    /// Returns whether states must be published. New poses are a reason too, because a state contains a pose.
    fn is_due(&self, now: Instant) -> bool {
        self.are_poses_new || now >= self.publish_at
    }

    /// Publishes the state of each sensor, and the poses if they are new.
    fn publish(&mut self, scene: &Scene, now: Instant, wall_ns: u64) {
        if std::mem::take(&mut self.are_poses_new) {
            self.poses.publish(wall_ns, &messages::transforms(scene, wall_ns));
        }
        self.publish_at = now + STATUS_INTERVAL;
        scene
            .sensors
            .iter()
            .for_each(|sensor| self.channels_of(&sensor.name).publish_status(wall_ns, sensor));
    }

    /// Removes the messages with scans of a sensor.
    fn clear(&self, sensor: &Sensor) {
        self.sensors.get(&sensor.name).into_iter().for_each(SensorChannels::clear);
    }
}

/// Channel with figures of all sensors.
struct Overlay<'a> {
    channel: ChannelPublisher<'a>,
    /// Whether a sample has arrived since the last message.
    is_new: bool,
    /// Earliest time of the next message.
    publish_at: Instant,
}

impl Overlay<'_> {
    /// Returns whether a message is due. If so, starts the next interval. Without a subscriber, no message is due: the
    /// figures change with every scan, so a later subscriber does not need old ones.
    fn take_due(&mut self, now: Instant) -> bool {
        let is_due = self.is_new && now >= self.publish_at && self.channel.is_subscribed();
        if is_due {
            (self.is_new, self.publish_at) = (false, now + OVERLAY_INTERVAL);
        }
        is_due
    }
}

/// The channels of circles, marks and line features.
struct Overlays<'a> {
    zones: Overlay<'a>,
    marks: Overlay<'a>,
    lines: Overlay<'a>,
    /// Circles of the last message.
    circles: Vec<Circle>,
    /// Time at which the circles are repeated.
    repeat_at: Instant,
}

impl<'a> Overlays<'a> {
    fn new(channels: &'a ChannelStore, now: Instant) -> Overlays<'a> {
        let overlay = |channel| Overlay { channel: channels.open(channel), is_new: true, publish_at: now };
        Overlays {
            zones: overlay(messages::zones_channel()),
            marks: overlay(messages::marks_channel()),
            lines: overlay(messages::lines_channel()),
            circles: Vec::new(),
            repeat_at: now,
        }
    }

    fn set_new(&mut self) {
        (self.zones.is_new, self.marks.is_new, self.lines.is_new) = (true, true, true);
    }

    fn publish(&mut self, scene: &Scene, now: Instant, wall_ns: u64) {
        if self.zones.take_due(now) {
            let zone_circles = circles(scene.robot().map(|(_, sensor)| sensor));
            let is_unchanged = zone_circles == self.circles && !zone_circles.iter().any(Circle::is_violated);
            if !is_unchanged || now >= self.repeat_at {
                (self.circles, self.repeat_at) = (zone_circles, now + CIRCLES_INTERVAL);
                self.zones.channel.publish(wall_ns, &messages::zones(scene, wall_ns));
            }
        }
        if self.marks.take_due(now) {
            self.marks.channel.publish(wall_ns, &messages::marks(scene, wall_ns));
        }
        if self.lines.take_due(now) {
            self.lines.channel.publish(wall_ns, &messages::lines(scene, wall_ns));
        }
    }
}

/// The channel of the verdict and the hub.
struct RobotFeed<'a> {
    channel: ChannelPublisher<'a>,
    /// Reason why the scene is empty.
    problem: Option<Problem>,
    /// Verdict of the last message, its sensor, and whether a hub ran.
    published: (Verdict, Option<String>, bool),
    /// Time at which the message is repeated.
    repeat_at: Instant,
}

impl<'a> RobotFeed<'a> {
    fn new(channels: &'a ChannelStore, now: Instant) -> RobotFeed<'a> {
        let channel = channels.open(messages::robot_channel());
        RobotFeed { channel, problem: None, published: (Verdict::Unknown, None, false), repeat_at: now }
    }

    fn publish(&mut self, scene: &Scene, domain: &str, now: Instant, wall_ns: u64) {
        if !self.channel.is_subscribed() {
            return;
        }
        let (verdict, sensor, _) = verdict(scene.robot().map(|(_, sensor)| sensor));
        let current = (verdict, sensor.map(str::to_owned), scene.hub_is_running);
        if now >= self.repeat_at || current != self.published {
            self.channel.publish(wall_ns, &messages::robot(scene, domain, self.problem.as_ref()));
            (self.published, self.repeat_at) = (current, now + ROBOT_INTERVAL);
        }
    }
}

/// The channel of a player.
struct PlayerFeed<'a> {
    player: &'a dyn Playback,
    channel: ChannelPublisher<'a>,
    /// Progress of the last message.
    published: Option<Progress>,
    /// Earliest time of the next message if only the position has changed.
    publish_at: Instant,
}

impl<'a> PlayerFeed<'a> {
    fn new(player: &'a dyn Playback, channels: &'a ChannelStore, now: Instant) -> PlayerFeed<'a> {
        PlayerFeed { player, channel: channels.open(player::channel()), published: None, publish_at: now }
    }

    /// Publishes the progress if it has changed. Returns the progress that was published last.
    fn publish(&mut self, now: Instant) -> Progress {
        let progress = self.player.progress();
        let is_only_later =
            |before: Progress| Progress { position_s: progress.position_s, ..before } == progress;
        match self.published {
            Some(before) if before == progress || now < self.publish_at && is_only_later(before) => before,
            _ => {
                (self.published, self.publish_at) = (Some(progress), now + PROGRESS_INTERVAL);
                self.channel.publish(clock::wall_ns(), &player::message(&progress));
                progress
            }
        }
    }
}
