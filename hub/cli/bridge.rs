//! `scanhub bridge`, which starts the program scanhub-bridge. That program parses its own arguments. It is a separate
//! program because few users need it, and it has five times as many dependencies as everything else.

use std::ffi::OsString;
use std::os::unix::process::CommandExt;
use std::process::Command;

use clap::Args;
use scanhub_schema::{Failure, Kind};
use scanhub_tools::bridge_program::{PROGRAM, find, search_directories};
use scanhub_verbs::context::Context;

/// Send and receive topics over Zenoh, through a router or as a router (program scanhub-bridge)
#[derive(Args, Debug)]
#[command(disable_help_flag = true)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Bridge {
    /// Arguments of scanhub-bridge, such as --help
    #[arg(trailing_var_arg = true, allow_hyphen_values = true, value_name = "ARGS")]
    arguments: Vec<OsString>,
}

const EXAMPLES: &str = "\
Examples:
  scanhub bridge --listen tcp/0.0.0.0:7447
  scanhub bridge --connect tcp/robot:7447 --publish --name robot1=5f3a12bc00d1e2f3
  scanhub bridge --help";

impl Bridge {
    /// Replaces this process by scanhub-bridge. Searches the directory of this program first, and then `PATH`.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Configuration`] if scanhub-bridge is not found, has another version, or cannot be started.
    pub(crate) fn run(&self, context: &mut Context) -> Result<(), Failure> {
        // Join the error and its remedy in one line.
        let program = find(&search_directories()).map_err(|Failure { kind, message, hint }| {
            Failure::new(kind, format!("{message}; {hint}"), "")
        })?;
        let mut command = Command::new(&program);
        command.args(["--domain", &context.domain.name]);
        if let Some(root) = &context.domain.root {
            command.arg("--root").arg(root);
        }
        if context.json {
            command.arg("--json");
        }
        let error = command.args(&self.arguments).exec();
        let what = format!("cannot run {PROGRAM} ({}): {error}", program.display());
        Err(Failure::new(Kind::Configuration, what, "it must be a program that this user may run"))
    }
}
