//! The scenario of a world as data: a seed, a duration, and a list of timed actions. The list is drawn from the seed. A
//! scenario can be printed, parsed and shortened, so a failure can be repeated with fewer actions. `actions` defines
//! the effects of actions.

use std::fmt;
use std::str::FromStr;

use scanhub_schema::{MILLIS, Nanos};
use scanhub_sim::fault::Faults;

use crate::actions::{self, ACTION_KINDS, ActionKind};
use crate::family;

/// The actions of a world. Everything else follows from the seed: number of sensors, rates, and subscribers.
#[derive(Clone, Debug, PartialEq)]
pub struct Scenario {
    /// Seed of all random numbers.
    pub seed: u64,
    /// Duration, in virtual seconds.
    pub seconds: u64,
    /// Name of the only sensor's model. For an RPLIDAR, the name may include the mode and the state at the start. If it
    /// is `None`, one or two sensors are drawn.
    pub model: Option<String>,
    /// Whether half of the links have no family, so that the hub searches for their scanners. If there is only one
    /// sensor, its link has no family.
    pub is_auto: bool,
    /// Actions in order of time.
    pub actions: Vec<Action>,
}

/// An action at its time.
#[derive(Clone, Debug)]
pub struct Action {
    /// Time, in milliseconds since the start of the world.
    pub at_ms: u64,
    pub(crate) kind: &'static ActionKind,
    /// Values of the keys of `kind`, in the same order.
    pub(crate) values: Vec<u64>,
}

impl Scenario {
    /// Draws a scenario of `seconds` seconds. The scenario contains about half of the kinds of actions, each of them
    /// one or more times. The other kinds are omitted, because many faults hide each other (swarm testing). The last 12
    /// seconds contain no actions.
    pub fn from_seed(seed: u64, seconds: u64) -> Scenario {
        let mut random = fastrand::Rng::with_seed(seed ^ 0x5EED_0F1A_C710_0000);
        let end_ms = (seconds * 1_000).saturating_sub(RECOVERY_TIME / MILLIS);
        let mut actions = Vec::new();
        for kind in ACTION_KINDS {
            // Each kind has its own random numbers, so the number of values that one kind draws does not change the
            // actions of other kinds.
            let mut random = random.fork();
            if random.bool() || end_ms <= START_DELAY_MS {
                continue;
            }
            let mean = kind.per_minute * (end_ms - START_DELAY_MS) as f64 / 60_000.0;
            for _ in 0..1 + (random.f64() * 2.0 * mean) as u64 {
                let at_ms = random.u64(START_DELAY_MS..end_ms);
                actions.push(Action { at_ms, kind, values: kind.draw(&mut random) });
            }
        }
        actions.sort_by_key(|action| action.at_ms);
        Scenario { seed, seconds, model: None, is_auto: false, actions }
    }

    /// Returns the same scenario as [`from_seed`](Scenario::from_seed), but half of the links have no family.
    pub fn auto_from_seed(seed: u64, seconds: u64) -> Scenario {
        Scenario { is_auto: true, ..Scenario::from_seed(seed, seconds) }
    }

    /// Returns the time at which all faults are cleared, 12 seconds before the end. In these 12 seconds, the hub must
    /// recover.
    pub fn faults_clear_at(&self) -> Nanos {
        (self.seconds * 1_000 * MILLIS).saturating_sub(RECOVERY_TIME)
    }
}

/// Time without actions at the end of a world, in which the hub and the remote machines must recover.
pub(crate) const RECOVERY_TIME: Nanos = 12_000 * MILLIS;
/// Time without actions at the start of a world, in which the hub starts.
const START_DELAY_MS: u64 = 200;

impl Action {
    /// Returns the value of the key `name`.
    pub fn value(&self, name: &str) -> u64 {
        let at = self.kind.keys.iter().position(|key| key.name == name);
        at.and_then(|at| self.values.get(at)).copied().unwrap_or_default()
    }

    /// Returns the line faults of the action if it starts at `now`, or `None` if the action does not affect bytes.
    pub fn faults(&self, now: Nanos) -> Option<Faults> {
        actions::faults(self, now)
    }

    /// Returns the name of the action's kind.
    pub fn name(&self) -> &'static str {
        self.kind.name
    }
}

impl PartialEq for Action {
    fn eq(&self, other: &Action) -> bool {
        (self.at_ms, self.kind.name, &self.values) == (other.at_ms, other.kind.name, &other.values)
    }
}

impl fmt::Display for Action {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {}", self.at_ms, self.kind.name)?;
        let mut keys = self.kind.keys.iter().zip(&self.values);
        keys.try_for_each(|(key, value)| write!(f, " {}={value}", key.name))
    }
}

impl FromStr for Action {
    type Err = String;

    fn from_str(text: &str) -> Result<Action, String> {
        let wrong = || format!("{text:?} is not a valid action");
        let mut words = text.split_whitespace();
        let at_ms = words.next().and_then(|word| word.parse().ok()).ok_or_else(wrong)?;
        let name = words.next().ok_or_else(wrong)?;
        let kind = ACTION_KINDS.iter().find(|kind| kind.name == name).ok_or_else(wrong)?;
        let mut values = Vec::new();
        for (key, word) in kind.keys.iter().zip(words.by_ref()) {
            let value = word.split_once('=').filter(|(name, _)| *name == key.name);
            values.push(value.and_then(|(_, value)| value.parse().ok()).ok_or_else(wrong)?);
        }
        if values.len() < kind.keys.len() || words.next().is_some() {
            return Err(wrong());
        }
        Ok(Action { at_ms, kind, values })
    }
}

