//! Progress line of a player at the bottom of stderr. Each update overwrites it, and log lines are printed above it.

use std::io::{self, Write, stderr};
use std::sync::atomic::{AtomicBool, Ordering};

use rustix::termios::tcgetwinsize;
use scanhub_daemon::{PlaybackRate, Progress};

/// Progress line, which is removed from the terminal when this value is dropped.
#[derive(Default)]
pub(super) struct ProgressLine {
    drawn: String,
}

/// Writer of the log to stderr. It removes the progress line before each write.
pub(crate) struct LogWriter;

/// Whether the progress line is shown where the next output on stderr would appear.
static IS_SHOWN: AtomicBool = AtomicBool::new(false);

impl ProgressLine {
    pub(super) fn draw(&mut self, progress: &Progress) {
        let text = text(progress, columns());
        if text != self.drawn || !IS_SHOWN.load(Ordering::Relaxed) {
            // The next update could not overwrite a wrapped line. Turn wrapping off, in case the terminal has just
            // become narrower.
            IS_SHOWN.store(true, Ordering::Relaxed);
            let _ = stderr().write_all(format!("{CLEAR_LINE}\x1b[?7l{text}\x1b[?7h").as_bytes());
            self.drawn = text;
        }
    }
}

impl Drop for ProgressLine {
    fn drop(&mut self) {
        clear_line();
    }
}

impl Write for LogWriter {
    fn write(&mut self, event: &[u8]) -> io::Result<usize> {
        clear_line();
        stderr().write(event)
    }

    fn flush(&mut self) -> io::Result<()> {
        stderr().flush()
    }
}

fn clear_line() {
    if IS_SHOWN.swap(false, Ordering::Relaxed) {
        let _ = stderr().write_all(CLEAR_LINE.as_bytes());
    }
}

/// Returns the summary of a replay that has ended.
pub(super) fn summary(played: &Progress) -> String {
    let Progress { telegrams, position_ns, took_ns, paused_ns, rate, lap, .. } = *played;
    let span = |ns: u64| match ns {
        ..1_000_000_000 => format!("{} ms", ns.div_ceil(1_000_000)),
        _ => format!("{:.1} s", ns as f64 / 1e9),
    };
    let mut words =
        format!("replayed {telegrams} telegrams up to {}, in {}", clock(position_ns), span(took_ns));
    if paused_ns > 0 {
        words += &format!(" and {} of pauses", span(paused_ns));
    }
    if rate == PlaybackRate::Max && lap == 0 && took_ns > 0 {
        words += &format!(", {:.0} times as fast as it was recorded", position_ns as f64 / took_ns as f64);
    }
    words
}

/// Returns the longest text that is shorter than `columns`. Some terminals wrap after the last column, so it stays
/// empty.
fn text(progress: &Progress, columns: usize) -> String {
    let texts = (0..=MAX_BREVITY).map(|brevity| shortened_text(progress, brevity));
    texts.into_iter().find(|text| text.len() < columns).unwrap_or_default()
}

/// Returns the text for a level of `brevity`. With each level, the least useful part is omitted or shortened.
fn shortened_text(progress: &Progress, brevity: u32) -> String {
    let Progress { position_ns, length_ns, rate, is_paused, is_over, lap, telegrams, .. } = *progress;
    let mut text = clock(position_ns);
    if let Some(length_ns) = length_ns.filter(|length_ns| *length_ns > 0 && brevity < 6) {
        let bar_width = if brevity < 1 { BAR_WIDTH } else { BAR_WIDTH / 2 };
        let done = (position_ns.min(length_ns) as u128 * bar_width as u128 / u128::from(length_ns)) as usize;
        text += &match brevity {
            0..4 => format!(" [{}{}] {}", "#".repeat(done), ".".repeat(bar_width - done), clock(length_ns)),
            _ => format!(" of {}", clock(length_ns)),
        };
    }
    if brevity < 7 {
        text += &match rate {
            PlaybackRate::Times(rate) => format!("  x{rate}"),
            PlaybackRate::Max => "  x max".to_owned(),
        };
    }
    if brevity < 2 {
        text += &format!("  {telegrams} telegrams");
    }
    if lap > 0 && brevity < 5 {
        text += &format!("  lap {}", lap + 1);
    }
    let (state, keys) = match (is_over, is_paused) {
        (true, _) => ("  at its end", "; q quits"),
        (_, true) => ("  paused", "; space continues, . steps, q quits"),
        _ => ("", "  space pauses, + - rate, q quits"),
    };
    text += if brevity < MAX_BREVITY { state } else { "" };
    text + if brevity < 3 { keys } else { "" }
}

