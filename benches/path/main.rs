//! Number of instructions, code lines of 64 bytes, code pages of 4 KiB and system calls that the hub needs for one
//! telegram. The bench single-steps the thread of a link under ptrace to count them. One subscriber waits for scans.
//! Unlike the figures of `hub_load`, these figures hardly depend on the machine's load. The bench does not measure
//! time.
//!
//! The sensor sends at 9,600 baud, because the steps are too slow for a higher rate. Two costs would be too high at
//! this rate, so the figures exclude them. The first cost is repeated waits ([`steps::TelegramCost`]). The second cost
//! is work that the hub does at most ten times a second: it examines the session and searches for subscribers, and once
//! a second it publishes the status. At 9,600 baud, the hub does this work with every telegram, but at 500,000 baud
//! only with one of four. The tables still show it as the stage of the status. If the program has no symbols, all
//! figures include this work.
//!
//! The steps delay the hub, so it sleeps and reads less often than usual. System calls are therefore also counted at
//! 500,000 baud, without steps.
//!
//! The figures are measured both while the hub learns the background, and with a learned background. For the second
//! case, another hub learns the background at 500,000 baud, and the measured hub starts with the saved model.
//!
//! The tables of stages, crates and functions need the symbols of the program, which `cargo bench` strips. This command
//! keeps them:
//!
//! ```text
//! CARGO_PROFILE_BENCH_STRIP=none CARGO_PROFILE_RELEASE_STRIP=none cargo bench --bench path
//! ```
//!
//! With `SCANHUB_WRITE=1`, the bench also writes `hub/path.lds`, which has the order of functions for the linker. The
//! linker ignores entries for functions that no longer exist. Write the file again only if the path of a telegram has
//! changed much.
//!
//! A code line or page counts once per telegram. It also counts once in each stage, crate and function that uses it, so
//! the sum of the parts is greater than the total. Steps in a function that no stage contains belong to the stage of
//! the caller.
#![cfg_attr(not(target_arch = "x86_64"), allow(unused))]

#[cfg(target_arch = "x86_64")]
mod profile;
#[cfg(target_arch = "x86_64")]
#[path = "../../tests/testkit/steps.rs"]
mod steps;
#[path = "../support/mod.rs"]
mod support;

use std::process::ExitCode;

fn main() -> ExitCode {
    support::main(measure)
}

#[cfg(not(target_arch = "x86_64"))]
fn measure(_: &support::Options) -> support::Outcome<()> {
    eprintln!("path: skipped: single steps are implemented for x86-64 only");
    Ok(())
}

#[cfg(target_arch = "x86_64")]
use on_x86_64::measure;

#[cfg(target_arch = "x86_64")]
mod on_x86_64 {
    use std::collections::{BTreeMap, HashMap, HashSet};
    use std::fs;
    use std::path::{Path, PathBuf};
    use std::process::Stdio;
    use std::thread;
    use std::time::{Duration, Instant};

    use crate::profile::{self, Code, Profile, Totals};
    use crate::steps::{Stepper, link_thread};
    use crate::support::environment::{BenchEnvironment, Child, PROGRAM, STEP_TIMEOUT};
    use crate::support::figures::{self, Cell};
    use crate::support::{Options, Outcome};

    pub(crate) fn measure(options: &Options) -> Outcome<()> {
        let count = options.count(if options.quick { 10 } else { 100 });
        let (mut cells, mut order) = (Vec::new(), [Vec::new(), Vec::new()]);
        for background in ["learned", "not learned"] {
            let environment = BenchEnvironment::new()?;
            let flags = ["--baud", "500000", "--state", "streaming", "--lossless"];
            let _simulator = environment.simulate_as(&[SENSOR], &flags)?;
            if background == "learned" {
                measure_learning(&environment, 10 * count as u64, &mut cells)?;
            }
            let mut command = environment.hub_command(PROGRAM, &[SENSOR]);
            command.arg(format!("--set=link.{SENSOR}.baud=9600"));
            let hub = Child::spawn(command, Stdio::null())?;
            hub.wait_for_line("ready", STEP_TIMEOUT)?;
            let subscriber = environment.start_subscriber("scan", SENSOR, &[])?;
            subscriber.wait_for_line("scan", 2 * STEP_TIMEOUT)?;
            let mut stepper = match Stepper::attach(link_thread(hub.guard.pid(), SENSOR)?) {
                Ok(stepper) => stepper,
                Err(reason) => {
                    eprintln!("path: skipped: {reason}");
                    return Ok(());
                }
            };
            let code = Code::of(hub.guard.pid())?;
            if !code.has_names() {
                eprintln!(
                    "path: no stages, crates and functions: the program has no symbols, or `nm` is missing; \
                     set CARGO_PROFILE_BENCH_STRIP=none and CARGO_PROFILE_RELEASE_STRIP=none"
                );
            }
            let end = Instant::now() + Duration::from_secs(options.seconds(MAX_SECONDS));
            let (profile, calls) = step(&mut stepper, &code, count, end)?;
            stepper.detach();
            add_tables(background, &profile, &calls, code.has_names(), &mut cells);
            for (patterns, of_status) in order.iter_mut().zip([false, true]) {
                patterns.extend(profile.patterns(of_status));
            }
        }
        if std::env::var_os("SCANHUB_WRITE").is_some() {
            fs::write(LINK_ORDER, link_order(&order.concat()))?;
        }
        figures::print_cells("path", options.json, &cells);
        Ok(())
    }

