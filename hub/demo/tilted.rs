//! What was seen in three dimensions, for the end of the demonstration. Refuses to know how.

use serde::Serialize;
use serde_json::Value;

use super::account::counted;

/// The sweeps so far: the last line, keys in the order of their contract.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub(super) struct Tilted {
    class: &'static str,
    sensor: String,
    sweeps: u64,
    /// In the last sweep.
    obstacles: usize,
    /// How far the nearest of them is from the robot's centre.
    nearest_m: Option<f64>,
}

impl Tilted {
    /// Takes a line of class `obstacles`.
    pub(super) fn take(&mut self, line: &Value) {
        let obstacles = line["obstacles"].as_array().map(Vec::as_slice).unwrap_or_default();
        *self = Tilted {
            class: "summary",
            sensor: line["sensor"].as_str().unwrap_or_default().to_owned(),
            sweeps: self.sweeps + 1,
            obstacles: obstacles.len(),
            nearest_m: obstacles.first().and_then(|one| one["distance_m"].as_f64()),
        };
    }

    /// In JSON, or for people.
    pub(super) fn line(&self, json: bool) -> String {
        if json {
            return serde_json::to_string(self).unwrap_or_default();
        }
        let nearest = self.nearest_m.map_or(String::new(), |m| format!(", the nearest at {m:.2} m"));
        let (sweeps, obstacles) = (counted(self.sweeps, "sweep"), counted(self.obstacles as u64, "obstacle"));
        format!("{:6} {sweeps}, {obstacles} in the last{nearest}", self.sensor)
    }
}
