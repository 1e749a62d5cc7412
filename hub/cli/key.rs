//! `scanhub key` on the command line.

use std::io::Write;
use std::path::PathBuf;

use clap::{Args, Subcommand};
use scanhub_schema::Failure;

#[derive(Args, Debug)]
pub(crate) struct Key {
    #[command(subcommand)]
    order: Order,
}

#[derive(Debug, Subcommand)]
enum Order {
    /// Make a file with a new key, readable for this user only
    New {
        /// The file; it must not exist
        file: PathBuf,
    },
}

impl Key {
    pub(crate) fn run(&self, json: bool, out: &mut dyn Write) -> Result<(), Failure> {
        let Order::New { file } = &self.order;
        scanhub_network::new_key(file, json, out)
    }
}
