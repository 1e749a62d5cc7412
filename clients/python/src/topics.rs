//! Classes of the samples, one for each topic. Scalars are read from shared memory. Arrays are views of shared memory,
//! except those that are marked as computed. Lists are copies, whose elements are the named tuples of `scanhub.values`.

use bytemuck::cast_slice;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyTuple};
use scanhub_client as client;
use scanhub_client::{Topic, Verdict};
use scanhub_schema::{Family, Intensities, Obstacle as FoundObstacle, Telegram as Frame};

use crate::error::value;
use crate::getters;
use crate::sample::{Sample, array, fixed, shaped, strided, view};

/// Declares the class of each topic.
macro_rules! classes {
    ($($topic:ident: $class:ident, $is_len:expr;)*) => {
        $(
            #[pyclass(extends = Sample, frozen, module = "scanhub")]
            pub(crate) struct $class;
        )*

        /// Creates the Python object of a sample. Its class is that of the sample's topic.
        pub(crate) fn wrap(py: Python<'_>, sample: Sample) -> PyResult<Py<PyAny>> {
            match sample.name.topic {
                $(Topic::$topic => Ok(Py::new(py, (PyClassInitializer::from(sample).add_subclass($class)))?.into_any()),)*
            }
        }

        /// Returns whether a payload of `topic` can have `len` bytes.
        pub(crate) fn is_payload(topic: Topic, len: usize) -> bool {
            match topic {
                $(Topic::$topic => {
                    let is_len: fn(usize) -> bool = $is_len;
                    is_len(len)
                })*
            }
        }

        /// Adds the classes to the module.
        pub(crate) fn add_to(module: &Bound<'_, PyModule>) -> PyResult<()> {
            $(module.add_class::<$class>()?;)*
            Ok(())
        }
    };
}

classes! {
    Telegram: Telegram, |_| true;
    Scan: Scan, |len| len >= client::Scan::HEAD;
    Marks: Marks, |len| len == size_of::<client::Marks>();
    Zones: Zones, |len| len == size_of::<client::Zones>();
    Foreground: Foreground, |len| len >= client::Foreground::HEAD;
    Background: Background, |len| len >= client::Background::HEAD;
    Status: Status, |len| len == size_of::<client::Status>();
    Lines: Lines, |len| len == size_of::<client::Lines>();
    Motion: Motion, |len| len == size_of::<client::Motion>();
    Early: Early, |len| len == size_of::<client::Early>();
    Tracks: Tracks, |len| len == size_of::<client::Tracks>();
    Events: Event, |len| len == size_of::<client::Event>();
    Tilt: Tilt, |len| len == size_of::<client::Tilt>();
    Cloud: Cloud, |len| len >= client::Cloud::HEAD;
    Obstacles: Obstacles, |len| len == size_of::<client::Obstacles>();
}

/// A numpy array or another object.
type Object<'py> = PyResult<Bound<'py, PyAny>>;
/// An object, or None.
type OptionalObject<'py> = PyResult<Option<Bound<'py, PyAny>>>;
/// A tuple of named tuples.
type List<'py> = PyResult<Bound<'py, PyTuple>>;

/// Returns a tuple of named tuples of class `name`.
fn values<'py, I: Iterator>(
    py: Python<'py>,
    items: I,
    convert: impl Fn(I::Item) -> PyResult<Bound<'py, PyAny>>,
) -> PyResult<Bound<'py, PyTuple>> {
    PyTuple::new(py, items.map(convert).collect::<PyResult<Vec<_>>>()?)
}

/// Millimeters, as an integer where possible.
#[derive(IntoPyObject)]
enum Millimeters {
    Whole(u32),
    Part(f64),
}

impl From<u32> for Millimeters {
    fn from(unit_um: u32) -> Millimeters {
        match unit_um % 1000 {
            0 => Millimeters::Whole(unit_um / 1000),
            _ => Millimeters::Part(f64::from(unit_um) / 1000.0),
        }
    }
}

