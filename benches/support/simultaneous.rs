//! Programs that are measured at the same time: the hub, two baselines and, with `--beside`, the hub of another build.
//! Each has a separate domain and separate simulated sensors. In every round they change places: each reads the lines
//! that its neighbor read in the round before. The load of the machine, which all of them share, and differences between
//! simulators therefore cancel out in differences between programs.

use std::process::Stdio;
use std::time::Duration;

use super::stage::{ALL_AROUND, Child, PATIENCE, PROGRAM, Stage};
use super::{Options, Outcome, baseline};

/// The programs and their lines.
pub(crate) struct Comparison {
    pub(crate) sensors: &'static [&'static str],
    /// The hub, two baselines and, with `--beside`, the hub of the other build, in this order.
    pub(crate) candidates: Vec<Candidate>,
    /// One per candidate.
    lines: Vec<Lines>,
}

/// A program that is measured.
pub(crate) struct Candidate {
    /// Name in tables.
    pub(crate) name: String,
    pub(crate) kind: Kind,
    /// Domain and directory of a hub.
    pub(crate) stage: Stage,
}

pub(crate) enum Kind {
    /// The hub of the program at this path.
    Hub(String),
    /// The baseline that wakes up this long before the end of a telegram, in ns; 0: as long as the hub.
    Baseline(u64),
}

/// A set of simulated sensors.
struct Lines {
    // Ends before the directory with its ports is removed.
    _simulator: Child,
    stage: Stage,
}

impl Comparison {
    /// Starts the simulators of `sensors` sensors for each program, and lets the hub start these sensors. From then on
    /// they stream to any program that reads.
    pub(crate) fn start(options: &Options, sensors: usize) -> Outcome<Comparison> {
        let sensors = ALL_AROUND.get(..sensors).ok_or("too many sensors")?;
        let mut kinds = vec![
            ("hub".to_owned(), Kind::Hub(PROGRAM.to_owned())),
            (BASELINE.to_owned(), Kind::Baseline(baseline::LEAD)),
            (format!("{BASELINE}, woken as the hub"), Kind::Baseline(0)),
        ];
        kinds.extend(options.beside.iter().map(|path| (path.clone(), Kind::Hub(path.clone()))));
        let count = kinds.len();
        let create = |(number, (name, kind))| -> Outcome<Candidate> {
            let stage = Stage::numbered(number)?;
            let kind = match kind {
                Kind::Hub(path) => Kind::Hub(copied(&path, &stage)?),
                baseline @ Kind::Baseline(_) => baseline,
            };
            Ok(Candidate { name, kind, stage })
        };
        let candidates = kinds.into_iter().enumerate().map(create).collect::<Outcome<Vec<_>>>()?;
        let lines = (count..2 * count)
            .map(|number| {
                let stage = Stage::numbered(number)?;
                Ok(Lines { _simulator: stage.simulate(sensors, 500_000)?, stage })
            })
            .collect::<Outcome<Vec<_>>>()?;
        for lines in &lines {
            let hub = candidates[0].start(&lines.stage, sensors, 0)?;
            let _subscribers = candidates[0].subscribe_to_scans(sensors)?;
            hub.guard.kill()?;
        }
        Ok(Comparison { sensors, candidates, lines })
    }

    /// Returns the index of the lines that a candidate reads in a round.
    pub(crate) fn place(&self, candidate: usize, round: usize) -> usize {
        (candidate + round) % self.lines.len()
    }

    /// Returns the stage of the lines with this index.
    pub(crate) fn lines(&self, place: usize) -> &Stage {
        &self.lines[place].stage
    }

    /// Returns the number of rounds. By default, each candidate reads all lines twice.
    pub(crate) fn rounds(&self, options: &Options) -> usize {
        options.pairs_or(2 * self.candidates.len())
    }

    /// Returns the names of all candidates.
    pub(crate) fn names(&self) -> Vec<&str> {
        self.candidates.iter().map(|candidate| candidate.name.as_str()).collect()
    }
}

impl Candidate {
    /// Starts the program on `lines`. A baseline ends after `count` telegrams from each (0: never).
    pub(crate) fn start(&self, lines: &Stage, sensors: &[&str], count: usize) -> Outcome<Child> {
        let child = match &self.kind {
            Kind::Hub(path) => Child::of(self.stage.hub_command_on(lines, path, sensors), Stdio::null()),
            Kind::Baseline(lead) => lines.bare(sensors, count, *lead),
        };
        let child = child.map_err(|error| format!("{}: {error}", self.name))?;
        child.await_line("ready", PATIENCE).map_err(|error| format!("{}: {error}", self.name))?;
        Ok(child)
    }

    /// Returns whether it is a hub.
    pub(crate) fn is_hub(&self) -> bool {
        matches!(self.kind, Kind::Hub(_))
    }

    /// Starts a subscriber to the scans of each sensor, and waits until every subscriber has received one. Only for hubs.
    pub(crate) fn subscribe_to_scans(&self, sensors: &[&str]) -> Outcome<Vec<Child>> {
        let start = |sensor: &&str| self.stage.consumer("scan", sensor, &[]);
        let subscribers = sensors.iter().map(start).collect::<Outcome<Vec<_>>>()?;
        for subscriber in &subscribers {
            let scan = subscriber.await_line("scan", PATIENCE);
            scan.map_err(|error| format!("{}: {error} (layouts in shared memory may differ)", self.name))?;
        }
        Ok(subscribers)
    }
}

/// Copies the program at `path` into the directory of `stage`, and returns the path of the copy. The simulators run
/// from the program of this build. If a hub ran from the same file, they would keep its code in the processor's caches.
fn copied(path: &str, stage: &Stage) -> Outcome<String> {
    let copy = stage.file("scanhub");
    std::fs::copy(path, &copy).map_err(|error| format!("{path}: {error}"))?;
    Ok(copy.display().to_string())
}

/// Name of the baseline in tables.
const BASELINE: &str = "baseline";
/// Time at the start of a round that does not count. The hub learns the background in 6.3 s and the duration of a
/// telegram in the first scans.
pub(crate) const SETTLING: Duration = Duration::from_secs(8);
