//! What a hub knew of the sensor of a link a moment before it was killed, for the next one: without it there are no scans until
//! the sensor has answered two questions, and each answer costs a scan. A short record, written as soon as that is known, and
//! once a second while the sensor streams. Refuses to know what of a sensor is worth to be known, where the record lies, and
//! whether the line was its own all the while.

use scanhub_drivers::PortSession;
use scanhub_drivers::line::{Identity, Session as _};
use schema::{MILLIS, Nanos};

use crate::surroundings::Surroundings;

/// The identity of the sensor of one link.
pub(crate) struct IdentityCache<'a, S> {
    around: &'a S,
    link: &'a str,
    /// Of which port it is.
    port: String,
    /// Stamp, identity, port.
    record: Vec<u8>,
    /// What stands in it behind the stamp.
    identity: Option<Identity>,
}

impl<'a, S: Surroundings> IdentityCache<'a, S> {
    /// That of `link` at `port`.
    pub(crate) fn new(around: &'a S, link: &'a str, port: String) -> Self {
        IdentityCache { around, link, port, record: Vec::new(), identity: None }
    }

    /// What the hub before this one knew, if that was just now and of this port.
    pub(crate) fn recall(&self, now: Nanos) -> Option<Identity> {
        // One byte more than there should be would be another port.
        let mut record = vec![0; STAMP + size_of::<Identity>() + self.port.len() + 1];
        let len = self.around.recall(self.link, &mut record)?;
        read(record.get(..len)?, &self.port, now)
    }

    /// Keeps what `session` knows `now`, if that is worth it.
    pub(crate) fn keep(&mut self, session: &PortSession, now: Nanos) {
        if let Some(identity) = session.identity() {
            self.write(identity, now);
        }
    }

    /// As soon as anything is known; then [`keep`](Self::keep) keeps it new.
    pub(crate) fn keep_first(&mut self, session: &PortSession) {
        if self.identity.is_none() {
            self.keep(session, self.around.now());
        }
    }

    fn write(&mut self, identity: Identity, now: Nanos) {
        if self.identity != Some(identity) {
            self.identity = Some(identity);
            write(&mut self.record, identity, &self.port);
        }
        self.record[..STAMP].copy_from_slice(&now.to_le_bytes());
        self.around.remember(self.link, &self.record);
    }
}

/// Makes `record` that of a sensor of this identity at `port`, without a stamp.
fn write(record: &mut Vec<u8>, identity: Identity, port: &str) {
    record.clear();
    record.extend([0; STAMP]);
    record.extend(identity);
    record.extend(port.as_bytes());
}

/// The identity in `record`, if that is of this port and new.
fn read(record: &[u8], port: &str, now: Nanos) -> Option<Identity> {
    let (stamp, rest) = record.split_first_chunk()?;
    let (identity, of) = rest.split_first_chunk()?;
    let is_new = now.checked_sub(Nanos::from_le_bytes(*stamp)).is_some_and(|age| age < FRESH);
    (is_new && of == port.as_bytes()).then_some(*identity)
}

/// Bytes of a stamp.
const STAMP: usize = size_of::<Nanos>();
/// Who streams after so long may be another sensor. It is written each second, and read as soon as the next hub is there.
const FRESH: Nanos = 3_000 * MILLIS;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_known_just_now_of_this_port_is_known() {
        let (now, port) = (9_000 * MILLIS, "/dev/ttyUSB0");
        let identity: Identity = [2; size_of::<Identity>()];
        let mut record = vec![7; 300];
        write(&mut record, identity, port);
        record[..STAMP].copy_from_slice(&now.to_le_bytes());
        assert_eq!(read(&record, port, now + FRESH - 1), Some(identity));
        assert_eq!(read(&record, port, now + FRESH), None, "too old");
        assert_eq!(read(&record, port, now - 1), None, "of another life of the machine");
        for other in ["/dev/ttyUSB", "/dev/ttyUSB01", ""] {
            assert_eq!(read(&record, other, now), None, "{other}");
        }
        for len in 0..record.len() {
            assert_eq!(read(&record[..len], port, now), None, "cut after {len} bytes");
        }
    }
}
