//! The telegrams of a container file, as the bytes of a line. Refuses to know what they mean.

use std::collections::VecDeque;
use std::fs::File;
use std::io::{self, Read};
use std::path::Path;

use recording::{Encoding, Form, Frame, Recording};
use scanhub_drivers::lms::variant::{Mode, Unit};
use schema::{Failure, Family, Kind};

/// Bytes, and the measuring mode of their values where the recording tells it.
type Unpacked = (Box<dyn Read>, Option<Mode>);

/// Whether the file at `path` is one; a pipe is not asked, because what is read from it is gone.
pub(super) fn is_framed(path: &Path) -> bool {
    let mut head = [0; 8];
    let is_file = path.metadata().is_ok_and(|metadata| metadata.is_file());
    is_file
        && File::open(path)
            .and_then(|mut file| file.read(&mut head))
            .is_ok_and(|len| Recording::is_framed(&head[..len]))
}

/// The telegrams in the recording at `path`, of `sensor` if it has several.
///
/// [`Kind::Input`] if it cannot be read or has no telegrams; [`Kind::NoTopic`] if it has no such sensor; [`Kind::Usage`] if
/// it has several and none is chosen, or one is and it does not name them.
pub(super) fn open(path: &Path, sensor: Option<&str>) -> Result<Unpacked, Failure> {
    let mut recording = Recording::open(path)?;
    if let Some(sensor) = sensor {
        recording = recording.of(sensor)?;
    }
    let contents = recording.contents();
    if !contents.is_lms() {
        let family = recording.family().map_or("that is not known here", Family::name);
        let message = format!(
            "{} has packets of a scanner of family {family}, not telegrams of an LMS",
            path.display()
        );
        return Err(Failure::new(Kind::Input, message, "`scanhub convert IN OUT.csv` makes scans of them"));
    }
    if !contents.damage.is_none() {
        tracing::warn!("{}: missing: {}", path.display(), contents.damage);
    }
    match contents.form {
        Form::Telegrams => Ok((recording.bytes()?, None)),
        Form::Mcap => {
            let mode = contents.mode;
            // Nothing of it is encoded here.
            let encoding = Encoding { unit: Unit::Mm, mode: mode.unwrap_or(Mode(0)) };
            let bytes = Bytes { telegrams: recording.telegrams(encoding)?, left: VecDeque::new() };
            Ok((Box::new(bytes), mode))
        }
        Form::Carmen => {
            let message = format!("{} is a CARMEN log, which has ranges and no telegrams", path.display());
            let hint = "`scanhub convert IN OUT.bin` makes telegrams of them";
            Err(Failure::new(Kind::Input, message, hint))
        }
    }
}

/// Telegrams as bytes.
struct Bytes {
    telegrams: Box<dyn Iterator<Item = Frame> + Send>,
    left: VecDeque<u8>,
}

impl Read for Bytes {
    fn read(&mut self, room: &mut [u8]) -> io::Result<usize> {
        if self.left.is_empty() {
            self.left = self.telegrams.next().map(|frame| frame.telegram.into()).unwrap_or_default();
        }
        self.left.read(room)
    }
}
