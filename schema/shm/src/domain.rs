//! Where the shared memory of one hub is: a root directory and a prefix that no other hub shares. Pure: it lists the
//! possible places in their order; refuses to check whether a hub runs there.

use std::path::{Path, PathBuf};

use scanhub_schema::{Failure, Kind};

/// The default domain.
pub const DEFAULT_DOMAIN: &str = "scanhub";

/// Root and prefix, with its random part, stay below this many bytes: the path of a listener's socket, 107 bytes at most
/// (unix(7)), has a number of up to 35 digits and 7 bytes besides.
const PLACE_LIMIT: usize = 66;

/// Bytes that a domain's directory adds to the prefix (`prefix.rs`): five random letters, and `_`.
const RANDOM: usize = 6;

/// What systemd makes for the service; clients outside of the service look there too.
const SERVICE_BASE: &str = "/run/scanhub";

/// A domain at its place.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Domain {
    name: String,
    root: PathBuf,
}

impl Domain {
    /// Returns domain `name` below the directory `base` (`--root`); a relative one counts from the working directory.
    ///
    /// # Errors
    ///
    /// [`Kind::Configuration`] if the name is not possible, or root and prefix are too long together.
    pub fn at(name: &str, base: &Path) -> Result<Domain, Failure> {
        check_name(name)?;
        let base = std::path::absolute(base).unwrap_or_else(|_| base.to_owned());
        let domain = Domain { name: name.to_owned(), root: base.join(name) };
        let length = domain.root.as_os_str().len() + domain.prefix().len() + RANDOM;
        if length < PLACE_LIMIT {
            return Ok(domain);
        }
        Err(Failure::new(
            Kind::Configuration,
            format!(
                "domain {name} at {} is too long: root and prefix {}xxxxx_ have {length} bytes, at most {} are possible",
                domain.root.display(),
                domain.prefix(),
                PLACE_LIMIT - 1
            ),
            "choose a shorter --root or --domain",
        ))
    }

    /// Returns where a hub puts domain `name`: below `base` if given, else the first place that the environment offers.
    ///
    /// # Errors
    ///
    /// [`Kind::Configuration`] as [`Domain::at`].
    pub fn of_hub(name: &str, base: Option<&Path>, environment: &Environment) -> Result<Domain, Failure> {
        let base = base.map_or_else(|| environment.base_of_hub(), Path::to_owned);
        Domain::at(name, &base)
    }

    /// Returns where a client looks for domain `name`: below `base` only if given, else every place that a hub may have
    /// chosen, in order; the first one that is live is taken. Places that are too long for a hub are left out.
    ///
    /// # Errors
    ///
    /// [`Kind::Configuration`] as [`Domain::at`].
    pub fn candidates(
        name: &str,
        base: Option<&Path>,
        environment: &Environment,
    ) -> Result<Vec<Domain>, Failure> {
        check_name(name)?;
        if let Some(base) = base {
            return Ok(vec![Domain::at(name, base)?]);
        }
        let mut domains = Vec::new();
        for base in environment.bases() {
            match Domain::at(name, &base) {
                Ok(domain) if !domains.contains(&domain) => domains.push(domain),
                _ => {}
            }
        }
        Ok(domains)
    }

    /// Returns the domain's name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Returns the directory of all its files, the lock among them.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// Returns how the names of its shared memory begin; what follows is in the directory's file `prefix`.
    pub fn prefix(&self) -> String {
        format!("sh_{}_", self.name)
    }
}

/// The variables of the process's environment that name places.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Environment {
    /// RUNTIME_DIRECTORY: set for the service, by systemd.
    pub runtime_directory: Option<PathBuf>,
    /// XDG_RUNTIME_DIR: set for a user who has logged in.
    pub xdg_runtime_dir: Option<PathBuf>,
    /// The user's number.
    pub uid: u32,
}

impl Environment {
    /// Returns the environment of this process.
    pub fn of_process() -> Environment {
        let path = |name| std::env::var_os(name).and_then(first_path);
        Environment {
            runtime_directory: path("RUNTIME_DIRECTORY"),
            xdg_runtime_dir: path("XDG_RUNTIME_DIR"),
            uid: rustix::process::getuid().as_raw(),
        }
    }

