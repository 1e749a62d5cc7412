//! Conversion of a recording to the same format or to another one. A damaged file becomes an intact file with
//! everything that can be read from the damaged one.

mod scans;
mod writers;

use std::io::{self, BufWriter, IntoInnerError, Write};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use flate2::write::GzEncoder;
use scanhub_drivers::lms::variant::{Mode, Unit};
use scanhub_files::output::{OutputFile, unwritable};
use scanhub_schema::csv::{MarkColumns, ScanColumns};
use scanhub_schema::file::Compression;
use scanhub_schema::{Failure, Family, Kind, Topic, check_any_sensor};

use crate::{Damage, Encoding, Form, Frame, Recording, UnreadLines};
use writers::{Csv, Ros2};

/// Options of a conversion.
#[derive(Clone, Debug, Default)]
pub struct ConvertOptions {
    /// Path of the recording, which may have any format.
    pub input: PathBuf,
    /// Family of a stream file. With `None`, the family is recognized by the bytes.
    pub family: Option<Family>,
    /// Path of the output. The ending of the path selects the format, and `-` means a telegram stream on stdout.
    pub output: PathBuf,
    /// Name of the sensor to convert; for a stream or a log, the name that the sensor gets in an MCAP file.
    pub sensor: Option<String>,
    /// Whether to overwrite an existing file.
    pub force: bool,
    /// Whether to write an MCAP file with only messages of ROS 2.
    pub ros2: bool,
    /// Whether ROS 2 output has each scan also as a PointCloud2.
    pub points: bool,
    /// Measuring mode for scans of a recording that does not contain the mode.
    pub mode: Option<Mode>,
    /// Topic to write as CSV: `SENSOR/scan` or `SENSOR/marks`.
    pub topic: Option<String>,
    /// Whether CSV output has ranges in meters.
    pub meters: bool,
    /// Whether CSV output has columns for intensities.
    pub intensities: bool,
    /// Compression of an MCAP file; `None` is the default.
    pub compression: Option<Compression>,
}

/// Result of a conversion.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ConversionResult {
    /// Formats of the input and of the output.
    pub forms: (Form, Target),
    /// Encoding into which the ranges of a log were converted; `None` for other formats.
    pub encoding: Option<Encoding>,
    /// Names of the recording's sensors. If the recording names no sensor, the name that its sensor gets in an MCAP
    /// file.
    pub sensors: Vec<String>,
    /// Number of telegrams that were written.
    pub telegrams: u64,
    /// Number of scans that were written; for CSV of marks, number of scans whose marks were written.
    pub scans: u64,
    /// Number of marks that were written; `None` if marks were not requested.
    pub marks: Option<u64>,
    /// Number of telegrams that the output format cannot hold. A CARMEN log holds only complete scans, and ROS 2 and
    /// CSV hold only scans. The reply that contains the encoding of a log is not counted.
    pub dropped: u64,
    /// Data of a log that no telegram holds.
    pub unread: UnreadLines,
    /// Time from the first telegram to the last one in ns, by the stamps of the recording or by generated stamps;
    /// `None` if the output has no stamps.
    pub duration_ns: Option<u64>,
    /// Data that could not be read.
    pub damage: Damage,
    /// Whether the program that read from stdout closed the pipe before the end.
    pub is_closed: bool,
}

/// Format that a recording is converted to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Target {
    /// A recording of this format.
    Recording(Form),
    /// An MCAP file with only messages of ROS 2.
    Ros2,
    /// CSV with a row for each scan.
    Csv,
    /// CSV with a row for each mark.
    MarksCsv,
}

impl Target {
    /// Returns the name of the format.
    pub fn name(self) -> &'static str {
        match self {
            Target::Recording(form) => form_name(form),
            Target::Ros2 => "ROS 2",
            Target::Csv | Target::MarksCsv => "CSV",
        }
    }
}

