//! Exact lines of class `scan`, for a scanner with beams at fixed angles and for one whose points have their own
//! angles. And the remedy of missing marks in class `status`.

use scanhub_schema::{Code, Contents, Family, Flags, Header, Pose, Reasons, Scan, ScanHead, Status};

fn header() -> Header {
    Header {
        seq: 7,
        topic_seq: 6,
        stamp_first_ns: 1_000_000_000,
        wall_ns: 1_700_000_000_000_000_000,
        boot: 0xAB,
        ..Header::default()
    }
}

fn line(header: &Header, scan: &Scan) -> String {
    serde_json::to_string(&super::scan("front", header, scan)).unwrap()
}

const BEGIN: &str = r#"{"class":"scan","sensor":"front","seq":7,"topic_seq":6,"stamp_ns":1000000000,"wall_ns":1700000000000000000,"boot":"00000000000000ab","quality":"#;

#[test]
fn of_an_lms() {
    let mut scan = Scan::of(ScanHead::lms(5, -90_000, 500, 10, 13), &[1000, 0x1FFF, 0x1FFE, 0x1FF7, 7]);
    let before = r#""clean","family":"lms","unit_um":10000,"count":5,"first_angle_deg":-90.0,"step_deg":0.5,"beam_time_ns":18500,"#;
    let measured =
        r#""ranges":[1000,null,null,null,7],"codes":[[1,"no_return"],[2,"too_bright"],[3,"beyond"]]"#;
    assert_eq!(line(&header(), &scan), [BEGIN, before, measured, "}"].concat());
    // Field bits are no intensities; reflector levels are.
    scan.arrays().upper.copy_from_slice(&[0, 0, 0, 0, 3]);
    assert_eq!(line(&header(), &scan), [BEGIN, before, measured, "}"].concat());
    scan.intensity_bits = 3;
    let flags = Header { flags: Flags::SIMULATED, ..header() };
    let levels = r#","intensities":[0,0,0,0,3],"flags":["simulated"]}"#;
    assert_eq!(line(&flags, &scan), [BEGIN, before, measured, levels].concat());
}

#[test]
fn of_points_with_angles_of_their_own() {
    let head = ScanHead {
        step: -90_f64.to_radians(),
        beam_time_ns: 62_500,
        unit_um: 250,
        valid_to: 0xFFEF,
        no_return: Code::NoReturn.value(),
        collapsed: 2,
        family: Family::Ld as u8,
        flags: Scan::INCOMPLETE,
        contents: Contents::ANGLES | Contents::WIDE,
        intensity_bits: 16,
        ..ScanHead::default()
    };
    let mut scan = Scan::of(head, &[4001, Code::NoReturn.value(), Scan::NOT_MEASURED, 0]);
    let arrays = scan.arrays();
    arrays.angles.copy_from_slice(&[0.25, -1.5, f32::NAN, -4.75]);
    arrays.wide.copy_from_slice(&[700, 1, 0, 65_535]);
    let header = Header { quality: 1, reasons: Reasons::SLOW, flags: Flags::SIMULATED, ..header() };
    let head = r#""suspect","reasons":["slow"],"family":"ld","unit_um":250,"count":4,"first_angle_deg":0.0,"step_deg":-90.0,"beam_time_ns":62500,"#;
    let measured = r#""ranges":[4001,null,null,0],"codes":[[1,"no_return"]],"intensities":[700,1,0,65535],"angles_deg":[14.3239,null,null,-272.155],"#;
    let end = r#""collapsed":2,"incomplete":true,"flags":["simulated"]}"#;
    assert_eq!(line(&header, &scan), [BEGIN, head, measured, end].concat());
    (scan.collapsed, scan.flags) = (0, 0);
    let end = r#""collapsed":0,"flags":["simulated"]}"#;
    assert_eq!(line(&header, &scan), [BEGIN, head, measured, end].concat());
}

#[test]
fn marks_need_reflector_bits_or_a_threshold() {
    let remedy = |family: u8, mode, has_mark_level| {
        let mut status = Status { family, mode, ..Status::default() };
        status.set_port("/dev/ttyUSB0");
        status.set_processing(Pose::default(), has_mark_level);
        super::marks_remedy("robot1.front", &status)
    };
    let configure = Some("scanhub configure /dev/ttyUSB0 mode=0x01".to_owned());
    for family in Family::ALL {
        let number = family as u8;
        let [without, with] = [false, true].map(|has_level| remedy(number, Status::MODE_UNKNOWN, has_level));
        if family.has_reflector_levels() {
            assert_eq!((without, with), (None, None));
            assert_eq!((remedy(number, 0, true), remedy(number, 1, false)), (configure.clone(), None));
        } else {
            assert_eq!((without, with), (Some("set link.front.marks.level".to_owned()), None));
        }
    }
    assert_eq!(remedy(Family::UNKNOWN, Status::MODE_UNKNOWN, true), None, "while the hub searches");
}