getters! {
    Telegram(slf, sample: slf.as_super().get(), frame) = Frame::of(sample.header.family, sample.memory.bytes());
    /// Family of the scanner, such as `lms`; None if this version does not support the family.
    family: Option<&'static str> = sample.header.family().map(Family::name);
    /// The bytes of the telegram or packets: a view.
    data: Object<'py> = view(slf.py(), sample, sample.memory.bytes());
    /// Number of packets; None for an LMS.
    packets: Option<usize> = Some(frame?.packets()?.packets);
    /// Address byte of an LMS; None for other families.
    address: Option<u8> = frame.filter(|frame| frame.is_lms()).map(Frame::address);
    /// Length field of an LMS; None for other families.
    length: Option<u16> = frame.filter(|frame| frame.is_lms()).map(Frame::length);
    /// Command byte of an LMS; None for other families.
    command: Option<u8> = frame.filter(|frame| frame.is_lms()).map(Frame::command);
}

getters! {
    Scan(slf, sample: slf.as_super().get(), scan) = client::Scan::of_words(cast_slice(sample.memory.words()));
    /// Family of the scanner, such as `lms`; None if this version does not support the family.
    family: Option<&'static str> = Family::of_number(scan.family).map(Family::name);
    /// Number of beams.
    count: usize = scan.beams();
    /// Micrometers per device unit.
    unit_um: u32 = scan.unit_um;
    /// Angle of beam 0 in radians.
    first_angle: f64 = scan.first_angle;
    /// Angle from one beam to the next in radians; negative if the scanner rotates clockwise.
    step: f64 = scan.step;
    /// Angle between two points that the scanner measures, in radians.
    spacing: f32 = scan.spacing;
    /// Time from one beam to the next in ns.
    beam_time_ns: u32 = scan.beam_time_ns;
    /// Bits of an intensity; 0 if the scan has no intensities.
    intensity_bits: u8 = scan.intensity_bits;
    /// Number of points that were dropped because another point has the same beam.
    collisions: u16 = scan.collisions;
    /// Whether packets of the revolution are missing.
    incomplete: bool = scan.is_incomplete();
    /// Ranges in meters, NaN without a reading: computed.
    ranges_m: Object<'py> = array(slf.py(), (0..scan.beams()).map(|i| scan.distance_m(i).unwrap_or(f64::NAN)).collect());
    /// Angles of the beams in radians, exact if the scanner reports them: computed.
    angles: Object<'py> = array(slf.py(), (0..scan.beams()).map(|i| scan.angle(i)).collect());
    /// Whether each beam has a reading: computed.
    valid: Object<'py> = array(slf.py(), scan.ranges().iter().map(|range| *range <= scan.valid_to).collect::<Vec<bool>>());
    /// Index and code of each beam without a reading.
    codes: Vec<(usize, &'static str)> = (0..scan.beams()).filter_map(|i| Some((i, scan.code(i)?.name()))).collect();
    /// Time at which each beam was measured, in ns of `time.monotonic_ns()`: computed.
    times_ns: Object<'py> = {
        let stamp_ns = sample.header.stamp_first_ns as i64;
        array(slf.py(), (0..scan.beams()).map(|i| stamp_ns.wrapping_add(scan.beam_ns(i))).collect())
    };
    /// Ranges in device units, with codes: a view. Calculate with `ranges_m`.
    ranges: Object<'py> = view(slf.py(), sample, scan.ranges());
    /// Exact angles in radians, NaN if nothing was measured: a view. None if the scanner does not report them.
    exact_angles: OptionalObject<'py> = {
        let has_angles = scan.contents & client::ArrayFlags::ANGLES != 0;
        has_angles.then(|| view(slf.py(), sample, scan.exact_angles())).transpose()
    };
    /// Intensities of the beams, one or two bytes: a view. None if the scanner does not send them.
    intensities: OptionalObject<'py> = {
        let intensities = || match scan.intensities() {
            Intensities::Narrow(bytes) => view(slf.py(), sample, bytes),
            Intensities::Wide(words) => view(slf.py(), sample, words),
        };
        (scan.intensity_bits != 0).then(intensities).transpose()
    };
    /// One more byte for each range, with intensities or field bits: a view. None if the scanner does not send such
    /// bytes.
    upper: OptionalObject<'py> = {
        let has_upper = scan.contents & client::ArrayFlags::UPPER != 0;
        has_upper.then(|| view(slf.py(), sample, scan.upper())).transpose()
    };
}