/// Converts according to `options` until `stop` is set. Calls `progress` with the number of telegrams so far and their
/// total. A closed stdout is not an error. After an error, no output remains.
///
/// # Errors
///
/// - [`Kind::Input`] if the recording cannot be read, or cannot be converted to the output format.
/// - [`Kind::NoTopic`] if the recording does not have the sensor that the options name.
/// - [`Kind::Usage`] if the output format is unknown, or options contradict each other.
/// - [`Kind::Output`] if the output exists or cannot be written.
/// - [`Kind::Interrupted`] if the conversion was stopped.
pub fn convert(
    options: &ConvertOptions,
    stop: &AtomicBool,
    mut progress: impl FnMut(u64, u64),
) -> Result<ConversionResult, Failure> {
    let (target, chosen) = target_of(options)?;
    let whole = Recording::open_as(&options.input, options.family)?;
    let output = Output::create(&options.output, &options.input, options.force)?;
    let recording = match chosen {
        Some(sensor) if whole.contents().form == Form::Mcap => whole.of(sensor)?,
        Some(sensor) => {
            let named = check_any_sensor(sensor).map(|()| whole);
            named.map_err(|failure| Failure { kind: Kind::Usage, ..failure })?
        }
        None => whole,
    };
    let contents = recording.contents();
    // Recorded marks are written without decoding values, so the encoding does not matter.
    let encoding = match target {
        Target::MarksCsv => Encoding { unit: Unit::Cm, mode: Mode(0) },
        _ => encoding(&recording, target)?,
    };
    let is_of_all = matches!(target, Target::Recording(Form::Mcap) | Target::Ros2);
    if !(contents.form == Form::Mcap && is_of_all) {
        // If the file has several sensors and no sensor was chosen, fail before anything is written.
        drop(recording.telegrams(encoding)?);
    }
    let mut conversion = Conversion {
        recording: &recording,
        options,
        sensor: chosen.unwrap_or(DEFAULT_SENSOR),
        encoding,
        stop,
        progress: &mut progress,
        telegram_count: 0,
        first_ns: None,
        converted: ConversionResult {
            forms: (contents.form, target),
            encoding: recording.encoding().filter(|_| contents.form == Form::Carmen),
            sensors: contents.sensors.clone(),
            telegrams: 0,
            scans: 0,
            marks: None,
            dropped: 0,
            unread: contents.unread,
            duration_ns: None,
            damage: contents.damage,
            is_closed: false,
        },
    };
    let mut file = BufWriter::with_capacity(BUFFER_LEN, output);
    let written = conversion.write(target, &mut file);
    let written = written.and_then(|()| Ok(file.into_inner().map_err(IntoInnerError::into_error)?));
    let converted = conversion.converted;
    match written {
        Ok(output) => output.commit().map(|()| converted),
        Err(ConversionError::Unwritable(error)) if Output::is_closed(&options.output, &error) => {
            Ok(ConversionResult { is_closed: true, ..converted })
        }
        Err(ConversionError::Unwritable(error)) => Err(unwritable(&options.output, &error)),
        Err(ConversionError::Failed(failure)) => Err(failure),
    }
}

/// Reason why a conversion ended early.
enum ConversionError {
    /// The output cannot be written.
    Unwritable(io::Error),
    Failed(Failure),
}

impl From<io::Error> for ConversionError {
    fn from(error: io::Error) -> ConversionError {
        ConversionError::Unwritable(error)
    }
}

impl From<Failure> for ConversionError {
    fn from(failure: Failure) -> ConversionError {
        ConversionError::Failed(failure)
    }
}

/// Running conversion: its input, its progress and its result so far.
struct Conversion<'a> {
    recording: &'a Recording,
    options: &'a ConvertOptions,
    /// Name of the sensor, for a recording that names no sensor.
    sensor: &'a str,
    encoding: Encoding,
    stop: &'a AtomicBool,
    progress: &'a mut dyn FnMut(u64, u64),
    /// Number of telegrams so far, including those that were not written.
    telegram_count: u64,
    /// Time of the first telegram.
    first_ns: Option<u64>,
    converted: ConversionResult,
}