impl fmt::Display for Scenario {
    /// Writes a line with the seed, and one line for each action.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "seed {} seconds {}", self.seed, self.seconds)?;
        self.model.iter().try_for_each(|model| write!(f, " {model}"))?;
        f.write_str(if self.is_auto { " auto" } else { "" })?;
        writeln!(f)?;
        self.actions.iter().try_for_each(|action| writeln!(f, "{action}"))
    }
}

impl FromStr for Scenario {
    type Err = String;

    fn from_str(text: &str) -> Result<Scenario, String> {
        let mut lines = text.lines().map(str::trim).filter(|line| !line.is_empty());
        let head = lines.next().unwrap_or_default();
        let words: Vec<&str> = head.split_whitespace().collect();
        let ["seed", seed, "seconds", seconds, ref rest @ ..] = words[..] else {
            return Err(format!("{head:?} is not the first line of a scenario"));
        };
        let (is_auto, rest) = match rest {
            [model @ .., "auto"] => (true, model),
            model => (false, model),
        };
        let model = match *rest {
            [] => None,
            [model] if family::from_name(model, &mut fastrand::Rng::with_seed(0)).is_some() => {
                Some(model.to_owned())
            }
            _ => return Err(format!("{head:?} does not name a known model")),
        };
        let number = |word: &str| word.parse().map_err(|_| format!("{word:?} is not a number"));
        let (seed, seconds) = (number(seed)?, number(seconds)?);
        Ok(Scenario {
            seed,
            seconds,
            model,
            is_auto,
            actions: lines.map(str::parse).collect::<Result<_, _>>()?,
        })
    }
}

/// Returns the scenarios that once ended in a violation, each with the reason of the violation. They must no longer end
/// in a violation.
///
/// # Panics
///
/// Panics if a scenario in the file is not valid.
pub fn corpus() -> Vec<(String, Scenario)> {
    let scenarios = CORPUS_TEXT.split("\n\n").filter(|text| text.lines().any(|line| !line.starts_with('#')));
    let parse = |text: &str| {
        let (why, scenario): (Vec<&str>, Vec<&str>) = text.lines().partition(|line| line.starts_with('#'));
        let scenario = scenario.join("\n");
        let why = why.iter().map(|line| line.trim_start_matches("# ")).collect::<Vec<_>>().join(" ");
        let scenario = scenario.parse().unwrap_or_else(|error| panic!("{why}: {error}"));
        (why, scenario)
    };
    scenarios.map(parse).collect()
}

/// Scenarios as text, separated by empty lines. The lines before each scenario give the reason of the violation.
const CORPUS_TEXT: &str = include_str!("corpus.txt");

/// Returns the shortest scenario found that still violates the same invariant as `scenario`. `check` runs a scenario
/// and returns the violated invariant. The search tries to remove halves of the actions, then quarters, and so on down
/// to single actions. It keeps a removal if the invariant stays the same.
pub fn shrink(scenario: &Scenario, mut check: impl FnMut(&Scenario) -> Option<&'static str>) -> Scenario {
    let Some(expected) = check(scenario) else { return scenario.clone() };
    let mut best = scenario.clone();
    let mut piece = best.actions.len().div_ceil(2).max(1);
    loop {
        let mut from = 0;
        let mut is_shorter = false;
        while from < best.actions.len() {
            let to = (from + piece).min(best.actions.len());
            let mut less = best.clone();
            less.actions.drain(from..to);
            if check(&less) == Some(expected) {
                best = less;
                is_shorter = true;
            } else {
                from = to;
            }
        }
        match (piece, is_shorter) {
            (1, false) => return best,
            (1, true) => {}
            _ => piece = piece.div_ceil(2),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scenario_round_trips_through_text() {
        let mut met = std::collections::HashSet::new();
        for seed in 0..50 {
            let scenario = Scenario::from_seed(seed, 60);
            assert_eq!(scenario.to_string().parse(), Ok(scenario.clone()));
            assert_eq!(scenario, Scenario::from_seed(seed, 60));
            assert!(scenario.actions.iter().all(|action| action.at_ms * MILLIS < scenario.faults_clear_at()));
            met.extend(scenario.actions.iter().map(Action::name));
            let model = Some("a1:boost".to_owned()).filter(|_| seed % 2 == 0);
            let auto = Scenario { model, ..Scenario::auto_from_seed(seed, 60) };
            assert_eq!(auto.to_string().parse(), Ok(auto));
        }
        assert_eq!(met.len(), ACTION_KINDS.len(), "{met:?}");
        for wrong in ["", "seed x seconds 1", "seed 1 seconds 2\nfoo", "seed 1 seconds 2\n5 fly sensor=1"] {
            assert!(wrong.parse::<Scenario>().is_err(), "{wrong:?}");
        }
    }

    #[test]
    fn shrink_finds_two_culprits_among_many() {
        let scenario = (0..)
            .map(|seed| Scenario::from_seed(seed, 60))
            .find(|scenario| scenario.actions.len() > 40)
            .unwrap();
        let culprits = [scenario.actions[7].clone(), scenario.actions[31].clone()];
        let mut runs = 0;
        let shrunk = shrink(&scenario, |scenario| {
            runs += 1;
            let has_all = culprits.iter().all(|culprit| scenario.actions.contains(culprit));
            has_all.then_some("both")
        });
        assert_eq!(shrunk.actions, culprits);
        assert!(runs < 80, "{runs}");
        assert_eq!(shrink(&scenario, |_| None), scenario);
    }
}
