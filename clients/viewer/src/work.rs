//! The processor time of the hub, as the kernel counts it. Refuses to know what the hub does.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

/// The work of one process over the last seconds.
#[derive(Debug, Default)]
pub(crate) struct Work {
    pid: u32,
    /// When it was looked at, and how much it had used by then, in ns.
    looks: VecDeque<(Instant, u64)>,
}

impl Work {
    /// Looks at process `pid`, at most once a second; in percent of one processor over the last five, if that is known.
    pub(crate) fn look(&mut self, pid: u32, now: Instant) -> Option<f64> {
        if self.pid != pid {
            *self = Work { pid, looks: VecDeque::new() };
        }
        if self.looks.back().is_none_or(|(at, _)| now - *at >= EVERY) {
            self.looks.push_back((now, used_ns(pid)?));
            while self.looks.len() > LOOKS {
                self.looks.pop_front();
            }
        }
        let ((first, before), (last, after)) = (self.looks.front()?, self.looks.back()?);
        let span = last.duration_since(*first);
        (!span.is_zero()).then(|| 100.0 * after.saturating_sub(*before) as f64 / span.as_nanos() as f64)
    }
}

/// Processor time of `pid`, user and system, with that of its threads that have ended; nothing if that may not be seen.
///
/// The sum over the threads that live would be finer than a tick, but it falls when one of them ends.
fn used_ns(pid: u32) -> Option<u64> {
    let text = std::fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
    // The name before is in parentheses and may hold anything; user and system time are fields 14 and 15 (proc(5)).
    let (_, fields) = text.rsplit_once(')')?;
    let ticks = fields.split_whitespace().skip(11).take(2).map(|field| field.parse::<u64>().ok());
    Some(ticks.sum::<Option<u64>>()? * TICK_NS)
}

/// Of the kernel's clock as `/proc` shows it: 100 a second on every Linux machine.
const TICK_NS: u64 = 10_000_000;

const EVERY: Duration = Duration::from_secs(1);
const LOOKS: usize = 6;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_process_that_works_is_seen_working_and_one_that_is_not_there_is_not() {
        let mut work = Work::default();
        let (me, begin) = (std::process::id(), Instant::now());
        assert_eq!(work.look(me, begin), None, "one look is no span");
        let before = used_ns(me).unwrap();
        let mut sum = 0_u64;
        // The kernel counts in ticks: until it has.
        while used_ns(me).unwrap() == before && begin.elapsed() < Duration::from_secs(20) {
            sum = std::hint::black_box(sum + 1);
        }
        assert!(work.look(me, begin + EVERY).unwrap() > 0.0);
        assert_eq!(work.look(u32::MAX, begin), None);
    }
}
