//! Circles, reflectors and people as `visualization_msgs/msg/MarkerArray`. Refuses to know how they are found.

use scanhub_schema::{Header, Marks, TrackState, Tracks, Verdict, Zones};

use crate::BASE_FRAME;
use crate::cdr::Cdr;

/// Writes the circles of `zones` to the end of `message`: thin discs around the robot's centre, the largest lowest; red
/// where something is inside, else green, all of them grey if the verdict is unknown. Who draws them removes them a second
/// after the last message.
pub fn zone_markers(message: &mut Vec<u8>, header: &Header, zones: &Zones) {
    let mut cdr = Cdr::begin(message);
    cdr.u32(zones.zones().len() as u32);
    for (place, zone) in zones.zones().iter().enumerate() {
        let color = match (zones.verdict(), zone.violated) {
            (Verdict::Unknown, 0) => GREY,
            (_, 0) => GREEN,
            _ => RED,
        };
        let across = f64::from(zone.radius_mm) / 500.0;
        let shape = Shape {
            stamp_ns: header.wall_ns,
            frame: BASE_FRAME,
            name: "zones",
            number: place as u32,
            kind: CYLINDER,
            action: ADD,
            place: [0.0, 0.0, DISC * place as f64],
            scale: [across, across, DISC],
            color,
            text: "",
        };
        shape.write(&mut cdr, [].into_iter());
    }
}

/// Writes `marks` of the frame `frame` to the end of `message`: one list of spheres, each where its mark was seen; removed
/// if there are none. Who draws them removes them a second after the last message.
pub fn mark_markers(message: &mut Vec<u8>, frame: &str, header: &Header, marks: &Marks) {
    let mut cdr = Cdr::begin(message);
    cdr.u32(1);
    let shape = Shape {
        stamp_ns: header.wall_ns,
        frame,
        name: "marks",
        number: 0,
        kind: SPHERE_LIST,
        action: if marks.marks().is_empty() { DELETE } else { ADD },
        place: [0.0; 3],
        scale: [SPHERE; 3],
        color: YELLOW,
        text: "",
    };
    let points = marks.marks().iter().map(|mark| {
        let (sin, cos) = (f64::from(mark.angle_mdeg) / 1000.0).to_radians().sin_cos();
        [cos, sin].map(|axis| f64::from(mark.range_dmm) / 10_000.0 * axis)
    });
    shape.write(&mut cdr, points);
}

/// Writes the people of `tracks`, in the map called `frame`, to the end of `message`: for each one who is known a column and above
/// it the number; grey who is not seen now. Who draws them removes them a second after the last message.
pub fn people_markers(message: &mut Vec<u8>, frame: &str, header: &Header, tracks: &Tracks) {
    let known = || tracks.tracks().iter().filter(|track| track.state() != TrackState::Tentative);
    let mut cdr = Cdr::begin(message);
    cdr.u32(2 * known().count() as u32);
    for track in known() {
        let number = track.id.to_string();
        let at = |z: f64| [track.x_m.into(), track.y_m.into(), z];
        let column = Shape {
            stamp_ns: header.wall_ns,
            frame,
            name: "people",
            // Markers are told apart by an int32.
            number: (track.id & 0x7FFF_FFFF) as u32,
            kind: CYLINDER,
            action: ADD,
            place: at(PERSON / 2.0),
            scale: [SHOULDERS, SHOULDERS, PERSON],
            color: if track.state() == TrackState::Confirmed { BLUE } else { GREY },
            text: "",
        };
        column.write(&mut cdr, [].into_iter());
        let words = Shape {
            name: "numbers",
            kind: WORDS,
            place: at(PERSON + LETTERS),
            scale: [0.0, 0.0, LETTERS],
            color: WHITE,
            text: &number,
            ..column
        };
        words.write(&mut cdr, [].into_iter());
    }
}

/// What is drawn: `visualization_msgs/msg/Marker` without what only other shapes have.
struct Shape<'a> {
    stamp_ns: u64,
    frame: &'a str,
    name: &'a str,
    number: u32,
    kind: u32,
    action: u32,
    /// x, y and z of its centre in metres.
    place: [f64; 3],
    scale: [f64; 3],
    color: [f32; 4],
    /// What it says, if it is words.
    text: &'a str,
}

impl Shape<'_> {
    fn write(&self, cdr: &mut Cdr<'_>, points: impl ExactSizeIterator<Item = [f64; 2]>) {
        cdr.header(self.stamp_ns, self.frame);
        cdr.text(self.name);
        [self.number, self.kind, self.action].into_iter().for_each(|value| cdr.u32(value));
        // Where it is, not turned, how large.
        let whither = [0.0, 0.0, 0.0, 1.0];
        self.place.into_iter().chain(whither).chain(self.scale).for_each(|value| cdr.f64(value));
        self.color.into_iter().for_each(|value| cdr.f32(value));
        // How long it is drawn, in seconds and nanoseconds.
        [1, 0].into_iter().for_each(|value| cdr.u32(value));
        cdr.bool(false);
        cdr.u32(points.len() as u32);
        points.for_each(|[x, y]| [x, y, 0.0].into_iter().for_each(|axis| cdr.f64(axis)));
        // No colours of its own for each point; no texture: its name, its picture with frame, stamp and format, its corners.
        cdr.u32(0);
        cdr.text("");
        cdr.header(0, "");
        cdr.text("");
        cdr.u32(0);
        cdr.u32(0);
        // Its words, and no mesh: its name, its file, whether its colours are used.
        cdr.text(self.text);
        cdr.text("");
        cdr.text("");
        cdr.u32(0);
        cdr.bool(false);
    }
}

