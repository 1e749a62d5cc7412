//! What stands there in three dimensions, as one sweep of a tilted scanner shows it. Refuses to know how it is found.

use bytemuck::{Pod, Zeroable};
#[cfg(feature = "ipc")]
use iceoryx2::prelude::ZeroCopySend;

/// The most obstacles of a sweep.
pub const OBSTACLES: usize = 64;

/// The payload of topic `obstacles`, 3088 bytes: what one sweep has found, also if that is nothing.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[cfg_attr(feature = "ipc", derive(ZeroCopySend), type_name("scanhub.Obstacles.v2"))]
#[repr(C)]
pub struct Obstacles {
    /// Number of the sweep, as in a [`Cloud`](crate::Cloud).
    pub sweep: u32,
    /// Number of the background, as in a [`Cloud`](crate::Cloud).
    pub generation: u32,
    /// Obstacles that did not fit.
    pub left_out: u32,
    /// Obstacles, at most [`OBSTACLES`].
    pub count: u8,
    /// Bits: [`COMPLETE`](Self::COMPLETE), [`DOUBTED`](Self::DOUBTED).
    pub flags: u8,
    /// 0.
    pub reserved: [u8; 2],
    /// The obstacles, the nearest first; 0 beyond `count`.
    pub obstacle_array: [Obstacle; OBSTACLES],
}

/// Something that stands there. All in the robot's frame: metres ahead, to the left, above the floor.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[cfg_attr(feature = "ipc", derive(ZeroCopySend), type_name("scanhub.Obstacle.v2"))]
#[repr(C)]
pub struct Obstacle {
    /// The mean of its points.
    pub middle: [f32; 3],
    /// The least coordinates of its points.
    pub low: [f32; 3],
    /// The greatest.
    pub high: [f32; 3],
    /// How far its nearest point is from the robot's centre, over ground, in metres.
    pub distance_m: f32,
    /// Points.
    pub points: u32,
    /// Bits: [`FOREGROUND`](Self::FOREGROUND), [`NEAR`](Self::NEAR).
    pub flags: u8,
    /// 0.
    pub reserved: [u8; 3],
}

impl Obstacle {
    /// Flag: points of it are before the background.
    pub const FOREGROUND: u8 = 1;
    /// Flag: points of it are in the space that is to be free.
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

impl Obstacles {
    /// Flag: the sweep went from one turn of the mount to the next, and no angle was missing.
    pub const COMPLETE: u8 = 4;
    /// Flag: the angles of the sweep contradict the background: there are no obstacles in this, whatever stands there.
    pub const DOUBTED: u8 = 8;

    /// Returns the obstacles, the nearest first.
    pub fn obstacles(&self) -> &[Obstacle] {
        &self.obstacle_array[..usize::from(self.count).min(OBSTACLES)]
    }

    /// Adds one; counts it as left out if there is no room for it.
    pub fn push(&mut self, obstacle: Obstacle) {
        match self.obstacle_array.get_mut(usize::from(self.count)) {
            Some(place) => {
                *place = obstacle;
                self.count += 1;
            }
            None => self.left_out += 1,
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
    fn what_is_too_many_is_left_out() {
        let mut found = Obstacles { flags: Obstacles::COMPLETE, ..Obstacles::default() };
        (0..=OBSTACLES as u32).for_each(|points| found.push(Obstacle { points, ..Obstacle::default() }));
        assert_eq!((found.obstacles().len(), found.left_out), (OBSTACLES, 1));
        assert_eq!(found.obstacles()[OBSTACLES - 1].points, OBSTACLES as u32 - 1);
        assert!(found.has(Obstacles::COMPLETE) && !found.has(Obstacles::DOUBTED));
    }
}
