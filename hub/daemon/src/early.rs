//! Early warnings from an incomplete scan, while its rest is still on the line or not measured yet. A telegram of 361
//! values takes 14.6 ms at 500 kBd and a revolution 100 ms, and a near object is often seen long before the end. A
//! warning is slow or stop, never clear. A warning is withdrawn if its scan is not published, or if a later part of the
//! scan refutes it.

use scanhub_drivers::line::RawScan;
use scanhub_preprocess::zones::{Warning, ZoneChecker};
use scanhub_schema::{ArrayFlags, Early, Scan, Verdict};

/// Source of warnings of objects in the scan that is arriving.
pub(crate) struct EarlyWarner {
    /// The measured part of the scan.
    scan: Box<Scan>,
    /// The warning that was published for this scan, and that its zones have not confirmed yet.
    warning: Option<PublishedWarning>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct PublishedWarning {
    /// Number of the scan in its session.
    scan: u64,
    message: EarlyMessage,
}

/// A warning or its withdrawal, with its sequence number. The sequence number is not greater than that of the zones of
/// the same scan.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct EarlyMessage {
    pub(crate) seq: u64,
    pub(crate) early: Early,
}

impl EarlyWarner {
    /// Creates a warner for scans of at most `beams` beams.
    pub(crate) fn new(beams: usize) -> EarlyWarner {
        EarlyWarner { scan: Scan::zeroed(Scan::len(beams, ArrayFlags::REVOLUTION)), warning: None }
    }

    /// Checks an incomplete scan. Returns the withdrawal of an earlier warning that no longer holds, and a new warning
    /// if it is worse than the earlier one. `next_seq` is the sequence number of the next telegram.
    pub(crate) fn update(
        &mut self,
        partial: &RawScan<'_>,
        check: &mut ZoneChecker,
        next_seq: u64,
    ) -> [Option<EarlyMessage>; 2] {
        let early = self.warning(partial, check);
        let verdict = early.map_or(Verdict::Clear as u8, |early| early.verdict);
        // A further warning keeps the sequence number of the first one, because `next_seq` may already be greater than
        // the sequence number of the scan's zones.
        let seq = self.warning.map_or(next_seq, |warning| warning.message.seq);
        let withdrawn = if self.verdict() > verdict { self.withdraw(None) } else { None };
        let worse = early.filter(|_| verdict > self.verdict()).map(|early| {
            let message = EarlyMessage { seq, early };
            self.warning = Some(PublishedWarning { scan: partial.number, message });
            message
        });
        [withdrawn, worse]
    }

    /// Returns the warning that an incomplete scan gives rise to.
    fn warning(&mut self, partial: &RawScan<'_>, check: &mut ZoneChecker) -> Option<Early> {
        let scan = &mut self.scan;
        partial.write(scan);
        let warning = check.check_partial(scan.beams(), scan.unit_um, scan.ranges(), scan.exact_angles())?;
        let beams_seen = scan.ranges().iter().filter(|range| **range != Scan::NOT_MEASURED).count();
        let Warning { verdict, beam, distance_mm } = warning;
        let (bytes_seen, beams_seen) = (partial.bytes as u16, beams_seen as u16);
        Some(Early { verdict: verdict as u8, flags: 0, beam, distance_mm, bytes_seen, beams_seen })
    }

    /// Returns whether a published warning is not confirmed yet.
    pub(crate) fn has_warned(&self) -> bool {
        self.warning.is_some()
    }

    /// Confirms the warning of scan `number`, whose zones were published.
    pub(crate) fn confirm(&mut self, number: u64) {
        self.warning = self.warning.filter(|warning| warning.scan != number);
    }

    /// Returns the withdrawal of an unconfirmed warning of any scan except `number`, the scan that is arriving.
    pub(crate) fn withdraw(&mut self, number: Option<u64>) -> Option<EarlyMessage> {
        let warning = self.warning.take_if(|warning| Some(warning.scan) != number)?;
        let EarlyMessage { seq, early } = warning.message;
        Some(EarlyMessage { seq, early: Early { flags: Early::WITHDRAWN, ..early } })
    }

    fn verdict(&self) -> u8 {
        self.warning.map_or(Verdict::Clear as u8, |warning| warning.message.early.verdict)
    }
}

