//! The clocks of this machine, read for an end of a network. Refuses to know what is stamped.

use crate::lan::Stamp;
use scanhub_client::clock;

/// Returns this moment.
pub fn now() -> Stamp {
    Stamp { monotonic_ns: clock::now_ns(), wall_ns: clock::wall_ns() }
}
