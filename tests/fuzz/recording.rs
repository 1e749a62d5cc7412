//! Invariants for recordings. A file is refused, or it can be read to its end twice, with the same result. The
//! telegrams in it are valid.

use std::fs;

use scanhub_drivers::lms::telegram::Telegram;
use scanhub_drivers::lms::variant::{Mode, Unit};
use scanhub_recording::{Encoding, Form, Recording};
use scanhub_schema::Family;
use tempfile::NamedTempFile;

/// Opens a file with the bytes of `data` as a recording.
pub(crate) fn recording(data: &[u8]) {
    let file = NamedTempFile::new().expect("a temporary file");
    fs::write(&file, data).expect("a writable file");
    let Ok(recording) = Recording::open(file.path()) else { return };
    let contents = recording.contents();
    let mut telegrams = 0;
    if contents.sensors.is_empty() {
        telegrams += read(&recording);
    }
    for sensor in &contents.sensors {
        let part = recording.of(sensor).expect("a sensor that it names");
        telegrams += read(&part);
    }
    assert_eq!(telegrams, contents.telegrams, "{contents:?}");
    assert!(contents.scans <= contents.telegrams);
}

/// Reads all telegrams, and checks that there are as many as the table of contents states. Returns the number of
/// telegrams.
fn read(recording: &Recording) -> u64 {
    let (contents, encoding) = (recording.contents(), Encoding { unit: Unit::Mm, mode: Mode(1) });
    let mut telegrams = 0;
    for frame in recording.telegrams(encoding).expect("it was chosen") {
        telegrams += 1;
        // Leave out MCAP files. With valid checksums of the file, they can contain any bytes as a telegram.
        if contents.form != Form::Mcap && contents.family == Family::Lms as u8 {
            assert!(Telegram::check(&frame.telegram).is_some());
        }
    }
    assert_eq!(telegrams, contents.telegrams, "{contents:?}");
    telegrams
}
