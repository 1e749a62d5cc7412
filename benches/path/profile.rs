//! Profile of the steps of one thread. It shows to which functions, crates and stages the instructions, code lines and
//! code pages of the thread belong.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::fs;
use std::process::Command;

/// The code of a process, with the names of files and functions.
pub(crate) struct Code {
    /// Path of the program, and address of the program's first page in memory.
    program: String,
    base: u64,
    /// Mapped files, sorted by address. Each entry has the start, the end and the name.
    files: Vec<(u64, u64, String)>,
    /// Functions of the program, sorted by address. Each entry has the address in memory and the name. Empty if the
    /// program has no symbols.
    functions: Vec<(u64, String)>,
}

impl Code {
    /// Reads the memory map of the process `pid`, and the symbols of its program with `nm`.
    pub(crate) fn of(pid: u32) -> Result<Code, String> {
        let failed = |error: std::io::Error| format!("process {pid}: {error}");
        let program = fs::read_link(format!("/proc/{pid}/exe")).map_err(failed)?.display().to_string();
        let (mut files, mut base) = (Vec::new(), None);
        for line in fs::read_to_string(format!("/proc/{pid}/maps")).map_err(failed)?.lines() {
            let words: Vec<&str> = line.split_whitespace().collect();
            let [range, _, offset, _, _, path] = words[..] else { continue };
            let Some((start, end)) = range.split_once('-') else { continue };
            let hex = |text: &str| u64::from_str_radix(text, 16).map_err(|error| error.to_string());
            let (start, end) = (hex(start)?, hex(end)?);
            if path == program && hex(offset)? == 0 {
                base = Some(start);
            }
            let name = path.rsplit('/').next().unwrap_or(path);
            files.push((start, end, if path == program { String::new() } else { name.to_owned() }));
        }
        let base = base.ok_or("the program is not in its own memory map")?;
        let functions = functions(&program, base, &["-C"]);
        Ok(Code { program, base, files, functions })
    }

    /// Returns whether the names of the program's functions are known.
    pub(crate) fn has_names(&self) -> bool {
        !self.functions.is_empty()
    }

    /// Returns the index and the name of the function at `address`, or `None` if the address is not in the program.
    pub(crate) fn function(&self, address: u64) -> Option<(usize, &str)> {
        if self.file(address).is_none_or(|file| !file.is_empty()) {
            return None;
        }
        let index = self.functions.partition_point(|(start, _)| *start <= address).checked_sub(1)?;
        Some((index, &self.functions[index].1))
    }

    /// Returns the name of the mapped file at `address`. The name of the program itself is empty.
    pub(crate) fn file(&self, address: u64) -> Option<&str> {
        let file = self.files.iter().find(|(start, end, _)| (*start..*end).contains(&address));
        file.map(|(_, _, name)| name.as_str())
    }

    /// Returns the name of the function at `address`, or the name of the mapped file if the address is not in the
    /// program.
    pub(crate) fn name(&self, address: u64) -> &str {
        let name = self.function(address).map(|(_, name)| name);
        name.or_else(|| self.file(address).filter(|name| !name.is_empty())).unwrap_or("?")
    }
}

/// Runs `nm` with `flags` on `program`, and returns the address and the name of each function. `base` is the address of
/// the first page of `program` in memory.
fn functions(program: &str, base: u64, flags: &[&str]) -> Vec<(u64, String)> {
    let Ok(output) = Command::new("nm").args(flags).args(["--defined-only", program]).output() else {
        return Vec::new();
    };
    let mut functions: Vec<_> = String::from_utf8_lossy(&output.stdout)
        .lines()
        .filter_map(|line| {
            let (address, rest) = line.split_once(' ')?;
            let (kind, name) = rest.split_once(' ')?;
            let address = u64::from_str_radix(address, 16).ok()?;
            "tTwW".contains(kind).then(|| (base + address, name.to_owned()))
        })
        .collect();
    functions.sort();
    functions
}

/// Returns the linker pattern that matches `symbol` with any hash at its end.
fn pattern(symbol: &str) -> String {
    let symbol = symbol.rsplit_once("17h").map_or(symbol.to_owned(), |(path, _)| format!("{path}17h*"));
    symbol.replace('$', "?")
}

/// Returns the crate of the function `name`, which is the first component of its path. For a generic function, it is
/// the crate that defines the function.
pub(crate) fn crate_of(name: &str) -> &str {
    let Some((path, _)) = name.split_once("::") else { return if name.contains(".so") { name } else { "C" } };
    path.rsplit(|c: char| !c.is_alphanumeric() && c != '_').next().unwrap_or(path)
}

