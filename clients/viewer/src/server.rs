//! What `scanhub web` serves: one page, and one WebSocket that speaks `foxglove.sdk.v1`, so that the page and other people's
//! viewers are clients of the same server. One thread serves all of them; whoever is slow gets the newest and costs nobody
//! anything. Refuses to know how a hub is followed.

mod board;
mod door;
mod foxglove;
mod guest;
mod listener;
pub mod messages;
mod page;
mod playback;
mod request;
mod viewer;

pub use board::{Board, Channel, ChannelId};
pub use door::Door;
pub use listener::{Event, Server, VIEWERS, Visit};
pub use playback::{Order, Playback, Progress};
