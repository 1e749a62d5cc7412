//! Verbs that print and record the topics of a hub. Each verb is one file with its arguments, its function `run` and
//! its output. The verbs share the subscription loop in [`follow`]. They use `scanhub_client`, and never the hub's
//! crates. `run` takes a [`Context`](context::Context) with options, output and signals of the process.

pub mod background;
pub mod context;
pub mod control;
pub mod discovery;
pub mod duration;
pub mod echo;
pub mod follow;
pub mod hz;
pub mod info;
pub mod json;
pub mod latency;
pub mod leds;
pub mod list;
pub mod names;
pub mod output;
mod receive_stats;
#[cfg(feature = "record")]
pub mod record;
mod renamed_flag;
pub mod show;
pub mod text;
pub mod zones;

pub use follow::RunLimits;
pub use json::error as error_line;
pub use renamed_flag::with_new_name;
