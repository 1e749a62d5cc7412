//! The few things that can be asked of a bench: `--json`, `--quick`, `--draw DIR`, `--pairs N`, `--seconds N`,
//! `--count N`.

use std::path::PathBuf;

use super::Outcome;

/// What was asked for; what was not is the bench's own.
#[derive(Clone, Debug, Default)]
pub(crate) struct Options {
    /// One line of JSON per measurement instead of the table.
    pub(crate) json: bool,
    /// Less of it, in a few minutes, where a bench is long.
    pub(crate) quick: bool,
    /// Where charts go, as SVG; without it none is drawn. A bench that has no charts has no use for it.
    pub(crate) draw: Option<PathBuf>,
    pairs: Option<usize>,
    seconds: Option<u64>,
    count: Option<usize>,
}

impl Options {
    pub(crate) fn parse(words: &[String]) -> Outcome<Options> {
        let mut options = Options::default();
        let mut words = words.iter();
        while let Some(word) = words.next() {
            let mut value = || {
                // Cargo says --bench to every bench.
                let value = words.next().filter(|value| *value != "--bench");
                value.ok_or_else(|| format!("{word} needs a value"))
            };
            match word.as_str() {
                "--json" => options.json = true,
                "--quick" => options.quick = true,
                "--draw" => options.draw = Some(value()?.into()),
                "--pairs" => options.pairs = Some(number(word, value()?)?),
                "--seconds" => options.seconds = Some(number(word, value()?)?),
                "--count" => options.count = Some(number(word, value()?)?),
                "--bench" => {}
                _ => {
                    return Err(format!(
                        "{word}? --json, --quick, --draw DIR, --pairs N, --seconds N, --count N"
                    )
                    .into());
                }
            }
        }
        Ok(options)
    }

    /// Pairs of a run of the hub and one of the floor.
    pub(crate) fn pairs(&self) -> usize {
        self.pairs_or(5)
    }

    /// The same, where five are not what a bench does by itself.
    pub(crate) fn pairs_or(&self, default: usize) -> usize {
        self.pairs.unwrap_or(default).clamp(1, 100)
    }

    /// Length of a run, if the bench is one of time.
    pub(crate) fn seconds(&self, default: u64) -> u64 {
        self.seconds.unwrap_or(default).clamp(1, 3600)
    }

    /// Number of telegrams or repetitions, if the bench is one of counts.
    pub(crate) fn count(&self, default: usize) -> usize {
        self.count.unwrap_or(default).clamp(1, 1_000_000)
    }
}

/// `value` as a number, at least one.
fn number<T: TryFrom<u64>>(flag: &str, value: &str) -> Outcome<T> {
    let number =
        value.parse::<u64>().ok().filter(|&number| number > 0).and_then(|number| number.try_into().ok());
    Ok(number.ok_or_else(|| format!("{flag} {value}? a number of at least 1"))?)
}
