//! Samples of a recording, computed by the code of the hub without a running hub.

use std::path::PathBuf;
use std::time::Instant;

use bytemuck::cast_slice;
use pyo3::prelude::*;
use pyo3::types::PyTuple;
use scanhub_client::{ArrayFlags, Scan, Topic};
use scanhub_config::Sources;
use scanhub_daemon::{ReadOptions, ReadSample, RecordingReader};
use scanhub_schema::{Failure, Family, Kind};

use crate::client::{ForkSafeCell, Name};
use crate::error::{Error, value};
use crate::sample::{Memory, Sample, array, shaped};
use crate::{SIGNAL_INTERVAL, interruptible, topics};

/// Recording whose samples are computed. Iterate over the object to get the samples.
#[pyclass(frozen, module = "scanhub")]
pub(crate) struct Recording {
    reader: ForkSafeCell<RecordingReader>,
    file: PathBuf,
    topics: Vec<Topic>,
    sensors: Vec<String>,
    problems: Vec<String>,
}

#[pymethods]
impl Recording {
    #[new]
    #[expect(clippy::too_many_arguments, reason = "they are the arguments of `scanhub.read`")]
    fn new(
        py: Python<'_>,
        file: PathBuf,
        topics: Vec<String>,
        sensor: Option<String>,
        config: Option<PathBuf>,
        family: Option<String>,
        set: Vec<String>,
        system_config: bool,
    ) -> PyResult<Recording> {
        let topics = topics.iter().map(|name| parse(name)).collect::<Result<Vec<_>, _>>()?;
        if topics.is_empty() {
            let what = format!("no topic of {} is named", file.display());
            return Err(Error::new("NoTopic", what, "name topics, as in topics=[\"scan\"]").into());
        }
        let family = family.map(|name| {
            let unknown = || {
                let names = Family::ALL.map(Family::name).join(", ");
                Error::new("Impossible", format!("no family {name:?}"), format!("the families are {names}"))
            };
            Family::parse(&name).ok_or_else(unknown)
        });
        let family = family.transpose()?;
        let (path, read) = (file.clone(), topics.clone());
        let opened = interruptible(py, move || {
            // The default configuration files are the same as for `scanhub replay`.
            let named = || std::env::var_os("SCANHUB_CONFIG").filter(|file| !file.is_empty());
            let mut files = if system_config { Sources::system() } else { Vec::new() };
            files.extend(config.or_else(|| named().map(PathBuf::from)));
            let sources = Sources { files, set, ..Sources::default() };
            let sensor = sensor.as_deref();
            let options = ReadOptions { file: &path, sensor, family, sources: &sources, topics: &read };
            RecordingReader::open(&options)
        })?;
        let reader = opened.map_err(refusal)?;
        let sensors = reader.sensors().into_iter().map(str::to_owned).collect();
        let problems = reader.problems().iter().map(|problem| in_python(problem)).collect();
        Ok(Recording { reader: ForkSafeCell::new(reader), file, topics, sensors, problems })
    }

    /// Names of the sensors whose samples are read.
    #[getter]
    fn sensors<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyTuple>> {
        PyTuple::new(py, &self.sensors)
    }

    /// Messages about damage, and about values that cannot be read.
    #[getter]
    fn _problems<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyTuple>> {
        PyTuple::new(py, &self.problems)
    }

    fn __iter__(slf: Py<Self>) -> Py<Self> {
        slf
    }

    fn __next__(&self, py: Python<'_>) -> PyResult<Option<Py<PyAny>>> {
        let _reserved = self.reader.reserve()?;
        let mut next = None;
        // If the recording is closed, `next` stays empty and the iteration ends.
        let _is_open = self.read(py, |sample| {
            next = Some(sample);
            false
        })?;
        next.map(|sample| topics::wrap(py, sample_of(sample))).transpose()
    }

