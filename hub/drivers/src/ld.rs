//! LDROBOT LD06, LD19, STL19P, STL27L and LD14P: the framer, packets, revolutions, and the session with a scanner that streams
//! without a request. Nothing is ever sent to it.

pub mod framer;
mod model;
pub mod packet;
mod point_count;
mod probe;
mod restarts;
mod sequence;
mod session;

pub use crate::line::{Tally, TurnCounts};
pub use model::Model;
pub use probe::Probe;
pub use session::{FEATURES, Session, Trouble};
pub(crate) use session::{check, scan_heads};
