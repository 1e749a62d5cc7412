//! Programs that are measured at the same time: the hub, two baselines and, with `--beside`, the hub of another build.
//! Each program has its own domain and its own simulated sensors. In every round, each program reads the lines that its
//! neighbor in the list read in the previous round. The load of the machine is the same for all programs, and each
//! program reads the lines of each simulator. Both effects therefore cancel out in differences between programs.

use std::process::Stdio;
use std::time::Duration;

use super::environment::{ALL_AROUND, BenchEnvironment, Child, PROGRAM, STEP_TIMEOUT};
use super::{Options, Outcome, baseline};

/// The programs and their lines.
pub(crate) struct Comparison {
    pub(crate) sensors: &'static [&'static str],
    /// Programs in this order: the hub, two baselines and, with `--beside`, the hub of the other build.
    pub(crate) programs: Vec<MeasuredProgram>,
    /// Simulated sensors, with one set per program.
    lines: Vec<SimulatedSensors>,
}

/// A program that is measured.
pub(crate) struct MeasuredProgram {
    /// Name in tables.
    pub(crate) name: String,
    pub(crate) program: ProgramKind,
    /// Domain and directory of a hub.
    pub(crate) stage: BenchEnvironment,
}

pub(crate) enum ProgramKind {
    /// The hub of the program at this path.
    Hub(String),
    /// The baseline that wakes up this many nanoseconds before the end of a telegram. If the number is 0, it wakes up
    /// as long before the end as the hub does.
    Baseline(u64),
}

/// A set of simulated sensors.
struct SimulatedSensors {
    // This field is dropped first, before the directory with the ports of the simulator is removed.
    _simulator: Child,
    stage: BenchEnvironment,
}

impl Comparison {
    /// Starts the simulators of `sensors` sensors for each program, and lets the hub start these sensors. From then on,
    /// the sensors stream to any program that reads.
    pub(crate) fn start(options: &Options, sensors: usize) -> Outcome<Comparison> {
        let sensors = ALL_AROUND.get(..sensors).ok_or("too many sensors")?;
        let mut kinds = vec![
            ("hub".to_owned(), ProgramKind::Hub(PROGRAM.to_owned())),
            (BASELINE_NAME.to_owned(), ProgramKind::Baseline(baseline::WAKE_AHEAD_NS)),
            (format!("{BASELINE_NAME}, woken as the hub"), ProgramKind::Baseline(0)),
        ];
        kinds.extend(options.other_program.iter().map(|path| (path.clone(), ProgramKind::Hub(path.clone()))));
        let count = kinds.len();
        let create = |(number, (name, program))| -> Outcome<MeasuredProgram> {
            let environment = BenchEnvironment::numbered(number)?;
            let program = match program {
                ProgramKind::Hub(path) => ProgramKind::Hub(copy_program(&path, &environment)?),
                baseline @ ProgramKind::Baseline(_) => baseline,
            };
            Ok(MeasuredProgram { name, program, stage: environment })
        };
        let programs = kinds.into_iter().enumerate().map(create).collect::<Outcome<Vec<_>>>()?;
        let lines = (count..2 * count)
            .map(|number| {
                let environment = BenchEnvironment::numbered(number)?;
                Ok(SimulatedSensors {
                    _simulator: environment.simulate(sensors, 500_000)?,
                    stage: environment,
                })
            })
            .collect::<Outcome<Vec<_>>>()?;
        for lines in &lines {
            let hub = programs[0].start(&lines.stage, sensors, 0)?;
            let _subscribers = programs[0].subscribe_to_scans(sensors)?;
            hub.guard.kill()?;
        }
        Ok(Comparison { sensors, programs, lines })
    }

    /// Returns the index of the lines that the program with the index `program` reads in a round.
    pub(crate) fn line_index(&self, program: usize, round: usize) -> usize {
        (program + round) % self.lines.len()
    }

    /// Returns the environment of the lines with this index.
    pub(crate) fn lines(&self, line_index: usize) -> &BenchEnvironment {
        &self.lines[line_index].stage
    }

    /// Returns the number of rounds. The default is twice the number of programs, so that each program reads the lines
    /// of each set twice.
    pub(crate) fn rounds(&self, options: &Options) -> usize {
        options.pairs_or(2 * self.programs.len())
    }

    /// Returns the names of all programs.
    pub(crate) fn names(&self) -> Vec<&str> {
        self.programs.iter().map(|candidate| candidate.name.as_str()).collect()
    }
}

impl MeasuredProgram {
    /// Starts the program on `lines`. A baseline ends after it has read `count` telegrams from each line (0: never).
    pub(crate) fn start(&self, lines: &BenchEnvironment, sensors: &[&str], count: usize) -> Outcome<Child> {
        let child = match &self.program {
            ProgramKind::Hub(path) => {
                Child::spawn(self.stage.hub_command_on(lines, path, sensors), Stdio::null())
            }
            ProgramKind::Baseline(lead) => lines.start_baseline(sensors, count, *lead),
        };
        let child = child.map_err(|error| format!("{}: {error}", self.name))?;
        child.wait_for_line("ready", STEP_TIMEOUT).map_err(|error| format!("{}: {error}", self.name))?;
        Ok(child)
    }

    /// Returns whether the program is a hub.
    pub(crate) fn is_hub(&self) -> bool {
        matches!(self.program, ProgramKind::Hub(_))
    }

    /// Starts a subscriber to the scans of each sensor, and waits until every subscriber has received a scan. Only a
    /// hub has topics, so the program must not be a baseline.
    pub(crate) fn subscribe_to_scans(&self, sensors: &[&str]) -> Outcome<Vec<Child>> {
        let start = |sensor: &&str| self.stage.start_subscriber("scan", sensor, &[]);
        let subscribers = sensors.iter().map(start).collect::<Outcome<Vec<_>>>()?;
        for subscriber in &subscribers {
            let scan = subscriber.wait_for_line("scan", STEP_TIMEOUT);
            scan.map_err(|error| format!("{}: {error} (layouts in shared memory may differ)", self.name))?;
        }
        Ok(subscribers)
    }
}

/// Copies the program at `path` into the directory of `environment`, and returns the path of the copy. The simulators
/// run from the program file of this build. If a hub ran from the same file, the simulators would help to keep the
/// hub's code in the caches of the processor.
fn copy_program(path: &str, environment: &BenchEnvironment) -> Outcome<String> {
    let copy = environment.file("scanhub");
    std::fs::copy(path, &copy).map_err(|error| format!("{path}: {error}"))?;
    Ok(copy.display().to_string())
}

/// Name of the baseline in tables.
const BASELINE_NAME: &str = "baseline";
/// Time at the start of a round whose results do not count. In this time, the hub learns the background, which takes
/// 6.3 s, and estimates the duration of a telegram from the first scans.
pub(crate) const SETTLE_TIME: Duration = Duration::from_secs(8);
