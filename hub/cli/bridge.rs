//! `scanhub bridge` on the command line: another program, which knows its own arguments. It is one of its own because few
//! need it, and what it is built of is five times as much as all the rest.

use std::convert::Infallible;
use std::ffi::OsString;
use std::io::ErrorKind;
use std::os::unix::process::CommandExt;
use std::path::PathBuf;
use std::process::Command;

use clap::Args;
use schema::{Failure, Kind};

use super::Everywhere;

#[derive(Args, Debug)]
#[command(disable_help_flag = true)]
pub(crate) struct Bridge {
    /// Arguments of scanhub-bridge, among them --help
    #[arg(trailing_var_arg = true, allow_hyphen_values = true, value_name = "ARGS")]
    arguments: Vec<OsString>,
}

/// The program.
const PROGRAM: &str = "scanhub-bridge";

impl Bridge {
    /// Becomes the program: the one beside this one, else the one that is found by its name.
    ///
    /// [`Kind::Configuration`] if there is none.
    pub(crate) fn run(&self, everywhere: &Everywhere) -> Result<Infallible, Failure> {
        let beside = std::env::current_exe().ok().map(|own| own.with_file_name(PROGRAM));
        let beside = beside.filter(|path| path.is_file()).unwrap_or_else(|| PathBuf::from(PROGRAM));
        let mut command = Command::new(beside);
        command.args(["--domain", &everywhere.domain]);
        if let Some(root) = &everywhere.root {
            command.arg("--root").arg(root);
        }
        if everywhere.json {
            command.arg("--json");
        }
        let error = command.args(&self.arguments).exec();
        let what = match error.kind() {
            ErrorKind::NotFound => format!("{PROGRAM} is not installed"),
            _ => format!("cannot run {PROGRAM}: {error}"),
        };
        let hint = "in the directory of scanhub's source: cargo install --path clients/bridge";
        Err(Failure::new(Kind::Configuration, what, hint))
    }
}
