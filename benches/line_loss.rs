//! Losses on a line that loses bytes, as in the paper's Fig. 6. Telegrams of five minutes pass the line, which loses
//! 0.135 % of their bytes in bursts. Three parsers read the remaining bytes. No parser can restore a telegram that the
//! line has damaged. If a telegram is missing that the line has not damaged, the parser has discarded it. `--count N`
//! sets the number of telegrams, and `--pairs N` sets the number of lines. The test `hub/drivers/tests/lms/framing.rs`
//! compares the parsers with other content on the line.
//!
//! A telegram counts as *damaged* if it lost at least one byte. A telegram counts as *collateral* if all of its bytes
//! arrived but the parser discarded it. In the paper, 0.135 % of the bytes and 40.8 % of the telegrams were lost.

#[path = "../hub/drivers/tests/lms/line.rs"]
#[allow(dead_code)] // The test uses the other content of the line.
mod line;
mod support;

use std::process::ExitCode;

use line::LineContent;
use line::SimulatedLine;
use line::{DiscardingParser, RewindingParser};
use line::{TelegramCounts, framer};
use support::figures::{self, Cell, Figure, Target};
use support::{Options, Outcome};

/// Number of telegrams on a line, as in the paper: 300 s at 37.5 Hz.
const TELEGRAM_COUNT: usize = 11_250;
const PARSERS: [&str; 3] = ["six states, discard", "rewind to STX + 1", "hub"];
/// Index of the hub's parser.
const HUB_PARSER: usize = 2;

fn main() -> ExitCode {
    support::main(measure)
}

fn measure(options: &Options) -> Outcome<()> {
    let telegrams = options.count(TELEGRAM_COUNT);
    let runs: Vec<LineRun> = (0..options.pairs() as u64).map(|seed| LineRun::new(telegrams, seed)).collect();
    if !options.json {
        println!(
            "{telegrams} telegrams a line, {} lines; the paper lost 0.135 % of bytes, 40.8 % of telegrams",
            runs.len()
        );
    }
    figures::print("line_loss", options.json, &figures(&runs));
    figures::print_cells("line_loss", options.json, &cells(&runs));
    Ok(())
}

/// A line, and the counts of each parser.
struct LineRun {
    bytes_lost_percent: f64,
    stats: [TelegramCounts; 3],
}

impl LineRun {
    fn new(telegrams: usize, seed: u64) -> LineRun {
        let line = SimulatedLine::new(LineContent::Furnished, telegrams, seed);
        let mut accounts = [TelegramCounts::default(); 3];
        let [discarding, rewinding, speculative] = &mut accounts;
        discarding.run_parser(&line, &mut DiscardingParser::new(line.header));
        rewinding.run_parser(&line, &mut RewindingParser::new(line.header));
        speculative.run_parser(&line, &mut framer(&line));
        let lost = line.sent.len() - line.received.len();
        LineRun { bytes_lost_percent: lost as f64 * 100.0 / line.sent.len() as f64, stats: accounts }
    }
}

/// Returns `of` telegrams as a percentage of all telegrams.
fn percent(stats: &TelegramCounts, of: u64) -> f64 {
    of as f64 * 100.0 / stats.telegrams as f64
}

/// Returns the figures of the line, and then those of the hub's parser. They are the columns of the table in the paper.
fn figures(runs: &[LineRun]) -> Vec<Figure> {
    let figure = |name, unit, hub: Vec<f64>, target| Figure { name, unit, hub, baseline: Vec::new(), target };
    let ours =
        |value: fn(&TelegramCounts) -> f64| runs.iter().map(|run| value(&run.stats[HUB_PARSER])).collect();
    let bytes = runs.iter().map(|run| run.bytes_lost_percent).collect();
    vec![
        figure("bytes lost (paper: 0.135)", "%", bytes, Target::None),
        figure("telegrams lost (paper: 40.8)", "%", ours(|stats| percent(stats, stats.lost)), Target::None),
        figure("damaged by the line", "%", ours(|stats| percent(stats, stats.damaged)), Target::None),
        figure("intact, not delivered", "1", ours(|account| account.intact_lost as f64), Target::Max(0.0)),
        figure("wrong, not marked", "1", ours(|account| account.wrong_clean as f64), Target::Max(0.0)),
    ]
}

/// Returns the cells of a table with one row for each parser.
fn cells(runs: &[LineRun]) -> Vec<Cell> {
    type Column = (&'static str, &'static str, fn(&TelegramCounts) -> f64);
    const COLUMNS: [Column; 7] = [
        ("damaged", "1", |stats| stats.damaged as f64),
        ("delivered", "1", |stats| (stats.telegrams - stats.lost) as f64),
        ("collateral: intact, not delivered", "1", |stats| stats.intact_lost as f64),
        ("collateral", "%", |stats| percent(stats, stats.intact_lost)),
        ("telegrams lost", "%", |account| percent(account, account.lost)),
        ("wrong content accepted", "1", |account| account.wrong as f64),
        ("of it unmarked", "1", |account| account.wrong_clean as f64),
    ];
    let mut cells = Vec::new();
    for (parser, name) in PARSERS.into_iter().enumerate() {
        cells.extend(COLUMNS.into_iter().map(|(column, unit, value)| Cell {
            table: "telegrams of a line that loses 0.135 % of the bytes".into(),
            row: name.into(),
            column: column.into(),
            unit,
            values: runs.iter().map(|run| value(&run.stats[parser])).collect(),
        }));
    }
    cells
}