/// Stages of the path of a telegram.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(crate) enum PathStage {
    Sleeping,
    Read,
    Framing,
    Decode,
    Zones,
    Publish,
    Processors,
    Bookkeeping,
    /// Publishing the status, which the hub does once a second, and the checks that the hub makes up to ten times a
    /// second.
    Status,
    Other,
}

/// Parts of function names, each with its stage. A function belongs to the stage of the first entry that its name
/// contains. An instruction belongs to the innermost calling function that has a stage. Steps in the shared-memory
/// library, `memcpy` and the standard library therefore belong to the callers of these functions.
const STAGES: [(&str, PathStage); 34] = [
    ("preprocess::zones::", PathStage::Zones),
    ("Pipeline::check_zones", PathStage::Zones),
    ("scanhub_preprocess::", PathStage::Processors),
    ("Pipeline::process", PathStage::Processors),
    ("lms::arrival_time::", PathStage::Read),
    ("::defer_read", PathStage::Read),
    ("::can_defer_read", PathStage::Read),
    ("::commit", PathStage::Read),
    ("::read_buffer", PathStage::Read),
    ("SessionDriver<S>::read", PathStage::Read),
    ("scanhub_port::tty::", PathStage::Read),
    ("lms::framer::", PathStage::Framing),
    ("lms::telegram::", PathStage::Framing),
    ("lms::session::", PathStage::Framing),
    ("lms::request_channel::", PathStage::Framing),
    ("lms::measured::", PathStage::Decode),
    ("line::scan::", PathStage::Decode),
    ("link_output::decode", PathStage::Decode),
    ("::copy_from", PathStage::Decode),
    ("daemon::publisher::", PathStage::Publish),
    ("daemon::topics::", PathStage::Publish),
    ("LinkOutput<S>::prepare", PathStage::Publish),
    ("LinkOutput<S>::publish_telegram", PathStage::Publish),
    ("LinkOutput<S>::publish_scan", PathStage::Publish),
    ("scanhub_shm::", PathStage::Publish),
    ("SessionDriver<S>::drain", PathStage::Bookkeeping),
    ("SessionDriver<S>::on_wakeup", PathStage::Bookkeeping),
    ("daemon::diagnosis::", PathStage::Bookkeeping),
    ("daemon::link_stats::", PathStage::Bookkeeping),
    ("LinkState<S>::", PathStage::Bookkeeping),
    ("daemon::system::", PathStage::Sleeping),
    ("LiveLink<S>::", PathStage::Sleeping),
    ("scanhub_port::clock::", PathStage::Sleeping),
    ("rustix::", PathStage::Sleeping),
];

/// Ends of function names. All steps in these functions, and in the functions that they call, belong to the status.
/// When the hub publishes the status, it also saves the scanner's identity.
const STATUS_SUFFIXES: [&str; 6] = [
    "SessionDriver<S>::report",
    "LinkState<S>::publish_status",
    "LinkState<S>::publish_session_status",
    "LinkState<S>::publish_due_status",
    "IdentityCache<S>::save",
    "Platform>::store_record",
];

impl PathStage {
    pub(crate) fn name(self) -> &'static str {
        match self {
            PathStage::Sleeping => "sleeping",
            PathStage::Read => "read",
            PathStage::Framing => "framing and CRC",
            PathStage::Decode => "decode",
            PathStage::Zones => "zones",
            PathStage::Publish => "publish and doorbell",
            PathStage::Processors => "background, other processors",
            PathStage::Bookkeeping => "bookkeeping",
            PathStage::Status => "status, checks ten times a second",
            PathStage::Other => "other",
        }
    }

    /// Returns the stage of the function with the name `name`, or `None` if it has none.
    fn of_function(name: &str) -> Option<PathStage> {
        if STATUS_SUFFIXES.iter().any(|end| name.ends_with(end)) {
            return Some(PathStage::Status);
        }
        STAGES.iter().find(|(part, _)| name.contains(part)).map(|(_, stage)| *stage)
    }
}

/// Sums over all telegrams of a profile, for one stage, one crate or one function.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Totals {
    pub(crate) instructions: u64,
    pub(crate) lines: u64,
    pub(crate) pages: u64,
}

/// Steps of one telegram that belong to the same stage, crate or function.
#[derive(Default)]
struct Steps {
    instructions: u64,
    lines: HashSet<u64>,
    pages: HashSet<u64>,
}

