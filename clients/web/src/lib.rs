//! What `scanhub web` serves: one page, and one WebSocket that speaks `foxglove.sdk.v1`, so that the page and other people's
//! viewers are clients of the same server. One thread serves all of them; whoever is slow gets the newest and costs nobody
//! anything. Refuses to know how a hub is followed.
#![forbid(unsafe_code)]

mod board;
mod door;
mod foxglove;
mod guest;
pub mod messages;
mod page;
mod playback;
mod request;
mod server;
mod viewer;

pub use board::{Board, Channel, ChannelId};
pub use door::Door;
pub use playback::{Order, Playback, Progress};
pub use server::{Event, Server, VIEWERS, Visit};
