//! Whole sweeps of a tilted scanner, gathered from the samples of their scans. Refuses to know where samples come from.

use crate::{Cloud, CloudPoint, Header};

/// The points of a sweep, as far as they came.
///
/// # Examples
///
/// ```
/// use schema::{Cloud, CloudHead, CloudPoint, Header, SweepPoints};
///
/// let mut sweep = SweepPoints::default();
/// for (topic_seq, flags) in [(7, Cloud::FIRST), (8, 0), (9, Cloud::LAST)] {
///     let head = CloudHead { flags, ..CloudHead::default() };
///     let sample = Cloud::of(head, &[CloudPoint::default(); 2]);
///     let header = Header { topic_seq, ..Header::default() };
///     let points = sweep.take(&header, &sample);
///     assert_eq!(points.map(<[CloudPoint]>::len), (topic_seq == 9).then_some(6));
/// }
/// ```
#[derive(Clone, Debug, Default)]
pub struct SweepPoints {
    points: Vec<CloudPoint>,
    /// Who sends it, and the number of its next sample; nothing where its first one is waited for.
    next: Option<(u64, u64)>,
}

/// No sweep that is gathered has more points.
const MOST: usize = 1 << 18;

impl SweepPoints {
    /// Takes a sample of topic `cloud`; returns the points of its sweep with the last one. A sweep of which a sample was missed,
    /// or that has more than 262,144 points, is left out.
    pub fn take(&mut self, header: &Header, cloud: &Cloud) -> Option<&[CloudPoint]> {
        let this = (header.boot, header.topic_seq);
        if cloud.has(Cloud::FIRST) {
            self.points.clear();
        } else if self.next != Some(this) {
            self.next = None;
            return None;
        }
        let has_room = self.points.len() + cloud.points().len() <= MOST;
        let goes_on = has_room && !cloud.has(Cloud::LAST);
        self.next = goes_on.then_some((header.boot, header.topic_seq.wrapping_add(1)));
        if !has_room {
            return None;
        }
        self.points.extend_from_slice(cloud.points());
        cloud.has(Cloud::LAST).then_some(&self.points)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::CloudHead;

    /// How many points come of these samples: number, flags, points of each.
    fn gathered(sweep: &mut SweepPoints, samples: &[(u64, u8, usize)]) -> Vec<usize> {
        let mut whole = Vec::new();
        for &(topic_seq, flags, count) in samples {
            let head = CloudHead { flags, ..CloudHead::default() };
            let cloud = Cloud::of(head, &vec![CloudPoint::default(); count]);
            let header = Header { topic_seq, boot: topic_seq / 100, ..Header::default() };
            whole.extend(sweep.take(&header, &cloud).map(<[CloudPoint]>::len));
        }
        whole
    }

    #[test]
    fn sweeps_are_whole_or_left_out() {
        let (first, last) = (Cloud::FIRST, Cloud::LAST);
        let mut sweep = SweepPoints::default();
        // Who comes in the middle waits for a beginning.
        assert_eq!(gathered(&mut sweep, &[(3, 0, 5), (4, last, 5)]), [0; 0]);
        assert_eq!(gathered(&mut sweep, &[(5, first, 5), (6, 0, 2), (7, last, 1)]), [8]);
        assert_eq!(gathered(&mut sweep, &[(8, first | last, 4), (9, last, 3)]), [4], "9 has no beginning");
        assert_eq!(gathered(&mut sweep, &[(10, first, 5), (12, last, 5)]), [0; 0], "11 was missed");
        assert_eq!(gathered(&mut sweep, &[(20, first, 5), (21, first, 2), (22, last, 1)]), [3]);
        assert_eq!(gathered(&mut sweep, &[(99, first, 5), (100, last, 5)]), [0; 0], "another one sends it");
    }

    #[test]
    fn no_sweep_is_too_long() {
        let mut samples: Vec<_> = (0..33).map(|number| (number, 0, 8192)).collect();
        samples[0].1 = Cloud::FIRST;
        samples.push((33, Cloud::LAST, 1));
        let mut sweep = SweepPoints::default();
        assert_eq!(gathered(&mut sweep, &samples), [0; 0]);
        samples.truncate(32);
        samples[31].1 = Cloud::LAST;
        assert_eq!(gathered(&mut sweep, &samples), [262_144]);
    }
}
