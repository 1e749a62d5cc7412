//! A learned background as text: the file of `scanhub background SENSOR save` with where the sensor sat and when it was
//! written. What is read is checked against the link that would begin with it. Refuses to know where files lie.

use config::Link;
use schema::{Background, Failure, Kind, Pose, SavedModel, as_json};
use serde::{Deserialize, Serialize};

/// A model, where its sensor sat, and when it was written, in nanoseconds since 1970.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct KeptBackground {
    pub(super) model: Box<Background>,
    pub(super) pose: Pose,
    pub(super) wall_ns: u64,
}

#[derive(Deserialize, Serialize)]
struct Place {
    pose: PoseText,
    wall_ns: u64,
}

#[derive(Deserialize, Serialize)]
struct PoseText {
    x: f64,
    y: f64,
    yaw: f64,
    upside_down: bool,
}

#[derive(Serialize)]
struct File<M> {
    #[serde(flatten)]
    model: M,
    #[serde(flatten)]
    place: Place,
}

impl KeptBackground {
    /// The text for `sensor`, a line.
    pub(super) fn text(&self, sensor: &str) -> Result<String, Failure> {
        let Pose { x_m: x, y_m: y, yaw_rad: yaw, upside_down, .. } = self.pose;
        let pose = PoseText { x, y, yaw, upside_down: upside_down != 0 };
        let file = File { model: as_json(sensor, &self.model), place: Place { pose, wall_ns: self.wall_ns } };
        let written = serde_json::to_string(&file);
        written.map(|text| text + "\n").map_err(|error| {
            Failure::new(Kind::Failed, format!("the background of {sensor} is no JSON: {error}"), "")
        })
    }

    /// What `text`, found at `place`, says of the sensor of `link`; or why that is not one to begin with.
    pub(super) fn read(text: &str, place: &str, link: &Link) -> Result<KeptBackground, String> {
        let saved = SavedModel::parse(text.as_bytes(), place).map_err(|failure| failure.message)?;
        let Place { pose, wall_ns } = serde_json::from_str(text)
            .map_err(|error| format!("{place} does not contain its time: {error}"))?;
        let model = saved.model;
        if saved.sensor != link.name {
            return Err(format!("{place} is the background of {}", saved.sensor));
        }
        if let Err(wanted) = link.fits(&model) {
            let (count, of) = (model.count, model.unit_um / 1000);
            return Err(format!(
                "{place} has {count} beams in units of {of} mm, the link is configured for {wanted}"
            ));
        }
        let Pose { x_m, y_m, yaw_rad, upside_down, .. } = link.processing.pose;
        let is_near = |said: f64, set: f64| (said - set).abs() < SAME;
        let is_there = is_near(pose.x, x_m) && is_near(pose.y, y_m) && is_near(pose.yaw, yaw_rad);
        if !is_there || pose.upside_down != (upside_down != 0) {
            return Err(format!("{place} is of another pose: the sensor was moved"));
        }
        Ok(KeptBackground { model, pose: link.processing.pose, wall_ns })
    }
}

/// Metres and radians that are the same: what a number loses as text is far less.
const SAME: f64 = 1e-9;

#[cfg(test)]
mod tests {
    use super::*;
    use config::{Config, Sources};
    use schema::BackgroundHead;

    fn link(set: &[&str]) -> Link {
        let set = set.iter().map(|flag| (*flag).to_owned()).collect();
        let sources = Sources { files: Vec::new(), links: vec!["front=/dev/x".into()], set };
        Config::load(&sources).unwrap().links.remove(0)
    }

    fn learned(pose: Pose) -> KeptBackground {
        let head = BackgroundHead {
            first_angle: -90_f64.to_radians(),
            step: 0.5_f64.to_radians(),
            generation: 3,
            unit_um: 1000,
            taught: 2,
            ..BackgroundHead::default()
        };
        let mut model = Background::of(head, &[0; 361]);
        model.ranges_mut()[..2].copy_from_slice(&[4000, Background::FAR]);
        KeptBackground { model, pose, wall_ns: 1_790_000_000_123_456_789 }
    }

    #[test]
    fn what_was_learned_comes_back_for_the_same_sensor_at_the_same_place() {
        let set =
            ["link.front.pose.x=0.1", "link.front.pose.yaw=-1.5708", "link.front.pose.upside_down=true"];
        let own = link(&set);
        let kept = learned(own.processing.pose);
        let text = kept.text("front").unwrap();
        assert_eq!(KeptBackground::read(&text, "f", &own), Ok(kept));
        let saved = SavedModel::parse(text.as_bytes(), "f").unwrap();
        assert_eq!((saved.sensor.as_str(), saved.model.taught), ("front", 2), "it can be loaded as any");
        for (change, why) in [
            ("link.front.pose.x=0.101", "another pose"),
            ("link.front.pose.yaw=1.5708", "another pose"),
            ("link.front.pose.upside_down=false", "another pose"),
            ("link.front.resolution=1", "the link is configured for 181 beams in units of 1 mm"),
            ("link.front.unit=cm", "the link is configured for 361 beams in units of 10 mm"),
        ] {
            let other = link(&[&set[..], &[change]].concat());
            let refusal = KeptBackground::read(&text, "f", &other).unwrap_err();
            assert!(refusal.contains(why), "{change}: {refusal}");
        }
    }

    #[test]
    fn what_is_damaged_is_refused() {
        let own = link(&[]);
        let text = learned(own.processing.pose).text("front").unwrap();
        for (from, to) in [
            ("\"front\"", "\"rear\""),
            ("\"wall_ns\"", "\"wall\""),
            ("\"taught\":2", "\"taught\":3"),
            ("\"yaw\":0.0", "\"yaw\":null"),
        ] {
            assert!(text.contains(from), "{from}");
            assert!(KeptBackground::read(&text.replacen(from, to, 1), "f", &own).is_err(), "{from}");
        }
        assert!((0..text.len() - 1).all(|length| KeptBackground::read(&text[..length], "f", &own).is_err()));
    }
}
