//! Replacement of `recording.rs` in builds without the feature `read`.

use pyo3::prelude::*;
use pyo3::types::{PyDict, PyTuple};

use crate::error::Error;

/// Recording that this build cannot read.
#[pyclass(frozen, module = "scanhub")]
pub(crate) struct Recording;

#[pymethods]
impl Recording {
    #[new]
    #[pyo3(signature = (*_args, **_kwargs))]
    fn new(_args: &Bound<'_, PyTuple>, _kwargs: Option<&Bound<'_, PyDict>>) -> Result<Recording, Error> {
        let what = "this build of the package scanhub does not read recordings";
        let remedy = "install a wheel of the project, or build with the Cargo feature read";
        Err(Error::new("Failure", what, remedy))
    }
}
