//! A domain of this process alone, gone with it. Refuses to know what hub runs in it.

use std::ops::Deref;

use schema::{Domain, Environment, Failure};

/// The domain; its directory and its shared memory are removed when this is dropped.
pub(crate) struct OwnDomain(Domain);

impl OwnDomain {
    /// One whose name begins with `word`, and has our process id.
    pub(crate) fn new(word: &str) -> Result<OwnDomain, Failure> {
        let name = format!("{word}-{}", std::process::id());
        let environment = Environment::of_process();
        // Where the user's own place is too long a name for a domain, that of who has none is not.
        let fallback = Environment { uid: environment.uid, ..Environment::default() };
        let domain = Domain::of_hub(&name, None, &environment);
        domain.or_else(|_| Domain::of_hub(&name, None, &fallback)).map(OwnDomain)
    }
}

impl Deref for OwnDomain {
    type Target = Domain;

    fn deref(&self) -> &Domain {
        &self.0
    }
}

impl Drop for OwnDomain {
    fn drop(&mut self) {
        // All of it is ours alone: the name has our process id.
        let _ = std::fs::remove_dir_all(self.root());
        let prefix = self.prefix();
        let entries = std::fs::read_dir("/dev/shm").into_iter().flatten().flatten();
        for entry in entries.filter(|entry| entry.file_name().to_string_lossy().starts_with(&prefix)) {
            let _ = std::fs::remove_file(entry.path());
        }
    }
}
