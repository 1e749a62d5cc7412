//! Disk thread: takes the whole queue ten times a second, builds a chunk and writes it. If the disk is full, slow or
//! missing, the thread reports that and tries again, while new samples wait in the queue.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, ErrorKind};
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};

use scanhub_schema::Topic;

use super::files::{Files, Split, discard};
use super::queue::{Batch, Entry, Queue, WRITE_INTERVAL, WriterEvent, WriterProgress};
use super::recording_file::{FileOptions, RecordingFile, RecordingOutput, RepeatedStatus};
use crate::names::TopicName;

/// State of the disk thread.
pub(super) struct DiskWriter {
    queue: Arc<Queue>,
    progress: Arc<WriterProgress>,
    files: Option<Files>,
    split: Option<Split>,
    description: BTreeMap<String, String>,
    options: FileOptions,
    file: RecordingFile,
    tracks: Vec<TopicName>,
    /// Last status of each track with statuses. The next file starts with these statuses.
    statuses: Vec<Option<RepeatedStatus>>,
    /// Entries that are being written. The batch keeps them until they are written.
    batch: Batch,
    /// Length of all earlier files of this run, in bytes.
    bytes: u64,
    /// Whether a sample was written. Until then, no older file is removed, because a run without a hub must not replace
    /// older recordings.
    has_samples: bool,
    failure: Option<WriteFailure>,
    check_at: Instant,
    max_index_len: usize,
}

/// State while the disk cannot be written.
struct WriteFailure {
    since: Instant,
    retry_at: Instant,
    is_too_large: bool,
}

/// Destination of a recording.
pub(super) enum Destination {
    /// Files. The next file is started when the current file is full or fails.
    Files(Files),
    /// A stream, such as stdout.
    Stream(File),
}

impl DiskWriter {
    /// Starts the first file or the stream. An error in this function ends the run.
    pub(super) fn begin(
        queue: Arc<Queue>,
        destination: Destination,
        split: Option<Split>,
        options: FileOptions,
        description: BTreeMap<String, String>,
    ) -> io::Result<DiskWriter> {
        let (files, output) = match destination {
            Destination::Files(mut files) => {
                let (path, file) = files.first()?;
                (Some(files), RecordingOutput::File(file, path))
            }
            Destination::Stream(stream) => (None, RecordingOutput::Stream(stream)),
        };
        let mut recording_file =
            RecordingFile::begin(output, options, numbered(&description, files.as_ref()))?;
        // Remove the incomplete file, so that it does not block the next attempt.
        recording_file.write().inspect_err(|_| recording_file.path().into_iter().for_each(discard))?;
        let progress = WriterProgress::default();
        progress.stats().bytes = recording_file.written;
        Ok(DiskWriter {
            queue,
            progress: Arc::new(progress),
            files,
            split,
            description,
            options,
            file: recording_file,
            tracks: Vec::new(),
            statuses: Vec::new(),
            batch: Batch::new(),
            bytes: 0,
            has_samples: false,
            failure: None,
            check_at: Instant::now() + CHECK_INTERVAL,
            max_index_len: MAX_INDEX_LEN,
        })
    }

    /// Returns the progress, which the disk thread updates.
    pub(super) fn progress(&self) -> Arc<WriterProgress> {
        self.progress.clone()
    }

    /// Returns the number of files of earlier runs that will be removed once a sample is written.
    pub(super) fn surplus_older(&self) -> usize {
        self.files.as_ref().map_or(0, Files::surplus_older)
    }

    /// Returns the path of the current file.
    pub(super) fn path(&self) -> PathBuf {
        self.file.path().map_or_else(|| "stdout".into(), PathBuf::from)
    }

