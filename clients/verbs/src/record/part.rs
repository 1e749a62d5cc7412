//! One file of a recording. Each chunk is made in memory and then written. If the disk refuses it, it is written again, so the
//! file always has a whole number of chunks.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{self, ErrorKind, Write};
use std::os::unix::fs::{FileExt, MetadataExt};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use scanhub_ros::bag::{self, Bag};
use scanhub_schema::datagram::Packed;
use scanhub_schema::file::{Compression, Writer};
use scanhub_schema::{Header, Scan, Status, Topic};

use super::queue::{Batch, Entry, Gap};
use crate::names::TopicName;

/// A file that is being written.
pub(super) struct Part {
    writer: Option<Writer<Made>>,
    made: Made,
    place: Place,
    /// Bytes of `made` that a stream has taken already. They cannot be taken back.
    taken: usize,
    /// Bytes that are in the file.
    pub(super) written: u64,
    /// Samples that are in the file, without those that are repeated.
    pub(super) samples: u64,
    /// Arrival of its first sample, apart from those that are repeated.
    pub(super) begun: Option<Instant>,
    /// Approximate memory of its index, in bytes.
    pub(super) index: usize,
    /// Approximate length of its index in the file, in bytes.
    end: u64,
    /// Length of the last write, in bytes.
    last: u64,
    /// Whether a sync failed, so that data may be missing on the disk.
    pub(super) is_doubtful: bool,
    /// Boot numbers of the hubs that the file describes.
    lives: Vec<u64>,
    /// Topics and tracks in the file.
    topics: Vec<Topic>,
    met: Vec<usize>,
    /// Only in a recording for ROS 2.
    bag: Option<Bag>,
    scan: Box<Scan>,
}

/// A status that is repeated in the next file.
pub(super) struct Kept {
    pub(super) came_at: Instant,
    pub(super) header: Header,
    pub(super) payload: Vec<u8>,
}

/// Form of a file.
#[derive(Clone, Copy, Debug)]
pub(super) struct Style {
    pub(super) form: Form,
    pub(super) compression: Compression,
}

/// Form of the messages.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Form {
    /// Samples as the hub publishes them.
    Hub,
    /// Only messages of ROS 2.
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
pub(super) enum Place {
    /// A file and its name.
    File(File, PathBuf),
    /// Stdout, for example a pipe.
    Stream(File),
}

/// Bytes that are made and not written yet.
#[derive(Clone, Default)]
struct Made(Arc<Mutex<Vec<u8>>>);

impl Write for Made {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Part {
    /// Makes the start of a file, with `facts` on the run. Nothing is written yet.
    pub(super) fn begin(place: Place, style: Style, facts: BTreeMap<String, String>) -> io::Result<Part> {
        let made = Made::default();
        let writer = Some(Writer::packed(made.clone(), style.form.profile(), style.compression, facts)?);
        Ok(Part {
            writer,
            made,
            place,
            taken: 0,
            written: 0,
            samples: 0,
            begun: None,
            index: 0,
            end: 0,
            last: 0,
            is_doubtful: false,
            lives: Vec::new(),
            topics: Vec::new(),
            met: Vec::new(),
            bag: (style.form == Form::Ros2).then(Bag::default),
            scan: Box::default(),
        })
    }

    /// Repeats the last statuses, by track, so that the file can be played without those before. Leaves out sensors that are
    /// silent while others send.
    pub(super) fn repeat(&mut self, tracks: &[TopicName], statuses: &[Option<Kept>]) -> io::Result<()> {
        let newest = statuses.iter().flatten().map(|kept| kept.came_at).max();
        for (at, kept) in statuses.iter().enumerate() {
            let stands = |kept: &&Kept| newest.is_some_and(|newest| newest - kept.came_at < STANDS);
            if let Some(kept) = kept.as_ref().filter(stands) {
                self.sample(tracks, at, &kept.header, &kept.payload)?;
            }
        }
        Ok(())
    }

