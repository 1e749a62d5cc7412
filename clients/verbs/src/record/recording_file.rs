//! A file of a recording. Each chunk is built in memory and then written. If the write fails, the chunk is removed from
//! the file and written again, so the file always has only complete chunks.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{self, ErrorKind, Write};
use std::os::unix::fs::{FileExt, MetadataExt};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use scanhub_ros::bag::{self, BagWriter};
use scanhub_schema::datagram::DatagramPayload;
use scanhub_schema::file::{Compression, Writer};
use scanhub_schema::{Header, Scan, Status, Topic};

use super::queue::{Batch, Entry, Gap};
use crate::names::TopicName;

/// A file or stream that is being written.
pub(super) struct RecordingFile {
    writer: Option<Writer<PendingBytes>>,
    pending: PendingBytes,
    output: RecordingOutput,
    /// Number of pending bytes that a stream has accepted. These bytes cannot be withdrawn.
    taken: usize,
    /// Number of written bytes.
    pub(super) written: u64,
    /// Number of samples in the file, except for repeated statuses.
    pub(super) samples: u64,
    /// Arrival of the first sample that is not a repeated status.
    pub(super) started: Option<Instant>,
    /// Approximate size of the index in memory, in bytes.
    pub(super) index: usize,
    /// Approximate length of the index at the end of the file, in bytes.
    end_len: u64,
    /// Length of the last write, in bytes.
    last: u64,
    /// Whether a sync of the file has failed. Data may then be missing on the disk.
    pub(super) is_doubtful: bool,
    /// `boot` IDs of the hubs that the file describes.
    boots: Vec<u64>,
    /// Topics and tracks in the file.
    topics: Vec<Topic>,
    known_tracks: Vec<usize>,
    /// Writer of ROS 2 messages, in a recording for ROS 2.
    bag: Option<BagWriter>,
    scan: Box<Scan>,
}

/// A status that is repeated in the next file.
pub(super) struct RepeatedStatus {
    pub(super) arrived_at: Instant,
    pub(super) header: Header,
    pub(super) payload: Vec<u8>,
}

/// Format of a file.
#[derive(Clone, Copy, Debug)]
pub(super) struct FileOptions {
    pub(super) form: Form,
    pub(super) compression: Compression,
}

/// Format of the messages.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Form {
    /// Samples as the hub publishes them.
    Hub,
    /// ROS 2 messages only.
    Ros2,
}

impl Form {
    fn profile(self) -> &'static str {
        match self {
            Form::Hub => "",
            Form::Ros2 => bag::PROFILE,
        }
    }
}

/// Destination of the bytes.
pub(super) enum RecordingOutput {
    /// File with its path.
    File(File, PathBuf),
    /// Stdout, for example a pipe.
    Stream(File),
}

/// Bytes that are not written yet.
#[derive(Clone, Default)]
struct PendingBytes(Arc<Mutex<Vec<u8>>>);

impl Write for PendingBytes {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl RecordingFile {
    /// Builds the start of a file with the `description` of the run, without writing it.
    pub(super) fn begin(
        output: RecordingOutput,
        options: FileOptions,
        description: BTreeMap<String, String>,
    ) -> io::Result<RecordingFile> {
        let pending = PendingBytes::default();
        let writer = Some(Writer::begin_compressed(
            pending.clone(),
            options.form.profile(),
            options.compression,
            description,
        )?);
        Ok(RecordingFile {
            writer,
            pending,
            output,
            taken: 0,
            written: 0,
            samples: 0,
            started: None,
            index: 0,
            end_len: 0,
            last: 0,
            is_doubtful: false,
            boots: Vec::new(),
            topics: Vec::new(),
            known_tracks: Vec::new(),
            bag: (options.form == Form::Ros2).then(BagWriter::default),
            scan: Box::default(),
        })
    }

    /// Repeats the last status of each track, so that the file can be played without the earlier files. Drops a status
    /// that is older than the newest status by more than [`STATUS_LIFETIME`].
    pub(super) fn repeat(
        &mut self,
        tracks: &[TopicName],
        statuses: &[Option<RepeatedStatus>],
    ) -> io::Result<()> {
        let newest = statuses.iter().flatten().map(|status| status.arrived_at).max();
        for (at, status) in statuses.iter().enumerate() {
            let is_valid = |status: &&RepeatedStatus| {
                newest.is_some_and(|newest| newest - status.arrived_at < STATUS_LIFETIME)
            };
            if let Some(status) = status.as_ref().filter(is_valid) {
                self.sample(tracks, at, &status.header, &status.payload)?;
            }
        }
        Ok(())
    }

