//! One line that says how far a player is, drawn over itself. What the log says meanwhile stands above it.

use std::io::{self, Write, stderr};
use std::sync::atomic::{AtomicBool, Ordering};

use daemon::{Pace, Progress};

/// The line at the bottom of stderr, until it is dropped.
#[derive(Default)]
pub(super) struct Line {
    drawn: String,
}

/// stderr as the log writes to it.
pub(crate) struct Log;

/// Whether there is a line where the next word on stderr would stand.
static IS_SHOWN: AtomicBool = AtomicBool::new(false);

impl Line {
    pub(super) fn draw(&mut self, progress: &Progress) {
        let text = text(progress);
        if text != self.drawn || !IS_SHOWN.load(Ordering::Relaxed) {
            // A line that wraps would not be drawn over: it is cut.
            IS_SHOWN.store(true, Ordering::Relaxed);
            let _ = stderr().write_all(format!("{WIPE}\x1b[?7l{text}\x1b[?7h").as_bytes());
            self.drawn = text;
        }
    }
}

impl Drop for Line {
    fn drop(&mut self) {
        wipe();
    }
}

impl Write for Log {
    fn write(&mut self, event: &[u8]) -> io::Result<usize> {
        wipe();
        stderr().write(event)
    }

    fn flush(&mut self) -> io::Result<()> {
        stderr().flush()
    }
}

fn wipe() {
    if IS_SHOWN.swap(false, Ordering::Relaxed) {
        let _ = stderr().write_all(WIPE.as_bytes());
    }
}

/// What was played, when it is over.
pub(super) fn summary(played: &Progress) -> String {
    let Progress { telegrams, position_ns, took_ns, .. } = *played;
    let took = took_ns as f64 / 1e9;
    format!("replayed {telegrams} telegrams up to {}, in {took:.1} s", clock(position_ns))
}

fn text(progress: &Progress) -> String {
    let Progress { position_ns, length_ns, pace, is_paused, is_over, lap, telegrams, .. } = *progress;
    let mut text = clock(position_ns);
    if let Some(length_ns) = length_ns.filter(|length_ns| *length_ns > 0) {
        let done = (position_ns.min(length_ns) as u128 * BAR as u128 / u128::from(length_ns)) as usize;
        text += &format!(" [{}{}] {}", "#".repeat(done), ".".repeat(BAR - done), clock(length_ns));
    }
    text += &match pace {
        Pace::Times(rate) => format!("  x{rate}"),
        Pace::Max => "  x max".to_owned(),
    };
    text += &format!("  {telegrams} telegrams");
    if lap > 0 {
        text += &format!("  lap {}", lap + 1);
    }
    text + match (is_over, is_paused) {
        (true, _) => "  at its end; q ends",
        (_, true) => "  paused; space goes on, . steps, q ends",
        _ => "  space pauses, + - rate, q ends",
    }
}

/// Minutes, or hours where there are any, seconds and tenths.
fn clock(ns: u64) -> String {
    let tenths = ns / 100_000_000;
    let (minutes, seconds) = (tenths / 600, tenths % 600);
    let rest = format!("{:02}.{}", seconds / 10, seconds % 10);
    match minutes / 60 {
        0 => format!("{minutes}:{rest}"),
        hours => format!("{hours}:{:02}:{rest}", minutes % 60),
    }
}

/// Places of the bar.
const BAR: usize = 20;
/// To the line's begin, and nothing on it (ECMA-48).
const WIPE: &str = "\r\x1b[K";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn how_far_it_is() {
        let progress = Progress {
            position_ns: 65_250_000_000,
            length_ns: Some(130_500_000_000),
            pace: Pace::Times(0.5),
            is_paused: false,
            is_over: false,
            lap: 0,
            telegrams: 7,
            took_ns: 1,
            now_ns: 2,
        };
        let begin = "1:05.2 [##########..........] 2:10.5  x0.5  7 telegrams  ";
        assert_eq!(text(&progress), format!("{begin}space pauses, + - rate, q ends"));
        let open = Progress { length_ns: None, pace: Pace::Max, lap: 1, is_paused: true, ..progress };
        assert_eq!(text(&open), "1:05.2  x max  7 telegrams  lap 2  paused; space goes on, . steps, q ends");
        assert_eq!(clock(3_725_000_000_000), "1:02:05.0");
    }
}
