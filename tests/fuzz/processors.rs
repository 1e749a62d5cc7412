//! Any scans and any settings, through all processors: whatever the bytes say, what comes out keeps to its own rules.

use preprocess::background::{Candidate, Method, Model, Settings, Start};
use preprocess::segments::Segmenter;
use preprocess::{marks, zones};
use schema::limits::TopicLimits;
use schema::{
    BEAMS, Background, Contents, Family, Foreground, Marks, Pose, Scan, ScanArrays, ScanHead, Verdict, ZONES,
    Zones,
};

/// Read as settings, then as one scan after the other until nothing is left.
pub(super) fn processors(data: &[u8]) {
    let mut bytes = Bytes(data);
    // Now and then a scan has more beams than that.
    let most = TopicLimits::default().beams;
    let pose = Pose {
        x_m: bytes.number(),
        y_m: bytes.number(),
        yaw_rad: bytes.number(),
        upside_down: bytes.u8(),
        ..Pose::default()
    };
    let radii_mm: Vec<u16> = (0..bytes.u8() % 10).map(|_| bytes.u16()).collect();
    let self_min: Vec<zones::Sector> = (0..bytes.u8() % 80)
        .map(|_| zones::Sector { from_mdeg: bytes.i32(), to_mdeg: bytes.i32(), range_mm: bytes.u16() })
        .collect();
    let flags = bytes.u8();
    let is = |bit: u8| flags >> bit & 1 == 1;
    let mut check = zones::Check::new(
        pose,
        &zones::Settings {
            radii_mm: &radii_mm,
            self_min: &self_min,
            margin_mm: bytes.u16(),
            min_beams: bytes.u16(),
            min_scans: u16::from(bytes.u8()),
            max_invalid: bytes.number(),
            exact: is(0),
            no_return_is_far: is(1),
        },
        most,
    );
    let max_gap = u16::from(bytes.u8());
    let mut finder = marks::MarkDetector::new(marks::Settings {
        i_min: bytes.u8(),
        level: is(2).then(|| bytes.u16()),
        max_range_step_mm: bytes.u16(),
        max_gap,
    });
    let settings = Settings {
        method: if is(2) { Method::Paper } else { Method::Multi },
        threshold_mm: is(3).then(|| bytes.u16()),
        candidate_mm: is(4).then(|| bytes.u16()),
        scans: is(5).then(|| u32::from(bytes.u8())),
        candidate: if is(6) { Candidate::First } else { Candidate::Latest },
        start: if is(7) { Start::FirstScan } else { Start::Empty },
        no_return_is_far: Some(is(1)),
    };
    let mut model = Model::new(settings, most);
    let mut cutter = Segmenter::new(pose, most);
    let (mut zones, mut marks) = (Zones::unknown(), Marks::default());
    let mut foreground = Foreground::of(most);
    let mut background = Background::zeroed(Background::len(most));
    let mut scan = Scan::zeroed(Scan::len(BEAMS, Contents::ALL));
    while !bytes.0.is_empty() {
        match bytes.u8() {
            0..=3 => model.reset(),
            4..=7 => model.freeze(),
            8..=11 => model.thaw(),
            12..=15 => {
                model.show(&mut background);
                assert_eq!(model.load(&background), Ok(()), "what it has shown");
            }
            16..=19 => {
                check.stale(&mut zones);
                assert_eq!(zones.verdict(), Verdict::Unknown);
            }
            20..=127 => layout(&mut bytes, &mut scan),
            _ => {}
        }
        fill(&mut bytes, &mut scan);
        check.update(&scan, &mut zones);
        assert_zones(&scan, &radii_mm, &zones);
        finder.update(&scan, &mut marks);
        assert_marks(&scan, &marks, max_gap);
        model.update(&scan, &mut foreground);
        cutter.update(&scan, &mut foreground);
        assert_foreground(&scan, &foreground, most);
        assert_eq!(model.classes().len(), scan.beams().min(most));
    }
}

fn assert_zones(scan: &Scan, radii_mm: &[u16], zones: &Zones) {
    let used = zones.zones();
    assert_eq!(used.len(), radii_mm.len().min(ZONES));
    assert!(used.iter().zip(radii_mm).all(|(zone, radius)| zone.radius_mm == *radius));
    assert!(used.iter().all(|zone| usize::from(zone.beams) <= scan.beams()));
    if radii_mm.is_sorted_by(|larger, smaller| larger >= smaller) {
        assert!(used.is_sorted_by(|outer, inner| outer.beams >= inner.beams), "{used:?}");
    }
    assert_eq!(zones.verdict() == Verdict::Stop, used.last().is_some_and(|zone| zone.violated == 1));
    assert!(zones.verdict() != Verdict::Clear || used.iter().all(|zone| zone.violated == 0));
    assert!(zones.nearest().is_none_or(|(beam, _)| scan.range(usize::from(beam)).is_some()));
    assert!(usize::from(zones.invalid_beams) <= scan.beams());
}

