//! How far a recording is that is played, as an object of JSON, and in words. Refuses to know what plays it.

use serde::Serialize;

use super::{bytes, json};
use crate::server::board::Channel;
use crate::server::playback::Progress;

/// How far the recording is that is played, see [`replay`].
pub fn replay_channel() -> Channel {
    json("/replay".to_owned(), "scanhub.Replay", include_str!("replay.json"))
}

/// How far the player is, as fields and as `words` for people.
pub fn replay(progress: &Progress) -> Vec<u8> {
    #[derive(Serialize)]
    struct Told<'a> {
        #[serde(flatten)]
        progress: &'a Progress,
        words: String,
    }
    bytes(&Told { progress, words: words(progress) })
}

fn words(&Progress { position_s, length_s, rate, paused, over, lap, .. }: &Progress) -> String {
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

/// Minutes and seconds.
fn clock(seconds: f64) -> String {
    let tenths = (seconds.max(0.0) * 10.0).round() as u64;
    format!("{}:{:02}.{}", tenths / 600, tenths / 10 % 60, tenths % 10)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn how_far_it_is_in_words() {
        let playing =
            Progress { position_s: 59.96, length_s: Some(75.0), rate: Some(0.5), ..Progress::default() };
        let paused = Progress { paused: true, rate: None, length_s: None, lap: 1, ..playing };
        let over = Progress { over: true, paused: true, ..playing };
        assert_eq!(words(&playing), "1:00.0 / 1:15.0  \u{d7}0.5");
        assert_eq!(words(&paused), "1:00.0  paused, \u{d7}max  lap 2");
        assert_eq!(words(&over), "1:00.0 / 1:15.0  at its end");
    }
}