    /// Builds a chunk from `batch`, whose track numbers refer to `tracks`.
    pub(super) fn add(&mut self, tracks: &[TopicName], batch: &Batch) -> io::Result<()> {
        let samples = batch.count() as usize;
        if samples > 0 {
            self.started.get_or_insert_with(Instant::now);
            let channels = samples.min(tracks.len());
            self.index += CHUNK_INDEX_LEN + CHANNEL_INDEX_LEN * channels;
            self.end_len += CHUNK_END_LEN + CHANNEL_END_LEN * channels as u64;
        }
        let mut bytes = &batch.bytes[..];
        for entry in &batch.entries {
            match entry {
                Entry::Track(_) => {}
                Entry::Sample { track, header, len } => {
                    let (payload, remainder) = bytes.split_at(*len);
                    bytes = remainder;
                    self.sample(tracks, *track, header, payload)?;
                }
                Entry::Gap(gap) => self.gap(gap)?,
            }
        }
        self.writer()?.close_chunk()
    }

    /// Builds the index, which ends the file.
    pub(super) fn finish(&mut self) -> io::Result<()> {
        match self.writer.take() {
            Some(writer) => writer.finish().map(drop),
            None => Ok(()),
        }
    }

    pub(super) fn is_finished(&self) -> bool {
        self.writer.is_none()
    }

    /// Writes the pending bytes. After an error, the file ends with the last complete chunk, and the next call tries
    /// again.
    pub(super) fn write(&mut self) -> io::Result<()> {
        let mut pending = self.pending.0.lock().unwrap_or_else(PoisonError::into_inner);
        match &mut self.output {
            RecordingOutput::Stream(stream) => {
                while self.taken < pending.len() {
                    match stream.write(&pending[self.taken..]) {
                        Ok(0) => return Err(ErrorKind::WriteZero.into()),
                        Ok(count) => self.taken += count,
                        Err(error) if error.kind() == ErrorKind::Interrupted => {}
                        Err(error) => return Err(error),
                    }
                }
                self.taken = 0;
            }
            RecordingOutput::File(file, _) => {
                file.write_all_at(&pending, self.written).inspect_err(|_| {
                    let _ = file.set_len(self.written);
                })?
            }
        }
        self.written += pending.len() as u64;
        if !pending.is_empty() {
            self.last = pending.len() as u64;
        }
        pending.clear();
        Ok(())
    }

    /// Returns the approximate length in bytes that the file will have with one more chunk and the index at its end.
    /// The chunk is estimated as 1.5 times the length of the last write.
    pub(super) fn next_len(&self) -> u64 {
        self.written + self.last * 3 / 2 + self.end_len
    }

    /// Waits until the disk has stored the file.
    pub(super) fn sync(&mut self) -> io::Result<()> {
        match &self.output {
            RecordingOutput::Stream(_) => Ok(()),
            RecordingOutput::File(file, _) => match file.sync_data() {
                // Some devices do not support a sync.
                Err(error) if error.kind() == ErrorKind::InvalidInput => Ok(()),
                // Store the error, because Linux reports it only once, and the next sync would succeed.
                synced => synced.inspect_err(|_| self.is_doubtful = true),
            },
        }
    }

    /// Returns the path of the file, or `None` for a stream.
    pub(super) fn path(&self) -> Option<&Path> {
        match &self.output {
            RecordingOutput::File(_, path) => Some(path),
            RecordingOutput::Stream(_) => None,
        }
    }

    /// Checks that the file still exists under its name, with its full length.
    ///
    /// # Errors
    ///
    /// [`ErrorKind::NotFound`] if another file has the name, or the file was truncated.
    pub(super) fn check(&self) -> io::Result<()> {
        let RecordingOutput::File(file, path) = &self.output else { return Ok(()) };
        let (here, there) = (file.metadata()?, fs::metadata(path)?);
        if (here.dev(), here.ino()) != (there.dev(), there.ino()) {
            return Err(io::Error::new(ErrorKind::NotFound, "another file has its name"));
        }
        if here.is_file() && here.len() < self.written {
            return Err(io::Error::new(ErrorKind::NotFound, "another program truncated it"));
        }
        Ok(())
    }

    /// Returns whether the file was removed or truncated. A file that was moved still has its samples.
    pub(super) fn is_removed(&self) -> bool {
        let RecordingOutput::File(file, _) = &self.output else { return false };
        file.metadata().is_ok_and(|here| here.is_file() && (here.nlink() == 0 || here.len() < self.written))
    }

