//! What is generated from the definition of the command line: completions for shells, and manual pages. It knows no verb.

use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use clap_complete::shells;
use scanhub_files::output;
use scanhub_schema::{Failure, Kind};

use super::{command, complete};
use crate::print_own;

#[derive(Args, Debug)]
pub(crate) struct Completions {
    /// Shell to print for
    shell: Shell,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum Shell {
    Bash,
    Zsh,
    Fish,
}

impl Completions {
    /// [`Kind::Failed`] if it cannot be written.
    pub(crate) fn run(&self) -> Result<(), Failure> {
        let mut text = Vec::new();
        let command = &mut command();
        match self.shell {
            Shell::Bash => clap_complete::generate(shells::Bash, command, NAME, &mut text),
            Shell::Zsh => clap_complete::generate(shells::Zsh, command, NAME, &mut text),
            Shell::Fish => clap_complete::generate(shells::Fish, command, NAME, &mut text),
        }
        let text = String::from_utf8_lossy(&text);
        let text = text.trim_end();
        // The definition does not know the names of the hub.
        match self.shell {
            Shell::Bash => print_own(&format!("{text}\n{}", complete::BASH.trim_end())),
            // The last lines of the script call functions defined before them.
            Shell::Zsh => {
                let (head, body) = text.split_once('\n').unwrap_or((text, ""));
                let body = body.replace(":_default'", ":_scanhub_live'");
                print_own(&format!("{head}\n{}\n{body}", complete::ZSH.trim_end()))
            }
            Shell::Fish => print_own(&format!("{text}\n{}", complete::FISH.trim())),
        }
    }
}

#[derive(Args, Debug)]
pub(crate) struct Man {
    /// Write one page per verb to this directory, scanhub-run.1 ..; without it, print the page of the program
    #[arg(value_name = "DIR")]
    directory: Option<PathBuf>,
}

impl Man {
    /// [`Kind::Output`] if the directory cannot be written to, [`Kind::Failed`] if stdout cannot.
    pub(crate) fn run(&self) -> Result<(), Failure> {
        match &self.directory {
            Some(directory) => write_pages(directory),
            None => {
                let mut page = Vec::new();
                let rendered = clap_mangen::Man::new(command()).render(&mut page);
                rendered.map_err(|error| Failure::new(Kind::Failed, format!("no page: {error}"), ""))?;
                print_own(String::from_utf8_lossy(&page).trim_end())
            }
        }
    }
}

fn write_pages(directory: &Path) -> Result<(), Failure> {
    output::create_directory(directory)?;
    let mut command = command().disable_help_subcommand(true);
    command.build();
    write_page(command, directory)
}

/// Writes the page of `command` and those of its subcommands. Pages of an earlier version are replaced.
fn write_page(command: clap::Command, directory: &Path) -> Result<(), Failure> {
    for command in command.get_subcommands().filter(|command| !command.is_hide_set()) {
        write_page(command.clone(), directory)?;
    }
    let man = clap_mangen::Man::new(command);
    let (path, mut page) = (directory.join(man.get_filename()), Vec::new());
    man.render(&mut page).map_err(|error| output::unwritable(&path, &error))?;
    output::write(&path, &page, true)
}

const NAME: &str = env!("CARGO_PKG_NAME");
