//! Golden size, offsets and bytes of every payload of version 1. Do not change these tests: another layout is another
//! version. The bytes stand in `tests/vectors/v1` too, for other languages.

use std::mem::{offset_of, size_of};

use schema::{
    BEAMS, Background, COUNTERS, Counter, Counters, Failure, Foreground, Header, Kind, Mark, Marks, Pose,
    Request, Response, Scan, Segment, State, Status, Verb, Zone, Zones,
};

/// Builds the expected bytes: `size` zeros with `fields` written over them.
fn golden(size: usize, fields: &[(usize, &[u8])]) -> Vec<u8> {
    let mut bytes = vec![0; size];
    for &(offset, field) in fields {
        bytes[offset..offset + field.len()].copy_from_slice(field);
    }
    bytes
}

/// The bytes that other languages read.
fn shared(file: &str) -> Vec<u8> {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../tests/vectors/v1/").to_owned() + file;
    let text = std::fs::read_to_string(&path).unwrap_or_else(|error| panic!("{path}: {error}"));
    let digits: Vec<u32> = text.chars().filter_map(|c| c.to_digit(16)).collect();
    digits.chunks(2).map(|pair| (pair[0] << 4 | pair[1]) as u8).collect()
}

#[test]
fn header_layout() {
    assert_eq!((size_of::<Header>(), align_of::<Header>()), (64, 8));
    assert_eq!(offset_of!(Header, seq), 0);
    assert_eq!(offset_of!(Header, topic_seq), 8);
    assert_eq!(offset_of!(Header, stamp_first_ns), 16);
    assert_eq!(offset_of!(Header, stamp_last_ns), 24);
    assert_eq!(offset_of!(Header, wall_ns), 32);
    assert_eq!(offset_of!(Header, boot), 40);
    assert_eq!(offset_of!(Header, sensor), 48);
    assert_eq!(offset_of!(Header, quality), 49);
    assert_eq!(offset_of!(Header, flags), 50);
    assert_eq!(offset_of!(Header, period_us), 52);
    assert_eq!(offset_of!(Header, hub_pid), 56);
    assert_eq!(offset_of!(Header, reasons), 60);
    assert_eq!(offset_of!(Header, hub_time), 61);
}

#[test]
fn header_bytes() {
    let header = Header {
        seq: 1,
        topic_seq: 2,
        stamp_first_ns: 3,
        stamp_last_ns: 4,
        wall_ns: 0x1122_3344_5566_7788,
        boot: 0x99AA_BBCC_DDEE_FF00,
        sensor: 5,
        quality: 1,
        flags: 0x0102,
        period_us: 26_640,
        hub_pid: 7,
        reasons: 0x12,
        hub_time: [0xB2, 0x02, 0xFF],
    };
    let expected = golden(
        64,
        &[
            (0, &[1]),
            (8, &[2]),
            (16, &[3]),
            (24, &[4]),
            (32, &[0x88, 0x77, 0x66, 0x55, 0x44, 0x33, 0x22, 0x11]),
            (40, &[0x00, 0xFF, 0xEE, 0xDD, 0xCC, 0xBB, 0xAA, 0x99]),
            (48, &[5, 1, 0x02, 0x01]),
            (52, &[0x10, 0x68, 0, 0]),
            (56, &[7]),
            (60, &[0x12, 0xB2, 0x02, 0xFF]),
        ],
    );
    assert_eq!(bytemuck::bytes_of(&header), expected);
    assert_eq!(shared("header.hex"), expected);
}

#[test]
fn scan_layout() {
    assert_eq!((size_of::<Scan>(), align_of::<Scan>(), BEAMS), (1216, 4, 401));
    assert_eq!(offset_of!(Scan, count), 0);
    assert_eq!(offset_of!(Scan, unit_mm), 2);
    assert_eq!(offset_of!(Scan, range_bits), 3);
    assert_eq!(offset_of!(Scan, first_angle_mdeg), 4);
    assert_eq!(offset_of!(Scan, step_mdeg), 8);
    assert_eq!(offset_of!(Scan, intensity_bits), 10);
    assert_eq!(offset_of!(Scan, contents), 11);
    assert_eq!(offset_of!(Scan, range_array), 12);
    assert_eq!(offset_of!(Scan, upper_array), 814);
    assert_eq!(offset_of!(Scan, pad), 1215);
}

