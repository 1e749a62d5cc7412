//! Prints and records the topics of a hub: each verb is one file with its arguments, its run and its output. [`follow`] is the
//! loop that they share. A verb uses `scanhub_client`, never the hub itself, and takes the request to stop as a flag.

mod background;
mod control;
pub mod discovery;
pub mod duration;
mod echo;
pub mod follow;
mod hz;
mod info;
pub mod json;
mod latency;
mod leds;
mod list;
pub mod lossy_writer;
pub mod names;
pub mod output;
mod receive_stats;
#[cfg(feature = "record")]
mod record;
pub mod show;
pub mod text;
mod zones;

pub use background::{BackgroundArgs, ModelOrder, saved_model};
pub use control::ControlArgs;
pub use echo::EchoArgs;
pub use follow::Bounds;
pub use hz::HzArgs;
pub use info::InfoArgs;
pub use json::error as error_line;
pub use latency::LatencyArgs;
pub use leds::LedsArgs;
pub use list::ListArgs;
#[cfg(feature = "record")]
pub use record::RecordArgs;
pub use zones::ZonesArgs;
