//! The output file of a conversion: it appears complete, or not at all. Refuses to know what is in it.

use std::ffi::OsString;
use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use schema::{Failure, Kind};

/// Where it shall be.
pub(super) struct Place {
    path: PathBuf,
    /// Where it is until it is whole; `None` on stdout.
    beside: Option<PathBuf>,
}

impl Place {
    /// Looks whether there may be a file made of `input` at `path`; what is there may be replaced if `force`.
    pub(super) fn check(path: &Path, input: &Path, force: bool) -> Result<Place, Failure> {
        let refuse = |message: String, hint: &str| Err(Failure::new(Kind::Output, message, hint));
        if path == Path::new("-") {
            return Ok(Place { path: path.to_owned(), beside: None });
        }
        if let (Ok(old), Ok(input)) = (fs::metadata(path), fs::metadata(input)) {
            if (old.dev(), old.ino()) == (input.dev(), input.ino()) {
                let hint = "write into another file, look at it, and then replace the first one";
                return refuse(format!("{} is both read and written", path.display()), hint);
            }
            if !old.is_file() {
                return refuse(format!("{} is no file", path.display()), "name a file, or - for stdout");
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
        Ok(Place { path: path.to_owned(), beside: Some(path.with_file_name(hidden)) })
    }

    /// Whether `error` says that the reader of stdout closed it.
    pub(super) fn is_closed(&self, error: &io::Error) -> bool {
        self.beside.is_none() && error.kind() == io::ErrorKind::BrokenPipe
    }

    /// Begins to write.
    pub(super) fn create(&self) -> Result<BufWriter<Box<dyn Write>>, Failure> {
        let file: Box<dyn Write> = match &self.beside {
            None => Box::new(io::stdout()),
            Some(beside) => Box::new(File::create(beside).map_err(|error| unwritable(&self.path, &error))?),
        };
        Ok(BufWriter::with_capacity(BUFFER, file))
    }

    /// Completes the output. `false` if the reader of stdout closed it before that.
    pub(super) fn put(mut self, mut file: BufWriter<Box<dyn Write>>) -> Result<bool, Failure> {
        let put = || {
            file.flush()?;
            drop(file);
            let Some(beside) = &self.beside else { return Ok(()) };
            File::open(beside)?.sync_all()?;
            fs::rename(beside, &self.path)
        };
        match put() {
            Err(error) if self.is_closed(&error) => return Ok(false),
            put => put.map_err(|error| unwritable(&self.path, &error))?,
        }
        self.beside = None;
        Ok(true)
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        if let Some(beside) = &self.beside {
            let _ = fs::remove_file(beside);
        }
    }
}

pub(super) fn unwritable(path: &Path, error: &io::Error) -> Failure {
    let hint = "the directory must exist, be writable and have free space";
    Failure::new(Kind::Output, format!("cannot write {}: {error}", path.display()), hint)
}

const BUFFER: usize = 1 << 20;
