//! An open recording. Its format is detected by the bytes of the file and not by the name. The file is read to its end
//! once, so that its contents and its damage are known before it is used. No telegram is kept in memory.

use std::io::{self, BufRead, BufReader, ErrorKind, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use flate2::bufread::MultiGzDecoder;
use scanhub_drivers::line::ScannerSession as _;
use scanhub_drivers::recognize::{EXAMINED_BYTES, bytes_by_family, family_of};
use scanhub_drivers::{Model, Session, Settings, features};
use scanhub_files::regular_file;
use scanhub_schema::{Failure, Family, Kind};

use crate::carmen::{self, LogReader};
#[cfg(feature = "mcap")]
use crate::mcap::{Catalog, Reader};
use crate::stream::{self, StreamReader};
use crate::{Contents, Encoding, Form, Frame, MountRecord, VirtualTime};

/// Recording that could be read to its end.
#[derive(Clone, Debug)]
pub struct Recording {
    path: PathBuf,
    contents: Contents,
    /// Summary of an MCAP file, with the contents of each sensor.
    #[cfg(feature = "mcap")]
    summary: std::sync::Arc<crate::mcap::FileSummary>,
    /// Sensor that [`of`](Self::of) selected.
    sensor: Option<String>,
}

impl Recording {
    /// Opens the file at `path`, and reads it to its end. The family of a stream file is recognized by its bytes. For a
    /// damaged file, see [`Contents::damage`].
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Input`] if the file is neither an MCAP file nor a CARMEN log, and has no telegram. Also returns
    /// [`Kind::Input`] for a stream file if no family accepts at least half of the [first
    /// bytes](scanhub_drivers::recognize::EXAMINED_BYTES).
    pub fn open(path: impl Into<PathBuf>) -> Result<Recording, Failure> {
        Recording::open_as(path, None)
    }

    /// Opens a file like [`open`](Self::open). If the file is a stream file and `family` is given, its bytes belong to
    /// this family.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`open`](Self::open).
    pub fn open_as(path: impl Into<PathBuf>, family: Option<Family>) -> Result<Recording, Failure> {
        let path = path.into();
        let recording = Recording::open_stream(&path, family)?;
        if recording.contents.form == Form::Telegrams && recording.contents.telegrams == 0 {
            return Err(without_telegram(&path));
        }
        Ok(recording)
    }

    /// Opens a file like [`open_as`](Self::open_as). If `family` is given, a stream file may contain no telegram, such
    /// as the bytes of a line with only noise.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`open`](Self::open).
    pub fn open_stream(path: impl Into<PathBuf>, family: Option<Family>) -> Result<Recording, Failure> {
        let path = path.into();
        let mut reader = reader(&path)?;
        let head = reader.fill_buf().map_err(|error| unreadable(&path, &error))?;
        if head.is_empty() {
            return Err(unusable(&path, "is empty"));
        }
        if head.starts_with(MCAP_MAGIC) {
            return Recording::open_mcap(path);
        }
        let form = if carmen::is_log(head) { Form::Carmen } else { Form::Telegrams };
        if let Some(fragment) = mcap_fragment(&path).map_err(|error| unreadable(&path, &error))? {
            let message =
                format!("recording {} is {fragment} of an MCAP file, without its beginning", path.display());
            return Err(Failure::new(
                Kind::Input,
                message,
                "an MCAP file is read from its first byte: give the whole file",
            ));
        }
        let contents = match form {
            Form::Carmen => carmen::contents(&path, reader)?,
            _ => stream_contents(&path, family)?,
        };
        if form == Form::Carmen && contents.telegrams == 0 {
            return Err(unusable(&path, "is a CARMEN log without a scan"));
        }
        Ok(Recording {
            path,
            contents,
            #[cfg(feature = "mcap")]
            summary: Default::default(),
            sensor: None,
        })
    }

    #[cfg(feature = "mcap")]
    fn open_mcap(path: PathBuf) -> Result<Recording, Failure> {
        let summary =
            crate::mcap::FileSummary::of(|| open(&path)).map_err(|error| unreadable(&path, &error))?;
        let contents = summary.contents();
        Ok(Recording { path, contents, summary: summary.into(), sensor: None })
    }

    #[cfg(not(feature = "mcap"))]
    fn open_mcap(path: PathBuf) -> Result<Recording, Failure> {
        let message = format!("recording {} is an MCAP file, which this build does not read", path.display());
        Err(Failure::new(Kind::Input, message, "build it with feature mcap of scanhub-recording"))
    }

    /// Returns whether a file that starts with `head` is a container with telegrams inside, which is MCAP or gzip.
    pub fn is_framed(head: &[u8]) -> bool {
        head.starts_with(MCAP_MAGIC) || head.starts_with(GZIP_MAGIC)
    }

    /// Returns the recording restricted to `sensor`.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::NoTopic`] with the existing sensors if `sensor` is not one of them, and [`Kind::Usage`] if the
    /// recording names no sensor.
    pub fn of(&self, sensor: &str) -> Result<Recording, Failure> {
        let path = self.path.display();
        if self.contents.sensors.is_empty() {
            let message = format!("recording {path} does not name its sensor, so {sensor} cannot be chosen");
            return Err(Failure::new(Kind::Usage, message, "leave the sensor out"));
        }
        if !self.contents.sensors.iter().any(|name| name == sensor) {
            let message = format!("recording {path} has no sensor {sensor:?}");
            return Err(Failure::new(Kind::NoTopic, message, self.sensor_choice()));
        }
        let mut chosen = self.clone();
        #[cfg(feature = "mcap")]
        {
            chosen.contents = self.summary.contents_of(sensor);
        }
        chosen.sensor = Some(sensor.to_owned());
        Ok(chosen)
    }

    /// Returns the sequence number of the first telegram of the only sensor from which the hub with the ID `boot`
    /// computed another sample. From this telegram on, the hub knew the meaning of the values. Returns `None` if the
    /// recording has no such sample. Only MCAP files have one.
    pub fn first_understood(&self, boot: u64) -> Option<u64> {
        #[cfg(feature = "mcap")]
        return self.summary.first_understood(self.contents.sensors.first()?, boot);
        #[cfg(not(feature = "mcap"))]
        {
            let _ = boot;
            None
        }
    }

    /// Returns the family of the first sensor; `None` if this version does not support it.
    pub fn family(&self) -> Option<Family> {
        Family::of_number(self.contents.family)
    }

    /// Returns the model of a rotating scanner, from a status or from the first packets.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`telegrams`](Self::telegrams), and [`Kind::Input`] if nothing in the recording defines
    /// how its packets must be read.
    pub fn model(&self) -> Result<Option<Model>, Failure> {
        let Some(family) = self.family().filter(|family| !features(*family).models.is_empty()) else {
            return Ok(None);
        };
        let mut models = features(family).models.iter();
        if let Some(reported) = models.find(|it| Some(it.name) == self.contents.model) {
            return Ok(Some(*reported));
        }
        let settings = Settings { fixed_rate: true, listen_only: true, ..Settings::default() };
        let mut session = VirtualTime::new(Session::begin(family, &settings, 0), 0);
        let mut frames = self.telegrams(Encoding::default())?;
        let mut model = None;
        for frame in frames.by_ref().take(MODEL_FRAMES) {
            session.take(0, &frame.telegram, |_| {});
            model = session.session().model();
            if model.is_some() {
                break;
            }
        }
        let missing = session.session().missing_setting();
        if let Some(missing) = missing.filter(|_| model.is_none() && self.contents.mode_name.is_none()) {
            return Err(Failure::new(
                Kind::Input,
                format!("recording {} does not say which kind of packets it has", self.path.display()),
                format!("`scanhub replay` plays it where link.NAME.{missing} is set"),
            ));
        }
        Ok(model)
    }

    /// Returns the number of beams in the scans of a rotating scanner, from the recorded scans or from a status.
    pub fn beams(&self) -> Option<usize> {
        let scans = self.contents.beams.map(usize::from);
        scans.or_else(|| {
            let (step, features) = (self.contents.step_cdeg?, features(self.family()?));
            let model = features.models.iter().find(|model| Some(model.name) == self.contents.model);
            let is_reported = |beams: &usize| (36_000.0 / *beams as f64).round() == f64::from(step);
            [model.map(|model| model.beams), Some(features.defaults.beams)]
                .into_iter()
                .flatten()
                .find(is_reported)
        })
    }

    /// Returns the settings of a session that reads the packets of this recording: model, mode and number of beams, if
    /// they are known.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`model`](Self::model).
    pub fn session_settings(&self) -> Result<Settings, Failure> {
        let model = self.model()?.map(|model| model.name);
        let (mode, beams) = (self.contents.mode_name, self.beams());
        Ok(Settings { model, mode, beams, fixed_rate: true, listen_only: true, ..Settings::default() })
    }

    /// Returns the path of the file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the contents of the recording, or of one sensor if [`of`](Self::of) selected a sensor.
    pub fn contents(&self) -> &Contents {
        &self.contents
    }

    /// Returns the unpacked bytes of the file. In a stream file, they are the bytes that a hub would read from the
    /// line.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Input`] if the file cannot be opened.
    pub fn bytes(&self) -> Result<Box<dyn Read + Send>, Failure> {
        Ok(reader(&self.path)?)
    }

    /// Returns the encoding of the values, if the recording contains this encoding. For a log, it is the encoding in
    /// which the ranges are whole values.
    pub fn encoding(&self) -> Option<Encoding> {
        Some(Encoding { unit: self.contents.unit?, mode: self.contents.mode? })
    }

    /// Returns the telegrams in order, including replies. The scans of a log are encoded as `encoding`, without loss if
    /// `encoding` is the one that [`encoding`](Self::encoding) returns. If the file becomes unreadable in the meantime,
    /// the telegrams end at that position.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Usage`] if there are several sensors and [`of`](Self::of) selected none, and [`Kind::Input`] if
    /// the file cannot be opened.
    pub fn telegrams(&self, encoding: Encoding) -> Result<Box<dyn Iterator<Item = Frame> + Send>, Failure> {
        let reader = reader(&self.path)?;
        Ok(match self.contents.form {
            Form::Carmen => {
                let (mut log, own) = (LogReader::new(reader), self.encoding().unwrap_or(encoding));
                Box::new(std::iter::from_fn(move || Some(log.next_valid()?.frame(own, encoding))))
            }
            Form::Telegrams => {
                let head =
                    head(&self.path, EXAMINED_BYTES).map_err(|error| unreadable(&self.path, &error))?;
                let mut stream = StreamReader::new(self.family().unwrap_or(Family::Lms), &head, reader);
                Box::new(std::iter::from_fn(move || stream.next().ok()?))
            }
            Form::Mcap => self.telegrams_of_sensor(reader)?,
        })
    }

    #[cfg(feature = "mcap")]
    fn telegrams_of_sensor(
        &self,
        reader: Box<dyn BufRead + Send>,
    ) -> Result<Box<dyn Iterator<Item = Frame> + Send>, Failure> {
        let sensor = match (&self.sensor, &self.contents.sensors[..]) {
            (Some(sensor), _) | (None, [sensor]) => sensor.clone(),
            (None, []) => return Ok(Box::new(std::iter::empty())),
            (None, _) => {
                let message = format!("recording {} has several sensors", self.path.display());
                return Err(Failure::new(Kind::Usage, message, self.sensor_choice()));
            }
        };
        Ok(Box::new(self.summary.frames(reader, sensor)))
    }

    #[cfg(not(feature = "mcap"))]
    fn telegrams_of_sensor(
        &self,
        _: Box<dyn BufRead + Send>,
    ) -> Result<Box<dyn Iterator<Item = Frame> + Send>, Failure> {
        // A build without the feature never opens an MCAP file.
        Ok(Box::new(std::iter::empty()))
    }

    /// Returns a reader of all records of an MCAP file, and its channels.
    #[cfg(feature = "mcap")]
    pub(crate) fn reader(&self) -> Result<(Reader<impl Read + use<>>, &Catalog), Failure> {
        Ok((self.summary.reader(reader(&self.path)?), self.summary.catalog()))
    }

    /// Returns the names of the mounts whose angles are in the recording.
    pub fn mounts(&self) -> Vec<String> {
        #[cfg(feature = "mcap")]
        return self.summary.catalog().mounts();
        #[cfg(not(feature = "mcap"))]
        Vec::new()
    }

    /// Returns the angles of a mount and the telegrams of the mount's machine in the order of the file. If the file
    /// becomes unreadable in the meantime, the records end at that position.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Input`] if the file cannot be opened.
    #[cfg(feature = "mcap")]
    pub fn angles(&self, mount: &str) -> Result<Box<dyn Iterator<Item = MountRecord> + Send>, Failure> {
        Ok(Box::new(self.summary.angles(reader(&self.path)?, mount.to_owned())))
    }

    /// Returns no angles, because only MCAP files contain them.
    #[cfg(not(feature = "mcap"))]
    pub fn angles(&self, _: &str) -> Result<Box<dyn Iterator<Item = MountRecord> + Send>, Failure> {
        Ok(Box::new(std::iter::empty()))
    }

    /// Returns the sensor that [`of`](Self::of) selected.
    #[cfg(feature = "mcap")]
    pub(crate) fn selected_sensor(&self) -> Option<&String> {
        self.sensor.as_ref()
    }

    /// Returns the time at which the file was last written, in ns since 1970, or 0 if the time is unknown.
    #[cfg(feature = "mcap")]
    pub(crate) fn modified_ns(&self) -> u64 {
        let modified = std::fs::metadata(&self.path).and_then(|metadata| metadata.modified()).ok();
        let since = modified.and_then(|modified| modified.duration_since(std::time::UNIX_EPOCH).ok());
        since.map_or(0, |since| since.as_nanos() as u64)
    }

    /// Returns the failure for a file that has become unreadable.
    #[cfg(feature = "mcap")]
    pub(crate) fn read_failure(&self, error: &io::Error) -> Failure {
        unreadable(&self.path, error)
    }

    fn sensor_choice(&self) -> String {
        let sensors = &self.contents.sensors;
        let more = match sensors.len().saturating_sub(MAX_NAMED_SENSORS) {
            0 => String::new(),
            more => format!(" and {more} more"),
        };
        format!("choose one: {}{more}", sensors[..sensors.len().min(MAX_NAMED_SENSORS)].join(", "))
    }
}

