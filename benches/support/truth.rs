//! What the simulator says that it sent: the truth that everything received is compared with.

use std::path::Path;

use serde_json::Value;
use sha2::{Digest, Sha256};

use super::Outcome;

/// A telegram of measured data that left whole.
#[derive(Clone, Debug)]
pub(crate) struct Sent {
    pub(crate) hash: String,
    /// CLOCK_MONOTONIC after its last byte was written.
    pub(crate) at_ns: u64,
}

/// What one sensor sent, in its order.
#[derive(Clone, Debug, Default)]
pub(crate) struct Truth {
    pub(crate) sent: Vec<Sent>,
    /// When each telegram of measured data ended that the sensor broke off, because it was asked something.
    pub(crate) aborted_ns: Vec<u64>,
    /// Only known once the simulator has ended.
    pub(crate) eeprom_writes: Option<u64>,
}

impl Truth {
    /// The truth of `sensor` in the file at `path`.
    pub(crate) fn read(path: &Path, sensor: &str) -> Outcome<Truth> {
        let mut truth = Truth::default();
        for line in std::fs::read_to_string(path)?.lines() {
            // The last line may be in the writing.
            let Ok(value) = serde_json::from_str::<Value>(line) else { continue };
            let port = value["port"].as_str().unwrap_or_default();
            if port.rsplit('/').next() != Some(sensor) {
                continue;
            }
            if value["class"] == "simulated" {
                truth.eeprom_writes = value["eeprom_writes"].as_u64();
            } else if value["kind"] == "data" && value["fault"] == "aborted" {
                truth.aborted_ns.extend(value["sent_ns"].as_u64());
            } else if value["kind"] == "data" && value["fault"].is_null() {
                let hash = value["sha256"].as_str().unwrap_or_default().to_owned();
                truth.sent.push(Sent { hash, at_ns: value["sent_ns"].as_u64().unwrap_or_default() });
            }
        }
        Ok(truth)
    }

    /// How many left from `from_ns` on and before `to_ns`.
    pub(crate) fn count(&self, from_ns: u64, to_ns: u64) -> usize {
        self.sent.iter().filter(|sent| (from_ns..to_ns).contains(&sent.at_ns)).count()
    }
}

/// SHA-256 as the truth writes it.
pub(crate) fn hash(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect()
}
