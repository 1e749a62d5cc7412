//! Domains: the locations in which the shared memory of a hub may be, and the hubs that run on this machine.
//!
//! [`Domain`] and [`Environment`] only compute locations, in the order in which clients search them. [`RunningHub`]
//! finds the hubs of all users in /proc. Shared memory belongs to one user, so a client of another user finds no hub.
//! The message of the client then names the user whose hub runs, and the command that reaches this hub.

use std::ffi::{OsStr, OsString};
use std::fs;
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};

use scanhub_schema::{Failure, Kind};

/// The default domain.
pub const DEFAULT_DOMAIN: &str = "scanhub";

/// Root and prefix together, with the random part of the prefix, must have fewer bytes than this limit. The library
/// puts root and prefix into the path of a socket, which has at most 107 bytes (unix(7)). This path also contains a
/// number of up to 35 digits and 7 other bytes.
const LOCATION_LEN_LIMIT: usize = 66;

/// Number of bytes that `segments.rs` appends to the prefix: five random letters, and `_`.
const RANDOM_LEN: usize = 6;

/// Directory that systemd creates for the service. Clients outside of the service search this directory, too.
const SERVICE_BASE: &str = "/run/scanhub";

/// A domain at its location.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Domain {
    name: String,
    root: PathBuf,
}

impl Domain {
    /// Returns domain `name` below the directory `base` (`--root`), which may be relative to the working directory.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Configuration`] if the name is not valid, or if root and prefix together are too long.
    pub fn at(name: &str, base: &Path) -> Result<Domain, Failure> {
        check_name(name)?;
        let base = std::path::absolute(base).unwrap_or_else(|_| base.to_owned());
        let domain = Domain { name: name.to_owned(), root: base.join(name) };
        let length = domain.root.as_os_str().len() + domain.prefix().len() + RANDOM_LEN;
        if length < LOCATION_LEN_LIMIT {
            return Ok(domain);
        }
        Err(Failure::new(
            Kind::Configuration,
            format!(
                "domain {name} at {} is too long: root and prefix {}xxxxx_ have {length} bytes, at most {} are possible",
                domain.root.display(),
                domain.prefix(),
                LOCATION_LEN_LIMIT - 1
            ),
            "choose a shorter --root or --domain",
        ))
    }

    /// Returns the location in which a hub creates domain `name`: below `base` if it is given, otherwise in the first
    /// directory that the environment names.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`Domain::at`].
    pub fn of_hub(name: &str, base: Option<&Path>, environment: &Environment) -> Result<Domain, Failure> {
        let base = base.map_or_else(|| environment.base_of_hub(), Path::to_owned);
        Domain::at(name, &base)
    }

    /// Returns the locations in which a client searches for domain `name`, in this order: only below `base` if `base`
    /// is given, otherwise in each directory that a hub may have chosen. Locations whose path is too long for a hub are
    /// left out.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`Domain::at`].
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
            if let Ok(domain) = Domain::at(name, &base)
                && !domains.contains(&domain)
            {
                domains.push(domain);
            }
        }
        Ok(domains)
    }

    /// Returns the domain's name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Returns the directory of the domain's files, such as its locks.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// Returns the text with which the names of the domain's shared memory start. The rest of the prefix is in the file
    /// `prefix` of the domain's directory.
    pub fn prefix(&self) -> String {
        format!("sh_{}_", self.name)
    }
}

/// Variables of a process's environment that name locations, and the user of the process.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Environment {
    /// RUNTIME_DIRECTORY, which systemd sets for the service.
    pub runtime_directory: Option<PathBuf>,
    /// XDG_RUNTIME_DIR, which is set in a login session.
    pub xdg_runtime_dir: Option<PathBuf>,
    /// User ID.
    pub uid: u32,
}

impl Environment {
    /// Returns the environment of this process.
    pub fn of_process() -> Environment {
        Environment::of(|name| std::env::var_os(name), rustix::process::getuid().as_raw())
    }

    fn of(variable: impl Fn(&str) -> Option<OsString>, uid: u32) -> Environment {
        let path = |name| variable(name).and_then(first_path);
        Environment {
            runtime_directory: path("RUNTIME_DIRECTORY"),
            xdg_runtime_dir: path("XDG_RUNTIME_DIR"),
            uid,
        }
    }

