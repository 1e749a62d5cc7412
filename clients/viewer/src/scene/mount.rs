//! Where a sensor sits: nobody told yet, on the robot, or in the map of a site.

use scanhub_schema::Pose;

/// Where a sensor sits, as far as that was told.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Mount {
    /// Nobody told: what the sensor sees is nowhere.
    #[default]
    Unknown,
    /// On the robot, at this pose in the robot's frame.
    OnRobot(Pose),
    /// In the map of a site in which a tracker follows people, at this pose in that map. Where the robot's centre is there is not
    /// known.
    InMap(Pose),
}

impl Mount {
    /// Returns the pose in the frame of the picture, if somebody told it.
    pub fn pose(&self) -> Option<Pose> {
        match *self {
            Mount::Unknown => None,
            Mount::OnRobot(pose) | Mount::InMap(pose) => Some(pose),
        }
    }

    /// Returns whether the picture has a map instead of the robot in its middle.
    pub fn is_in_map(&self) -> bool {
        matches!(self, Mount::InMap(_))
    }
}
