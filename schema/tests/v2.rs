//! Golden size, offsets and bytes of every payload of version 2. Do not change these tests: another layout is another
//! version. The bytes stand in `tests/vectors/v2` too, for other languages.

#[path = "v2/early.rs"]
mod early;
#[path = "v2/lines.rs"]
mod lines;
#[path = "v2/motion.rs"]
mod motion;
#[path = "v2/scan.rs"]
mod scan;
#[path = "v2/tilted.rs"]
mod tilted;
#[path = "v2/tracks.rs"]
mod tracks;

use std::mem::{offset_of, size_of};

use scanhub_schema::{
    Background, BackgroundHead, BackgroundWord, COUNTERS, Counter, Counters, Failure, Foreground,
    ForegroundHead, ForegroundWord, Header, Kind, Mark, Marks, Pose, Request, Response, SEGMENTS, Segment,
    Shown, State, Status, Verb, Zone, Zones,
};

/// Builds the expected bytes: `size` zeros with `fields` written over them.
pub(crate) fn golden(size: usize, fields: &[(usize, &[u8])]) -> Vec<u8> {
    let mut bytes = vec![0; size];
    for &(offset, field) in fields {
        bytes[offset..offset + field.len()].copy_from_slice(field);
    }
    bytes
}

/// The bytes that other languages read.
pub(crate) fn shared(file: &str) -> Vec<u8> {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../tests/vectors/v2/").to_owned() + file;
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
    assert_eq!((offset_of!(Header, flags), offset_of!(Header, family)), (50, 51));
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
        flags: 2,
        family: 1,
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
    assert_eq!((size_of::<ForegroundHead>(), align_of::<ForegroundHead>(), Foreground::HEAD), (24, 8, 24));
    assert_eq!((size_of::<ForegroundWord>(), align_of::<ForegroundWord>()), (8, 8));
    assert_eq!((offset_of!(ForegroundHead, generation), offset_of!(ForegroundHead, unit_um)), (0, 4));
    assert_eq!((offset_of!(ForegroundHead, count), offset_of!(ForegroundHead, beams)), (8, 10));
    assert_eq!((offset_of!(ForegroundHead, segments), offset_of!(ForegroundHead, left_out)), (12, 14));
    assert_eq!(offset_of!(ForegroundHead, supported), 16);
    assert_eq!((size_of::<Segment>(), align_of::<Segment>(), SEGMENTS), (16, 4, 64));
    assert_eq!((offset_of!(Segment, first), offset_of!(Segment, last)), (0, 2));
    assert_eq!((offset_of!(Segment, nearest), offset_of!(Segment, width)), (4, 6));
    assert_eq!((offset_of!(Segment, x_mm), offset_of!(Segment, y_mm)), (8, 12));
    assert_eq!([16, 17, 401].map(Foreground::len), [1082, 1086, 1902]);
}

#[test]
fn foreground_bytes() {
    let mut foreground = Foreground::of(401);
    let arrays = foreground.begin(ForegroundHead {
        generation: 0x0001_0203,
        unit_um: 10_000,
        count: 401,
        beams: 1,
        segments: 64,
        left_out: 0x0104,
        supported: 0x8000_0000_0000_0206,
    });
    arrays.segments[63] = Segment { first: 400, last: 0x0105, nearest: 6, width: 7, x_mm: -2, y_mm: 8 };
    (arrays.bits[50], arrays.ranges[0]) = (1, 0x1234);
    let expected = golden(
        1902,
        &[
            (0, &[3, 2, 1, 0, 0x10, 0x27, 0, 0, 0x91, 0x01, 1, 0, 64, 0, 4, 1, 6, 2, 0, 0, 0, 0, 0, 0x80]),
            (1032, &[0x90, 0x01, 5, 1, 6, 0, 7, 0, 0xFE, 0xFF, 0xFF, 0xFF, 8]),
            (1098, &[1, 0, 0x34, 0x12]),
        ],
    );
    assert_eq!(foreground.bytes(), expected);
    assert_eq!(shared("foreground.hex"), expected);
}

#[test]
fn background_layout() {
    assert_eq!((size_of::<BackgroundHead>(), align_of::<BackgroundHead>(), Background::HEAD), (32, 8, 32));
    assert_eq!((size_of::<BackgroundWord>(), align_of::<BackgroundWord>()), (8, 8));
    assert_eq!((offset_of!(BackgroundHead, first_angle), offset_of!(BackgroundHead, step)), (0, 8));
    assert_eq!((offset_of!(BackgroundHead, generation), offset_of!(BackgroundHead, unit_um)), (16, 20));
    assert_eq!((offset_of!(BackgroundHead, taught), offset_of!(BackgroundHead, count)), (24, 26));
    assert_eq!((offset_of!(BackgroundHead, flags), offset_of!(BackgroundHead, reserved)), (28, 29));
    assert_eq!((Background::UNTAUGHT, Background::FAR, Background::len(401)), (0, 0xFFFF, 834));
}