impl Steps {
    fn add(&mut self, address: u64) {
        self.instructions += 1;
        self.lines.insert(address / CACHE_LINE_LEN);
        self.pages.insert(address / PAGE_LEN);
    }
}

/// Profile of several telegrams.
pub(crate) struct Profile<'a> {
    code: &'a Code,
    /// Stage of each function that was executed, by the address of the function.
    stages: HashMap<u64, Option<PathStage>>,
    pub(crate) telegrams: u64,
    pub(crate) by_stage: BTreeMap<PathStage, Totals>,
    pub(crate) by_crate: HashMap<&'a str, Totals>,
    pub(crate) by_function: HashMap<&'a str, Totals>,
    /// Sums of each telegram, without the status.
    pub(crate) per_telegram: Vec<Totals>,
    /// Addresses of functions in the order of their first steps. The first list has the functions of a telegram's path,
    /// and the second list has those of the status.
    first_steps: [Vec<u64>; 2],
}

impl<'a> Profile<'a> {
    pub(crate) fn new(code: &'a Code) -> Profile<'a> {
        Profile {
            code,
            stages: HashMap::new(),
            telegrams: 0,
            by_stage: BTreeMap::new(),
            by_crate: HashMap::new(),
            by_function: HashMap::new(),
            per_telegram: Vec::new(),
            first_steps: Default::default(),
        }
    }

    /// Returns patterns for the symbols of the executed functions, in the order of their first steps. If `of_status` is
    /// true, these are the functions of the status, and otherwise those of a telegram's path. A pattern omits the hash
    /// at the end of a symbol, so it matches a generic function with any types.
    pub(crate) fn patterns(&self, of_status: bool) -> Vec<String> {
        let symbols = functions(&self.code.program, self.code.base, &[]);
        let of_address = |address| {
            let begin = symbols.partition_point(|(start, _)| *start < address);
            symbols[begin..].iter().take_while(move |(start, _)| *start == address)
        };
        let order = &self.first_steps[usize::from(of_status)];
        order.iter().flat_map(|address| of_address(*address)).map(|(_, symbol)| pattern(symbol)).collect()
    }

    /// Returns the stage of an instruction at `address`. `calls` has the addresses of the functions in which the
    /// instruction runs, outermost first.
    pub(crate) fn stage(&mut self, address: u64, calls: impl DoubleEndedIterator<Item = u64>) -> PathStage {
        let mut found = self.stage_of(address);
        for function in calls.rev() {
            let stage = self.stage_of(function);
            if stage == Some(PathStage::Status) {
                return PathStage::Status;
            }
            found = found.or(stage);
        }
        found.unwrap_or(PathStage::Other)
    }

    fn stage_of(&mut self, address: u64) -> Option<PathStage> {
        let code = self.code;
        *self.stages.entry(address).or_insert_with(|| PathStage::of_function(code.name(address)))
    }

    /// Adds the steps of a telegram.
    pub(crate) fn add(&mut self, steps: impl Iterator<Item = (u64, PathStage)>) {
        let mut all = Steps::default();
        let mut by_stage = HashMap::<PathStage, Steps>::new();
        let (mut by_crate, mut by_function) = (HashMap::<&str, Steps>::new(), HashMap::<&str, Steps>::new());
        for (address, stage) in steps {
            by_stage.entry(stage).or_default().add(address);
            if let Some((index, _)) = self.code.function(address) {
                let order = &mut self.first_steps[usize::from(stage == PathStage::Status)];
                let function = self.code.functions[index].0;
                if !order.contains(&function) {
                    order.push(function);
                }
            }
            if stage == PathStage::Status {
                continue;
            }
            all.add(address);
            let name = self.code.name(address);
            by_function.entry(name).or_default().add(address);
            by_crate.entry(crate_of(name)).or_default().add(address);
        }
        self.telegrams += 1;
        let mut sum = Totals::default();
        sum.add(&all);
        self.per_telegram.push(sum);
        by_stage.iter().for_each(|(key, steps)| self.by_stage.entry(*key).or_default().add(steps));
        by_crate.iter().for_each(|(key, steps)| self.by_crate.entry(key).or_default().add(steps));
        by_function.iter().for_each(|(key, steps)| self.by_function.entry(key).or_default().add(steps));
    }
}

impl Totals {
    fn add(&mut self, steps: &Steps) {
        self.instructions += steps.instructions;
        self.lines += steps.lines.len() as u64;
        self.pages += steps.pages.len() as u64;
    }
}

/// Length of a code line and of a code page, in bytes.
const CACHE_LINE_LEN: u64 = 64;
const PAGE_LEN: u64 = 4096;