/// Reads the stream file at `path`, whose bytes belong to the family `named`. If `named` is `None`, or if the file has
/// no telegram of this family, the family is recognized by the bytes.
///
/// # Errors
///
/// Returns [`Kind::Input`] if the file cannot be read, or if its family is neither named nor recognized.
fn stream_contents(path: &Path, named: Option<Family>) -> Result<Contents, Failure> {
    let head = head(path, EXAMINED_BYTES).map_err(|error| unreadable(path, &error))?;
    let contents_of = |family| stream::contents(path, family, &head);
    let of_named = named.map(contents_of).transpose()?;
    if let Some(contents) = of_named.as_ref().filter(|contents| contents.telegrams > 0) {
        return Ok(contents.clone());
    }
    match (family_of(&head), of_named) {
        (Some(family), _) => contents_of(family),
        (None, Some(contents)) => Ok(contents),
        (None, None) if bytes_by_family(&head)[0].1 == 0 => Err(without_telegram(path)),
        (None, None) => Err(unrecognized(path, &head)),
    }
}

/// Returns the first `len` bytes of the file at `path`, unpacked.
fn head(path: &Path, len: usize) -> io::Result<Vec<u8>> {
    let mut head = Vec::new();
    match open(path)?.take(len as u64).read_to_end(&mut head) {
        Err(error) if !is_truncation(&error) => Err(error),
        _ => Ok(head),
    }
}