    /// Returns every directory that may contain domains, in the order in which clients search. The list contains the
    /// directory of the login session even if XDG_RUNTIME_DIR is not set. sudo, ssh and cron do not set this variable.
    pub fn bases(&self) -> Vec<PathBuf> {
        let mut bases: Vec<PathBuf> = self.runtime_directory.iter().cloned().collect();
        bases.push(SERVICE_BASE.into());
        let user = self.xdg_runtime_dir.clone().unwrap_or_else(|| format!("/run/user/{}", self.uid).into());
        bases.push(user.join("scanhub"));
        bases.push(self.fallback());
        bases.dedup();
        bases
    }

    /// Returns the directory in which a hub with this environment creates its domain.
    fn base_of_hub(&self) -> PathBuf {
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

/// A process that runs a hub: `scanhub run` or `scanhub replay`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RunningHub {
    /// Process ID.
    pub pid: u32,
    /// ID of the user that the hub runs as.
    pub uid: u32,
    /// Name of this user. For a user without a name, it is `#` and the ID, which `sudo -u` accepts.
    pub user: String,
    /// Domain of the hub. `None` if the domain may be set only in the hub's environment, which other users cannot read.
    pub domain: Option<String>,
    /// Directory that contains the domain. `None` if this directory depends on the hub's environment, which other users
    /// cannot read.
    pub base: Option<PathBuf>,
    /// Path or name of the program with which the hub was started.
    program: String,
}

impl RunningHub {
    /// Returns the hubs that run on this machine, sorted by process ID. `root` is the root of the file system, except
    /// in tests. Processes that this user may not see are missing.
    pub fn all(root: &Path) -> Vec<RunningHub> {
        let users = fs::read_to_string(root.join("etc/passwd")).unwrap_or_default();
        let processes = fs::read_dir(root.join("proc")).into_iter().flatten().flatten();
        let mut hubs: Vec<RunningHub> = processes
            .filter_map(|process| {
                let pid = process.file_name().to_str()?.parse().ok()?;
                RunningHub::of_process(&process.path(), pid, &users)
            })
            .collect();
        hubs.sort_by_key(|hub| hub.pid);
        hubs
    }

    /// Returns the hub that process `pid` runs, or `None` if the process does not run a hub. `path` is the directory of
    /// the process in /proc, and `users` is the text of /etc/passwd.
    fn of_process(path: &Path, pid: u32, users: &str) -> Option<RunningHub> {
        let text = |name: &str| fs::read_to_string(path.join(name)).ok();
        if text("comm")?.trim_end() != "scanhub" {
            return None;
        }
        let command_line = fs::read(path.join("cmdline")).ok()?;
        let command = CommandLine::parse(&command_line)?;
        let uid = text("status")?.lines().find_map(|line| line.strip_prefix("Uid:"))?.to_owned();
        let uid: u32 = uid.split_whitespace().next()?.parse().ok()?;
        let entry = users.lines().find(|line| line.split(':').nth(2) == Some(&uid.to_string()));
        let user = entry.and_then(|entry| entry.split(':').next());
        let user = user.map_or_else(|| format!("#{uid}"), str::to_owned);
        let environment = fs::read(path.join("environ")).ok();
        let variable = |name: &str| {
            let mut all = environment.as_deref().unwrap_or_default().split(|&byte| byte == 0);
            let value = all.find_map(|entry| entry.strip_prefix(name.as_bytes())?.strip_prefix(b"="))?;
            (!value.is_empty()).then(|| OsStr::from_bytes(value).to_owned())
        };
        let base = match command.root {
            // A relative directory is relative to the working directory of the process, which other users cannot read.
            Some(root) => Some(fs::read_link(path.join("cwd")).map_or(root.clone(), |cwd| cwd.join(root))),
            None => environment.is_some().then(|| Environment::of(variable, uid).base_of_hub()),
        };
        let domain = command.domain.or_else(|| variable("SCANHUB_DOMAIN")?.into_string().ok());
        let domain = domain.or_else(|| environment.is_some().then(|| DEFAULT_DOMAIN.to_owned()));
        // Check the name. Any user can start a process with any command line, and the name becomes part of a suggested
        // command.
        if let Some(domain) = &domain {
            check_name(domain).ok()?;
        }
        // A relative path is relative to the process's working directory.
        let program = if command.program.contains('/') && !command.program.starts_with('/') {
            let directory = fs::read_link(path.join("cwd"));
            directory.map_or("scanhub".to_owned(), |it| it.join(&command.program).display().to_string())
        } else {
            command.program
        };
        Some(RunningHub { pid, uid, user, domain, base, program })
    }

