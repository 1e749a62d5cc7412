//! Native part of the Python package `scanhub`: the module `scanhub._scanhub`, based on `scanhub_client`. The package
//! adds the functions that programs call, the exceptions and the named tuples.

mod client;
mod error;
#[cfg(feature = "read")]
mod recording;
#[cfg(not(feature = "read"))]
#[path = "no_recording.rs"]
mod recording;
mod sample;
mod subscription;
mod topics;

use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{self, RecvTimeoutError};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::Duration;

use pyo3::prelude::*;
use scanhub_client::{Request, Tilt, Topic, Verb};
use scanhub_schema::{check_any_sensor, is_remote};

use client::{DomainOptions, ForkSafeCell, Mount, Name};
use error::Error;
use sample::Sample;

#[pymodule]
fn _scanhub(module: &Bound<'_, PyModule>) -> PyResult<()> {
    // Import numpy now, because an import when the first array is created would delay the first sample.
    module.py().import("numpy")?;
    module.add("__version__", env!("CARGO_PKG_VERSION"))?;
    module.add("__commit__", env!("SCANHUB_COMMIT"))?;
    // This attribute is only for tests.
    module.setattr("_sources", env!("SCANHUB_SOURCES"))?;
    module.add_class::<Sample>()?;
    topics::add_to(module)?;
    module.add_class::<subscription::Subscriber>()?;
    module.add_class::<subscription::RobotSubscriber>()?;
    module.add_class::<recording::Recording>()?;
    module.add_class::<Publication>()?;
    module.add_function(wrap_pyfunction!(sample::restore, module)?)?;
    module.add_function(wrap_pyfunction!(topic_names, module)?)?;
    module.add_function(wrap_pyfunction!(request, module)?)
}

/// Returns the topic that `text` names, such as `front/scan`.
fn parse(text: &str) -> Result<Name, Error> {
    let parts = text.split_once('/').and_then(|(sensor, topic)| Some((sensor, Topic::parse(topic)?)));
    let (sensor, topic) = parts.ok_or_else(|| {
        let names: Vec<_> = Topic::ALL.iter().map(|topic| topic.name()).collect();
        let remedy = format!("write SENSOR/TOPIC, as front/scan; topics are {}", names.join(", "));
        Error::new("NoTopic", format!("no topic {text:?}"), remedy)
    })?;
    check_any_sensor(sensor)?;
    Ok(Name { sensor: sensor.into(), topic })
}

/// Returns the sensors and topics of the running hub, by name.
#[pyfunction]
#[pyo3(name = "_topics")]
fn topic_names(
    py: Python<'_>,
    domain: Option<String>,
    root: Option<PathBuf>,
) -> PyResult<Vec<(String, String)>> {
    Ok(py.detach(|| client::topics(&DomainOptions { domain, root }))?)
}

/// Sends a request to the hub, and returns the background model in the hub's reply, or `None` if the reply has no
/// model.
#[pyfunction]
#[pyo3(name = "_request")]
fn request(
    py: Python<'_>,
    sensor: &str,
    order: &str,
    domain: Option<String>,
    root: Option<PathBuf>,
) -> PyResult<Option<Py<PyAny>>> {
    check_any_sensor(sensor).map_err(Error::from)?;
    let invalid =
        || Error::new("Impossible", format!("unknown order {order:?}"), "docs/python.md lists them");
    let verb = Verb::parse(order).ok_or_else(invalid)?;
    let (request, stop) = (Request::new(sensor, verb), Arc::new(AtomicBool::new(false)));
    let domain_options = DomainOptions { domain, root };
    let answer = interruptible(py, {
        let stop = Arc::clone(&stop);
        move || {
            domain_options.live_domain().and_then(|domain| {
                scanhub_client::request(&[domain], &request, &stop).map_err(Error::of_request)
            })
        }
    });
    let answer = answer.inspect_err(|_| stop.store(true, Ordering::Relaxed))?;
    let model = answer?.map(|shown| sample::Sample::of_model(sensor, &shown.model));
    model.map(|model| topics::wrap(py, model)).transpose()
}