/// Returns the failure for a stream file that starts with `head`, because no family accepts enough of these bytes.
fn unrecognized(path: &Path, head: &[u8]) -> Failure {
    let percent = |len: usize| 100 * len / head.len().max(1);
    let counts = bytes_by_family(head).map(|(family, len)| format!("{} {} %", family.name(), percent(len)));
    let message = format!(
        "the family of recording {} is not known: none takes half of its first {} bytes ({})",
        path.display(),
        head.len(),
        counts.join(", ")
    );
    let names = Family::ALL.map(Family::name).join(", ");
    let hint = format!(
        "name the family of the scanner, one of {names}: family=NAME of a link, or --family NAME of the command"
    );
    Failure::new(Kind::Input, message, hint)
}

/// Returns the failure for a file that is not a recording.
fn without_telegram(path: &Path) -> Failure {
    let message = format!(
        "recording {} is neither an MCAP file nor a CARMEN log, and there is no telegram in it",
        path.display()
    );
    Failure::new(
        Kind::Input,
        message,
        format!("{FORMS_REMEDY}; a link to a file without a valid telegram needs family=NAME"),
    )
}

/// Returns whether `error` means that a packed file ends early or is damaged, in contrast to an error of the disk.
pub(crate) fn is_truncation(error: &io::Error) -> bool {
    use io::ErrorKind::{InvalidData, InvalidInput, UnexpectedEof};
    matches!(error.kind(), InvalidData | InvalidInput | UnexpectedEof)
}