    /// Writes until the queue has ended and all its entries are written. An error is the reason why the file has no
    /// end.
    pub(super) fn run(mut self) -> io::Result<()> {
        let mut due = Instant::now();
        loop {
            due = (due + WRITE_INTERVAL).max(Instant::now());
            let is_over = self.queue.wait(due);
            let now = Instant::now();
            if self.failure.as_ref().is_some_and(|failure| !is_over && now < failure.retry_at) {
                continue;
            }
            match self.step(now, is_over) {
                Ok(()) => {
                    self.on_recovered();
                    if is_over {
                        return Ok(());
                    }
                }
                Err(error) if error.kind() == ErrorKind::BrokenPipe => {
                    self.progress.stats().events.push(WriterEvent::ReaderClosed);
                    return Err(error);
                }
                Err(error) if is_over && (self.failure.is_some() || self.file.is_doubtful) => {
                    return Err(error);
                }
                Err(error) => self.on_write_failed(&error, now),
            }
        }
    }

    /// Writes the data that could not be written before, and then the new entries of the queue.
    fn step(&mut self, now: Instant, is_over: bool) -> io::Result<()> {
        if self.failure.is_some() && self.is_lost() {
            self.renew()?;
        }
        self.write()?;
        if self.file.is_finished() {
            self.file.sync()?;
            if is_over && self.queue.is_empty() {
                self.subtract_removed();
                return Ok(());
            }
            self.renew()?;
        }
        self.queue.take(&mut self.batch);
        self.add_tracks();
        self.file.add(&self.tracks, &self.batch)?;
        self.write()?;
        if now >= self.check_at {
            self.check_at = now + CHECK_INTERVAL;
            self.file.check()?;
        }
        let is_full = self.files.is_some() && self.is_full(now);
        if is_over || is_full {
            self.file.finish()?;
            self.write()?;
            self.file.sync()?;
        }
        if is_full && !is_over {
            self.renew()?;
            self.write()?;
        } else if is_over {
            self.subtract_removed();
        }
        Ok(())
    }

    /// Returns whether the next file is due. A file without samples is never full, because the next file could replace
    /// a kept file.
    fn is_full(&self, now: Instant) -> bool {
        let is_split = match self.split {
            // End the file before it is too long, unless the index takes half of the file.
            Some(Split::Bytes(max_len)) => {
                self.file.started.is_some()
                    && self.file.written >= max_len / 2
                    && self.file.next_len() > max_len
            }
            Some(Split::Time(max_time)) => {
                self.file.started.is_some_and(|started| now.saturating_duration_since(started) >= max_time)
            }
            None => false,
        };
        is_split || self.file.index >= self.max_index_len
    }

    /// Writes the pending chunk, counts the samples of its batch, and empties the batch.
    fn write(&mut self) -> io::Result<()> {
        self.file.write()?;
        self.store_statuses();
        let mut stats = self.progress.stats();
        stats.bytes = self.bytes + self.file.written;
        stats.samples += self.batch.count();
        self.file.samples += self.batch.count();
        drop(stats);
        if !self.has_samples && self.batch.count() > 0 {
            self.has_samples = true;
            self.prune();
        }
        self.batch.clear();
        Ok(())
    }

    /// Returns whether the current file cannot be continued even if the disk works again.
    fn is_lost(&self) -> bool {
        let is_too_large = self.failure.as_ref().is_some_and(|failure| failure.is_too_large);
        self.files.is_some() && (self.file.check().is_err() || (is_too_large && self.file.written > 0))
    }

    /// Starts the next file, and adds the batch that was not written to the last file.
    fn renew(&mut self) -> io::Result<()> {
        let Some(files) = &mut self.files else { return Ok(()) };
        let (path, file) = files.next()?;
        let description = numbered(&self.description, Some(files));
        let mut recording_file =
            RecordingFile::begin(RecordingOutput::File(file, path.clone()), self.options, description)?;
        recording_file.repeat(&self.tracks, &self.statuses)?;
        recording_file.add(&self.tracks, &self.batch)?;
        self.subtract_removed();
        self.bytes += self.file.written;
        // This assignment closes the old file, which releases the lock on it. A file can be removed only after its lock
        // was released.
        self.file = recording_file;
        self.prune();
        self.progress.stats().events.push(WriterEvent::File(path));
        Ok(())
    }

