//! Comparison of the telegrams that the simulators sent with those that the subscribers received. Telegrams are
//! identified by their hash, so a damaged telegram counts as lost.

use std::collections::{HashMap, HashSet};
use std::time::{Duration, Instant};

use scanhub_drivers::features;
use serde::Serialize;
use serde_json::Value;
use sha2::{Digest, Sha256};

/// Counts of all sensors.
pub(crate) struct DeliveryStats {
    pub(crate) sensors: Vec<Sensor>,
    /// Time of the cut, the end of the count, in nanoseconds of the monotonic clock. Telegrams whose last byte was sent
    /// later do not count.
    cut_ns: u64,
    cut_at: Option<Instant>,
    /// Results of three-dimensional perception, if a sensor is on a mount.
    tilted: Option<TiltSummary>,
    hub: Option<CpuTime>,
    /// Last line of the people tracker.
    pub(crate) tracker_line: Option<String>,
    /// CPU time of the hub since all sensors stream, in percent of one processor.
    pub(crate) hub_cpu_percent: f64,
}

/// Counts of one sensor.
#[derive(Default)]
pub(crate) struct Sensor {
    pub(crate) name: String,
    pub(crate) state: String,
    pub(crate) baud: u64,
    /// Whether the scanner is a rotating one, which sends packets. Packets before the first subscriber do not count.
    is_rotating: bool,
    /// Hashes of packets that were sent before the first packet arrived.
    sent_before_first: Vec<String>,
    /// Number of telegrams of measured data that were sent completely before the cut.
    pub(crate) sent: u64,
    /// Number of telegrams that were sent and have not arrived, by hash.
    missing: HashMap<String, u64>,
    /// Number of telegrams that arrived before the simulator reported them, by hash.
    early: HashMap<String, u64>,
    pub(crate) received_count: u64,
    /// Ranges of the last scan from right to left, in millimeters. `None` is a beam without a reading.
    pub(crate) ranges: Vec<Option<u64>>,
    pub(crate) nearest_mm: Option<u64>,
    pub(crate) nearest_deg: f64,
    pub(crate) first_ns: u64,
    pub(crate) last_ns: u64,
    eeprom_writes: u64,
    /// Counters of the line in the last status, and those before the first telegram.
    line: Option<LineCounts>,
    line_before: LineCounts,
    /// Number of published samples of telegrams that the subscriber of this demonstration missed.
    pub(crate) missed: u64,
    /// Hashes of telegrams that were sent after the cut.
    after_cut: HashSet<String>,
    /// Whether a telegram that was sent after the cut has arrived. Telegrams arrive in their order, so no more
    /// telegrams from before the cut will arrive.
    is_past_cut: bool,
    /// Time at which the last telegram arrived.
    arrived_at: Option<Instant>,
}

/// Counters of a sensor's line since the start of the hub.
#[derive(Clone, Copy, Default)]
struct LineCounts {
    read: u64,
    damaged: u64,
    /// Number of scans that the line lost; `None` while the period of the scans is unknown.
    lost: Option<u64>,
}

/// CPU time that the hub had used at a point in time.
#[derive(Clone, Copy)]
struct CpuTime {
    since: Instant,
    used_ns: u64,
}

/// Line of a sensor in the summary. The order of the keys is part of the contract.
#[derive(Serialize)]
struct Summary<'a> {
    class: &'static str,
    sensor: &'a str,
    state: &'a str,
    sent: u64,
    received: u64,
    lost: u64,
    hz: Option<f64>,
    seconds: f64,
    nearest_mm: Option<u64>,
    hub_cpu_percent: f64,
    eeprom_writes: u64,
    damaged: Option<f64>,
    lost_on_line: Option<u64>,
    missed: u64,
}

impl DeliveryStats {
    pub(crate) fn new(sensors: &[super::participants::Sensor]) -> Self {
        let sensors = sensors.iter().map(|sensor| Sensor {
            name: sensor.name.clone(),
            state: "absent".into(),
            is_rotating: !features(sensor.family).has_whole_telegrams,
            ..Sensor::default()
        });
        DeliveryStats {
            sensors: sensors.collect(),
            cut_ns: u64::MAX,
            cut_at: None,
            tilted: None,
            hub: None,
            tracker_line: None,
            hub_cpu_percent: 0.0,
        }
    }

