//! What goes on, as lines for files and pipes; a terminal has the picture of `watch`.

use std::io::Write;
use std::time::Duration;

use super::account::{Account, Sensor, counted};

/// What was said last.
pub(crate) struct View {
    /// What somebody types in another terminal to look at it.
    attach: String,
    /// Where a browser sees it.
    url: Option<String>,
    /// Seconds for which there are lines.
    seconds: u64,
}

impl View {
    /// Of a demonstration that `attach` lets somebody look at, and a browser at `url`.
    pub(crate) fn new(attach: String, url: Option<&str>) -> Self {
        View { attach, url: url.map(str::to_owned), seconds: 0 }
    }

    /// Says once a second how the account is after `elapsed`.
    pub(crate) fn draw(&mut self, out: &mut dyn Write, account: &Account, elapsed: Duration) {
        if elapsed.as_secs() >= self.seconds {
            self.seconds = elapsed.as_secs() + 1;
            let text = self.lines(account, elapsed).join("\n") + "\n\n";
            let _ = out.write_all(text.as_bytes()).and_then(|()| out.flush());
        }
    }

    fn lines(&self, account: &Account, elapsed: Duration) -> Vec<String> {
        let seconds = elapsed.as_secs();
        let mut lines = vec![
            format!(
                "scanhub demo  {:02}:{:02}   the hub uses {:.1} % of a processor   Ctrl-C quits",
                seconds / 60,
                seconds % 60,
                account.hub_cpu_percent
            ),
            self.attach.clone(),
        ];
        lines.extend(self.url.iter().map(|url| format!("browser: {url}")));
        lines.extend(account.news.iter().map(|news| format!("people: {news}")));
        for sensor in &account.sensors {
            lines.push(String::new());
            lines.extend(sensor_lines(sensor));
        }
        lines.extend(account.tilted_words());
        lines
    }
}

fn sensor_lines(sensor: &Sensor) -> [String; 3] {
    // What is on its way is not lost: the truth is a little ahead of the consumers.
    let lost = sensor.lost().saturating_sub(IN_FLIGHT);
    let nearest = match sensor.nearest_mm {
        Some(mm) => format!("nearest {:.2} m at {:.1} degrees", mm as f64 / 1000.0, sensor.nearest_deg),
        None => "nothing seen".to_owned(),
    };
    [
        format!(
            "{:6} {:9} {:6} Bd  {:>5} Hz   {}   {} lost, {} on the line",
            sensor.name,
            sensor.state,
            sensor.baud,
            sensor.hz().map_or("-".into(), |hz| format!("{hz:.2}")),
            counted(sensor.received_count, "telegram"),
            lost,
            sensor.lost_on_line().unwrap_or_default(),
        ),
        format!("  left  {}  right", profile(sensor)),
        format!("        {:<COLUMNS$}", format!("(the taller, the nearer)   {nearest}")),
    ]
}

/// The scan from left to right, the nearest beam of each column as a block that is the taller the nearer.
fn profile(sensor: &Sensor) -> String {
    if sensor.ranges.is_empty() {
        return "waiting for the first scan".to_owned();
    }
    let beams = sensor.ranges.len();
    let column = |n: usize| {
        let nearest = sensor.ranges[n * beams / COLUMNS..(n + 1) * beams / COLUMNS].iter().flatten().min();
        nearest.map_or(' ', |&mm| {
            BLOCKS[(BLOCKS.len() - 1) - (mm as usize * BLOCKS.len() / FAR_MM).min(BLOCKS.len() - 1)]
        })
    };
    // Beam 0 is on the right.
    (0..COLUMNS).rev().map(column).collect()
}

const COLUMNS: usize = 60;
const BLOCKS: [char; 8] = ['▁', '▂', '▃', '▄', '▅', '▆', '▇', '█'];
/// The lowest block.
const FAR_MM: usize = 8000;
/// Telegrams that may be between the two ends at a look.
const IN_FLIGHT: u64 = 12;
