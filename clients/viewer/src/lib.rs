//! Draws live pictures of a hub's sensors: `watch` in a terminal, and `web` for browsers and Foxglove.
//!
//! Both verbs follow a hub into a [`scene`], so their pictures cannot disagree. Input of strangers ends in the
//! [`server`] of `web`, which only has channels of bytes. A test holds that it names neither a hub nor a file.
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
