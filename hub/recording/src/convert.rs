//! Writes a recording in the same format or another. A damaged file becomes an intact one with everything that can be read
//! from it.

mod copy;
mod output;
mod scans;
mod stream_head;
mod views;

use std::cell::Cell;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use scanhub_drivers::lms::variant::{Baud, Mode, Unit};
use scanhub_files::output::unwritable;
use schema::csv::{MarkColumns, ScanColumns};
use schema::file::{Compression, Writer};
use schema::{Failure, Family, Flags, Header, Kind, Topic, check_followed};

use crate::{Damage, Encoding, Form, Frame, Recording, Unread, carmen};
use output::{Output, Packing};
use scans::{Sight, Times};
use stream_head::stream_heads;
use views::{Csv, Ros2, View, write_marks};

/// What to convert.
#[derive(Clone, Debug, Default)]
pub struct ConvertOptions {
    /// The recording, of any form.
    pub input: PathBuf,
    /// Family of a stream file; `None` if it is recognized by the bytes.
    pub family: Option<Family>,
    /// What it becomes: the form is that of the ending; `-` is a telegram stream on stdout.
    pub output: PathBuf,
    /// Which sensor of the recording; of a stream or a log the name that it gets in an MCAP file.
    pub sensor: Option<String>,
    /// Overwrite an existing file.
    pub force: bool,
    /// An MCAP file with only messages of ROS 2.
    pub ros2: bool,
    /// For ROS 2: each scan also as a PointCloud2.
    pub points: bool,
    /// For scans: the measuring mode of a recording that does not contain it.
    pub mode: Option<Mode>,
    /// For CSV: `SENSOR/scan` or `SENSOR/marks`.
    pub topic: Option<String>,
    /// For CSV: ranges in meters.
    pub meters: bool,
    /// For CSV: columns for intensities.
    pub intensities: bool,
    /// How an MCAP file is packed, if not as usual.
    pub compression: Option<Compression>,
}

/// What was converted.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Converted {
    /// Formats of the input and of the output.
    pub forms: (Form, Target),
    /// How the ranges of a log are encoded as values; `None` for other formats.
    pub encoding: Option<Encoding>,
    /// Its sensors; of one that names none the name that it gets in an MCAP file.
    pub sensors: Vec<String>,
    /// Telegrams that were written.
    pub telegrams: u64,
    /// Scans that were written; of marks, scans whose marks were written.
    pub scans: u64,
    /// Marks that were written; `None` if these were not asked for.
    pub marks: Option<u64>,
    /// Telegrams that the form cannot hold: in a CARMEN log all but whole scans, for ROS 2 and in columns all but scans. The
    /// reply that stands for the encoding of a log does not count.
    pub left_out: u64,
    /// Data of a log that no telegram holds.
    pub unread: Unread,
    /// From the first telegram to the last one, in ns, as stamps say: the recording's, or those that were made for it.
    /// Nothing if there are neither.
    pub took_ns: Option<u64>,
    /// What was missing of the recording.
    pub damage: Damage,
    /// The reader of stdout closed it before the end.
    pub is_closed: bool,
}

/// Format that a recording is converted to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Target {
    /// A recording again, of this form.
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