getters! {
    Marks(slf, sample: slf.as_super().get(), marks) = fixed::<client::Marks>(sample);
    /// Whether the measuring mode has marks. Otherwise, the list is always empty.
    available: bool = marks.is_available();
    /// Whether there were more marks than fit.
    overflow: bool = marks.is_overflow();
    /// The marks in the order of their beams.
    marks: List<'py> = {
        values(slf.py(), marks.marks().iter(), |mark| {
            let (angle_deg, range_mm) =
                (f64::from(mark.angle_mdeg) / 1000.0, f64::from(mark.range_dmm) / 10.0);
            let beams = (mark.first_beam, mark.last_beam);
            let is_edge = mark.edge != 0;
            value(slf.py(), "Mark", (angle_deg, range_mm, mark.peak, mark.weight, beams.0, beams.1, is_edge))
        })
    };
}

getters! {
    Lines(slf, sample: slf.as_super().get(), lines) = fixed::<client::Lines>(sample);
    /// Whether there were more lines than fit.
    overflow: bool = lines.is_overflow();
    /// Number of beams of the scan that have a reading.
    readings: u16 = lines.readings;
    /// Number of readings that are on a line.
    on_lines: u16 = lines.on_lines;
    /// Standard deviation of the ranges in this scan, in meters.
    noise_m: f32 = lines.noise_m;
    /// The lines in the order of their beams.
    lines: List<'py> = {
        values(slf.py(), lines.lines().iter(), |line| {
            let ends = (line.x1_m, line.y1_m, line.x2_m, line.y2_m);
            let normal = (line.r_m, line.alpha_rad, line.sd_r_m, line.sd_alpha_rad);
            let (x1_m, y1_m, x2_m, y2_m) = ends;
            let (r_m, alpha_rad, sd_r_m, sd_alpha_rad) = normal;
            let beams = (line.first, line.last, line.points);
            let fields =
                (x1_m, y1_m, x2_m, y2_m, r_m, alpha_rad, sd_r_m, sd_alpha_rad, beams.0, beams.1, beams.2);
            value(slf.py(), "Line", fields)
        })
    };
    /// Intersections of lines.
    corners: List<'py> = {
        values(slf.py(), lines.corners().iter(), |corner| {
            let fields = (corner.x_m, corner.y_m, corner.first_line, corner.second_line);
            value(slf.py(), "Corner", fields)
        })
    };
}

/// Returns a matrix of 3 x 3.
fn matrix<'py>(py: Python<'py>, elements: &[f32; 9]) -> PyResult<Bound<'py, PyAny>> {
    shaped(py, elements.to_vec(), vec![3, 3])
}

getters! {
    Motion(slf, sample: slf.as_super().get(), motion) = fixed::<client::Motion>(sample);
    /// Method by which the step was found: `first`, `refused`, `beams`, `points`, `lines` or `both`.
    method: &'static str = motion.method().name();
    /// Step from the previous scan; None if there is no step.
    step: OptionalObject<'py> = {
        let fields = (motion.dx_m, motion.dy_m, motion.dyaw_rad);
        motion.has_step().then(|| value(slf.py(), "Step", fields)).transpose()
    };
    /// Covariance of the step, 3 x 3; None if there is no step.
    covariance: OptionalObject<'py> = motion.has_step().then(|| matrix(slf.py(), &motion.covariance)).transpose();
    /// Share of the readings that are on surfaces of the previous scan; None if there is no step.
    overlap: Option<f32> = Some(motion.overlap).filter(|_| motion.has_step());
    /// Sum of all steps; None if the sum is unknown.
    place: OptionalObject<'py> = {
        let fields = (motion.x_m, motion.y_m, motion.yaw_rad);
        motion.has_pose().then(|| value(slf.py(), "Place", fields)).transpose()
    };
    /// Covariance of `place`, 3 x 3; None if the covariance is unknown.
    pose_covariance: OptionalObject<'py> = motion.sum_covariance().map(|covariance| matrix(slf.py(), covariance)).transpose();
    /// Whether `place` is known, and contains no degenerate step.
    valid: bool = motion.has_valid_pose();
    /// Whether the surroundings do not show how far the robot moved in some direction, as in a corridor.
    degenerate: bool = motion.is_degenerate();
    /// Number of refused steps since the start.
    refused_steps: u16 = motion.refused_steps;
}

getters! {
    Early(slf, sample: slf.as_super().get(), early) = fixed::<client::Early>(sample);
    /// `slow` or `stop`.
    verdict: &'static str = early.verdict().name();
    /// Whether the warning with this number is withdrawn.
    withdrawn: bool = early.is_withdrawn();
    /// Beam of the nearest point so far.
    beam: u16 = early.beam;
    /// Distance of this point from the robot's center in mm.
    distance_mm: u32 = early.distance_mm;
    /// Bytes of the telegram that had arrived; 0 for a rotating scanner.
    bytes_seen: u16 = early.bytes_seen;
    /// Beams of the scan that had arrived.
    beams_seen: u16 = early.beams_seen;
}

