//! What goes wrong on the line on purpose. Faults are data: a table of keys, a seed, and the same bytes lost in every
//! run. Applied between the sensor and the port; the sensor knows nothing of them.

use std::fmt;
use std::str::FromStr;

use schema::{Failure, Kind};

/// Why a telegram did not reach the host as it should have, as the truth names it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fault {
    /// A request broke it off.
    Aborted,
    /// Bytes of it were lost on the line.
    Loss,
    /// The host's port had another rate.
    Baud,
    /// Nobody had the port open.
    Unread,
    /// The host did not read, and its buffer was full.
    Overrun,
}

impl Fault {
    /// Its name in the truth.
    pub fn name(self) -> &'static str {
        match self {
            Fault::Aborted => "aborted",
            Fault::Loss => "loss",
            Fault::Baud => "baud",
            Fault::Unread => "unread",
            Fault::Overrun => "overrun",
        }
    }
}

/// The faults of a line, as they are written: `loss=0.00135,burst=1.89`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Faults {
    /// Share of the bytes from sensor to host that are lost, 0 to 1.
    pub loss: f64,
    /// Mean number of bytes lost in a row, 1 or more; the number is geometric.
    pub burst: f64,
}

impl Default for Faults {
    /// None.
    fn default() -> Self {
        Faults { loss: 0.0, burst: 1.0 }
    }
}

impl Faults {
    /// Every key with what it means.
    pub const KEYS: [(&str, &str); 2] = [
        ("loss", "share of the bytes from sensor to host that are lost, 0 to 0.5 [0]"),
        ("burst", "mean number of bytes lost in a row, geometric, 1 to 1000 [1]"),
    ];
}

impl FromStr for Faults {
    type Err = Failure;

    fn from_str(text: &str) -> Result<Self, Failure> {
        let mut faults = Faults::default();
        for part in text.split(',').filter(|part| !part.is_empty()) {
            let (key, value) = part.split_once('=').ok_or_else(|| wrong(part, "is not KEY=VALUE", keys()))?;
            let (target, range) = match key {
                "loss" => (&mut faults.loss, 0.0..=0.5),
                "burst" => (&mut faults.burst, 1.0..=1000.0),
                _ => return Err(wrong(part, "names no fault", keys())),
            };
            let hint = format!("{key} is a number from {} to {}", range.start(), range.end());
            *target = value
                .parse()
                .ok()
                .filter(|number| range.contains(number))
                .ok_or_else(|| wrong(part, "is out of range", hint))?;
        }
        Ok(faults)
    }
}

impl fmt::Display for Faults {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "loss={},burst={}", self.loss, self.burst)
    }
}

/// Loses bytes in bursts, the same ones in every run with the same seed.
#[derive(Clone, Debug)]
pub struct Loss {
    /// Chance that a burst begins with a byte that follows one that got through.
    begin: f64,
    /// Chance that a burst goes on.
    go_on: f64,
    inside: bool,
    random: fastrand::Rng,
}

impl Loss {
    /// The losses of `faults` with `seed`.
    pub fn new(faults: Faults, seed: u64) -> Self {
        Loss {
            // Bursts of mean b and, between them, runs of mean 1/begin: their share is b / (b + 1/begin).
            begin: faults.loss / (faults.burst * (1.0 - faults.loss)),
            go_on: 1.0 - 1.0 / faults.burst,
            inside: false,
            random: fastrand::Rng::with_seed(seed),
        }
    }

    /// Removes what is lost from `bytes`; returns whether anything was.
    pub fn apply(&mut self, bytes: &mut Vec<u8>) -> bool {
        if self.begin == 0.0 {
            return false;
        }
        let before = bytes.len();
        bytes.retain(|_| {
            let chance = if self.inside { self.go_on } else { self.begin };
            self.inside = self.random.f64() < chance;
            !self.inside
        });
        bytes.len() < before
    }
}

fn wrong(part: &str, what: &str, hint: String) -> Failure {
    Failure::new(Kind::Configuration, format!("fault {part:?} {what}"), hint)
}

fn keys() -> String {
    format!("keys: {}", Faults::KEYS.map(|(key, _)| key).join(", "))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn written_faults() {
        let faults: Faults = "loss=0.00135,burst=1.89".parse().unwrap();
        assert_eq!(faults, Faults { loss: 0.00135, burst: 1.89 });
        assert_eq!(faults.to_string().parse::<Faults>(), Ok(faults));
        assert_eq!("".parse::<Faults>(), Ok(Faults::default()));
        for (text, says) in [
            ("los=0.1", "loss, burst"),
            ("loss", "loss, burst"),
            ("loss=2", "from 0 to 0.5"),
            ("loss=x", "from 0 to 0.5"),
            ("burst=0.5", "from 1 to 1000"),
            ("burst=nan", "from 1 to 1000"),
        ] {
            let failure = text.parse::<Faults>().unwrap_err();
            assert!(failure.hint.contains(says), "{text}: {failure}");
            assert_eq!(failure.kind.exit_code(), 78);
        }
    }

    #[test]
    fn the_share_the_bursts_and_the_damage_of_the_paper() {
        // 0.135 % of the bytes in bursts of 1.89 damage 40.8 % of 732-byte telegrams.
        let mut loss = Loss::new(Faults { loss: 0.00135, burst: 1.89 }, 1);
        let (telegrams, mut damaged, mut lost) = (20_000, 0, 0);
        for _ in 0..telegrams {
            let mut bytes = vec![0; 732];
            damaged += u32::from(loss.apply(&mut bytes));
            lost += 732 - bytes.len();
        }
        let share = lost as f64 / (732.0 * f64::from(telegrams));
        assert!((share - 0.00135).abs() < 0.00005, "{share}");
        let damaged = f64::from(damaged) / f64::from(telegrams);
        assert!((damaged - 0.408).abs() < 0.01, "{damaged}");
    }

    #[test]
    fn the_same_seed_loses_the_same_bytes_however_they_are_cut() {
        let faults = Faults { loss: 0.05, burst: 3.0 };
        let bytes: Vec<u8> = (0..5000).map(|i| i as u8).collect();
        let mut whole = bytes.clone();
        assert!(Loss::new(faults, 9).apply(&mut whole));
        let mut loss = Loss::new(faults, 9);
        let mut cut = Vec::new();
        for chunk in bytes.chunks(62) {
            let mut chunk = chunk.to_vec();
            loss.apply(&mut chunk);
            cut.append(&mut chunk);
        }
        assert_eq!(cut, whole);
        assert!(!Loss::new(Faults::default(), 9).apply(&mut whole));
    }
}