    /// Handles a line that the subscriber of the sensor with this index printed.
    pub(crate) fn handle_line(&mut self, index: usize, line: &Value) {
        if line["class"] == "obstacles" {
            self.tilted.get_or_insert_default().take(line);
        }
        let Some(sensor) = self.sensors.get_mut(index) else { return };
        match line["class"].as_str() {
            Some("telegram") => sensor.take_telegram(line),
            Some("scan") => sensor.take_scan(line),
            Some("notice") if line["kind"] == "missed" && line["topic"] == "telegram" => {
                sensor.missed += line["missed"].as_u64().unwrap_or_default();
            }
            Some("status") => {
                sensor.state = line["state"].as_str().unwrap_or_default().to_owned();
                let count = |name: &str| line["counters"][name].as_u64().unwrap_or_default();
                let (read, damaged) = (count("bytes_read"), count("bytes_damaged"));
                let counts = LineCounts { read, damaged, lost: line["lost_on_line"].as_u64() };
                sensor.line = Some(counts);
                if sensor.arrived_at.is_none() {
                    sensor.line_before = counts;
                }
                sensor.baud = line["baud"].as_u64().unwrap_or_default();
            }
            _ => {}
        }
    }

    /// Handles a line of the people tracker.
    pub(crate) fn set_tracker_line(&mut self, line: String) {
        self.tracker_line = Some(line);
    }

    /// Returns whether a scan of every sensor has arrived.
    pub(crate) fn all_stream(&self) -> bool {
        self.sensors.iter().all(|sensor| !sensor.ranges.is_empty())
    }

    /// Returns whether no more telegrams from before the cut will arrive. This is so if each sensor has either
    /// delivered a telegram from after the cut, or delivered no telegram for `limit`. After six times `limit` since the
    /// cut, always returns true.
    pub(crate) fn is_complete(&self, limit: Duration) -> bool {
        let Some(cut_at) = self.cut_at else { return false };
        // A sensor that has sent nothing by the cut has lost nothing.
        let is_silent = |sensor: &Sensor| match sensor.arrived_at {
            Some(at) => at.max(cut_at).elapsed() > limit,
            None => sensor.sent == 0 || cut_at.elapsed() > limit,
        };
        let all_arrived = self.sensors.iter().all(|sensor| sensor.is_past_cut || is_silent(sensor));
        all_arrived || cut_at.elapsed() > limit.saturating_mul(6)
    }

    /// Handles a line of a simulator: a telegram that it sent, or its summary.
    pub(crate) fn take_simulator_line(&mut self, text: &str) {
        let line: Value = serde_json::from_str(text).unwrap_or_default();
        let name = line["port"].as_str().and_then(|port| port.rsplit('/').next());
        let of = self.sensors.iter_mut().find(|sensor| name == Some(sensor.name.as_str()));
        let Some(sensor) = of else { return };
        if line["class"] == "simulated" {
            sensor.eeprom_writes = line["eeprom_writes"].as_u64().unwrap_or(u64::MAX);
        } else if line["kind"] == "data" && line["fault"].is_null() {
            let sent_ns = line["sent_ns"].as_u64().unwrap_or_default();
            let hash = line["sha256"].as_str().unwrap_or_default();
            if sent_ns <= self.cut_ns {
                sensor.take_sent(hash);
            } else {
                sensor.is_past_cut |= sensor.early.contains_key(hash);
                sensor.after_cut.insert(hash.to_owned());
            }
        }
    }

    /// Ends the count: telegrams that are sent from now on do not count.
    pub(crate) fn cut(&mut self) {
        let now = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
        self.cut_ns = now.tv_sec as u64 * 1_000_000_000 + now.tv_nsec as u64;
        self.cut_at = Some(Instant::now());
    }

