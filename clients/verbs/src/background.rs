//! `scanhub background`: shows, resets, freezes, thaws, saves and loads the background model of a sensor. Files are
//! handled here; the hub gets models only.

use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use clap::{Args, Subcommand};
use scanhub_client::request;
use scanhub_files::output::{self, Target};
use scanhub_files::regular;
use scanhub_schema::{
    Age, Background, BackgroundHead, Failure, Kind, Request, SavedModel, Shown, Verb, as_json, check_sensor,
};
use serde::Serialize;

use crate::context::Context;
use crate::control::confirm;
use crate::names::as_word;
use crate::output::{Output, quiet};
use crate::text;

/// Show, reset, freeze, save or load the background model of a sensor
#[derive(Args, Clone, Debug)]
#[command(after_help = "Example:\n  scanhub background front save front.json")]
pub struct BackgroundArgs {
    /// The sensor
    pub sensor: String,
    /// Request about its model.
    #[command(subcommand)]
    pub order: ModelOrder,
}

/// Request about a background model.
#[derive(Clone, Debug, PartialEq, Eq, Subcommand)]
pub enum ModelOrder {
    /// Show how many beams are known; with --json, every range
    #[command(after_help = "Example:\n  scanhub background front show")]
    Show,
    /// Forget the model and learn it again
    #[command(after_help = "Example:\n  scanhub background front reset")]
    Reset,
    /// Freeze the model: stop learning
    #[command(after_help = "Example:\n  scanhub background front freeze")]
    Freeze,
    /// Continue learning
    #[command(after_help = "Example:\n  scanhub background front thaw")]
    Thaw,
    /// Save the model to a file
    #[command(after_help = "Example:\n  scanhub background front save front.json")]
    Save {
        /// The file; - is stdout
        file: PathBuf,
        /// Overwrite an existing file
        #[arg(short, long)]
        force: bool,
    },
    /// Load a saved model
    #[command(after_help = "Example:\n  scanhub background front load front.json")]
    Load {
        /// The file; - is stdin
        file: PathBuf,
        /// Accept a model of another sensor
        #[arg(long)]
        any_sensor: bool,
    },
}