getters! {
    Zones(slf, sample: slf.as_super().get(), zones) = fixed::<client::Zones>(sample);
    /// Whether the verdict is unknown because no recent data arrived.
    stale: bool = sample.stale;
    /// `clear`, `slow`, `stop` or `unknown`. Treat `unknown` as `stop`.
    verdict: &'static str = Verdict::name(zones.verdict());
    /// Beam of the point nearest to the robot's center; None if no beam has a reading.
    nearest_beam: Option<u16> = Some(zones.nearest()?.0);
    /// Distance of this point from the center in mm; None if no beam has a reading.
    nearest_mm: Option<u32> = Some(zones.nearest()?.1);
    /// The zones, the largest first.
    zones: List<'py> = values(slf.py(), zones.zones().iter(), |zone| {
            value(slf.py(), "Zone", (zone.radius_mm, zone.violated == 1, zone.beams))
        });
    /// Number of beams without a reading that cross the largest zone.
    invalid_beams: u16 = zones.invalid_beams;
    /// Whether there were fewer scans than a violation requires, so that no zone can be violated yet.
    provisional: bool = zones.flags & client::Zones::PROVISIONAL != 0;
}

getters! {
    Foreground(slf, sample: slf.as_super().get(), foreground) = client::Foreground::of_words(cast_slice(sample.memory.words()));
    /// Generation of the background that the scan was compared with.
    generation: u32 = foreground.generation;
    /// Number of beams of the scan.
    count: u16 = foreground.count;
    /// Millimeters per device unit.
    unit_mm: Millimeters = foreground.unit_um.into();
    /// Indexes of the foreground beams: computed.
    beams: Object<'py> = array(slf.py(), foreground.readings().map(|(i, _)| i as i64).collect());
    /// Ranges of the foreground beams in device units: a view.
    ranges: Object<'py> = view(slf.py(), sample, foreground.ranges());
    /// The segments in the order of their beams.
    segments: List<'py> = {
        let in_mm = |units: u16| u64::from(units) * u64::from(foreground.unit_um) / 1000;
        values(slf.py(), foreground.segments().iter().enumerate(), |(i, segment)| {
            let (nearest_mm, width_mm) = (in_mm(segment.nearest), in_mm(segment.width));
            let (first, last) = (segment.first, segment.last);
            let has_support = foreground.has_support(i);
            let fields = (first, last, nearest_mm, width_mm, segment.x_mm, segment.y_mm, has_support);
            value(slf.py(), "Segment", fields)
        })
    };
    /// Number of segments that did not fit.
    dropped: u16 = foreground.dropped;
}

getters! {
    Background(slf, sample: slf.as_super().get(), background) = client::Background::of_words(cast_slice(sample.memory.words()));
    /// Generation of the background. It increases by 1 after a reset, a load, and a change of the beams or the unit.
    generation: u32 = background.generation;
    /// Number of beams whose background is known.
    known_beams: u16 = background.known_beams;
    /// Number of beams; 0 before the first scan.
    count: usize = background.ranges().len();
    /// Millimeters per device unit.
    unit_mm: Millimeters = background.unit_um.into();
    /// Whether learning is stopped.
    frozen: bool = background.is_frozen();
    /// Ranges in device units, 0 if unknown, 65535 if beyond the maximum range: a view.
    ranges: Object<'py> = view(slf.py(), sample, background.ranges());
    /// Ranges in meters, NaN if unknown, infinite if beyond the maximum range: computed.
    ranges_m: Object<'py> = {
        let in_m = |range: &u16| match *range {
            client::Background::UNKNOWN => f64::NAN,
            client::Background::FAR => f64::INFINITY,
            range => f64::from(range) * f64::from(background.unit_um) / 1e6,
        };
        array(slf.py(), background.ranges().iter().map(in_m).collect::<Vec<f64>>())
    };
    /// Angle of beam 0 in radians; None before the first scan.
    first_angle: Option<f64> = Some(background.first_angle).filter(|_| background.step != 0.0);
    /// Angle from one beam to the next in radians; None before the first scan.
    step: Option<f64> = Some(background.step).filter(|step| *step != 0.0);
    /// Angles of the beams in radians: computed. None before the first scan.
    angles: OptionalObject<'py> = {
        let angle = |i: usize| background.first_angle + i as f64 * background.step;
        let angles = || array(slf.py(), (0..background.ranges().len()).map(angle).collect::<Vec<f64>>());
        (background.step != 0.0).then(angles).transpose()
    };
}

