//! What a sensor says of itself beside its scans: it is known, told in words, and streams go on.

use scanhub_drivers::lms;
use scanhub_drivers::lms::Notice;
use scanhub_drivers::lms::status::Condition;
use scanhub_drivers::lms::variant::Baud;
use scanhub_schema::MILLIS;
use scanhub_sim::machine::{Settings, Start};
use scanhub_sim::operating::Operating;

use super::bench::{Bench, ToHost, sensor_with};

fn streaming(settings: Settings) -> Bench {
    let mut bench = Bench::new(sensor_with(settings), 0);
    bench.until("streaming", 3_000 * MILLIS, Bench::is_streaming);
    bench.run(1_000 * MILLIS);
    assert!(bench.is_streaming() && bench.session.trouble().is_none(), "{bench}");
    bench
}

#[test]
fn a_healthy_sensor_is_known_whole_and_says_nothing() {
    for (baud, start) in [(Baud::B9600, Operating::OnRequest), (Baud::B500000, Operating::All)] {
        let bench = streaming(Settings { baud, start: Start::In(start), ..Settings::default() });
        let known = bench.session.sensor();
        assert_eq!((known.software(), known.kind()), (&b"V02.30"[..], &b"LMS200;301063;V02.30"[..]));
        assert_eq!((known.condition, known.defective), (Some(Condition::OK), Some(false)));
        assert_eq!((known.permanent_baud, known.window_percent), (Some(false), Some(100)));
        assert!(known.laser_power_percent.is_some());
        assert_eq!(known.notices().next(), None);
    }
}

#[test]
fn a_dirty_window_and_an_error_are_told() {
    for (status, pollution_percent, notices) in [
        (0x11, 100, &[][..]),
        (0x92, 100, &[Notice::Dirty][..]),
        (0x10, 60, &[Notice::Dirty][..]),
        (0x13, 100, &[Notice::Error][..]),
        (0x94, 20, &[Notice::Fatal, Notice::Dirty][..]),
    ] {
        let bench = streaming(Settings { status, pollution_percent, ..Settings::default() });
        let known = bench.session.sensor();
        assert!(known.notices().eq(notices.iter().copied()), "{status:02X} {pollution_percent}: {known:?}");
        assert_eq!(known.window_percent, Some(pollution_percent));
        assert!(notices.iter().all(|notice| notice.is_fault()));
    }
}

#[test]
fn a_condition_that_comes_and_goes_is_there() {
    let mut bench = streaming(Settings { baud: Baud::B500000, ..Settings::default() });
    // A scan with a dirty window now and then.
    bench.to_host = whole_scans(|count, scan| dirty(scan, count % 5 == 0));
    bench.until("told", 1_000 * MILLIS, |bench| bench.session.sensor().notices().eq([Notice::Dirty]));
    for _ in 0..200 {
        bench.run(27 * MILLIS);
        assert!(bench.session.sensor().notices().eq([Notice::Dirty]), "{bench}");
    }
    bench.to_host = Box::new(|_, bytes| bytes);
    bench.until("forgotten", 10_000 * MILLIS, |bench| bench.session.sensor().notices().next().is_none());
}

/// Hands over whole scans of 361 beams, as `change` makes them of their number and bytes; the rest of the one on the line is
/// lost.
fn whole_scans(change: impl Fn(u32, Vec<u8>) -> Vec<u8> + 'static) -> ToHost {
    let mut count = 0;
    let mut held = Vec::new();
    Box::new(move |_, bytes| {
        if held.is_empty() && !bytes.starts_with(&[0x02, 0x80, 0xD6, 0x02]) {
            return Vec::new();
        }
        held.extend(bytes);
        if held.len() < 732 {
            return Vec::new();
        }
        count += 1;
        change(count, std::mem::take(&mut held))
    })
}

/// `scan`, whose sensor complains of its window if it `is_dirty`, with a right checksum.
fn dirty(mut scan: Vec<u8>, is_dirty: bool) -> Vec<u8> {
    if is_dirty {
        scan[729] |= 0x80;
        let sum = lms::telegram::crc(&scan[..730]).to_le_bytes();
        scan[730..].copy_from_slice(&sum);
    }
    scan
}

#[test]
fn on_a_line_that_damages_telegrams_one_complaint_is_none() {
    let mut bench = streaming(Settings { baud: Baud::B500000, ..Settings::default() });
    bench.to_host = whole_scans(|count, scan| match count % 4 {
        0 => scan[..700].to_vec(),
        _ => dirty(scan, count == 101 || count == 103),
    });
    for _ in 0..300 {
        bench.run(27 * MILLIS);
        assert_eq!(bench.session.sensor().notices().next(), None, "{bench}");
    }
    // One that is told again and again is one.
    bench.to_host = whole_scans(|count, scan| match count % 4 {
        0 => scan[..700].to_vec(),
        _ => dirty(scan, true),
    });
    bench.until("told", 1_000 * MILLIS, |bench| bench.session.sensor().notices().eq([Notice::Dirty]));
}
