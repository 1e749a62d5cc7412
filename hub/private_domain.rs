//! Private domain of this process, which is removed when the process ends.

use std::ops::Deref;

use scanhub_schema::{Failure, Kind};
use scanhub_shm::{Directory, Domain, Environment};
use tempfile::TempDir;

/// Private domain. Its directory and its shared memory are removed when this value is dropped.
pub(crate) struct PrivateDomain {
    domain: Domain,
    /// Temporary directory that contains the domain, if another user has occupied the usual directory.
    base: Option<TempDir>,
}

impl PrivateDomain {
    /// Creates a domain whose name is `prefix` followed by the process ID.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Failed`] if neither the usual directory nor a temporary directory can be used.
    pub(crate) fn new(prefix: &str) -> Result<PrivateDomain, Failure> {
        let name = format!("{prefix}-{}", std::process::id());
        let environment = Environment::of_process();
        // The path of the user's directory may be too long for a domain. The path for users without such a directory is
        // short enough.
        let fallback = Environment { uid: environment.uid, ..Environment::default() };
        for environment in [environment, fallback] {
            if let Ok(domain) = Domain::of_hub(&name, None, &environment)
                && Directory::create(domain.root()).is_ok()
            {
                return Ok(PrivateDomain { domain, base: None });
            }
        }
        let base = tempfile::Builder::new().prefix("scanhub-").tempdir().map_err(|error| {
            let message = format!("cannot create a temporary directory: {error}");
            Failure::new(Kind::Failed, message, "set TMPDIR to a directory that this user may write")
        })?;
        let domain = Domain::of_hub(&name, Some(base.path()), &Environment::default())?;
        Ok(PrivateDomain { domain, base: Some(base) })
    }

    /// Returns the flags by which another program finds the domain.
    pub(crate) fn flags(&self) -> String {
        let name = self.domain.name();
        match &self.base {
            Some(base) => format!("--domain {name} --root {}", base.path().display()),
            None => format!("--domain {name}"),
        }
    }
}

impl Deref for PrivateDomain {
    type Target = Domain;

    fn deref(&self) -> &Domain {
        &self.domain
    }
}

impl Drop for PrivateDomain {
    fn drop(&mut self) {
        // The name contains the process ID, so nothing in the directory belongs to another process.
        let _ = std::fs::remove_dir_all(self.root());
        let prefix = self.prefix();
        let entries = std::fs::read_dir("/dev/shm").into_iter().flatten().flatten();
        for entry in entries.filter(|entry| entry.file_name().to_string_lossy().starts_with(&prefix)) {
            let _ = std::fs::remove_file(entry.path());
        }
    }
}
