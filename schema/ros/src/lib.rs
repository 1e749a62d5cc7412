//! Samples of the hub as messages of ROS 2: the encoding of messages, the names of topics and frames, and the
//! definitions of types that a reader without ROS needs. All code that writes scans for ROS uses this crate. This crate
//! does no I/O.
#![forbid(unsafe_code)]

#[cfg(feature = "mcap")]
pub mod bag;
mod cdr;
mod diagnostics;
mod markers;
mod names;
pub mod rmw_zenoh;
mod scans;
mod types;

pub use cdr::{Value, read};
pub use diagnostics::{diagnosis, hub_diagnosis, verdict_message};
pub use markers::{mark_markers, people_markers, people_poses, zone_markers};
pub use names::{BASE_FRAME, DIAGNOSTICS, RosNames, TF_STATIC, frame, scan_topic, static_transforms};
pub use scans::{foreground_cloud, laser_scan, scan_cloud, sweep_cloud};
pub use types::{
    DIAGNOSTIC_ARRAY, LASER_SCAN, MARKER_ARRAY, POINT_CLOUD, POSE_ARRAY, STRING, TF_MESSAGE, Type,
};
