//! Subscriptions to topics and to the verdict of a robot. While a subscription waits, other Python threads can run.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};

use pyo3::prelude::*;
use pyo3::types::{PyAny, PyDict};

use crate::client::{DomainOptions, ForkSafeCell, PollableSource, Topics, Verdict, Verdicts};
use crate::error::{Error, value};
use crate::{parse, topics};

/// Returns the next item, and waits if no item has arrived. Returns `None` if the subscription is closed.
fn next<F: PollableSource>(
    py: Python<'_>,
    this: &Arc<ForkSafeCell<F>>,
    timeout: Option<f64>,
    notice: Option<&Py<PyAny>>,
) -> PyResult<Option<F::Item>> {
    let _reserved = this.reserve()?;
    let until = timeout.and_then(|seconds| {
        // A timeout that is too long for the clock never expires.
        Instant::now().checked_add(Duration::try_from_secs_f64(seconds.max(0.0)).ok()?)
    });
    loop {
        let item = poll(py, this, notice)?;
        if item.is_some() || !is_open(this) {
            return Ok(item);
        }
        let left = until.map_or(Duration::MAX, |until| until.saturating_duration_since(Instant::now()));
        if left.is_zero() {
            return Err(silence(this, timeout).into());
        }
        py.detach(|| this.with(|source| source.wait(left)).transpose())?;
        py.check_signals()?;
    }
}

/// Returns the next item that has arrived, after the notices before it.
fn poll<F: PollableSource>(
    py: Python<'_>,
    this: &Arc<ForkSafeCell<F>>,
    notice: Option<&Py<PyAny>>,
) -> PyResult<Option<F::Item>> {
    // Check each time, because the callback may close the subscription.
    while is_open(this) {
        // Warn before receiving, because a topic can be silent while another topic always has samples.
        warn(py, this)?;
        let item = this.with(F::try_next).transpose()?.flatten();
        if item.is_some() || !notify(py, this, notice)? {
            return Ok(item);
        }
    }
    Ok(None)
}

/// Calls the program's callback with each notice. Returns whether there was a notice. If a call fails, the remaining
/// notices stay queued.
fn notify<F: PollableSource>(
    py: Python<'_>,
    this: &Arc<ForkSafeCell<F>>,
    callback: Option<&Py<PyAny>>,
) -> PyResult<bool> {
    let mut any = false;
    while let Some(notice) = this.with(PollableSource::next_notice).flatten() {
        callback.map_or(Ok(()), |callback| callback.call1(py, (notice,)).map(drop))?;
        any = true;
    }
    Ok(any)
}

fn warn<F: PollableSource>(py: Python<'_>, this: &Arc<ForkSafeCell<F>>) -> PyResult<()> {
    this.with(PollableSource::warning).flatten().map_or(Ok(()), |reason| reason.warn(py))
}

fn is_open<F: PollableSource>(this: &Arc<ForkSafeCell<F>>) -> bool {
    this.with(|source| !source.has_left()).unwrap_or_default()
}

fn silence<F: PollableSource>(this: &Arc<ForkSafeCell<F>>, timeout: Option<f64>) -> Error {
    let silence = this.with(|source| source.silence(timeout.unwrap_or_default()));
    silence.unwrap_or_else(closed)
}

fn descriptor<F: PollableSource>(this: &Arc<ForkSafeCell<F>>) -> Result<i32, Error> {
    let _reserved = this.reserve()?;
    this.with(PollableSource::descriptor).unwrap_or_else(|| Err(closed()))
}

fn closed() -> Error {
    Error::new("Failure", "the subscription is closed", "subscribe again")
}