    fn writer(&mut self) -> io::Result<&mut Writer<PendingBytes>> {
        self.writer.as_mut().ok_or_else(nothing_after_index)
    }

    fn sample(&mut self, tracks: &[TopicName], at: usize, header: &Header, payload: &[u8]) -> io::Result<()> {
        let Some(name) = tracks.get(at) else { return Ok(()) };
        if !self.known_tracks.contains(&at) {
            self.known_tracks.push(at);
            self.end_len += TRACK_END_LEN;
            if !self.topics.contains(&name.topic) {
                self.topics.push(name.topic);
                self.end_len += TOPIC_END_LEN;
            }
        }
        if !self.boots.contains(&header.boot) {
            self.boots.push(header.boot);
            let fields = [
                ("boot", format!("{:016x}", header.boot)),
                ("hub_pid", header.hub_pid.to_string()),
                ("wall_ns", header.wall_ns.to_string()),
            ];
            self.writer()?
                .write_metadata(HUB_RECORD_NAME, fields.map(|(key, value)| (key.to_owned(), value)).into())?;
        }
        let Some(writer) = &mut self.writer else { return Err(nothing_after_index()) };
        match (&mut self.bag, name.topic) {
            (None, topic) => writer.write_sample(&name.sensor, topic, header, payload),
            (Some(bag), Topic::Scan) if Scan::unpack_into(&mut self.scan, payload) => {
                bag.write_scan(writer, &name.sensor, header, &self.scan)
            }
            (Some(bag), Topic::Status) => {
                let mut status = Status::default();
                match status.unpack(payload) {
                    true => bag.write_pose(writer, &name.sensor, header.wall_ns, &status.pose),
                    false => Ok(()),
                }
            }
            (Some(_), _) => Ok(()),
        }
    }

    fn gap(&mut self, gap: &Gap) -> io::Result<()> {
        let span = [("from_ns", gap.from_ns), ("to_ns", gap.to_ns)];
        let fields = span.map(|(key, value)| (key.to_owned(), value.to_string()));
        let dropped = gap.dropped.iter().map(|(name, count)| (name.to_string(), count.to_string()));
        self.writer()?.write_metadata(GAP_RECORD_NAME, fields.into_iter().chain(dropped).collect())
    }
}

fn nothing_after_index() -> io::Error {
    io::Error::other("nothing follows the index")
}

/// Maximum time between a repeated status and the newest status. Each sensor sends a status once a second.
const STATUS_LIFETIME: Duration = Duration::from_secs(60);
/// Size of the index in memory, in bytes: for each chunk, and for each channel in a chunk.
const CHUNK_INDEX_LEN: usize = 200;
const CHANNEL_INDEX_LEN: usize = 24;
/// Length of the index in the file, in bytes: for each chunk, each channel in a chunk, each track, and each topic. The
/// index contains the description of a topic's type again.
const CHUNK_END_LEN: u64 = 70;
const CHANNEL_END_LEN: u64 = 10;
const TRACK_END_LEN: u64 = 100;
const TOPIC_END_LEN: u64 = 100 + scanhub_schema::file::LAYOUT.len() as u64;
/// Name of the metadata record that is written before the first sample of a hub's run.
const HUB_RECORD_NAME: &str = "scanhub.run";
/// Name of the metadata record about dropped samples.
const GAP_RECORD_NAME: &str = "scanhub.gap";

#[cfg(test)]
mod tests {
    use std::io::Read;

    use super::*;

    #[test]
    fn stream_receives_every_byte_exactly_once() {
        let (mut reader, writer) = io::pipe().unwrap();
        rustix::io::ioctl_fionbio(&writer, true).unwrap();
        let stream = RecordingOutput::Stream(File::from(std::os::fd::OwnedFd::from(writer)));
        let options = FileOptions { form: Form::Hub, compression: Compression::None };
        let mut part = RecordingFile::begin(stream, options, BTreeMap::new()).unwrap();
        part.pending.write_all(&[7; 300_000]).unwrap();
        let made = part.pending.0.lock().unwrap().clone();
        let mut read = Vec::new();
        // A pipe takes only some of the bytes, and then none until the reader has read them.
        while let Err(error) = part.write() {
            assert_eq!((error.kind(), part.written), (ErrorKind::WouldBlock, 0));
            let mut some = [0; 50_000];
            let count = reader.read(&mut some).unwrap();
            read.extend(&some[..count]);
        }
        assert_eq!(part.written, made.len() as u64);
        drop(part);
        reader.read_to_end(&mut read).unwrap();
        assert!(read == made, "{} of {} bytes", read.len(), made.len());
    }
}
