//! Invariants for the results of all processors, for any scans and any settings.

use scanhub_preprocess::background::{BackgroundModel, Candidate, Method, Settings, Start};
use scanhub_preprocess::segments::Segmenter;
use scanhub_preprocess::{marks, zones};
use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{ArrayFlags, Background, Foreground, MAX_BEAMS, MAX_ZONES, Marks, Scan, Verdict, Zones};

use super::scans::{Bytes, fill, layout};

/// Reads settings from `data`, and then processes one scan after another until no bytes are left.
pub(super) fn processors(data: &[u8]) {
    let mut bytes = Bytes(data);
    // Some scans in the input have more beams than this limit.
    let maximum = TopicLimits::default().beams;
    let pose = bytes.pose();
    let radii_mm: Vec<u16> = (0..bytes.u8() % 10).map(|_| bytes.u16()).collect();
    let body_mask: Vec<zones::Sector> = (0..bytes.u8() % 80)
        .map(|_| zones::Sector { from_mdeg: bytes.i32(), to_mdeg: bytes.i32(), range_mm: bytes.u16() })
        .collect();
    let flags = bytes.u8();
    let is = |bit: u8| flags >> bit & 1 == 1;
    let mut check = zones::ZoneChecker::new(
        pose,
        &zones::Settings {
            radii_mm: radii_mm.clone(),
            body_mask,
            margin_mm: bytes.u16(),
            min_beams: bytes.u16(),
            min_scans: u16::from(bytes.u8()),
            max_invalid: bytes.number(),
            exact: is(0),
            no_return_is_far: is(1),
        },
        maximum,
    );
    let max_gap = u16::from(bytes.u8());
    let mut finder = marks::MarkDetector::new(marks::Settings {
        min_level: bytes.u8(),
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
    let mut model = BackgroundModel::new(settings, maximum);
    let mut cutter = Segmenter::new(pose, maximum);
    let (mut zones, mut marks) = (Zones::unknown(), Marks::default());
    let mut foreground = Foreground::of(maximum);
    let mut background = Background::zeroed(Background::len(maximum));
    let mut scan = Scan::zeroed(Scan::len(MAX_BEAMS, ArrayFlags::ALL));
    while !bytes.is_empty() {
        match bytes.u8() {
            0..=3 => model.reset(),
            4..=7 => model.freeze(),
            8..=11 => model.thaw(),
            12..=15 => {
                model.write(&mut background);
                assert_eq!(model.load(&background), Ok(()), "what it has shown");
            }
            16..=19 => {
                check.write_stale(&mut zones);
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
        assert_foreground(&scan, &foreground, maximum);
        assert_eq!(model.classes().len(), scan.beams().min(maximum));
    }
}

fn assert_zones(scan: &Scan, radii_mm: &[u16], zones: &Zones) {
    let used = zones.zones();
    assert_eq!(used.len(), radii_mm.len().min(MAX_ZONES));
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

fn assert_foreground(scan: &Scan, foreground: &Foreground, max_segments: usize) {
    assert_eq!(usize::from(foreground.count), scan.beams().min(max_segments));
    let mut beams = 0;
    for (beam, range) in foreground.readings() {
        assert_eq!(scan.range(beam), Some(range), "beam {beam}");
        beams += 1;
    }
    assert_eq!(usize::from(foreground.beams), beams);
    let ends = foreground.segments().iter().map(|segment| (segment.first, segment.last));
    assert!(ends.clone().all(|(first, last)| (first..=last).all(|i| foreground.contains(usize::from(i)))));
    assert!(ends.clone().is_sorted_by(|one, next| one.1 < next.0));
    assert!(ends.enumerate().all(|(i, (first, last))| first == last || foreground.has_support(i)));
}
