//! What follows the hub: samples become a scene, and the scene what is put up on the board. Refuses to know who looks at it.

use std::rc::Rc;
use std::sync::mpsc::{Receiver, TryRecvError};
use std::time::{Duration, Instant};

use crate::scene::{Circle, People, Problem, Scene, circles};
use crate::server::{Board, ChannelId, Event, Playback, Progress, messages};
use scanhub_client::clock;
use scanhub_client::streams::{Sample, Session, Who};
use scanhub_schema::{Failure, Kind, Maker, Topic, Verdict};
use scanhub_shm::Domain;

use super::sensor::Channels;
use super::tilted::Tilted;
use super::{WebOptions, told};
use crate::picture;
use scanhub_verbs::follow::{Notice, ReceiveStats, Sink};
use scanhub_verbs::names::TopicName;
use scanhub_verbs::output::{End, Output};

use crate::work::Work;

pub(super) struct Feeder<'a> {
    options: &'a WebOptions,
    /// What plays the recording, its channel, and what is there.
    player: Option<(&'a dyn Playback, ChannelId)>,
    progress: Option<Progress>,
    /// When it is put up again though nothing but its place changed.
    progress_at: Instant,
    board: &'a Board,
    events: Receiver<Event>,
    output: Output<'a>,
    scene: Scene,
    channels: Vec<Channels>,
    /// Of each tracker.
    tracks: Vec<(String, ChannelId)>,
    tilted: Tilted<'a>,
    transforms: ChannelId,
    zones: ChannelId,
    marks: ChannelId,
    lines: ChannelId,
    robot: ChannelId,
    work: Work,
    /// Of the zones, the marks or the lines something came that was not put up.
    zones_are_new: bool,
    marks_are_new: bool,
    lines_are_new: bool,
    poses_are_new: bool,
    /// The verdict as it was put up, whose it is and whether there is a hub; and when it is put up again.
    told: (Verdict, Option<String>, bool),
    robot_at: Instant,
    /// The circles as they were put up, and when they are put up again although they are the same.
    circles: Vec<Circle>,
    circles_at: Instant,
    /// When marks, zones and lines are put up again, at the earliest.
    marked_at: [Instant; 3],
    status_at: Instant,
    /// Before that it is not told again that something is short.
    short_at: Instant,
    trouble: Option<Problem>,
    message: Vec<u8>,
}

