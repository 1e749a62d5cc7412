//! What was taken comes back: when all is over no line is open, no loan is out, no sample is held.

use scanhub_schema::Nanos;

use super::{Judge, Say};
use crate::event::Event;

/// Looks at the end.
pub(crate) struct Resources;

impl Judge for Resources {
    fn name(&self) -> &'static str {
        "resources"
    }

    fn note(&mut self, _: Nanos, event: &Event<'_>, say: &mut Say<'_>) {
        if let Event::Over { handles, loans, held, .. } = *event
            && (handles, loans, held) != (0, 0, 0)
        {
            say.broken(format!("{handles} lines are open, {loans} loans are out, {held} samples are held"));
        }
    }
}
