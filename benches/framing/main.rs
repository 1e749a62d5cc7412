//! What parsers make of a line that loses bytes in bursts: 400,000 telegrams in four surroundings, in virtual time,
//! the same bytes for each. `cargo bench --bench framing`, `-- --json` for one object per line, `-- --telegrams N`
//! for another number per surrounding.

#[path = "../support/figures.rs"]
#[allow(dead_code)] // Benches of time use more of it.
mod figures;
#[path = "../../hub/lms/tests/line/mod.rs"]
mod line;
mod rivals;

use figures::{Cell, Figure, Target};
use line::Line;
use line::account::{Account, framer};
use line::scene::Scene;
use rivals::{Discarding, Rewinding};

/// Telegrams of one line; a surrounding is as many lines as it needs, each with a seed of its own.
const LINE: usize = 2_000;
/// Place of ours among the parsers.
const HUB: usize = 2;

fn main() {
    let arguments: Vec<String> = std::env::args().collect();
    let json = arguments.iter().any(|argument| argument == "--json");
    let named = arguments.iter().position(|argument| argument == "--telegrams");
    let telegrams = named.map_or(100_000, |at| {
        arguments.get(at + 1).and_then(|n| n.parse().ok()).expect("--telegrams needs a number")
    });
    let mut all = [Account::default(); 3];
    let mut cells = Vec::new();
    for (number, scene) in Scene::ALL.into_iter().enumerate() {
        let mut accounts = [Account::default(); 3];
        for piece in 0..usize::div_ceil(telegrams, LINE) {
            let seed = (number << 32 | piece) as u64;
            let line = Line::new(scene, LINE.min(telegrams - piece * LINE), seed);
            let [discarding, rewinding, speculative] = &mut accounts;
            discarding.take(&line, &mut Discarding::new(line.header));
            rewinding.take(&line, &mut Rewinding::new(line.header));
            speculative.take(&line, &mut framer(&line));
        }
        for (all, account) in all.iter_mut().zip(accounts) {
            *all += account;
        }
        cells.extend(table(scene.name(), &accounts));
    }
    cells.extend(table("all surroundings", &all));
    figures::print("framing", json, &promises(&all[HUB]));
    figures::print_cells("framing", json, &cells);
}

/// What must hold for ours.
fn promises(hub: &Account) -> [Figure; 3] {
    let figure = |name, unit, value, most| {
        let target = Target::Most(most);
        Figure { name, unit, hub: vec![value], floor: Vec::new(), target }
    };
    [
        figure("intact, not delivered", "1", hub.intact_lost as f64, 0.0),
        figure("wrong content, not marked", "1", hub.wrong_clean as f64, 0.0),
        figure("latest telegram", "ms", hub.extra_max_ms(), 2.1),
    ]
}

/// A row for each parser.
fn table(scene: &str, accounts: &[Account; 3]) -> Vec<Cell> {
    let parsers = ["six states, discard", "rewind to STX + 1", "hub"];
    let mut cells = Vec::new();
    for (parser, account) in parsers.into_iter().zip(accounts) {
        let Account { telegrams, damaged, lost, intact_lost, wrong, wrong_clean, held, .. } = *account;
        let columns = [
            ("telegrams", "1", telegrams as f64),
            ("damaged", "1", damaged as f64),
            ("lost", "%", lost as f64 * 100.0 / telegrams as f64),
            ("intact, lost", "1", intact_lost as f64),
            ("wrong", "1", wrong as f64),
            ("wrong, not marked", "1", wrong_clean as f64),
            ("held", "1", held as f64),
            ("mean extra", "ms", account.extra_mean_ms()),
            ("most extra", "ms", account.extra_max_ms()),
        ];
        cells.extend(columns.map(|(column, unit, value)| Cell {
            table: scene.into(),
            row: parser.into(),
            column: column.into(),
            unit,
            values: vec![value],
        }));
    }
    cells
}
