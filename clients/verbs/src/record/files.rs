//! Files of a run: their names, the limits at which the next file starts, and the removal of old files.
//!
//! With `--force`, files of earlier runs count as kept files too. Each file is checked again just before it is removed.
//! A file that another recorder writes, or that is not a recording, is therefore never removed.

use std::fs::{self, File, TryLockError};
use std::io::{self, ErrorKind, Read};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::time::Duration;

use rustix::fs::{OFlags, major, minor};
use scanhub_files::output::Target;
use scanhub_schema::file::MAGIC;

use crate::duration;

/// Limit of a file, at which the recording continues in the next file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Split {
    /// Length in bytes.
    Bytes(u64),
    /// Duration.
    Time(Duration),
}

impl Split {
    /// Parses a duration such as `1h`, or a size such as `512MiB` or `2GB`. The error is a message for the user.
    pub(super) fn parse(text: &str) -> Result<Split, String> {
        let unit = text.find(|c: char| c.is_ascii_alphabetic()).unwrap_or(text.len());
        let (number, unit) = text.split_at(unit);
        let Some((_, factor)) = UNITS.iter().find(|(name, _)| *name == unit) else {
            let time = duration::parse(text).map_err(|_| {
                format!("{text:?} is neither a size nor a duration: write it like 512MiB, 2GB, 10m or 1h")
            })?;
            return match time >= MIN_SPLIT_TIME {
                true => Ok(Split::Time(time)),
                false => Err(format!("{text:?} is too short: a file takes at least {MIN_SPLIT_TIME:?}")),
            };
        };
        let digits = number.chars().all(|c| c.is_ascii_digit() || c == '.');
        let number: Option<f64> = number.parse().ok().filter(|_| digits);
        let size = number.ok_or_else(|| format!("{text:?} is not a size: write it like 512MiB or 2GB"))?;
        let size = (size * *factor as f64) as u64;
        match (MIN_SPLIT_BYTES..=MAX_SPLIT_BYTES).contains(&size) {
            true => Ok(Split::Bytes(size)),
            false => Err(format!("{text:?}: a file takes 128KiB to 1024TiB")),
        }
    }
}

const UNITS: [(&str, u64); 8] = [
    ("B", 1),
    ("kB", 1000),
    ("KiB", 1 << 10),
    ("MB", 1_000_000),
    ("MiB", 1 << 20),
    ("GB", 1_000_000_000),
    ("GiB", 1 << 30),
    ("TiB", 1 << 40),
];
/// Minimum value of `--split` in bytes. The descriptions of the topics may take half of a file with this size.
const MIN_SPLIT_BYTES: u64 = 128 << 10;
const MAX_SPLIT_BYTES: u64 = 1 << 50;
const MIN_SPLIT_TIME: Duration = Duration::from_secs(1);

/// Files of a run: the rule for their names, and the files that the run has created.
pub(super) struct Files {
    path: PathBuf,
    is_split: bool,
    overwrites: bool,
    keep: Option<usize>,
    /// Number in the name of the last file.
    number: u32,
    /// Number of files of this run.
    count: u32,
    /// Text near the start of each file of this run, and of no other file.
    run: String,
    /// Paths of the files of this run, the current one last.
    created: Vec<PathBuf>,
    /// Paths of the files of earlier runs that count as kept files, the lowest number first.
    older: Vec<PathBuf>,
}

impl Files {
    /// Describes the files of a run, without creating any. Without `is_split`, the run has one file, `path`. With
    /// `is_split`, the run has several files, with numbers after the stem of `path`. An existing file is an error,
    /// unless `overwrites` is set. With `overwrites`, a split run continues after the existing numbers. The last `keep`
    /// files are kept. All files of the run must contain `run` within their first [`HEAD_LEN`] bytes.
    pub(super) fn new(
        path: &Path,
        is_split: bool,
        overwrites: bool,
        keep: Option<usize>,
        run: &str,
    ) -> Files {
        let (path, run, created, older) = (path.to_owned(), run.to_owned(), Vec::new(), Vec::new());
        Files { path, is_split, overwrites, keep, number: 0, count: 0, run, created, older }
    }

