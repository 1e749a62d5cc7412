//! Limits how often late scans are reported. Time is an argument.

use std::time::{Duration, Instant};

/// Shortest time between two reports. The first one is due at once.
const EVERY: Duration = Duration::from_secs(5);

/// Late scans that were reported so far.
pub(super) struct LateReports {
    /// Per sensor, in the order of the site.
    reported: Vec<u64>,
    /// Earliest time of the next report.
    next: Option<Instant>,
}

impl LateReports {
    pub(super) fn new(sensors: usize) -> LateReports {
        LateReports { reported: vec![0; sensors], next: None }
    }

    /// Returns the sensors that have late scans, with their number since the last report, if a report is due. `late` has the
    /// late scans of each sensor since the start.
    pub(super) fn due(&mut self, now: Instant, late: &[u64]) -> Vec<(usize, u64)> {
        if late == self.reported || self.next.is_some_and(|next| now < next) {
            return Vec::new();
        }
        self.next = Some(now + EVERY);
        self.unreported(late)
    }

    /// Returns what the last report does not contain, even if no report is due: for the end of a run.
    pub(super) fn unreported(&mut self, late: &[u64]) -> Vec<(usize, u64)> {
        let since = late.iter().zip(&self.reported).map(|(late, reported)| late - reported).enumerate();
        let since = since.filter(|&(_, count)| count > 0).collect();
        self.reported.copy_from_slice(late);
        since
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn first_late_scan_is_reported_at_once_and_others_every_five_seconds() {
        let begin = Instant::now();
        let mut reports = LateReports::new(3);
        let mut due = |after_s: u64, late: [u64; 3]| reports.due(begin + Duration::from_secs(after_s), &late);
        assert_eq!(due(0, [0, 0, 0]), []);
        assert_eq!(due(1, [0, 1, 0]), [(1, 1)]);
        assert_eq!(due(5, [0, 40, 2]), []);
        assert_eq!(due(6, [0, 41, 2]), [(1, 40), (2, 2)]);
        assert_eq!(due(60, [0, 41, 2]), []);
        assert_eq!(due(61, [0, 42, 2]), [(1, 1)]);
        assert_eq!(due(62, [7, 42, 2]), []);
        assert_eq!(reports.unreported(&[7, 42, 3]), [(0, 7), (2, 1)]);
        assert_eq!(reports.unreported(&[7, 42, 3]), []);
    }
}
