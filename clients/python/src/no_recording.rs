//! Replaces `recording.rs` in builds without the feature `read`.

use std::path::PathBuf;

use pyo3::prelude::*;

use crate::error::Error;

/// Recording that this build cannot read.
#[pyclass(frozen, module = "scanhub")]
pub(crate) struct Recording;

#[pymethods]
impl Recording {
    #[new]
    #[expect(unused_variables, reason = "the arguments are those of the class that reads")]
    fn new(
        file: PathBuf,
        topics: Vec<String>,
        sensor: Option<String>,
        config: Option<PathBuf>,
        family: Option<String>,
        set: Vec<String>,
        system_config: bool,
    ) -> Result<Recording, Error> {
        let what = "this build of the package scanhub does not read recordings";
        Err(Error::new(
            "Failure",
            what,
            "install a wheel of the project, or build with the Cargo feature read",
        ))
    }
}
