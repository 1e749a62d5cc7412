//! Objects that a viewer draws: zones, marks and people as `visualization_msgs/msg/MarkerArray`, and people as
//! `geometry_msgs/msg/PoseArray`.

use scanhub_schema::{Header, Marks, Track, TrackState, Tracks, Verdict, Zones};

use crate::BASE_FRAME;
use crate::cdr::Cdr;

/// Appends `zones` to `message` as a MarkerArray: thin discs around the robot's center, the largest one lowest. A disc
/// is red if its zone is violated. Otherwise, it is green, or gray if the verdict is unknown. A viewer removes the
/// discs one second after the last message.
pub fn zone_markers(message: &mut Vec<u8>, header: &Header, zones: &Zones) {
    let mut cdr = Cdr::begin(message);
    cdr.u32(zones.zones().len() as u32);
    for (index, zone) in zones.zones().iter().enumerate() {
        let color = match (zones.verdict(), zone.violated) {
            (Verdict::Unknown, 0) => GRAY,
            (_, 0) => GREEN,
            _ => RED,
        };
        let diameter = f64::from(zone.radius_mm) / 500.0;
        let shape = Shape {
            namespace: "zones",
            id: index as u32,
            position: [0.0, 0.0, DISC_HEIGHT_M * index as f64],
            scale: [diameter, diameter, DISC_HEIGHT_M],
            color,
            ..Shape::new(header, BASE_FRAME)
        };
        shape.write(&mut cdr, [].into_iter());
    }
}

/// Appends `marks` in frame `frame` to `message` as a MarkerArray: a list of spheres, or the removal of the list if
/// there are no marks. A viewer removes the spheres one second after the last message.
pub fn mark_markers(message: &mut Vec<u8>, frame: &str, header: &Header, marks: &Marks) {
    let mut cdr = Cdr::begin(message);
    cdr.u32(1);
    let shape = Shape {
        namespace: "marks",
        kind: SPHERE_LIST,
        action: if marks.marks().is_empty() { DELETE } else { ADD },
        scale: [MARK_DIAMETER_M; 3],
        color: YELLOW,
        ..Shape::new(header, frame)
    };
    let points = marks.marks().iter().map(|mark| {
        let (sin, cos) = (f64::from(mark.angle_mdeg) / 1000.0).to_radians().sin_cos();
        [cos, sin].map(|axis| f64::from(mark.range_dmm) / 10_000.0 * axis)
    });
    shape.write(&mut cdr, points);
}

/// Appends the people of `tracks` in the map `frame` to `message` as a MarkerArray: a column for each track that is not
/// tentative, with the ID of the track above the column. The column is gray if no sensor sees the person now. A viewer
/// removes the columns one second after the last message.
pub fn people_markers(message: &mut Vec<u8>, frame: &str, header: &Header, tracks: &Tracks) {
    let mut cdr = Cdr::begin(message);
    cdr.u32(2 * established_tracks(tracks).count() as u32);
    for track in established_tracks(tracks) {
        let id = track.id.to_string();
        let at = |z: f64| [track.x_m.into(), track.y_m.into(), z];
        let column = Shape {
            namespace: "people",
            // The ID of a marker is an int32.
            id: (track.id & 0x7FFF_FFFF) as u32,
            position: at(PERSON_HEIGHT_M / 2.0),
            scale: [PERSON_DIAMETER_M, PERSON_DIAMETER_M, PERSON_HEIGHT_M],
            color: if track.state() == TrackState::Confirmed { BLUE } else { GRAY },
            ..Shape::new(header, frame)
        };
        column.write(&mut cdr, [].into_iter());
        let label = Shape {
            namespace: "numbers",
            kind: TEXT_VIEW_FACING,
            position: at(PERSON_HEIGHT_M + LABEL_HEIGHT_M),
            scale: [0.0, 0.0, LABEL_HEIGHT_M],
            color: WHITE,
            text: &id,
            ..column
        };
        label.write(&mut cdr, [].into_iter());
    }
}

/// Appends the people of `tracks` in the map `frame` to `message` as a PoseArray: a pose for each track that is not
/// tentative. The direction of a pose is the direction in which the person walks, or the x axis if the person stands.
pub fn people_poses(message: &mut Vec<u8>, frame: &str, header: &Header, tracks: &Tracks) {
    let mut cdr = Cdr::begin(message);
    cdr.header(header.wall_ns, frame);
    cdr.u32(established_tracks(tracks).count() as u32);
    for track in established_tracks(tracks) {
        let [x, y, vx, vy] = [track.x_m, track.y_m, track.vx_m_s, track.vy_m_s].map(f64::from);
        let walks = vx.hypot(vy) >= MIN_WALKING_SPEED_M_S;
        let (sin, cos) = if walks { (vy.atan2(vx) / 2.0).sin_cos() } else { (0.0, 1.0) };
        [x, y, 0.0, 0.0, 0.0, sin, cos].into_iter().for_each(|value| cdr.f64(value));
    }
}

