//! Identity of a gateway: a random number that the gateway keeps from one run to the next, and an epoch that is greater
//! than those of earlier runs. Two gateways of one hub have different numbers.

use std::fs::{File, Permissions};
use std::hash::{BuildHasher, RandomState};
use std::io;
use std::os::unix::fs::{FileExt, PermissionsExt};
use std::path::{Path, PathBuf};

use scanhub_client::clock;
use scanhub_files::regular_file;
use scanhub_schema::{Failure, Kind};
use scanhub_shm::{Directory, StateDirectory};

/// Identity of a gateway in one run. While this value exists, no other process on this machine can get the same number.
#[derive(Debug)]
pub struct GatewayIdentity {
    /// Number of the gateway.
    pub hub: u64,
    /// Seconds since 1970 at the start of the run, or the epoch of the previous run plus one, if that is greater.
    pub epoch: u32,
    /// Whether the gateway has a new number, because the saved one belongs to another machine, whose disk was copied.
    pub is_renumbered: bool,
    /// File with the number, which stays locked.
    _file: File,
}

impl GatewayIdentity {
    /// Begins a run of a gateway of `domain` on `interface`, which may also be another word for the gateway's
    /// destination. Each number is saved in a file in `directory`, which is created if it does not exist. If the
    /// gateway of one file is already running, the next file is tried. `now_s` is the time in seconds since 1970.
    /// `machine` identifies this machine, if known. A number that was saved on another machine is not used.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Output`] if the file cannot be written, because listeners could then not distinguish this run
    /// from the previous one. Returns [`Kind::Configuration`] if too many gateways are running.
    fn begin(
        directory: &Path,
        domain: &str,
        interface: &str,
        now_s: u64,
        machine: Option<u64>,
    ) -> Result<GatewayIdentity, Failure> {
        let unkept = |failure: Failure| {
            let message = format!("cannot save the gateway's number: {}", failure.message);
            Failure { kind: Kind::Output, message, ..failure }
        };
        let state_directory = Directory::create_state(directory, 1).map_err(unkept)?;
        for number in 1..=MAX_GATEWAYS {
            let name = format!("gateway-{domain}-{interface}-{number}");
            let file = state_directory.open_or_create(&name).map_err(unkept)?;
            let unusable = |error: io::Error| {
                let what = format!("{}: {error}", directory.join(&name).display());
                unkept(Failure::new(Kind::Output, what, "the file system must have locks and free space"))
            };
            match file.try_lock() {
                Ok(()) => return GatewayIdentity::of(file, now_s, machine).map_err(unusable),
                Err(std::fs::TryLockError::WouldBlock) => {}
                Err(std::fs::TryLockError::Error(error)) => return Err(unusable(error)),
            }
        }
        let what = format!("{MAX_GATEWAYS} gateways of domain {domain} are on {interface} already");
        Err(Failure::new(Kind::Configuration, what, "stop some of them"))
    }

    /// Begins a run with the number in `file`, or with a new number if the file contains none for this machine.
    fn of(file: File, now_s: u64, machine: Option<u64>) -> io::Result<GatewayIdentity> {
        let now = u32::try_from(now_s).unwrap_or(u32::MAX);
        let stored = StoredIdentity::read(&file);
        let is_copy = |stored: &StoredIdentity| {
            stored.machine.is_some_and(|there| machine.is_some_and(|here| here != there))
        };
        let is_renumbered = stored.as_ref().is_some_and(is_copy);
        // If the line is not valid, or its epoch is already the highest one, the gateway gets a new number.
        let last = stored.filter(|stored| !is_copy(stored)).and_then(|kept| {
            let epoch = kept.epoch.checked_add(1)?.max(now);
            Some(StoredIdentity { epoch, machine: machine.or(kept.machine), ..kept })
        });
        let stored = last.unwrap_or_else(|| StoredIdentity {
            hub: RandomState::new().hash_one(now_s),
            epoch: now,
            machine,
        });
        let line = stored.line();
        // Earlier versions created the file so that other users could read it.
        file.set_permissions(Permissions::from_mode(0o600))?;
        file.write_all_at(line.as_bytes(), 0)?;
        file.set_len(line.len() as u64)?;
        file.sync_data()?;
        Ok(GatewayIdentity { hub: stored.hub, epoch: stored.epoch, is_renumbered, _file: file })
    }
}

