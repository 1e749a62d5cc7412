//! `scanhub web` on the command line.

use std::net::SocketAddr;
use std::path::PathBuf;

use clap::Args;
use schema::Failure;
use verbs::WebOptions;

use super::{Everywhere, Limits};

#[derive(Args, Debug)]
pub(crate) struct Web {
    /// Sensors to show [default: all]
    #[arg(value_name = "SENSOR")]
    sensors: Vec<String>,
    /// Address to listen on. If the port is in use, the next free one. An address that other machines reach needs --token
    #[arg(long, default_value = "127.0.0.1:8080", value_name = "ADDRESS:PORT")]
    listen: SocketAddr,
    /// Word that page and viewers must know: it goes into the address, as ?token=WORD. It travels unencrypted
    #[arg(long, value_name = "WORD", env = "SCANHUB_WEB_TOKEN", hide_env_values = true, value_parser = word)]
    token: Option<String>,
    /// Let everybody look who reaches the address, without a token
    #[arg(long, conflicts_with = "token")]
    open: bool,
    /// Let viewers come that are served from this URL. Can be repeated
    #[arg(long = "allow-origin", value_name = "URL")]
    origins: Vec<String>,
    /// Show this recording instead of a hub: a private hub plays it, and the page has the keys of the player. Files: MCAP,
    /// telegram stream or CARMEN log, plain or gzipped
    #[arg(long, value_name = "FILE")]
    pub(crate) replay: Option<PathBuf>,
    /// Start the recording again at its end
    #[arg(long = "loop", requires = "replay")]
    pub(crate) is_looped: bool,
    #[command(flatten)]
    limits: Limits,
}

/// It goes into an address as it is.
fn word(text: &str) -> Result<String, String> {
    let is_plain = |sign: char| sign.is_ascii_alphanumeric() || "-._~".contains(sign);
    match !text.is_empty() && text.chars().all(is_plain) {
        true => Ok(text.to_owned()),
        false => Err("letters, digits and - . _ ~".to_owned()),
    }
}

impl Web {
    pub(crate) fn options(&self, everywhere: &Everywhere) -> Result<WebOptions, Failure> {
        let name = rustix::system::uname().nodename().to_string_lossy().into_owned();
        Ok(WebOptions {
            sensors: self.sensors.clone(),
            listen: self.listen,
            token: self.token.clone(),
            open: self.open,
            origins: self.origins.clone(),
            names: vec![name],
            json: everywhere.json,
            bounds: self.limits.bounds(),
            places: everywhere.places()?,
        })
    }
}

/// What it is for, for the end of the help.
pub(crate) const VIEWERS: &str = "\
Open the printed address in a browser. Foxglove and Lichtblick: open connection, Foxglove WebSocket, the same address with ws:.";
