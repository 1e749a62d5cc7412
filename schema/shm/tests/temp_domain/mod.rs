//! A domain for a single test.

use std::path::PathBuf;
use std::sync::atomic::{AtomicU32, Ordering};

use scanhub_shm::Domain;

/// A domain that is removed at the end of the test.
pub(crate) struct TempDomain {
    pub(crate) base: PathBuf,
    pub(crate) domain: Domain,
}

impl TempDomain {
    pub(crate) fn new() -> TempDomain {
        static NEXT: AtomicU32 = AtomicU32::new(0);
        let number = NEXT.fetch_add(1, Ordering::Relaxed);
        let base = PathBuf::from(format!("/tmp/shs{}-{number}", std::process::id()));
        let domain = Domain::at(&format!("s{}-{number}", std::process::id()), &base).unwrap();
        TempDomain { base, domain }
    }
}

impl Drop for TempDomain {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.base);
        // The library's management segment of a domain outlives its nodes.
        for entry in std::fs::read_dir("/dev/shm").into_iter().flatten().flatten() {
            if entry.file_name().to_string_lossy().starts_with(&self.domain.prefix()) {
                let _ = std::fs::remove_file(entry.path());
            }
        }
    }
}