impl<'a> Feeder<'a> {
    pub(super) fn new(
        options: &'a WebOptions,
        player: Option<&'a dyn Playback>,
        board: &'a Board,
        events: Receiver<Event>,
        output: Output<'a>,
    ) -> Feeder<'a> {
        let now = Instant::now();
        Feeder {
            options,
            player: player.map(|player| (player, board.channel(messages::replay_channel()))),
            progress: None,
            progress_at: now,
            board,
            events,
            output,
            scene: Scene::default(),
            channels: Vec::new(),
            tracks: Vec::new(),
            tilted: Tilted::new(board),
            robot: board.channel(messages::robot_channel()),
            zones: board.channel(messages::zones_channel()),
            marks: board.channel(messages::marks_channel()),
            lines: board.channel(messages::lines_channel()),
            transforms: board.channel(messages::transforms_channel()),
            work: Work::default(),
            zones_are_new: true,
            marks_are_new: true,
            lines_are_new: true,
            poses_are_new: true,
            told: (Verdict::Unknown, None, false),
            robot_at: now,
            circles: Vec::new(),
            circles_at: now,
            marked_at: [now; 3],
            status_at: now,
            short_at: now,
            trouble: None,
            message: Vec::new(),
        }
    }

    /// The channels of `sensor`, which there are from now on.
    fn of(&mut self, sensor: &str) -> &mut Channels {
        let at = self.channels.iter().position(|one| one.sensor == sensor).unwrap_or_else(|| {
            self.channels.push(Channels::new(self.board, sensor));
            self.channels.len() - 1
        });
        &mut self.channels[at]
    }

    /// The channel of the people of `tracker`, which is there from now on.
    fn tracks_of(&mut self, tracker: &str) -> ChannelId {
        let at = self.tracks.iter().position(|(known, _)| known == tracker).unwrap_or_else(|| {
            self.tracks.push((tracker.to_owned(), self.board.channel(messages::tracks_channel(tracker))));
            self.tracks.len() - 1
        });
        self.tracks[at].1
    }

    fn put_tracks(&mut self, tracker: &str, wall_ns: u64) {
        let channel = self.tracks_of(tracker);
        let people = self.scene.trackers.iter().find(|(name, _)| name == tracker);
        if let Some((_, people)) = people.filter(|_| self.board.is_watched(channel)) {
            self.board.put(channel, wall_ns, &messages::tracks(people, wall_ns));
        }
    }

    fn put_foreground(&mut self, name: &TopicName, message: &mut Vec<u8>) {
        let at = self.channels.iter().position(|one| one.sensor == name.sensor);
        if let Some(channels) = at.map(|at| &mut self.channels[at]) {
            channels.put_foreground(self.board, message, self.scene.sensor(&name.sensor));
        }
    }

    /// What was true a moment ago, and is not any more.
    fn clear(&mut self) {
        for channels in &self.channels {
            let is_old =
                |sensor: &crate::scene::Sensor| sensor.name == channels.sensor && sensor.scan.is_none();
            if self.scene.sensors.iter().any(is_old) {
                channels.clear(self.board);
            }
        }
        for (tracker, channel) in &self.tracks {
            let has_people =
                |(name, people): &(String, People)| name == tracker && !people.persons().is_empty();
            if !self.scene.trackers.iter().any(has_people) {
                self.board.clear(*channel);
            }
        }
        (self.zones_are_new, self.marks_are_new, self.lines_are_new) = (true, true, true);
    }

    /// Puts up what is new of all but scans.
    fn put(&mut self, now: Instant) {
        let wall_ns = clock::wall_ns();
        // Of what changes with every scan nobody who is not there misses anything.
        if now >= self.marked_at[0] && self.zones_are_new && self.board.is_watched(self.zones) {
            (self.zones_are_new, self.marked_at[0]) = (false, now + MARKS_EVERY);
            let around = circles(self.scene.robot().map(|(_, sensor)| sensor));
            // Circles with nothing inside stay as they are.
            let stands = around == self.circles && !around.iter().any(Circle::is_violated);
            if !stands || now >= self.circles_at {
                (self.circles, self.circles_at) = (around, now + CIRCLES_EVERY);
                self.board.put(self.zones, wall_ns, &messages::zones(&self.scene, wall_ns));
            }
        }
        if now >= self.marked_at[1] && self.marks_are_new && self.board.is_watched(self.marks) {
            (self.marks_are_new, self.marked_at[1]) = (false, now + MARKS_EVERY);
            self.board.put(self.marks, wall_ns, &messages::marks(&self.scene, wall_ns));
        }
        if now >= self.marked_at[2] && self.lines_are_new && self.board.is_watched(self.lines) {
            (self.lines_are_new, self.marked_at[2]) = (false, now + MARKS_EVERY);
            self.board.put(self.lines, wall_ns, &messages::lines(&self.scene, wall_ns));
        }
        if !self.board.is_watched(self.lines) {
            self.scene.forget_lines();
        }
        if std::mem::take(&mut self.poses_are_new) {
            self.board.put(self.transforms, wall_ns, &messages::transforms(&self.scene, wall_ns));
            // A status says it, too.
            self.status_at = now;
        }
        if now >= self.status_at {
            self.status_at = now + STATUS_EVERY;
            self.look(now);
            for at in 0..self.scene.sensors.len() {
                let name = self.scene.sensors[at].name.clone();
                let channel = self.of(&name).status;
                self.board.put(channel, wall_ns, &messages::status(&self.scene.sensors[at]));
            }
        }
        if !self.board.is_watched(self.robot) {
            return;
        }
        let (verdict, whose, _) = crate::scene::verdict(self.scene.robot().map(|(_, sensor)| sensor));
        let told = (verdict, whose.map(str::to_owned), self.scene.hub_lives);
        if now >= self.robot_at || told != self.told {
            let domain = self.options.places.first().map(Domain::name).unwrap_or_default();
            let message = messages::robot(&self.scene, domain, self.trouble.as_ref());
            self.board.put(self.robot, wall_ns, &message);
            (self.told, self.robot_at) = (told, now + ROBOT_EVERY);
        }
    }

    /// Puts up how far the player is, if that is another place or state.
    fn put_progress(&mut self, now: Instant) {
        let Some((player, channel)) = self.player else { return };
        let progress = player.progress();
        let is_only_later =
            |before: Progress| Progress { position_s: progress.position_s, ..before } == progress;
        if self.progress == Some(progress)
            || (now < self.progress_at && self.progress.is_some_and(is_only_later))
        {
            return;
        }
        (self.progress, self.progress_at) = (Some(progress), now + PROGRESS_EVERY);
        self.board.put(channel, clock::wall_ns(), &messages::replay(&progress));
    }

    /// Looks at the hub: what it uses, or why there is none.
    fn look(&mut self, now: Instant) {
        self.trouble = if !self.scene.hub_lives {
            let mut session = Session::new(self.options.places.clone());
            let failure = session.look().err();
            match session.publishes() {
                None => Some(failure.unwrap_or_else(|| session.no_hub_here())),
                Some(Who::Hub) => None,
                Some(Who::Listener) => Some(Failure::new(
                    Kind::NoTopic,
                    "no sensor of another machine is published here yet",
                    "on that machine: scanhub gateway --interface NAME; here, scanhub listen shows who sends",
                )),
            }
            .map(|Failure { message, hint, .. }| Problem { what: message, remedy: hint })
        } else if self.scene.sensors.is_empty() {
            let remedy = "scanhub run --link front=/dev/ttyUSB0".to_owned();
            Some(Problem { what: "the hub has no sensors".to_owned(), remedy })
        } else {
            None
        };
        if self.scene.hub_pid != 0 {
            self.scene.hub_percent = self.work.look(self.scene.hub_pid, now);
        }
    }
}

