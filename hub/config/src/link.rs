//! Links of a hub, each with its port and the settings of its scanner: the keys of the sources, and the values in
//! effect.

use scanhub_drivers::{Features, Settings, scan_heads};
use scanhub_port::PortSpec;
use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{Background, Failure, Family, ScanHead, check_sensor};

use crate::processing::{
    BackgroundKeys, EarlyKeys, LinesKeys, MarksKeys, MotionKeys, PoseKeys, Processing, ZonesKeys,
};
use crate::scanner::Scanner;
use crate::section::{CheckResult, Section, invalid_value, optional, section};

/// Configuration in effect.
#[derive(Clone, Debug, PartialEq)]
pub struct Config {
    /// Links in their order. The number of a sensor is the index of its link.
    pub links: Vec<Link>,
    /// Limits for the topics of a link, except those that depend on its scanner.
    pub limits: TopicLimits,
}

impl Config {
    /// Returns the limits for the topics of each link.
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

    /// Returns the remedy for a lack of shared memory, which is to set the family of a link. Returns `None` if all
    /// links have a family.
    pub fn memory_remedy(&self) -> Option<String> {
        let link = self.links.iter().find(|link| link.family().is_none())?;
        let families = Family::ALL.map(Family::name).join(", ");
        Some(format!("family = \"auto\" needs the most: set link.{}.family to one of {families}", link.name))
    }
}

/// One link, with the settings of its scanner and of the processing.
#[derive(Clone, Debug, PartialEq)]
pub struct Link {
    /// Name of the sensor in topics.
    pub name: String,
    /// Port of the link.
    pub port: PortSpec,
    /// Family and settings of the link's scanner.
    pub scanner: Scanner,
    /// Settings for processing the scans.
    pub processing: Processing,
}

impl Link {
    /// Returns the baud rate at which the hub opens the port, in bits per second.
    pub fn rate(&self) -> u32 {
        self.scanner.rate()
    }

    /// Returns the highest baud rate that the scanner can have at this port.
    pub fn max_rate(&self) -> u32 {
        self.scanner.max_rate_at(&self.port)
    }

    /// Returns the maximum number of beams of a scan.
    pub fn max_beams(&self) -> usize {
        self.scanner.max_beams()
    }

    /// Returns the limits for the topics of this link. `all` are the limits that do not depend on the scanner.
    pub fn limits(&self, all: &TopicLimits) -> TopicLimits {
        let &Features { array_flags: contents, max_telegram, .. } = self.scanner.features();
        TopicLimits { beams: self.max_beams(), contents, telegram: max_telegram, ..*all }
    }

    /// Returns the family of the scanner. Returns `None` if the hub searches for the family.
    pub fn family(&self) -> Option<Family> {
        self.scanner.family
    }

    /// Returns the names of the keys whose values differ in `other`, apart from the keys for processing.
    pub fn differences(&self, other: &Link) -> Vec<&'static str> {
        let port = (self.port != other.port).then_some("port");
        port.into_iter().chain(self.scanner.differences(&other.scanner)).collect()
    }

    /// Returns all scan heads that the scanner may have, as far as they are known. The scan heads with the most beams
    /// come first.
    pub fn scan_heads(&self) -> Vec<ScanHead> {
        let families = self.family().map_or(Family::ALL.to_vec(), |family| vec![family]);
        let settings = self.settings();
        let mut heads: Vec<_> =
            families.into_iter().flat_map(|family| scan_heads(family, &settings)).collect();
        heads.sort_by_key(|head| std::cmp::Reverse(head.count));
        heads
    }

    /// Returns the settings of a session at the port of this link. A session cannot send to a recording.
    pub fn settings(&self) -> Settings {
        self.scanner.settings_at(&self.port, matches!(self.port, PortSpec::File { .. }))
    }

    /// Checks whether a background `model` may belong to the sensor of this link.
    ///
    /// # Errors
    ///
    /// Returns the expected number of beams and the expected unit as text if the model has another number of beams or
    /// another unit.
    pub fn check_background(&self, model: &Background) -> Result<(), String> {
        let heads = self.scan_heads();
        let count = heads[0].count;
        let (fits, beams) = match self.scanner.is_auto() {
            true => (model.count <= count, format!("at most {count}")),
            false => (model.count == count, count.to_string()),
        };
        // The scanner of an unknown family may have any unit.
        let unit_um = if heads.len() > 1 { model.unit_um } else { heads[0].unit_um };
        if fits && model.unit_um == unit_um {
            return Ok(());
        }
        Err(format!("{beams} beams in units of {} mm", unit_um / 1000))
    }
}