    /// Returns every directory that may hold domains, in the order in which clients look. A hub of a login session is found
    /// even from outside of it: sudo, ssh and cron do not set XDG_RUNTIME_DIR.
    pub fn bases(&self) -> Vec<PathBuf> {
        let mut bases: Vec<PathBuf> = self.runtime_directory.iter().cloned().collect();
        bases.push(SERVICE_BASE.into());
        let user = self.xdg_runtime_dir.clone().unwrap_or_else(|| format!("/run/user/{}", self.uid).into());
        bases.push(user.join("scanhub"));
        bases.push(self.fallback());
        bases.dedup();
        bases
    }

    /// Returns the directory that a hub with this environment puts its domain into.
    pub(crate) fn base_of_hub(&self) -> PathBuf {
        match (&self.runtime_directory, &self.xdg_runtime_dir) {
            (Some(service), _) => service.clone(),
            (None, Some(user)) => user.join("scanhub"),
            (None, None) => self.fallback(),
        }
    }

    fn fallback(&self) -> PathBuf {
        format!("/tmp/scanhub-{}", self.uid).into()
    }
}

/// Refuses a domain's name that is not `[a-z0-9-]{1,16}`.
pub(crate) fn check_name(name: &str) -> Result<(), Failure> {
    let allowed = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '-';
    if (1..=16).contains(&name.len()) && name.chars().all(allowed) {
        return Ok(());
    }
    Err(Failure::new(
        Kind::Configuration,
        format!("domain name {name:?} is not possible"),
        "1 to 16 of a-z, 0-9 and -, for example scanhub",
    ))
}

/// The first of a colon-separated list (systemd lists several runtime directories so), if it is absolute.
pub(crate) fn first_path(value: std::ffi::OsString) -> Option<PathBuf> {
    let text = value.into_string().ok()?;
    let first = PathBuf::from(text.split(':').next()?);
    first.is_absolute().then_some(first)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn environment(service: Option<&str>, user: Option<&str>) -> Environment {
        Environment {
            runtime_directory: service.map(Into::into),
            xdg_runtime_dir: user.map(Into::into),
            uid: 7,
        }
    }

    fn root(domain: Result<Domain, Failure>) -> PathBuf {
        domain.unwrap().root().to_owned()
    }

    #[test]
    fn a_hub_takes_the_first_place() {
        let all = environment(Some("/run/scanhub"), Some("/run/user/7"));
        let user = environment(None, Some("/run/user/7"));
        let none = environment(None, None);
        assert_eq!(root(Domain::of_hub("a", Some(Path::new("/b")), &all)), Path::new("/b/a"));
        assert_eq!(root(Domain::of_hub("a", None, &all)), Path::new("/run/scanhub/a"));
        assert_eq!(root(Domain::of_hub("a", None, &user)), Path::new("/run/user/7/scanhub/a"));
        assert_eq!(root(Domain::of_hub("a", None, &none)), Path::new("/tmp/scanhub-7/a"));
    }

    #[test]
    fn a_client_looks_everywhere_in_order() {
        let roots = |environment: &Environment| -> Vec<String> {
            let places = Domain::candidates("a", None, environment).unwrap();
            places.iter().map(|domain| domain.root().display().to_string()).collect()
        };
        let expected = ["/run/scanhub/a", "/run/user/7/scanhub/a", "/tmp/scanhub-7/a"];
        assert_eq!(roots(&environment(None, Some("/run/user/7"))), expected);
        assert_eq!(roots(&environment(None, None)), expected, "outside of the login session");
        assert_eq!(roots(&environment(None, Some("/x")))[1], "/x/scanhub/a");
    }

    #[test]
    fn names_and_lengths() {
        assert_eq!(Domain::at("t-1", Path::new("/x")).unwrap().prefix(), "sh_t-1_");
        for bad in ["", "A", "a_b", "a/b", &"a".repeat(17)] {
            assert_eq!(
                Domain::at(bad, Path::new("/x")).map_err(|failure| failure.kind),
                Err(Kind::Configuration)
            );
        }
        // "/" + 52 + "/a" and "sh_a_xxxxx_" are 66.
        let base = format!("/{}", "b".repeat(52));
        assert_eq!(
            Domain::at("a", Path::new(&base)).map_err(|failure| failure.kind),
            Err(Kind::Configuration)
        );
        assert!(Domain::at("a", Path::new(&base[..52])).is_ok());
    }

    #[test]
    fn the_first_of_several_directories_counts() {
        assert_eq!(first_path("/run/a:/run/b".into()), Some("/run/a".into()));
        assert_eq!(first_path("relative".into()), None);
    }
}
