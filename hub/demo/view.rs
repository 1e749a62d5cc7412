//! The live picture: a block of lines that is drawn over itself.

use std::io::Write;
use std::time::Duration;

use super::account::{Account, Sensor};

/// What was drawn last.
pub(crate) struct View {
    domain: String,
    hub_pid: u32,
    /// Whether the block can be drawn over; else every picture is one line.
    terminal: bool,
    drawn: usize,
}

impl View {
    pub(crate) fn new(domain: &str, hub_pid: u32, terminal: bool) -> Self {
        View { domain: domain.to_owned(), hub_pid, terminal, drawn: 0 }
    }

    /// Draws the account as it is after `elapsed`.
    pub(crate) fn draw(&mut self, out: &mut dyn Write, account: &Account, elapsed: Duration) {
        let lines = self.lines(account, elapsed);
        let mut picture = String::new();
        if self.terminal {
            if self.drawn > 0 {
                picture += &format!("\x1b[{}A", self.drawn);
            }
            for line in &lines {
                picture += &format!("\x1b[2K{line}\n");
            }
            // A line that wraps would be two, and the next picture would not find its place: it is cut.
            picture = format!("\x1b[?7l{picture}\x1b[?7h");
            self.drawn = lines.len();
        } else if elapsed.as_secs() >= self.drawn as u64 {
            // Into a file or a pipe: once a second is enough.
            self.drawn = elapsed.as_secs() as usize + 1;
            picture = lines.join("\n") + "\n";
        }
        let _ = out.write_all(picture.as_bytes()).and_then(|()| out.flush());
    }

    /// Leaves the last picture where it is.
    pub(crate) fn end(&mut self, out: &mut dyn Write) {
        let _ = out.write_all(b"\n").and_then(|()| out.flush());
    }

    fn lines(&self, account: &Account, elapsed: Duration) -> Vec<String> {
        let seconds = elapsed.as_secs();
        let mut lines = vec![
            format!(
                "scanhub demo  {:02}:{:02}   hub {} uses {:.1} % of a processor   Ctrl-C ends it",
                seconds / 60,
                seconds % 60,
                self.hub_pid,
                account.hub_cpu_percent
            ),
            format!("look from another terminal:  scanhub echo front/scan --domain {}", self.domain),
        ];
        for sensor in &account.sensors {
            lines.push(String::new());
            lines.extend(sensor_lines(sensor));
        }
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
            "{:6} {:9} {:6} Bd  {:5.2} Hz   {} telegrams   {} lost",
            sensor.name,
            sensor.state,
            sensor.baud,
            sensor.hz(),
            sensor.received_count,
            lost,
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