#[test]
fn scan_bytes() {
    let mut scan = Scan {
        count: 401,
        unit_mm: 10,
        range_bits: 13,
        first_angle_mdeg: -40_000,
        step_mdeg: 250,
        intensity_bits: 3,
        contents: 1,
        ..Scan::default()
    };
    scan.range_array[0] = 0x1234;
    scan.range_array[400] = 0x1FFF;
    scan.upper_array[0] = 7;
    scan.upper_array[400] = 6;
    let expected = golden(
        1216,
        &[
            (0, &[0x91, 0x01, 10, 13, 0xC0, 0x63, 0xFF, 0xFF, 250, 0, 3, 1]),
            (12, &[0x34, 0x12]),
            (812, &[0xFF, 0x1F, 7]),
            (1214, &[6, 0]),
        ],
    );
    assert_eq!(bytemuck::bytes_of(&scan), expected);
    assert_eq!(shared("scan.hex"), expected);
}

#[test]
fn marks_layout() {
    assert_eq!((size_of::<Marks>(), align_of::<Marks>()), (1028, 4));
    assert_eq!((offset_of!(Marks, count), offset_of!(Marks, flags)), (0, 1));
    assert_eq!((offset_of!(Marks, reserved), offset_of!(Marks, mark_array)), (2, 4));
    assert_eq!((size_of::<Mark>(), align_of::<Mark>()), (16, 4));
    assert_eq!((offset_of!(Mark, angle_mdeg), offset_of!(Mark, range_dmm)), (0, 4));
    assert_eq!((offset_of!(Mark, weight), offset_of!(Mark, peak), offset_of!(Mark, edge)), (8, 10, 11));
    assert_eq!((offset_of!(Mark, first_beam), offset_of!(Mark, last_beam)), (12, 14));
}

#[test]
fn marks_bytes() {
    let mut marks = Marks { count: 64, flags: Marks::OVERFLOW | Marks::UNAVAILABLE, ..Marks::default() };
    marks.mark_array[63] = Mark {
        angle_mdeg: -2,
        range_dmm: 0x0001_0203,
        weight: 0x0405,
        peak: 7,
        edge: 1,
        first_beam: 0x0106,
        last_beam: 0x0108,
    };
    let mark = [0xFE, 0xFF, 0xFF, 0xFF, 3, 2, 1, 0, 5, 4, 7, 1, 6, 1, 8, 1];
    assert_eq!(bytemuck::bytes_of(&marks), golden(1028, &[(0, &[64, 3]), (1012, &mark)]));
    assert_eq!(bytemuck::bytes_of(&marks), shared("marks.hex"));
}

#[test]
fn zones_layout() {
    assert_eq!((size_of::<Zones>(), align_of::<Zones>()), (76, 4));
    assert_eq!((offset_of!(Zones, verdict), offset_of!(Zones, count)), (0, 1));
    assert_eq!((offset_of!(Zones, nearest_beam), offset_of!(Zones, nearest_mm)), (2, 4));
    assert_eq!((offset_of!(Zones, invalid_beams), offset_of!(Zones, flags)), (8, 10));
    assert_eq!((offset_of!(Zones, reserved), offset_of!(Zones, zone_array)), (11, 12));
    assert_eq!((size_of::<Zone>(), align_of::<Zone>()), (8, 2));
    assert_eq!((offset_of!(Zone, radius_mm), offset_of!(Zone, beams)), (0, 2));
    assert_eq!((offset_of!(Zone, violated), offset_of!(Zone, reserved)), (4, 5));
}

#[test]
fn zones_bytes() {
    assert_eq!(bytemuck::bytes_of(&Zones::unknown()), golden(76, &[(0, &[3]), (2, &[0xFF; 6])]));
    let mut zones = Zones {
        verdict: 1,
        count: 2,
        nearest_beam: 0x0102,
        nearest_mm: 0x0003_0405,
        invalid_beams: 0x0106,
        flags: Zones::PROVISIONAL,
        ..Zones::unknown()
    };
    zones.zone_array[1] = Zone { radius_mm: 600, beams: 0x0107, violated: 1, reserved: [0; 3] };
    let head = [1, 2, 2, 1, 5, 4, 3, 0, 6, 1, 1, 0];
    let expected = golden(76, &[(0, &head), (20, &[0x58, 0x02, 7, 1, 1])]);
    assert_eq!(bytemuck::bytes_of(&zones), expected);
    assert_eq!(shared("zones.hex"), expected);
}

