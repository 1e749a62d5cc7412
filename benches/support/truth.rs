//! The log of the simulator, with the telegrams that the simulator has sent. The benches compare received data with
//! this log.

use std::collections::HashMap;
use std::path::Path;

use serde_json::Value;
use sha2::{Digest, Sha256};

use super::Outcome;

/// A telegram of measured data that was sent completely.
#[derive(Clone, Debug)]
pub(crate) struct SentTelegram {
    pub(crate) hash: String,
    /// Index of the telegram among all telegrams that the sensor sent.
    pub(crate) index: u64,
    /// Time of CLOCK_MONOTONIC after the telegram's last byte was written.
    pub(crate) at_ns: u64,
}

/// The telegrams of one sensor, in order.
#[derive(Clone, Debug, Default)]
pub(crate) struct SensorTruth {
    pub(crate) sent: Vec<SentTelegram>,
    /// Telegrams for which the buffer of the host had not enough room, or no room. If only a part of a telegram had
    /// room, bytes of a later telegram may complete it.
    overrun: Vec<SentTelegram>,
    /// Times at which the sensor aborted a telegram of measured data in order to reply to a request.
    pub(crate) aborted_ns: Vec<u64>,
    /// Number of EEPROM writes. It is `None` until the simulator has ended.
    pub(crate) eeprom_writes: Option<u64>,
}

impl SensorTruth {
    /// Reads the telegrams that `sensor` sent from the file at `path`.
    pub(crate) fn read(path: &Path, sensor: &str) -> Outcome<SensorTruth> {
        let mut truth = SensorTruth::default();
        for line in std::fs::read_to_string(path)?.lines() {
            // The last line may be incomplete, so skip lines that cannot be parsed.
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
                let sent = SentTelegram { hash, index: number("index"), at_ns: number("sent_ns") };
                if value["fault"].is_null() { &mut truth.sent } else { &mut truth.overrun }.push(sent);
            }
        }
        Ok(truth)
    }

    /// Returns the times at which each telegram was due, by the hash of the telegram, and the total time in nanoseconds
    /// for which the sensor could not send. The sensor sends one telegram every `every_ns` nanoseconds. The computation
    /// assumes that near each telegram, the sensor sent at least one telegram in time.
    pub(crate) fn due(&self, every_ns: u64) -> (HashMap<&str, Vec<u64>>, u64) {
        let mut all: Vec<&SentTelegram> = self.sent.iter().chain(&self.overrun).collect();
        all.sort_by_key(|sent| sent.index);
        let begin = |sent: &&SentTelegram| sent.at_ns.saturating_sub(sent.index * every_ns);
        let begins: Vec<u64> = all.iter().map(begin).collect();
        let min_delay = |n: usize| {
            let around = n.saturating_sub(NEIGHBOR_COUNT)..(n + NEIGHBOR_COUNT).min(begins.len());
            begins[around].iter().copied().min().unwrap_or_default()
        };
        let min_delay: Vec<u64> = (0..begins.len()).map(min_delay).collect();
        let mut due: HashMap<&str, Vec<u64>> = HashMap::new();
        for (sent, begin) in all.into_iter().zip(&min_delay) {
            due.entry(&sent.hash).or_default().push(begin + sent.index * every_ns);
        }
        let stood = min_delay.windows(2).map(|pair| pair[1].saturating_sub(pair[0])).sum();
        (due, stood)
    }

    /// Returns the number of telegrams that were sent at or after `from_ns` and before `to_ns`.
    pub(crate) fn count(&self, from_ns: u64, to_ns: u64) -> usize {
        self.sent.iter().filter(|sent| (from_ns..to_ns).contains(&sent.at_ns)).count()
    }
}

/// Number of neighbors on either side of a telegram. At least one of them is assumed to have been sent in time.
const NEIGHBOR_COUNT: usize = 200;

/// Returns the SHA-256 of `bytes` as the simulator writes it.
pub(crate) fn hash(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect()
}