getters! {
    Status(slf, sample: slf.as_super().get(), status) = fixed::<client::Status>(sample);
    /// State of the link: `absent`, `probing`, `switching`, `starting`, `streaming`, `silent` or `paused`.
    state: &'static str = status.state().map_or("unknown", client::State::name);
    /// Stamp of the start of the state, in ns of `time.monotonic_ns()`.
    since_ns: u64 = status.since_ns;
    /// Baud rate of the line; None if unknown.
    baud: Option<u32> = Some(status.baud).filter(|baud| *baud != 0);
    /// Measuring mode of an LMS; None if unknown.
    mode: Option<u8> = Some(status.mode).filter(|mode| *mode != client::Status::MODE_UNKNOWN);
    /// Family of the scanner, such as `lms`; None if unknown.
    family: Option<&'static str> = status.family().map(Family::name);
    /// Model of the scanner in lower case; None if unknown.
    model: Option<String> = status.model();
    /// Millimeters per device unit; None if unknown.
    unit_mm: Option<u8> = Some(status.unit_mm).filter(|unit_mm| *unit_mm != 0);
    /// Field of view in degrees; None if unknown.
    angle_deg: Option<u16> = Some(status.angle_deg).filter(|angle_deg| *angle_deg != 0);
    /// Angle between two beams in degrees; None if unknown.
    step_deg: Option<f64> = Some(f64::from(status.resolution_cdeg) / 100.0).filter(|step_deg| *step_deg != 0.0);
    /// Scans per second.
    hz: f64 = f64::from(status.rate_mhz) / 1000.0;
    /// Type that the scanner reports; empty if unknown.
    r#type: &'a str = status.sensor_type();
    /// Port that the link is configured for.
    port: &'a str = status.port();
    /// Last error; empty if there was none.
    last_error: &'a str = status.last_error();
    /// Counters by their names in docs/output.md.
    counters: PyResult<Bound<'py, PyDict>> = {
        let counters = PyDict::new(slf.py());
        status.counters.named_values().try_for_each(|(name, count)| counters.set_item(name, count))?;
        Ok(counters)
    };
    /// Share of damaged bytes in the last 10 s, 0 to 1.
    damaged: f64 = status.damaged_share();
    /// Number of scans that were lost on the line; None if unknown.
    lost_on_line: Option<u64> = status.lost_on_line();
    /// Pose of the sensor, as configured.
    pose: Object<'py> = {
        let pose = &status.pose;
        value(slf.py(), "Pose", (pose.x_m, pose.y_m, pose.yaw_rad, pose.upside_down == 1))
    };
}

getters! {
    Tracks(slf, sample: slf.as_super().get(), tracks) = fixed::<client::Tracks>(sample);
    /// The sensors in the order of the site.
    sites: List<'py> = {
        values(slf.py(), tracks.sensors().iter(), |site| {
            let fields = (site.name(), site.x_m, site.y_m, site.yaw_rad, site.upside_down == 1);
            value(slf.py(), "Site", fields)
        })
    };
    /// The tracks in the order of their IDs.
    tracks: List<'py> = {
        values(slf.py(), tracks.tracks().iter(), |track| {
            let sensors = PyTuple::new(slf.py(), tracks.sensor_names_of(track).collect::<Vec<_>>())?;
            let (position, speed) = ((track.x_m, track.y_m), (track.vx_m_s, track.vy_m_s));
            let [xx, xy, yy] = track.covariance;
            let fields = (
                track.id,
                track.state().name(),
                position.0,
                position.1,
                speed.0,
                speed.1,
                (xx, xy, yy),
                track.room_name(),
                sensors,
                f64::from(track.age_ms) / 1000.0,
                track.score,
            );
            value(slf.py(), "Track", fields)
        })
    };
}