#[test]
fn foreground_layout() {
    assert_eq!((size_of::<Foreground>(), align_of::<Foreground>()), (1892, 4));
    assert_eq!((offset_of!(Foreground, generation), offset_of!(Foreground, count)), (0, 4));
    assert_eq!((offset_of!(Foreground, beams), offset_of!(Foreground, unit_mm)), (6, 8));
    assert_eq!((offset_of!(Foreground, left_out), offset_of!(Foreground, segments)), (9, 10));
    assert_eq!((offset_of!(Foreground, bit_array), offset_of!(Foreground, pad)), (12, 63));
    assert_eq!((offset_of!(Foreground, range_array), offset_of!(Foreground, pad2)), (64, 866));
    assert_eq!(offset_of!(Foreground, segment_array), 868);
    assert_eq!((size_of::<Segment>(), align_of::<Segment>()), (16, 4));
    assert_eq!((offset_of!(Segment, first), offset_of!(Segment, last)), (0, 2));
    assert_eq!((offset_of!(Segment, nearest), offset_of!(Segment, width)), (4, 6));
    assert_eq!((offset_of!(Segment, x_mm), offset_of!(Segment, y_mm)), (8, 12));
}

#[test]
fn foreground_bytes() {
    let mut foreground = Foreground {
        generation: 0x0001_0203,
        count: 401,
        beams: 1,
        unit_mm: 10,
        left_out: 255,
        segments: 64,
        ..Foreground::default()
    };
    foreground.bit_array[50] = 1;
    foreground.range_array[0] = 0x1234;
    foreground.segment_array[63] =
        Segment { first: 400, last: 0x0105, nearest: 6, width: 7, x_mm: -2, y_mm: 8 };
    let expected = golden(
        1892,
        &[
            (0, &[3, 2, 1, 0, 0x91, 0x01, 1, 0, 10, 255, 64, 0]),
            (62, &[1, 0, 0x34, 0x12]),
            (1876, &[0x90, 0x01, 5, 1, 6, 0, 7, 0, 0xFE, 0xFF, 0xFF, 0xFF, 8]),
        ],
    );
    assert_eq!(bytemuck::bytes_of(&foreground), expected);
    assert_eq!(shared("foreground.hex"), expected);
}

#[test]
fn background_layout() {
    assert_eq!((size_of::<Background>(), align_of::<Background>()), (816, 4));
    assert_eq!((offset_of!(Background, generation), offset_of!(Background, taught)), (0, 4));
    assert_eq!((offset_of!(Background, count), offset_of!(Background, unit_mm)), (6, 8));
    assert_eq!((offset_of!(Background, flags), offset_of!(Background, reserved)), (9, 10));
    assert_eq!((offset_of!(Background, range_array), offset_of!(Background, pad)), (12, 814));
}

#[test]
fn background_bytes() {
    let mut background = Background {
        generation: 0x0001_0203,
        taught: 0x0104,
        count: 401,
        unit_mm: 10,
        flags: Background::FROZEN,
        ..Background::default()
    };
    background.range_array[0] = 0x1234;
    background.range_array[400] = Background::FAR;
    let expected =
        golden(816, &[(0, &[3, 2, 1, 0, 4, 1, 0x91, 0x01, 10, 1, 0, 0, 0x34, 0x12]), (812, &[0xFF, 0xFF])]);
    assert_eq!(bytemuck::bytes_of(&background), expected);
    assert_eq!(shared("background.hex"), expected);
    assert_eq!(background.packed(), &expected[..814]);
}

#[test]
fn status_layout() {
    assert_eq!((size_of::<Status>(), align_of::<Status>()), (592, 8));
    assert_eq!((size_of::<Counters>(), COUNTERS), (224, 28));
    assert_eq!(offset_of!(Status, state), 0);
    assert_eq!(offset_of!(Status, mode), 1);
    assert_eq!(offset_of!(Status, unit_mm), 2);
    assert_eq!(offset_of!(Status, reserved), 3);
    assert_eq!(offset_of!(Status, baud), 4);
    assert_eq!(offset_of!(Status, since_ns), 8);
    assert_eq!(offset_of!(Status, rate_mhz), 16);
    assert_eq!(offset_of!(Status, angle_deg), 20);
    assert_eq!(offset_of!(Status, resolution_cdeg), 22);
    assert_eq!(offset_of!(Status, type_text), 24);
    assert_eq!(offset_of!(Status, port_text), 48);
    assert_eq!(offset_of!(Status, last_error_text), 176);
    assert_eq!(offset_of!(Status, counters), 336);
    assert_eq!(offset_of!(Status, pose), 560);
    assert_eq!((size_of::<Pose>(), align_of::<Pose>()), (32, 8));
    assert_eq!((offset_of!(Pose, x_m), offset_of!(Pose, y_m)), (0, 8));
    assert_eq!((offset_of!(Pose, yaw_rad), offset_of!(Pose, upside_down)), (16, 24));
}

