//! What a bridge costs, and what it loses: how long a scan takes from shared memory to a plain client of Zenoh behind a router,
//! beside a plain publisher; all topics of two sensors for minutes; a router that is killed again and again; a link that is too
//! slow. Routers are bridges that listen. It does not tell what a real network does.
//!
//! `cargo bench -p scanhub-bridge --bench bridge [-- MINUTES] [hop|killed|slow|loss ..]` (default: 10, all), with
//! `cargo build --release` before it.

mod account;
mod hop;
mod killed;
mod loss;
mod relay;
mod slow;
#[path = "../stage/mod.rs"]
mod stage;

use stage::Stage;

/// One row of the table.
struct Row {
    what: String,
    value: String,
    /// What was aimed at, and whether it was reached.
    target: Option<(&'static str, bool)>,
}

fn row(what: &str, value: impl Into<String>, target: Option<(&'static str, bool)>) -> Row {
    Row { what: what.to_owned(), value: value.into(), target }
}

fn main() {
    let words: Vec<String> = std::env::args().skip(1).filter(|word| !word.starts_with("--")).collect();
    let minutes = words.iter().find_map(|word| word.parse().ok()).unwrap_or(10.0);
    let is_wanted = |part: &str| words.iter().all(|word| word.parse::<f64>().is_ok() || word == part);
    type Part<'a> = (&'static str, &'a dyn Fn(&Stage) -> Vec<Row>);
    let loss = |stage: &Stage| loss::rows(stage, minutes);
    let parts: [Part<'_>; 4] =
        [("hop", &hop::rows), ("killed", &killed::rows), ("slow", &slow::rows), ("loss", &loss)];
    for (name, part) in parts {
        if is_wanted(name) || words.iter().any(|word| word == name) {
            let Some(stage) = Stage::new(name) else { return };
            for Row { what, value, target } in part(&stage) {
                let target = target.map_or(String::new(), |(target, is_met)| {
                    format!(" ({target}: {})", if is_met { "met" } else { "missed" })
                });
                println!("{what}: {value}{target}");
            }
        }
    }
}