impl Sink for Feeder<'_> {
    fn begin(&mut self, name: &TopicName) {
        picture::begin(&mut self.scene, name);
        match name.topic.maker() {
            Maker::Link => drop(self.of(&name.sensor)),
            Maker::Tracker => drop(self.tracks_of(&name.sensor)),
            Maker::Mount | Maker::Tilted => self.tilted.begin(name),
        }
        self.poses_are_new = true;
    }

    fn sample(&mut self, name: &TopicName, sample: &Sample) -> Result<(), End> {
        if let Maker::Mount | Maker::Tilted = name.topic.maker() {
            self.tilted.take(name, sample);
            return Ok(());
        }
        if let Sample::Tracks(tracks) = sample {
            let mounts =
                |scene: &Scene| scene.sensors.iter().map(|sensor| sensor.placement).collect::<Vec<_>>();
            let before = mounts(&self.scene);
            picture::take(&mut self.scene, name, sample);
            self.poses_are_new |= mounts(&self.scene) != before;
            self.put_tracks(&name.sensor, tracks.header().wall_ns);
            return Ok(());
        }
        let mount = self.scene.sensor(&name.sensor).placement;
        picture::take(&mut self.scene, name, sample);
        let board = self.board;
        let mut message = std::mem::take(&mut self.message);
        match sample {
            Sample::Scan(scan) => {
                let channels = self.of(&name.sensor);
                channels.put_scan(board, &mut message, scan.header(), scan);
                self.put_foreground(name, &mut message);
            }
            Sample::Marks(_) => self.marks_are_new = true,
            Sample::Zones(_) => self.zones_are_new = true,
            Sample::Lines(_) => self.lines_are_new = true,
            Sample::Foreground(foreground) => {
                self.of(&name.sensor).take_foreground(foreground.header().seq);
                self.put_foreground(name, &mut message);
            }
            Sample::Background(model) => {
                let wall_ns = model.header().wall_ns;
                self.of(&name.sensor).put_background(board, &mut message, wall_ns, model);
            }
            Sample::Status(_) => {
                self.poses_are_new |= mount != self.scene.sensor(&name.sensor).placement;
                self.status_at = Instant::now();
            }
            _ => {}
        }
        self.message = message;
        Ok(())
    }

    fn notice(&mut self, names: &[Rc<TopicName>], notice: Notice) -> Result<(), End> {
        picture::note(&mut self.scene, names, &notice);
        if let Notice::NoHub(failure) = &notice
            && !self.options.json
        {
            // Only this terminal reads of other users' hubs; viewers read the trouble of `look`.
            told::no_hub(&mut self.output, failure)?;
        }
        if matches!(notice, Notice::NoHub(_) | Notice::HubGone) {
            self.clear();
            self.status_at = Instant::now();
        }
        Ok(())
    }

    /// Lines are wanted as long as a viewer asks for them, and so are angles and points.
    fn wants(&self, topic: Topic) -> bool {
        if topic == Topic::Lines { self.board.is_watched(self.lines) } else { self.tilted.wants(topic) }
    }

    /// What is followed already is served.
    fn short(&mut self, name: &TopicName, failure: Failure) -> Result<(), End> {
        if Instant::now() < self.short_at {
            return Ok(());
        }
        self.short_at = Instant::now() + SHORT_EVERY;
        let message = format!("{name} is not served: {}", failure.message);
        told::short(&mut self.output, &message, &failure.hint, self.options.json)
    }

    fn tick(&mut self, now: Instant) -> Result<(), End> {
        loop {
            match self.events.try_recv() {
                Ok(event) => told::event(&mut self.output, &event, self.options.json)?,
                Err(TryRecvError::Empty) => break,
                // Nobody is served any more; why is known where that thread is waited for.
                Err(TryRecvError::Disconnected) => return Err(End::ReaderGone),
            }
        }
        self.put_progress(now);
        // What a player shows while it waits stands.
        if !self.progress.is_some_and(|progress| progress.stands()) && self.scene.age(clock::now_ns()) {
            self.clear();
        }
        self.put(now);
        self.board.tell();
        Ok(())
    }

    fn summary(&mut self, _: &TopicName, _: &ReceiveStats) -> Result<(), End> {
        Ok(())
    }
}

/// The same verdict, because a page that hears nothing for half a second takes it for unknown; and a distance that changes
/// with every scan cannot be read. A change is put up at once.
const ROBOT_EVERY: Duration = Duration::from_millis(90);
/// Nobody sees a player move in smaller steps.
const PROGRESS_EVERY: Duration = Duration::from_millis(50);
/// Of several sensors one message has all, and a sign that follows its scan so soon is seen to go with it.
const MARKS_EVERY: Duration = Duration::from_millis(50);
/// In viewers what is not said again is gone after a second, and whoever comes sees them so soon.
const CIRCLES_EVERY: Duration = Duration::from_millis(300);
const STATUS_EVERY: Duration = Duration::from_millis(500);
/// Between two words about a shortage.
const SHORT_EVERY: Duration = Duration::from_secs(10);
