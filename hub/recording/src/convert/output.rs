//! The output of a conversion. A file appears complete, or not at all.

use std::ffi::OsString;
use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use flate2::write::GzEncoder;
use schema::{Failure, Kind};

/// Path of the output, and the hidden file next to it that is written until it is complete.
pub(super) struct Place {
    path: PathBuf,
    /// The hidden file; `None` for stdout.
    hidden: Option<PathBuf>,
}

impl Place {
    /// Checks that the file at `path` may be created from `input`, or replaced if `force`.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Output`] if it may not.
    pub(super) fn check(path: &Path, input: &Path, force: bool) -> Result<Place, Failure> {
        let refuse = |message: String, hint: &str| Err(Failure::new(Kind::Output, message, hint));
        if path == Path::new("-") {
            return Ok(Place { path: path.to_owned(), hidden: None });
        }
        if let (Ok(old), Ok(input)) = (fs::metadata(path), fs::metadata(input)) {
            if (old.dev(), old.ino()) == (input.dev(), input.ino()) {
                let hint = "write into another file, look at it, and then replace the first one";
                return refuse(format!("{} is both read and written", path.display()), hint);
            }
            if !old.is_file() {
                return refuse(format!("{} is not a file", path.display()), "name a file, or - for stdout");
            }
            if !force {
                let message = format!("{} exists", path.display());
                return refuse(message, "--force replaces it");
            }
        }
        let Some(name) = path.file_name() else {
            return refuse(format!("{} is not a file name", path.display()), "name a file, or - for stdout");
        };
        let mut hidden = OsString::from(".");
        hidden.push(name);
        hidden.push(format!(".{}", std::process::id()));
        Ok(Place { path: path.to_owned(), hidden: Some(path.with_file_name(hidden)) })
    }

    /// Returns whether `error` means that the reader of stdout closed it.
    pub(super) fn is_closed(&self, error: &io::Error) -> bool {
        self.hidden.is_none() && error.kind() == io::ErrorKind::BrokenPipe
    }

    /// Creates the output.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Output`] if the file cannot be created.
    pub(super) fn create(&self) -> Result<BufWriter<Box<dyn Write>>, Failure> {
        let file: Box<dyn Write> = match &self.hidden {
            None => Box::new(io::stdout()),
            Some(hidden) => Box::new(File::create(hidden).map_err(|error| unwritable(&self.path, &error))?),
        };
        Ok(BufWriter::with_capacity(BUFFER, file))
    }

    /// Completes the output. Returns `false` if the reader of stdout closed it before.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Output`] if the file cannot be written or renamed.
    pub(super) fn put(mut self, mut file: BufWriter<Box<dyn Write>>) -> Result<bool, Failure> {
        let put = || {
            file.flush()?;
            drop(file);
            let Some(hidden) = &self.hidden else { return Ok(()) };
            File::open(hidden)?.sync_all()?;
            fs::rename(hidden, &self.path)
        };
        match put() {
            Err(error) if self.is_closed(&error) => return Ok(false),
            put => put.map_err(|error| unwritable(&self.path, &error))?,
        }
        self.hidden = None;
        Ok(true)
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        if let Some(hidden) = &self.hidden {
            let _ = fs::remove_file(hidden);
        }
    }
}

/// Output that is compressed by gzip if the name of the file ends with `.gz`.
pub(super) enum Packing<W: Write> {
    Plain(W),
    Gzip(GzEncoder<W>),
}

impl<W: Write> Packing<W> {
    pub(super) fn of(path: &Path, file: W) -> Self {
        match path.extension() {
            Some(ending) if ending.eq_ignore_ascii_case("gz") => {
                Packing::Gzip(GzEncoder::new(file, flate2::Compression::default()))
            }
            _ => Packing::Plain(file),
        }
    }

    pub(super) fn write_all(&mut self, bytes: &[u8]) -> io::Result<()> {
        match self {
            Packing::Plain(file) => file.write_all(bytes),
            Packing::Gzip(encoder) => encoder.write_all(bytes),
        }
    }

    pub(super) fn finish(self) -> io::Result<()> {
        match self {
            Packing::Plain(_) => Ok(()),
            Packing::Gzip(encoder) => encoder.finish().map(drop),
        }
    }
}

pub(super) fn unwritable(path: &Path, error: &io::Error) -> Failure {
    let hint = "the directory must exist, be writable and have free space";
    Failure::new(Kind::Output, format!("cannot write {}: {error}", path.display()), hint)
}

const BUFFER: usize = 1 << 20;