    /// Removes the oldest files if there are more than `--keep` allows.
    fn prune(&mut self) {
        if let Some(files) = self.files.as_mut().filter(|_| self.has_samples) {
            files.prune();
        }
    }

    /// Subtracts the samples of a file that was removed or truncated.
    fn subtract_removed(&mut self) {
        let Some(path) = self.file.path().filter(|_| self.file.is_removed()).map(PathBuf::from) else {
            return;
        };
        let samples = std::mem::take(&mut self.file.samples);
        self.file.written = 0;
        let mut stats = self.progress.stats();
        (stats.bytes, stats.samples) = (self.bytes, stats.samples - samples);
        stats.events.push(WriterEvent::Removed(path, samples));
    }

    /// Adds the new tracks of the batch.
    fn add_tracks(&mut self) {
        for entry in &self.batch.entries {
            if let Entry::Track(track) = entry {
                self.tracks.push(track.clone());
                self.statuses.push(None);
            }
        }
    }

    /// Stores the last status of each sensor in the batch, for the start of the next file.
    fn store_statuses(&mut self) {
        let now = Instant::now();
        for (track, header, payload) in self.batch.samples() {
            if self.tracks[track].topic == Topic::Status {
                let mut room = self.statuses[track].take().map_or_else(Vec::new, |status| status.payload);
                room.clear();
                room.extend_from_slice(payload);
                let status = RepeatedStatus { arrived_at: now, header: *header, payload: room };
                self.statuses[track] = Some(status);
            }
        }
    }

    fn on_write_failed(&mut self, error: &io::Error, now: Instant) {
        let is_too_large = error.kind() == ErrorKind::FileTooLarge;
        if self.failure.is_none() {
            self.progress.stats().events.push(WriterEvent::WriteFailed(self.path(), error.to_string()));
        }
        // If the next file may be writable, try again at once.
        let is_first = self.failure.is_none();
        let since = self.failure.as_ref().map_or(now, |failure| failure.since);
        self.failure = Some(WriteFailure { since, retry_at: now, is_too_large });
        let at_once = is_first && self.is_lost();
        if let Some(failure) = self.failure.as_mut().filter(|_| !at_once) {
            failure.retry_at = now + RETRY_INTERVAL;
        }
    }

    fn on_recovered(&mut self) {
        if let Some(failure) = self.failure.take() {
            self.progress
                .stats()
                .events
                .push(WriterEvent::WriteResumed(self.path(), failure.since.elapsed()));
        }
    }
}

/// Returns the description of the run, with the number of the file in this run.
fn numbered(description: &BTreeMap<String, String>, files: Option<&Files>) -> BTreeMap<String, String> {
    let mut description = description.clone();
    description.insert("part".to_owned(), files.map_or(1, Files::count).to_string());
    description
}

/// Maximum memory for the index of a file, in bytes. Finishing the file takes twice this size in addition.
const MAX_INDEX_LEN: usize = 128 << 20;
/// Interval between attempts after the disk has failed.
const RETRY_INTERVAL: Duration = Duration::from_secs(1);
/// Interval between checks whether the current file was removed.
const CHECK_INTERVAL: Duration = Duration::from_secs(1);

#[cfg(test)]
mod tests {
    use std::fs;

    use scanhub_schema::file::Compression;
    use scanhub_schema::{Header, Status};
    use tempfile::TempDir;

    use super::super::recording_file::Form;
    use super::*;

