//! The disk thread: takes the queue ten times a second, makes a chunk and writes it. If the disk is full, slow or missing, it
//! reports that and tries again, while new samples wait in the queue.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, ErrorKind};
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};

use scanhub_schema::Topic;

use super::files::{Files, Split, discard};
use super::part::{Kept, Part, Place, Style};
use super::queue::{Batch, Entry, News, Queue, WRITE_INTERVAL, WriterProgress};
use crate::names::TopicName;

/// State of the disk thread of one run.
pub(super) struct Disk {
    queue: Arc<Queue>,
    progress: Arc<WriterProgress>,
    files: Option<Files>,
    split: Option<Split>,
    facts: BTreeMap<String, String>,
    style: Style,
    part: Part,
    tracks: Vec<TopicName>,
    /// Last status of each track of that topic, for the start of the next file.
    statuses: Vec<Option<Kept>>,
    /// Entries that are being written. They stay here until the disk has them.
    batch: Batch,
    /// Bytes of the files before.
    bytes: u64,
    /// Whether a sample was written. Before that, no older file is removed: a run without a hub must not cost one.
    has_samples: bool,
    trouble: Option<Trouble>,
    look_at: Instant,
    most_index: usize,
}

/// State while the disk cannot be written.
struct Trouble {
    since: Instant,
    retry_at: Instant,
    is_too_large: bool,
}

/// Place of a recording.
pub(super) enum Destination {
    /// Files. The next one is started if the current one is full or fails.
    Files(Files),
    /// A stream, such as stdout.
    Stream(File),
}

impl Disk {
    /// Starts the first file, or the stream. An error at the start ends the run at once.
    pub(super) fn begin(
        queue: Arc<Queue>,
        destination: Destination,
        split: Option<Split>,
        style: Style,
        facts: BTreeMap<String, String>,
    ) -> io::Result<Disk> {
        let (files, place) = match destination {
            Destination::Files(mut files) => {
                let (path, file) = files.first()?;
                (Some(files), Place::File(file, path))
            }
            Destination::Stream(stream) => (None, Place::Stream(stream)),
        };
        let mut part = Part::begin(place, style, numbered(&facts, files.as_ref()))?;
        // A file that could not be started must not block the next try.
        part.write().inspect_err(|_| part.path().into_iter().for_each(discard))?;
        let progress = WriterProgress::default();
        progress.stats().bytes = part.written;
        Ok(Disk {
            queue,
            progress: Arc::new(progress),
            files,
            split,
            facts,
            style,
            part,
            tracks: Vec::new(),
            statuses: Vec::new(),
            batch: Batch::new(),
            bytes: 0,
            has_samples: false,
            trouble: None,
            look_at: Instant::now() + LOOK_EVERY,
            most_index: MOST_INDEX,
        })
    }

    /// Returns the progress, which the disk thread updates.
    pub(super) fn progress(&self) -> Arc<WriterProgress> {
        self.progress.clone()
    }

    /// Returns how many files of earlier runs are removed as soon as a sample is written.
    pub(super) fn surplus_older(&self) -> usize {
        self.files.as_ref().map_or(0, Files::surplus_older)
    }

    /// Returns the name of the current file.
    pub(super) fn path(&self) -> PathBuf {
        self.part.path().map_or_else(|| "stdout".into(), PathBuf::from)
    }

    /// Writes until the queue has ended and everything is written. The error is the reason why the end is missing.
    pub(super) fn run(mut self) -> io::Result<()> {
        let mut due = Instant::now();
        loop {
            due = (due + WRITE_INTERVAL).max(Instant::now());
            let is_over = self.queue.wait(due);
            let now = Instant::now();
            if self.trouble.as_ref().is_some_and(|trouble| !is_over && now < trouble.retry_at) {
                continue;
            }
            match self.step(now, is_over) {
                Ok(()) => {
                    self.recovered();
                    if is_over {
                        return Ok(());
                    }
                }
                Err(error) if error.kind() == ErrorKind::BrokenPipe => {
                    self.progress.stats().news.push(News::ReaderGone);
                    return Err(error);
                }
                Err(error) if is_over && (self.trouble.is_some() || self.part.is_doubtful) => {
                    return Err(error);
                }
                Err(error) => self.troubled(&error, now),
            }
        }
    }

    /// Writes first what could not be written before, and then what the queue received since.
    fn step(&mut self, now: Instant, is_over: bool) -> io::Result<()> {
        if self.trouble.is_some() && self.is_lost() {
            self.renew()?;
        }
        self.write()?;
        if self.part.is_finished() {
            self.part.sync()?;
            if is_over && self.queue.is_empty() {
                self.count_gone();
                return Ok(());
            }
            self.renew()?;
        }
        self.queue.take(&mut self.batch);
        self.meet();
        self.part.add(&self.tracks, &self.batch)?;
        self.write()?;
        if now >= self.look_at {
            self.look_at = now + LOOK_EVERY;
            self.part.look()?;
        }
        let is_full = self.files.is_some() && self.is_full(now);
        if is_over || is_full {
            self.part.finish()?;
            self.write()?;
            self.part.sync()?;
        }
        if is_full && !is_over {
            self.renew()?;
            self.write()?;
        } else if is_over {
            self.count_gone();
        }
        Ok(())
    }

