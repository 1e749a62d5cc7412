//! Live pictures of a hub's sensors: `watch` in a terminal, and `web` for browsers and Foxglove.
//!
//! Both verbs update a [`scene`] from the topics of a hub, so their pictures always agree. Only the [`server`] of `web`
//! handles untrusted input. The server only handles channels of bytes. A test checks that its code uses neither a hub
//! nor a file.
#![forbid(unsafe_code)]

#[cfg(any(feature = "tui", feature = "web"))]
mod live_scene;
pub mod scene;
#[cfg(feature = "web")]
pub mod server;
#[cfg(feature = "tui")]
mod watch;
#[cfg(feature = "web")]
mod web;

#[cfg(feature = "tui")]
pub use watch::{WatchArgs, can_show_pictures};
#[cfg(feature = "web")]
pub use web::WebArgs;
