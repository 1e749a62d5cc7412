//! A scanner on a tilting mount: the angle of the mount, the points of each scan in three dimensions, the sweeps that
//! they form, and the obstacles that were found in one sweep.

use std::fmt;

use bytemuck::{Pod, Zeroable, cast_slice, cast_slice_mut, pod_read_unaligned};
#[cfg(feature = "ipc")]
use iceoryx2::prelude::ZeroCopySend;

use crate::limits::TopicLimits;
use crate::payload::{
    FixedPayload, UsedElements, are_finite, packed_as_is, read_head, sliced, used_elements,
};
use crate::text::named;
use crate::topic::PayloadLen;
use crate::{Header, MAX_BEAMS};

/// The payload of topic `tilt`, 16 bytes: the angle of a mount. Both stamps of the sample are the time at which the
/// mount had this angle, not the time of the report.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[cfg_attr(feature = "ipc", derive(ZeroCopySend), type_name("scanhub.Tilt.v2"))]
#[repr(C)]
pub struct Tilt {
    /// Angle in radians, right-handed around the mount's axis.
    pub angle_rad: f64,
    /// Angular rate in radians per second; NaN if unknown.
    pub rate_rad_s: f64,
}

impl Default for Tilt {
    /// Returns angle 0 with an unknown rate.
    fn default() -> Self {
        Tilt { angle_rad: 0.0, rate_rad_s: f64::NAN }
    }
}

impl FixedPayload for Tilt {
    fn is_valid(&self) -> bool {
        self.angle_rad.is_finite() && !self.rate_rad_s.is_infinite()
    }
}

impl Tilt {
    /// Returns the angular rate in radians per second, if it is known.
    pub fn rate_rad_s(&self) -> Option<f64> {
        Some(self.rate_rad_s).filter(|rate| rate.is_finite())
    }
}

/// Head of a cloud, before the points. 16 bytes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub struct CloudHead {
    /// Number of the sweep, from 0.
    pub sweep: u32,
    /// Generation of the background that the points were compared with; each reset increases it by 1.
    pub generation: u32,
    /// Number of points, at most [`MAX_BEAMS`](crate::MAX_BEAMS).
    pub count: u16,
    /// Flags: [`FIRST`](Cloud::FIRST), [`LAST`](Cloud::LAST), [`COMPLETE`](Cloud::COMPLETE),
    /// [`UNRELIABLE`](Cloud::UNRELIABLE).
    pub flags: u8,
    /// 0.
    pub reserved: [u8; 5],
}

sliced! {
    /// The payload of topic `cloud`: a [`CloudHead`], whose fields can be read directly, followed by the points of one
    /// scan. The samples of a sweep follow each other, from [`FIRST`](Self::FIRST) to [`LAST`](Self::LAST).
    /// [`SweepPoints`] gathers whole sweeps. The stamps of a sample are the times of its first and its last point.
    Cloud, CloudWord, "scanhub.Cloud.v2", CloudHead
}

/// One point. 16 bytes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct CloudPoint {
    /// Position in the robot's frame, in meters: ahead, to the left, above the floor.
    pub at: [f32; 3],
    /// Index of the beam in its scan.
    pub beam: u16,
    /// Class of the point: [`PointClass`]. Treat every other number as unknown.
    pub point_class: u8,
    /// 0.
    pub reserved: u8,
}

/// Class of a point compared with the background.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(u8)]
pub enum PointClass {
    /// The background of the beam is unknown.
    #[default]
    Unknown,
    /// The point is on the background.
    Background,
    /// The point is in front of the background.
    Foreground,
    /// The point is beyond the background: an object was removed.
    Behind,
}

named! {
    PointClass:
    Unknown "unknown",
    Background "background",
    Foreground "foreground",
    Behind "behind",
}

impl CloudPoint {
    /// Returns the class; [`PointClass::Unknown`] if this version does not know its number.
    pub fn class(&self) -> PointClass {
        PointClass::ALL.get(usize::from(self.point_class)).copied().unwrap_or_default()
    }
}

impl PayloadLen for Cloud {
    fn max_payload_len(limits: &TopicLimits) -> usize {
        Cloud::len(limits.beams)
    }
}

packed_as_is!(Cloud);

