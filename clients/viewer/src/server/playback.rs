//! What viewers do with a recording that is played for them: the orders of a player, and how far it is. Refuses to know how
//! it is played.

use serde::{Deserialize, Serialize};

/// What a viewer asks of the player.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Order {
    /// To pause, or to go on.
    Toggle,
    /// To play the next telegram, and pause.
    Step,
    /// To go on twice as fast.
    Faster,
    /// To go on half as fast.
    Slower,
}

/// How far the player is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Progress {
    /// Seconds from the first telegram on.
    pub position_s: f64,
    /// Those of the end, where it is known.
    pub length_s: Option<f64>,
    /// How many times as fast as it was recorded; nothing: as fast as it can be read.
    pub rate: Option<f64>,
    /// It waits.
    pub paused: bool,
    /// Everything was played.
    pub over: bool,
    /// Times that it started again.
    pub lap: u32,
    /// Telegrams that were played, of all sensors and laps.
    pub telegrams: u64,
}

impl Progress {
    /// What is seen stays as it is until the player goes on.
    pub fn stands(&self) -> bool {
        self.paused || self.over
    }
}

/// A recording that is played for the viewers of a server alone.
pub trait Playback: Sync {
    /// Does what a viewer asks for.
    fn order(&self, order: Order);
    /// How far it is.
    fn progress(&self) -> Progress;
}