fn assert_marks(scan: &Scan, marks: &Marks, max_gap: u16) {
    let used = marks.marks();
    assert!(used.iter().all(|mark| mark.first_beam <= mark.last_beam && mark.weight > 0 && mark.peak > 0));
    assert!(used.is_sorted_by(|one, next| one.last_beam < next.first_beam));
    assert!(used.last().is_none_or(|mark| usize::from(mark.last_beam) < scan.beams()));
    assert!(marks.is_available() || used.is_empty());
    let lit = scan.intensities().iter().filter(|intensity| *intensity > 0).count();
    let covered: usize = used.iter().map(|mark| usize::from(mark.last_beam - mark.first_beam) + 1).sum();
    assert!(covered <= lit * (usize::from(max_gap) + 1));
}

fn assert_foreground(scan: &Scan, foreground: &Foreground, most: usize) {
    assert_eq!(usize::from(foreground.count), scan.beams().min(most));
    let mut beams = 0;
    for (beam, range) in foreground.readings() {
        assert_eq!(scan.range(beam), Some(range), "beam {beam}");
        beams += 1;
    }
    assert_eq!(usize::from(foreground.beams), beams);
    let ends = foreground.segments().iter().map(|segment| (segment.first, segment.last));
    assert!(ends.clone().all(|(first, last)| (first..=last).all(|i| foreground.contains(usize::from(i)))));
    assert!(ends.is_sorted_by(|one, next| one.1 < next.0));
}

/// Another sensor, or the same one set otherwise; now and then one that there is.
fn layout(bytes: &mut Bytes<'_>, scan: &mut Scan) {
    let variant =
        [(361, -90_000, 500), (181, -90_000, 1000), (401, -50_000, 250)].get(usize::from(bytes.u8()));
    let (count, first_angle_mdeg, step_mdeg) =
        variant.copied().unwrap_or_else(|| (bytes.u16(), bytes.i32(), bytes.u16() as i16));
    let in_radians = |mdeg: i32| (f64::from(mdeg) / 1000.0).to_radians();
    let (unit_mm, range_bits) = (bytes.u8(), bytes.u8());
    let greatest = ((1_u32 << (range_bits % 17)) - 1) as u16;
    let head = ScanHead {
        first_angle: in_radians(first_angle_mdeg),
        step: in_radians(step_mdeg.into()),
        unit_um: 1000 * u32::from(unit_mm),
        count: count.min(BEAMS as u16),
        valid_to: greatest.saturating_sub(9),
        no_return: greatest,
        beyond: greatest.saturating_sub(8),
        family: if range_bits & 0x80 == 0 { Family::Lms } else { Family::Ld } as u8,
        intensity_bits: bytes.u8(),
        contents: bytes.u8() & Contents::ALL,
        ..ScanHead::default()
    };
    scan.begin(head);
}

/// Stretches of beams with the same reading, until they are enough or nothing is left.
fn fill(bytes: &mut Bytes<'_>, scan: &mut Scan) {
    let ScanArrays { angles, ranges, wide, upper } = scan.arrays();
    let mut end = 0;
    while end < ranges.len() && !bytes.0.is_empty() {
        let start = end;
        end = (start + 1 + usize::from(bytes.u8())).min(ranges.len());
        ranges[start..end].fill(bytes.u16());
        upper.get_mut(start..end).unwrap_or_default().fill(bytes.u8());
        if let Some(wide) = wide.get_mut(start..end) {
            wide.fill(bytes.u16());
        }
        if let Some(angles) = angles.get_mut(start..end) {
            angles.fill(bytes.number() as f32);
        }
    }
}

/// What is left of the input; zeroes when nothing is.
struct Bytes<'a>(&'a [u8]);

impl Bytes<'_> {
    fn take<const N: usize>(&mut self) -> [u8; N] {
        std::array::from_fn(|_| self.0.split_off_first().copied().unwrap_or(0))
    }

    fn u8(&mut self) -> u8 {
        let [byte] = self.take();
        byte
    }

    fn u16(&mut self) -> u16 {
        u16::from_le_bytes(self.take())
    }

    fn i32(&mut self) -> i32 {
        i32::from_le_bytes(self.take())
    }

    /// Any number, infinite ones and those that are none too; mostly of a size that a sensor's place has.
    fn number(&mut self) -> f64 {
        match self.u8() {
            0 => f64::from_bits(u64::from_le_bytes(self.take())),
            _ => f64::from(i16::from_le_bytes(self.take())) / 1000.0,
        }
    }
}
