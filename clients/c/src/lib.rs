//! The client library for programs in C and C++. It implements `include/scanhub/attach.h` on top of `scanhub_client`. A
//! handle is a number, not an address, so the library detects a handle that was closed or belongs to another thread.

mod boundary;
mod export;
mod handle;

pub use boundary::Lent;
pub use export::{
    scanhub_close, scanhub_error, scanhub_fd, scanhub_hub_lives, scanhub_open, scanhub_open_robot,
    scanhub_open_robot_early, scanhub_publish_tilt, scanhub_release, scanhub_send_tilt, scanhub_take,
    scanhub_unpublish, scanhub_version, scanhub_wait,
};
pub use handle::Opaque;
