//! `scanhub telegram` on the command line.

use std::path::PathBuf;

use clap::{Args, Subcommand};
use tools::telegram::{DecodeOptions, EncodeOptions};

#[derive(Args, Debug)]
pub(crate) struct Telegram {
    #[command(subcommand)]
    pub(crate) way: Way,
}

#[derive(Debug, Subcommand)]
pub(crate) enum Way {
    /// Decode bytes to text: the telegrams in a recording, a pipe, or text such as 02 00 01 00 31 15 12
    Decode(Decode),
    /// Encode a telegram and print its bytes; nothing is sent
    #[command(after_help = tools::telegram::names())]
    Encode(Encode),
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

#[derive(Args, Debug)]
pub(crate) struct Encode {
    /// Name of the telegram and its values; see below
    #[arg(required = true, value_name = "NAME")]
    words: Vec<String>,
    /// The sensor's own address, 0 to 127; 0 is all sensors
    #[arg(long, default_value_t = 0, value_name = "N")]
    address: u8,
    /// Status byte of a reply [default: 0x10]
    #[arg(long, value_name = "BYTE")]
    status: Option<String>,
    /// Print raw bytes instead of hexadecimal text
    #[arg(long, conflicts_with = "json")]
    raw: bool,
}

impl Encode {
    pub(crate) fn options(&self, json: bool) -> EncodeOptions {
        EncodeOptions {
            words: self.words.clone(),
            address: self.address,
            status: self.status.clone(),
            raw: self.raw,
            json,
        }
    }
}
