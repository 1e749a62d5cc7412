//! The points of one scan of a tilted scanner in three dimensions. Refuses to know how they are made.

use std::fmt;

use bytemuck::{Pod, Zeroable, cast_slice, cast_slice_mut};
#[cfg(feature = "ipc")]
use iceoryx2::prelude::ZeroCopySend;

use crate::sliced::sliced;

/// What stands before the points of a [`Cloud`]. 16 bytes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub struct CloudHead {
    /// Number of the sweep, the way of the mount from turn to turn, that the points are of: from 0.
    pub sweep: u32,
    /// Number of the background that they were compared with: one more each time that it was forgotten.
    pub generation: u32,
    /// Points.
    pub count: u16,
    /// Bits: [`FIRST`](Cloud::FIRST), [`LAST`](Cloud::LAST), [`COMPLETE`](Cloud::COMPLETE), [`DOUBTED`](Cloud::DOUBTED).
    pub flags: u8,
    /// 0.
    pub reserved: [u8; 5],
}

sliced! {
    /// The payload of topic `cloud`: a [`CloudHead`], which its fields are read through, and behind it the points. A sample holds
    /// those of one scan, and the samples of a sweep come one behind the other: who wants whole sweeps gathers from
    /// [`FIRST`](Self::FIRST) to [`LAST`](Self::LAST). The stamps of a sample are when its first and its last point were
    /// measured.
    Cloud, CloudWord, "scanhub.Cloud.v2", CloudHead
}

/// Where a beam ended. 16 bytes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct CloudPoint {
    /// In the robot's frame: metres ahead, to the left, above the floor.
    pub at: [f32; 3],
    /// Number of the beam in its scan.
    pub beam: u16,
    /// See [`PointClass`].
    pub point_class: u8,
    /// 0.
    pub reserved: u8,
}

/// What a point is beside the background.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(u8)]
pub enum PointClass {
    /// What stands there always is not known yet.
    #[default]
    Unknown,
    /// It is where something stands always.
    Background,
    /// It is nearer than that.
    Foreground,
    /// It is farther away: something has gone.
    Behind,
}

impl PointClass {
    /// All, in the order of their numbers.
    pub const ALL: [PointClass; 4] =
        [PointClass::Unknown, PointClass::Background, PointClass::Foreground, PointClass::Behind];

    /// Returns the word for it in all output.
    pub const fn name(self) -> &'static str {
        match self {
            PointClass::Unknown => "unknown",
            PointClass::Background => "background",
            PointClass::Foreground => "foreground",
            PointClass::Behind => "behind",
        }
    }
}

impl CloudPoint {
    /// Returns what it is beside the background; a number that is not known says nothing of it.
    pub fn class(&self) -> PointClass {
        PointClass::ALL.get(usize::from(self.point_class)).copied().unwrap_or_default()
    }
}

impl Cloud {
    /// Flag: the first sample of its sweep.
    pub const FIRST: u8 = 1;
    /// Flag: the last one.
    pub const LAST: u8 = 2;
    /// Flag: the sweep went from one turn of the mount to the next, and no angle was missing.
    pub const COMPLETE: u8 = 4;
    /// Flag: the angles of the sweep contradict the background; the class of all points is unknown.
    pub const DOUBTED: u8 = 8;

    /// Returns the bytes of so many points.
    pub const fn len(points: usize) -> usize {
        Cloud::HEAD + points * size_of::<CloudPoint>()
    }

    /// Returns a cloud with `head` and `points`.
    pub fn of(head: CloudHead, points: &[CloudPoint]) -> Box<Cloud> {
        let mut cloud = Cloud::zeroed(Cloud::len(points.len()));
        cloud.begin(CloudHead { count: points.len() as u16, ..head }).copy_from_slice(points);
        cloud
    }

    /// Writes `head` and returns the points, which have to be filled.
    ///
    /// # Panics
    ///
    /// If the memory is too short for them.
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
}

impl fmt::Debug for Cloud {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Cloud").field("head", &**self).field("points", &self.points()).finish()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_are_as_many_as_there_is_memory_for() {
        let point = CloudPoint { at: [1.0, -2.0, 0.5], beam: 7, point_class: 2, reserved: 0 };
        let head = CloudHead { sweep: 3, flags: Cloud::FIRST | Cloud::COMPLETE, ..CloudHead::default() };
        let mut cloud = Cloud::of(head, &[CloudPoint::default(), point]);
        assert_eq!((cloud.sweep, cloud.bytes().len(), cloud.points()[1]), (3, 48, point));
        assert!(cloud.has(Cloud::FIRST) && !cloud.has(Cloud::LAST));
        cloud.count = 9;
        assert_eq!((cloud.points().len(), cloud.bytes().len()), (2, 48), "there is no memory for so many");
    }

    #[test]
    fn numbers_of_classes() {
        for (number, class) in PointClass::ALL.into_iter().enumerate() {
            assert_eq!(class as usize, number);
            assert_eq!(CloudPoint { point_class: number as u8, ..CloudPoint::default() }.class(), class);
        }
        assert_eq!(CloudPoint { point_class: 4, ..CloudPoint::default() }.class(), PointClass::Unknown);
    }
}
