//! Who has a key believes nobody who has not: what was forged is refused and for that reason, and what was recorded and is sent
//! again is never taken as new. (That all refusals are counted, and that the right gateway is believed all the time, others
//! judge.)

use std::collections::{HashMap, HashSet};

use scanhub_schema::Nanos;
use scanhub_schema::datagram::DatagramError;

use super::{Judge, Say};
use crate::event::{Arrival, Event};
use crate::hash::History;
use crate::remote::Forgery;

/// What was forged.
#[derive(Default)]
pub(crate) struct RemoteKeys {
    forged: HashMap<u64, Forgery>,
    /// What was recorded and sent again.
    again: HashSet<u64>,
    /// What the listener that lives took.
    taken: HashSet<u64>,
}

impl Judge for RemoteKeys {
    fn name(&self) -> &'static str {
        "remote_keys"
    }

    fn note(&mut self, _: Nanos, event: &Event<'_>, say: &mut Say<'_>) {
        match *event {
            Event::ListenerBegins { .. } => self.taken.clear(),
            Event::Forged { forgery: Forgery::Recording, bytes } => _ = self.again.insert(History::of(bytes)),
            Event::Forged { forgery, bytes } => _ = self.forged.insert(History::of(bytes), forgery),
            Event::Arrived { datagram, bytes, outcome, .. } => {
                let bytes = History::of(bytes);
                let is_new = matches!(outcome, Arrival::Announced | Arrival::Sample { late: false });
                if let Some(forgery) = self.forged.get(&bytes) {
                    let due = match forgery {
                        Forgery::Plain => DatagramError::Unauthenticated,
                        _ => DatagramError::Mac,
                    };
                    if outcome != Arrival::Refused(due) {
                        say.broken(format!("{forgery:?}, and it is {outcome:?}, due {due:?}: {datagram:?}"));
                    }
                } else if is_new && !self.taken.insert(bytes) {
                    say.broken(format!("it was taken before: {datagram:?}"));
                } else if is_new && self.again.contains(&bytes) {
                    say.broken(format!("it was recorded: {datagram:?}"));
                }
            }
            _ => {}
        }
    }
}
