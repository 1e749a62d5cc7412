//! Samples, with header and payload in shared memory or in a copy, and numpy arrays of their data.

use std::any::Any;
use std::sync::Arc;

use bytemuck::{Pod, bytes_of, cast_slice, cast_slice_mut, pod_read_unaligned};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::sync::PyOnceLock;
use pyo3::types::{PyBytes, PyDict, PyFrozenSet, PyTuple};
use scanhub_client::{Background, Flags, Header, Reasons, Topic};

use crate::client::{Name, SharedPayload};
use crate::topics;

/// Payload of a sample.
#[expect(clippy::large_enum_variant, reason = "it is always behind an `Arc`")]
pub(crate) enum Memory {
    /// Payload in shared memory.
    Hub(SharedPayload),
    /// Copy of the payload, with its number of bytes.
    Copy(Vec<u64>, usize),
}

impl Memory {
    pub(crate) fn copy_of(bytes: &[u8]) -> Memory {
        let mut words = vec![0_u64; bytes.len().div_ceil(8)];
        cast_slice_mut(&mut words)[..bytes.len()].copy_from_slice(bytes);
        Memory::Copy(words, bytes.len())
    }

    /// Returns the used bytes.
    pub(crate) fn bytes(&self) -> &[u8] {
        match self {
            Memory::Hub(held) => held.bytes(),
            Memory::Copy(words, len) => &cast_slice(words)[..*len],
        }
    }

    /// Returns a payload of variable length as whole words.
    pub(crate) fn words(&self) -> &[u8] {
        match self {
            Memory::Hub(held) => held.words(),
            Memory::Copy(words, _) => cast_slice(words),
        }
    }
}