section! {
    /// Keys of a link. The keys of its scanner are also in [`scanhub_drivers::Key`], and the family checks their
    /// values.
    pub(crate) struct LinkKeys: "keys of a link, as { name = \"front\", port = \"/dev/ttyUSB0\" }" {
        /// first part of topic names: a-z, 0-9, _ and -
        ///
        /// The sensor's name in topics: at most 24 of a-z, 0-9, _ and -, but not `robot`.
        name: String = String::new(), check name;
        /// better a permanent name: `scanhub probe` lists them; or tcp:HOST:PORT, or file:PATH
        ///
        /// A tty, `tcp:HOST:PORT`, or `file:PATH[?rate=max]`.
        port: Option<String> = None, check optional(port), example "\"/dev/ttyUSB0\"";
        /// expected type: lms200, lms211, lms221 or lms291
        ///
        /// Expected type of an LMS: `lms200`, `lms211`, `lms221` or `lms291`.
        expected_type ("type"): Option<String> = None;
        /// auto: the hub finds the scanner
        ///
        /// `lms`, `ld` or `rplidar`. With `auto`, the default, the hub finds the family.
        family: Option<String> = None, example "\"auto\"";
        /// auto, or the name of a model
        ///
        /// Model of a rotating scanner, or `auto`, the default.
        model: Option<String> = None, example "\"auto\"";
        /// beams per scan, 2 to 8192; default: as many points as the model measures per revolution
        ///
        /// Beams per scan of a rotating scanner, 2 to 8192. Default: the points that the model measures per revolution.
        beams: Option<i64> = None, example "450";
        /// degrees, 100 or 180
        ///
        /// Angle of view of an LMS in degrees: 100 or 180.
        angle: Option<f64> = None, example "180";
        /// degrees, 0.25, 0.5 or 1
        ///
        /// Angle between two beams of an LMS in degrees: 0.25, 0.5 or 1.
        resolution: Option<f64> = None, example "0.5";
        /// expected unit: mm or cm
        ///
        /// Expected unit of an LMS: `mm` or `cm`.
        unit: Option<String> = None, example "\"mm\"";
        /// measuring mode, for a recording that does not contain it
        ///
        /// Scan mode of an RPLIDAR, or measuring mode of a recording of an LMS ([mode](#mode)).
        mode: Option<toml::Value> = None, example "0x01";
        /// run, or stop: the motor stops while no program subscribes
        ///
        /// `run` or `stop`. With `stop`, the motor of an RPLIDAR stops while no program subscribes.
        idle: Option<String> = None, example "\"run\"";
        /// baud rate of the stream: 500000, 38400, 19200 or 9600
        ///
        /// Baud rate at which an LMS streams: 500000, 38400, 19200 or 9600. Default: 500000, or 38400 on RS-232
        /// ([scanner-lms.md](scanner-lms.md)).
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
    /// Returns the sections of a link, each with its name.
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

/// Estimates of the shared memory and the descriptors that links need.
pub mod resource_estimate {
    use scanhub_schema::Topic;
    use scanhub_schema::limits::TopicLimits;
    use scanhub_shm::resource_limits::{self, sensor_bytes};

    /// Returns the number of bytes of shared memory for links with topics of these `limits`, including their first
    /// subscribers.
    pub fn memory(limits: &[TopicLimits]) -> u64 {
        limits.iter().map(|limits| sensor_bytes(&Topic::OF_LINKS, limits)).sum::<u64>() + BASE_MEMORY
    }

    /// Returns the length of the longest shared-memory segment of these links, in bytes.
    pub fn longest_segment(limits: &[TopicLimits]) -> u64 {
        limits
            .iter()
            .map(|limits| resource_limits::longest_segment(&Topic::OF_LINKS, limits))
            .max()
            .unwrap_or_default()
    }

    /// Returns the number of descriptors for `links` links and one subscriber of each. Descriptors that are already
    /// open when the hub starts are not included.
    pub fn descriptors(links: usize) -> u64 {
        BASE_DESCRIPTORS + links as u64 * LINK_DESCRIPTORS
    }

    /// Number of descriptors that do not belong to a link. 16 of them stay open, and the others are open only while
    /// topics are created.
    const BASE_DESCRIPTORS: u64 = 24;
    /// Number of descriptors that a link needs: four for each of its services, which are the topics and the event
    /// service, and seven more. The seven descriptors are for the port, the lock of the name, and one subscriber.
    const LINK_DESCRIPTORS: u64 = 4 * (Topic::OF_LINKS.len() as u64 + 1) + 7;
    /// Bytes of shared memory for the control service, for everything else that does not belong to a link, and for the
    /// first subscribers.
    const BASE_MEMORY: u64 = 512 * 1024;
}