    /// Makes a chunk of `batch`, whose tracks are among `tracks`.
    pub(super) fn add(&mut self, tracks: &[TopicName], batch: &Batch) -> io::Result<()> {
        let samples = batch.count() as usize;
        if samples > 0 {
            self.begun.get_or_insert_with(Instant::now);
            let channels = samples.min(tracks.len());
            self.index += INDEX_OF_CHUNK + INDEX_OF_CHANNEL * channels;
            self.end += END_OF_CHUNK + END_OF_CHANNEL * channels as u64;
        }
        let mut bytes = &batch.bytes[..];
        for entry in &batch.entries {
            match entry {
                Entry::Track(_) => {}
                Entry::Sample { track, header, len } => {
                    let (payload, rest) = bytes.split_at(*len);
                    bytes = rest;
                    self.sample(tracks, *track, header, payload)?;
                }
                Entry::Gap(gap) => self.gap(gap)?,
            }
        }
        self.writer()?.close_chunk()
    }

    /// Makes the index, which ends the file.
    pub(super) fn finish(&mut self) -> io::Result<()> {
        match self.writer.take() {
            Some(writer) => writer.finish().map(drop),
            None => Ok(()),
        }
    }

    pub(super) fn is_finished(&self) -> bool {
        self.writer.is_none()
    }

    /// Writes what was made. After an error, the file ends with the last whole chunk, and the next call tries again.
    pub(super) fn write(&mut self) -> io::Result<()> {
        let mut made = self.made.0.lock().unwrap_or_else(PoisonError::into_inner);
        match &mut self.place {
            Place::Stream(stream) => {
                while self.taken < made.len() {
                    match stream.write(&made[self.taken..]) {
                        Ok(0) => return Err(ErrorKind::WriteZero.into()),
                        Ok(count) => self.taken += count,
                        Err(error) if error.kind() == ErrorKind::Interrupted => {}
                        Err(error) => return Err(error),
                    }
                }
                self.taken = 0;
            }
            Place::File(file, _) => file.write_all_at(&made, self.written).inspect_err(|_| {
                let _ = file.set_len(self.written);
            })?,
        }
        self.written += made.len() as u64;
        if !made.is_empty() {
            self.last = made.len() as u64;
        }
        made.clear();
        Ok(())
    }

    /// Returns the approximate length of the file after one more chunk and its end, in bytes. The chunk is assumed to be half as
    /// long again as the last one.
    pub(super) fn next_len(&self) -> u64 {
        self.written + self.last * 3 / 2 + self.end
    }

    /// Waits until the disk has stored the file.
    pub(super) fn sync(&mut self) -> io::Result<()> {
        match &self.place {
            Place::Stream(_) => Ok(()),
            Place::File(file, _) => match file.sync_data() {
                // Not every device stores data.
                Err(error) if error.kind() == ErrorKind::InvalidInput => Ok(()),
                // Linux reports the error only once: the next sync would succeed.
                synced => synced.inspect_err(|_| self.is_doubtful = true),
            },
        }
    }

    /// Returns the name of the file, or `None` for a stream.
    pub(super) fn path(&self) -> Option<&Path> {
        match &self.place {
            Place::File(_, path) => Some(path),
            Place::Stream(_) => None,
        }
    }

    /// Checks that the whole file still has its name.
    ///
    /// # Errors
    ///
    /// [`ErrorKind::NotFound`] if another file has the name, or the file was cut.
    pub(super) fn look(&self) -> io::Result<()> {
        let Place::File(file, path) = &self.place else { return Ok(()) };
        let (here, there) = (file.metadata()?, fs::metadata(path)?);
        if (here.dev(), here.ino()) != (there.dev(), there.ino()) {
            return Err(io::Error::new(ErrorKind::NotFound, "another file has its name"));
        }
        if here.is_file() && here.len() < self.written {
            return Err(io::Error::new(ErrorKind::NotFound, "another program cut it"));
        }
        Ok(())
    }

