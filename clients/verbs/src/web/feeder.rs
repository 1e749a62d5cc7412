//! What follows the hub: samples become a scene, and the scene what is put up on the board. Refuses to know who looks at it.

use std::sync::mpsc::Receiver;
use std::time::{Duration, Instant};

use ::web::{Board, ChannelId, Event, messages};
use scanhub_client::clock;
use scanhub_client::streams::{Sample, Session};
use scene::{Scene, Trouble};
use schema::{Domain, Header, Topic};

use super::{WebOptions, told};
use crate::follow::{Notice, Sink};
use crate::names::TopicName;
use crate::output::{End, Output};
use crate::receive_stats::ReceiveStats;
use crate::work::Work;

/// What a sensor is told in.
struct Channels {
    sensor: String,
    scan: ChannelId,
    foreground: ChannelId,
    background: ChannelId,
    status: ChannelId,
    /// The telegram of the last scan, and of the last foreground.
    scan_of: Option<Header>,
    foreground_of: Option<u64>,
}

pub(super) struct Feeder<'a> {
    options: &'a WebOptions,
    board: &'a Board,
    events: Receiver<Event>,
    output: Output<'a>,
    scene: Scene,
    channels: Vec<Channels>,
    transforms: ChannelId,
    zones: ChannelId,
    marks: ChannelId,
    robot: ChannelId,
    work: Work,
    /// Of the zones or the marks something came that was not put up.
    zones_are_new: bool,
    marks_are_new: bool,
    poses_are_new: bool,
    /// The verdict as it was put up, and when it is again.
    verdict: Vec<u8>,
    robot_at: Instant,
    status_at: Instant,
    trouble: Option<Trouble>,
    message: Vec<u8>,
}

