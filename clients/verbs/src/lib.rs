//! The verbs that follow a hub and show, record or forward what it publishes: everything that prints. Each uses
//! `scanhub_client`, never the hub itself. Refuses to know command lines and signals: options are structs, the request
//! to stop is a flag.

mod background;
pub mod background_task;
mod body;
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
mod line;
mod list;
pub mod lossy_writer;
mod mask;
pub mod names;
pub mod output;
mod receive_stats;
#[cfg(feature = "record")]
mod record;
pub mod selection;
pub mod show;
pub mod text;
mod window;

pub use background::{BackgroundOptions, ModelOrder, background, saved_model};
pub use control::{ControlOptions, control};
pub use echo::{EchoOptions, Format, echo};
pub use follow::Bounds;
pub use hz::{HzOptions, hz};
pub use info::{InfoOptions, info};
pub use json::error as error_line;
pub use latency::LatencyArgs;
pub use leds::LedsArgs;
pub use list::{ListOptions, list, list_domains};
pub use mask::{MaskOptions, mask};
#[cfg(feature = "record")]
pub use record::RecordArgs;