// A worse verdict has a greater number.
const _: () = assert!((Verdict::Clear as u8) < Verdict::Slow as u8);
const _: () = assert!((Verdict::Slow as u8) < Verdict::Stop as u8);

#[cfg(test)]
mod tests {
    use fastrand::Rng;
    use scanhub_drivers::line::{NO_RETURN, Point};
    use scanhub_drivers::line::{Values, revolution_head};
    use scanhub_preprocess::zones::{Sector, Settings};
    use scanhub_schema::{Family, Pose, Zones};

    use super::*;

    const BEAMS: usize = 90;

    /// Returns the points of a revolution with near objects, in an order in which each point is at most `late`
    /// positions late.
    fn points(random: &mut Rng, late: usize) -> Vec<Point> {
        let count = random.usize(40..200);
        let near: Vec<(f32, f32, u16)> = (0..random.usize(..4))
            .map(|_| (6.2 * random.f32(), 0.3 * random.f32(), random.u16(..1300)))
            .collect();
        let mut points: Vec<(usize, Point)> = (0..count)
            .map(|i| {
                let clockwise = i as f32 / count as f32 * std::f32::consts::TAU - 0.03;
                let is_at = |object: &&(f32, f32, u16)| (clockwise - object.0).abs() < object.1;
                let found = near.iter().find(is_at).map_or(5000, |object| object.2 + random.u16(..30));
                let range = if random.u8(..20) == 0 { NO_RETURN } else { found };
                (i + random.usize(..=late), Point { angle: -clockwise, range, intensity: 9 })
            })
            .collect();
        points.sort_by_key(|(index, _)| *index);
        points.into_iter().map(|(_, point)| point).collect()
    }

