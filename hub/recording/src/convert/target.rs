//! What a recording becomes, by the name of the file and the options. Refuses to know how.

use std::path::Path;

use schema::{Failure, Kind};

use super::ConvertOptions;
use crate::Form;

/// What a recording becomes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Target {
    /// A recording again, of this form.
    Recording(Form),
    /// An MCAP file with only messages of ROS 2.
    Ros2,
    /// A row of columns for each scan.
    Csv,
}

impl Target {
    /// The target as a word.
    pub fn name(self) -> &'static str {
        match self {
            Target::Recording(form) => form_name(form),
            Target::Ros2 => "ROS 2",
            Target::Csv => "CSV",
        }
    }
}

/// What the name of the file and the options tell.
pub(super) fn target_of(options: &ConvertOptions) -> Result<Target, Failure> {
    let target = ending(&options.output)?;
    let usage = |message: &str, hint: &str| Err(Failure::new(Kind::Usage, message, hint));
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