/// Runs `work` in another thread, and returns its result. Only the main thread handles signals, so the main thread must
/// not wait for long. If a signal raises an exception, the other thread continues.
fn interruptible<T: Send + 'static>(
    py: Python<'_>,
    work: impl FnOnce() -> T + Send + 'static,
) -> PyResult<T> {
    let (send, receive) = mpsc::channel();
    thread::spawn(move || send.send(work()));
    let receive = Mutex::new(receive);
    let wait = || receive.lock().unwrap_or_else(PoisonError::into_inner).recv_timeout(SIGNAL_INTERVAL);
    loop {
        match py.detach(wait) {
            Ok(result) => return Ok(result),
            Err(RecvTimeoutError::Timeout) => py.check_signals()?,
            Err(RecvTimeoutError::Disconnected) => {
                return Err(Error::new("Failure", "a thread of the package ended", "please report it").into());
            }
        }
    }
}

/// Interval at which signals are handled while this module works for a long time.
const SIGNAL_INTERVAL: Duration = Duration::from_millis(50);

/// Published angles of a mount.
#[pyclass(frozen, module = "scanhub")]
struct Publication(ForkSafeCell<Mount>);

#[pymethods]
impl Publication {
    #[new]
    fn new(
        py: Python<'_>,
        topic: &str,
        domain: Option<String>,
        root: Option<PathBuf>,
    ) -> PyResult<Publication> {
        let Name { sensor, topic } = parse(topic)?;
        if topic != Topic::Tilt {
            let what = format!("Python does not publish {}", topic.name());
            return Err(
                Error::new("Impossible", what, "tilt, as in mount/tilt; Rust publishes all topics").into()
            );
        }
        if is_remote(&sensor) {
            let what = format!("{sensor} is not the name of a mount");
            return Err(Error::new("Impossible", what, "one without a dot, for example mount").into());
        }
        // Only one thread at a time creates and uses a publication.
        let mount =
            py.detach(|| Mount::new(&sensor, &DomainOptions { domain, root }).map(ForkSafeCell::new))?;
        Ok(Publication(mount))
    }

    /// Publishes the angle of the mount at `stamp_ns` of `time.monotonic_ns()`, by default now.
    #[pyo3(signature = (angle_rad, *, rate_rad_s = None, stamp_ns = None))]
    fn send(
        &self,
        angle_rad: f64,
        rate_rad_s: Option<f64>,
        stamp_ns: Option<Bound<'_, PyAny>>,
    ) -> PyResult<()> {
        let in_range = |stamp: Bound<'_, PyAny>| match stamp.extract::<u64>() {
            Err(error) if error.is_instance_of::<pyo3::exceptions::PyOverflowError>(stamp.py()) => {
                let what = format!("stamp_ns {stamp} is not a time");
                Err(Error::new("Impossible", what, "a time of time.monotonic_ns(), or None for now").into())
            }
            stamp_ns => stamp_ns,
        };
        let stamp_ns = stamp_ns.map(in_range).transpose()?;
        let tilt = Tilt { angle_rad, rate_rad_s: rate_rad_s.unwrap_or(f64::NAN) };
        let ended = || {
            let remedy = "publish again; a child publishes under a name of its own";
            Error::new("Failure", "this publication has ended", remedy)
        };
        Ok(self.0.with(|mount| mount.send(stamp_ns, tilt)).ok_or_else(ended)??)
    }

    /// Number of subscribers.
    #[getter]
    fn subscribers(&self) -> usize {
        self.0.with(|mount| mount.subscribers()).unwrap_or_default()
    }

    /// Ends the publication and releases the name.
    fn close(&self) {
        drop(self.0.take());
    }

    fn __enter__(slf: Py<Self>) -> Py<Self> {
        slf
    }

    #[pyo3(signature = (*_error))]
    fn __exit__(&self, _error: &Bound<'_, pyo3::types::PyTuple>) {
        self.close();
    }
}