    /// Returns a linker script that puts functions next to each other, in the order of `patterns`. Each pattern matches
    /// the symbol of a function.
    fn link_order(patterns: &[String]) -> String {
        let mut known = HashSet::new();
        let patterns = patterns.iter().filter(|pattern| known.insert(*pattern));
        let lines: String = patterns.map(|pattern| format!("    *(.text.{pattern})\n")).collect();
        format!(
            "{LINK_ORDER_HEADER}SECTIONS\n{{\n  .text.path :\n  {{\n{lines}  }}\n}}\nINSERT BEFORE .text;\n"
        )
    }

    /// Starts a hub at 500,000 baud that learns the background and saves it. Then counts the hub's system calls for
    /// `count` telegrams.
    fn measure_learning(environment: &BenchEnvironment, count: u64, cells: &mut Vec<Cell>) -> Outcome<()> {
        let hub = environment.start_hub(&[SENSOR])?;
        hub.wait_for_line("ready", STEP_TIMEOUT)?;
        let subscriber = environment.start_subscriber("scan", SENSOR, &[])?;
        subscriber.wait_for_line("scan", STEP_TIMEOUT)?;
        let end = Instant::now() + 6 * STEP_TIMEOUT;
        while saved_background(&environment.file("scanhub")).is_none() {
            if Instant::now() > end {
                return Err("the hub did not learn the background".into());
            }
            thread::sleep(Duration::from_millis(100));
        }
        // Return without a message if attaching fails, because `measure` reports the reason.
        let Ok(mut stepper) = Stepper::attach(link_thread(hub.guard.pid(), SENSOR)?) else { return Ok(()) };
        stepper.run_telegram()?;
        let (mut calls, mut telegrams) = (BTreeMap::<u64, u64>::new(), 0);
        while telegrams < count {
            let cost = stepper.run_telegram()?;
            telegrams += cost.telegrams;
            cost.system_calls.iter().for_each(|(call, count)| *calls.entry(*call).or_default() += count);
        }
        stepper.detach();
        let mut add = |row: &str, calls: u64| {
            let (table, column) = ("at 500,000 baud".to_owned(), "system calls per telegram".to_owned());
            let values = vec![calls as f64 / telegrams as f64];
            cells.push(Cell { table, row: row.to_owned(), column, unit: "1", values });
        };
        add("all", calls.values().sum());
        calls.iter().for_each(|(call, count)| add(&call_name(*call), *count));
        Ok(())
    }

    /// Returns the path of the file in which a hub has saved the background, below `directory`.
    fn saved_background(directory: &Path) -> Option<PathBuf> {
        let domains = fs::read_dir(directory).ok()?.flatten();
        let files = domains.map(|domain| domain.path().join(format!("{SENSOR}.background.json")));
        files.into_iter().find(|file| file.exists())
    }

