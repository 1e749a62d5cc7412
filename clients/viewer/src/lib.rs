//! Draws live pictures of what the sensors see: [`watch`] in a terminal, and [`web`] for browsers and Foxglove.
//!
//! Both follow a hub into one [`scene`], so that no two pictures disagree. The [`server`] of `web` is the end of what strangers
//! send: it has channels of bytes and nothing else. A test holds that it names neither a hub nor a file.
#![forbid(unsafe_code)]

#[cfg(any(feature = "tui", feature = "web"))]
mod picture;
pub mod scene;
#[cfg(feature = "web")]
pub mod server;
#[cfg(feature = "tui")]
mod watch;
#[cfg(feature = "web")]
mod web;
#[cfg(any(feature = "tui", feature = "web"))]
mod work;

#[cfg(feature = "tui")]
pub use watch::{WatchOptions, watch};
#[cfg(feature = "web")]
pub use web::{WEB_PORT, WebOptions, web};
