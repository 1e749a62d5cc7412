//! A directory of one test, and conversions in it.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use recording::convert::{ConvertOptions, Converted, convert};
use schema::Failure;

/// A directory of this test that is gone with it.
pub(crate) struct Folder(pub(crate) PathBuf);

impl Folder {
    pub(crate) fn new(name: &str) -> Folder {
        let path = std::env::temp_dir().join(format!("scanhub-convert-{}-{name}", std::process::id()));
        fs::create_dir_all(&path).unwrap();
        Folder(path)
    }

    pub(crate) fn file(&self, name: &str, bytes: &[u8]) -> PathBuf {
        let path = self.0.join(name);
        fs::write(&path, bytes).unwrap();
        path
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

pub(crate) fn converted(input: &Path, output: &Path, sensor: Option<&str>) -> Result<Converted, Failure> {
    let options = ConvertOptions {
        input: input.to_owned(),
        output: output.to_owned(),
        sensor: sensor.map(str::to_owned),
        ..ConvertOptions::default()
    };
    convert(&options, &AtomicBool::new(false), |_, _| {})
}