    /// Returns whether the file was removed or cut. A file that was moved still has its samples.
    pub(super) fn is_gone(&self) -> bool {
        let Place::File(file, _) = &self.place else { return false };
        file.metadata().is_ok_and(|here| here.is_file() && (here.nlink() == 0 || here.len() < self.written))
    }

    fn writer(&mut self) -> io::Result<&mut Writer<Made>> {
        self.writer.as_mut().ok_or_else(nothing_behind)
    }

    fn sample(&mut self, tracks: &[TopicName], at: usize, header: &Header, payload: &[u8]) -> io::Result<()> {
        let Some(name) = tracks.get(at) else { return Ok(()) };
        if !self.met.contains(&at) {
            self.met.push(at);
            self.end += END_OF_TRACK;
            if !self.topics.contains(&name.topic) {
                self.topics.push(name.topic);
                self.end += END_OF_TOPIC;
            }
        }
        if !self.lives.contains(&header.boot) {
            self.lives.push(header.boot);
            let facts = [
                ("boot", format!("{:016x}", header.boot)),
                ("hub_pid", header.hub_pid.to_string()),
                ("wall_ns", header.wall_ns.to_string()),
            ];
            self.writer()?.note(LIFE, facts.map(|(key, value)| (key.to_owned(), value)).into())?;
        }
        let Some(writer) = &mut self.writer else { return Err(nothing_behind()) };
        match (&mut self.bag, name.topic) {
            (None, topic) => writer.sample(&name.sensor, topic, header, payload),
            (Some(bag), Topic::Scan) if Scan::unpack_into(&mut self.scan, payload) => {
                bag.scan(writer, &name.sensor, header, &self.scan)
            }
            (Some(bag), Topic::Status) => {
                let mut status = Status::default();
                match status.unpack(payload) {
                    true => bag.pose(writer, &name.sensor, header.wall_ns, &status.pose),
                    false => Ok(()),
                }
            }
            (Some(_), _) => Ok(()),
        }
    }

    fn gap(&mut self, gap: &Gap) -> io::Result<()> {
        let span = [("from_ns", gap.from_ns), ("to_ns", gap.to_ns)];
        let facts = span.map(|(key, value)| (key.to_owned(), value.to_string()));
        let dropped = gap.dropped.iter().map(|(name, count)| (name.to_string(), count.to_string()));
        self.writer()?.note(GAP, facts.into_iter().chain(dropped).collect())
    }
}

fn nothing_behind() -> io::Error {
    io::Error::other("nothing follows the index")
}

/// A status is valid for this time while others arrive. Each sensor sends one a second.
const STANDS: Duration = Duration::from_secs(60);
/// Bytes in the index in memory: for a chunk, and for each channel in it.
const INDEX_OF_CHUNK: usize = 200;
const INDEX_OF_CHANNEL: usize = 24;
/// Bytes in the index in the file: for a chunk, each channel in it, a track, and a topic, whose type the index describes again.
const END_OF_CHUNK: u64 = 70;
const END_OF_CHANNEL: u64 = 10;
const END_OF_TRACK: u64 = 100;
const END_OF_TOPIC: u64 = 100 + scanhub_schema::file::LAYOUT.len() as u64;
/// Name of the metadata record that precedes the first sample of a hub.
const LIFE: &str = "scanhub.life";
/// Name of the metadata record of samples that were left out.
const GAP: &str = "scanhub.gap";

#[cfg(test)]
mod tests {
    use std::io::Read;

    use super::*;

    #[test]
    fn what_a_stream_has_taken_it_is_not_given_again() {
        let (mut reader, writer) = io::pipe().unwrap();
        rustix::io::ioctl_fionbio(&writer, true).unwrap();
        let stream = Place::Stream(File::from(std::os::fd::OwnedFd::from(writer)));
        let style = Style { form: Form::Hub, compression: Compression::None };
        let mut part = Part::begin(stream, style, BTreeMap::new()).unwrap();
        part.made.write_all(&[7; 300_000]).unwrap();
        let made = part.made.0.lock().unwrap().clone();
        let mut read = Vec::new();
        // A pipe takes less than that, and then for a while nothing.
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