impl Conversion<'_> {
    /// Writes the recording into `file` in the format `target`.
    fn write(&mut self, target: Target, file: &mut impl Write) -> Result<(), ConversionError> {
        let options = self.options;
        let &ConvertOptions { meters, intensities, .. } = options;
        match target {
            Target::Recording(Form::Mcap) if self.recording.contents().form == Form::Mcap => {
                writers::copy(self, file)
            }
            Target::Recording(Form::Mcap) => writers::write_mcap(self, file),
            Target::Ros2 => {
                let sink = Ros2::begin(self, file)?;
                writers::write_scans(self, sink)
            }
            Target::Csv => {
                let columns = ScanColumns { meters, intensities };
                writers::write_scans(self, Csv::begin(OutputEncoder::of(&options.output, file), columns))
            }
            Target::MarksCsv => {
                writers::write_marks(self, MarkColumns { meters }, OutputEncoder::of(&options.output, file))
            }
            Target::Recording(Form::Carmen) => {
                writers::write_log(self, OutputEncoder::of(&options.output, file))
            }
            Target::Recording(Form::Telegrams) => {
                writers::write_stream(self, OutputEncoder::of(&options.output, file))
            }
        }
    }

    /// Counts a telegram that was measured at `at_ns`.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Interrupted`] if the conversion was stopped.
    fn count(&mut self, item: WrittenItem, at_ns: Option<u64>) -> Result<(), ConversionError> {
        let converted = &mut self.converted;
        if let Some(at_ns) = at_ns.filter(|_| !matches!(item, WrittenItem::Added | WrittenItem::Dropped)) {
            let since_ns = at_ns.saturating_sub(*self.first_ns.get_or_insert(at_ns));
            converted.duration_ns = converted.duration_ns.max(Some(since_ns));
        }
        converted.telegrams += u64::from(matches!(item, WrittenItem::Scan | WrittenItem::Other));
        converted.scans += u64::from(matches!(item, WrittenItem::Scan | WrittenItem::Marks));
        converted.dropped += u64::from(item == WrittenItem::Dropped);
        self.telegram_count += 1;
        if self.telegram_count.is_multiple_of(PROGRESS_INTERVAL) {
            (self.progress)(self.telegram_count, self.recording.contents().telegrams);
        }
        if self.stop.load(Ordering::Relaxed) {
            return Err(Failure::new(Kind::Interrupted, "interrupted before the end", "").into());
        }
        Ok(())
    }
}

/// Result of a telegram in the output.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum WrittenItem {
    Scan,
    Other,
    /// The marks of a scan.
    Marks,
    /// A reply that the recording itself does not contain, such as the reply with the encoding of a log's values.
    Added,
    Dropped,
}

impl WrittenItem {
    fn of(is_scan: bool) -> WrittenItem {
        if is_scan { WrittenItem::Scan } else { WrittenItem::Other }
    }

    /// Returns the result of `frame`, which has the index `number` among the frames that [`writers::frames`] returns
    /// for a recording of `form`.
    fn of_frame(form: Form, number: usize, frame: &Frame) -> WrittenItem {
        if form == Form::Carmen && number == 0 {
            WrittenItem::Added
        } else {
            WrittenItem::of(frame.is_scan())
        }
    }
}

/// Returns the encoding of the values, if `target` needs it.
///
/// # Errors
///
/// Returns [`Kind::Input`] if the input is a log with ranges that no scanner could have sent, if `target` cannot hold
/// the telegrams of the scanner, or if `target` needs a family or a measuring mode that is unknown.
fn encoding(recording: &Recording, target: Target) -> Result<Encoding, Failure> {
    let contents = recording.contents();
    let unencodable = contents.unencodable;
    if !unencodable.is_none() {
        let message =
            format!("{} cannot become telegrams without loss: {unencodable}", recording.path().display());
        let hint = "round its ranges first; `scanhub replay` plays it rounded";
        return Err(Failure::new(Kind::Input, message, hint));
    }
    if target == Target::Recording(Form::Telegrams)
        && contents.sensors.len() <= 1
        && let Some(other) = contents.other_family
    {
        let [one, other] = [contents.family, other].map(|number| {
            Family::of_number(number)
                .map_or_else(|| format!("number {number}"), |family| family.name().to_owned())
        });
        let message = format!(
            "{} has telegrams of families {one} and {other}, because the scanner was replaced; raw bytes of both cannot be \
             distinguished",
            recording.path().display()
        );
        let hint = "name OUT.mcap, which keeps the family of each telegram, or OUT.csv for the scans";
        return Err(Failure::new(Kind::Input, message, hint));
    }
    if !contents.is_lms() && target == Target::Recording(Form::Carmen) {
        let message = format!(
            "{} is of a rotating scanner, which a CARMEN log cannot hold",
            recording.path().display()
        );
        let hint = "name OUT.mcap with --ros2, or OUT.csv";
        return Err(Failure::new(Kind::Input, message, hint));
    }
    if recording.family().is_none() && !matches!(target, Target::Recording(_)) {
        let (place, number) = (recording.path().display(), contents.family);
        let message =
            format!("{place} is of a scanner of family number {number}, which this version does not know");
        return Err(Failure::new(Kind::Input, message, "a later version of scanhub recorded it: use that"));
    }
    let mode = contents.readable_mode();
    if mode.is_none() && target == Target::Recording(Form::Carmen) {
        let message = format!("{} does not contain its measuring mode", recording.path().display());
        let hint = "`scanhub replay --set link.front.mode=0x04` plays it, and `scanhub record` records it with its mode";
        return Err(Failure::new(Kind::Input, message, hint));
    }
    Ok(Encoding { unit: contents.unit.unwrap_or(Unit::Cm), mode: mode.unwrap_or(Mode(0)) })
}

