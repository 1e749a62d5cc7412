//! What has to hold whatever is in a file: a recording is refused or read to its end, twice the same, and its telegrams
//! are telegrams.

use std::fs;
use std::path::PathBuf;
use std::sync::atomic::{AtomicU64, Ordering};

use lms::telegram::Telegram;
use lms::variant::{Mode, Unit};
use recording::{Encoding, Form, Recording};
use schema::Family;

/// Any bytes as a file.
pub(crate) fn recording(data: &[u8]) {
    let file = File::of(data);
    let Ok(recording) = Recording::open(&file.0) else { return };
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

/// How many telegrams it gives; as many as it says.
fn read(recording: &Recording) -> u64 {
    let (contents, encoding) = (recording.contents(), Encoding { unit: Unit::Mm, mode: Mode(1) });
    let mut telegrams = 0;
    for frame in recording.telegrams(encoding).expect("it was chosen") {
        telegrams += 1;
        // In an MCAP file with right checksums, anything can stand where a telegram should be.
        if contents.form != Form::Mcap && contents.family == Family::Lms as u8 {
            assert!(Telegram::check(&frame.telegram).is_some());
        }
    }
    assert_eq!(telegrams, contents.telegrams, "{contents:?}");
    telegrams
}

/// A file of its own, also where several targets run at once.
struct File(PathBuf);

impl File {
    fn of(data: &[u8]) -> File {
        static NUMBER: AtomicU64 = AtomicU64::new(0);
        let number = NUMBER.fetch_add(1, Ordering::Relaxed);
        let path = std::env::temp_dir().join(format!("scanhub-fuzz-{}-{number}", std::process::id()));
        fs::write(&path, data).expect("a file for temporary things");
        File(path)
    }
}

impl Drop for File {
    fn drop(&mut self) {
        let _ = fs::remove_file(&self.0);
    }
}
