//! Output format of a conversion, from the name of the file and the options.

use std::path::Path;

use schema::{Failure, Kind, Topic};

use super::ConvertOptions;
use crate::Form;

/// What a recording becomes.
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
    /// The target as a word.
    pub fn name(self) -> &'static str {
        match self {
            Target::Recording(form) => form_name(form),
            Target::Ros2 => "ROS 2",
            Target::Csv | Target::MarksCsv => "CSV",
        }
    }
}

/// Returns the output format, and the sensor that the options choose.
///
/// # Errors
///
/// Returns [`Kind::Usage`] if the format is unknown, or an option does not fit it.
pub(super) fn target_of(options: &ConvertOptions) -> Result<(Target, Option<&str>), Failure> {
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

/// What the name of a file tells.
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

/// The form as a word.
pub fn form_name(form: Form) -> &'static str {
    match form {
        Form::Telegrams => "telegram stream",
        Form::Carmen => "CARMEN log",
        Form::Mcap => "MCAP",
    }
}
