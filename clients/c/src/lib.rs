//! Client library for programs in C and C++. The library implements `include/scanhub/attach.h` with `scanhub_client`. A
//! handle is a number, not an address, so the library detects a handle that was closed or belongs to another thread.

mod export;
mod ffi;
mod handle;
mod silence;

pub use export::{
    scanhub_close, scanhub_error, scanhub_fd, scanhub_hub_is_running, scanhub_open, scanhub_open_robot,
    scanhub_open_robot_early, scanhub_publish_tilt, scanhub_release, scanhub_send_tilt, scanhub_sensors,
    scanhub_silent_for, scanhub_take, scanhub_topics, scanhub_unpublish, scanhub_version, scanhub_wait,
    scanhub_why_silent,
};
pub use ffi::BorrowedSample;
pub use handle::Opaque;
