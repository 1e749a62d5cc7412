//! Cost of a message from one process to N other processes. The bench compares topics of the hub, with each way to
//! wait, with UDP multicast, Unix sockets, TCP and pipes. The baselines are wake-ups without a message. The runs of the
//! mechanisms alternate, so that other load on the machine affects all of them. The bench does not measure the
//! additional cost of a network or of another machine.
//!
//! How to read the figures:
//!
//! - Latency is from just before the send until a process has the message and has read a byte of each cache line. The
//!   latency of the last receiver covers only messages that all receivers got.
//! - Every sender writes the whole message again before each send. The sender of a topic writes it into the loan, and
//!   the other senders write it into their own memory. The sender's CPU time therefore includes the writing, and the
//!   sleep until the next message. "Sending alone" includes neither.
//! - In the targets, the column "baseline" is the baseline or the socket with which topics are compared.
//! - If there are more receivers than processors, the last receiver waits until the other receivers have used the
//!   processors. This is true for every mechanism.
//! - UDP datagrams hold 65,507 bytes, and Unix datagram sockets 65,536. Longer messages are sent in parts, and if one
//!   part is lost, the message is lost.
//! - Without a pause between messages, streams, pipes and Unix datagrams wait for their receivers. Multicast and topics
//!   lose messages instead.
//! - The baselines `futex` and `cache line` use the hub's own doorbell, which costs one addition and one system call.
//!   The baseline `eventfd` uses no code of the hub.
//! - In this bench, topics are a service with the hub's settings and with messages of any length. For messages as long
//!   as a scan, `Subscriber::next` of the client library is also measured.
//! - For each sample, the shared-memory library checks all possible subscriber slots three times. For one small message
//!   to one receiver, a pipe or a Unix socket needs less memory than the slots. At 37.5 Hz, the slots have left the
//!   caches before each message. For the same reason, spinning does not reach the latency of a microsecond that it
//!   reaches when messages arrive without a pause.
//! - To signal the event, the library sends one datagram to each listener, and the listener needs one more system call
//!   to receive it. The event takes about twice as long as a futex.
//! - The doorbell wakes all sleeping subscribers at once, so they compete for two cores.

mod baselines;
mod message;
mod process;
mod report;
mod run;
mod sockets;
#[path = "../support/mod.rs"]
mod support;
mod topic;

use std::fmt;
use std::io::IsTerminal;
use std::process::ExitCode;
use std::thread::available_parallelism;

use message::{Mechanism, PHASES};
use process::RunParameters;
use run::{Case, PhaseFigures};
use support::environment::BenchEnvironment;
use support::{Options, Outcome};

/// Results of a mechanism in one phase, with one result per run.
pub(crate) struct Cell {
    pub(crate) case: Case,
    /// Index of the phase in the schedule.
    pub(crate) phase: usize,
    pub(crate) runs: Vec<PhaseFigures>,
}

impl Cell {
    /// Returns whether messages are sent at a rate, and not without a pause.
    fn is_paced(&self) -> bool {
        PHASES[self.phase].period_ns > 0
    }

    /// Returns whether `other` has messages of the same length, the same number of receivers and the same rate.
    fn has_same_load(&self, other: &Cell) -> bool {
        let place = |cell: &Cell| (cell.case.payload, cell.case.receivers, cell.phase);
        place(self) == place(other)
    }
}

impl fmt::Display for Cell {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Case { mechanism, payload, receivers } = self.case;
        write!(f, "{}, {payload} B to {receivers}, {}", mechanism.name(), PHASES[self.phase].name)
    }
}

fn main() -> ExitCode {
    support::main_with(run_part, measure)
}

/// Runs one process of a run. The words of the command line select the process.
fn run_part(words: &[&str]) -> Outcome<()> {
    let [part, way, payload, receivers, domain, place, ref rest @ ..] = *words else {
        return Err(format!("unknown part {words:?}").into());
    };
    let mechanism = Mechanism::from_name(way)?;
    let task = RunParameters {
        mechanism,
        payload: payload.parse()?,
        receivers: receivers.parse()?,
        domain,
        path_prefix: place,
    };
    match (part, rest) {
        ("send", []) => process::send_all(&task),
        ("receive", [number, address]) => process::receive_all(&task, number.parse()?, address),
        _ => Err(format!("unknown part {words:?}").into()),
    }
}

fn measure(options: &Options) -> Outcome<()> {
    let pairs = if options.quick { options.pairs().min(2) } else { options.pairs() };
    let (payloads, receivers): (&[usize], &[usize]) =
        if options.quick { (&[TELEGRAM_LEN, MEBIBYTE], &[1, 16]) } else { (&PAYLOAD_LENS, &RECEIVER_COUNTS) };
    let environment = BenchEnvironment::new()?;
    let processors = available_parallelism()?.get();
    let mut cells = Vec::new();
    for (number, payload) in payloads.iter().enumerate() {
        for receivers in receivers {
            print_progress(&format!(
                "{payload} bytes to {receivers}, length {} of {}",
                number + 1,
                payloads.len()
            ));
            cells.extend(compare(&environment, *payload, *receivers, processors, pairs)?);
        }
    }
    drop(environment);
    report::print_tables(options, processors, pairs, &cells);
    report::print_targets(options, &cells);
    Ok(())
}

/// Runs all mechanisms with the same messages and the same number of receivers, `pairs` times. In each repetition,
/// another mechanism runs first.
fn compare(
    stage: &BenchEnvironment,
    payload: usize,
    receivers: usize,
    processors: usize,
    pairs: usize,
) -> Outcome<Vec<Cell>> {
    let ways = Mechanism::ALL.into_iter().filter(|way| way.is_run_with(receivers, payload, processors));
    let mut cases: Vec<_> = ways.map(|way| Case { mechanism: way, payload, receivers }).collect();
    let mut cells: Vec<Cell> = Vec::new();
    for case in &cases {
        let phases = 1..PHASES.len();
        let phases = phases.filter(|phase| PHASES[*phase].count(case.mechanism) > 0);
        cells.extend(phases.map(|phase| Cell { case: *case, phase, runs: Vec::new() }));
    }
    for _ in 0..pairs {
        for case in &cases {
            let measured = case.measure(stage).map_err(|error| format!("{case:?}: {error}"))?;
            for (phase, measured) in measured {
                let cell = cells.iter_mut().find(|cell| cell.case == *case && cell.phase == phase);
                cell.ok_or("unknown phase")?.runs.push(measured);
            }
        }
        cases.rotate_left(1);
    }
    Ok(cells)
}

/// Prints the progress on a terminal.
fn print_progress(progress: &str) {
    if std::io::stderr().is_terminal() {
        eprintln!("{progress}");
    }
}

/// Length of a telegram of 361 beams.
const TELEGRAM_LEN: usize = 732;
const MEBIBYTE: usize = 1 << 20;
const PAYLOAD_LENS: [usize; 4] = [TELEGRAM_LEN, message::SCAN_LEN, 1 << 16, MEBIBYTE];
const RECEIVER_COUNTS: [usize; 4] = [1, 4, 16, 64];