/// Implements the properties of a class, and then the methods after the `+`. Each property is an expression that uses
/// the object, the sample and the payload of the sample.
#[macro_export]
macro_rules! getters {
    (
        $class:ident($slf:ident, $sample:ident: $access:expr, $payload:ident) = $read:expr;
        $($(#[$($doc:tt)*])* $name:ident: $type:ty = $value:expr;)*
        $(+ { $($methods:tt)* })?
    ) => {
        #[pymethods]
        impl $class {
            $(
                $(#[$($doc)*])*
                #[getter]
                #[allow(unused_variables, clippy::extra_unused_lifetimes)]
                fn $name<'a, 'py>($slf: &'a Bound<'py, Self>) -> $type {
                    let $sample = $access;
                    let $payload = $read;
                    $value
                }
            )*

            $($($methods)*)?
        }
    };
}

/// A sample of any topic. The payload stays in shared memory until the sample and all of its arrays are dropped.
#[pyclass(subclass, frozen, module = "scanhub")]
#[derive(Clone)]
pub(crate) struct Sample {
    pub(crate) name: Name,
    /// Header of the sample. For zones that are unknown because of a silence, it is the header of the last sample.
    pub(crate) header: Header,
    pub(crate) missed: u64,
    pub(crate) restarted: bool,
    /// Whether zones are unknown because no recent data arrived.
    pub(crate) stale: bool,
    pub(crate) memory: Arc<Memory>,
}

getters! {
    Sample(slf, sample: slf.get(), header) = &sample.header;
    /// Name of the sensor.
    sensor: &'a str = &sample.name.sensor;
    /// Name of the topic.
    topic: &'a str = sample.name.topic.name();
    /// Samples of this topic that were sent before this one and not received.
    missed: u64 = sample.missed;
    /// Whether another run of the hub sent the previous sample, so that the numbers started again.
    restarted: bool = sample.restarted;
    /// Number of the telegram, per sensor and run of the hub, from 0. A status has the number of the last telegram.
    seq: u64 = header.seq;
    /// Number of the sample in its topic, from 0. A gap means missed samples.
    topic_seq: u64 = header.topic_seq;
    /// Stamp of the telegram's first byte, in ns of `time.monotonic_ns()`.
    stamp_ns: u64 = header.stamp_first_ns;
    /// Stamp of the telegram's last byte, in ns of `time.monotonic_ns()`.
    stamp_last_ns: u64 = header.stamp_last_ns;
    /// Wall clock of the telegram's first byte, in ns since 1970.
    wall_ns: u64 = header.wall_ns;
    /// Random number of the hub's run.
    boot: u64 = header.boot;
    /// `clean`, or `suspect` if the telegram may be damaged.
    quality: &'static str = if header.quality == 0 { "clean" } else { "suspect" };
    /// Reasons why the telegram is suspect.
    reasons: PyResult<Bound<'py, PyTuple>> = PyTuple::new(slf.py(), Reasons::names(header.reasons).collect::<Vec<_>>());
    /// Flags that are set: `simulated`, `replayed`, `stamp_estimated`, `remote`.
    flags: PyResult<Bound<'py, PyFrozenSet>> = PyFrozenSet::new(slf.py(), Flags::names(header.flags));
    /// Nominal period of the scans in microseconds; None if unknown.
    period_us: Option<u32> = Some(header.period_us).filter(|period_us| *period_us != 0);
    /// Time from the telegram's last byte until the sample was sent, in steps of 256 ns; None if the time is unknown or
    /// more than 4 s.
    hub_time_ns: Option<u64> = header.hub_time_ns();

    + {
        /// Returns a copy of the sample with its own payload. The copy can be kept and pickled.
        fn copy(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
            let memory = Arc::new(Memory::copy_of(self.memory.bytes()));
            topics::wrap(py, Sample { memory, ..self.clone() })
        }

        fn __copy__(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
            self.copy(py)
        }

        fn __deepcopy__(&self, py: Python<'_>, _memo: &Bound<'_, PyAny>) -> PyResult<Py<PyAny>> {
            self.copy(py)
        }

        fn __reduce__<'py>(&self, py: Python<'py>) -> PyResult<(Bound<'py, PyAny>, Bound<'py, PyTuple>)> {
            if let Memory::Hub(_) = &*self.memory {
                let what = "a sample in shared memory cannot be pickled; pickle `sample.copy()`";
                return Err(PyTypeError::new_err(what));
            }
            let header = PyBytes::new(py, bytes_of(&self.header));
            let payload = PyBytes::new(py, self.memory.bytes());
            let name = (&*self.name.sensor, self.name.topic.name());
            let state = (self.missed, self.restarted, self.stale);
            let fields = (name.0, name.1, header, payload, state);
            Ok((py.import("scanhub._scanhub")?.getattr("_restore")?, fields.into_pyobject(py)?))
        }

        fn __repr__(&self) -> String {
            let Name { sensor, topic } = &self.name;
            format!("<{sensor}/{} {}, {}>", topic.name(), self.header.topic_seq, self.header.quality().name())
        }
    }
}

impl Sample {
    /// Returns a background model that the hub sent on request.
    pub(crate) fn of_model(sensor: &str, model: &Background) -> Sample {
        let name = Name { sensor: sensor.into(), topic: Topic::Background };
        let memory = Arc::new(Memory::copy_of(model.bytes()));
        Sample { name, header: Header::default(), missed: 0, restarted: false, stale: false, memory }
    }
}

/// Creates a sample again from the values that were pickled.
#[pyfunction]
#[pyo3(name = "_restore")]
pub(crate) fn restore(
    py: Python<'_>,
    sensor: &str,
    topic: &str,
    header: &[u8],
    payload: &[u8],
    state: (u64, bool, bool),
) -> PyResult<Py<PyAny>> {
    let (missed, restarted, stale) = state;
    let invalid = || PyValueError::new_err("not a pickled sample of this version");
    let topic =
        Topic::parse(topic).filter(|topic| topics::is_payload(*topic, payload.len())).ok_or_else(invalid)?;
    if header.len() != size_of::<Header>() {
        return Err(invalid());
    }
    let (header, memory) = (pod_read_unaligned(header), Arc::new(Memory::copy_of(payload)));
    let name = Name { sensor: sensor.into(), topic };
    topics::wrap(py, Sample { name, header, missed, restarted, stale, memory })
}

/// Type of the elements of a numpy array.
pub(crate) trait Element: Send + Sync + 'static {
    /// Name of the type in the array interface of numpy.
    const KIND: &'static str;
}

macro_rules! elements {
    ($($element:ty: $kind:literal),*) => {
        $(impl Element for $element { const KIND: &'static str = $kind; })*
    };
}

elements!(u8: "|u1", bool: "|b1", u16: "<u2", f32: "<f4", i64: "<i8", f64: "<f8");

/// Memory of a numpy array. numpy keeps this object as the base of the array.
#[pyclass(frozen, module = "scanhub._scanhub", name = "_Array")]
pub(crate) struct Array {
    address: usize,
    kind: &'static str,
    shape: Vec<usize>,
    /// Bytes from one element to the next in each dimension; `None` if the elements are contiguous.
    strides: Option<Vec<usize>>,
    is_view: bool,
    _owner: Box<dyn Any + Send + Sync>,
}

#[pymethods]
impl Array {
    #[getter]
    fn __array_interface__<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let interface = PyDict::new(py);
        interface.set_item("version", 3)?;
        interface.set_item("typestr", self.kind)?;
        interface.set_item("data", (self.address, self.is_view))?;
        interface.set_item("shape", PyTuple::new(py, &self.shape)?)?;
        let strides = self.strides.as_ref().map(|strides| PyTuple::new(py, strides)).transpose()?;
        interface.set_item("strides", strides)?;
        Ok(interface)
    }
}

impl Array {
    fn into_numpy(self, py: Python<'_>) -> PyResult<Bound<'_, PyAny>> {
        static AS_ARRAY: PyOnceLock<Py<PyAny>> = PyOnceLock::new();
        AS_ARRAY.import(py, "numpy", "asarray")?.call1((self,))
    }
}

/// Returns a view of `elements`, which are in the payload of `sample`. The view is read-only.
pub(crate) fn view<'py, T: Element>(
    py: Python<'py>,
    sample: &Sample,
    elements: &[T],
) -> PyResult<Bound<'py, PyAny>> {
    strided(py, sample, elements, T::KIND, vec![elements.len()], None)
}

/// Returns a read-only view of parts of `elements`, which are in the payload of `sample`. The view starts at the first
/// byte of `elements`.
pub(crate) fn strided<'py, T>(
    py: Python<'py>,
    sample: &Sample,
    elements: &[T],
    kind: &'static str,
    shape: Vec<usize>,
    strides: Option<Vec<usize>>,
) -> PyResult<Bound<'py, PyAny>> {
    let address = elements.as_ptr().expose_provenance();
    let owner = Box::new(Arc::clone(&sample.memory));
    Array { address, kind, shape, strides, is_view: true, _owner: owner }.into_numpy(py)
}

/// Returns a numpy array with these elements.
pub(crate) fn array<T: Element>(py: Python<'_>, elements: Vec<T>) -> PyResult<Bound<'_, PyAny>> {
    let shape = vec![elements.len()];
    shaped(py, elements, shape)
}

/// Returns a numpy array of `shape` with these elements, row by row.
pub(crate) fn shaped<T: Element>(
    py: Python<'_>,
    elements: Vec<T>,
    shape: Vec<usize>,
) -> PyResult<Bound<'_, PyAny>> {
    let address = elements.as_ptr().expose_provenance();
    let owner = Box::new(elements);
    Array { address, kind: T::KIND, shape, strides: None, is_view: false, _owner: owner }.into_numpy(py)
}

/// Reads a payload of constant length.
pub(crate) fn fixed<P: Pod>(sample: &Sample) -> &P {
    bytemuck::from_bytes(sample.memory.bytes())
}
