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
mod file;
mod follow;
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
mod names;
mod output;
mod receive_stats;
#[cfg(feature = "record")]
mod record;
mod selection;
mod show;
mod stamp;
mod text;
#[cfg(feature = "tui")]
mod watch;
mod window;

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
#[cfg(feature = "tui")]
pub use watch::{WatchOptions, watch};