/// Converts according to `options` until `stop` is set; calls `progress` with the telegrams written and their total. A
/// closed stdout is not an error.
///
/// [`Kind::Input`] if the recording cannot be read, or not be converted without loss, [`Kind::NoTopic`] if it has no such
/// sensor, [`Kind::Usage`] if the output format is not known or options contradict each other, [`Kind::Output`] if the
/// output exists or cannot be written, [`Kind::Interrupted`] if it was stopped. No output is left then.
pub fn convert(
    options: &ConvertOptions,
    stop: &AtomicBool,
    mut progress: impl FnMut(u64, u64),
) -> Result<Converted, Failure> {
    let (target, chosen) = target_of(options)?;
    let whole = Recording::open_as(&options.input, options.family)?;
    let output = Output::create(&options.output, &options.input, options.force)?;
    let recording = match chosen {
        Some(sensor) if whole.contents().form == Form::Mcap => whole.of(sensor)?,
        Some(sensor) => {
            let named = check_followed(sensor).map(|()| whole);
            named.map_err(|failure| Failure { kind: Kind::Usage, ..failure })?
        }
        None => whole,
    };
    let contents = recording.contents();
    let mut converted = Converted {
        forms: (contents.form, target),
        encoding: recording.encoding().filter(|_| contents.form == Form::Carmen),
        sensors: contents.sensors.clone(),
        telegrams: 0,
        scans: 0,
        marks: None,
        left_out: 0,
        unread: contents.unread,
        took_ns: None,
        damage: contents.damage,
        is_closed: false,
    };
    // Marks are copied, whatever the encoding of the scans.
    let encoding = match target {
        Target::MarksCsv => Encoding { unit: Unit::Cm, mode: Mode(0) },
        _ => encoding(&recording, target)?,
    };
    let is_of_all = matches!(target, Target::Recording(Form::Mcap) | Target::Ros2);
    if !(contents.form == Form::Mcap && is_of_all) {
        // Fails before anything is written if the file has several sensors and none was chosen.
        drop(recording.telegrams(encoding)?);
    }
    let mut file = BufWriter::with_capacity(BUFFER, output);
    let is_closed = Cell::new(false);
    let failed = |error: io::Error| {
        is_closed.set(Output::is_closed(&options.output, &error));
        unwritable(&options.output, &error)
    };
    let mut first_ns = None;
    let mut done = 0_u64;
    let mut count = |written: Written, at_ns: Option<u64>| {
        if let Some(at_ns) = at_ns.filter(|_| !matches!(written, Written::Added | Written::LeftOut)) {
            let since_ns = at_ns.saturating_sub(*first_ns.get_or_insert(at_ns));
            converted.took_ns = converted.took_ns.max(Some(since_ns));
        }
        converted.telegrams += u64::from(matches!(written, Written::Scan | Written::Other));
        converted.scans += u64::from(matches!(written, Written::Scan | Written::Marks));
        converted.left_out += u64::from(written == Written::LeftOut);
        done += 1;
        if done.is_multiple_of(STEP) {
            progress(done, contents.telegrams);
        }
        if stop.load(Ordering::Relaxed) {
            return Err(Failure::new(Kind::Interrupted, "interrupted before the end", ""));
        }
        Ok(())
    };
    let sensor = chosen.unwrap_or(SENSOR);
    let compression = options.compression.unwrap_or_default();
    let written = match target {
        Target::Recording(Form::Mcap) if contents.form == Form::Mcap => {
            copy::copy(&recording, compression, &mut file, &mut count, &failed)
        }
        Target::Recording(Form::Mcap) => {
            let file = (&mut file, compression);
            converted.sensors = vec![sensor.to_owned()];
            write_mcap(&recording, sensor, encoding, file, &mut count, &failed)
        }
        Target::Ros2 => {
            let view = Ros2::begin(&mut file, compression, form_name(contents.form), options.points);
            view.map_err(&failed).and_then(|view| {
                write_view(&recording, sensor, encoding, options.mode, view, &mut count, &failed)
            })
        }
        Target::Csv => {
            let columns = ScanColumns { meters: options.meters, intensities: options.intensities };
            let view = Csv::begin(Packing::of(&options.output, &mut file), columns);
            write_view(&recording, sensor, encoding, options.mode, view, &mut count, &failed)
        }
        Target::MarksCsv => {
            let out = Packing::of(&options.output, &mut file);
            let columns = MarkColumns { meters: options.meters };
            let written = write_marks(&recording, columns, out, &mut count, &failed);
            written.map(|written| converted.marks = Some(written))
        }
        Target::Recording(form) => {
            let out = Packing::of(&options.output, &mut file);
            write_bytes(&recording, form, encoding, out, &mut count, &failed)
        }
    };
    let flushed = written.and_then(|()| file.flush().map_err(&failed));
    match flushed.and_then(|()| file.into_inner().map_err(|error| failed(error.into_error()))) {
        Err(_) if is_closed.get() => Ok(Converted { is_closed: true, ..converted }),
        Err(failure) => Err(failure),
        Ok(output) => output.commit().map(|()| converted),
    }
}

/// Size of the buffer before the output, in bytes.
const BUFFER: usize = 1 << 20;

/// What became of a telegram.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Written {
    Scan,
    Other,
    /// The marks of a scan.
    Marks,
    /// A reply that the recording itself does not contain, such as one with the encoding of a log's values.
    Added,
    LeftOut,
}