/// Returns the tracks that are not tentative.
fn established_tracks(tracks: &Tracks) -> impl Iterator<Item = &Track> {
    tracks.tracks().iter().filter(|track| track.state() != TrackState::Tentative)
}

/// A `visualization_msgs/msg/Marker`, without the fields that are only for shapes of other kinds.
struct Shape<'a> {
    stamp_ns: u64,
    frame: &'a str,
    namespace: &'a str,
    id: u32,
    kind: u32,
    action: u32,
    /// x, y and z of the center in meters.
    position: [f64; 3],
    scale: [f64; 3],
    color: [f32; 4],
    /// Text of a shape of kind [`TEXT_VIEW_FACING`].
    text: &'a str,
}

impl<'a> Shape<'a> {
    /// Returns a cylinder with the stamp of `header`.
    fn new(header: &Header, frame: &'a str) -> Shape<'a> {
        Shape {
            stamp_ns: header.wall_ns,
            frame,
            namespace: "",
            id: 0,
            kind: CYLINDER,
            action: ADD,
            position: [0.0; 3],
            scale: [0.0; 3],
            color: WHITE,
            text: "",
        }
    }

    fn write(&self, cdr: &mut Cdr<'_>, points: impl ExactSizeIterator<Item = [f64; 2]>) {
        cdr.header(self.stamp_ns, self.frame);
        cdr.text(self.namespace);
        [self.id, self.kind, self.action].into_iter().for_each(|value| cdr.u32(value));
        let orientation = [0.0, 0.0, 0.0, 1.0];
        self.position.into_iter().chain(orientation).chain(self.scale).for_each(|value| cdr.f64(value));
        self.color.into_iter().for_each(|value| cdr.f32(value));
        // Lifetime in seconds and nanoseconds.
        [1, 0].into_iter().for_each(|value| cdr.u32(value));
        cdr.bool(false);
        cdr.u32(points.len() as u32);
        points.for_each(|[x, y]| [x, y, 0.0].into_iter().for_each(|axis| cdr.f64(axis)));
        // These fields are empty: colors of points, name of the texture, image of the texture with header, format and
        // data, coordinates of the texture.
        cdr.u32(0);
        cdr.text("");
        cdr.header(0, "");
        cdr.text("");
        cdr.u32(0);
        cdr.u32(0);
        // The text. The fields of a mesh are empty: its name, its file with name and data, whether its materials are
        // used.
        cdr.text(self.text);
        cdr.text("");
        cdr.text("");
        cdr.u32(0);
        cdr.bool(false);
    }
}

const CYLINDER: u32 = 3;
const SPHERE_LIST: u32 = 7;
const TEXT_VIEW_FACING: u32 = 9;
const ADD: u32 = 0;
const DELETE: u32 = 2;
/// Height of a disc in meters.
const DISC_HEIGHT_M: f64 = 0.01;
/// Diameter of a mark in meters.
const MARK_DIAMETER_M: f64 = 0.1;
/// Height and diameter of a person, and height of the ID above, in meters.
const PERSON_HEIGHT_M: f64 = 1.7;
const PERSON_DIAMETER_M: f64 = 0.4;
const LABEL_HEIGHT_M: f64 = 0.3;
const BLUE: [f32; 4] = [0.1, 0.4, 0.9, 0.8];
const WHITE: [f32; 4] = [1.0; 4];
const GREEN: [f32; 4] = [0.1, 0.7, 0.2, 0.25];
const RED: [f32; 4] = [0.9, 0.1, 0.1, 0.4];
const GRAY: [f32; 4] = [0.5, 0.5, 0.5, 0.25];
const YELLOW: [f32; 4] = [1.0, 0.8, 0.0, 1.0];
/// Minimum speed at which a person is considered to walk, in meters per second.
const MIN_WALKING_SPEED_M_S: f64 = 0.2;

#[cfg(test)]
mod tests {
    use scanhub_schema::{Mark, Track, Zone};