impl Cloud {
    /// Flag: the first sample of its sweep.
    pub const FIRST: u8 = 1;
    /// Flag: the last sample of its sweep.
    pub const LAST: u8 = 2;
    /// Flag: the sweep has all angles from one reversal of the mount to the next.
    pub const COMPLETE: u8 = 4;
    /// Flag: the angles of the sweep contradict the background. The class of all points is unknown.
    pub const UNRELIABLE: u8 = 8;

    /// Returns the length in bytes of a cloud of `points` points.
    pub const fn len(points: usize) -> usize {
        Cloud::HEAD + points * size_of::<CloudPoint>()
    }

    /// Returns a cloud with `head` and `points`.
    pub fn of(head: CloudHead, points: &[CloudPoint]) -> Box<Cloud> {
        let mut cloud = Cloud::zeroed(Cloud::len(points.len()));
        cloud.begin(CloudHead { count: points.len() as u16, ..head }).copy_from_slice(points);
        cloud
    }

    /// Writes `head` and returns the points, which the caller must fill.
    ///
    /// # Panics
    ///
    /// Panics if the memory is too short for the head and the points.
    pub fn begin(&mut self, head: CloudHead) -> &mut [CloudPoint] {
        **self = head;
        cast_slice_mut(&mut self.memory_mut()[Cloud::HEAD..Cloud::len(head.count.into())])
    }

    /// Returns the points.
    pub fn points(&self) -> &[CloudPoint] {
        let room = self.memory().len().saturating_sub(Cloud::HEAD) / size_of::<CloudPoint>();
        let count = usize::from(self.count).min(room);
        self.memory().get(Cloud::HEAD..Cloud::len(count)).map_or(&[], cast_slice)
    }

    /// Returns whether `flag` is set.
    pub fn has(&self, flag: u8) -> bool {
        self.flags & flag != 0
    }

    fn used(&self) -> usize {
        Cloud::len(self.points().len())
    }

    /// Returns the length in bytes of the cloud in a datagram's payload, or `None` if the cloud is not valid.
    fn packed_len(payload: &[u8]) -> Option<usize> {
        let count = usize::from(read_head::<CloudHead>(payload)?.count);
        let points = payload.get(Cloud::HEAD..Cloud::len(count)).filter(|_| count <= MAX_BEAMS)?;
        let mut points = points.chunks_exact(size_of::<CloudPoint>()).map(pod_read_unaligned);
        points.all(|point: CloudPoint| are_finite(&point.at)).then_some(Cloud::len(count))
    }

    fn widen(limits: &mut TopicLimits, head: &CloudHead) {
        limits.beams = limits.beams.max(head.count.into());
    }
}

impl fmt::Debug for Cloud {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Cloud").field("head", &**self).field("points", &self.points()).finish()
    }
}

/// Gathers the points of whole sweeps from the samples of topic `cloud`.
///
/// # Examples
///
/// ```
/// use scanhub_schema::{Cloud, CloudHead, CloudPoint, Header, SweepPoints};
///
/// let mut sweep = SweepPoints::default();
/// for (topic_seq, flags) in [(7, Cloud::FIRST), (8, 0), (9, Cloud::LAST)] {
///     let head = CloudHead { flags, ..CloudHead::default() };
///     let sample = Cloud::of(head, &[CloudPoint::default(); 2]);
///     let header = Header { topic_seq, ..Header::default() };
///     let points = sweep.take(&header, &sample);
///     assert_eq!(points.map(<[CloudPoint]>::len), (topic_seq == 9).then_some(6));
/// }
/// ```
#[derive(Clone, Debug, Default)]
pub struct SweepPoints {
    points: Vec<CloudPoint>,
    /// `boot` and `topic_seq` of the next sample of this sweep. `None` while no sweep is being gathered.
    next: Option<(u64, u64)>,
}

/// Maximum number of points of a sweep that is gathered.
const MAX_SWEEP_POINTS: usize = 1 << 18;

impl SweepPoints {
    /// Adds a sample of topic `cloud`. With the last sample of a sweep, returns the points of the sweep. A sweep with a
    /// missed sample, or with more than 262,144 points, is dropped.
    pub fn take(&mut self, header: &Header, cloud: &Cloud) -> Option<&[CloudPoint]> {
        let position = (header.boot, header.topic_seq);
        if cloud.has(Cloud::FIRST) {
            self.points.clear();
        } else if self.next != Some(position) {
            self.next = None;
            return None;
        }
        let has_room = self.points.len() + cloud.points().len() <= MAX_SWEEP_POINTS;
        let continues = has_room && !cloud.has(Cloud::LAST);
        self.next = continues.then_some((header.boot, header.topic_seq.wrapping_add(1)));
        if !has_room {
            return None;
        }
        self.points.extend_from_slice(cloud.points());
        cloud.has(Cloud::LAST).then_some(&self.points)
    }
}

