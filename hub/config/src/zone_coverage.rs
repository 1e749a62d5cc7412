//! Checks that a sensor's beams cover enough of its largest zone to ever detect a violation. A zone that cannot be
//! violated is an error of the configuration. The real sensor is unknown here, so the hub checks again with its scans.

use std::rc::Rc;

use preprocess::zones::{Check, Settings};
use schema::{Failure, Kind, Scan, ScanHead, Zones};

use crate::link::Link;
use crate::processing::{Processing, Sections};
use crate::sources::Origin;

/// A link with the sections that its settings come from.
pub(crate) struct ZoneCoverage<'a> {
    pub(crate) link: &'a Link,
    /// Place where the link starts.
    pub(crate) place: &'a str,
    /// Sections for all links, then for this one, in the order of the sources.
    pub(crate) said: Vec<&'a (Rc<Origin>, Sections)>,
}

impl ZoneCoverage<'_> {
    /// Returns [`Kind::Configuration`] with the place of the cause if fewer beams can detect something in the largest
    /// zone than a violation requires.
    pub(crate) fn check(&self) -> Result<(), Failure> {
        let processing = &self.link.processing;
        let settings = processing.zones.settings();
        let (beams, min_beams) = (self.link.scan_heads()[0].count.into(), settings.min_beams);
        if usize::from(min_beams) > beams {
            let what = format!("min_beams = {min_beams}, and a scan has {beams} beams");
            return Err(self.refuse(Sections::min_beams, what, "the default is one beam"));
        }
        let detecting = self.detecting(processing, &settings);
        if detecting >= min_beams {
            return Ok(());
        }
        let circle_m = f64::from(settings.radii_mm.first().copied().unwrap_or_default()) / 1000.0;
        let meeting = self.detecting(processing, &Settings { self_min: &[], ..settings });
        let (place, what, remedy): (Place, _, _) = match (meeting, detecting) {
            (0, _) => (
                Sections::pose,
                format!("no beam sees into the circle of {circle_m} m"),
                "correct the sensor's pose, or set a circle that it sees: link.NAME.zones.radii",
            ),
            (_, 0) => (
                Sections::self_min,
                format!("self_min covers every beam up to the circle of {circle_m} m"),
                "shorten self_min: it is only for the robot's own body",
            ),
            _ => (
                Sections::min_beams,
                format!("min_beams = {min_beams}, and {detecting} can see the circle of {circle_m} m"),
                "set fewer beams, a larger circle, or another pose or self_min",
            ),
        };
        Err(self.refuse(place, what, remedy))
    }

    /// Returns the maximum number of beams that can detect something in the largest zone.
    fn detecting(&self, processing: &Processing, settings: &Settings<'_>) -> u16 {
        let of_head = |head: &ScanHead| {
            let beams = usize::from(head.count);
            let mut check = Check::new(processing.pose, settings, beams);
            check.update(&Scan::of(*head, &vec![0; beams]), &mut Zones::unknown());
            check.telling()
        };
        self.link.scan_heads().iter().map(of_head).max().unwrap_or_default()
    }

    /// Returns the failure at the last place where `place` is set, or at the start of the link if it is not set.
    fn refuse(&self, place: Place, what: String, remedy: &str) -> Failure {
        let at = |(origin, sections): &&(Rc<Origin>, Sections)| Some(origin.place(Some(place(sections)?)));
        let place = self.said.iter().rev().find_map(at).unwrap_or_else(|| self.place.to_owned());
        let message = format!("{place}: link {}: {what}", self.link.name);
        Failure::new(Kind::Configuration, message, remedy.replace("NAME", &self.link.name))
    }
}

type Place = fn(&Sections) -> Option<std::ops::Range<usize>>;
