//! The verbs that follow a hub and show, record or forward what it publishes: everything that prints. Each uses
//! `scanhub_client`, never the hub itself. Refuses to know command lines and signals: options are structs, the request
//! to stop is a flag.

mod background;
mod background_task;
mod body;
mod control;
mod discovery;
pub mod duration;
mod echo;
pub mod follow;
mod forward;
mod gateway;
mod hz;
mod info;
mod interface;
mod json;
mod key_file;
mod latency;
mod leds;
mod line;
mod list;
mod listen;
mod lossy_writer;
mod mask;
pub mod names;
pub mod output;
mod receive_stats;
mod reception;
#[cfg(feature = "record")]
mod record;
mod selection;
mod show;
mod stamp;
mod text;
mod tilt;
mod track;
mod window;

/// What carries samples to other machines and back has in common, whatever the network: the programs `scanhub` and
/// `scanhub-bridge` are built of it.
pub mod network {
    pub use crate::follow::Notice;
    pub use crate::forward::{Carrier, Forwarder, Life, Selection, account, begin_life, tell};
    pub use crate::lossy_writer::LossyWriter;
    pub use crate::output::{End, Output, quiet};
    pub use crate::reception::{Origin, Reception, Wanted, Words, received_topics};
    pub use crate::stamp::now;
}

pub use background::{BackgroundOptions, ModelOrder, background, saved_model};
pub use control::{ControlOptions, control};
pub use echo::{EchoOptions, Format, echo};
pub use follow::Bounds;
pub use gateway::{GatewayLook, GatewayOptions, gateway};
pub use hz::{HzOptions, hz};
pub use info::{InfoOptions, info};
pub use json::error as error_line;
pub use key_file::new_key;
pub use latency::{LatencyOptions, latency};
pub use leds::{LedsLook, LedsOptions, leds};
pub use list::{ListOptions, list, list_domains};
pub use listen::{ListenOptions, listen};
pub use mask::{MaskOptions, mask};
#[cfg(feature = "record")]
pub use record::{RecordLook, RecordOptions, Split, record};
pub use tilt::{TiltOptions, tilt};
pub use track::{TrackOptions, track};