const CYLINDER: u32 = 3;
const SPHERE_LIST: u32 = 7;
const WORDS: u32 = 9;
const ADD: u32 = 0;
const DELETE: u32 = 2;
/// Metres.
const DISC: f64 = 0.01;
/// Metres across.
const SPHERE: f64 = 0.1;
/// Metres: how tall a person is drawn, how broad, and the number above.
const PERSON: f64 = 1.7;
const SHOULDERS: f64 = 0.4;
const LETTERS: f64 = 0.3;
const BLUE: [f32; 4] = [0.1, 0.4, 0.9, 0.8];
const WHITE: [f32; 4] = [1.0; 4];
const GREEN: [f32; 4] = [0.1, 0.7, 0.2, 0.25];
const RED: [f32; 4] = [0.9, 0.1, 0.1, 0.4];
const GREY: [f32; 4] = [0.5, 0.5, 0.5, 0.25];
const YELLOW: [f32; 4] = [1.0, 0.8, 0.0, 1.0];

#[cfg(test)]
mod tests {
    use scanhub_schema::{Mark, Track, Zone};

    use super::*;
    use crate::{MARKER_ARRAY, Value, read};

    fn header() -> Header {
        Header { wall_ns: 3_000_000_005, ..Header::default() }
    }

    #[test]
    fn circles_are_discs_around_the_robot() {
        let mut zones = Zones { verdict: Verdict::Slow as u8, count: 2, ..Zones::unknown() };
        zones.zone_array[0] = Zone { radius_mm: 1500, violated: 1, ..Zone::default() };
        zones.zone_array[1] = Zone { radius_mm: 500, ..Zone::default() };
        let drawn = |zones: &Zones| {
            let mut message = Vec::new();
            zone_markers(&mut message, &header(), zones);
            read(&MARKER_ARRAY, &message).unwrap()
        };
        let told = drawn(&zones);
        assert_eq!(told.sequence("markers").map(<[Value]>::len), Some(2));
        for (place, across, red) in [(0, 3.0, 0.9_f32), (1, 1.0, 0.1)] {
            let number = |path: &str| told.number(&format!("markers.{place}.{path}"));
            assert_eq!(told.text(&format!("markers.{place}.header.frame_id")), Some("base_link"));
            assert_eq!((number("header.stamp.sec"), number("header.stamp.nanosec")), (Some(3.0), Some(5.0)));
            assert_eq!(
                (number("id"), number("type"), number("action")),
                (Some(f64::from(place)), Some(3.0), Some(0.0))
            );
            assert_eq!((number("scale.x"), number("scale.y")), (Some(across), Some(across)));
            assert_eq!((number("pose.orientation.w"), number("lifetime.sec")), (Some(1.0), Some(1.0)));
            assert_eq!(number("color.r"), Some(red.into()));
        }
        zones.verdict = Verdict::Unknown as u8;
        let told = drawn(&zones);
        let grey = f64::from(GREY[0]);
        assert_eq!(
            (told.number("markers.0.color.r"), told.number("markers.1.color.r")),
            (Some(RED[0].into()), Some(grey))
        );
    }

    #[test]
    fn marks_are_points_of_one_list() {
        let drawn = |marks: &Marks| {
            let mut message = vec![7];
            mark_markers(&mut message, "rear", &header(), marks);
            read(&MARKER_ARRAY, &message[1..]).unwrap()
        };
        let mut marks = Marks { count: 2, ..Marks::default() };
        marks.mark_array[0] = Mark { angle_mdeg: 0, range_dmm: 20_000, ..Mark::default() };
        marks.mark_array[1] = Mark { angle_mdeg: 90_000, range_dmm: 15_000, ..Mark::default() };
        let told = drawn(&marks);
        assert_eq!((told.number("markers.0.type"), told.number("markers.0.action")), (Some(7.0), Some(0.0)));
        assert_eq!(told.text("markers.0.header.frame_id"), Some("rear"));
        assert_eq!(told.sequence("markers.0.points").map(<[Value]>::len), Some(2));
        assert_eq!(
            (told.number("markers.0.points.0.x"), told.number("markers.0.points.0.y")),
            (Some(2.0), Some(0.0))
        );
        assert_eq!(told.number("markers.0.points.1.y"), Some(1.5));
        let told = drawn(&Marks::default());
        assert_eq!(told.number("markers.0.action"), Some(2.0));
    }

    #[test]
    fn people_are_columns_with_their_numbers() {
        let mut tracks = Tracks::default();
        for (id, state) in [(5, TrackState::Confirmed), (6, TrackState::Tentative), (7, TrackState::Hidden)] {
            tracks.push(Track { id, state: state as u8, x_m: id as f32, y_m: -1.0, ..Track::default() });
        }
        let mut message = Vec::new();
        people_markers(&mut message, "house", &header(), &tracks);
        let told = read(&MARKER_ARRAY, &message).unwrap();
        assert_eq!(told.sequence("markers").map(<[Value]>::len), Some(4), "nobody who is tentative");
        for (place, id, kind, text) in
            [(0, 5.0, 3.0, ""), (1, 5.0, 9.0, "5"), (2, 7.0, 3.0, ""), (3, 7.0, 9.0, "7")]
        {
            let number = |path: &str| told.number(&format!("markers.{place}.{path}"));
            assert_eq!((number("id"), number("type"), number("action")), (Some(id), Some(kind), Some(0.0)));
            assert_eq!((number("pose.position.x"), number("pose.position.y")), (Some(id), Some(-1.0)));
            assert_eq!(told.text(&format!("markers.{place}.text")), Some(text));
            assert_eq!(told.text(&format!("markers.{place}.header.frame_id")), Some("house"));
        }
    }
}