    fn revolution(number: u64, points: &[Point]) -> RawScan<'_> {
        // Each revolution has a different period.
        let (period, per_second) = (100_000_000 + 1_000 * number, 900.0);
        RawScan {
            number,
            first: 0,
            last: 0,
            period,
            reasons: 0,
            bytes: 0,
            head: revolution_head(Family::Ld, BEAMS, period, per_second, false),
            values: Values::Points { points, per_second },
        }
    }

    /// Returns the zones of a complete revolution.
    fn zones(check: &mut ZoneChecker, revolution: &RawScan<'_>) -> Zones {
        let mut scan = Scan::zeroed(revolution.payload_len());
        revolution.write(&mut scan);
        let mut zones = Zones::unknown();
        check.update(&scan, &mut zones);
        zones
    }

    /// Model of a subscriber, which checks every message.
    #[derive(Default)]
    struct Subscriber {
        /// The warning in force.
        warning: Option<EarlyMessage>,
        warned: usize,
        withdrawn: usize,
    }

    impl Subscriber {
        fn receive(&mut self, message: EarlyMessage) {
            if message.early.is_withdrawn() {
                let before = self.warning.take().expect("nothing to withdraw");
                assert_eq!((before.seq, before.early.verdict), (message.seq, message.early.verdict));
                self.withdrawn += 1;
                return;
            }
            assert!(matches!(message.early.verdict(), Verdict::Slow | Verdict::Stop));
            if let Some(before) = self.warning.replace(message) {
                assert!(
                    before.seq == message.seq && before.early.verdict < message.early.verdict,
                    "{message:?}"
                );
            }
            self.warned += 1;
        }
    }

    #[test]
    fn unwithdrawn_warning_is_confirmed_by_its_scan() {
        let mut random = Rng::with_seed(28);
        let (mut subscriber, mut confirmed, mut packets) = (Subscriber::default(), 0, 0);
        for _ in 0..400 {
            let own: Vec<Sector> = (0..random.usize(..3))
                .map(|_| {
                    let from_mdeg = random.i32(-180_000..180_000);
                    Sector {
                        from_mdeg,
                        to_mdeg: from_mdeg + random.i32(..90_000),
                        range_mm: random.u16(..900),
                    }
                })
                .collect();
            let settings = Settings {
                body_mask: own.clone(),
                margin_mm: random.u16(..50),
                min_beams: random.u16(1..4),
                min_scans: random.u16(1..4),
                exact: random.bool(),
                ..Settings::default()
            };
            let (x_m, y_m) = (2.0 * random.f64() - 1.0, 2.0 * random.f64() - 1.0);
            let upside_down = random.bool().into();
            let pose = Pose { x_m, y_m, yaw_rad: 6.0 * random.f64(), upside_down, ..Pose::default() };
            let mut check = ZoneChecker::new(pose, &settings, BEAMS);
            let mut warner = EarlyWarner::new(BEAMS);
            let late = if random.bool() { 0 } else { 20 };
            let other = points(&mut random, late);
            for number in 1..9 {
                // Most revolutions see the same objects as the one before.
                let points = if random.u8(..3) == 0 { points(&mut random, late) } else { other.clone() };
                let is_over = random.u8(..4) > 0;
                let end = if is_over { points.len() - 1 } else { random.usize(..points.len()) };
                let mut received = 0;
                while received < end {
                    (received, packets) = ((received + random.usize(1..24)).min(end), packets + 1);
                    warner.withdraw(Some(number)).into_iter().for_each(|message| subscriber.receive(message));
                    let partial = revolution(number, &points[..received]);
                    let messages = warner.update(&partial, &mut check, packets);
                    messages.into_iter().flatten().for_each(|message| subscriber.receive(message));
                }
                if is_over {
                    // The packet that ends the revolution also contains its last points.
                    packets += 1;
                    if warner.has_warned() {
                        let partial = revolution(number, &points);
                        let messages = warner.update(&partial, &mut check, packets);
                        messages.into_iter().flatten().for_each(|message| subscriber.receive(message));
                    }
                    let zones = zones(&mut check, &revolution(number, &points));
                    warner.confirm(number);
                    let warning = subscriber.warning.take();
                    assert!(
                        warning.as_ref().is_none_or(|warning| warning.seq < packets),
                        "{warning:?} of {packets}"
                    );
                    let holds = |warning: &EarlyMessage| {
                        zones.verdict().worse(warning.early.verdict()) == zones.verdict()
                    };
                    assert!(warning.as_ref().is_none_or(holds), "{warning:?} and {:?}", zones.verdict());
                    confirmed += usize::from(warning.is_some());
                } else {
                    warner.withdraw(None).into_iter().for_each(|message| subscriber.receive(message));
                    assert_eq!(subscriber.warning, None);
                }
            }
        }
        let Subscriber { warned, withdrawn, .. } = subscriber;
        assert!(confirmed > 300 && withdrawn > 100, "{confirmed} confirmed, {withdrawn} withdrawn");
        assert!(warned >= confirmed + withdrawn);
    }

    #[test]
    fn warning_of_the_robots_own_body_is_withdrawn() {
        let at = |degrees: f32, range| Point { angle: -degrees.to_radians(), range, intensity: 9 };
        let own = [Sector { from_mdeg: -95_000, to_mdeg: -85_000, range_mm: 300 }];
        let settings = Settings { body_mask: own.to_vec(), ..Settings::default() };
        let mut check = ZoneChecker::new(Pose::default(), &settings, BEAMS);
        let mut warner = EarlyWarner::new(BEAMS);
        zones(&mut check, &revolution(1, &[at(10.0, 5000)]));
        // Beam 22 points 88 degrees to the right. The nearest point in a beam counts, and in beam 22 this point is on
        // the robot.
        let mut turned: Vec<Point> = (0..BEAMS).map(|beam| at(4.0 * beam as f32, 5000)).collect();
        turned.splice(22..23, [at(87.5, 500), at(88.5, 200)]);
        turned[60].range = 800;
        let mut update = |received: usize| warner.update(&revolution(2, &turned[..received]), &mut check, 7);
        assert_eq!(update(22), [None, None]);
        let [None, Some(stop)] = update(23) else { panic!("no warning") };
        let Early { verdict, beam, distance_mm, bytes_seen, beams_seen, flags } = stop.early;
        assert_eq!((stop.seq, verdict, flags), (7, Verdict::Stop as u8, 0));
        assert_eq!((beam, distance_mm, bytes_seen, beams_seen), (22, 500, 0, 23));
        assert_eq!(update(23), [None, None], "each warning is published once");
        let withdrawn = EarlyMessage { early: Early { flags: Early::WITHDRAWN, ..stop.early }, ..stop };
        assert_eq!(update(24), [Some(withdrawn), None]);
        let [None, Some(slow)] = update(BEAMS) else { panic!("no warning") };
        assert_eq!(slow.early.verdict(), Verdict::Slow);
        assert_eq!(zones(&mut check, &revolution(2, &turned)).verdict(), Verdict::Slow);
    }
}