    /// Creates the first file, and returns its path.
    ///
    /// # Errors
    ///
    /// [`ErrorKind::AlreadyExists`] if a file exists, [`ErrorKind::ResourceBusy`] if another run writes it.
    pub(super) fn first(&mut self) -> io::Result<(PathBuf, File)> {
        let existing = if self.is_split { self.existing() } else { Vec::new() };
        let last = existing.last().copied().unwrap_or(0);
        if last > 0 && !self.overwrites {
            let name = self.name(last);
            let what = format!("files of an earlier run exist, the last one is {}", name.display());
            return Err(io::Error::new(ErrorKind::AlreadyExists, what));
        }
        if self.keep.is_some() {
            let paths = existing.iter().map(|number| self.name(*number));
            self.older = paths.filter(|path| lock_finished(path).is_some()).collect();
        }
        self.make(last + 1, self.overwrites && !self.is_split)
    }

    /// Creates the next file, and returns its path. Skips names that another run has taken.
    pub(super) fn next(&mut self) -> io::Result<(PathBuf, File)> {
        let mut number = self.number + 1;
        loop {
            match self.make(number, false) {
                Err(error) if NAME_TAKEN_ERRORS.contains(&error.kind()) => number += 1,
                made => return made,
            }
        }
    }

    /// Returns the number of files of earlier runs that the next [`prune`](Self::prune) removes.
    pub(super) fn surplus_older(&self) -> usize {
        self.surplus().min(self.older.len())
    }

    /// Removes the oldest files, first the files of earlier runs, until at most `keep` files remain. A file that cannot
    /// be removed no longer counts as kept.
    pub(super) fn prune(&mut self) {
        for _ in 0..self.surplus() {
            // Another file may have this name by now.
            let (path, removable) = if self.older.is_empty() {
                let path = self.created.remove(0);
                let own = lock_of_run(&path, &self.run);
                (path, own)
            } else {
                let path = self.older.remove(0);
                let finished = lock_finished(&path);
                (path, finished)
            };
            // Keep the file locked until its name has been removed.
            if removable.as_ref().is_some_and(|file| is_at(file, &path)) {
                let _ = fs::remove_file(path);
            }
        }
    }

    /// Returns the number of files that exceed `keep`. The current file is always kept.
    fn surplus(&self) -> usize {
        let keep = self.keep.map_or(usize::MAX, |keep| keep.max(1));
        (self.older.len() + self.created.len()).saturating_sub(keep)
    }

    /// Returns the number of files of this run.
    pub(super) fn count(&self) -> u32 {
        self.count
    }

    fn make(&mut self, number: u32, overwrites: bool) -> io::Result<(PathBuf, File)> {
        let path = self.name(number);
        let file = open(&path, overwrites)?;
        (self.number, self.count) = (number, self.count + 1);
        self.created.push(path.clone());
        Ok((path, file))
    }

    fn name(&self, number: u32) -> PathBuf {
        if number == 1 && !self.is_split {
            return self.path.clone();
        }
        let (stem, ending) = self.name_parts();
        self.path.with_file_name(format!("{stem}-{number:04}{ending}"))
    }

    /// Returns the parts of a name before and after the number.
    fn name_parts(&self) -> (String, String) {
        let stem = self.path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let ending = self.path.extension().map(|ending| format!(".{}", ending.to_string_lossy()));
        (stem, ending.unwrap_or_default())
    }

    /// Returns the numbers of the existing files with a name of this run, in ascending order.
    fn existing(&self) -> Vec<u32> {
        let (stem, ending) = self.name_parts();
        let directory = self.path.parent().filter(|directory| !directory.as_os_str().is_empty());
        let Ok(entries) = fs::read_dir(directory.unwrap_or(Path::new("."))) else { return Vec::new() };
        let names = entries.flatten().map(|entry| entry.file_name());
        let number = |name: &str| {
            let digits = name.strip_prefix(&stem)?.strip_prefix('-')?.strip_suffix(&ending)?;
            // A longer number is a date.
            let number = digits.parse().ok().filter(|number| *number < 1_000_000)?;
            (format!("{number:04}") == digits).then_some(number)
        };
        let mut numbers: Vec<u32> = names.filter_map(|name| number(name.to_str()?)).collect();
        numbers.sort_unstable();
        numbers
    }
}

