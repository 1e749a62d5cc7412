//! Sensors that were announced before their gateway was known to deliver. They have no topics yet, but the last sample of
//! each topic with a history is kept: a background, for example, is sent only once.

use std::collections::VecDeque;

use scanhub_schema::Topic;
use scanhub_schema::datagram::{Datagram, Head};

use super::SENSORS;
use crate::lan::incoming::Remote;

/// The sensors that were announced last. All others have to be announced again.
#[derive(Default)]
pub(super) struct Candidates(VecDeque<Candidate>);

/// A sensor, and its samples that late subscribers would get.
pub(super) struct Candidate {
    /// Gateway, its run, and the sensor's number.
    source: (u64, u32, u8),
    /// At most one of each topic.
    kept: Vec<Kept>,
}

/// A sample that is not published yet.
struct Kept {
    head: Head,
    topic: Topic,
    payload: Vec<u8>,
    boot: u64,
    arrival_ns: u64,
    age_ns: Option<u64>,
}

/// Maximum number of candidates. Their samples take up to 17 kB each.
const CANDIDATES: usize = 4 * SENSORS;

impl Candidates {
    /// Adds the sensor that sent `head`, unless it is a candidate already.
    pub(super) fn add(&mut self, head: &Head) -> &mut Candidate {
        let source = source(head);
        let at = match self.0.iter().position(|candidate| candidate.source == source) {
            Some(at) => at,
            None => {
                self.put_back(Candidate { source, kept: Vec::new() });
                self.0.len() - 1
            }
        };
        &mut self.0[at]
    }

    /// Adds `candidate`, which was not one. The oldest one has to go if there are too many.
    pub(super) fn put_back(&mut self, candidate: Candidate) {
        if self.0.len() == CANDIDATES {
            self.0.pop_front();
        }
        self.0.push_back(candidate);
    }

    /// Removes the sensor that sent `head`, and returns it if it was a candidate.
    pub(super) fn take(&mut self, head: &Head) -> Option<Candidate> {
        let source = source(head);
        let at = self.0.iter().position(|candidate| candidate.source == source)?;
        self.0.remove(at)
    }
}

impl Candidate {
    /// Keeps `remote` in place of the last sample of its topic, if the topic has a history.
    pub(super) fn keep(&mut self, remote: &Remote<'_>) {
        let &Remote { topic, datagram, boot, arrival_ns, age_ns, .. } = remote;
        if topic.row().kept > 0 {
            self.kept.retain(|kept| kept.topic != topic);
            let (head, payload) = (datagram.head, datagram.payload.to_vec());
            self.kept.push(Kept { head, topic, payload, boot, arrival_ns, age_ns });
        }
    }

    /// Returns the samples that are kept, each as it was received.
    pub(super) fn samples(&self) -> impl Iterator<Item = Remote<'_>> {
        self.kept.iter().map(|kept| Remote {
            topic: kept.topic,
            datagram: Datagram { head: kept.head, payload: &kept.payload, mac: None },
            boot: kept.boot,
            arrival_ns: kept.arrival_ns,
            age_ns: kept.age_ns,
            late: false,
            // Nothing is a candidate if there is a key.
            authenticated: false,
        })
    }
}

fn source(head: &Head) -> (u64, u32, u8) {
    (head.hub, head.epoch, head.sensor)
}
