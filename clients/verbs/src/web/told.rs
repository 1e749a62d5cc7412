//! The lines of `web`: where it is, who comes and goes, why nobody can, and what is not served.

use std::io::Write;

use ::web::{Event, Visit};
use serde::Serialize;

use crate::output::{End, Output};

/// Prints the address; as text also the flags for access from other machines, if the address is local.
pub(crate) fn ready(output: &mut Output<'_>, url: &str, is_local: bool, json: bool) -> Result<(), End> {
    #[derive(Serialize)]
    struct Ready<'a> {
        class: &'static str,
        url: &'a str,
        pid: u32,
    }
    match json {
        true => output.json(&Ready { class: "ready", url, pid: std::process::id() }),
        false => {
            output.line(|line| write!(line, "ready {url}"))?;
            match is_local {
                true => output.line(|line| write!(line, "for other machines: --listen 0.0.0.0 --token WORD")),
                false => Ok(()),
            }
        }
    }
}

pub(crate) fn event(output: &mut Output<'_>, event: &Event, json: bool) -> Result<(), End> {
    match event {
        Event::Viewer(visit) => client(output, visit, json),
        Event::Short(error) => {
            let hint = "raise the limit of descriptors: ulimit -n";
            short(output, &format!("cannot accept viewers: {error}"), hint, json)
        }
    }
}

fn client(output: &mut Output<'_>, visit: &Visit, json: bool) -> Result<(), End> {
    #[derive(Serialize)]
    struct Client {
        class: &'static str,
        address: String,
        came: bool,
        skipped: u64,
        clients: usize,
    }
    let Visit { address, came, skipped, viewers } = *visit;
    let word = if came { "came" } else { "went" };
    match json {
        true => {
            let address = address.to_string();
            output.json(&Client { class: "client", address, came, skipped, clients: viewers })
        }
        false => output.line(|line| write!(line, "{address} {word}, {viewers} here, {skipped} skipped")),
    }
}

/// Something is too short for more than there is; it goes on with that, so it is no end.
pub(crate) fn short(output: &mut Output<'_>, message: &str, hint: &str, json: bool) -> Result<(), End> {
    #[derive(Serialize)]
    struct Short<'a> {
        class: &'static str,
        message: &'a str,
        hint: &'a str,
    }
    match json {
        true => output.json(&Short { class: "web_short", message, hint }),
        false => output.line(|line| write!(line, "{message}; {hint}")),
    }
}