#[test]
fn background_bytes() {
    let head = BackgroundHead {
        first_angle: -0.25,
        step: -1.5,
        generation: 0x0001_0203,
        unit_um: 10_000,
        taught: 0x0104,
        flags: Background::FROZEN,
        ..BackgroundHead::default()
    };
    let mut model = Background::of(head, &[0; 401]);
    (model.ranges_mut()[0], model.ranges_mut()[400]) = (0x1234, Background::FAR);
    let expected = golden(
        834,
        &[
            (0, &(-0.25_f64).to_le_bytes()),
            (8, &(-1.5_f64).to_le_bytes()),
            (16, &[3, 2, 1, 0, 0x10, 0x27, 0, 0, 4, 1, 0x91, 0x01, 1]),
            (32, &[0x34, 0x12]),
            (832, &[0xFF, 0xFF]),
        ],
    );
    assert_eq!(model.bytes(), expected);
    assert_eq!(shared("background.hex"), expected);
    assert_eq!(Background::read(&expected), Some(model));
}

#[test]
fn status_layout() {
    assert_eq!((size_of::<Status>(), align_of::<Status>()), (592, 8));
    assert_eq!((size_of::<Counters>(), COUNTERS), (224, 28));
    assert_eq!(offset_of!(Status, state), 0);
    assert_eq!(offset_of!(Status, mode), 1);
    assert_eq!(offset_of!(Status, unit_mm), 2);
    assert_eq!(offset_of!(Status, family), 3);
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
        family: 1,
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
            (0, &[4, 1, 1, 1, 0x20, 0xA1, 0x07, 0]),
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
         due_on_line lost_on_line lost_ppm scanner_restarts"
    );
    let names: Vec<_> = State::ALL.iter().map(|state| state.name()).collect();
    assert_eq!(names.join(" "), "absent probing switching starting streaming silent paused");
}

#[test]
fn request_bytes() {
    let verbs: Vec<_> = Verb::all().map(|verb| (verb as u16, verb.name())).collect();
    let flow = [(1, "pause"), (2, "resume"), (3, "resync")];
    let background = [(16, "show"), (17, "reset"), (18, "freeze"), (19, "thaw"), (20, "load")];
    assert_eq!(verbs, [&flow[..], &background].concat());
    let plain = golden(40, &[(0, b"front"), (32, &[3])]);
    assert_eq!(Request::new("front", Verb::Resync).encode(), plain);
    let head = BackgroundHead { step: 0.5, unit_um: 10_000, ..BackgroundHead::default() };
    let request = Request::load("front", &Background::of(head, &[0x1234, 0, 0x1FFF]));
    let expected = golden(
        78,
        &[
            (0, b"front"),
            (32, &[20]),
            (48, &0.5_f64.to_le_bytes()),
            (60, &[0x10, 0x27, 0, 0, 0, 0, 3]),
            (72, &[0x34, 0x12, 0, 0, 0xFF, 0x1F]),
        ],
    );
    assert_eq!(request.encode(), expected);
    assert_eq!(shared("request.hex"), expected);
    assert_eq!(Request::decode(&expected), Some(request));
}

#[test]
fn response_bytes() {
    assert_eq!(Response(Ok(None)).encode(), [0, 0, 0, 0]);
    let head = BackgroundHead { step: 0.5, unit_um: 1000, taught: 1, ..BackgroundHead::default() };
    let model = Background::of(head, &[0x1234]);
    let bytes =
        golden(34, &[(8, &0.5_f64.to_le_bytes()), (20, &[0xE8, 3, 0, 0, 1, 0, 1]), (32, &[0x34, 0x12])]);
    let shown = Response(Ok(Some(model.clone().into())));
    assert_eq!(shown.encode(), [&[0; 4], &bytes[..]].concat());
    let kept = Response(Ok(Some(Shown { model, kept_wall_ns: Some(17) })));
    assert_eq!(kept.encode(), [&[0, 0, 2, 0, b'1', b'7'], &bytes[..]].concat());
    let refused = Response(Err(Failure::new(Kind::Short, "busy", "wait")));
    assert_eq!(refused.encode(), b"\x4b\0\x09\0busy\nwait");
}
