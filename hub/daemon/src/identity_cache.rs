//! What a hub knew of the sensor of a link a moment before it was killed, for the next one: without it there are no scans until
//! the sensor has answered two questions, and each answer costs a scan. A small file in the domain's directory, written as
//! soon as that is known, and once a second while the sensor streams. Refuses to know what of a sensor is worth to be known, and whether the line
//! was its own all the while.

use std::fs::File;
use std::os::unix::fs::FileExt;
use std::path::Path;

use lms::{Identity, MILLIS, Nanos, Session};
use port::clock;
use schema::Directory;

/// The identity of the sensor of one link.
pub(crate) struct IdentityCache {
    /// Stamp, identity, port; nothing where it cannot be written: then the sensor is asked.
    file: Option<File>,
    /// Of which port it is.
    port: String,
    record: Vec<u8>,
    /// What stands in it behind the stamp.
    identity: Option<Identity>,
}

impl IdentityCache {
    /// That of the link `name` at `port`, in the directory `root`.
    pub(crate) fn open(root: &Path, name: &str, port: &str) -> IdentityCache {
        let file = match Directory::open(root) {
            Ok(Some(directory)) => directory.file_or_new(&format!("{name}.sensor")).map(Some),
            nowhere => nowhere.map(|_| None),
        };
        let file =
            file.inspect_err(|error| tracing::debug!(%error, "{name}: the learned state cannot be saved"));
        IdentityCache { file: file.ok().flatten(), port: port.to_owned(), record: Vec::new(), identity: None }
    }

    /// What the hub before this one knew, if that was just now and of this port.
    pub(crate) fn recall(&self, now: Nanos) -> Option<Identity> {
        // One byte more than there should be would be another port.
        let mut record = vec![0; STAMP + Identity::LEN + self.port.len() + 1];
        let len = self.file.as_ref()?.read_at(&mut record, 0).ok()?;
        let (stamp, rest) = record[..len].split_first_chunk()?;
        let (identity, port) = rest.split_first_chunk()?;
        let is_new = now.checked_sub(Nanos::from_le_bytes(*stamp)).is_some_and(|age| age < FRESH);
        (is_new && port == self.port.as_bytes()).then(|| Identity::from_bytes(*identity))
    }

    /// Keeps what `session` knows `now`, if that is worth it.
    pub(crate) fn keep(&mut self, session: &Session, now: Nanos) {
        if let Some(identity) = session.identity() {
            self.write(identity, now);
        }
    }

    /// As soon as anything is known; then [`keep`](Self::keep) keeps it new.
    pub(crate) fn keep_first(&mut self, session: &Session) {
        if self.identity.is_none() {
            self.keep(session, clock::now());
        }
    }

    fn write(&mut self, identity: Identity, now: Nanos) {
        let Some(file) = &self.file else { return };
        if self.identity != Some(identity) {
            self.identity = Some(identity);
            self.record.clear();
            self.record.extend([0; STAMP]);
            self.record.extend(identity.to_bytes());
            self.record.extend(self.port.as_bytes());
        }
        self.record[..STAMP].copy_from_slice(&now.to_le_bytes());
        // One that cannot be written is too old soon; behind a shorter one nothing of a longer one stays.
        let _ = file.write_all_at(&self.record, 0).and_then(|()| file.set_len(self.record.len() as u64));
    }
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
        let base = std::env::temp_dir().join(format!("scanhub-cache-{}", std::process::id()));
        let root = base.join("domain");
        Directory::make(&root).unwrap();
        let identity = |byte: u8| Identity::from_bytes([byte; Identity::LEN]);
        let (now, port) = (9_000 * MILLIS, "/dev/ttyUSB0");
        let mut cache = IdentityCache::open(&root, "front", port);
        assert_eq!(cache.recall(now), None, "the first one");
        cache.write(identity(1), now - 1);
        cache.write(identity(2), now);
        let next = |name, port, now| IdentityCache::open(&root, name, port).recall(now);
        assert_eq!(next("front", port, now + FRESH - 1), Some(identity(2)));
        assert_eq!(next("front", port, now + FRESH), None, "too old");
        assert_eq!(next("front", port, now - 1), None, "of another life of the machine");
        assert_eq!(next("rear", port, now), None);
        assert_eq!(next("front", "/dev/ttyUSB", now), None);
        assert_eq!(next("front", "/dev/ttyUSB01", now), None);
        let mut other = IdentityCache::open(&root, "front", "/dev/x");
        other.write(identity(3), now);
        assert_eq!((next("front", "/dev/x", now), next("front", port, now)), (Some(identity(3)), None));
        std::fs::write(root.join("front.sensor"), [0; 9]).unwrap();
        assert_eq!(next("front", port, now), None, "cut short");
        // Where nothing can be kept, nothing is known.
        let mut nowhere = IdentityCache::open(&root.join("nowhere"), "front", port);
        nowhere.write(identity(1), now);
        assert_eq!(nowhere.recall(now), None);
        std::fs::remove_dir_all(&base).unwrap();
    }
}
