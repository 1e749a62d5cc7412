//! A scanner at the start of a simulation, and what will go wrong in it. Plain values; [`crate::rplidar`] acts on them.

use schema::{MILLIS, Nanos};

use super::models::Model;
use crate::fault::Faults;
use crate::settings::Habits;
use crate::transmission::ChunkSize;

/// How a scanner is.
#[derive(Clone, Debug)]
pub struct UnitSettings {
    /// Which one.
    pub model: Model,
    /// Number of the mode that it recommends; by default the model's.
    pub typical: usize,
    /// Turns in a second, on the mean; by default the model's.
    pub turns_per_second: f64,
    /// By which share of that the speed goes up and down.
    pub wander: f64,
    /// What it does at time 0.
    pub start: UnitStart,
    /// From power-on to the banner.
    pub boot_ns: Nanos,
    /// Status and code that it reports; a status of 2 is an error, in which it does not measure.
    pub health: (u8, u16),
    /// Whether that stays after a RESET.
    pub stubborn: bool,
    /// How it deviates from the manual; what only an LMS has is ignored.
    pub habits: Habits,
    /// Faults of the scanner: times in which something holds its head.
    pub faults: Faults,
    /// How many bytes the host's hardware hands over at once.
    pub chunk: ChunkSize,
    /// Of its speed, its serial number, its habits and its faults.
    pub seed: u64,
}

/// What a scanner does at time 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum UnitStart {
    /// It waits for requests, its motor as power-on leaves it, but at speed.
    Idle,
    /// It streams in its typical mode: a host that is gone left it so.
    Streaming,
    /// It gets its power now.
    PowerOn,
}

impl UnitSettings {
    /// A `model` as it comes out of its box, switched on long ago.
    pub fn of(model: Model) -> UnitSettings {
        UnitSettings {
            model,
            typical: model.typical(),
            turns_per_second: model.turns_per_second(),
            wander: 0.005,
            start: UnitStart::Idle,
            boot_ns: 2_000 * MILLIS,
            health: (0, 0),
            stubborn: false,
            habits: Habits::default(),
            faults: Faults::default(),
            chunk: ChunkSize::Uart,
            seed: 0,
        }
    }
}
