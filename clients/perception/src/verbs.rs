//! The verbs that subscribe to scans, and print and publish the results of [`track`](mod@crate::track) and
//! [`tilt`](mod@crate::tilt).

mod tilt;
mod track;

use std::path::Path;

use scanhub_files::regular;
use scanhub_schema::{Failure, Kind};

use crate::track::Site;

pub use tilt::{TiltOptions, tilt};
pub use track::{TrackOptions, track};

impl Site {
    /// Reads the site file at `path`.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Input`] if the file cannot be read, and the errors of [`Site::parse`].
    pub fn read(path: &Path) -> Result<Site, Failure> {
        let text = regular::read_text(path, regular::LONGEST).map_err(|error| {
            let message = format!("{}: {error}", path.display());
            Failure::new(Kind::Input, message, "name a readable site file; docs/tracks.md has one")
        })?;
        Site::parse(&path.display().to_string(), &text)
    }
}