impl BackgroundArgs {
    /// Sends the request to the hub and writes a line to stdout. Reads the model to load before it installs handlers
    /// for signals, because a flag would not end the read of a terminal.
    ///
    /// # Errors
    ///
    /// - The errors of [`saved_model`].
    /// - [`Kind::Configuration`] if the hub refuses a model.
    /// - [`Kind::Output`] if a file exists or cannot be written.
    /// - [`Kind::Failed`] if there is no model yet to be saved.
    /// - The errors of [`ControlArgs::run`](crate::control::ControlArgs::run).
    pub fn run(&self, context: &mut Context) -> Result<(), Failure> {
        let json = context.json;
        let places = context.domain.places()?;
        let sensor = &self.sensor;
        let loaded = match &self.order {
            ModelOrder::Load { file, any_sensor } => {
                Some(saved_model(file, sensor, *any_sensor, &mut io::stdin())?)
            }
            _ => None,
        };
        let stop = context.signals.stop()?;
        as_word(check_sensor(sensor))?;
        let ask = |verb| request(&places, &Request::new(sensor, verb), &stop);
        let mut output = Output::new(&mut context.out);
        let verb = match &self.order {
            ModelOrder::Show => {
                let Shown { model, kept_wall_ns } = shown(sensor, ask(Verb::Show)?)?;
                return quiet(if json {
                    output.json(&Kept { model: as_json(sensor, &model), kept_wall_ns })
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
            ModelOrder::Save { file, force } => {
                if file != Path::new(STANDARD) {
                    Target::open(file)?.check(*force)?;
                }
                let Shown { model, .. } = shown(sensor, ask(Verb::Show)?)?;
                return save(file, *force, sensor, &model, json, &mut output);
            }
            ModelOrder::Reset => Verb::Reset,
            ModelOrder::Freeze => Verb::Freeze,
            ModelOrder::Thaw => Verb::Thaw,
            ModelOrder::Load { .. } => Verb::Load,
        };
        match &loaded {
            Some(model) => request(&places, &Request::load(sensor, model), &stop)?,
            None => ask(verb)?,
        };
        let is_frozen = verb == Verb::Reset && !json && shown(sensor, ask(Verb::Show)?)?.model.is_frozen();
        confirm(&mut output, json, sensor, verb)?;
        if is_frozen {
            let hint = format!("it is frozen: nothing is learned until `scanhub background {sensor} thaw`");
            quiet(output.line(|line| write!(line, "{hint}")))?;
        }
        Ok(())
    }
}

/// What is shown: a model, and when it was kept for the next hub.
#[derive(Serialize)]
struct Kept<M> {
    #[serde(flatten)]
    model: M,
    #[serde(skip_serializing_if = "Option::is_none")]
    kept_wall_ns: Option<u64>,
}

/// The time since 1970.
fn wall() -> Duration {
    SystemTime::UNIX_EPOCH.elapsed().unwrap_or_default()
}

fn shown(sensor: &str, shown: Option<Shown>) -> Result<Shown, Failure> {
    let hint = "client and hub are of different versions";
    shown.ok_or_else(|| {
        Failure::new(Kind::Failed, format!("the hub answered without a model of {sensor}"), hint)
    })
}

/// Writes `model` to `file`, which may replace an existing file if `force`, and reports it to `printed`. Standard output as
/// `file` is `printed` itself.
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
            "learning takes some seconds: `scanhub background {sensor} show`; frozen it learns nothing"
        );
        return Err(Failure::new(
            Kind::Failed,
            format!("the background of {sensor} has no known beam yet"),
            hint,
        ));
    }
    let object = as_json(sensor, model);
    if file == Path::new(STANDARD) {
        return quiet(printed.json(&object));
    }
    let mut content = serde_json::to_vec(&object)
        .map_err(|error| Failure::new(Kind::Failed, format!("the model is no JSON: {error}"), ""))?;
    content.push(b'\n');
    output::write(file, &content, force)?;
    let (BackgroundHead { known_beams, count, generation, .. }, place) = (**model, file.display());
    quiet(if json {
        printed.json(&Saved {
            class: "saved",
            sensor,
            file: place.to_string(),
            generation,
            known_beams,
            count,
        })
    } else {
        printed.line(|line| write!(line, "{sensor}: {known_beams} of {count} beams saved to {place}"))
    })
}

/// Class `saved`.
#[derive(Serialize)]
struct Saved<'a> {
    class: &'static str,
    sensor: &'a str,
    file: String,
    generation: u32,
    known_beams: u16,
    count: u16,
}

/// The model for `sensor` in `file`, `-` is `input`. It has to be saved from that sensor unless `any_sensor`.
///
/// [`Kind::Input`] with place and reason if it cannot be read or is no model, [`Kind::Configuration`] if it is another
/// sensor's.
pub fn saved_model(
    file: &Path,
    sensor: &str,
    any_sensor: bool,
    input: &mut dyn Read,
) -> Result<Box<Background>, Failure> {
    let (text, place) = if file == Path::new(STANDARD) {
        (
            regular::read_all(input, LONGEST).map_err(|error| regular::unreadable("stdin", &error))?,
            "stdin".to_owned(),
        )
    } else {
        let place = file.display().to_string();
        (regular::read(file, LONGEST).map_err(|error| regular::unreadable(&place, &error))?, place)
    };
    let saved = SavedModel::parse(&text, &place)?;
    if saved.sensor == sensor || any_sensor {
        return Ok(saved.model);
    }
    let message = format!("{place} is the background of {}, not of {sensor}", saved.sensor);
    Err(Failure::new(Kind::Configuration, message, "--any-sensor accepts it anyway"))
}

/// The file that is stdin or stdout.
const STANDARD: &str = "-";
/// Far more bytes than a model of 401 beams has as text, and as it would be if people had laid it out.
const LONGEST: u64 = 1 << 20;
