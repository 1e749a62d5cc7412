//! What parsers make of a line that loses bytes in bursts: 400,000 telegrams in four surroundings, in virtual time,
//! the same bytes for each. `cargo bench --bench framing`, `-- --json` for one object per line, `-- --telegrams N`
//! for another number per surrounding.

#[path = "../../hub/lms/tests/line/mod.rs"]
mod line;
mod rivals;

use line::Line;
use line::account::{Account, framer};
use line::scene::Scene;
use rivals::{Discarding, Rewinding};

/// Telegrams of one line; a surrounding is as many lines as it needs, each with a seed of its own.
const LINE: usize = 2_000;

fn main() {
    let arguments: Vec<String> = std::env::args().collect();
    let json = arguments.iter().any(|argument| argument == "--json");
    let named = arguments.iter().position(|argument| argument == "--telegrams");
    let telegrams = named.map_or(100_000, |at| {
        arguments.get(at + 1).and_then(|n| n.parse().ok()).expect("--telegrams needs a number")
    });
    let mut all = [Account::default(); 3];
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
        print(scene.name(), &accounts, json);
    }
    print("all", &all, json);
}

fn print(scene: &str, accounts: &[Account; 3], json: bool) {
    if !json {
        println!(
            "{scene:<28}{:>9} {:>8} {:>8} {:>7} {:>11} {:>6} {:>11} {:>5} {:>13} {:>12}",
            "telegrams",
            "damaged",
            "lost",
            "lost %",
            "intact lost",
            "wrong",
            "wrong clean",
            "held",
            "mean extra ms",
            "max extra ms"
        );
    }
    for (parser, account) in ["six states, discard", "rewind to STX + 1", "hub"].into_iter().zip(accounts) {
        let Account { telegrams, damaged, lost, intact_lost, wrong, wrong_clean, held, .. } = *account;
        let (mean, max) = (account.extra_mean_ms(), account.extra_max_ms());
        if json {
            let line = serde_json::json!({
                "class": "framing", "scene": scene, "parser": parser, "telegrams": telegrams, "damaged": damaged,
                "lost": lost, "intact_lost": intact_lost, "wrong": wrong, "wrong_clean": wrong_clean, "held": held,
                "extra_mean_ms": mean, "extra_max_ms": max,
            });
            println!("{line}");
        } else {
            println!(
                "  {parser:<26}{telegrams:>9} {damaged:>8} {lost:>8} {:>7.2} {intact_lost:>11} {wrong:>6} \
                 {wrong_clean:>11} {held:>5} {mean:>13.4} {max:>12.3}",
                lost as f64 * 100.0 / telegrams as f64
            );
        }
    }
}
