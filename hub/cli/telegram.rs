//! `scanhub telegram` on the command line.

use std::path::PathBuf;

use clap::{Args, Subcommand};
use scanhub_tools::telegram::DecodeOptions;

#[derive(Args, Debug)]
pub(crate) struct Telegram {
    #[command(subcommand)]
    pub(crate) way: Way,
}

#[derive(Debug, Subcommand)]
pub(crate) enum Way {
    /// Decode bytes to text: the telegrams in a recording, a pipe, or text such as 02 00 01 00 31 15 12
    Decode(Decode),
}

#[derive(Args, Debug)]
pub(crate) struct Decode {
    /// File with the bytes, raw or as text, or an MCAP recording; - or nothing is stdin
    file: Option<PathBuf>,
    /// Decode only this sensor, if the recording has several
    #[arg(long, value_name = "NAME")]
    sensor: Option<String>,
    /// Measuring mode of the values, for example 0x01 [default: the mode in the telegrams]
    #[arg(long, value_name = "BYTE")]
    mode: Option<String>,
    /// Print every value of long lists
    #[arg(long)]
    all: bool,
}

impl Decode {
    pub(crate) fn options(&self, json: bool) -> DecodeOptions {
        let Decode { file, sensor, mode, all } = self;
        DecodeOptions { file: file.clone(), sensor: sensor.clone(), mode: mode.clone(), all: *all, json }
    }
}