pub(crate) fn reader(path: &Path) -> Result<Box<dyn BufRead + Send>, Failure> {
    open(path).map_err(|error| unreadable(path, &error))
}

fn open(path: &Path) -> io::Result<Box<dyn BufRead + Send>> {
    let mut file = BufReader::with_capacity(BUFFER_LEN, regular_file::open(path)?);
    if file.fill_buf()?.starts_with(GZIP_MAGIC) {
        return Ok(Box::new(BufReader::with_capacity(BUFFER_LEN, GzipReader::new(file))));
    }
    Ok(Box::new(file))
}

/// Returns a description if the file at `path` is a piece of an MCAP file, and `None` for any other file. Without this
/// check, the telegrams in such a piece would look like a stream file.
fn mcap_fragment(path: &Path) -> io::Result<Option<&'static str>> {
    let mut file = regular_file::open(path)?;
    let end = file.metadata()?.len().saturating_sub(MCAP_MAGIC.len() as u64);
    file.seek(SeekFrom::Start(end))?;
    let mut tail = Vec::new();
    file.read_to_end(&mut tail)?;
    if tail == MCAP_MAGIC {
        return Ok(Some("the end"));
    }
    #[cfg(feature = "mcap")]
    if crate::mcap::has_record_boundary(&head(path, SEARCH_LEN)?) {
        return Ok(Some("a piece"));
    }
    Ok(None)
}

