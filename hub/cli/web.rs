//! `scanhub web` on the command line.

use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use clap::Args;
use scanhub_files::regular;
use scanhub_schema::{Failure, Kind};
use scanhub_viewer::WebOptions;

use super::{Everywhere, Limits};

#[derive(Args, Debug)]
pub(crate) struct Web {
    /// Sensors to show [default: all]
    #[arg(value_name = "SENSOR")]
    sensors: Vec<String>,
    /// Address to listen on: an IP address or localhost, a port, or both. 0.0.0.0 or :: for other machines, which needs --token. If the
    /// port is in use, the next free one
    #[arg(long, default_value = "127.0.0.1:8080", value_name = "ADDRESS:PORT", value_parser = listen_address)]
    listen: SocketAddr,
    /// Word that page and viewers must know: it goes into the address, as ?token=WORD. It travels unencrypted, and other users
    /// of this machine see it in the list of processes, unless it comes from the environment or --token-file
    #[arg(long, value_name = "WORD", env = "SCANHUB_WEB_TOKEN", hide_env_values = true, value_parser = word)]
    token: Option<String>,
    /// File with the word as its only line, which only this user can read. It goes before --token
    #[arg(long, value_name = "FILE")]
    token_file: Option<PathBuf>,
    /// Serve everyone who can reach the address, without a token
    #[arg(long, conflicts_with_all = ["token", "token_file"])]
    open: bool,
    /// Accept viewers that are served from this URL. Can be repeated
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

/// Port that `web` listens on if `--listen` names only an address.
const DEFAULT_PORT: u16 = scanhub_viewer::WEB_PORT;

/// Parses `ADDRESS:PORT`, an address without a port, or a port without an address, which means this machine only, as does
/// `localhost`.
fn listen_address(text: &str) -> Result<SocketAddr, String> {
    let without_brackets = text.strip_prefix('[').and_then(|rest| rest.strip_suffix(']')).unwrap_or(text);
    if let Ok(address) = text.parse() {
        return Ok(address);
    }
    if let Ok(ip) = without_brackets.parse::<IpAddr>() {
        return Ok(SocketAddr::new(ip, DEFAULT_PORT));
    }
    if text == "localhost" {
        return Ok(SocketAddr::from((Ipv4Addr::LOCALHOST, DEFAULT_PORT)));
    }
    let port = text.strip_prefix("localhost:").or_else(|| text.strip_prefix(':')).unwrap_or(text);
    if let Ok(port) = port.parse() {
        return Ok(SocketAddr::from((Ipv4Addr::LOCALHOST, port)));
    }
    Err("use localhost or an IP address, a port, or both, such as 8090, 0.0.0.0 or [::]:8090".to_owned())
}

/// It goes into an address as it is.
fn word(text: &str) -> Result<String, String> {
    let is_plain = |sign: char| sign.is_ascii_alphanumeric() || "-._~".contains(sign);
    match !text.is_empty() && text.chars().all(is_plain) {
        true => Ok(text.to_owned()),
        false => Err("letters, digits and - . _ ~".to_owned()),
    }
}

/// Returns the token in `file`.
///
/// # Errors
///
/// [`Kind::Input`] if it cannot be read, [`Kind::Configuration`] if it contains no token, or if others can use it.
fn read_token(file: &Path) -> Result<String, Failure> {
    let place = file.display().to_string();
    let unreadable = |error: std::io::Error| regular::unreadable(&place, &error);
    let text = regular::read_text(file, MAX_TOKEN_FILE).map_err(unreadable)?;
    let mode = file.metadata().map_err(unreadable)?.mode() & 0o777;
    if mode & 0o077 != 0 {
        let message = format!("{place} has mode {mode:04o}, so others can use the token");
        return Err(Failure::new(Kind::Configuration, message, "`chmod 600` it"));
    }
    word(text.trim_end()).map_err(|expected| {
        let hint = format!("one line with one word: {expected}");
        Failure::new(Kind::Configuration, format!("{place} contains no token"), hint)
    })
}

/// Maximum size of a file with a token, in bytes.
const MAX_TOKEN_FILE: u64 = 4096;

impl Web {
    pub(crate) fn options(&self, everywhere: &Everywhere) -> Result<WebOptions, Failure> {
        let name = rustix::system::uname().nodename().to_string_lossy().into_owned();
        Ok(WebOptions {
            sensors: self.sensors.clone(),
            listen: self.listen,
            token: self
                .token_file
                .as_deref()
                .map_or(Ok(self.token.clone()), |file| read_token(file).map(Some))?,
            token_file: self.token_file.clone(),
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn listen_takes_a_port_an_address_or_both() {
        for (text, expected) in [
            ("8090", "127.0.0.1:8090"),
            ("0", "127.0.0.1:0"),
            (":8090", "127.0.0.1:8090"),
            ("localhost:8090", "127.0.0.1:8090"),
            ("localhost", "127.0.0.1:8080"),
            ("0.0.0.0", "0.0.0.0:8080"),
            ("::", "[::]:8080"),
            ("[::]", "[::]:8080"),
            ("::1", "[::1]:8080"),
            ("192.168.1.7", "192.168.1.7:8080"),
            ("0.0.0.0:8090", "0.0.0.0:8090"),
            ("[::]:8090", "[::]:8090"),
        ] {
            assert_eq!(listen_address(text), Ok(expected.parse().unwrap()), "{text}");
        }
        for bad in [
            "",
            "65536",
            "-1",
            ":",
            "localhost:",
            "::8090x",
            "robot",
            "robot:8090",
            "0.0.0.0:",
            "1.2.3",
            "[0.0.0.0",
            "http://0.0.0.0",
        ] {
            assert!(listen_address(bad).is_err(), "{bad}");
        }
    }
}