    /// Steps through `count` telegrams, or through fewer if the time `end` is reached before. Returns the profile of
    /// the steps, and the system calls of each telegram.
    fn step<'a>(
        stepper: &mut Stepper,
        code: &'a Code,
        count: usize,
        end: Instant,
    ) -> Outcome<(Profile<'a>, Vec<BTreeMap<u64, u64>>)> {
        let (mut profile, mut calls) = (Profile::new(code), Vec::new());
        stepper.run_past_telegram(TELEGRAM_INTERVAL)?;
        while calls.len() < count && Instant::now() < end {
            let mut steps = Vec::new();
            let mut of_status = Vec::new();
            let mut cost = stepper.step_telegram(|address, calls, system_call| {
                let stage = profile.stage(address, calls.iter().map(|call| call.function));
                steps.push((address, stage));
                of_status.extend(system_call.filter(|_| stage == profile::PathStage::Status));
            })?;
            for call in of_status {
                cost.system_calls.entry(call).and_modify(|count| *count -= 1);
            }
            let mut index = 0;
            steps.retain(|_| {
                index += 1;
                !cost.repeats.iter().any(|steps| steps.contains(&(index - 1)))
            });
            // On a busy machine, the next telegram may be complete before the hub has read this one. The cost then
            // covers both, so leave it out.
            if cost.telegrams == 1 {
                profile.add(steps.into_iter());
                calls.push(cost.system_calls);
            }
            // If the hub is less late than this, it still reads the first bytes of the next telegram before most of
            // that telegram has arrived.
            if cost.lag > TELEGRAM_INTERVAL * 2 / 3 {
                stepper.run_past_telegram(TELEGRAM_INTERVAL)?;
            }
        }
        if calls.is_empty() {
            return Err("this machine is too busy: steps did not keep up with the sensor".into());
        }
        Ok((profile, calls))
    }

    /// Adds the tables for the background state `background`: learned or not learned.
    fn add_tables(
        background: &str,
        profile: &Profile<'_>,
        calls: &[BTreeMap<u64, u64>],
        has_names: bool,
        cells: &mut Vec<Cell>,
    ) {
        let mut add = |table: &str, row: &str, column: &str, values: Vec<f64>| {
            let column = format!("{column}, {background}").trim_start_matches(", ").to_owned();
            cells.push(Cell { table: table.to_owned(), row: row.to_owned(), column, unit: "1", values });
        };
        add("per telegram", "measured telegrams", "", vec![calls.len() as f64]);
        let each =
            |value: fn(&Totals) -> u64| profile.per_telegram.iter().map(|sum| value(sum) as f64).collect();
        add("per telegram", "instructions", "", each(|sum| sum.instructions));
        add("per telegram", "code lines of 64 bytes", "", each(|sum| sum.lines));
        add("per telegram", "code pages of 4 KiB", "", each(|sum| sum.pages));
        let all_calls = calls.iter().map(|calls| calls.values().sum::<u64>() as f64);
        add("per telegram", "system calls", "", all_calls.collect());
        let numbers: std::collections::BTreeSet<u64> =
            calls.iter().flat_map(BTreeMap::keys).copied().collect();
        for number in numbers {
            let each = calls.iter().map(|calls| calls.get(&number).copied().unwrap_or(0) as f64);
            add("system calls per telegram, mean", &call_name(number), "", vec![mean(each)]);
        }
        if !has_names {
            return;
        }
        let telegrams = profile.telegrams as f64;
        let mut rows = |table: &str, row: &str, sum: &Totals| {
            for (column, count) in
                [("instructions", sum.instructions), ("code lines", sum.lines), ("code pages", sum.pages)]
            {
                add(table, row, column, vec![(count as f64 / telegrams * 10.0).round() / 10.0]);
            }
        };
        for (stage, sum) in &profile.by_stage {
            rows("by stage, mean", stage.name(), sum);
        }
        for (name, sum) in sorted(&profile.by_crate, |sum| sum.instructions) {
            rows("by crate, mean", name, &sum);
        }
        for (name, sum) in
            sorted(&profile.by_function, |sum| sum.instructions).into_iter().take(MAX_TABLE_ROWS)
        {
            rows(&format!("{MAX_TABLE_ROWS} functions by instructions, mean, {background}"), name, &sum);
        }
        for (name, sum) in sorted(&profile.by_function, |sum| sum.lines).into_iter().take(MAX_TABLE_ROWS) {
            rows(&format!("{MAX_TABLE_ROWS} functions by code lines, mean, {background}"), name, &sum);
        }
    }

    fn sorted<'a>(sums: &HashMap<&'a str, Totals>, key: fn(&Totals) -> u64) -> Vec<(&'a str, Totals)> {
        let mut sorted: Vec<_> = sums.iter().map(|(name, sum)| (*name, *sum)).collect();
        sorted.sort_by_key(|(name, sum)| (std::cmp::Reverse(key(sum)), *name));
        sorted
    }

    fn mean(values: impl ExactSizeIterator<Item = f64>) -> f64 {
        let count = values.len().max(1) as f64;
        values.sum::<f64>() / count
    }

    /// Returns the name of a system call on x86-64.
    fn call_name(number: u64) -> String {
        let names = [
            (0, "read"),
            (1, "write"),
            (7, "poll"),
            (16, "ioctl"),
            (18, "pwrite64"),
            (35, "nanosleep"),
            (44, "sendto"),
            (77, "ftruncate"),
            (202, "futex"),
            (228, "clock_gettime"),
            (230, "clock_nanosleep"),
            (271, "ppoll"),
        ];
        let name = names.iter().find(|(known, _)| *known == number);
        name.map_or(format!("number {number}"), |(_, name)| (*name).to_owned())
    }

    const SENSOR: &str = "front";
    /// Path of the linker script that `hub/build.rs` passes to the linker, and the first lines of this script.
    const LINK_ORDER: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/hub/path.lds");
    const LINK_ORDER_HEADER: &str = "/* The functions that run for each telegram, in the order in which they run, and then those of the\n   \
        status. Written by the bench `path`. */\n";
    /// Time between two telegrams at 9,600 baud.
    const TELEGRAM_INTERVAL: Duration = Duration::from_millis(773);
    /// Maximum time for the steps with one state of the background, in seconds. An idle machine needs less time for 100
    /// telegrams.
    const MAX_SECONDS: u64 = 110;
    /// Maximum number of functions in a table.
    const MAX_TABLE_ROWS: usize = 20;
}
