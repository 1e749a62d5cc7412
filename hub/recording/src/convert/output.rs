//! The output of a conversion: a file that appears complete or not at all, or stdout.

use std::io::{self, Write};
use std::os::unix::fs::MetadataExt;
use std::path::Path;

use flate2::write::GzEncoder;
use scanhub_files::output::OutputFile;
use schema::{Failure, Kind};

/// Output of a conversion.
pub(super) enum Output {
    Stdout(io::Stdout),
    File(OutputFile),
}

impl Output {
    /// Creates the output at `path`, which may replace another file than `input` if `force`. `-` is stdout.
    ///
    /// # Errors
    ///
    /// Those of [`OutputFile::create`], and [`Kind::Output`] if `path` is the input.
    pub(super) fn create(path: &Path, input: &Path, force: bool) -> Result<Output, Failure> {
        if path == Path::new("-") {
            return Ok(Output::Stdout(io::stdout()));
        }
        let id = |path: &Path| path.metadata().map(|metadata| (metadata.dev(), metadata.ino())).ok();
        if id(path).is_some_and(|output| id(input) == Some(output)) {
            let hint = "write into another file, look at it, and then replace the first one";
            let message = format!("{} is both read and written", path.display());
            return Err(Failure::new(Kind::Output, message, hint));
        }
        OutputFile::create(path, force).map(Output::File)
    }

    /// Returns whether `error` means that the reader of stdout closed it.
    pub(super) fn is_closed(path: &Path, error: &io::Error) -> bool {
        path == Path::new("-") && error.kind() == io::ErrorKind::BrokenPipe
    }

    /// Completes the output.
    ///
    /// # Errors
    ///
    /// Those of [`OutputFile::commit`].
    pub(super) fn commit(self) -> Result<(), Failure> {
        match self {
            Output::Stdout(_) => Ok(()),
            Output::File(file) => file.commit(),
        }
    }
}

impl Write for Output {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        match self {
            Output::Stdout(stdout) => stdout.write(bytes),
            Output::File(file) => file.write(bytes),
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        match self {
            Output::Stdout(stdout) => stdout.flush(),
            Output::File(file) => file.flush(),
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