/// Opens and locks the file at `path` if it is a recording that no recorder writes. No recorder can lock the file until
/// the returned file is closed. Returns `None` if the file system has no locks, because recorders then cannot be
/// detected.
fn lock_finished(path: &Path) -> Option<File> {
    let (file, head, is_taken) = head(path).ok()?;
    (head.starts_with(MAGIC) && is_taken == Some(false)).then_some(file)
}

/// Opens and locks the file at `path` if `run` has created it and no other recorder writes it. No recorder can lock the
/// file until the returned file is closed.
fn lock_of_run(path: &Path, run: &str) -> Option<File> {
    let (file, head, is_taken) = head(path).ok()?;
    (String::from_utf8_lossy(&head).contains(run) && is_taken != Some(true)).then_some(file)
}

/// Opens the regular file at `path`. Returns the file, its first [`HEAD_LEN`] bytes, and whether another process has
/// locked it (`None` if the file system has no locks). If no other process has locked the file, this process holds the
/// lock until it closes the file.
///
/// # Errors
///
/// Returns an error if the file cannot be read, or is not a regular file. A link to a regular file is also an error.
fn head(path: &Path) -> io::Result<(File, Vec<u8>, Option<bool>)> {
    // Without NONBLOCK, opening a pipe would wait for its writer.
    let flags = OFlags::NOFOLLOW | OFlags::NONBLOCK;
    let file = File::options().read(true).custom_flags(flags.bits().cast_signed()).open(path)?;
    if !file.metadata()?.is_file() {
        return Err(ErrorKind::InvalidInput.into());
    }
    // Lock before reading. Otherwise, another recorder could start to write between the two steps.
    let is_taken = is_taken(&file);
    let mut head = Vec::new();
    (&file).take(HEAD_LEN).read_to_end(&mut head)?;
    Ok((file, head, is_taken))
}

/// Opens and locks the file at `path`, and empties it. Fails if another run writes it.
fn open(path: &Path, overwrites: bool) -> io::Result<File> {
    let target = Target::open(path).map_err(|failure| io::Error::other(failure.message))?;
    let mut file = target.create(overwrites)?;
    take_lock(&file)?;
    // Another run may remove the file as an old file between the open and the lock.
    for _ in 0..MAX_ATTEMPTS {
        if is_at(&file, path) {
            break;
        }
        file = target.create(overwrites)?;
        take_lock(&file)?;
    }
    file.set_len(0)?;
    Ok(file)
}

/// Returns whether `file` is the file that `path` names.
fn is_at(file: &File, path: &Path) -> bool {
    let id = |metadata: fs::Metadata| (metadata.dev(), metadata.ino());
    let named = path.symlink_metadata().map(id);
    file.metadata().map(id).is_ok_and(|own| named.is_ok_and(|named| named == own))
}

/// Maximum number of attempts to open a file that other runs remove at the same time. The number is limited, because
/// some file systems never report the same inode twice, so that every attempt seems to fail.
const MAX_ATTEMPTS: usize = 3;

/// Locks `file` until it is closed, because two writers would overwrite each other. Succeeds without a lock if the file
/// system has none.
///
/// # Errors
///
/// [`ErrorKind::ResourceBusy`] if another process holds the lock.
fn take_lock(file: &File) -> io::Result<()> {
    match file.try_lock() {
        Err(TryLockError::WouldBlock) => {
            let process = holder(file).map_or(String::new(), |pid| format!(" (process {pid})"));
            Err(io::Error::new(ErrorKind::ResourceBusy, format!("another recorder writes it{process}")))
        }
        Ok(()) | Err(TryLockError::Error(_)) => Ok(()),
    }
}

/// Returns whether a process has locked `file`, or `None` if the file system has no locks.
fn is_taken(file: &File) -> Option<bool> {
    // A shared lock needs no permission to write. It is released when `file` is closed.
    match file.try_lock_shared() {
        Ok(()) => Some(false),
        Err(TryLockError::WouldBlock) => Some(true),
        Err(TryLockError::Error(_)) => None,
    }
}

