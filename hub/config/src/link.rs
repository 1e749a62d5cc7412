//! The links of a hub, each with its port and the settings of its sensor: keys of the sources and values in effect.

use scanhub_drivers::{Features, Settings, scan_heads};
use scanhub_port::PortSpec;
use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{Background, Failure, Family, ScanHead, check_sensor};

use crate::processing::{
    BackgroundKeys, EarlyKeys, LinesKeys, MarksKeys, MotionKeys, PoseKeys, Processing, ZonesKeys,
};
use crate::scanner::Scanner;
use crate::section::{CheckResult, Section, invalid_value, optional, section};

/// The effective configuration.
#[derive(Clone, Debug, PartialEq)]
pub struct Config {
    /// The links in their order: a sensor's number is its place here.
    pub links: Vec<Link>,
    /// What the topics of a link are made for, but for what its scanner needs.
    pub limits: TopicLimits,
}

impl Config {
    /// Returns what the topics of each link are made for.
    pub fn topic_limits(&self) -> Vec<TopicLimits> {
        self.links.iter().map(|link| link.limits(&self.limits)).collect()
    }

    /// Adds the [remedy](Self::memory_remedy) to a failure that reports too little shared memory.
    pub fn with_remedy(&self, failure: Failure) -> Failure {
        match self.memory_remedy() {
            Some(remedy) => Failure { hint: format!("{}; {remedy}", failure.hint), ..failure },
            None => failure,
        }
    }

    /// Returns the remedy for too little shared memory: to set the family of a link. `None` if all links have one.
    pub fn memory_remedy(&self) -> Option<String> {
        let link = self.links.iter().find(|link| link.family().is_none())?;
        let families = Family::ALL.map(Family::name).join(", ");
        Some(format!("family = \"auto\" needs the most: set link.{}.family to one of {families}", link.name))
    }
}

/// One link and what to ask of its sensor.
#[derive(Clone, Debug, PartialEq)]
pub struct Link {
    /// The sensor's name in topics.
    pub name: String,
    /// The source of its bytes.
    pub port: PortSpec,
    /// Family and settings of its scanner.
    pub scanner: Scanner,
    /// How its scans are processed.
    pub processing: Processing,
}

impl Link {
    /// Returns the rate at which its port is opened, in bits per second.
    pub fn rate(&self) -> u32 {
        self.scanner.rate()
    }

    /// Returns the highest rate that the scanner can have at its port.
    pub fn max_rate(&self) -> u32 {
        self.scanner.max_rate_at(&self.port)
    }

    /// Returns the maximum number of beams of a scan.
    pub fn max_beams(&self) -> usize {
        self.scanner.max_beams()
    }

    /// Returns the limits of its topics. `all` are those of all links.
    pub fn limits(&self, all: &TopicLimits) -> TopicLimits {
        let &Features { array_flags: contents, max_telegram, .. } = self.scanner.features();
        TopicLimits { beams: self.max_beams(), contents, telegram: max_telegram, ..*all }
    }

    /// Returns the family of its scanner. `None`: it is searched for.
    pub fn family(&self) -> Option<Family> {
        self.scanner.family
    }

    /// Returns the keys, apart from its processing, that differ in `other`.
    pub fn differences(&self, other: &Link) -> Vec<&'static str> {
        let port = (self.port != other.port).then_some("port");
        port.into_iter().chain(self.scanner.differences(&other.scanner)).collect()
    }

    /// Returns the possible heads of its scans, as far as they are known; those with the most beams first.
    pub fn scan_heads(&self) -> Vec<ScanHead> {
        let families = self.family().map_or(Family::ALL.to_vec(), |family| vec![family]);
        let settings = self.settings();
        let mut heads: Vec<_> =
            families.into_iter().flat_map(|family| scan_heads(family, &settings)).collect();
        heads.sort_by_key(|head| std::cmp::Reverse(head.count));
        heads
    }

    /// Returns the settings of a session at its port. Nothing can be sent to a recording.
    pub fn settings(&self) -> Settings {
        self.scanner.settings_at(&self.port, matches!(self.port, PortSpec::File { .. }))
    }

    /// Checks whether `model` may belong to its sensor, as far as that is known.
    ///
    /// # Errors
    ///
    /// Returns the beams and the unit that such a model has, as text.
    pub fn check_background(&self, model: &Background) -> Result<(), String> {
        let heads = self.scan_heads();
        let count = heads[0].count;
        let (fits, beams) = match self.scanner.is_auto() {
            true => (model.count <= count, format!("at most {count}")),
            false => (model.count == count, count.to_string()),
        };
        // A unit that is not configured may be any.
        let unit_um = if heads.len() > 1 { model.unit_um } else { heads[0].unit_um };
        if fits && model.unit_um == unit_um {
            return Ok(());
        }
        Err(format!("{beams} beams in units of {} mm", unit_um / 1000))
    }
}