/// Maximum number of obstacles of a sweep.
pub const MAX_OBSTACLES: usize = 64;

/// The payload of topic `obstacles`, 3088 bytes: the obstacles of one sweep. The sample is published even if there are
/// no obstacles.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[cfg_attr(feature = "ipc", derive(ZeroCopySend), type_name("scanhub.Obstacles.v2"))]
#[repr(C)]
pub struct Obstacles {
    /// Number of the sweep, as in topic `cloud`.
    pub sweep: u32,
    /// Generation of the background, as in topic `cloud`.
    pub generation: u32,
    /// Number of obstacles that did not fit into the sample.
    pub dropped: u32,
    /// Number of obstacles, at most [`MAX_OBSTACLES`].
    pub count: u8,
    /// Flags: [`COMPLETE`](Self::COMPLETE), [`UNRELIABLE`](Self::UNRELIABLE).
    pub flags: u8,
    /// 0.
    pub reserved: [u8; 2],
    /// The obstacles, the nearest first; 0 beyond `count`.
    pub obstacle_array: [Obstacle; MAX_OBSTACLES],
}

/// An object that was found in one sweep. Positions are in the robot's frame, in meters: ahead, to the left, above the
/// floor.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[cfg_attr(feature = "ipc", derive(ZeroCopySend), type_name("scanhub.Obstacle.v2"))]
#[repr(C)]
pub struct Obstacle {
    /// Mean of the points, in meters.
    pub middle: [f32; 3],
    /// Lowest coordinates of the points, in meters.
    pub low: [f32; 3],
    /// Highest coordinates of the points, in meters.
    pub high: [f32; 3],
    /// Horizontal distance of the nearest point from the robot's center, in meters.
    pub distance_m: f32,
    /// Number of points.
    pub points: u32,
    /// Flags: [`FOREGROUND`](Self::FOREGROUND), [`NEAR`](Self::NEAR).
    pub flags: u8,
    /// 0.
    pub reserved: [u8; 3],
}

impl Obstacle {
    /// Flag: some of its points are in front of the background.
    pub const FOREGROUND: u8 = 1;
    /// Flag: some of its points are in the space that must be free.
    pub const NEAR: u8 = 2;

    /// Returns whether `flag` is set.
    pub fn has(&self, flag: u8) -> bool {
        self.flags & flag != 0
    }
}

impl Default for Obstacles {
    fn default() -> Self {
        Zeroable::zeroed()
    }
}

impl FixedPayload for Obstacles {
    const ARRAYS: &'static [UsedElements] =
        &[used_elements!(Obstacles, obstacle_array: [Obstacle; MAX_OBSTACLES], count)];

    fn is_valid(&self) -> bool {
        let is_finite = |obstacle: &Obstacle| {
            are_finite([obstacle.middle, obstacle.low, obstacle.high].as_flattened())
                && obstacle.distance_m.is_finite()
        };
        self.obstacles().iter().all(is_finite)
    }
}

impl Obstacles {
    /// Flag: the sweep has all angles from one reversal of the mount to the next.
    pub const COMPLETE: u8 = 4;
    /// Flag: the angles of the sweep contradict the background. The list is empty, whatever the scene contains.
    pub const UNRELIABLE: u8 = 8;

    /// Returns the obstacles, the nearest first.
    pub fn obstacles(&self) -> &[Obstacle] {
        &self.obstacle_array[..usize::from(self.count).min(MAX_OBSTACLES)]
    }

    /// Adds an obstacle, or counts it as dropped if there is no room for it.
    pub fn push(&mut self, obstacle: Obstacle) {
        match self.obstacle_array.get_mut(usize::from(self.count)) {
            Some(slot) => {
                *slot = obstacle;
                self.count += 1;
            }
            None => self.dropped += 1,
        }
    }

