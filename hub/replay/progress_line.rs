//! One line that says how far a player is, drawn over itself. What the log says meanwhile stands above it.

use std::io::{self, Write, stderr};
use std::sync::atomic::{AtomicBool, Ordering};

use rustix::termios::tcgetwinsize;
use scanhub_daemon::{PlaybackRate, Progress};

/// The line at the bottom of stderr, until it is dropped.
#[derive(Default)]
pub(super) struct ProgressLine {
    drawn: String,
}

/// stderr as the log writes to it.
pub(crate) struct LogWriter;

/// Whether there is a line where the next word on stderr would stand.
static IS_SHOWN: AtomicBool = AtomicBool::new(false);

impl ProgressLine {
    pub(super) fn draw(&mut self, progress: &Progress) {
        let text = text(progress, columns());
        if text != self.drawn || !IS_SHOWN.load(Ordering::Relaxed) {
            // A line that wraps would not be drawn over: should the terminal have become narrower just now, it is cut.
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

/// What was played, when it is over.
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

/// As much as goes into `columns` but the last one, after which some terminals wrap.
fn text(progress: &Progress, columns: usize) -> String {
    let texts = (0..=MAX_BREVITY).map(|brevity| shortened_text(progress, brevity));
    texts.into_iter().find(|text| text.len() < columns).unwrap_or_default()
}

/// Whole parts, the fewer the greater `brevity` is: first goes what helps least.
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

/// Columns of the terminal; no end of them if it does not tell.
fn columns() -> usize {
    let size = tcgetwinsize(stderr()).ok().map(|size| usize::from(size.ws_col));
    size.filter(|columns| *columns > 0).unwrap_or(usize::MAX)
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
const BAR_WIDTH: usize = 20;
/// Brevity at which nothing is left but the time.
const MAX_BREVITY: u32 = 8;
/// To the line's begin, and nothing on it (ECMA-48).
const CLEAR_LINE: &str = "\r\x1b[K";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn how_far_it_is() {
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
    fn how_long_it_took() {
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