/// Returns the output format, and the sensor that the options choose.
///
/// # Errors
///
/// Returns [`Kind::Usage`] if the format is unknown, or if an option does not fit the format.
fn target_of(options: &ConvertOptions) -> Result<(Target, Option<&str>), Failure> {
    let (target, sensor) = match (format_of(options)?, options.topic.as_deref()) {
        (target, None) => (target, options.sensor.as_deref()),
        (Target::Csv, Some(topic)) => {
            let (target, sensor) = of_topic(topic)?;
            if options.sensor.as_deref().is_some_and(|other| other != sensor) {
                return usage("--sensor and --topic name different sensors", "leave --sensor out");
            }
            (target, Some(sensor))
        }
        (_, Some(_)) => {
            return usage("--topic is for CSV", "scanhub convert IN OUT.csv --topic SENSOR/marks");
        }
    };
    match target {
        Target::MarksCsv if options.mode.is_some() => {
            usage("--mode is for scans; marks are copied as they were recorded", "leave --mode out")
        }
        Target::MarksCsv if options.intensities => usage(
            "--intensities is for scans, not for marks, which have the columns peak and weight",
            "leave --intensities out",
        ),
        Target::Recording(_) | Target::Ros2 if options.intensities => {
            let hint =
                "scanhub convert IN OUT.csv --intensities; MCAP files, also with --ros2, always have them";
            usage("--intensities is for CSV", hint)
        }
        Target::Recording(_) | Target::Ros2 if options.meters => {
            let hint = "scanhub convert IN OUT.csv --meters; a CARMEN log and --ros2 always have meters";
            usage("--meters is for CSV", hint)
        }
        target => Ok((target, sensor)),
    }
}

/// Returns the CSV format for `topic`, and the sensor that `topic` names.
fn of_topic(topic: &str) -> Result<(Target, &str), Failure> {
    let (sensor, name) = topic.rsplit_once('/').unwrap_or((topic, ""));
    match Topic::parse(name) {
        Some(Topic::Scan) => Ok((Target::Csv, sensor)),
        Some(Topic::Marks) => Ok((Target::MarksCsv, sensor)),
        Some(_) => {
            let hint =
                "`scanhub replay IN` publishes every topic, and `scanhub echo SENSOR/TOPIC --json` prints it";
            usage(&format!("{topic} cannot be CSV: only scan and marks can"), hint)
        }
        None => usage(&format!("{topic:?} is not a topic"), "for example --topic front/marks"),
    }
}

fn usage<T>(message: &str, hint: &str) -> Result<T, Failure> {
    Err(Failure::new(Kind::Usage, message, hint))
}

/// Returns the format that the file's name and `--ros2` select.
fn format_of(options: &ConvertOptions) -> Result<Target, Failure> {
    let target = target_of_ending(&options.output)?;
    if options.points && !options.ros2 {
        return usage("--points is for ROS 2", "scanhub convert IN OUT.mcap --ros2 --points");
    }
    match (target, options.ros2) {
        (Target::Recording(Form::Mcap), true) => Ok(Target::Ros2),
        (Target::Csv | Target::Recording(Form::Telegrams | Form::Carmen), _)
            if options.compression.is_some() =>
        {
            usage("--compression is for MCAP files", "add .gz to OUT, which compresses it")
        }
        (_, true) => usage("--ros2 makes an MCAP file", "scanhub convert IN OUT.mcap --ros2"),
        (Target::Recording(_), _) if options.mode.is_some() => {
            usage("--mode is for scans; telegrams are copied as they are", "with --ros2, or OUT.csv")
        }
        (target, false) => Ok(target),
    }
}

