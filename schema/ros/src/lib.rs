//! What the hub publishes, as messages of ROS 2: their bytes, the names of their topics and frames, and the texts from
//! which a reader without ROS learns them. All code that writes scans for ROS calls this crate. Refuses to know shared
//! memory, networks and clocks.
#![forbid(unsafe_code)]

#[cfg(feature = "mcap")]
pub mod bag;
mod cdr;
mod laser_scan;
mod layout;
mod markers;
mod names;
mod point_cloud;
mod pose_array;
mod state;
mod transforms;
mod type_hash;
mod types;
pub mod zenoh_wire;

pub use laser_scan::laser_scan;
pub use layout::{Value, read};
pub use markers::{mark_markers, people_markers, zone_markers};
pub use names::{BASE_FRAME, DIAGNOSTICS, Names, TF_STATIC, frame, points_topic, scan_topic};
pub use point_cloud::{foreground_cloud, scan_cloud, sweep_cloud};
pub use pose_array::people_poses;
pub use state::{diagnosis, hub_diagnosis, verdict_word};
pub use transforms::static_transforms;
pub use types::{
    DIAGNOSTIC_ARRAY, LASER_SCAN, MARKER_ARRAY, POINT_CLOUD, POSE_ARRAY, STRING, TF_MESSAGE, Type,
};