section! {
    /// Keys of a link. A scanner key is in [`scanhub_drivers::Key`], too; its family checks the value.
    pub(crate) struct LinkKeys: "keys of a link, as { name = \"front\", port = \"/dev/ttyUSB0\" }" {
        /// first part of topic names: a-z, 0-9, _ and -
        ///
        /// The sensor's name in topics, at most 24 of a-z, 0-9, _ and -; not `robot`.
        name: String = String::new(), check name;
        /// better a permanent name: `scanhub probe` lists them; or tcp:HOST:PORT, or file:PATH
        ///
        /// A tty, `tcp:HOST:PORT`, or `file:PATH[?rate=max]`.
        port: Option<String> = None, check optional(port), example "\"/dev/ttyUSB0\"";
        /// lms200, lms211, lms221 or lms291: other settings are refused
        ///
        /// Expected type of an LMS: `lms200`, `lms211`, `lms221` or `lms291`. Settings that it does not support are refused.
        expected_type ("type"): Option<String> = None;
        /// auto: the hub finds the scanner
        ///
        /// The name of a family, see below, or `auto`, the default: the hub finds the scanner.
        family: Option<String> = None, example "\"auto\"";
        /// auto, or the name of a model
        ///
        /// The name of a model, see below, or `auto`, the default.
        model: Option<String> = None, example "\"auto\"";
        /// of a scan, 2 to 8192; default: as many points as the model measures per revolution
        ///
        /// Beams per scan for a rotating scanner, 2 to 8192. Default: as many points as the model measures per
        /// revolution.
        beams: Option<i64> = None, example "450";
        /// degrees, 100 or 180
        ///
        /// Angle of view of an LMS in degrees: 100 or 180.
        angle: Option<f64> = None, example "180";
        /// degrees, 0.25, 0.5 or 1
        ///
        /// Angle between two beams of an LMS in degrees: 0.25, 0.5 or 1.
        resolution: Option<f64> = None, example "0.5";
        /// mm or cm, compared with the sensor's, never written
        ///
        /// Expected unit of an LMS: `mm` or `cm`. It is compared, never written.
        unit: Option<String> = None, example "\"mm\"";
        /// measuring mode, for a recording that does not contain it
        ///
        /// Scan mode of an RPLIDAR, or measuring mode of a recording of an LMS, see below.
        mode: Option<toml::Value> = None, example "0x01";
        /// run, or stop: the motor stops while no program subscribes
        ///
        /// `run`; or `stop`: the motor of an RPLIDAR stops while no program subscribes.
        idle: Option<String> = None, example "\"run\"";
        /// the rate to stream at: 500000, 38400, 19200 or 9600
        ///
        /// Rate at which an LMS streams: 500000, 38400, 19200 or 9600. Default: 500000, or 38400 on RS-232
        /// ([scanners.md](scanners.md)).
        baud: Option<i64> = None, example "500000";
        /// in the robot's frame: meters, radians
        pose: PoseKeys = PoseKeys::default();
        /// see `[zones]`
        zones: ZonesKeys = ZonesKeys::default();
        /// see `[marks]`
        marks: MarksKeys = MarksKeys::default();
        /// see `[lines]`
        lines: LinesKeys = LinesKeys::default();
        /// see `[motion]`
        motion: MotionKeys = MotionKeys::default();
        /// see `[background]`
        background: BackgroundKeys = BackgroundKeys::default();
        /// see `[early]`
        early: EarlyKeys = EarlyKeys::default();
    }
}

impl LinkKeys {
    /// Returns its sections, each with its name.
    pub(crate) fn sections(&self) -> [(&'static str, &dyn Section); 7] {
        [
            ("pose", &self.pose),
            ("zones", &self.zones),
            ("marks", &self.marks),
            ("lines", &self.lines),
            ("motion", &self.motion),
            ("early", &self.early),
            ("background", &self.background),
        ]
    }
}

fn name(_: &str, name: &str) -> CheckResult {
    check_sensor(name).map_err(|failure| invalid_value(failure.message, failure.hint))
}

fn port(_: &str, port: &str) -> CheckResult {
    let remedy = "name a tty, tcp:HOST:PORT, or file:PATH, which may end with ?rate=max";
    PortSpec::parse(port).map(drop).map_err(|what| invalid_value(what, remedy))
}

/// Maximum number of links of one hub.
pub(crate) const MAX_LINKS: usize = 256;

/// Shared memory and descriptors that links need.
pub mod resource_estimate {
    use scanhub_schema::Topic;
    use scanhub_schema::limits::TopicLimits;
    use scanhub_shm::resource_limits::{self, sensor_bytes};

    /// Returns the number of bytes of shared memory for links with topics for `limits`, and their first subscribers.
    pub fn memory(limits: &[TopicLimits]) -> u64 {
        limits.iter().map(|limits| sensor_bytes(&Topic::OF_LINKS, limits)).sum::<u64>() + BASE_MEMORY
    }

    /// Returns the number of bytes of their longest shared-memory segment.
    pub fn longest_segment(limits: &[TopicLimits]) -> u64 {
        limits
            .iter()
            .map(|limits| resource_limits::longest_segment(&Topic::OF_LINKS, limits))
            .max()
            .unwrap_or_default()
    }

    /// Returns the number of descriptors for `links` links and a first subscriber of each, in addition to those that are
    /// open from the start.
    pub fn descriptors(links: usize) -> u64 {
        BASE_DESCRIPTORS + links as u64 * LINK_DESCRIPTORS
    }

    /// Descriptors that belong to no link: 16 stay open, and more are open while they are created.
    const BASE_DESCRIPTORS: u64 = 24;
    /// Descriptors of a link: four for each of its services, which are the topics and the event. The others are for its
    /// port, the lock of its name, and a first subscriber.
    const LINK_DESCRIPTORS: u64 = 4 * (Topic::OF_LINKS.len() as u64 + 1) + 7;
    /// Bytes of the control service, of everything else that belongs to no link, and of the first subscribers.
    const BASE_MEMORY: u64 = 512 * 1024;
}
