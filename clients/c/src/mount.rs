//! The angles of a mount as C publishes them. Refuses to know who follows them.

use scanhub_client::{Publication, home};
use scanhub_schema::Tilt;

use crate::call_error::CallError;

/// A mount whose angles are published.
pub(crate) struct Mount(Publication<Tilt>);

impl Mount {
    /// Publishes as `name` in `domain`, or in that which the environment names.
    pub(crate) fn publish(domain: Option<&str>, name: &str) -> Result<Mount, CallError> {
        Ok(Mount(Publication::in_domain(&home(domain)?, name)?))
    }

    /// Says how it stood at `stamp_ns` of CLOCK_MONOTONIC; 0: how it stands now.
    pub(crate) fn send(&mut self, stamp_ns: u64, tilt: Tilt) -> Result<(), CallError> {
        let fill = |sample: &mut Tilt| *sample = tilt;
        Ok(if stamp_ns == 0 { self.0.send(fill) } else { self.0.send_at(stamp_ns, fill) }?)
    }
}