/// Returns the number of columns of the terminal, or the maximum if it is unknown.
fn columns() -> usize {
    let size = tcgetwinsize(stderr()).ok().map(|size| usize::from(size.ws_col));
    size.filter(|columns| *columns > 0).unwrap_or(usize::MAX)
}

/// Formats a time as minutes, seconds and tenths, with hours if there are any.
fn clock(ns: u64) -> String {
    let tenths = ns / 100_000_000;
    let (minutes, seconds) = (tenths / 600, tenths % 600);
    let rest = format!("{:02}.{}", seconds / 10, seconds % 10);
    match minutes / 60 {
        0 => format!("{minutes}:{rest}"),
        hours => format!("{hours}:{:02}:{rest}", minutes % 60),
    }
}

/// Number of characters of the bar.
const BAR_WIDTH: usize = 20;
/// Maximum brevity, at which the line shows only the time.
const MAX_BREVITY: u32 = 8;
/// Control sequence that moves the cursor to the start of the line and clears the line (ECMA-48).
const CLEAR_LINE: &str = "\r\x1b[K";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn progress_line_has_position_rate_and_lap() {
        let progress = Progress {
            position_ns: 65_250_000_000,
            length_ns: Some(130_500_000_000),
            rate: PlaybackRate::Times(0.5),
            is_paused: false,
            is_over: false,
            lap: 0,
            telegrams: 7,
            took_ns: 1,
            paused_ns: 0,
            now_ns: 2,
        };
        let begin = "1:05.2 [##########..........] 2:10.5  x0.5  7 telegrams  ";
        assert_eq!(text(&progress, usize::MAX), format!("{begin}space pauses, + - rate, q quits"));
        let open = Progress { length_ns: None, rate: PlaybackRate::Max, lap: 1, is_paused: true, ..progress };
        assert_eq!(
            text(&open, 200),
            "1:05.2  x max  7 telegrams  lap 2  paused; space continues, . steps, q quits"
        );
        for (columns, narrow) in [
            (80, "1:05.2 [#####.....] 2:10.5  x0.5  7 telegrams  space pauses, + - rate, q quits"),
            (70, "1:05.2 [#####.....] 2:10.5  x0.5  space pauses, + - rate, q quits"),
            (64, "1:05.2 [#####.....] 2:10.5  x0.5"),
            (30, "1:05.2 of 2:10.5  x0.5"),
            (17, "1:05.2  x0.5"),
            (7, "1:05.2"),
            (6, ""),
        ] {
            assert_eq!(text(&progress, columns), narrow, "{columns}");
        }
        let paused = Progress { is_paused: true, ..progress };
        let steps = "1:05.2 [#####.....] 2:10.5  x0.5  paused; space continues, . steps, q quits";
        assert_eq!((&text(&paused, 80)[..], &text(&paused, 15)[..]), (steps, "1:05.2  paused"));
        assert_eq!(clock(3_725_000_000_000), "1:02:05.0");
    }

    #[test]
    fn summary_has_duration_and_speed() {
        let played = Progress {
            position_ns: 60_000_000_000,
            length_ns: None,
            rate: PlaybackRate::Max,
            is_paused: false,
            is_over: true,
            lap: 0,
            telegrams: 7,
            took_ns: 30_000_000,
            paused_ns: 0,
            now_ns: 2,
        };
        let words = "replayed 7 telegrams up to 1:00.0, in 30 ms, 2000 times as fast as it was recorded";
        assert_eq!(summary(&played), words);
        let slow = Progress { rate: PlaybackRate::Times(1.0), took_ns: 61_000_000_000, ..played };
        assert_eq!(summary(&slow), "replayed 7 telegrams up to 1:00.0, in 61.0 s");
        let paused = Progress { paused_ns: 12_340_000_000, ..played };
        let words = "replayed 7 telegrams up to 1:00.0, in 30 ms and 12.3 s of pauses, 2000 times as fast as it was recorded";
        assert_eq!(summary(&paused), words);
    }
}
