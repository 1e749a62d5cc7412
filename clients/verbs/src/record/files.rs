//! The files of a run: their names, when the next one starts, and which of them are kept. Refuses to know what is in
//! them.

use std::fs::{self, File};
use std::io::{self, ErrorKind};
use std::path::{Path, PathBuf};
use std::time::Duration;

use super::lock;
use crate::duration;

/// When a recording goes on in the next file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Split {
    /// When a file is so long, in bytes.
    Bytes(u64),
    /// After this time.
    Time(Duration),
}

impl Split {
    /// What `text` says: a duration as `1h`, or a size as `512MiB` or `2GB`.
    ///
    /// The error says what would be right.
    pub fn parse(text: &str) -> Result<Split, String> {
        let unit = text.find(|c: char| c.is_ascii_alphabetic()).unwrap_or(text.len());
        let (number, unit) = text.split_at(unit);
        let Some((_, factor)) = UNITS.iter().find(|(name, _)| *name == unit) else {
            let time = duration::parse(text).map_err(|_| {
                format!("{text:?} is neither a size nor a duration: write it like 512MiB, 2GB, 10m or 1h")
            })?;
            return match time >= SHORTEST {
                true => Ok(Split::Time(time)),
                false => Err(format!("{text:?} is too short: a file takes at least {SHORTEST:?}")),
            };
        };
        let digits = number.chars().all(|c| c.is_ascii_digit() || c == '.');
        let number: Option<f64> = number.parse().ok().filter(|_| digits);
        let size = number.ok_or_else(|| format!("{text:?} is no size: write it like 512MiB or 2GB"))?;
        let size = (size * *factor as f64) as u64;
        match (SMALLEST..=LARGEST).contains(&size) {
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
/// Half of it is what every file says of its topics.
const SMALLEST: u64 = 128 << 10;
const LARGEST: u64 = 1 << 50;
const SHORTEST: Duration = Duration::from_secs(1);

/// The files that a run has made so far.
pub(super) struct Files {
    path: PathBuf,
    is_split: bool,
    overwrites: bool,
    keep: Option<usize>,
    /// The last number that a name has.
    number: u32,
    /// How many it has made.
    count: u32,
    made: Vec<PathBuf>,
}

impl Files {
    /// Called `path`, or with numbers behind its stem if the run `is_split`. What is there already is in the way, but for a
    /// run that `overwrites`: it does so, or goes on behind the numbers that there are. Of those made, the last `keep` stay.
    pub(super) fn new(path: &Path, is_split: bool, overwrites: bool, keep: Option<usize>) -> Files {
        Files { path: path.to_owned(), is_split, overwrites, keep, number: 0, count: 0, made: Vec::new() }
    }

    /// The first one.
    ///
    /// [`ErrorKind::AlreadyExists`] if something is in the way, [`ErrorKind::ResourceBusy`] if another run writes it.
    pub(super) fn first(&mut self) -> io::Result<(PathBuf, File)> {
        let last = if self.is_split { self.last() } else { 0 };
        if last > 0 && !self.overwrites {
            let name = self.name(last);
            let what = format!("files of an earlier run exist, the last one is {}", name.display());
            return Err(io::Error::new(ErrorKind::AlreadyExists, what));
        }
        self.make(last + 1, self.overwrites && !self.is_split)
    }

    /// The next one: a name that another run has taken is passed over.
    pub(super) fn next(&mut self) -> io::Result<(PathBuf, File)> {
        let mut number = self.number + 1;
        loop {
            match self.make(number, false) {
                Err(error) if TAKEN.contains(&error.kind()) => number += 1,
                made => return made,
            }
        }
    }

    /// Removes the oldest ones, if there are more than are kept. One that cannot be removed is nobody's any more.
    pub(super) fn prune(&mut self) {
        while self.keep.is_some_and(|keep| self.made.len() > keep.max(1)) {
            let _ = fs::remove_file(self.made.remove(0));
        }
    }

    /// How many it has made.
    pub(super) fn count(&self) -> u32 {
        self.count
    }

    fn make(&mut self, number: u32, overwrites: bool) -> io::Result<(PathBuf, File)> {
        let path = self.name(number);
        let file = open(&path, overwrites)?;
        (self.number, self.count) = (number, self.count + 1);
        self.made.push(path.clone());
        Ok((path, file))
    }

    fn name(&self, number: u32) -> PathBuf {
        if number == 1 && !self.is_split {
            return self.path.clone();
        }
        let (stem, ending) = self.around();
        self.path.with_file_name(format!("{stem}-{number:04}{ending}"))
    }

    /// What stands before and behind a number.
    fn around(&self) -> (String, String) {
        let stem = self.path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let ending = self.path.extension().map(|ending| format!(".{}", ending.to_string_lossy()));
        (stem, ending.unwrap_or_default())
    }

    /// The greatest number that a name in the directory has; 0 if there is none.
    fn last(&self) -> u32 {
        let (stem, ending) = self.around();
        let place = self.path.parent().filter(|place| !place.as_os_str().is_empty());
        let Ok(entries) = fs::read_dir(place.unwrap_or(Path::new("."))) else { return 0 };
        let names = entries.flatten().map(|entry| entry.file_name());
        let number = |name: &str| {
            let digits = name.strip_prefix(&stem)?.strip_prefix('-')?.strip_suffix(&ending)?;
            // Longer ones are dates.
            let number = digits.parse().ok().filter(|number| *number < 1_000_000)?;
            (format!("{number:04}") == digits).then_some(number)
        };
        names.filter_map(|name| number(name.to_str()?)).max().unwrap_or(0)
    }
}

/// Opens a file that no other run writes, empty.
fn open(path: &Path, overwrites: bool) -> io::Result<File> {
    let mut options = File::options();
    options.write(true);
    match overwrites {
        // Emptied when it is known that nobody writes it.
        true => options.create(true).truncate(false),
        false => options.create_new(true),
    };
    let file = options.open(path)?;
    if file.metadata()?.is_file() {
        lock::take(&file)?;
        file.set_len(0)?;
    }
    Ok(file)
}

/// Somebody else has the name.
const TAKEN: [ErrorKind; 2] = [ErrorKind::AlreadyExists, ErrorKind::ResourceBusy];

/// Removes the file that was made at `path`, if it is one: devices and links are others' things.
pub(super) fn discard(path: &Path) {
    if fs::symlink_metadata(path).is_ok_and(|place| place.is_file()) {
        let _ = fs::remove_file(path);
    }
}

/// The name of a recording that was begun at `wall_ns` and given none.
pub(super) fn usual_name(wall_ns: u64) -> PathBuf {
    let [year, month, day, hour, minute, second] = utc(wall_ns);
    format!("scanhub-{year:04}{month:02}{day:02}-{hour:02}{minute:02}{second:02}.mcap").into()
}

/// `wall_ns` as ISO 8601 has it, to the second.
pub(super) fn iso(wall_ns: u64) -> String {
    let [year, month, day, hour, minute, second] = utc(wall_ns);
    format!("{year:04}-{month:02}-{day:02}T{hour:02}:{minute:02}:{second:02}Z")
}

/// Year, month, day, hour, minute and second of a time in ns since 1970, in the Gregorian calendar.
fn utc(wall_ns: u64) -> [u64; 6] {
    let seconds = wall_ns / 1_000_000_000;
    let (mut day, time) = (seconds / DAY, seconds % DAY);
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

const DAY: u64 = 86_400;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_and_times() {
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
    fn dates() {
        let at = |seconds: u64| iso(seconds * 1_000_000_000);
        assert_eq!(at(0), "1970-01-01T00:00:00Z");
        assert_eq!(at(951_782_400), "2000-02-29T00:00:00Z");
        assert_eq!(at(1_709_251_199), "2024-02-29T23:59:59Z");
        assert_eq!(at(1_798_761_599), "2026-12-31T23:59:59Z");
        assert_eq!(at(4_107_542_400), "2100-03-01T00:00:00Z");
        assert_eq!(usual_name(1_700_000_000_000_000_000), Path::new("scanhub-20231114-221320.mcap"));
    }

    #[test]
    fn files_of_others_stay() {
        let place = std::env::temp_dir().join(format!("scanhub-files-{}", std::process::id()));
        fs::create_dir_all(&place).unwrap();
        let at = |name: &str| place.join(name);
        let mut files = Files::new(&at("walk.mcap"), true, false, Some(2));
        assert_eq!(files.first().unwrap().0, at("walk-0001.mcap"));
        fs::write(at("walk-0002.mcap"), "another's").unwrap();
        assert_eq!(files.next().unwrap().0, at("walk-0003.mcap"));
        assert_eq!(files.next().unwrap().0, at("walk-0004.mcap"));
        assert_eq!(files.count(), 3);
        files.prune();
        assert!(!at("walk-0001.mcap").exists() && at("walk-0003.mcap").exists());
        let taken = Files::new(&at("walk-0002.mcap"), false, false, None).first().unwrap_err();
        assert_eq!(taken.kind(), ErrorKind::AlreadyExists);
        // Those of an earlier run are not mixed with those of the next one.
        for other in
            ["walk-20261122.mcap", "walk-00009.mcap", "walk-7.mcap", "walk-0009.bag", "walks-0009.mcap"]
        {
            fs::write(at(other), "another's").unwrap();
        }
        let earlier = Files::new(&at("walk.mcap"), true, false, None).first().unwrap_err();
        assert!(earlier.kind() == ErrorKind::AlreadyExists && earlier.to_string().contains("walk-0004.mcap"));
        let mut behind = Files::new(&at("walk.mcap"), true, true, None);
        assert_eq!((behind.first().unwrap().0, behind.count()), (at("walk-0005.mcap"), 1));
        assert_eq!(fs::read(at("walk-0002.mcap")).unwrap(), b"another's");
        let mut one = Files::new(&at("one"), false, true, None);
        assert_eq!((one.first().unwrap().0, one.next().unwrap().0), (at("one"), at("one-0002")));
        fs::remove_dir_all(place).unwrap();
    }

    #[test]
    fn a_file_has_one_writer() {
        let place = std::env::temp_dir().join(format!("scanhub-writer-{}", std::process::id()));
        fs::create_dir_all(&place).unwrap();
        let path = place.join("walk.mcap");
        let (_, mut file) = Files::new(&path, false, false, None).first().unwrap();
        io::Write::write_all(&mut file, b"mine").unwrap();
        let busy = Files::new(&path, false, true, None).first().unwrap_err();
        assert_eq!((busy.kind(), fs::read(&path).unwrap()), (ErrorKind::ResourceBusy, b"mine".to_vec()));
        drop(file);
        assert!(Files::new(&path, false, true, None).first().is_ok());
        assert_eq!(fs::read(&path).unwrap(), b"");
        fs::remove_dir_all(place).unwrap();
    }
}