/// Returns the format that the ending of a file selects.
fn target_of_ending(path: &Path) -> Result<Target, Failure> {
    let name = path.file_name().map(|name| name.to_string_lossy().to_lowercase()).unwrap_or_default();
    let plain = name.strip_suffix(".gz").unwrap_or(&name);
    match plain.rsplit_once('.') {
        _ if name == "-" => Ok(Target::Recording(Form::Telegrams)),
        Some((_, "mcap")) if plain == name => Ok(Target::Recording(Form::Mcap)),
        Some((_, "log" | "clf")) => Ok(Target::Recording(Form::Carmen)),
        Some((_, "bin" | "raw")) => Ok(Target::Recording(Form::Telegrams)),
        Some((_, "csv")) => Ok(Target::Csv),
        _ => {
            let message = format!("the ending of {} is not a known format", path.display());
            let hint = ".mcap; .log (CARMEN), .bin (telegram stream), .csv, also with .gz; or - for stdout";
            Err(Failure::new(Kind::Usage, message, hint))
        }
    }
}

/// Returns the name of a recording's format.
pub fn form_name(form: Form) -> &'static str {
    match form {
        Form::Telegrams => "telegram stream",
        Form::Carmen => "CARMEN log",
        Form::Mcap => "MCAP",
    }
}

/// Output of a conversion.
enum Output {
    Stdout(io::Stdout),
    File(OutputFile),
}

impl Output {
    /// Creates the output at `path`. With `force`, the output may replace a file, but not `input`. The path `-` means
    /// stdout.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`OutputFile::create`], and [`Kind::Output`] if `path` is the input.
    fn create(path: &Path, input: &Path, force: bool) -> Result<Output, Failure> {
        if path == Path::new("-") {
            return Ok(Output::Stdout(io::stdout()));
        }
        let id = |path: &Path| path.metadata().map(|metadata| (metadata.dev(), metadata.ino())).ok();
        if id(path).is_some_and(|output| id(input) == Some(output)) {
            let hint = "write into another file, check it, and then replace the first one";
            let message = format!("{} is both read and written", path.display());
            return Err(Failure::new(Kind::Output, message, hint));
        }
        OutputFile::create(path, force).map(Output::File)
    }

    /// Returns whether `error` means that the program that read from stdout closed the pipe.
    fn is_closed(path: &Path, error: &io::Error) -> bool {
        path == Path::new("-") && error.kind() == io::ErrorKind::BrokenPipe
    }

    /// Completes the output.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`OutputFile::commit`].
    fn commit(self) -> Result<(), Failure> {
        match self {
            Output::Stdout(_) => Ok(()),
            Output::File(file) => file.commit(),
        }
    }
}

impl Write for Output {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        match self {
            Output::Stdout(stdout) => stdout.write(bytes),
            Output::File(file) => file.write(bytes),
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        match self {
            Output::Stdout(stdout) => stdout.flush(),
            Output::File(file) => file.flush(),
        }
    }
}

/// Encoder of the output, which compresses with gzip if the name of the file ends with `.gz`.
enum OutputEncoder<W: Write> {
    Plain(W),
    Gzip(GzEncoder<W>),
}

impl<W: Write> OutputEncoder<W> {
    fn of(path: &Path, file: W) -> Self {
        match path.extension() {
            Some(ending) if ending.eq_ignore_ascii_case("gz") => {
                OutputEncoder::Gzip(GzEncoder::new(file, flate2::Compression::default()))
            }
            _ => OutputEncoder::Plain(file),
        }
    }

    fn write_all(&mut self, bytes: &[u8]) -> io::Result<()> {
        match self {
            OutputEncoder::Plain(file) => file.write_all(bytes),
            OutputEncoder::Gzip(encoder) => encoder.write_all(bytes),
        }
    }

    fn finish(self) -> io::Result<()> {
        match self {
            OutputEncoder::Plain(_) => Ok(()),
            OutputEncoder::Gzip(encoder) => encoder.finish().map(drop),
        }
    }
}

/// Name of the sensor of a stream or a log, unless an option names the sensor.
const DEFAULT_SENSOR: &str = "front";
/// Size of the buffer in which output is collected, in bytes.
const BUFFER_LEN: usize = 1 << 20;
/// Number of telegrams between two reports of progress.
const PROGRESS_INTERVAL: u64 = 512;