    /// Updates the CPU time of the hub, process `pid`.
    pub(crate) fn update_cpu_time(&mut self, pid: u32) {
        let now = CpuTime { since: Instant::now(), used_ns: cpu_time_ns(pid) };
        // The CPU time of the search for the scanners does not count, so the measurement starts when all sensors
        // stream.
        if self.sensors.iter().any(|sensor| sensor.ranges.is_empty()) {
            self.hub = Some(now);
            return;
        }
        if let Some(begin) = self.hub {
            let span = now.since.duration_since(begin.since).as_nanos().max(1);
            self.hub_cpu_percent = 100.0 * now.used_ns.saturating_sub(begin.used_ns) as f64 / span as f64;
        }
    }

    /// Returns a text about the total losses and their reasons; `None` without losses.
    pub(crate) fn loss(&self) -> Option<String> {
        let lossy = || self.sensors.iter().filter(|sensor| sensor.lost() > 0);
        let count = |of: fn(&Sensor) -> u64| lossy().map(of).sum::<u64>();
        let lost = Some(count(Sensor::lost)).filter(|&lost| lost > 0)?;
        let causes = [
            (count(|sensor| sensor.missed), "published by the hub, but missed by this program's subscribers"),
            (count(|sensor| sensor.lost_on_line().unwrap_or_default()), "lost on the line"),
        ];
        let causes =
            causes.iter().filter(|(count, _)| *count > 0).map(|(count, what)| format!("{count} {what}"));
        let silent = Some(count(|sensor| u64::from(!sensor.is_past_cut))).filter(|&silent| silent > 0);
        let silent = silent.map(|count| format!("no later telegram of {} arrived", counted(count, "sensor")));
        let causes: Vec<String> = causes.chain(silent).collect();
        let causes = if causes.is_empty() { "for an unknown reason".into() } else { causes.join(", ") };
        let (what, were) = (counted(lost, "telegram"), if lost == 1 { "was" } else { "were" });
        Some(format!("{what} {were} sent and not received: {causes}"))
    }

    /// Returns the summary, one line for each sensor.
    pub(crate) fn summary(&self, json: bool) -> Vec<String> {
        let mut lines = Vec::new();
        for sensor in &self.sensors {
            let (sent, lost) = (sensor.sent, sensor.lost());
            let summary = Summary {
                class: "summary",
                sensor: &sensor.name,
                state: &sensor.state,
                sent,
                received: sent - lost,
                lost,
                hz: sensor.hz(),
                seconds: sensor.seconds(),
                nearest_mm: sensor.nearest_mm,
                hub_cpu_percent: self.hub_cpu_percent,
                eeprom_writes: sensor.eeprom_writes,
                damaged: sensor.damaged(),
                lost_on_line: sensor.lost_on_line(),
                missed: sensor.missed,
            };
            lines.push(if json {
                crate::to_json_line(&summary)
            } else {
                format!(
                    "{:6} {}: {} sent, {} received, {lost} lost in {:.1} s, {} lost on the line, {} missed, {} Hz, \
                     nearest {}, hub {:.1} % of a processor, {} EEPROM writes",
                    summary.sensor,
                    summary.state,
                    counted(sent, "telegram"),
                    summary.received,
                    summary.seconds,
                    summary.lost_on_line.map_or("unknown".into(), |lost| lost.to_string()),
                    summary.missed,
                    summary.hz.map_or("unknown".into(), |hz| format!("{hz:.2}")),
                    sensor.nearest_mm.map_or("nothing".into(), |mm| format!("{mm} mm")),
                    summary.hub_cpu_percent,
                    summary.eeprom_writes,
                )
            });
        }
        lines.extend(self.tilted.as_ref().map(|tilted| tilted.line(json)));
        lines
    }

    /// Returns the results of three-dimensional perception as text.
    pub(crate) fn tilt_summary(&self) -> Option<String> {
        self.tilted.as_ref().map(|tilted| tilted.line(false))
    }
}

impl Sensor {
    /// Returns the number of telegrams that were sent and have not arrived yet.
    pub(crate) fn lost(&self) -> u64 {
        self.missing.values().sum()
    }

