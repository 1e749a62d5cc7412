//! Asks a person at a terminal whether to carry out a plan. The only place that creates consent: nothing is written
//! into a sensor unless a person has typed `yes`.

use std::io::{IsTerminal, Write, stderr, stdin};
use std::sync::atomic::{AtomicBool, Ordering};

use lms_configure::{Consent, Plan};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::termios::{QueueSelector, tcflush};
use schema::{Failure, Kind};

/// Asks a person for consent to `plan`, whose differences were shown.
///
/// # Errors
///
/// Returns [`Kind::Usage`] if stdin, or stderr with the question, is not a terminal, [`Kind::Interrupted`] if `stop` is
/// set, and [`Kind::Failed`] if the answer is not `yes`.
pub(crate) fn person(plan: Plan, stop: &AtomicBool) -> Result<Consent, Failure> {
    let input = stdin();
    if !input.is_terminal() || !stderr().is_terminal() {
        return Err(Failure::new(
            Kind::Usage,
            "nothing was written: a person must confirm it",
            "run the same command in a terminal, with stdin and stderr not redirected",
        ));
    }
    // Input that was typed before the question does not count as an answer.
    let _ = tcflush(&input, QueueSelector::IFlush);
    let question = "The EEPROM wears out after a few thousand writes. Write this? Type yes: ";
    let _ = stderr().write_all(question.as_bytes());
    loop {
        if stop.load(Ordering::Relaxed) {
            let _ = stderr().write_all(b"\n");
            return Err(Failure::new(Kind::Interrupted, "interrupted, nothing was written", ""));
        }
        // A terminal becomes readable once it has a whole line.
        let mut fds = [PollFd::new(&input, PollFlags::IN)];
        if poll(&mut fds, Some(&STOP_CHECK_INTERVAL)).is_ok_and(|ready| ready > 0) {
            break;
        }
    }
    let mut answer = String::new();
    let read = input.read_line(&mut answer);
    // An answer without a newline, such as Ctrl-D, leaves the cursor on the line of the question.
    if !answer.ends_with('\n') {
        let _ = stderr().write_all(b"\n");
    }
    if read.is_ok() && answer.trim() == "yes" {
        return Ok(Consent::of_a_person(plan));
    }
    Err(Failure::new(Kind::Failed, "not confirmed: nothing was written", "to write, answer: yes"))
}

/// Interval between checks for an interrupt.
const STOP_CHECK_INTERVAL: Timespec = Timespec { tv_sec: 0, tv_nsec: 100_000_000 };