    /// Returns whether the next file is due. A file without samples stays open, because the next one could replace a kept file.
    fn is_full(&self, now: Instant) -> bool {
        let is_split = match self.split {
            // The file ends before it is too long, unless its index takes half of it.
            Some(Split::Bytes(most)) => {
                self.part.begun.is_some() && self.part.written >= most / 2 && self.part.next_len() > most
            }
            Some(Split::Time(most)) => {
                self.part.begun.is_some_and(|begun| now.saturating_duration_since(begun) >= most)
            }
            None => false,
        };
        is_split || self.part.index >= self.most_index
    }

    /// Writes the chunk of the batch, counts its samples, and empties the batch.
    fn write(&mut self) -> io::Result<()> {
        self.part.write()?;
        self.remember();
        let mut stats = self.progress.stats();
        stats.bytes = self.bytes + self.part.written;
        stats.samples += self.batch.count();
        self.part.samples += self.batch.count();
        drop(stats);
        if !self.has_samples && self.batch.count() > 0 {
            self.has_samples = true;
            self.prune();
        }
        self.batch.clear();
        Ok(())
    }

    /// Returns whether the current file cannot be continued, even if the disk recovers.
    fn is_lost(&self) -> bool {
        let is_too_large = self.trouble.as_ref().is_some_and(|trouble| trouble.is_too_large);
        self.files.is_some() && (self.part.look().is_err() || (is_too_large && self.part.written > 0))
    }

    /// Starts the next file, with the batch that is not written yet.
    fn renew(&mut self) -> io::Result<()> {
        let Some(files) = &mut self.files else { return Ok(()) };
        let (path, file) = files.next()?;
        let facts = numbered(&self.facts, Some(files));
        let mut part = Part::begin(Place::File(file, path.clone()), self.style, facts)?;
        part.repeat(&self.tracks, &self.statuses)?;
        part.add(&self.tracks, &self.batch)?;
        self.count_gone();
        self.bytes += self.part.written;
        // Replacing the part closes the old file, which unlocks it. Only then can it be removed.
        self.part = part;
        self.prune();
        self.progress.stats().news.push(News::File(path));
        Ok(())
    }

    /// Removes files beyond those that are kept.
    fn prune(&mut self) {
        if let Some(files) = self.files.as_mut().filter(|_| self.has_samples) {
            files.prune();
        }
    }

    /// Subtracts the samples of a file that was removed or cut.
    fn count_gone(&mut self) {
        let Some(path) = self.part.path().filter(|_| self.part.is_gone()).map(PathBuf::from) else { return };
        let samples = std::mem::take(&mut self.part.samples);
        self.part.written = 0;
        let mut stats = self.progress.stats();
        (stats.bytes, stats.samples) = (self.bytes, stats.samples - samples);
        stats.news.push(News::Gone(path, samples));
    }

    /// Keeps the tracks of the batch.
    fn meet(&mut self) {
        for entry in &self.batch.entries {
            if let Entry::Track(track) = entry {
                self.tracks.push(track.clone());
                self.statuses.push(None);
            }
        }
    }

    /// Keeps the last statuses of the batch, for the next file.
    fn remember(&mut self) {
        let now = Instant::now();
        for (track, header, payload) in self.batch.samples() {
            if self.tracks[track].topic == Topic::Status {
                let mut room = self.statuses[track].take().map_or_else(Vec::new, |kept| kept.payload);
                room.clear();
                room.extend_from_slice(payload);
                let kept = Kept { came_at: now, header: *header, payload: room };
                self.statuses[track] = Some(kept);
            }
        }
    }

    fn troubled(&mut self, error: &io::Error, now: Instant) {
        let is_too_large = error.kind() == ErrorKind::FileTooLarge;
        if self.trouble.is_none() {
            self.progress.stats().news.push(News::Trouble(self.path(), error.to_string()));
        }
        // If another file may help, the next try is at once.
        let is_first = self.trouble.is_none();
        let since = self.trouble.as_ref().map_or(now, |trouble| trouble.since);
        self.trouble = Some(Trouble { since, retry_at: now, is_too_large });
        let at_once = is_first && self.is_lost();
        if let Some(trouble) = self.trouble.as_mut().filter(|_| !at_once) {
            trouble.retry_at = now + RETRY_EVERY;
        }
    }

    fn recovered(&mut self) {
        if let Some(trouble) = self.trouble.take() {
            self.progress.stats().news.push(News::Well(self.path(), trouble.since.elapsed()));
        }
    }
}