    /// Returns the number of scans that the line lost since the first telegram, as the hub counts them. `None` while
    /// the period of the scans is unknown.
    pub(crate) fn lost_on_line(&self) -> Option<u64> {
        let lost = self.line?.lost?;
        Some(lost.saturating_sub(self.line_before.lost.unwrap_or_default()))
    }

    /// Returns the share of damaged bytes since the first telegram; `None` if no byte has been read.
    fn damaged(&self) -> Option<f64> {
        let (counts, before) = (self.line?, self.line_before);
        let read = counts.read.saturating_sub(before.read);
        (read > 0).then(|| counts.damaged.saturating_sub(before.damaged) as f64 / read as f64)
    }

    fn take_sent(&mut self, hash: &str) {
        if self.is_rotating && self.sent == 0 && !self.early.contains_key(hash) {
            return self.sent_before_first.push(hash.to_owned());
        }
        self.sent += 1;
        if !remove_hash(&mut self.early, hash) {
            *self.missing.entry(hash.to_owned()).or_default() += 1;
        }
    }

    fn take_arrived(&mut self, bytes: &[u8]) {
        let hash: String = Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect();
        if let Some(first) = self.sent_before_first.iter().position(|sent| *sent == hash) {
            let sent: Vec<String> = std::mem::take(&mut self.sent_before_first).split_off(first);
            self.sent += sent.len() as u64;
            sent.into_iter().for_each(|hash| *self.missing.entry(hash).or_default() += 1);
        }
        if !remove_hash(&mut self.missing, &hash) {
            self.is_past_cut |= self.after_cut.contains(&hash);
            *self.early.entry(hash).or_default() += 1;
        }
    }

    /// Returns the telegrams per second from the first to the last, or revolutions of a rotating scanner. `None` while
    /// they span less than [`scanhub_schema::MIN_RATE_SPAN`].
    pub(crate) fn hz(&self) -> Option<f64> {
        let span = Duration::from_nanos(self.last_ns.saturating_sub(self.first_ns));
        scanhub_schema::rate_hz(self.received_count.saturating_sub(1), span)
    }

    fn seconds(&self) -> f64 {
        (self.last_ns - self.first_ns) as f64 / 1e9
    }

    fn take_telegram(&mut self, line: &Value) {
        let is_data = if self.is_rotating {
            line["kind"] == "data"
        } else {
            line["command"] == MEASURED_VALUES_COMMAND
        };
        if !is_data {
            return;
        }
        self.arrived_at = Some(Instant::now());
        let bytes = from_hex(line["data"].as_str().unwrap_or_default());
        let packets = line["packets"].as_u64().unwrap_or(1).max(1) as usize;
        bytes.chunks((bytes.len() / packets).max(1)).for_each(|packet| self.take_arrived(packet));
        if !self.is_rotating {
            self.count(line);
        }
    }

    /// Counts a telegram, or a revolution of a rotating scanner.
    fn count(&mut self, line: &Value) {
        self.received_count += 1;
        self.last_ns = line["stamp_ns"].as_u64().unwrap_or_default();
        if self.first_ns == 0 {
            self.first_ns = self.last_ns;
        }
    }

    fn take_scan(&mut self, line: &Value) {
        if self.is_rotating {
            self.count(line);
        }
        let unit = line["unit_um"].as_u64().unwrap_or(1000) / 1000;
        let ranges = line["ranges"].as_array().map(Vec::as_slice).unwrap_or_default();
        self.ranges = ranges.iter().map(|range| range.as_u64().map(|range| range * unit)).collect();
        // A single beam may be noise, so two neighboring beams must see an object. The farther of the two counts.
        let both = |pair: &[Option<u64>]| Some(pair[0]?.max(pair[1]?));
        let pairs = self.ranges.windows(2).enumerate();
        let nearest = pairs.filter_map(|(i, pair)| Some((both(pair)?, i))).min();
        self.nearest_mm = nearest.map(|(mm, _)| mm);
        let angle = |key: &str| line[key].as_f64().unwrap_or_default();
        self.nearest_deg =
            nearest.map_or(0.0, |(_, i)| angle("first_angle_deg") + i as f64 * angle("step_deg"));
        if angle("step_deg") < 0.0 {
            // A revolution starts ahead and runs clockwise. Rotate it so that the rear is at both ends and the right
            // side comes first.
            let half = self.ranges.len() / 2;
            self.ranges.rotate_left(half);
            self.ranges.reverse();
        }
    }
}