impl Written {
    fn of(is_scan: bool) -> Written {
        if is_scan { Written::Scan } else { Written::Other }
    }

    /// Returns what was written with `frame`, number `number` of those that [`frames`] returns for a recording of `form`.
    fn of_frame(form: Form, number: usize, frame: &Frame) -> Written {
        if form == Form::Carmen && number == 0 { Written::Added } else { Written::of(frame.is_scan()) }
    }
}

/// Writes a stream of telegrams, or a log.
fn write_bytes(
    recording: &Recording,
    form: Form,
    encoding: Encoding,
    mut out: Packing<impl Write>,
    count: &mut impl FnMut(Written, Option<u64>) -> Result<(), Failure>,
    failed: &impl Fn(io::Error) -> Failure,
) -> Result<(), Failure> {
    let mut times = Times::of(recording);
    if form == Form::Telegrams {
        let mut heads = stream_heads(recording)?.into_iter().peekable();
        for (number, frame) in frames(recording, encoding)?.enumerate() {
            if let Some((_, head)) = heads.next_if(|(before, _)| *before == number) {
                out.write_all(&head).map_err(failed)?;
            }
            out.write_all(&frame.telegram).map_err(failed)?;
            count(Written::of_frame(recording.contents().form, number, &frame), frame.wall_ns)?;
        }
        return out.finish().map_err(failed);
    }
    let mode = encoding.mode;
    let told = carmen::encoding_line(encoding);
    out.write_all(told.as_bytes()).map_err(failed)?;
    let mut first_ns = None;
    for (number, frame) in recording.telegrams(encoding)?.enumerate() {
        let at_ns = times.wall_ns(&frame);
        // The line above says the same.
        if number == 0 && is_made_up(&frame.telegram, frame.header.as_ref()) {
            continue;
        }
        let line = carmen::scan_line(&frame.telegram, mode, at_ns, *first_ns.get_or_insert(at_ns));
        out.write_all(line.as_deref().unwrap_or_default().as_bytes()).map_err(failed)?;
        count(if line.is_some() { Written::Scan } else { Written::LeftOut }, Some(at_ns))?;
    }
    out.finish().map_err(failed)
}

/// Writes telegrams that have no header into an MCAP file.
fn write_mcap(
    recording: &Recording,
    sensor: &str,
    encoding: Encoding,
    (file, compression): (&mut impl Write, Compression),
    count: &mut impl FnMut(Written, Option<u64>) -> Result<(), Failure>,
    failed: &impl Fn(io::Error) -> Failure,
) -> Result<(), Failure> {
    let facts = [("converted from".to_owned(), form_name(recording.contents().form).to_owned())];
    let mut writer = Writer::packed(file, "", compression, facts.into()).map_err(failed)?;
    let mut times = Times::of(recording);
    let mut bytes = 0;
    let mut frames = frames(recording, encoding)?.enumerate().peekable();
    while let Some((number, frame)) = frames.next() {
        let next_ns = frames.peek().and_then(|(_, next)| next.wall_ns);
        let header = times.header(&frame, number as u64, next_ns);
        writer.sample(sensor, Topic::Telegram, &header, &frame.telegram).map_err(failed)?;
        bytes += frame.telegram.len();
        if bytes >= CHUNK {
            writer.close_chunk().map_err(failed)?;
            bytes = 0;
        }
        count(Written::of_frame(recording.contents().form, number, &frame), Some(header.wall_ns))?;
    }
    writer.finish().map_err(failed).map(drop)
}

/// Writes the scans in the format of `view`.
fn write_view(
    recording: &Recording,
    sensor: &str,
    encoding: Encoding,
    mode: Option<Mode>,
    mut view: impl View,
    count: &mut impl FnMut(Written, Option<u64>) -> Result<(), Failure>,
    failed: &impl Fn(io::Error) -> Failure,
) -> Result<(), Failure> {
    let mut is_empty = true;
    scans::each(recording, sensor, encoding, mode, &mut |sight| {
        let Some(written) = view.see(&sight).map_err(failed)? else { return Ok(()) };
        let Sight::Scan(_, header, _) = sight else { return count(written, None) };
        is_empty = false;
        count(written, Some(header.wall_ns))
    })?;
    if is_empty {
        let message = format!("there is no scan in {}", recording.path().display());
        let hint = "scans are decoded from topic telegram, or taken from topic scan";
        return Err(Failure::new(Kind::Input, message, hint));
    }
    if view.lacks_intensities() {
        let message = format!("no scan in {} has intensities", recording.path().display());
        let hint = "leave --intensities out; an LMS sends reflector levels only in some measuring modes, such as 0x01";
        return Err(Failure::new(Kind::Input, message, hint));
    }
    view.finish().map_err(failed)
}

