//! What is told of a stream beside its samples, in JSON or for people. Refuses to know how it was noticed.

use scanhub_schema::Failure;

use crate::names::TopicName;
use crate::output::{End, Output};
use crate::{json, text};

/// What went wrong in a stream, beside its samples.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Notice {
    /// So many samples were sent and not received.
    Missed(u64),
    /// Nothing came for longer than the topic's samples are apart.
    Stale,
    /// No hub runs in the domain when the verb starts, so the verb waits for one. The failure names the places that were
    /// searched, and the hubs of other users.
    NoHub(Failure),
    /// The hub of the domain has ended.
    HubGone,
    /// A hub lives in the domain again.
    HubBack,
}

impl Notice {
    /// Tells it of `names`, or of the domain if there are none: lines of JSON to `out`, or text to `notes`.
    pub(crate) fn tell(
        &self,
        names: &[&TopicName],
        json: bool,
        out: &mut Output<'_>,
        notes: &mut Output<'_>,
    ) -> Result<(), End> {
        match json {
            true => json::notices(out, names, self),
            false => notes.line(|line| text::notice(line, names, self)),
        }
    }
}