    /// Returns all scans that were not read yet, as arrays.
    fn to_numpy(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
        let _reserved = self.reader.reserve()?;
        let path = self.file.display();
        if self.sensors.len() > 1 {
            let what = format!("{path} has several sensors: {}", self.sensors.join(", "));
            let remedy = format!("read one of them: sensor={:?}", self.sensors[0]);
            return Err(Error::new("Impossible", what, remedy).into());
        }
        if !self.topics.contains(&Topic::Scan) {
            let what = format!("{path} is read without its scans");
            return Err(Error::new("Impossible", what, "add \"scan\" to topics").into());
        }
        let mut scans = Scans::default();
        let is_open = self.read(py, |sample| {
            if sample.topic == Topic::Scan {
                scans.push(sample.header.stamp_first_ns, Scan::of_words(cast_slice(&sample.words)));
            }
            true
        })?;
        if !is_open {
            let what = format!("the recording {path} is closed");
            return Err(Error::new("Failure", what, "call scanhub.read again").into());
        }
        scans.into_numpy(py).map(Bound::unbind)
    }

    /// Closes the file. The iteration then ends.
    fn close(&self, py: Python<'_>) {
        py.detach(|| drop(self.reader.take()));
    }

    fn __enter__(slf: Py<Self>) -> Py<Self> {
        slf
    }

    #[pyo3(signature = (*_error))]
    fn __exit__(&self, py: Python<'_>, _error: &Bound<'_, PyTuple>) {
        self.close(py);
    }

    fn __repr__(&self) -> String {
        format!("<recording {}, {}>", self.file.display(), self.sensors.join(", "))
    }
}

impl Recording {
    /// Passes samples to `take` until `take` returns false, or until the end of the recording. Handles signals in
    /// between. Returns false if the recording is closed. At the end, fails once if the file has become shorter.
    fn read(&self, py: Python<'_>, mut take: impl FnMut(ReadSample) -> bool + Send) -> PyResult<bool> {
        let mut read_slice = |reader: &mut RecordingReader| {
            let until = Instant::now() + SIGNAL_INTERVAL;
            loop {
                while let Some(sample) = reader.pop() {
                    if !take(sample) {
                        return Ok(false);
                    }
                }
                if !reader.step() {
                    return reader.take_shortfall().map_or(Ok(false), Err);
                }
                if Instant::now() >= until {
                    return Ok(true);
                }
            }
        };
        loop {
            let Some(continues) = py.detach(|| self.reader.with(&mut read_slice)) else {
                return Ok(false);
            };
            if !continues.map_err(refusal)? {
                return Ok(true);
            }
            py.check_signals()?;
        }
    }
}

fn parse(name: &str) -> Result<Topic, Error> {
    let unknown = || {
        let names: Vec<_> = RecordingReader::topics().map(Topic::name).collect();
        Error::new("NoTopic", format!("no topic {name:?}"), format!("the topics are {}", names.join(", ")))
    };
    Topic::parse(name).ok_or_else(unknown)
}

fn sample_of(sample: ReadSample) -> Sample {
    let ReadSample { sensor, topic, header, words, len } = sample;
    let memory = Memory::Copy(words, len).into();
    Sample { name: Name { sensor, topic }, header, missed: 0, restarted: false, stale: false, memory }
}

/// Returns the error for a recording that cannot be read. The message and the remedy name arguments of Python instead
/// of options of the program.
fn refusal(failure: Failure) -> Error {
    let (message, hint) = (in_python(&failure.message), in_python(&failure.hint));
    match failure.kind {
        Kind::Input => Error::new("Unreadable", message, hint),
        _ => Failure { message, hint, ..failure }.into(),
    }
}