pub(crate) fn unreadable(path: &Path, error: &io::Error) -> Failure {
    let hint = match error.kind() {
        io::ErrorKind::NotFound => "give the path of an existing recording",
        io::ErrorKind::PermissionDenied => "the file must be readable by this user",
        io::ErrorKind::UnexpectedEof => "the gzip file is cut: `zcat FILE > WHOLE` saves the intact part",
        io::ErrorKind::Unsupported => "`mcap compress --compression none IN -o OUT` (of mcap.dev) unpacks it",
        io::ErrorKind::FileTooLarge => {
            "`zcat FILE > WHOLE` unpacks a packed file; `mcap filter --output-compression none IN -o OUT` (of mcap.dev) \
             writes short chunks, and with -y TOPIC only some topics"
        }
        _ => FORMS_REMEDY,
    };
    Failure::new(Kind::Input, format!("cannot read recording {}: {error}", path.display()), hint)
}

fn unusable(path: &Path, what: &str) -> Failure {
    Failure::new(Kind::Input, format!("recording {} {what}", path.display()), FORMS_REMEDY)
}

/// Reader of a gzip file that limits the ratio of unpacked to packed bytes. A kilobyte can unpack to a megabyte of
/// equal bytes, so a file whose ratio is too large for a recording is rejected early.
struct GzipReader<R> {
    decoder: MultiGzDecoder<CountingReader<R>>,
    /// Number of unpacked bytes.
    unpacked: u64,
}

/// Reader that counts the bytes that it reads from `input`.
struct CountingReader<R> {
    input: R,
    read: u64,
}

impl<R: BufRead> GzipReader<R> {
    fn new(input: R) -> Self {
        GzipReader { decoder: MultiGzDecoder::new(CountingReader { input, read: 0 }), unpacked: 0 }
    }
}

