//! `scanhub config`: its arguments, and the output of a configuration.

use std::path::PathBuf;

use clap::{Args, Subcommand};
use scanhub_config::{DEFAULT, Link, Value, values};
use scanhub_schema::Failure;
use scanhub_verbs::context::Context;
use serde::Serialize;

use super::gateway::Gateway;
use super::run::Run;
use crate::{print, to_json_line};

/// Print a default configuration, check one, or show all values in effect
#[derive(Args, Debug)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Config {
    #[command(subcommand)]
    command: ConfigCommand,
}

const EXAMPLES: &str = "\
Examples:
  scanhub config default > scanhub.toml
  scanhub config check scanhub.toml
  scanhub config show";

#[derive(Debug, Subcommand)]
enum ConfigCommand {
    /// Print a configuration with all default values, as a start for your own
    #[command(after_help = "Example:\n  scanhub config default > scanhub.toml")]
    Default,
    /// Check the configuration. If it has an error, show the position of the error, and exit with code 78
    #[command(after_help = "Example:\n  scanhub config check scanhub.toml")]
    Check {
        /// File to check, in place of those in /etc/scanhub and of --config
        file: Option<PathBuf>,
        #[command(flatten)]
        run: Run,
    },
    /// Show all values in effect, each with its origin
    #[command(after_help = SHOW_EXAMPLES)]
    Show {
        #[command(flatten)]
        run: Run,
    },
}

impl Config {
    pub(crate) fn run(&self, context: &mut Context) -> Result<(), Failure> {
        let text = match &self.command {
            ConfigCommand::Default => DEFAULT.trim_end().to_owned(),
            ConfigCommand::Check { file, run } => {
                let mut sources = run.sources();
                if let Some(file) = file {
                    sources.files = vec![file.clone()];
                }
                let sources = sources.read();
                Gateway::check(&sources, &context.domain)?;
                let links = scanhub_config::Config::of(&sources)?.links;
                if context.json { checked_line(&links) } else { checked(&links) }
            }
            ConfigCommand::Show { run } => {
                let values = values(&run.sources())?;
                if context.json {
                    values.iter().map(to_json_line).collect::<Vec<_>>().join("\n")
                } else {
                    table(&values)
                }
            }
        };
        print(&text)
    }
}

#[derive(Serialize)]
struct CheckReport<'a> {
    class: &'static str,
    links: Vec<CheckedLink<'a>>,
}

#[derive(Serialize)]
struct CheckedLink<'a> {
    name: &'a str,
    port: String,
}

fn checked_line(links: &[Link]) -> String {
    let links = links.iter().map(|link| CheckedLink { name: &link.name, port: link.port.name() }).collect();
    to_json_line(&CheckReport { class: "checked", links })
}

fn checked(links: &[Link]) -> String {
    let named: Vec<_> = links.iter().map(|link| format!("{} at {}", link.name, link.port.name())).collect();
    let s = if links.len() == 1 { "" } else { "s" };
    format!("ok: {} link{s}: {}", links.len(), named.join(", "))
}

/// Formats keys, values and origins as a table. A text that is longer than its column is not cut.
fn table(values: &[Value]) -> String {
    let width =
        |of: &dyn Fn(&Value) -> usize| values.iter().map(of).filter(|&len| len <= MAX_COLUMN_WIDTH).max();
    let key_width = width(&|value| value.key.len()).unwrap_or_default();
    let text_width = width(&|value| value.text().len()).unwrap_or_default();
    let row = |value: &Value| {
        let (key, text) = (&value.key, value.text());
        format!("{key:key_width$}  {text:text_width$}  {}", value.origin)
    };
    values.iter().map(row).collect::<Vec<_>>().join("\n")
}

/// Maximum width of a column. Longer texts do not widen it.
const MAX_COLUMN_WIDTH: usize = 48;

const SHOW_EXAMPLES: &str = "\
Examples:
  scanhub config show
  scanhub config show --config robot.toml --set link.front.angle=100";
