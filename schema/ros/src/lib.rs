//! What the hub publishes, as messages of ROS 2: their bytes, the names of their topics and frames, and the texts from
//! which a reader without ROS learns them. All code that writes scans for ROS calls this crate. Refuses to know shared
//! memory, networks and clocks.
#![forbid(unsafe_code)]

#[cfg(feature = "mcap")]
pub mod bag;
mod cdr;
mod laser_scan;
mod names;
mod transforms;
mod types;

pub use laser_scan::laser_scan;
pub use names::{BASE_FRAME, TF_STATIC, frame, scan_topic};
pub use transforms::static_transforms;
pub use types::{LASER_SCAN, TF_MESSAGE, Type};
