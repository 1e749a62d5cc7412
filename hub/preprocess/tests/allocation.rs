//! Test that no processor allocates memory when it processes a scan, not even for the first scan of another layout.

#[path = "../../daemon/tests/counting/mod.rs"]
mod counting;
mod surroundings;

use std::hint::black_box;
use std::sync::atomic::Ordering::Relaxed;

use counting::{ALLOCATIONS, WATCHED_THREAD};
use rustix::thread::gettid;
use scanhub_preprocess::background::{self, BackgroundModel, Method};
use scanhub_preprocess::segments::Segmenter;
use scanhub_preprocess::{lines, marks, motion, zones};
use scanhub_schema::{Background, Foreground, Lines, Marks, Motion, Pose, Scan, Zones};
use surroundings::{MAX_TEST_BEAMS, RandomSurroundings, Shape};

#[test]
fn processors_do_not_allocate_per_scan() {
    let mut random = fastrand::Rng::with_seed(1);
    let mut scans: Vec<Box<Scan>> = Vec::new();
    for seed in 0..20 {
        let mut surroundings = RandomSurroundings::new(Shape::any(&mut random), seed);
        scans.extend((0..50).map(|_| surroundings.next()));
    }
    for scan in &mut scans {
        scan.intensity_bits = 3;
        scan.arrays().upper.iter_mut().for_each(|intensity| *intensity = random.u8(..8));
    }
    let pose = Pose { x_m: 0.3, yaw_rad: 1.0, ..Pose::default() };
    let mut check = zones::ZoneChecker::new(pose, &zones::Settings::default(), MAX_TEST_BEAMS);
    let mut finder = marks::MarkDetector::new(marks::Settings::default());
    let of_form = |refine| lines::Settings { refine, ..lines::Settings::default() };
    let mut line_finders =
        [false, true].map(|refine| lines::LineFinder::new(pose, of_form(refine), MAX_TEST_BEAMS));
    let mut found_lines = Lines::default();
    let settings = |method| background::Settings { method, scans: Some(10), ..Default::default() };
    let mut models = [Method::Paper, Method::Multi, Method::Moving]
        .map(|method| BackgroundModel::new(settings(method), MAX_TEST_BEAMS));
    let mut estimator = motion::MotionEstimator::new(pose, motion::Settings::default(), MAX_TEST_BEAMS);
    let (mut found_motion, mut stamp_ns) = (Motion::default(), 0);
    let mut cutter = Segmenter::new(pose, MAX_TEST_BEAMS);
    let (mut zones, mut marks) = (Zones::default(), Marks::default());
    let mut foreground = Foreground::of(MAX_TEST_BEAMS);
    let mut background = Background::zeroed(Background::len(MAX_TEST_BEAMS));
    let (mut segments, mut lines_found) = (0, 0);

    WATCHED_THREAD.store(gettid().as_raw_nonzero().get(), Relaxed);
    drop(black_box(Box::new(0)));
    let before = ALLOCATIONS.load(Relaxed);
    for scan in &scans {
        check.update(scan, &mut zones);
        finder.update(scan, &mut marks);
        for finder in &mut line_finders {
            finder.update(scan, &mut found_lines);
            lines_found += found_lines.lines().len();
        }
        stamp_ns += 26_640_000;
        estimator.update(scan, stamp_ns, 0, &mut found_motion);
        for model in &mut models {
            model.set_motion(&pose, &found_motion, &estimator.velocity());
            model.update(scan, &mut foreground);
            cutter.update(scan, &mut foreground);
            model.write(&mut background);
            segments += foreground.segments().len();
        }
    }
    check.write_stale(&mut zones);
    let taken = ALLOCATIONS.load(Relaxed) - before;
    WATCHED_THREAD.store(0, Relaxed);
    assert_eq!((before, taken), (1, 0), "one piece was taken before, to see that it is counted");
    assert!(marks.count > 0 && segments > 0 && lines_found > 0, "there was something to do");
}