getters! {
    Event(slf, sample: slf.as_super().get(), event) = fixed::<client::Event>(sample);
    /// Kind of the event: `appeared`, `left` or `door`; None if this version does not support the kind.
    kind: Option<&'static str> = event.kind().map(|kind| kind.name());
    /// ID of the track.
    id: u64 = event.id;
    /// Room of the person after the event; None outside of all rooms.
    room: Option<&'a str> = event.room_name();
    /// Name of the door; None for other events.
    door: Option<&'a str> = Some(event.door()?.0);
    /// Room from which the person came, or `outside`; None for other events.
    from_room: Option<&'a str> = Some(event.door()?.1);
    /// Room to which the person went, or `outside`; None for other events.
    to_room: Option<&'a str> = Some(event.door()?.2);
}

getters! {
    Tilt(slf, sample: slf.as_super().get(), tilt) = fixed::<client::Tilt>(sample);
    /// Angle in radians, right-handed around the mount's axis.
    angle_rad: f64 = tilt.angle_rad;
    /// Angular rate in radians per second; None if unknown.
    rate_rad_s: Option<f64> = tilt.rate_rad_s();
}

/// Number of bytes of a point in the payload.
const POINT_LEN: usize = size_of::<client::CloudPoint>();

getters! {
    Cloud(slf, sample: slf.as_super().get(), cloud) = client::Cloud::of_words(cast_slice(sample.memory.words()));
    /// Number of the sweep, from 0.
    sweep: u32 = cloud.sweep;
    /// Generation of the background. Each reset increases it by 1.
    generation: u32 = cloud.generation;
    /// Whether this is the first sample of its sweep.
    first: bool = cloud.has(client::Cloud::FIRST);
    /// Whether this is the last sample of its sweep.
    last: bool = cloud.has(client::Cloud::LAST);
    /// Whether the sweep went from one reversal to the next, and no angle was missing.
    complete: bool = cloud.has(client::Cloud::COMPLETE);
    /// Whether the angles contradict the background, so that obstacles are unknown.
    unreliable: bool = cloud.has(client::Cloud::UNRELIABLE);
    /// Number of points.
    count: usize = cloud.points().len();
    /// Rows of x, y and z in the robot's frame, in meters: a view.
    points: Object<'py> = {
        let points = cloud.points();
        strided(slf.py(), sample, points, "<f4", vec![points.len(), 3], Some(vec![POINT_LEN, 4]))
    };
    /// Index of each point's beam in the scan: a view.
    beams: Object<'py> = part_of_points(slf.py(), sample, cloud.points(), std::mem::offset_of!(client::CloudPoint, beam), "<u2");
    /// Class of each point, an index in `scanhub.CLASSES`: a view.
    classes: Object<'py> = part_of_points(slf.py(), sample, cloud.points(), std::mem::offset_of!(client::CloudPoint, point_class), "|u1");
}

/// Returns a view of the field at `offset` of all points.
fn part_of_points<'py>(
    py: Python<'py>,
    sample: &Sample,
    points: &[client::CloudPoint],
    offset: usize,
    kind: &'static str,
) -> Object<'py> {
    let bytes: &[u8] = cast_slice(points);
    let from = bytes.get(offset..).unwrap_or_default();
    strided(py, sample, from, kind, vec![points.len()], Some(vec![POINT_LEN]))
}

getters! {
    Obstacles(slf, sample: slf.as_super().get(), obstacles) = fixed::<client::Obstacles>(sample);
    /// Number of the sweep, from 0.
    sweep: u32 = obstacles.sweep;
    /// Generation of the background. Each reset increases it by 1.
    generation: u32 = obstacles.generation;
    /// Whether the sweep went from one reversal to the next, and no angle was missing.
    complete: bool = obstacles.has(client::Obstacles::COMPLETE);
    /// Whether the angles contradict the background, so that obstacles are unknown.
    unreliable: bool = obstacles.has(client::Obstacles::UNRELIABLE);
    /// Number of obstacles that did not fit.
    dropped: u32 = obstacles.dropped;
    /// The obstacles, the nearest first.
    obstacles: List<'py> = {
        values(slf.py(), obstacles.obstacles().iter(), |obstacle| {
            let [x_m, y_m, z_m] = obstacle.middle;
            let (low, high) = (<(f32, f32, f32)>::from(obstacle.low), <(f32, f32, f32)>::from(obstacle.high));
            let (distance_m, points) = (obstacle.distance_m, obstacle.points);
            let is_foreground = obstacle.has(FoundObstacle::FOREGROUND);
            let is_near = obstacle.has(FoundObstacle::NEAR);
            let fields = (x_m, y_m, z_m, low, high, distance_m, points, is_foreground, is_near);
            value(slf.py(), "Obstacle", fields)
        })
    };
}
