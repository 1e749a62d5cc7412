//! Everyone who listens: the attach library, and the verbs that show what the hub publishes. Knows only `schema`; a hub
//! is a lock that is held and topics that are there. Refuses to know command lines and signals: options come as structs,
//! the wish to stop as a flag.

mod account;
mod attach;
mod background;
mod body;
mod clock;
mod control;
pub mod duration;
mod echo;
mod errand;
mod file;
mod follow;
mod follower;
mod freshness;
mod gateway;
mod hz;
mod info;
mod interface;
mod json;
mod latency;
mod leds;
mod line;
mod list;
mod listen;
mod mask;
mod names;
mod output;
mod presence;
mod readiness;
#[cfg(feature = "record")]
mod record;
mod robot;
mod roll;
mod sample;
mod selection;
mod session;
mod spare;
mod text;
mod wait;
#[cfg(feature = "tui")]
mod watch;
mod window;
mod zones;

pub use attach::{Attachment, attach, places};
pub use background::{BackgroundOptions, ModelOrder, background, saved_model};
pub use control::{ControlOptions, control};
pub use echo::{EchoOptions, Format, echo};
pub use follow::Bounds;
pub use follower::Received;
pub use gateway::{GatewayLook, GatewayOptions, gateway};
pub use hz::{HzOptions, hz};
pub use info::{InfoOptions, info};
pub use json::error as error_line;
pub use latency::{LatencyOptions, latency};
pub use leds::{LedsLook, LedsOptions, leds};
pub use list::{ListOptions, list, list_domains, live_sensors, live_topics};
pub use listen::{ListenOptions, listen};
pub use mask::{MaskOptions, mask};
pub use names::TopicName;
#[cfg(feature = "record")]
pub use record::{RecordLook, RecordOptions, Split, record};
pub use robot::{Robot, RobotFollower, robot};
pub use wait::Wait;
#[cfg(feature = "tui")]
pub use watch::{WatchOptions, watch};
pub use zones::{Heard, ZonesFollower, zones};