/// Replaces options of the program in `text` by arguments of `scanhub.read`.
fn in_python(text: &str) -> String {
    let text = text
        .replace("play one of them: --sensor NAME", "read one of them: sensor=\"NAME\"")
        .replace("--family NAME of the command", "family=\"NAME\" of scanhub.read")
        .replace("`scanhub replay` plays it where", "scanhub.read reads it if")
        .replace("--set link.", "set link.");
    let mut parts = text.split("set link.");
    let mut python = parts.next().unwrap_or_default().to_owned();
    for part in parts {
        // The option may be followed by its value.
        let len = part.find([' ', ',', ';', ':']).unwrap_or(part.len());
        let (setting, remainder) = part.split_at(len);
        let (value, remainder) = match remainder.strip_prefix(" = \"").and_then(|rest| rest.split_once('"')) {
            Some((value, remainder)) => (format!("={value}"), remainder),
            None => ((if setting.contains('=') { "" } else { "=VALUE" }).to_owned(), remainder),
        };
        python += &format!("set=[\"link.{setting}{value}\"]{remainder}");
    }
    python
}

/// Scans as rows of arrays. All rows are as long as the longest scan, and shorter scans are filled with NaN.
#[derive(Default)]
struct Scans {
    stamps: Vec<i64>,
    /// Number of beams of each scan.
    beams: Vec<usize>,
    ranges: Rows,
    angles: Angles,
}

/// Angles of the beams, in radians.
#[derive(Default)]
enum Angles {
    #[default]
    Unknown,
    /// One row for all scans. The two numbers are `first_angle` and `step`, which are the same in all scans.
    Same(f64, f64, Vec<f64>),
    PerScan(Rows),
}

impl Scans {
    fn push(&mut self, stamp_ns: u64, scan: &Scan) {
        let beams = scan.beams();
        self.stamps.push(stamp_ns as i64);
        self.beams.push(beams);
        self.ranges.push(beams, (0..beams).map(|i| scan.distance_m(i).unwrap_or(f64::NAN)));
        let is_exact = scan.contents & ArrayFlags::ANGLES != 0;
        let angles = (0..beams).map(|i| scan.angle(i));
        match &mut self.angles {
            Angles::PerScan(rows) => rows.push(beams, angles),
            Angles::Same(first, step, same)
                if !is_exact && (*first, *step) == (scan.first_angle, scan.step) =>
            {
                same.extend(angles.skip(same.len()));
            }
            before => {
                let mut rows = Rows::default();
                if let Angles::Same(_, _, same) = &before {
                    for &len in &self.beams[..self.beams.len() - 1] {
                        rows.push(len, same[..len].iter().copied());
                    }
                } else if !is_exact {
                    *before = Angles::Same(scan.first_angle, scan.step, angles.collect());
                    return;
                }
                rows.push(beams, angles);
                *before = Angles::PerScan(rows);
            }
        }
    }

    fn into_numpy(self, py: Python<'_>) -> PyResult<Bound<'_, PyAny>> {
        let angles = match self.angles {
            Angles::Unknown => array(py, Vec::<f64>::new())?,
            Angles::Same(_, _, angles) => array(py, angles)?,
            Angles::PerScan(rows) => rows.into_numpy(py)?,
        };
        value(py, "Scans", (self.ranges.into_numpy(py)?, array(py, self.stamps)?, angles))
    }
}

/// Table whose rows have the same length. Shorter rows are filled with NaN.
#[derive(Default)]
struct Rows {
    values: Vec<f64>,
    width: usize,
    count: usize,
}

impl Rows {
    fn push(&mut self, len: usize, row: impl Iterator<Item = f64>) {
        if len > self.width {
            self.widen(len);
        }
        self.values.extend(row);
        self.count += 1;
        self.values.resize(self.count * self.width, f64::NAN);
    }

    fn widen(&mut self, width: usize) {
        let mut values = Vec::with_capacity((self.count + 1) * width);
        for row in 0..self.count {
            values.extend_from_slice(&self.values[row * self.width..][..self.width]);
            values.resize((row + 1) * width, f64::NAN);
        }
        (self.values, self.width) = (values, width);
    }

    fn into_numpy(mut self, py: Python<'_>) -> PyResult<Bound<'_, PyAny>> {
        self.values.shrink_to_fit();
        let shape = vec![self.count, self.width];
        shaped(py, self.values, shape)
    }
}
