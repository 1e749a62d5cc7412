//! What do consumers of two sensors cost their machine (the paper's Fig. 7), if
//! a. each reads the raw bytes, one by one, from two lines of its own, and does everything itself,
//! b. does the same, but reads what is there in one go,
//! c. gets bare telegrams by multicast, as from the paper's unit, and does the rest itself,
//! d. takes the scans of the hub,
//! e. takes the zones and the foreground of the hub?
//!
//! Consumers are processes, and all of them get 37.5 scans a second of each sensor; a table says whether they did. What
//! stands for hardware (simulators; in c the unit) is left out: its own time is taken from the machine's.
//!
//! Two accounts of each run. `/proc/stat` is the paper's: the whole machine, interrupts with the system, and whatever
//! else runs there. Where the kernel counts by ticks (CONFIG_TICK_CPU_ACCOUNTING) it charges one of 1 to 10 ms to
//! whoever runs when it falls, and most of those here run for less than 0.1 ms at once. How far that is off is measured,
//! in the table "/proc/stat, of what the scheduler counted": exact would be 100 %, and it is more if others
//! ended meanwhile, who are then missing in the scheduler's count. The account of the processes is the scheduler's, in nanoseconds
//! (schedstat); only its division in user and system is by ticks, of a process's whole life. Targets are of that one. It
//! has no part of what threads of the kernel do for a pty, which is more where more ptys are: a table has these.
//!
//! It does not tell what a real UART costs: a pty has no interrupts.

mod account;
mod consumer;
#[path = "../../hub/lms/tests/line/mod.rs"]
#[allow(dead_code)] // Of the comparison of parsers only what a parser is.
mod line;
mod load;
#[path = "../framing/rivals.rs"]
#[allow(dead_code)] // The plainest one.
mod rivals;
mod setup;
#[path = "../support/mod.rs"]
mod support;
mod tables;
mod unit;
mod work;

use std::io::IsTerminal;
use std::process::ExitCode;
use std::time::Duration;

use setup::{SetUp, WORD};
use support::Outcome;
use support::options::Options;
use tables::{Run, Tables};

fn main() -> ExitCode {
    support::main_with(play, measure)
}

fn play(words: &[&str]) -> Outcome<()> {
    match *words {
        [WORD, "bytes", most, front, rear] => consumer::bytes([front, rear], most.parse()?),
        [WORD, "datagrams", port] => consumer::datagrams(port.parse()?),
        [WORD, "scans", domain] => consumer::scans(domain),
        [WORD, "results", domain] => consumer::results(domain),
        [WORD, "unit", port] => unit::send(port.parse()?),
        _ => support::play(words),
    }
}

fn measure(options: &Options) -> Outcome<()> {
    let counts: &[usize] = if options.quick { &[1, 4] } else { &[1, 2, 4, 8, 16] };
    let seconds = options.seconds(if options.quick { 5 } else { 60 });
    let pairs = options.pairs_or(match seconds {
        _ if options.quick => 2,
        ..30 => 5,
        _ => 1,
    });
    let span = Duration::from_secs(seconds);
    let mut runs = Vec::new();
    for pair in 0..pairs {
        // What the unit takes whom nobody hears.
        let deaf = SetUp::Datagrams.start(0)?.watch(span)?.outside;
        for (turn, &count) in counts.iter().enumerate() {
            let mut set_ups = SetUp::ALL;
            set_ups.rotate_left((pair + turn) % SetUp::ALL.len());
            for set_up in set_ups {
                if std::io::stderr().is_terminal() {
                    eprintln!("{} of {pairs}: {count} consumers, {}", pair + 1, set_up.name());
                }
                let load = set_up.start(count)?.watch(span)?;
                runs.push(Run {
                    set_up,
                    count,
                    host: load.of_host((set_up == SetUp::Datagrams).then_some(deaf)),
                    load,
                });
            }
        }
    }
    Tables::of(&runs, counts)?.print(options)
}