impl<'a> Feeder<'a> {
    pub(super) fn new(
        options: &'a WebOptions,
        board: &'a Board,
        events: Receiver<Event>,
        output: Output<'a>,
    ) -> Feeder<'a> {
        let now = Instant::now();
        Feeder {
            options,
            board,
            events,
            output,
            scene: Scene::default(),
            channels: Vec::new(),
            robot: board.channel(messages::robot_channel()),
            zones: board.channel(messages::zones_channel()),
            marks: board.channel(messages::marks_channel()),
            transforms: board.channel(messages::transforms_channel()),
            work: Work::default(),
            zones_are_new: true,
            marks_are_new: true,
            poses_are_new: true,
            verdict: Vec::new(),
            robot_at: now,
            status_at: now,
            trouble: None,
            message: Vec::new(),
        }
    }

    /// The channels of `sensor`, which there are from now on.
    fn of(&mut self, sensor: &str) -> &mut Channels {
        let at = self.channels.iter().position(|one| one.sensor == sensor).unwrap_or_else(|| {
            self.channels.push(Channels {
                sensor: sensor.to_owned(),
                scan: self.board.channel(messages::scan_channel(sensor)),
                foreground: self.board.channel(messages::foreground_channel(sensor)),
                background: self.board.channel(messages::background_channel(sensor)),
                scan_of: None,
                foreground_of: None,
                status: self.board.channel(messages::status_channel(sensor)),
            });
            self.channels.len() - 1
        });
        &mut self.channels[at]
    }

    fn put_scan(&mut self, name: &TopicName, scan: &scanhub_client::Received<schema::Scan>) {
        let channels = self.of(&name.sensor);
        channels.scan_of = Some(*scan.header());
        let channel = channels.scan;
        if self.board.is_wanted(channel) {
            self.message.clear();
            ros::laser_scan(&mut self.message, ros::frame(&name.sensor), scan.header(), scan);
            self.board.put(channel, scan.header().wall_ns, &self.message);
        }
    }

    /// Puts up the foreground of `name`'s sensor as soon as the scan of the same telegram is here, which says where its beams
    /// point.
    fn put_foreground(&mut self, name: &TopicName) {
        let channels = self.of(&name.sensor);
        let Some(header) = channels.scan_of.filter(|header| channels.foreground_of == Some(header.seq))
        else {
            return;
        };
        channels.foreground_of = None;
        let channel = channels.foreground;
        let sensor = self.scene.sensor(&name.sensor);
        let (Some(scan), Some(foreground)) = (&sensor.scan, &sensor.foreground) else { return };
        if self.board.is_wanted(channel) {
            self.message.clear();
            ros::foreground_cloud(&mut self.message, ros::frame(&name.sensor), &header, scan, foreground);
            self.board.put(channel, header.wall_ns, &self.message);
        }
    }

    fn put_background(&mut self, name: &TopicName, wall_ns: u64, model: &schema::Background) {
        let channel = self.of(&name.sensor).background;
        self.message.clear();
        messages::background(&mut self.message, &name.sensor, wall_ns, model);
        self.board.put(channel, wall_ns, &self.message);
    }

    /// What was true a moment ago, and is not any more.
    fn clear(&mut self) {
        for channels in &self.channels {
            let is_old = |sensor: &scene::Sensor| sensor.name == channels.sensor && sensor.scan.is_none();
            if self.scene.sensors.iter().any(is_old) {
                self.board.clear(channels.scan);
                self.board.clear(channels.foreground);
            }
        }
        (self.zones_are_new, self.marks_are_new) = (true, true);
    }

    /// Puts up what is new of all but scans.
    fn put(&mut self, now: Instant) {
        let wall_ns = clock::wall_ns();
        // Of what changes with every scan nobody who is not there misses anything.
        if self.zones_are_new && self.board.is_watched(self.zones) {
            self.zones_are_new = false;
            self.board.put(self.zones, wall_ns, &messages::zones(&self.scene, wall_ns));
        }
        if self.marks_are_new && self.board.is_watched(self.marks) {
            self.marks_are_new = false;
            self.board.put(self.marks, wall_ns, &messages::marks(&self.scene, wall_ns));
        }
        if std::mem::take(&mut self.poses_are_new) {
            self.board.put(self.transforms, wall_ns, &messages::transforms(&self.scene, wall_ns));
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
        let domain = self.options.places.first().map(Domain::name).unwrap_or_default();
        let verdict = messages::robot(&self.scene, domain, self.trouble.as_ref());
        if now >= self.robot_at || verdict != self.verdict {
            self.board.put(self.robot, wall_ns, &verdict);
            self.verdict = verdict;
            self.robot_at = now + ROBOT_EVERY;
        }
    }

    /// Looks at the hub: what it uses, or why there is none.
    fn look(&mut self, now: Instant) {
        self.trouble = if !self.scene.hub_lives {
            let mut session = Session::new(self.options.places.clone());
            let failure = session.look().err().unwrap_or_else(|| session.no_hub());
            session.domain().is_none().then_some(Trouble { what: failure.message, remedy: failure.hint })
        } else if self.scene.sensors.is_empty() {
            let remedy = "scanhub run --link front=/dev/ttyUSB0".to_owned();
            Some(Trouble { what: "the hub has no sensors".to_owned(), remedy })
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
        self.scene.sensor(&name.sensor);
        self.of(&name.sensor);
        self.poses_are_new = true;
    }

    fn sample(&mut self, name: &TopicName, sample: &Sample) -> Result<(), End> {
        let sensor = self.scene.heard(&name.sensor, sample.header());
        match sample {
            Sample::Scan(scan) => {
                sensor.take_scan(scan.header(), scan, clock::now_ns());
                self.put_scan(name, scan);
                self.put_foreground(name);
            }
            Sample::Marks(marks) => {
                sensor.marks = marks.is_available().then_some(**marks);
                self.marks_are_new = true;
            }
            Sample::Zones(heard) => {
                sensor.zones = heard.zones;
                self.zones_are_new = true;
            }
            Sample::Foreground(foreground) => {
                sensor.foreground = Some(foreground.boxed());
                self.of(&name.sensor).foreground_of = Some(foreground.header().seq);
                self.put_foreground(name);
            }
            Sample::Background(model) => {
                sensor.background = Some(model.boxed());
                self.put_background(name, model.header().wall_ns, model);
            }
            Sample::Status(status) => {
                self.poses_are_new |= sensor.pose != status.pose;
                sensor.take_status(status);
                self.status_at = Instant::now();
            }
            // The picture does not show it.
            _ => {}
        }
        Ok(())
    }

    fn notice(&mut self, names: &[&TopicName], notice: Notice) -> Result<(), End> {
        match (notice, names) {
            (Notice::Missed(missed), [name]) if name.topic == Topic::Scan => {
                self.scene.sensor(&name.sensor).lost += missed;
            }
            (Notice::HubGone, _) => {
                self.scene.hub_gone();
                self.clear();
                self.status_at = Instant::now();
            }
            (Notice::HubBack, _) => self.scene.hub_lives = true,
            _ => {}
        }
        Ok(())
    }

    fn tick(&mut self, now: Instant) -> Result<(), End> {
        while let Ok(event) = self.events.try_recv() {
            told::client(&mut self.output, &event, self.options.json)?;
        }
        if self.scene.age(clock::now_ns()) {
            self.clear();
        }
        self.put(now);
        Ok(())
    }

    fn summary(&mut self, _: &TopicName, _: &ReceiveStats) -> Result<(), End> {
        Ok(())
    }
}

/// A page that hears nothing for half a second takes the verdict for unknown.
const ROBOT_EVERY: Duration = Duration::from_millis(150);
const STATUS_EVERY: Duration = Duration::from_millis(500);