/// Returns the description of the run, with the number of the file in the run.
fn numbered(facts: &BTreeMap<String, String>, files: Option<&Files>) -> BTreeMap<String, String> {
    let mut facts = facts.clone();
    facts.insert("part".to_owned(), files.map_or(1, Files::count).to_string());
    facts
}

/// Maximum memory for the index of a file, in bytes. Finishing the file takes twice as much again.
const MOST_INDEX: usize = 128 << 20;
/// Interval at which a disk that fails is tried again.
const RETRY_EVERY: Duration = Duration::from_secs(1);
/// Interval at which the current file is checked for removal.
const LOOK_EVERY: Duration = Duration::from_secs(1);

#[cfg(test)]
mod tests {
    use std::fs;

    use scanhub_schema::file::Compression;
    use scanhub_schema::{Header, Status};
    use tempfile::TempDir;

    use super::super::part::Form;
    use super::*;

    /// Starts a recording of the status of these sensors, in its own directory.
    fn disk(split: Option<Split>, sensors: &[&str]) -> (TempDir, Disk) {
        let place = TempDir::new().unwrap();
        let files = Files::new(&place.path().join("walk.mcap"), split.is_some(), false, None, "");
        let style = Style { form: Form::Hub, compression: Compression::None };
        let disk =
            Disk::begin(Arc::new(Queue::new()), Destination::Files(files), split, style, BTreeMap::new());
        let disk = disk.unwrap();
        for sensor in sensors {
            let name = TopicName { sensor: (*sensor).to_owned(), topic: Topic::Status };
            disk.queue.note(Entry::Track(name));
        }
        (place, disk)
    }

    fn push(disk: &Disk, track: usize) {
        let pack = |room: &mut [u8]| scanhub_schema::datagram::Packed::pack(&Status::default(), room);
        let pushed = disk.queue.push(track, &Header::default(), size_of::<Status>(), pack);
        assert!(pushed);
    }

    fn names(place: &TempDir) -> Vec<String> {
        let names = fs::read_dir(place).unwrap().map(|entry| entry.unwrap().file_name());
        let mut names: Vec<_> = names.map(|name| name.to_string_lossy().into_owned()).collect();
        names.sort();
        names
    }

    #[test]
    fn keeps_file_without_samples_open() {
        let hour = Duration::from_secs(3600);
        let (place, mut disk) = disk(Some(Split::Time(hour)), &["front"]);
        let now = Instant::now();
        for hours in 1..5 {
            disk.step(now + hours * hour, false).unwrap();
        }
        assert_eq!(names(&place), ["walk-0001.mcap"]);
        push(&disk, 0);
        disk.step(now, false).unwrap();
        disk.step(now + 2 * hour, false).unwrap();
        assert_eq!(names(&place), ["walk-0001.mcap", "walk-0002.mcap"]);
    }

    #[test]
    fn keeps_one_file_if_configured() {
        let (place, mut disk) = disk(None, &["front"]);
        disk.files = Some(Files::new(&place.path().join("run.mcap"), true, false, Some(1), "run 1"));
        disk.facts.insert("started_ns".to_owned(), "run 1".to_owned());
        for number in 1..4 {
            push(&disk, 0);
            disk.step(Instant::now(), false).unwrap();
            disk.renew().unwrap();
            disk.write().unwrap();
            assert_eq!(names(&place), [&format!("run-{number:04}.mcap")[..], "walk.mcap"]);
            assert!(!disk.progress.stats().news.iter().any(|news| matches!(news, News::Gone(..))));
        }
    }

    #[test]
    fn starts_next_file_if_index_is_too_large() {
        let (place, mut disk) = disk(None, &["front"]);
        disk.most_index = 1000;
        for _ in 0..9 {
            push(&disk, 0);
            disk.step(Instant::now(), false).unwrap();
        }
        assert_eq!(names(&place), ["walk-0002.mcap", "walk.mcap"]);
    }

    #[test]
    fn does_not_repeat_status_of_missing_sensor() {
        let (_place, mut disk) = disk(None, &["front", "rear"]);
        (0..2).for_each(|track| push(&disk, track));
        disk.step(Instant::now(), false).unwrap();
        let mut next = || {
            disk.renew().unwrap();
            disk.write().unwrap();
            disk.part.written
        };
        let [both, again] = [next(), next()];
        disk.statuses[0].as_mut().unwrap().came_at += Duration::from_secs(600);
        disk.renew().unwrap();
        disk.write().unwrap();
        assert!(both == again && disk.part.written < both, "{both} {again} {}", disk.part.written);
    }

    #[test]
    fn detects_file_that_was_cut() {
        let (place, mut disk) = disk(None, &["front"]);
        push(&disk, 0);
        disk.step(Instant::now(), false).unwrap();
        assert!(disk.part.look().is_ok());
        File::options().write(true).open(place.path().join("walk.mcap")).unwrap().set_len(100).unwrap();
        assert_eq!(disk.part.look().map_err(|error| error.kind()), Err(ErrorKind::NotFound));
    }
}