/// Returns whether `telegram`, the first one of a sensor, is the reply that [`frames`] adds to a log. No scanner sent it, so
/// nothing is lost without it.
fn is_made_up(telegram: &[u8], header: Option<&Header>) -> bool {
    let is_estimated = header.is_none_or(|header| header.flags & Flags::STAMP_ESTIMATED != 0);
    is_estimated && carmen::is_made_up(telegram)
}

/// Returns the encoding of the values, if `target` needs it.
///
/// # Errors
///
/// Returns [`Kind::Input`] for a log with ranges that no scanner could have sent, and if a log cannot be written because the
/// measuring mode is unknown.
fn encoding(recording: &Recording, target: Target) -> Result<Encoding, Failure> {
    let contents = recording.contents();
    let unfit = contents.unfit;
    if !unfit.is_none() {
        let message = format!("{} cannot become telegrams without loss: {unfit}", recording.path().display());
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
             told apart",
            recording.path().display()
        );
        let hint = "name OUT.mcap, which keeps the family of each telegram, or OUT.csv for the scans";
        return Err(Failure::new(Kind::Input, message, hint));
    }
    if !contents.is_lms() && target == Target::Recording(Form::Carmen) {
        let message = format!(
            "{} is of a scanner that looks all around, which a CARMEN log has no place for",
            recording.path().display()
        );
        let hint = "name OUT.mcap with --ros2, or OUT.csv";
        return Err(Failure::new(Kind::Input, message, hint));
    }
    if recording.family().is_none() && !matches!(target, Target::Recording(_)) {
        let (place, number) = (recording.path().display(), contents.family);
        let message = format!("{place} is of a scanner of family number {number}, which is not known here");
        return Err(Failure::new(Kind::Input, message, "a later version of scanhub recorded it: use that"));
    }
    let mode = contents.readable();
    if mode.is_none() && target == Target::Recording(Form::Carmen) {
        let message = format!("{} does not contain its measuring mode", recording.path().display());
        let hint = "`scanhub replay --set link.front.mode=0x04` plays it, and `scanhub record` records it with its mode";
        return Err(Failure::new(Kind::Input, message, hint));
    }
    Ok(Encoding { unit: contents.unit.unwrap_or(Unit::Cm), mode: mode.unwrap_or(Mode(0)) })
}

/// Returns the telegrams of `recording`. Those of a log begin with the reply that contains the encoding of the values.
fn frames(recording: &Recording, encoding: Encoding) -> Result<impl Iterator<Item = Frame> + use<>, Failure> {
    let contents = recording.contents();
    let told = (contents.form == Form::Carmen).then(|| {
        let telegram = carmen::configuration(encoding);
        let took_ns = schema::line_time(telegram.len(), Baud::B500000.rate());
        let wall_ns = contents.span.map(|(first_ns, _)| first_ns.saturating_sub(took_ns));
        Frame { telegram, wall_ns, ..Frame::default() }
    });
    Ok(told.into_iter().chain(recording.telegrams(encoding)?))
}

/// Returns the output format, and the sensor that the options choose.
///
/// # Errors
///
/// Returns [`Kind::Usage`] if the format is unknown, or an option does not fit it.
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
            "--intensities is for scans; columns peak and weight of a mark are its intensities",
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

/// Returns the format of `topic` as CSV, and its sensor.
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
    let target = ending(&options.output)?;
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
fn ending(path: &Path) -> Result<Target, Failure> {
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

/// Name of the sensor of a stream or a log that has none.
const SENSOR: &str = "front";
/// Bytes of telegrams in a chunk.
const CHUNK: usize = 256 * 1024;
/// Telegrams between two reports of progress.
const STEP: u64 = 512;
