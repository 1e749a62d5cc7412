//! Opens a recording by what is in it, not by its name, and reads it through once: what it holds is known, and what
//! is wrong with it is said, before anything is sent from it. Nothing is kept in memory.

use std::fs::File;
use std::io::{self, BufRead, BufReader, Read};
use std::path::{Path, PathBuf};

use flate2::bufread::MultiGzDecoder;
use lms::measured::{MEASURED, Measured};
use lms::reply::Reply;
use lms::telegram::Telegram;
use lms::variant::{Mode, Unit, Variant};
use schema::{Failure, Kind};

use crate::Frame;
use crate::carmen;
use crate::stream::Telegrams;

/// What kind of recording it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Form {
    /// Bytes as they came down a line.
    Telegrams,
    /// A CARMEN log.
    Carmen,
}

/// What a recording holds, and what it says of the sensor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Contents {
    /// Its form.
    pub form: Form,
    /// Number of whole telegrams; of a log, of scans.
    pub telegrams: u64,
    /// How many of them are measured values (B0h).
    pub scans: u64,
    /// Variant of the first scan.
    pub variant: Option<Variant>,
    /// Unit of the first scan; a log has none, its metres become what is asked for.
    pub unit: Option<Unit>,
    /// Measuring mode, where a configuration reply (F4h) tells it.
    pub mode: Option<Mode>,
}

/// How a log's metres become value words; a telegram stream is what it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Encoding {
    /// Unit of the ranges.
    pub unit: Unit,
    /// How the 16 bits of a value are split.
    pub mode: Mode,
}

/// A recording that could be read to its end.
#[derive(Clone, Debug)]
pub struct Recording {
    path: PathBuf,
    contents: Contents,
}

impl Recording {
    /// Opens and reads through the file at `path`.
    pub fn open(path: impl Into<PathBuf>) -> Result<Recording, Failure> {
        let path = path.into();
        let mut reader = reader(&path)?;
        let head = reader.fill_buf().map_err(|error| unreadable(&path, &error))?;
        if head.is_empty() {
            return Err(refused(&path, "is empty"));
        }
        if head.starts_with(MCAP) {
            return Err(refused(&path, "is an MCAP file, which is not among the forms read here"));
        }
        let form = if carmen::is_log(head) { Form::Carmen } else { Form::Telegrams };
        let contents = match form {
            Form::Carmen => survey_log(&path, reader)?,
            Form::Telegrams => survey_stream(&path, reader)?,
        };
        Ok(Recording { path, contents })
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// What is in it.
    pub fn contents(&self) -> &Contents {
        &self.contents
    }

    /// The file's bytes, unpacked, from the beginning; of a telegram stream what a hub would have read from the line.
    pub fn bytes(&self) -> Result<Box<dyn Read + Send>, Failure> {
        Ok(reader(&self.path)?)
    }

    /// Its telegrams in order, replies too; a log's scans as `encoding` says. Should the file become unreadable in the
    /// meantime, they end there.
    pub fn telegrams(&self, encoding: Encoding) -> Result<Box<dyn Iterator<Item = Frame> + Send>, Failure> {
        let mut reader = reader(&self.path)?;
        Ok(match self.contents.form {
            Form::Carmen => {
                let mut line = 0;
                Box::new(std::iter::from_fn(move || {
                    let sweep = carmen::next(&mut reader, &mut line).ok()??;
                    Some(sweep.frame(encoding.unit, encoding.mode))
                }))
            }
            Form::Telegrams => {
                let mut telegrams = Telegrams::new(reader);
                Box::new(std::iter::from_fn(move || {
                    Some(Frame { telegram: telegrams.next().ok()??, wall_ns: None })
                }))
            }
        })
    }
}

impl Frame {
    /// Whether it is a telegram of measured values (B0h), which is what a sensor streams.
    pub fn is_scan(&self) -> bool {
        self.telegram.get(4) == Some(&MEASURED)
    }
}

fn survey_log(path: &Path, mut reader: impl BufRead) -> Result<Contents, Failure> {
    let mut contents =
        Contents { form: Form::Carmen, telegrams: 0, scans: 0, variant: None, unit: None, mode: None };
    let mut line = 0;
    loop {
        let sweep = carmen::next(&mut reader, &mut line).map_err(|wrong| {
            let message = format!("{}:{line}: {wrong}", path.display());
            Failure::new(Kind::Configuration, message, "a scan is: FLASER 361 RANGE... in metres")
        })?;
        let Some(sweep) = sweep else { return Ok(contents) };
        contents.telegrams += 1;
        contents.scans += 1;
        contents.variant = contents.variant.or(sweep.variant());
    }
}

fn survey_stream(path: &Path, reader: impl Read) -> Result<Contents, Failure> {
    let mut contents =
        Contents { form: Form::Telegrams, telegrams: 0, scans: 0, variant: None, unit: None, mode: None };
    let mut telegrams = Telegrams::new(reader);
    while let Some(bytes) = telegrams.next().map_err(|error| unreadable(path, &error))? {
        contents.telegrams += 1;
        let Some(telegram) = Telegram::check(&bytes) else { continue };
        if let Some(Reply::Configuration(configuration)) = Reply::decode(telegram) {
            contents.mode = contents.mode.or(Some(configuration.mode()));
        }
        if let Some(measured) = Measured::decode(telegram) {
            contents.scans += 1;
            contents.variant = contents.variant.or(Variant::of_beams(measured.count()));
            contents.unit = contents.unit.or(Some(measured.unit()));
        }
    }
    Ok(contents)
}

fn reader(path: &Path) -> Result<Box<dyn BufRead + Send>, Failure> {
    let open = || -> io::Result<Box<dyn BufRead + Send>> {
        // A pipe or a device has no end, and would be waited for.
        if !std::fs::metadata(path)?.is_file() {
            return Err(io::Error::new(io::ErrorKind::InvalidInput, "it is no regular file"));
        }
        let mut file = BufReader::with_capacity(BUFFER, File::open(path)?);
        if file.fill_buf()?.starts_with(GZIP) {
            return Ok(Box::new(BufReader::with_capacity(BUFFER, MultiGzDecoder::new(file))));
        }
        Ok(Box::new(file))
    };
    open().map_err(|error| unreadable(path, &error))
}

fn unreadable(path: &Path, error: &io::Error) -> Failure {
    let hint = match error.kind() {
        io::ErrorKind::NotFound => "give the path of an existing recording",
        io::ErrorKind::PermissionDenied => "the file must be readable by this user",
        io::ErrorKind::UnexpectedEof => "the gzip file is cut: `zcat FILE > WHOLE` saves what is there",
        _ => FORMS,
    };
    Failure::new(Kind::Configuration, format!("cannot read recording {}: {error}", path.display()), hint)
}

fn refused(path: &Path, what: &str) -> Failure {
    Failure::new(Kind::Configuration, format!("recording {} {what}", path.display()), FORMS)
}

const FORMS: &str = "a recording is a stream of telegrams or a CARMEN log, plain or gzipped";
/// First bytes of a gzip file.
const GZIP: &[u8] = &[0x1F, 0x8B];
/// First bytes of an MCAP file.
const MCAP: &[u8] = b"\x89MCAP0\r\n";
/// Enough for the head of a log to show a line that tells it.
const BUFFER: usize = 64 * 1024;
