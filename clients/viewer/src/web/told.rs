//! The lines of `web`: where it is, who comes and goes, why nobody can, and what is not served.

use std::io::Write;

use crate::server::{Event, Visit};
use scanhub_schema::Failure;
use serde::Serialize;

use super::{WEB_PORT, WebOptions};
use scanhub_verbs::output::{End, Output};

/// Prints the URLs of the page. As text, prints also what a user should know about access: with a local address the flags for
/// other machines, and with `--open` a warning.
pub(crate) fn ready(output: &mut Output<'_>, urls: &[String], options: &WebOptions) -> Result<(), End> {
    #[derive(Serialize)]
    struct Ready<'a> {
        class: &'static str,
        url: &'a str,
        urls: &'a [String],
        pid: u32,
    }
    let url = urls.first().map_or("", String::as_str);
    if options.json {
        return output.json(&Ready { class: "ready", url, urls, pid: std::process::id() });
    }
    output.line(|line| write!(line, "ready {url}"))?;
    if let [_, others @ ..] = urls
        && !others.is_empty()
    {
        output.line(|line| write!(line, "or {}", others.join(" ")))?;
    }
    if !options.listen.ip().is_loopback() {
        if !options.open {
            return Ok(());
        }
        let warning = "anyone who can reach this address can watch; to restrict that: --token WORD";
        return output.line(|line| write!(line, "{warning}"));
    }
    let port = match options.listen.port() {
        WEB_PORT => String::new(),
        port => format!(":{port}"),
    };
    let token = match (&options.token_file, &options.token) {
        (Some(file), _) => format!("--token-file {}", file.display()),
        (None, token) => format!("--token {}", token.as_deref().unwrap_or("WORD")),
    };
    output.line(|line| write!(line, "for other machines: --listen 0.0.0.0{port} {token}"))
}

/// Prints why there is no hub to serve yet, and the command that reaches another one.
pub(crate) fn no_hub(output: &mut Output<'_>, failure: &Failure) -> Result<(), End> {
    output.line(|line| write!(line, "{}; {}", failure.message, failure.hint))
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
