//! The client library for programs in C and C++: `include/scanhub/attach.h` is its contract, this is what stands behind it.
//! A handle is a number, not an address: one that was closed, or is another thread's, is found out and not followed.
//! Refuses to know how samples come: that is `scanhub_client`.

mod boundary;
mod call_error;
mod export;
mod handle;
mod mount;
mod robot;
mod table;

pub use boundary::Lent;
pub use export::{
    scanhub_close, scanhub_error, scanhub_fd, scanhub_hub_lives, scanhub_open, scanhub_open_robot,
    scanhub_open_robot_early, scanhub_publish_tilt, scanhub_release, scanhub_send_tilt, scanhub_take,
    scanhub_unpublish, scanhub_version, scanhub_wait,
};
pub use table::Opaque;