impl<R: BufRead> Read for GzipReader<R> {
    /// Reads unpacked bytes. Returns [`ErrorKind::FileTooLarge`] if the unpacked bytes are more than [`MAX_RATIO`]
    /// times the packed bytes so far.
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let len = self.decoder.read(buffer)?;
        self.unpacked += len as u64;
        let max = self.decoder.get_ref().read.saturating_mul(MAX_RATIO).max(MIN_LIMITED_LEN);
        if self.unpacked > max {
            let what =
                format!("it unpacks to more than {MAX_RATIO} times its length, which no recording does");
            return Err(io::Error::new(ErrorKind::FileTooLarge, what));
        }
        Ok(len)
    }
}

impl<R: BufRead> Read for CountingReader<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let len = self.input.read(buffer)?;
        self.read += len as u64;
        Ok(len)
    }
}

impl<R: BufRead> BufRead for CountingReader<R> {
    fn fill_buf(&mut self) -> io::Result<&[u8]> {
        self.input.fill_buf()
    }

    fn consume(&mut self, len: usize) {
        self.read += len as u64;
        self.input.consume(len);
    }
}

/// Maximum number of sensors that a failure names.
const MAX_NAMED_SENSORS: usize = 32;
const FORMS_REMEDY: &str =
    "a recording is an MCAP file, a stream of telegrams or a CARMEN log, plain or gzipped";
/// First bytes of a gzip file.
const GZIP_MAGIC: &[u8] = &[0x1F, 0x8B];
/// First bytes of an MCAP file.
const MCAP_MAGIC: &[u8] = b"\x89MCAP0\r\n";
/// Number of bytes at the beginning of a file that are searched for records of MCAP. They hold several samples of any
/// topic.
#[cfg(feature = "mcap")]
const SEARCH_LEN: usize = 256 * 1024;
/// Size of a read buffer in bytes. A CARMEN log is detected by the lines in the first buffer.
const BUFFER_LEN: usize = 64 * 1024;
/// Maximum number of frames that are read to detect the model by the packets.
const MODEL_FRAMES: usize = 500;
/// Maximum ratio of unpacked to packed bytes. A stream of equal telegrams has a ratio of 100; the format allows 1,000.
const MAX_RATIO: u64 = 400;
/// Number of unpacked bytes up to which the ratio is not limited.
const MIN_LIMITED_LEN: u64 = 32 << 20;

#[cfg(test)]
mod tests {
    use std::io::Write;

    use flate2::Compression;
    use flate2::write::GzEncoder;

    use super::*;

    fn packed(byte: impl Fn(usize) -> u8, len: usize) -> Vec<u8> {
        let mut encoder = GzEncoder::new(Vec::new(), Compression::best());
        for begin in (0..len).step_by(1 << 16) {
            let piece: Vec<u8> = (begin..len.min(begin + (1 << 16))).map(&byte).collect();
            encoder.write_all(&piece).unwrap();
        }
        encoder.finish().unwrap()
    }

    /// Returns the number of unpacked bytes, and the error at which the reader ended, if any.
    fn unpacked(packed: &[u8]) -> (usize, Result<(), ErrorKind>) {
        let (mut input, mut buffer, mut len) = (GzipReader::new(packed), vec![0; 1 << 16], 0);
        loop {
            match input.read(&mut buffer) {
                Ok(0) => return (len, Ok(())),
                Ok(read) => len += read,
                Err(error) => return (len, Err(error.kind())),
            }
        }
    }

    #[test]
    fn rejects_gzip_bomb_early() {
        let max = MIN_LIMITED_LEN as usize;
        assert_eq!(unpacked(&packed(|_| 0, max)), (max, Ok(())), "short enough for any ratio");
        let (len, end) = unpacked(&packed(|_| 0, 3 * max));
        assert!(len <= max && end == Err(ErrorKind::FileTooLarge), "{len} {end:?}");
        // The telegrams are equal, as from an empty room.
        let telegram = |at: usize| (at % 732) as u8 ^ ((at % 732) >> 8) as u8;
        assert_eq!(unpacked(&packed(telegram, 2 * max)), (2 * max, Ok(())));
    }
}