/// Returns the ID of the process that has locked `file`, if the kernel reports it.
fn holder(file: &File) -> Option<u32> {
    let metadata = file.metadata().ok()?;
    let id = format!("{:02x}:{:02x}:{}", major(metadata.dev()), minor(metadata.dev()), metadata.ino());
    let locks = fs::read_to_string("/proc/locks").ok()?;
    let words = locks.lines().map(|line| line.split_whitespace().collect::<Vec<_>>());
    let words = words.into_iter().find(|words| words.get(FILE_WORD) == Some(&id.as_str()))?;
    words[PROCESS_WORD].parse().ok().filter(|pid| *pid > 0)
}

/// Indexes of words in a line of /proc/locks: `1: FLOCK ADVISORY WRITE 4711 08:01:131 0 EOF`.
const PROCESS_WORD: usize = 4;
const FILE_WORD: usize = 5;

/// Number of bytes at the start of a recording that contain the description of the run, which is its first record.
const HEAD_LEN: u64 = 4096;
/// Kinds of errors that are returned if another run has taken a name.
const NAME_TAKEN_ERRORS: [ErrorKind; 2] = [ErrorKind::AlreadyExists, ErrorKind::ResourceBusy];

/// Removes the file that was created at `path`, unless it is a device or a link.
pub(super) fn discard(path: &Path) {
    if fs::symlink_metadata(path).is_ok_and(|metadata| metadata.is_file()) {
        let _ = fs::remove_file(path);
    }
}

/// Returns the default name of a recording that starts at `wall_ns`.
pub(super) fn default_name(wall_ns: u64) -> PathBuf {
    let [year, month, day, hour, minute, second] = utc(wall_ns);
    format!("scanhub-{year:04}{month:02}{day:02}-{hour:02}{minute:02}{second:02}.mcap").into()
}

/// Formats `wall_ns` as in ISO 8601, to the second.
pub(super) fn iso(wall_ns: u64) -> String {
    let [year, month, day, hour, minute, second] = utc(wall_ns);
    format!("{year:04}-{month:02}-{day:02}T{hour:02}:{minute:02}:{second:02}Z")
}

/// Returns year, month, day, hour, minute and second of a time in ns since 1970, in the Gregorian calendar.
fn utc(wall_ns: u64) -> [u64; 6] {
    let seconds = wall_ns / 1_000_000_000;
    let (mut day, time) = (seconds / SECONDS_PER_DAY, seconds % SECONDS_PER_DAY);
    let is_leap =
        |year: u64| year.is_multiple_of(4) && (!year.is_multiple_of(100) || year.is_multiple_of(400));
    let mut year = 1970;
    while day >= 365 + u64::from(is_leap(year)) {
        day -= 365 + u64::from(is_leap(year));
        year += 1;
    }
    let february = 28 + u64::from(is_leap(year));
    let mut month = 1;
    for length in [31, february, 31, 30, 31, 30, 31, 31, 30, 31, 30] {
        if day < length {
            break;
        }
        day -= length;
        month += 1;
    }
    [year, month, day + 1, time / 3600, time / 60 % 60, time % 60]
}

