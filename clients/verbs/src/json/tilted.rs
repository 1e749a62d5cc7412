//! The classes of mounts, and of what is seen in three dimensions from them. A contract, like its parent module.

use scanhub_schema::{Cloud, Header, Obstacle, Obstacles, Tilt};
use serde::{Serialize, Serializer};

use super::people::thousandths;
use super::{Stamp, Words};

/// Class `tilt`.
pub(crate) fn tilt<'a>(sensor: &'a str, header: &Header, tilt: &Tilt) -> impl Serialize + 'a {
    #[derive(Serialize)]
    struct Line<'a> {
        #[serde(flatten)]
        stamp: Stamp<'a>,
        angle_deg: f64,
        rate_deg_s: Option<f64>,
        #[serde(flatten)]
        flags: Words,
    }
    Line {
        stamp: Stamp::new("tilt", sensor, header),
        angle_deg: degrees(tilt.angle_rad),
        rate_deg_s: tilt.rate_rad_s().map(degrees),
        flags: Words::of(header),
    }
}

/// Class `cloud`.
pub(crate) fn cloud<'a>(sensor: &'a str, header: &Header, cloud: &'a Cloud) -> impl Serialize + 'a {
    #[derive(Serialize)]
    struct Line<'a> {
        #[serde(flatten)]
        stamp: Stamp<'a>,
        sweep: u32,
        generation: u32,
        first: bool,
        last: bool,
        complete: bool,
        doubted: bool,
        #[serde(serialize_with = "point_list")]
        points: &'a Cloud,
        #[serde(serialize_with = "beam_list")]
        beams: &'a Cloud,
        #[serde(serialize_with = "class_list")]
        classes: &'a Cloud,
        #[serde(flatten)]
        flags: Words,
    }
    Line {
        stamp: Stamp::new("cloud", sensor, header),
        sweep: cloud.sweep,
        generation: cloud.generation,
        first: cloud.has(Cloud::FIRST),
        last: cloud.has(Cloud::LAST),
        complete: cloud.has(Cloud::COMPLETE),
        doubted: cloud.has(Cloud::DOUBTED),
        points: cloud,
        beams: cloud,
        classes: cloud,
        flags: Words::of(header),
    }
}

/// Class `obstacles`.
pub fn obstacles<'a>(sensor: &'a str, header: &Header, found: &'a Obstacles) -> impl Serialize + 'a {
    #[derive(Serialize)]
    struct Line<'a> {
        #[serde(flatten)]
        stamp: Stamp<'a>,
        sweep: u32,
        generation: u32,
        complete: bool,
        doubted: bool,
        #[serde(serialize_with = "obstacle_list")]
        obstacles: &'a Obstacles,
        left_out: u32,
        #[serde(flatten)]
        flags: Words,
    }
    Line {
        stamp: Stamp::new("obstacles", sensor, header),
        sweep: found.sweep,
        generation: found.generation,
        complete: found.has(Obstacles::COMPLETE),
        doubted: found.has(Obstacles::DOUBTED),
        obstacles: found,
        left_out: found.left_out,
        flags: Words::of(header),
    }
}

fn point_list<S: Serializer>(cloud: &Cloud, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_seq(cloud.points().iter().map(|point| point.at.map(thousandths)))
}

fn beam_list<S: Serializer>(cloud: &Cloud, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_seq(cloud.points().iter().map(|point| point.beam))
}

fn class_list<S: Serializer>(cloud: &Cloud, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_seq(cloud.points().iter().map(|point| point.class() as u8))
}

fn obstacle_list<S: Serializer>(found: &Obstacles, serializer: S) -> Result<S::Ok, S::Error> {
    #[derive(Serialize)]
    struct Item {
        x_m: f64,
        y_m: f64,
        z_m: f64,
        low_m: [f64; 3],
        high_m: [f64; 3],
        distance_m: f64,
        points: u32,
        foreground: bool,
        near: bool,
    }
    serializer.collect_seq(found.obstacles().iter().map(|one| {
        let [x_m, y_m, z_m] = one.middle.map(thousandths);
        Item {
            x_m,
            y_m,
            z_m,
            low_m: one.low.map(thousandths),
            high_m: one.high.map(thousandths),
            distance_m: thousandths(one.distance_m),
            points: one.points,
            foreground: one.has(Obstacle::FOREGROUND),
            near: one.has(Obstacle::NEAR),
        }
    }))
}

fn degrees(angle_rad: f64) -> f64 {
    (1e4 * angle_rad.to_degrees()).round() / 1e4
}

#[cfg(test)]
mod tests {
    use super::*;
    use scanhub_schema::{CloudHead, CloudPoint};

    const HEAD: &str = r#""sensor":"room","seq":7,"topic_seq":6,"stamp_ns":5,"wall_ns":4,"boot":"00000000000000ab","quality":"clean","#;

    fn header() -> Header {
        Header { seq: 7, topic_seq: 6, stamp_first_ns: 5, wall_ns: 4, boot: 0xAB, ..Header::default() }
    }

    fn letters(line: impl Serialize) -> String {
        serde_json::to_string(&line).unwrap()
    }

    #[test]
    fn angles_to_the_letter() {
        let said = Tilt { angle_rad: -0.5, rate_rad_s: 0.25 };
        let rest = r#""angle_deg":-28.6479,"rate_deg_s":14.3239}"#;
        assert_eq!(letters(tilt("room", &header(), &said)), format!(r#"{{"class":"tilt",{HEAD}{rest}"#));
        let rest = r#""angle_deg":0.0,"rate_deg_s":null}"#;
        let line = letters(tilt("room", &header(), &Tilt::default()));
        assert_eq!(line, format!(r#"{{"class":"tilt",{HEAD}{rest}"#));
    }

    #[test]
    fn points_to_the_letter() {
        let point =
            |beam, point_class| CloudPoint { at: [1.0, -2.5, 0.1234], beam, point_class, reserved: 0 };
        let flags = Cloud::FIRST | Cloud::COMPLETE;
        let head = CloudHead { sweep: 3, generation: 1, flags, ..CloudHead::default() };
        // A class that is not known says nothing.
        let line = letters(cloud("room", &header(), &Cloud::of(head, &[point(90, 2), point(91, 9)])));
        let rest = r#""sweep":3,"generation":1,"first":true,"last":false,"complete":true,"doubted":false,"points":[[1.0,-2.5,0.123],[1.0,-2.5,0.123]],"beams":[90,91],"classes":[2,0]}"#;
        assert_eq!(line, format!(r#"{{"class":"cloud",{HEAD}{rest}"#));
    }

    #[test]
    fn obstacles_to_the_letter() {
        let mut found = Obstacles { sweep: 3, flags: Obstacles::COMPLETE, ..Obstacles::default() };
        found.push(Obstacle {
            middle: [2.0, 0.0, 0.5],
            low: [1.95, -0.05, 0.0],
            high: [2.05, 0.05, 1.0],
            distance_m: 1.95,
            points: 120,
            flags: Obstacle::FOREGROUND,
            ..Obstacle::default()
        });
        let line = letters(obstacles("room", &header(), &found));
        let one = r#"{"x_m":2.0,"y_m":0.0,"z_m":0.5,"low_m":[1.95,-0.05,0.0],"high_m":[2.05,0.05,1.0],"distance_m":1.95,"points":120,"foreground":true,"near":false}"#;
        let rest = format!(
            r#""sweep":3,"generation":0,"complete":true,"doubted":false,"obstacles":[{one}],"left_out":0}}"#
        );
        assert_eq!(line, format!(r#"{{"class":"obstacles",{HEAD}{rest}"#));
    }
}