/// Content of the file: the number in 16 hex digits, the epoch in 10 decimal digits, and the machine in 16 hex digits
/// if it is known.
struct StoredIdentity {
    hub: u64,
    epoch: u32,
    machine: Option<u64>,
}

impl StoredIdentity {
    /// Reads the file. `None` if its content is not valid.
    fn read(file: &File) -> Option<StoredIdentity> {
        let mut bytes = [0; 64];
        let len = file.read_at(&mut bytes, 0).ok()?;
        let mut words = str::from_utf8(&bytes[..len]).ok()?.strip_suffix('\n')?.split(' ');
        let mut word = |digits: usize| words.next().filter(|word| word.len() == digits);
        let hex = |word: &str| u64::from_str_radix(word, 16).ok();
        let (hub, epoch) = (hex(word(16)?)?, word(10)?.parse().ok()?);
        Some(StoredIdentity { hub, epoch, machine: word(16).and_then(hex) })
    }

    fn line(&self) -> String {
        let StoredIdentity { hub, epoch, machine } = self;
        let machine = machine.map(|machine| format!(" {machine:016x}")).unwrap_or_default();
        format!("{hub:016x} {epoch:010}{machine}\n")
    }
}

/// Returns the directory for the files with numbers. It also contains the state directories of domains.
///
/// # Errors
///
/// Returns [`Kind::Configuration`] if none of STATE_DIRECTORY, XDG_STATE_HOME and HOME is set.
fn directory() -> Result<PathBuf, Failure> {
    StateDirectory::base().ok_or_else(|| {
        let what = "no directory for the gateway's number: neither XDG_STATE_HOME nor HOME is set";
        Failure::new(Kind::Configuration, what, "set XDG_STATE_HOME to a directory that can be written")
    })
}

/// Maximum number of gateways of one domain on one interface. A greater number is treated as a mistake of the user.
const MAX_GATEWAYS: u32 = 16;

/// Begins a run of a gateway of `domain` on this machine, now. `destination` is the gateway's interface, or another
/// word for where it sends.
///
/// # Errors
///
/// Returns the same errors as `GatewayIdentity::begin`, and [`Kind::Configuration`] if the environment names no
/// directory for its number.
pub fn begin_run(domain: &str, destination: &str) -> Result<GatewayIdentity, Failure> {
    let now_s = clock::wall_ns() / 1_000_000_000;
    GatewayIdentity::begin(&directory()?, domain, destination, now_s, machine(Path::new(MACHINE_ID)))
}

/// Returns a number that identifies this machine. It is a hash of the machine's ID, because the ID itself is
/// confidential (machine-id(5)). `None` if the file at `path` is missing or contains no valid ID.
fn machine(path: &Path) -> Option<u64> {
    let text = regular_file::read_text(path, regular_file::MAX_FILE_BYTES).ok()?;
    let id = text.trim_end();
    let is_id = id.len() == 32 && id.bytes().all(|byte| byte.is_ascii_hexdigit());
    is_id.then(|| hash(id))
}

/// File with the ID of this machine.
const MACHINE_ID: &str = "/etc/machine-id";

/// Returns the FNV-1a hash of a machine's ID. The algorithm is fixed, because hashes that other builds have saved are
/// compared with this one.
fn hash(id: &str) -> u64 {
    let bytes = "scanhub gateway ".bytes().chain(id.bytes());
    bytes.fold(0xcbf2_9ce4_8422_2325, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(0x100_0000_01b3))
}

#[cfg(test)]
mod tests {
    use tempfile::TempDir;

    use super::*;

    struct TestDirectory(TempDir);

    impl TestDirectory {
        fn new() -> TestDirectory {
            TestDirectory(TempDir::new().unwrap())
        }

        fn begin(&self, interface: &str, now_s: u64) -> GatewayIdentity {
            self.begin_on(interface, now_s, None)
        }

