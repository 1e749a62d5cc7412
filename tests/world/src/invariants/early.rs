//! Invariant on early warnings, which are verdicts from partial scans. An early warning is slow or stop, never clear.
//! The next zones with the same or a greater `seq` confirm the warning if their verdict is at least as bad. Otherwise,
//! the hub withdraws the warning before these zones. While nothing is wrong, two more rules hold. No warning is
//! withdrawn. The verdict of zones becomes stop only after a warning, and the hub sent that warning when at most three
//! quarters of the scan had arrived.

use std::collections::BTreeMap;

use bytemuck::pod_read_unaligned;
use scanhub_schema::{MILLIS, Nanos, Scan, Topic, Verdict, Zones};

use super::{Invariant, ViolationReporter};
use crate::event::Event;

/// State of the early warnings of each sensor.
#[derive(Default)]
pub(crate) struct EarlyWarnings {
    sensors: BTreeMap<usize, SensorWarnings>,
    faults_cleared_at: Option<Nanos>,
}

/// An early warning.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Warning {
    seq: u64,
    verdict: Verdict,
    /// Whether the scan must have exactly the `seq` of the warning. Otherwise the scan's `seq` may be greater.
    is_of_telegram: bool,
    /// Number of beams that had arrived when the warning was sent.
    beams_seen: u16,
}

#[derive(Default)]
struct SensorWarnings {
    /// The warning that is not yet confirmed or withdrawn.
    current: Option<Warning>,
    /// The `seq` of the last zones.
    zones: Option<u64>,
    /// Whether the current warning is unknown because there was no memory for a sample.
    is_unknown: bool,
    /// Whether a warning was withdrawn although nothing was wrong.
    is_needless: bool,
    /// Number of scans since the hub found the scanner, and number of beams in the last scan.
    scans: usize,
    beams: usize,
}

impl Invariant for EarlyWarnings {
    fn name(&self) -> &'static str {
        "early"
    }

    fn on_event(&mut self, at: Nanos, event: &Event<'_>, reporter: &mut ViolationReporter<'_>) {
        match *event {
            Event::Published { sensor, sample } => {
                let of = self.sensors.entry(sensor).or_default();
                let seq = sample.header.seq;
                let is_well = self.faults_cleared_at.is_some_and(|healed_at| at > healed_at + RECOVERY_TIME);
                let wrong = match sample.topic {
                    Topic::Scan => {
                        let before = std::mem::replace(&mut of.beams, Scan::of_bytes(&sample.bytes).beams());
                        // When the number of beams changes, the session estimates the scan period again.
                        of.scans = if before == of.beams { of.scans + 1 } else { 0 };
                        None
                    }
                    Topic::Early => of.check_warning(seq, &pod_read_unaligned(&sample.bytes), is_well),
                    Topic::Zones => of.check_zones(seq, &pod_read_unaligned(&sample.bytes), is_well),
                    _ => None,
                };
                if let Some(wrong) = wrong {
                    reporter.report(format!("sensor {sensor}, seq {seq}: {wrong}"));
                }
            }
            Event::OutOfMemory { sensor, topic: Topic::Early | Topic::Zones } => {
                let of = self.sensors.entry(sensor).or_default();
                (of.current, of.is_unknown) = (None, true);
            }
            Event::PortOpened { sensor, .. }
            | Event::RateChanged { sensor }
            | Event::ScannerExchanged { sensor } => {
                self.sensors.entry(sensor).or_default().scans = 0;
            }
            Event::HubEnded { .. } => self.sensors.clear(),
            Event::FaultsCleared => self.faults_cleared_at = Some(at),
            _ => {}
        }
    }
}

impl SensorWarnings {
    /// Returns a description of the error in a warning or in the withdrawal of a warning, or `None` if there is no
    /// error.
    fn check_warning(
        &mut self,
        seq: u64,
        early: &scanhub_schema::Early,
        is_faultless: bool,
    ) -> Option<String> {
        let verdict = early.verdict();
        if !matches!(verdict, Verdict::Slow | Verdict::Stop) {
            return Some(format!("the verdict of a warning is {}", verdict.name()));
        }
        if self.zones.is_some_and(|zones| seq <= zones) {
            return Some("a warning for a scan whose zones had been sent".to_owned());
        }
        let beams_seen = early.beams_seen;
        let warning = Warning { seq, verdict, is_of_telegram: early.bytes_seen > 0, beams_seen };
        let before = self.current.take();
        if early.is_withdrawn() {
            self.is_needless = is_faultless && self.scans > LEARNING_SCANS;
            let is_of = before.is_some_and(|before| (before.seq, before.verdict) == (seq, verdict));
            let is_of = is_of || std::mem::take(&mut self.is_unknown);
            return (!is_of).then(|| format!("another warning than {before:?} was withdrawn"));
        }
        self.current = Some(warning);
        self.is_unknown = false;
        let is_worse =
            |before: &Warning| before.seq == seq && before.verdict.worse(verdict) != before.verdict;
        before
            .filter(|before| !is_worse(before))
            .map(|before| format!("{warning:?} follows {before:?}, and is not worse"))
    }

    /// Returns a description of the error if the current warning contradicts `zones`, or if a required warning is
    /// missing. If `is_faultless`, nothing is wrong in the world.
    fn check_zones(&mut self, seq: u64, zones: &Zones, is_faultless: bool) -> Option<String> {
        self.zones = Some(seq);
        // A hub that ends withdraws its warning, and sends no zones after the withdrawal. The hub publishes a scan
        // before the zones of the scan. If the number of beams changes, the scan that the warning belongs to is never
        // completed.
        if std::mem::take(&mut self.is_needless) && self.scans > 0 {
            return Some("a warning was withdrawn although nothing went wrong".to_owned());
        }
        let verdict = zones.verdict();
        let warning = self.current.take_if(|warning| seq >= warning.seq);
        let is_soon = zones.nearest().is_some_and(|(beam, _)| 5 * usize::from(beam) < 3 * self.beams);
        if is_faultless && self.scans > LEARNING_SCANS && verdict == Verdict::Stop && is_soon {
            let is_in_time = |warning: &Warning| 4 * usize::from(warning.beams_seen) <= 3 * self.beams;
            if !warning.as_ref().is_some_and(is_in_time) {
                return Some(format!("{warning:?} before a scan of {} beams, {zones:?}", self.beams));
            }
        }
        let warning = warning?;
        let holds =
            verdict.worse(warning.verdict) == verdict && (seq == warning.seq || !warning.is_of_telegram);
        (!holds).then(|| format!("{warning:?}, the zones are {}", verdict.name()))
    }
}

/// Time after the last fault, after which no fault has an effect any more.
const RECOVERY_TIME: Nanos = 3_000 * MILLIS;
/// Number of consecutive scans after which the session has estimated the scan period.
const LEARNING_SCANS: usize = 20;