#[test]
fn status_bytes() {
    let mut status = Status {
        state: State::Streaming as u8,
        mode: 1,
        unit_mm: 1,
        baud: 500_000,
        since_ns: 9,
        rate_mhz: 37_538,
        angle_deg: 180,
        resolution_cdeg: 50,
        ..Status::default()
    };
    status.set_sensor_type("LMS200-30106");
    status.set_port("/dev/ttyUSB0");
    status.set_last_error("none");
    status.counters[Counter::BytesRead] = 3;
    status.counters[Counter::RejectedSuperseded] = 4;
    status.counters[Counter::LineErrors] = 5;
    status.pose = Pose { x_m: 0.5, y_m: -0.5, yaw_rad: 2.0, upside_down: 1, reserved: [0; 7] };
    let expected = golden(
        592,
        &[
            (0, &[4, 1, 1, 0, 0x20, 0xA1, 0x07, 0]),
            (8, &[9]),
            (16, &[0xA2, 0x92, 0, 0, 180, 0, 50, 0]),
            (24, b"LMS200-30106"),
            (48, b"/dev/ttyUSB0"),
            (176, b"none"),
            (336, &[3]),
            (336 + 19 * 8, &[4]),
            (336 + 20 * 8, &[5]),
            (560, &0.5f64.to_le_bytes()),
            (568, &(-0.5f64).to_le_bytes()),
            (576, &2.0f64.to_le_bytes()),
            (584, &[1]),
        ],
    );
    assert_eq!(bytemuck::bytes_of(&status), expected);
    assert_eq!(shared("status.hex"), expected);
}

#[test]
fn counters_in_order() {
    let names: Vec<_> = Counter::ALL.iter().map(|counter| counter.name()).collect();
    assert_eq!(
        names.join(" "),
        "bytes_read bytes_in_telegrams bytes_acknowledge bytes_discarded bytes_buffered telegrams suspect aborted \
         resyncs reconnects lost_in_restart wakeups loan_failed rejected_address rejected_length rejected_command \
         rejected_count rejected_crc rejected_vetoed rejected_superseded line_errors bytes_damaged damaged_ppm \
         due_on_line lost_on_line lost_ppm"
    );
    let names: Vec<_> = State::ALL.iter().map(|state| state.name()).collect();
    assert_eq!(names.join(" "), "absent probing switching starting streaming silent paused");
}

#[test]
fn request_layout() {
    assert_eq!((size_of::<Request>(), align_of::<Request>()), (848, 2));
    assert_eq!(offset_of!(Request, sensor_text), 0);
    assert_eq!(offset_of!(Request, verb), 32);
    assert_eq!(offset_of!(Request, count), 34);
    assert_eq!(offset_of!(Request, unit_mm), 36);
    assert_eq!(offset_of!(Request, reserved), 37);
    assert_eq!(offset_of!(Request, range_array), 40);
    assert_eq!(offset_of!(Request, pad), 842);
    assert_eq!([Verb::Pause as u16, Verb::Resume as u16, Verb::Resync as u16], [1, 2, 3]);
}

#[test]
fn request_bytes() {
    let mut request = Request { count: 401, unit_mm: 10, ..Request::new("front", Verb::Resync) };
    request.range_array[0] = 0x1234;
    request.range_array[400] = 0x1FFF;
    let expected = golden(
        848,
        &[(0, b"front"), (32, &[3, 0, 0x91, 0x01, 10]), (40, &[0x34, 0x12]), (840, &[0xFF, 0x1F])],
    );
    assert_eq!(bytemuck::bytes_of(&request), expected);
    assert_eq!(shared("request.hex"), expected);
}

#[test]
fn response_bytes() {
    assert_eq!(Response(Ok(None)).encode(), [0, 0, 0, 0]);
    let model = Background { count: 1, taught: 1, unit_mm: 1, ..Background::default() };
    let shown = [0, 0, 0, 0, 0, 0, 0, 0, 1, 0, 1, 0, 1, 0, 0, 0, 0, 0];
    assert_eq!(Response(Ok(Some(model.into()))).encode(), shown);
    let kept = Response(Ok(Some(schema::Shown { model, kept_wall_ns: Some(17) })));
    assert_eq!(kept.encode(), [&[0, 0, 2, 0, b'1', b'7'], &shown[4..]].concat());
    let refused = Response(Err(Failure::new(Kind::Short, "busy", "wait")));
    assert_eq!(refused.encode(), b"\x4b\0\x09\0busy\nwait");
}
