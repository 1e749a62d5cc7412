//! Files and conversions in the temporary directory of a test.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use scanhub_recording::convert::{ConversionResult, ConvertOptions, convert};
use scanhub_schema::Failure;
use tempfile::TempDir;

/// Writes a file into `folder`, and returns its path.
pub(crate) fn file(folder: &TempDir, name: &str, bytes: &[u8]) -> PathBuf {
    let path = folder.path().join(name);
    fs::write(&path, bytes).unwrap();
    path
}

pub(crate) fn convert_file(
    input: &Path,
    output: &Path,
    sensor: Option<&str>,
) -> Result<ConversionResult, Failure> {
    let options = ConvertOptions {
        input: input.to_owned(),
        output: output.to_owned(),
        sensor: sensor.map(str::to_owned),
        ..ConvertOptions::default()
    };
    convert(&options, &AtomicBool::new(false), |_, _| {})
}