/// Results of three-dimensional perception, for the last line of the summary. The order of the keys is part of the
/// contract.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
struct TiltSummary {
    class: &'static str,
    sensor: String,
    sweeps: u64,
    /// Number of obstacles in the last sweep.
    obstacles: usize,
    /// Distance of the nearest obstacle from the center of the robot, in meters.
    nearest_m: Option<f64>,
}

impl TiltSummary {
    /// Updates the counts from a line of class `obstacles`.
    fn take(&mut self, line: &Value) {
        let obstacles = line["obstacles"].as_array().map(Vec::as_slice).unwrap_or_default();
        *self = TiltSummary {
            class: "summary",
            sensor: line["sensor"].as_str().unwrap_or_default().to_owned(),
            sweeps: self.sweeps + 1,
            obstacles: obstacles.len(),
            nearest_m: obstacles.first().and_then(|one| one["distance_m"].as_f64()),
        };
    }

    /// Returns the line, as JSON or as text.
    fn line(&self, json: bool) -> String {
        if json {
            return serde_json::to_string(self).unwrap_or_default();
        }
        let nearest = self.nearest_m.map_or(String::new(), |m| format!(", the nearest at {m:.2} m"));
        let (sweeps, obstacles) = (counted(self.sweeps, "sweep"), counted(self.obstacles as u64, "obstacle"));
        format!("{:6} {sweeps}, {obstacles} in the last{nearest}", self.sensor)
    }
}

/// Decreases the count of `hash` in `counts` by 1. Returns whether it was in `counts`.
fn remove_hash(counts: &mut HashMap<String, u64>, hash: &str) -> bool {
    let Some(count) = counts.get_mut(hash) else { return false };
    *count -= 1;
    if *count == 0 {
        counts.remove(hash);
    }
    true
}

fn from_hex(text: &str) -> Vec<u8> {
    let digits = |at| text.get(at..at + 2).and_then(|pair| u8::from_str_radix(pair, 16).ok());
    (0..text.len()).step_by(2).map_while(digits).collect()
}

/// Returns the CPU time of all threads of `pid`, in nanoseconds.
fn cpu_time_ns(pid: u32) -> u64 {
    let tasks = std::fs::read_dir(format!("/proc/{pid}/task")).into_iter().flatten().flatten();
    let spent = tasks.filter_map(|task| {
        let text = std::fs::read_to_string(task.path().join("schedstat")).ok()?;
        text.split_whitespace().next()?.parse::<u64>().ok()
    });
    spent.sum()
}

/// Command byte of a telegram with measured values.
const MEASURED_VALUES_COMMAND: u64 = 0xB0;

