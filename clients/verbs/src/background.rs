//! `scanhub background`: shows, resets, freezes, thaws, saves and loads the background model of a sensor. The verb
//! reads and writes the files; the hub receives only models.

use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use clap::{Args, Subcommand};
use scanhub_client::request;
use scanhub_files::output::{self, Target};
use scanhub_files::regular_file;
use scanhub_schema::{
    Age, Background, BackgroundFile, BackgroundHead, Failure, Kind, Request, ResponseModel, Verb, as_json,
    check_sensor,
};
use serde::Serialize;

use crate::context::Context;
use crate::control::confirm;
use crate::names::as_argument;
use crate::output::{Output, verb_result};
use crate::text;

/// Show, reset, freeze, save or load the background model of a sensor
#[derive(Args, Clone, Debug)]
#[command(after_help = "Example:\n  scanhub background front save front.json")]
pub struct BackgroundArgs {
    /// The sensor
    pub sensor: String,
    /// Request about the background model of the sensor.
    #[command(subcommand)]
    pub order: ModelRequest,
}

/// Request about a background model.
#[derive(Clone, Debug, PartialEq, Eq, Subcommand)]
pub enum ModelRequest {
    /// Show how many beams have a known background. With --json, show the range of each beam
    #[command(after_help = "Example:\n  scanhub background front show")]
    Show,
    /// Discard the model and learn it again
    #[command(after_help = "Example:\n  scanhub background front reset")]
    Reset,
    /// Stop learning, and keep the model as it is
    #[command(after_help = "Example:\n  scanhub background front freeze")]
    Freeze,
    /// Continue learning after `freeze`
    #[command(after_help = "Example:\n  scanhub background front thaw")]
    Thaw,
    /// Save the model to a file
    #[command(after_help = "Example:\n  scanhub background front save front.json")]
    Save {
        /// File to write; - is stdout
        file: PathBuf,
        /// Overwrite an existing file
        #[arg(short, long)]
        force: bool,
    },
    /// Load a saved model
    #[command(after_help = "Example:\n  scanhub background front load front.json")]
    Load {
        /// File to read; - is stdin
        file: PathBuf,
        /// Accept a model of another sensor
        #[arg(long)]
        any_sensor: bool,
    },
}

impl BackgroundArgs {
    /// Sends the request to the hub and writes a line to stdout. A model to load is read before the signal handlers are
    /// installed. A handler only sets a flag, which would not interrupt a read from a terminal.
    ///
    /// # Errors
    ///
    /// - The errors of [`saved_model`].
    /// - [`Kind::Configuration`] if the hub rejects a model.
    /// - [`Kind::Output`] if a file exists or cannot be written.
    /// - [`Kind::Failed`] if there is no model to save yet.
    /// - The errors of [`ControlArgs::run`](crate::control::ControlArgs::run).
    pub fn run(&self, context: &mut Context) -> Result<(), Failure> {
        let json = context.json;
        let locations = context.domain.locations()?;
        let sensor = &self.sensor;
        let loaded = match &self.order {
            ModelRequest::Load { file, any_sensor } => {
                Some(saved_model(file, sensor, *any_sensor, &mut io::stdin())?)
            }
            _ => None,
        };
        let stop = context.signals.stop()?;
        as_argument(check_sensor(sensor))?;
        let send = |verb| request(&locations, &Request::new(sensor, verb), &stop);
        let mut output = Output::new(&mut context.out);
        let verb = match &self.order {
            ModelRequest::Show => {
                let ResponseModel { model, kept_wall_ns } = shown(sensor, send(Verb::Show)?)?;
                return verb_result(if json {
                    output.json(&StoredModel { model: as_json(sensor, &model), kept_wall_ns })
                } else {
                    output.line(|line| {
                        write!(line, "{sensor}: ")?;
                        text::background(line, &model)?;
                        match kept_wall_ns.map(Duration::from_nanos) {
                            Some(kept) => write!(line, ", kept {} ago", Age(wall().saturating_sub(kept))),
                            None => Ok(()),
                        }
                    })
                });
            }
            ModelRequest::Save { file, force } => {
                if file != Path::new(STANDARD_STREAM) {
                    Target::open(file)?.check(*force)?;
                }
                let ResponseModel { model, .. } = shown(sensor, send(Verb::Show)?)?;
                return save(file, *force, sensor, &model, json, &mut output);
            }
            ModelRequest::Reset => Verb::Reset,
            ModelRequest::Freeze => Verb::Freeze,
            ModelRequest::Thaw => Verb::Thaw,
            ModelRequest::Load { .. } => Verb::Load,
        };
        match &loaded {
            Some(model) => request(&locations, &Request::load(sensor, model), &stop)?,
            None => send(verb)?,
        };
        let is_frozen = verb == Verb::Reset && !json && shown(sensor, send(Verb::Show)?)?.model.is_frozen();
        confirm(&mut output, json, sensor, verb)?;
        if is_frozen {
            let hint = format!("it is frozen: nothing is learned until `scanhub background {sensor} thaw`");
            verb_result(output.line(|line| write!(line, "{hint}")))?;
        }
        Ok(())
    }
}