    /// Returns the text that states who runs the hub, and the command that reaches the hub. The text is for a client of
    /// `caller` that searched for `domain`.
    pub fn describe(&self, verb: &str, domain: &str, caller: &Environment) -> String {
        let owner =
            if self.uid == caller.uid { "this user".to_owned() } else { format!("user {}", self.user) };
        let of_domain = match &self.domain {
            Some(own) if own == domain => String::new(),
            Some(own) => format!(" in domain {own}"),
            None => " in an unknown domain".to_owned(),
        };
        format!("{owner} runs one{of_domain}, process {}: {}", self.pid, self.command(verb, domain, caller))
    }

    /// Returns the command with which the user of `caller` runs `verb` in the domain of this hub. `domain` is the
    /// domain that the caller searched for. If the hub's domain is unknown, the command lists the domains of the hub's
    /// user.
    pub fn command(&self, verb: &str, domain: &str, caller: &Environment) -> String {
        // sudo resets the environment, so the command of another user runs with the defaults of that user.
        let (sudo, environment, domain) = if self.uid == caller.uid {
            (String::new(), caller.clone(), domain)
        } else {
            let sudo = if self.uid == 0 {
                "sudo ".to_owned()
            } else {
                format!("sudo -u {} ", shell_word(&self.user))
            };
            (sudo, Environment { uid: self.uid, ..Environment::default() }, DEFAULT_DOMAIN)
        };
        let program = shell_word(&self.program);
        let Some(own) = &self.domain else { return format!("{sudo}{program} list --domains") };
        let mut command = format!("{sudo}{program} {verb}");
        if own != domain {
            command += &format!(" --domain {own}");
        }
        if let Some(base) = self.base.as_ref().filter(|base| !environment.bases().contains(base)) {
            command += &format!(" --root {}", shell_word(&base.to_string_lossy()));
        }
        command
    }
}

/// Command line of a hub.
#[derive(Debug, Default, PartialEq, Eq)]
struct CommandLine {
    program: String,
    domain: Option<String>,
    root: Option<PathBuf>,
}

impl CommandLine {
    /// Parses `/proc/PID/cmdline`; `None` if it does not start a hub.
    fn parse(bytes: &[u8]) -> Option<CommandLine> {
        let text = bytes.strip_suffix(&[0]).unwrap_or(bytes);
        let mut words = text.split(|&byte| byte == 0).map(|word| String::from_utf8_lossy(word));
        let program = Path::new(&*words.next()?).to_owned();
        // A program in a directory that sudo searches needs no directory in the command.
        let is_usual = program.parent().is_some_and(|directory| {
            USUAL_DIRECTORIES.iter().any(|directory_name| directory == Path::new(directory_name))
        });
        let name = if is_usual { program.file_name()?.into() } else { program.into_os_string() };
        let mut command = CommandLine { program: name.into_string().ok()?, ..CommandLine::default() };
        let mut verb = None;
        while let Some(word) = words.next() {
            let (flag, mut value) = match word.split_once('=') {
                Some((flag, value)) => (flag, Some(value.to_owned())),
                None => (&*word, None),
            };
            if ["--domain", "--root"].contains(&flag) && value.is_none() {
                value = words.next().map(|value| value.into_owned());
            }
            match flag {
                "--domain" => command.domain = value,
                "--root" => command.root = value.map(PathBuf::from),
                _ if !word.starts_with('-') && verb.is_none() => verb = Some(word.into_owned()),
                _ => {}
            }
        }
        ["run", "replay"].contains(&verb?.as_str()).then_some(command)
    }
}

/// Returns `word` as one word of a shell. An empty word needs quotes, and so does a word with blanks or with brackets,
/// which zsh expands.
pub fn shell_word(word: &str) -> String {
    let is_plain = |c: char| c.is_ascii_alphanumeric() || "-_./:@+,=".contains(c);
    if !word.is_empty() && word.chars().all(is_plain) {
        return word.to_owned();
    }
    format!("'{}'", word.replace('\'', r"'\''"))
}

/// Directories in which sudo searches for programs (sudoers(5), `secure_path`).
const USUAL_DIRECTORIES: [&str; 6] =
    ["/usr/local/sbin", "/usr/local/bin", "/usr/sbin", "/usr/bin", "/sbin", "/bin"];

/// Checks that a domain's name is `[a-z0-9-]{1,16}`.
fn check_name(name: &str) -> Result<(), Failure> {
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

/// Returns the first path of a colon-separated list, if it is absolute. systemd may list several runtime directories.
pub(crate) fn first_path(value: OsString) -> Option<PathBuf> {
    let text = value.into_string().ok()?;
    let first = PathBuf::from(text.split(':').next()?);
    first.is_absolute().then_some(first)
}

#[cfg(test)]
mod tests {
    use tempfile::TempDir;

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
    fn hub_uses_the_first_location() {
        let all = environment(Some("/run/scanhub"), Some("/run/user/7"));
        let user = environment(None, Some("/run/user/7"));
        let none = environment(None, None);
        assert_eq!(root(Domain::of_hub("a", Some(Path::new("/b")), &all)), Path::new("/b/a"));
        assert_eq!(root(Domain::of_hub("a", None, &all)), Path::new("/run/scanhub/a"));
        assert_eq!(root(Domain::of_hub("a", None, &user)), Path::new("/run/user/7/scanhub/a"));
        assert_eq!(root(Domain::of_hub("a", None, &none)), Path::new("/tmp/scanhub-7/a"));
    }

    #[test]
    fn client_searches_all_locations_in_order() {
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
    fn invalid_domain_names_and_long_paths_are_refused() {
        assert_eq!(Domain::at("t-1", Path::new("/x")).unwrap().prefix(), "sh_t-1_");
        for bad in ["", "A", "a_b", "a/b", &"a".repeat(17)] {
            assert_eq!(
                Domain::at(bad, Path::new("/x")).map_err(|failure| failure.kind),
                Err(Kind::Configuration)
            );
        }
        // The root `/`, 52 letters and `/a`, and the prefix `sh_a_xxxxx_`, have 66 bytes.
        let base = format!("/{}", "b".repeat(52));
        assert_eq!(
            Domain::at("a", Path::new(&base)).map_err(|failure| failure.kind),
            Err(Kind::Configuration)
        );
        assert!(Domain::at("a", Path::new(&base[..52])).is_ok());
    }

    #[test]
    fn first_of_several_runtime_directories_is_used() {
        assert_eq!(first_path("/run/a:/run/b".into()), Some("/run/a".into()));
        assert_eq!(first_path("relative".into()), None);
    }

    const PASSWD: &str = "root:x:0:0:root:/root:/bin/sh\nscanhub:x:998:997::/:/usr/sbin/nologin\nalice:x:1000:1000::/home/alice:/bin/sh\n";

    /// A simulated machine: files below a temporary directory.
    struct Machine(TempDir);

    impl Machine {
        fn new() -> Machine {
            let root = TempDir::new().unwrap();
            fs::create_dir(root.path().join("etc")).unwrap();
            fs::write(root.path().join("etc/passwd"), PASSWD).unwrap();
            Machine(root)
        }

        /// Adds a process. If `environment` is `None`, the environment of the process cannot be read.
        fn process(&self, pid: u32, uid: u32, command: &[&str], environment: Option<&str>) {
            let path = self.0.path().join(format!("proc/{pid}"));
            fs::create_dir_all(&path).unwrap();
            let program = command.first().and_then(|program| program.rsplit('/').next()).unwrap_or("sh");
            fs::write(path.join("comm"), format!("{program}\n")).unwrap();
            fs::write(path.join("status"), format!("Name:\t{program}\nUid:\t{uid}\t{uid}\t{uid}\t{uid}\n"))
                .unwrap();
            let words: Vec<u8> = command.iter().flat_map(|word| [word.as_bytes(), &[0]].concat()).collect();
            fs::write(path.join("cmdline"), words).unwrap();
            if let Some(environment) = environment {
                fs::write(path.join("environ"), environment.replace(' ', "\0")).unwrap();
            }
        }
    }

    fn user(uid: u32) -> Environment {
        Environment {
            uid,
            xdg_runtime_dir: Some(format!("/run/user/{uid}").into()),
            ..Environment::default()
        }
    }

    #[test]
    fn finds_hubs_of_all_users() {
        let machine = Machine::new();
        machine.process(10, 0, &["sudo", "scanhub", "run"], None);
        machine.process(11, 0, &["scanhub", "run", "--link", "front=/dev/ttyUSB0"], None);
        machine.process(12, 998, &["/usr/local/bin/scanhub", "--json", "run"], None);
        machine.process(13, 1000, &["./scanhub", "--domain", "lab", "replay", "a.mcap"], None);
        machine.process(14, 1000, &["scanhub", "list"], None);
        machine.process(15, 1000, &["scanhub", "echo", "run"], None);
        machine.process(16, 0, &[], None);
        machine.process(17, 1000, &["scanhub", "run", "--domain", "x; id"], None);
        machine.process(18, 1000, &["scanhub", "run"], Some(""));
        machine.process(19, 1000, &["scanhub", "run"], Some("SCANHUB_DOMAIN=lab"));
        let hubs = RunningHub::all(machine.0.path());
        let found: Vec<_> =
            hubs.iter().map(|hub| (hub.pid, hub.user.as_str(), hub.domain.as_deref())).collect();
        assert_eq!(
            found,
            [
                (11, "root", None),
                (12, "scanhub", None),
                (13, "alice", Some("lab")),
                (18, "alice", Some("scanhub")),
                (19, "alice", Some("lab")),
            ]
        );
        assert_eq!(RunningHub::all(Path::new("/nowhere")), []);
    }

    #[test]
    fn names_the_command_that_reaches_a_hub() {
        let command = |uid, words: &[&str], environment: Option<&str>, caller: u32| {
            let machine = Machine::new();
            machine.process(7, uid, words, environment);
            let [hub] = &RunningHub::all(machine.0.path())[..] else { panic!("one hub") };
            hub.command("list", "scanhub", &user(caller))
        };
        let run = ["scanhub", "run"];
        // The hub's domain may be set in its environment, which other users cannot read.
        assert_eq!(command(0, &run, None, 1000), "sudo scanhub list --domains");
        let named = ["/usr/local/bin/scanhub", "run", "--domain", "scanhub"];
        assert_eq!(command(998, &named, None, 1000), "sudo -u scanhub scanhub list");
        assert_eq!(command(1000, &run, None, 1001), "sudo -u alice scanhub list --domains");
        assert_eq!(command(65_531, &run, Some("A=b"), 0), "sudo -u '#65531' scanhub list");
        // Root can read the location of the hub. sudo does not pass the variable on, but a client searches this
        // location even without the variable.
        let logged_in = Some("HOME=/home/alice XDG_RUNTIME_DIR=/run/user/1000");
        assert_eq!(command(1000, &run, logged_in, 0), "sudo -u alice scanhub list");
        let elsewhere = Some("XDG_RUNTIME_DIR=/run/user/1000 SCANHUB_DOMAIN=lab");
        assert_eq!(
            command(0, &run, elsewhere, 1000),
            "sudo scanhub list --domain lab --root /run/user/1000/scanhub"
        );
        let flags = ["/opt/scanhub", "run", "--root=/srv/a b", "--domain=lab"];
        assert_eq!(command(0, &flags, None, 1000), "sudo /opt/scanhub list --domain lab --root '/srv/a b'");
        // The working directory of the hub cannot be read, so the command has only the program's name.
        assert_eq!(command(0, &["./scanhub", "run"], None, 1000), "sudo scanhub list --domains");
        assert_eq!(
            command(1000, &["scanhub", "run", "--domain", "lab"], logged_in, 1000),
            "scanhub list --domain lab"
        );
    }
}
