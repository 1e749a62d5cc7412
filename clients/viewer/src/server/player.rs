//! Control of a player by viewers: the viewers' commands, and the player's progress as a message.

use serde::{Deserialize, Serialize};

use super::channels::Channel;
use super::messages::{json_bytes, json_channel};

/// Command of a viewer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum PlayerCommand {
    /// Pause or resume.
    Toggle,
    /// Play the next telegram, and pause.
    Step,
    /// Double the rate.
    Faster,
    /// Halve the rate.
    Slower,
}

/// Progress of the player.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Progress {
    /// Position in seconds from the first telegram.
    pub position_s: f64,
    /// Position of the end in seconds, if it is known.
    pub length_s: Option<f64>,
    /// Rate as a multiple of the recorded rate; `None` means as fast as possible.
    pub rate: Option<f64>,
    /// Whether the player is paused.
    pub paused: bool,
    /// Whether the end has been reached.
    pub over: bool,
    /// Number of times that the player has restarted the recording.
    pub lap: u32,
    /// Number of telegrams of all sensors that were played, in all laps.
    pub telegrams: u64,
}

impl Progress {
    /// Returns whether the picture stays as it is until the player continues.
    pub fn is_held(&self) -> bool {
        self.paused || self.over
    }
}

/// Player that the viewers of one server control.
pub trait Playback: Sync {
    /// Executes a command of a viewer.
    fn command(&self, command: PlayerCommand);
    /// Returns the current progress.
    fn progress(&self) -> Progress;
}

/// Returns the channel of the player's progress, see [`message`].
pub(crate) fn channel() -> Channel {
    json_channel("/replay".to_owned(), "scanhub.Replay", include_str!("messages/replay.json"))
}

/// Encodes the progress as fields, and as text in `words`.
pub(crate) fn message(progress: &Progress) -> Vec<u8> {
    #[derive(Serialize)]
    struct Replay<'a> {
        #[serde(flatten)]
        progress: &'a Progress,
        words: String,
    }
    json_bytes(&Replay { progress, words: text(progress) })
}

fn text(&Progress { position_s, length_s, rate, paused, over, lap, .. }: &Progress) -> String {
    let speed = rate.map_or("\u{d7}max".to_owned(), |rate| format!("\u{d7}{rate}"));
    let state = match (over, paused) {
        (true, _) => "at its end".to_owned(),
        (false, true) => format!("paused, {speed}"),
        (false, false) => speed,
    };
    let length = length_s.map_or(String::new(), |length_s| format!(" / {}", clock(length_s)));
    let lap = if lap > 0 { format!("  lap {}", lap + 1) } else { String::new() };
    format!("{}{length}  {state}{lap}", clock(position_s))
}

/// Formats minutes and seconds.
fn clock(seconds: f64) -> String {
    let tenths = (seconds.max(0.0) * 10.0).round() as u64;
    format!("{}:{:02}.{}", tenths / 600, tenths / 10 % 60, tenths % 10)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn progress_is_formatted_as_text() {
        let playing =
            Progress { position_s: 59.96, length_s: Some(75.0), rate: Some(0.5), ..Progress::default() };
        let paused = Progress { paused: true, rate: None, length_s: None, lap: 1, ..playing };
        let over = Progress { over: true, paused: true, ..playing };
        assert_eq!(text(&playing), "1:00.0 / 1:15.0  \u{d7}0.5");
        assert_eq!(text(&paused), "1:00.0  paused, \u{d7}max  lap 2");
        assert_eq!(text(&over), "1:00.0 / 1:15.0  at its end");
    }
}