/// Implements a subscription with the methods that all subscriptions share. `$convert` converts an item to an object.
macro_rules! subscriber {
    ($class:ident, |$py:ident, $item:ident| $convert:expr; $($own:tt)*) => {
        #[pymethods]
        impl $class {
            $($own)*

            fn __iter__(slf: Py<Self>) -> Py<Self> {
                slf
            }

            fn __next__(&self, $py: Python<'_>) -> PyResult<Option<Py<PyAny>>> {
                let received = next($py, &self.source, self.timeout, self.notice.as_ref())?;
                received.map(|$item| $convert).transpose()
            }

            /// Leaves the domain. Samples that the program keeps stay readable.
            fn close(&self, py: Python<'_>) {
                py.detach(|| self.source.with(PollableSource::leave));
            }

            /// Whether a hub or listener publishes in the domain, as of the last check.
            #[getter]
            fn hub_is_running(&self, py: Python<'_>) -> bool {
                // Release the interpreter, because a waiting thread can hold the lock for a tenth of a second.
                py.detach(|| self.source.with(|source| source.hub_is_running())).unwrap_or_default()
            }

            /// Returns the number of seconds since the last sample, or since the start if there was no sample. The
            /// number includes time during which the machine was suspended.
            fn silent_for(&self, py: Python<'_>) -> Result<f64, Error> {
                let silent_for = |source: &mut _| (!PollableSource::has_left(source)).then(|| PollableSource::silent_for(source));
                let silent_for = py.detach(|| self.source.with(silent_for)).flatten();
                silent_for.map(|time| time.as_secs_f64()).ok_or_else(closed)
            }

            #[getter]
            fn _warning_due(&self) -> Option<f64> {
                self.source.with(|source| source.warning_due()).flatten().map(|time| time.as_secs_f64())
            }

            #[getter]
            fn _timeout(&self) -> Option<f64> {
                self.timeout
            }

            #[getter]
            fn _is_open(&self, py: Python<'_>) -> Result<bool, Error> {
                let _reserved = self.source.reserve()?;
                Ok(py.detach(|| is_open(&self.source)))
            }

            fn _poll(&self, $py: Python<'_>) -> PyResult<Option<Py<PyAny>>> {
                let _reserved = self.source.reserve()?;
                let received = poll($py, &self.source, self.notice.as_ref())?;
                received.map(|$item| $convert).transpose()
            }

            fn _descriptor(&self) -> Result<i32, Error> {
                descriptor(&self.source)
            }

            fn _silence(&self) -> PyErr {
                silence(&self.source, self.timeout).into()
            }
        }
    };
}

/// Subscription to topics. Iterate over its samples, with `for` or with `async for`.
#[pyclass(subclass, frozen, module = "scanhub._scanhub")]
pub(crate) struct Subscriber {
    source: Arc<ForkSafeCell<Topics>>,
    timeout: Option<f64>,
    notice: Option<Py<PyAny>>,
}

subscriber! {
    Subscriber, |py, sample| topics::wrap(py, sample);

    #[new]
    fn new(
        names: Vec<String>,
        domain: Option<String>,
        root: Option<PathBuf>,
        timeout: Option<f64>,
        on_notice: Option<Py<PyAny>>,
    ) -> PyResult<Subscriber> {
        let mut unique = Vec::new();
        for name in &names {
            let name = parse(name)?;
            if !unique.contains(&name) {
                unique.push(name);
            }
        }
        if unique.is_empty() {
            return Err(Error::new("NoTopic", "no topic is named", "write SENSOR/TOPIC, as front/scan").into());
        }
        let source = Arc::new(ForkSafeCell::new(Topics::new(unique, &DomainOptions { domain, root })?));
        Ok(Subscriber { source, timeout, notice: on_notice })
    }
}

/// Subscription to the verdict of a robot. Iterate over its verdicts, with `for` or with `async for`.
#[pyclass(subclass, frozen, module = "scanhub._scanhub")]
pub(crate) struct RobotSubscriber {
    source: Arc<ForkSafeCell<Verdicts>>,
    timeout: Option<f64>,
    notice: Option<Py<PyAny>>,
}

subscriber! {
    RobotSubscriber, |py, verdict| robot(py, verdict);

    #[new]
    fn new(
        sensors: Vec<String>,
        domain: Option<String>,
        root: Option<PathBuf>,
        early: bool,
    ) -> PyResult<RobotSubscriber> {
        let sensors: Vec<&str> = sensors.iter().map(String::as_str).collect();
        let verdicts = Verdicts::new(&sensors, &DomainOptions { domain, root }, early)?;
        Ok(RobotSubscriber { source: Arc::new(ForkSafeCell::new(verdicts)), timeout: None, notice: None })
    }

    /// Returns the current verdict. Never waits.
    fn now(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
        let _reserved = self.source.reserve()?;
        let verdict = self.source.with(Verdicts::now).transpose()?;
        warn(py, &self.source)?;
        robot(py, verdict.unwrap_or_default())
    }
}

fn robot(py: Python<'_>, verdict: Verdict) -> PyResult<Py<PyAny>> {
    let sensors = PyDict::new(py);
    verdict.sensors.iter().try_for_each(|(sensor, verdict)| sensors.set_item(sensor, verdict))?;
    let (nearest_mm, nearest_sensor) = verdict.nearest.unzip();
    let fields = (verdict.verdict, verdict.worst, nearest_mm, nearest_sensor, sensors);
    value(py, "Robot", fields).map(Bound::unbind)
}
