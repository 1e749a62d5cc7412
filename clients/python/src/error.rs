//! Conversion of errors to exceptions of the Python package.

use std::ffi::CString;

use pyo3::prelude::*;
use pyo3::sync::PyOnceLock;
use pyo3::types::{PyModule, PyTuple};

/// Error, with the name of its exception in `scanhub.errors`.
#[derive(Debug)]
pub(crate) struct Error {
    pub(crate) class: &'static str,
    message: String,
    remedy: String,
}

impl Error {
    pub(crate) fn new(class: &'static str, message: impl Into<String>, remedy: impl Into<String>) -> Error {
        Error { class, message: message.into(), remedy: remedy.into() }
    }

    /// Returns this error with `what` before its message.
    pub(crate) fn after(self, what: &str) -> Error {
        Error { message: format!("{what}: {}", self.message), ..self }
    }

    /// Issues this error as the warning `SilenceWarning`. Returns an exception if the program treats warnings as
    /// errors.
    pub(crate) fn warn(&self, py: Python<'_>) -> PyResult<()> {
        let text = format!("nothing yet: {}\n  {}", self.message, self.remedy);
        let category = PyModule::import(py, "scanhub.errors")?.getattr("SilenceWarning")?;
        PyErr::warn(py, &category, &CString::new(text)?, 1)
    }
}

impl From<Error> for PyErr {
    fn from(error: Error) -> PyErr {
        let Error { class, message, remedy } = error;
        Python::attach(|py| {
            let raised = PyModule::import(py, "scanhub.errors")
                .and_then(|errors| errors.getattr(class)?.call1((message, remedy)));
            raised.map_or_else(|error| error, PyErr::from_value)
        })
    }
}

/// Creates a value of the class `name` of `scanhub.values`, a named tuple or a dataclass.
pub(crate) fn value<'py>(
    py: Python<'py>,
    name: &str,
    fields: impl IntoPyObject<'py, Target = PyTuple, Output = Bound<'py, PyTuple>, Error = PyErr>,
) -> PyResult<Bound<'py, PyAny>> {
    static VALUES: PyOnceLock<Py<PyModule>> = PyOnceLock::new();
    let values = VALUES.get_or_try_init(py, || PyModule::import(py, "scanhub.values").map(Bound::unbind))?;
    values.bind(py).getattr(name)?.call1(fields.into_pyobject(py)?)
}
