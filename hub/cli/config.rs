//! `scanhub config` on the command line: what it takes, and how it shows a configuration.

use std::path::PathBuf;

use clap::{Args, Subcommand};
use scanhub_config::{DEFAULT, Link, Value, values};
use scanhub_schema::Failure;
use serde::Serialize;

use super::{Everywhere, Gateway, Run};
use crate::{line, print};

#[derive(Args, Debug)]
pub(crate) struct Config {
    #[command(subcommand)]
    order: Order,
}

#[derive(Debug, Subcommand)]
enum Order {
    /// Print a configuration to start from, with all default values
    Default,
    /// Check the configuration; if it has an error, show the place and exit with 78
    Check {
        /// Check only this file
        file: Option<PathBuf>,
        #[command(flatten)]
        run: Run,
    },
    /// Show every value in effect and its origin
    Show {
        #[command(flatten)]
        run: Run,
    },
}

impl Config {
    pub(crate) fn run(&self, everywhere: &Everywhere) -> Result<(), Failure> {
        let text = match &self.order {
            Order::Default => DEFAULT.trim_end().to_owned(),
            Order::Check { file, run } => {
                let mut sources = run.sources();
                if let Some(file) = file {
                    sources.files = vec![file.clone()];
                }
                let sources = sources.read();
                Gateway::check(&sources, everywhere)?;
                let links = scanhub_config::Config::of(&sources)?.links;
                if everywhere.json { checked_line(&links) } else { checked(&links) }
            }
            Order::Show { run } => {
                let values = values(&run.sources())?;
                if everywhere.json {
                    values.iter().map(line).collect::<Vec<_>>().join("\n")
                } else {
                    table(&values)
                }
            }
        };
        print(&text)
    }
}

#[derive(Serialize)]
struct Checked<'a> {
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
    line(&Checked { class: "checked", links })
}

fn checked(links: &[Link]) -> String {
    let named: Vec<_> = links.iter().map(|link| format!("{} at {}", link.name, link.port.name())).collect();
    let s = if links.len() == 1 { "" } else { "s" };
    format!("ok: {} link{s}: {}", links.len(), named.join(", "))
}

/// Key, value and place, one below the other; what is longer than its column takes the room that it needs.
fn table(values: &[Value]) -> String {
    let width = |of: &dyn Fn(&Value) -> usize| values.iter().map(of).filter(|&len| len <= WIDEST).max();
    let key_width = width(&|value| value.key.len()).unwrap_or_default();
    let text_width = width(&|value| value.text().len()).unwrap_or_default();
    let row = |value: &Value| {
        let (key, text) = (&value.key, value.text());
        format!("{key:key_width$}  {text:text_width$}  {}", value.origin)
    };
    values.iter().map(row).collect::<Vec<_>>().join("\n")
}

/// A column is not made wider than this for the sake of one row.
const WIDEST: usize = 48;