/// Returns `count` followed by `what`, with an `s` unless the count is 1.
pub(super) fn counted(count: u64, what: &str) -> String {
    format!("{count} {what}{}", if count == 1 { "" } else { "s" })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn single_beam_is_not_the_nearest() {
        let mut sensor = Sensor::default();
        let scan = |ranges: Value| serde_json::json!({ "unit_um": 10_000, "first_angle_deg": -90.0, "step_deg": 0.5, "ranges": ranges });
        sensor.take_scan(&scan(serde_json::json!([400, 400, 3, 400, null, 7, null, 120, 110, 300])));
        assert_eq!((sensor.nearest_mm, sensor.nearest_deg), (Some(1200), -86.5));
        sensor.take_scan(&scan(serde_json::json!([null, 3, null])));
        assert_eq!(sensor.nearest_mm, None);
    }

    #[test]
    fn packets_count_from_the_first_that_arrives() {
        let telegram = |data: &str, packets: u64| serde_json::json!({ "kind": "data", "packets": packets, "data": data });
        let hash =
            |bytes: &[u8]| Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect::<String>();
        let mut sensor = Sensor { is_rotating: true, ..Sensor::default() };
        // Two packets are sent before the first one arrives. Three follow, and the middle one is lost.
        [b"a", b"b", b"c"].iter().for_each(|sent| sensor.take_sent(&hash(*sent)));
        assert_eq!((sensor.sent, sensor.lost()), (0, 0));
        sensor.take_telegram(&telegram("6365", 2));
        assert_eq!((sensor.sent, sensor.lost()), (1, 0));
        [b"d", b"e"].iter().for_each(|sent| sensor.take_sent(&hash(*sent)));
        assert_eq!((sensor.sent, sensor.lost()), (3, 1));
        let mut sensor = Sensor { is_rotating: true, ..Sensor::default() };
        sensor.take_telegram(&telegram("62", 1));
        [b"a", b"b", b"c"].iter().for_each(|sent| sensor.take_sent(&hash(*sent)));
        assert_eq!((sensor.sent, sensor.lost()), (2, 1));
    }

    #[test]
    fn loss_has_a_cause_and_later_telegram_ends_the_wait() {
        let hash =
            |bytes: &[u8]| Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect::<String>();
        let sent = |bytes: &[u8], sent_ns: u64| {
            let port = "/x/front";
            serde_json::json!({ "port": port, "kind": "data", "fault": null, "sent_ns": sent_ns, "sha256": hash(bytes) })
        };
        let sensor = Sensor { name: "front".into(), ..Sensor::default() };
        let mut account = DeliveryStats::new(&[]);
        account.sensors.push(sensor);
        let telegram = |data: &str| serde_json::json!({ "class": "telegram", "command": 0xB0, "data": data });
        account.handle_line(0, &telegram("61"));
        account.cut();
        for line in [sent(b"a", 1), sent(b"b", 2), sent(b"c", u64::MAX)] {
            account.take_simulator_line(&line.to_string());
        }
        assert!(!account.is_complete(Duration::MAX) && account.is_complete(Duration::ZERO));
        let silent = "1 telegram was sent and not received: no later telegram of 1 sensor arrived";
        assert_eq!(account.loss().as_deref(), Some(silent));
        let notice =
            serde_json::json!({ "class": "notice", "kind": "missed", "topic": "telegram", "missed": 1 });
        account.handle_line(0, &notice);
        account.handle_line(0, &telegram("63"));
        assert!(account.is_complete(Duration::MAX));
        let missed = "1 published by the hub, but missed by this program's subscribers";
        assert!(account.loss().is_some_and(|loss| loss.ends_with(missed)));
        account.handle_line(0, &telegram("62"));
        assert_eq!(account.loss(), None);
    }

    #[test]
    fn revolution_is_shown_from_right_to_left() {
        let mut sensor = Sensor { is_rotating: true, ..Sensor::default() };
        // The beams point ahead, right, to the rear, and left.
        let turn = serde_json::json!({ "unit_um": 1000, "first_angle_deg": 0.0, "step_deg": -90.0, "ranges": [1, 2, 3, 4] });
        sensor.take_scan(&turn);
        assert_eq!(sensor.ranges, [2, 1, 4, 3].map(Some));
    }

    #[test]
    fn line_losses_count_from_the_first_telegram() {
        let mut account = DeliveryStats::new(&[]);
        account.sensors.push(Sensor { name: "front".into(), ..Sensor::default() });
        let status = |read: u64, damaged: u64, lost: Option<u64>| {
            let counters = serde_json::json!({ "bytes_read": read, "bytes_damaged": damaged });
            serde_json::json!({ "class": "status", "counters": counters, "lost_on_line": lost })
        };
        let mut counters_after = |line: &Value| {
            account.handle_line(0, line);
            (account.sensors[0].lost_on_line(), account.sensors[0].damaged())
        };
        assert_eq!(counters_after(&status(1_000, 500, Some(7))), (Some(0), None));
        counters_after(&serde_json::json!({ "class": "telegram", "command": 0xB0, "data": "61" }));
        assert_eq!(counters_after(&status(2_000, 750, Some(9))), (Some(2), Some(0.25)));
        assert_eq!(counters_after(&status(3_000, 750, None)), (None, Some(0.125)));
    }
}