    /// Returns whether `flag` is set.
    pub fn has(&self, flag: u8) -> bool {
        self.flags & flag != 0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn point_count_is_limited_by_memory() {
        let point = CloudPoint { at: [1.0, -2.0, 0.5], beam: 7, point_class: 2, reserved: 0 };
        let head = CloudHead { sweep: 3, flags: Cloud::FIRST | Cloud::COMPLETE, ..CloudHead::default() };
        let mut cloud = Cloud::of(head, &[CloudPoint::default(), point]);
        assert_eq!((cloud.sweep, cloud.bytes().len(), cloud.points()[1]), (3, 48, point));
        assert!(cloud.has(Cloud::FIRST) && !cloud.has(Cloud::LAST));
        cloud.count = 9;
        assert_eq!((cloud.points().len(), cloud.bytes().len()), (2, 48), "there is no memory for so many");
    }

    #[test]
    fn point_class_numbers_match_their_order() {
        for (number, class) in PointClass::ALL.into_iter().enumerate() {
            assert_eq!(class as usize, number);
            assert_eq!(CloudPoint { point_class: number as u8, ..CloudPoint::default() }.class(), class);
        }
        assert_eq!(CloudPoint { point_class: 4, ..CloudPoint::default() }.class(), PointClass::Unknown);
    }

    /// Returns the number of points of each complete sweep. `samples` has the sequence number, the flags and the number
    /// of points of each sample.
    fn complete_sweeps(sweep: &mut SweepPoints, samples: &[(u64, u8, usize)]) -> Vec<usize> {
        let mut whole = Vec::new();
        for &(topic_seq, flags, count) in samples {
            let head = CloudHead { flags, ..CloudHead::default() };
            let cloud = Cloud::of(head, &vec![CloudPoint::default(); count]);
            let header = Header { topic_seq, boot: topic_seq / 100, ..Header::default() };
            whole.extend(sweep.take(&header, &cloud).map(<[CloudPoint]>::len));
        }
        whole
    }

    #[test]
    fn incomplete_sweeps_are_dropped() {
        let (first, last) = (Cloud::FIRST, Cloud::LAST);
        let mut sweep = SweepPoints::default();
        // A program that starts in the middle of a sweep waits for the next one.
        assert_eq!(complete_sweeps(&mut sweep, &[(3, 0, 5), (4, last, 5)]), [0; 0]);
        assert_eq!(complete_sweeps(&mut sweep, &[(5, first, 5), (6, 0, 2), (7, last, 1)]), [8]);
        assert_eq!(
            complete_sweeps(&mut sweep, &[(8, first | last, 4), (9, last, 3)]),
            [4],
            "9 has no beginning"
        );
        assert_eq!(complete_sweeps(&mut sweep, &[(10, first, 5), (12, last, 5)]), [0; 0], "11 was missed");
        assert_eq!(complete_sweeps(&mut sweep, &[(20, first, 5), (21, first, 2), (22, last, 1)]), [3]);
        assert_eq!(
            complete_sweeps(&mut sweep, &[(99, first, 5), (100, last, 5)]),
            [0; 0],
            "another one sends it"
        );
    }

    #[test]
    fn sweep_longer_than_the_maximum_is_dropped() {
        let mut samples: Vec<_> = (0..33).map(|number| (number, 0, 8192)).collect();
        samples[0].1 = Cloud::FIRST;
        samples.push((33, Cloud::LAST, 1));
        let mut sweep = SweepPoints::default();
        assert_eq!(complete_sweeps(&mut sweep, &samples), [0; 0]);
        samples.truncate(32);
        samples[31].1 = Cloud::LAST;
        assert_eq!(complete_sweeps(&mut sweep, &samples), [262_144]);
    }

    #[test]
    fn surplus_obstacles_are_dropped_and_counted() {
        let mut found = Obstacles { flags: Obstacles::COMPLETE, ..Obstacles::default() };
        (0..=MAX_OBSTACLES as u32).for_each(|points| found.push(Obstacle { points, ..Obstacle::default() }));
        assert_eq!((found.obstacles().len(), found.dropped), (MAX_OBSTACLES, 1));
        assert_eq!(found.obstacles()[MAX_OBSTACLES - 1].points, MAX_OBSTACLES as u32 - 1);
        assert!(found.has(Obstacles::COMPLETE) && !found.has(Obstacles::UNRELIABLE));
    }
}