    /// Starts a recording of the statuses of these sensors, in a new directory.
    fn disk(split: Option<Split>, sensors: &[&str]) -> (TempDir, DiskWriter) {
        let directory = TempDir::new().unwrap();
        let files = Files::new(&directory.path().join("walk.mcap"), split.is_some(), false, None, "");
        let options = FileOptions { form: Form::Hub, compression: Compression::None };
        let disk = DiskWriter::begin(
            Arc::new(Queue::new()),
            Destination::Files(files),
            split,
            options,
            BTreeMap::new(),
        );
        let disk = disk.unwrap();
        for sensor in sensors {
            let name = TopicName { sensor: (*sensor).to_owned(), topic: Topic::Status };
            disk.queue.note(Entry::Track(name));
        }
        (directory, disk)
    }

    fn push(disk: &DiskWriter, track: usize) {
        let pack =
            |room: &mut [u8]| scanhub_schema::datagram::DatagramPayload::pack(&Status::default(), room);
        let pushed = disk.queue.push(track, &Header::default(), size_of::<Status>(), pack);
        assert!(pushed);
    }

    fn names(directory: &TempDir) -> Vec<String> {
        let names = fs::read_dir(directory).unwrap().map(|entry| entry.unwrap().file_name());
        let mut names: Vec<_> = names.map(|name| name.to_string_lossy().into_owned()).collect();
        names.sort();
        names
    }

    #[test]
    fn keeps_file_without_samples_open() {
        let hour = Duration::from_secs(3600);
        let (directory, mut disk) = disk(Some(Split::Time(hour)), &["front"]);
        let now = Instant::now();
        for hours in 1..5 {
            disk.step(now + hours * hour, false).unwrap();
        }
        assert_eq!(names(&directory), ["walk-0001.mcap"]);
        push(&disk, 0);
        disk.step(now, false).unwrap();
        disk.step(now + 2 * hour, false).unwrap();
        assert_eq!(names(&directory), ["walk-0001.mcap", "walk-0002.mcap"]);
    }

    #[test]
    fn keeps_one_file_if_configured() {
        let (directory, mut disk) = disk(None, &["front"]);
        disk.files = Some(Files::new(&directory.path().join("run.mcap"), true, false, Some(1), "run 1"));
        disk.description.insert("started_ns".to_owned(), "run 1".to_owned());
        for number in 1..4 {
            push(&disk, 0);
            disk.step(Instant::now(), false).unwrap();
            disk.renew().unwrap();
            disk.write().unwrap();
            assert_eq!(names(&directory), [&format!("run-{number:04}.mcap")[..], "walk.mcap"]);
            assert!(
                !disk.progress.stats().events.iter().any(|news| matches!(news, WriterEvent::Removed(..)))
            );
        }
    }

    #[test]
    fn starts_next_file_if_index_is_too_large() {
        let (directory, mut disk) = disk(None, &["front"]);
        disk.max_index_len = 1000;
        for _ in 0..9 {
            push(&disk, 0);
            disk.step(Instant::now(), false).unwrap();
        }
        assert_eq!(names(&directory), ["walk-0002.mcap", "walk.mcap"]);
    }

    #[test]
    fn does_not_repeat_status_of_missing_sensor() {
        let (_place, mut disk) = disk(None, &["front", "rear"]);
        (0..2).for_each(|track| push(&disk, track));
        disk.step(Instant::now(), false).unwrap();
        let mut next = || {
            disk.renew().unwrap();
            disk.write().unwrap();
            disk.file.written
        };
        let [both, again] = [next(), next()];
        disk.statuses[0].as_mut().unwrap().arrived_at += Duration::from_secs(600);
        disk.renew().unwrap();
        disk.write().unwrap();
        assert!(both == again && disk.file.written < both, "{both} {again} {}", disk.file.written);
    }

    #[test]
    fn detects_file_that_was_cut() {
        let (directory, mut disk) = disk(None, &["front"]);
        push(&disk, 0);
        disk.step(Instant::now(), false).unwrap();
        assert!(disk.file.check().is_ok());
        File::options().write(true).open(directory.path().join("walk.mcap")).unwrap().set_len(100).unwrap();
        assert_eq!(disk.file.check().map_err(|error| error.kind()), Err(ErrorKind::NotFound));
    }
}