        fn begin_on(&self, interface: &str, now_s: u64, machine: Option<u64>) -> GatewayIdentity {
            GatewayIdentity::begin(self.0.path(), "d", interface, now_s, machine).unwrap()
        }
    }

    #[test]
    fn each_run_has_a_higher_epoch() {
        let directory = TestDirectory::new();
        let (hub, epoch) = {
            let identity = directory.begin("eth0", 1000);
            (identity.hub, identity.epoch)
        };
        assert_eq!(epoch, 1000);
        for (now_s, epoch) in [(1000, 1001), (5, 1002), (2000, 2000), (0, 2001)] {
            let identity = directory.begin("eth0", now_s);
            assert_eq!((identity.hub, identity.epoch), (hub, epoch));
        }
    }

    #[test]
    fn concurrent_gateways_have_different_numbers() {
        let directory = TestDirectory::new();
        let first = directory.begin("eth0", 1);
        let (second, elsewhere) = (directory.begin("eth0", 1), directory.begin("wlan0", 1));
        assert!(first.hub != second.hub && first.hub != elsewhere.hub && second.hub != elsewhere.hub);
        let (first_hub, second_hub) = (first.hub, second.hub);
        drop((first, second));
        let (first, second) = (directory.begin("eth0", 1), directory.begin("eth0", 1));
        assert_eq!((first.hub, second.hub), (first_hub, second_hub));
    }

    #[test]
    fn copy_on_another_machine_gets_a_new_number() {
        let directory = TestDirectory::new();
        let of = |identity: GatewayIdentity| (identity.hub, identity.epoch, identity.is_renumbered);
        // The number was stored without a machine, by an earlier version or on a machine without an ID.
        let (hub, ..) = of(directory.begin("eth0", 7));
        assert_eq!(of(directory.begin_on("eth0", 7, Some(0xa))), (hub, 8, false));
        assert_eq!(of(directory.begin("eth0", 7)), (hub, 9, false));
        assert_eq!(of(directory.begin_on("eth0", 7, Some(0xa))), (hub, 10, false));
        let (copy, epoch, is_renumbered) = of(directory.begin_on("eth0", 7, Some(0xb)));
        assert!(copy != hub && epoch == 7 && is_renumbered);
        assert_eq!(of(directory.begin_on("eth0", 7, Some(0xb))), (copy, 8, false), "reported once");
    }

    #[test]
    fn replaces_invalid_number() {
        let directory = TestDirectory::new();
        let hub = directory.begin("eth0", 7).hub;
        let path = directory.0.path().join("gateway-d-eth0-1");
        for torn in ["", "0123", "0123456789abcdef 4294967295\n", "0123456789abcdef 12\n", &"x".repeat(60)] {
            std::fs::write(&path, torn).unwrap();
            let identity = directory.begin("eth0", 8);
            assert!(identity.hub != hub && identity.epoch == 8, "{torn}");
            assert_eq!(std::fs::metadata(&path).unwrap().len(), 28);
        }
    }

    #[test]
    fn refuses_unwritable_directory() {
        let refused = GatewayIdentity::begin(Path::new("/dev/null/x"), "d", "eth0", 1, None).unwrap_err();
        assert_eq!(refused.kind, Kind::Output);
        assert!(refused.message.contains("number: /dev/null: "), "{refused}");
    }

    #[test]
    fn machine_hash_is_stable() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("machine-id");
        let of = |text: &str| {
            std::fs::write(&path, text).unwrap();
            machine(&path)
        };
        let id = "0123456789abcdef0123456789abcdef";
        assert_eq!(
            (of(id), of(&format!("{id}\n"))),
            (Some(0x8f5c_2224_2b82_b25b), Some(0x8f5c_2224_2b82_b25b))
        );
        assert_ne!(of("0123456789abcdef0123456789abcdee\n"), of(id));
        assert!(
            ["", "uninitialized\n", "x123456789abcdef0123456789abcdef\n"].iter().all(|no| of(no).is_none())
        );
        std::fs::remove_file(&path).unwrap();
        assert_eq!(machine(&path), None);
    }
}