    use super::*;
    use crate::{MARKER_ARRAY, POSE_ARRAY, Value, read};

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
        let decoded = drawn(&zones);
        assert_eq!(decoded.sequence("markers").map(<[Value]>::len), Some(2));
        for (place, across, red) in [(0, 3.0, 0.9_f32), (1, 1.0, 0.1)] {
            let number = |path: &str| decoded.number(&format!("markers.{place}.{path}"));
            assert_eq!(decoded.text(&format!("markers.{place}.header.frame_id")), Some("base_link"));
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
        let decoded = drawn(&zones);
        let gray = f64::from(GRAY[0]);
        assert_eq!(
            (decoded.number("markers.0.color.r"), decoded.number("markers.1.color.r")),
            (Some(RED[0].into()), Some(gray))
        );
    }

    #[test]
    fn marks_are_encoded_as_points_of_one_marker() {
        let drawn = |marks: &Marks| {
            let mut message = vec![7];
            mark_markers(&mut message, "rear", &header(), marks);
            read(&MARKER_ARRAY, &message[1..]).unwrap()
        };
        let mut marks = Marks { count: 2, ..Marks::default() };
        marks.mark_array[0] = Mark { angle_mdeg: 0, range_dmm: 20_000, ..Mark::default() };
        marks.mark_array[1] = Mark { angle_mdeg: 90_000, range_dmm: 15_000, ..Mark::default() };
        let decoded = drawn(&marks);
        assert_eq!(
            (decoded.number("markers.0.type"), decoded.number("markers.0.action")),
            (Some(7.0), Some(0.0))
        );
        assert_eq!(decoded.text("markers.0.header.frame_id"), Some("rear"));
        assert_eq!(decoded.sequence("markers.0.points").map(<[Value]>::len), Some(2));
        assert_eq!(
            (decoded.number("markers.0.points.0.x"), decoded.number("markers.0.points.0.y")),
            (Some(2.0), Some(0.0))
        );
        assert_eq!(decoded.number("markers.0.points.1.y"), Some(1.5));
        let decoded = drawn(&Marks::default());
        assert_eq!(decoded.number("markers.0.action"), Some(2.0));
    }

    #[test]
    fn people_are_encoded_as_columns_with_ids() {
        let mut tracks = Tracks::default();
        for (id, state) in [(5, TrackState::Confirmed), (6, TrackState::Tentative), (7, TrackState::Hidden)] {
            tracks.push(Track { id, state: state as u8, x_m: id as f32, y_m: -1.0, ..Track::default() });
        }
        let mut message = Vec::new();
        people_markers(&mut message, "house", &header(), &tracks);
        let decoded = read(&MARKER_ARRAY, &message).unwrap();
        assert_eq!(decoded.sequence("markers").map(<[Value]>::len), Some(4), "no tentative person");
        for (place, id, kind, text) in
            [(0, 5.0, 3.0, ""), (1, 5.0, 9.0, "5"), (2, 7.0, 3.0, ""), (3, 7.0, 9.0, "7")]
        {
            let number = |path: &str| decoded.number(&format!("markers.{place}.{path}"));
            assert_eq!((number("id"), number("type"), number("action")), (Some(id), Some(kind), Some(0.0)));
            assert_eq!((number("pose.position.x"), number("pose.position.y")), (Some(id), Some(-1.0)));
            assert_eq!(decoded.text(&format!("markers.{place}.text")), Some(text));
            assert_eq!(decoded.text(&format!("markers.{place}.header.frame_id")), Some("house"));
        }
    }

    #[test]
    fn poses_of_people_face_their_walking_direction() {
        let mut tracks = Tracks::default();
        for (state, vy_m_s) in [(1, 1.0), (0, 1.0), (2, 0.1)] {
            tracks.push(Track { x_m: 2.0, y_m: -0.5, vy_m_s, state, ..Track::default() });
        }
        let mut message = Vec::new();
        people_poses(&mut message, "house", &header(), &tracks);
        let decoded = read(&POSE_ARRAY, &message).unwrap();
        assert_eq!(decoded.sequence("poses").map(<[Value]>::len), Some(2), "no tentative person");
        assert_eq!(decoded.text("header.frame_id"), Some("house"));
        assert_eq!(
            (decoded.number("poses.0.position.x"), decoded.number("poses.0.position.y")),
            (Some(2.0), Some(-0.5))
        );
        // The pose is rotated by 90 degrees to the left.
        let half = std::f64::consts::FRAC_1_SQRT_2;
        for axis in ["z", "w"] {
            let value = decoded.number(&format!("poses.0.orientation.{axis}")).unwrap();
            assert!((value - half).abs() < 1e-12, "{axis}: {value}");
        }
        assert_eq!(decoded.number("poses.1.orientation.w"), Some(1.0));
    }
}
