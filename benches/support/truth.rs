//! What the simulator says that it sent: the truth that everything received is compared with.

use std::collections::HashMap;
use std::path::Path;

use serde_json::Value;
use sha2::{Digest, Sha256};

use super::Outcome;

/// A telegram of measured data that left whole.
#[derive(Clone, Debug)]
pub(crate) struct Sent {
    pub(crate) hash: String,
    /// Its number among all that the sensor sent.
    pub(crate) index: u64,
    /// CLOCK_MONOTONIC after its last byte was written.
    pub(crate) at_ns: u64,
}

/// What one sensor sent, in its order.
#[derive(Clone, Debug, Default)]
pub(crate) struct Truth {
    pub(crate) sent: Vec<Sent>,
    /// What found no room at the host, or not all of it: the rest of a later one may make it whole again.
    overrun: Vec<Sent>,
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
            } else if value["kind"] == "data" && (value["fault"].is_null() || value["fault"] == "overrun") {
                let hash = value["sha256"].as_str().unwrap_or_default().to_owned();
                let number = |key: &str| value[key].as_u64().unwrap_or_default();
                let sent = Sent { hash, index: number("index"), at_ns: number("sent_ns") };
                if value["fault"].is_null() { &mut truth.sent } else { &mut truth.overrun }.push(sent);
            }
        }
        Ok(truth)
    }

    /// When each was due, by its hash, of a sensor that sends one each `every_ns`: some of its neighbours left in time. And for
    /// how long it sent nothing in all although it should have.
    pub(crate) fn due(&self, every_ns: u64) -> (HashMap<&str, Vec<u64>>, u64) {
        let mut all: Vec<&Sent> = self.sent.iter().chain(&self.overrun).collect();
        all.sort_by_key(|sent| sent.index);
        let begin = |sent: &&Sent| sent.at_ns.saturating_sub(sent.index * every_ns);
        let begins: Vec<u64> = all.iter().map(begin).collect();
        let least = |n: usize| {
            let around = n.saturating_sub(NEIGHBOURS)..(n + NEIGHBOURS).min(begins.len());
            begins[around].iter().copied().min().unwrap_or_default()
        };
        let least: Vec<u64> = (0..begins.len()).map(least).collect();
        let mut due: HashMap<&str, Vec<u64>> = HashMap::new();
        for (sent, begin) in all.into_iter().zip(&least) {
            due.entry(&sent.hash).or_default().push(begin + sent.index * every_ns);
        }
        let stood = least.windows(2).map(|pair| pair[1].saturating_sub(pair[0])).sum();
        (due, stood)
    }

    /// How many left from `from_ns` on and before `to_ns`.
    pub(crate) fn count(&self, from_ns: u64, to_ns: u64) -> usize {
        self.sent.iter().filter(|sent| (from_ns..to_ns).contains(&sent.at_ns)).count()
    }
}

/// Telegrams on either side of which one left in time.
const NEIGHBOURS: usize = 200;

/// SHA-256 as the truth writes it.
pub(crate) fn hash(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect()
}
