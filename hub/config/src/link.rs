//! The links of a hub, each with its port and the settings of its sensor: values in effect.

use port::Source;
use scanhub_drivers::{Features, Settings, scan_heads};
use schema::limits::TopicLimits;
use schema::{Background, Failure, Family, ScanHead};

use crate::processing::Processing;
use crate::scanner::Scanner;

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
    pub port: Source,
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
        let &Features { contents, max_telegram, .. } = self.scanner.features();
        TopicLimits { beams: self.max_beams(), contents, telegram: max_telegram, ..*all }
    }

    /// Returns the family of its scanner. `None`: it is searched for.
    pub fn family(&self) -> Option<Family> {
        self.scanner.family
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
        self.scanner.settings_at(&self.port, matches!(self.port, Source::File { .. }))
    }

    /// Checks whether `model` may belong to its sensor, as far as that is known.
    ///
    /// # Errors
    ///
    /// Returns the beams and the unit that such a model has, as text.
    pub fn fits(&self, model: &Background) -> Result<(), String> {
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

/// Links of one hub.
pub(crate) const MAX_LINKS: usize = 256;
