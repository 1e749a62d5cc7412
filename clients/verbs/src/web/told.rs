//! The lines of `web`: where it is, and who comes and goes.

use std::io::Write;

use ::web::Event;
use serde::Serialize;

use crate::output::{End, Output};

pub(crate) fn ready(output: &mut Output<'_>, url: &str, json: bool) -> Result<(), End> {
    #[derive(Serialize)]
    struct Ready<'a> {
        class: &'static str,
        url: &'a str,
        pid: u32,
    }
    match json {
        true => output.json(&Ready { class: "ready", url, pid: std::process::id() }),
        false => output.line(|line| write!(line, "ready {url}")),
    }
}

pub(crate) fn client(output: &mut Output<'_>, event: &Event, json: bool) -> Result<(), End> {
    #[derive(Serialize)]
    struct Client {
        class: &'static str,
        address: String,
        came: bool,
        skipped: u64,
        clients: usize,
    }
    let Event { address, came, skipped, viewers } = *event;
    let word = if came { "came" } else { "went" };
    match json {
        true => {
            let address = address.to_string();
            output.json(&Client { class: "client", address, came, skipped, clients: viewers })
        }
        false => output.line(|line| write!(line, "{address} {word}, {viewers} here, {skipped} skipped")),
    }
}