const SECONDS_PER_DAY: u64 = 86_400;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parses_split_sizes_and_times() {
        assert_eq!(Split::parse("512MiB"), Ok(Split::Bytes(512 << 20)));
        assert_eq!(Split::parse("1.5GB"), Ok(Split::Bytes(1_500_000_000)));
        assert_eq!(Split::parse("1h"), Ok(Split::Time(Duration::from_secs(3600))));
        assert_eq!(Split::parse("10m"), Ok(Split::Time(Duration::from_secs(600))));
        for bad in
            ["", "512", "512 MiB", "-1MiB", "1MiB2", "63KiB", "0.5s", "MiB", "1.2.3GB", "9999999TiB", "1mb"]
        {
            assert!(Split::parse(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn formats_dates_and_default_file_name() {
        let at = |seconds: u64| iso(seconds * 1_000_000_000);
        assert_eq!(at(0), "1970-01-01T00:00:00Z");
        assert_eq!(at(951_782_400), "2000-02-29T00:00:00Z");
        assert_eq!(at(1_709_251_199), "2024-02-29T23:59:59Z");
        assert_eq!(at(1_798_761_599), "2026-12-31T23:59:59Z");
        assert_eq!(at(4_107_542_400), "2100-03-01T00:00:00Z");
        assert_eq!(default_name(1_700_000_000_000_000_000), Path::new("scanhub-20231114-221320.mcap"));
    }

    /// Returns the start of a file that `run` created.
    fn recording(run: &str) -> Vec<u8> {
        [MAGIC, run.as_bytes()].concat()
    }

    #[test]
    fn keeps_the_newest_files_of_all_runs_when_forced() {
        let directory = tempfile::tempdir().unwrap();
        let place = directory.path();
        let at = |name: &str| place.join(name);
        let names = || {
            let mut names: Vec<_> = fs::read_dir(place).unwrap().map(|it| it.unwrap().file_name()).collect();
            names.sort();
            names.into_iter().map(|name| name.into_string().unwrap()).collect::<Vec<_>>()
        };
        for number in [2, 3, 9, 10, 11] {
            fs::write(at(&format!("walk-{number:04}.mcap")), recording("run 1")).unwrap();
        }
        // None of the following files is a finished recording of an earlier run.
        fs::write(at("target.mcap"), recording("run 1")).unwrap();
        std::os::unix::fs::symlink(at("target.mcap"), at("walk-0001.mcap")).unwrap();
        fs::write(at("walk-0004.mcap"), "my notes").unwrap();
        fs::write(at("walk-0005.mcap"), "").unwrap();
        fs::create_dir(at("walk-0006.mcap")).unwrap();
        let written = File::create(at("walk-0007.mcap")).unwrap();
        fs::write(at("walk-0007.mcap"), recording("run 0")).unwrap();
        take_lock(&written).unwrap();
        for other in ["walk-fast-0001.mcap", "walk-20261122.mcap", "walk.mcap", "walk-0001.bag"] {
            fs::write(at(other), recording("run 1")).unwrap();
        }
        let others = [
            "target.mcap",
            "walk-0001.bag",
            "walk-0001.mcap",
            "walk-0004.mcap",
            "walk-0005.mcap",
            "walk-0006.mcap",
            "walk-0007.mcap",
            "walk-20261122.mcap",
            "walk-fast-0001.mcap",
            "walk.mcap",
        ];
        let kept = || names().into_iter().filter(|name| !others.contains(&&name[..])).collect::<Vec<_>>();

        let refused = Files::new(&at("walk.mcap"), true, false, Some(3), "run 2").first().unwrap_err();
        assert_eq!((refused.kind(), kept().len()), (ErrorKind::AlreadyExists, 5));

        let mut files = Files::new(&at("walk.mcap"), true, true, Some(3), "run 2");
        let make = |files: &mut Files, is_first: bool| {
            let (path, mut file) = if is_first { files.first() } else { files.next() }.unwrap();
            io::Write::write_all(&mut file, &recording("run 2")).unwrap();
            path
        };
        assert_eq!(make(&mut files, true), at("walk-0012.mcap"));
        assert_eq!((files.surplus_older(), kept().len()), (3, 6), "nothing is removed yet");
        files.prune();
        assert_eq!(kept(), ["walk-0010.mcap", "walk-0011.mcap", "walk-0012.mcap"]);
        assert_eq!(files.surplus_older(), 0);
        for _ in 13..17 {
            make(&mut files, false);
            files.prune();
        }
        assert_eq!(kept(), ["walk-0014.mcap", "walk-0015.mcap", "walk-0016.mcap"]);
        assert!(others.iter().all(|name| names().iter().any(|there| there == name)), "{:?}", names());
        drop(written);
    }

    #[test]
    fn does_not_remove_a_file_while_it_is_recorded() {
        let directory = tempfile::tempdir().unwrap();
        let place = directory.path();
        let path = place.join("walk-0001.mcap");
        fs::write(&path, recording("run 1")).unwrap();
        let mut files = Files::new(&place.join("walk.mcap"), true, true, Some(1), "run 2");
        files.first().unwrap();
        assert_eq!(files.surplus_older(), 1);
        let other = File::open(&path).unwrap();
        take_lock(&other).unwrap();
        files.prune();
        assert!(path.exists());
    }

    #[test]
    fn file_being_removed_cannot_be_opened() {
        let directory = tempfile::tempdir().unwrap();
        let place = directory.path();
        let path = place.join("walk-0001.mcap");
        fs::write(&path, recording("run 1")).unwrap();
        let busy = |path: &Path| open(path, true).map(drop).map_err(|error| error.kind());
        for lock in [lock_finished(&path), lock_of_run(&path, "run 1")] {
            assert!(lock.is_some());
            assert_eq!(busy(&path), Err(ErrorKind::ResourceBusy));
        }
        assert_eq!(fs::read(&path).unwrap(), recording("run 1"), "it was not emptied");
        assert_eq!(busy(&path), Ok(()));
    }

    #[test]
    fn does_not_remove_files_of_other_runs() {
        let directory = tempfile::tempdir().unwrap();
        let place = directory.path();
        let at = |name: &str| place.join(name);
        let mut files = Files::new(&at("walk.mcap"), true, false, Some(2), "run 1");
        assert_eq!(files.first().unwrap().0, at("walk-0001.mcap"));
        fs::write(at("walk-0001.mcap"), "of run 1").unwrap();
        fs::write(at("walk-0002.mcap"), "another's").unwrap();
        assert_eq!(files.next().unwrap().0, at("walk-0003.mcap"));
        assert_eq!(files.next().unwrap().0, at("walk-0004.mcap"));
        assert_eq!((files.count(), files.surplus_older()), (3, 0));
        files.prune();
        assert!(!at("walk-0001.mcap").exists() && at("walk-0003.mcap").exists());
        // Another run has created a file under a name of this run.
        fs::write(at("walk-0003.mcap"), recording("run 2")).unwrap();
        assert_eq!(files.next().unwrap().0, at("walk-0005.mcap"));
        files.prune();
        assert_eq!(fs::read(at("walk-0003.mcap")).unwrap(), recording("run 2"));
        let failure = Files::new(&at("walk-0002.mcap"), false, false, None, "").first().unwrap_err();
        assert_eq!(failure.kind(), ErrorKind::AlreadyExists);
        // These names do not belong to the files of this run.
        for other in
            ["walk-20261122.mcap", "walk-00009.mcap", "walk-7.mcap", "walk-0009.bag", "walks-0009.mcap"]
        {
            fs::write(at(other), "another's").unwrap();
        }
        let earlier = Files::new(&at("walk.mcap"), true, false, None, "").first().unwrap_err();
        assert!(earlier.kind() == ErrorKind::AlreadyExists && earlier.to_string().contains("walk-0005.mcap"));
        let mut behind = Files::new(&at("walk.mcap"), true, true, None, "");
        assert_eq!((behind.first().unwrap().0, behind.count()), (at("walk-0006.mcap"), 1));
        assert_eq!(fs::read(at("walk-0002.mcap")).unwrap(), b"another's");
        let mut one = Files::new(&at("one"), false, true, None, "");
        assert_eq!((one.first().unwrap().0, one.next().unwrap().0), (at("one"), at("one-0002")));
    }

    #[test]
    fn second_writer_of_a_file_is_refused() {
        let directory = tempfile::tempdir().unwrap();
        let place = directory.path();
        let path = place.join("walk.mcap");
        let (_, mut file) = Files::new(&path, false, false, None, "").first().unwrap();
        io::Write::write_all(&mut file, b"mine").unwrap();
        let busy = Files::new(&path, false, true, None, "").first().unwrap_err();
        assert_eq!((busy.kind(), fs::read(&path).unwrap()), (ErrorKind::ResourceBusy, b"mine".to_vec()));
        drop(file);
        assert!(Files::new(&path, false, true, None, "").first().is_ok());
        assert_eq!(fs::read(&path).unwrap(), b"");
    }
}