/// Model to print, and the time at which the hub saved it for the hub's next run.
#[derive(Serialize)]
struct StoredModel<M> {
    #[serde(flatten)]
    model: M,
    #[serde(skip_serializing_if = "Option::is_none")]
    kept_wall_ns: Option<u64>,
}

/// Returns the wall clock time since 1970.
fn wall() -> Duration {
    SystemTime::UNIX_EPOCH.elapsed().unwrap_or_default()
}

fn shown(sensor: &str, shown: Option<ResponseModel>) -> Result<ResponseModel, Failure> {
    let hint = "client and hub have different versions";
    shown.ok_or_else(|| {
        Failure::new(Kind::Failed, format!("the hub answered without a model of {sensor}"), hint)
    })
}

/// Writes `model` to `file`, and writes a line about the saved file to `printed`. Replaces an existing file if `force`
/// is set. If `file` is standard output, the model goes to `printed`.
fn save(
    file: &Path,
    force: bool,
    sensor: &str,
    model: &Background,
    json: bool,
    printed: &mut Output<'_>,
) -> Result<(), Failure> {
    if model.count == 0 {
        let hint = format!("a scan must arrive first: `scanhub info {sensor}` shows its state");
        return Err(Failure::new(Kind::Failed, format!("{sensor} has no background model yet"), hint));
    }
    if model.known_beams == 0 {
        let hint = format!(
            "learning takes some seconds, and a frozen model does not learn: `scanhub background {sensor} show`"
        );
        return Err(Failure::new(
            Kind::Failed,
            format!("the background of {sensor} has no known beam yet"),
            hint,
        ));
    }
    let object = as_json(sensor, model);
    if file == Path::new(STANDARD_STREAM) {
        return verb_result(printed.json(&object));
    }
    let mut content = serde_json::to_vec(&object)
        .map_err(|error| Failure::new(Kind::Failed, format!("the model is not valid JSON: {error}"), ""))?;
    content.push(b'\n');
    output::write(file, &content, force)?;
    let (BackgroundHead { known_beams, count, generation, .. }, path_text) = (**model, file.display());
    verb_result(if json {
        printed.json(&SavedJson {
            class: "saved",
            sensor,
            file: path_text.to_string(),
            generation,
            known_beams,
            count,
        })
    } else {
        printed.line(|line| write!(line, "{sensor}: {known_beams} of {count} beams saved to {path_text}"))
    })
}

/// JSON line of class `saved`.
#[derive(Serialize)]
struct SavedJson<'a> {
    class: &'static str,
    sensor: &'a str,
    file: String,
    generation: u32,
    known_beams: u16,
    count: u16,
}

/// Reads the model for `sensor` from `file`; `-` stands for `input`. Unless `any_sensor` is set, the model must belong
/// to `sensor`.
///
/// # Errors
///
/// - [`Kind::Input`] with position and reason if the file cannot be read or is not a model.
/// - [`Kind::Configuration`] if the model belongs to another sensor.
pub fn saved_model(
    file: &Path,
    sensor: &str,
    any_sensor: bool,
    input: &mut dyn Read,
) -> Result<Box<Background>, Failure> {
    let (text, path_text) = if file == Path::new(STANDARD_STREAM) {
        (
            regular_file::read_all(input, MAX_FILE_LEN)
                .map_err(|error| regular_file::unreadable("stdin", &error))?,
            "stdin".to_owned(),
        )
    } else {
        let place = file.display().to_string();
        (
            regular_file::read(file, MAX_FILE_LEN)
                .map_err(|error| regular_file::unreadable(&place, &error))?,
            place,
        )
    };
    let saved = BackgroundFile::parse(&text, &path_text)?;
    if saved.sensor == sensor || any_sensor {
        return Ok(saved.model);
    }
    let message = format!("{path_text} is the background of {}, not of {sensor}", saved.sensor);
    Err(Failure::new(Kind::Configuration, message, "--any-sensor accepts it anyway"))
}

/// Name that stands for stdin or stdout.
const STANDARD_STREAM: &str = "-";
/// Maximum length of a model file in bytes. A model of 401 beams is far shorter, even with indentation.
const MAX_FILE_LEN: u64 = 1 << 20;
