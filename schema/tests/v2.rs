//! Golden sizes, offsets and bytes of every payload of version 2. Do not change these tests: a different layout needs a
//! new version. Readers in other languages use the same bytes from `tests/vectors/v2`.

use std::mem::{offset_of, size_of};

use scanhub_schema::{
    ArrayFlags, Background, BackgroundHead, BackgroundWord, Cloud, CloudHead, CloudPoint, CloudWord, Code,
    Corner, Counter, Counters, Early, Event, EventKind, Failure, Family, Foreground, ForegroundHead,
    ForegroundWord, Header, Kind, Line, Lines, MAX_BEAMS, MAX_COUNTERS, MAX_LINES, MAX_OBSTACLES,
    MAX_SEGMENTS, MAX_TRACK_SENSORS, MAX_TRACKS, Mark, Marks, Motion, MotionMethod, Obstacle, Obstacles,
    PointClass, Pose, Request, Response, ResponseModel, Scan, ScanHead, ScanWord, Segment, State, Status,
    Tilt, Track, TrackSensor, TrackState, Tracks, Verb, Verdict, Zone, Zones,
};

/// Builds the expected bytes: `size` zeros with `fields` written over them.
fn golden(size: usize, fields: &[(usize, &[u8])]) -> Vec<u8> {
    let mut bytes = vec![0; size];
    for &(offset, field) in fields {
        bytes[offset..offset + field.len()].copy_from_slice(field);
    }
    bytes
}

/// Returns the bytes with this name in `tests/vectors/v2/bytes.txt`.
fn read_vector(name: &str) -> Vec<u8> {
    let lines = include_str!("../../tests/vectors/v2/bytes.txt").lines();
    let digits = lines.filter_map(|line| line.split_once(' ')).find(|(of, _)| *of == name);
    let (_, digits) = digits.unwrap_or_else(|| panic!("no bytes {name}"));
    let digits: Vec<u32> = digits.chars().map(|c| c.to_digit(16).expect("hex")).collect();
    digits.chunks(2).map(|pair| (pair[0] << 4 | pair[1]) as u8).collect()
}

#[test]
fn header_layout_is_unchanged() {
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
fn header_bytes_match_the_vector() {
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
    assert_eq!(read_vector("header"), expected);
}

#[test]
fn marks_layout_is_unchanged() {
    assert_eq!((size_of::<Marks>(), align_of::<Marks>()), (1028, 4));
    assert_eq!((offset_of!(Marks, count), offset_of!(Marks, flags)), (0, 1));
    assert_eq!((offset_of!(Marks, reserved), offset_of!(Marks, mark_array)), (2, 4));
    assert_eq!((size_of::<Mark>(), align_of::<Mark>()), (16, 4));
    assert_eq!((offset_of!(Mark, angle_mdeg), offset_of!(Mark, range_dmm)), (0, 4));
    assert_eq!((offset_of!(Mark, weight), offset_of!(Mark, peak), offset_of!(Mark, edge)), (8, 10, 11));
    assert_eq!((offset_of!(Mark, first_beam), offset_of!(Mark, last_beam)), (12, 14));
}

#[test]
fn marks_bytes_match_the_vector() {
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
    assert_eq!(bytemuck::bytes_of(&marks), read_vector("marks"));
}

#[test]
fn zones_layout_is_unchanged() {
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
fn zones_bytes_match_the_vector() {
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
    assert_eq!(read_vector("zones"), expected);
}

#[test]
fn foreground_layout_is_unchanged() {
    assert_eq!((size_of::<ForegroundHead>(), align_of::<ForegroundHead>(), Foreground::HEAD), (24, 8, 24));
    assert_eq!((size_of::<ForegroundWord>(), align_of::<ForegroundWord>()), (8, 8));
    assert_eq!((offset_of!(ForegroundHead, generation), offset_of!(ForegroundHead, unit_um)), (0, 4));
    assert_eq!((offset_of!(ForegroundHead, count), offset_of!(ForegroundHead, beams)), (8, 10));
    assert_eq!((offset_of!(ForegroundHead, segments), offset_of!(ForegroundHead, dropped)), (12, 14));
    assert_eq!(offset_of!(ForegroundHead, supported), 16);
    assert_eq!((size_of::<Segment>(), align_of::<Segment>(), MAX_SEGMENTS), (16, 4, 64));
    assert_eq!((offset_of!(Segment, first), offset_of!(Segment, last)), (0, 2));
    assert_eq!((offset_of!(Segment, nearest), offset_of!(Segment, width)), (4, 6));
    assert_eq!((offset_of!(Segment, x_mm), offset_of!(Segment, y_mm)), (8, 12));
    assert_eq!([16, 17, 401].map(Foreground::len), [1082, 1086, 1902]);
}

#[test]
fn foreground_bytes_match_the_vector() {
    let mut foreground = Foreground::of(401);
    let arrays = foreground.begin(ForegroundHead {
        generation: 0x0001_0203,
        unit_um: 10_000,
        count: 401,
        beams: 1,
        segments: 64,
        dropped: 0x0104,
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
    assert_eq!(read_vector("foreground"), expected);
}

#[test]
fn background_layout_is_unchanged() {
    assert_eq!((size_of::<BackgroundHead>(), align_of::<BackgroundHead>(), Background::HEAD), (32, 8, 32));
    assert_eq!((size_of::<BackgroundWord>(), align_of::<BackgroundWord>()), (8, 8));
    assert_eq!((offset_of!(BackgroundHead, first_angle), offset_of!(BackgroundHead, step)), (0, 8));
    assert_eq!((offset_of!(BackgroundHead, generation), offset_of!(BackgroundHead, unit_um)), (16, 20));
    assert_eq!((offset_of!(BackgroundHead, known_beams), offset_of!(BackgroundHead, count)), (24, 26));
    assert_eq!((offset_of!(BackgroundHead, flags), offset_of!(BackgroundHead, reserved)), (28, 29));
    assert_eq!((Background::UNKNOWN, Background::FAR, Background::len(401)), (0, 0xFFFF, 834));
}

#[test]
fn background_bytes_match_the_vector() {
    let head = BackgroundHead {
        first_angle: -0.25,
        step: -1.5,
        generation: 0x0001_0203,
        unit_um: 10_000,
        known_beams: 0x0104,
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
    assert_eq!(read_vector("background"), expected);
    assert_eq!(Background::read(&expected), Some(model));
}

#[test]
fn status_layout_is_unchanged() {
    assert_eq!((size_of::<Status>(), align_of::<Status>()), (592, 8));
    assert_eq!((size_of::<Counters>(), MAX_COUNTERS), (224, 28));
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
fn status_bytes_match_the_vector() {
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
    assert_eq!(read_vector("status"), expected);
}

#[test]
fn counter_and_state_names_keep_their_order() {
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
fn request_bytes_match_the_vector() {
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
    assert_eq!(read_vector("request"), expected);
    assert_eq!(Request::decode(&expected), Some(request));
}

#[test]
fn response_bytes_are_unchanged() {
    assert_eq!(Response(Ok(None)).encode(), [0, 0, 0, 0]);
    let head = BackgroundHead { step: 0.5, unit_um: 1000, known_beams: 1, ..BackgroundHead::default() };
    let model = Background::of(head, &[0x1234]);
    let bytes =
        golden(34, &[(8, &0.5_f64.to_le_bytes()), (20, &[0xE8, 3, 0, 0, 1, 0, 1]), (32, &[0x34, 0x12])]);
    let shown = Response(Ok(Some(model.clone().into())));
    assert_eq!(shown.encode(), [&[0; 4], &bytes[..]].concat());
    let kept = Response(Ok(Some(ResponseModel { model, kept_wall_ns: Some(17) })));
    assert_eq!(kept.encode(), [&[0, 0, 2, 0, b'1', b'7'], &bytes[..]].concat());
    let refused = Response(Err(Failure::new(Kind::ResourceExhausted, "busy", "wait")));
    assert_eq!(refused.encode(), b"\x4b\0\x09\0busy\nwait");
}

#[test]
fn scan_layout_is_unchanged() {
    assert_eq!((size_of::<ScanHead>(), align_of::<ScanHead>(), Scan::HEAD, MAX_BEAMS), (64, 8, 64, 8192));
    assert_eq!((size_of::<ScanWord>(), align_of::<ScanWord>()), (8, 8));
    assert_eq!((offset_of!(ScanHead, first_angle), offset_of!(ScanHead, step)), (0, 8));
    assert_eq!((offset_of!(ScanHead, spacing), offset_of!(ScanHead, beam_time_ns)), (16, 20));
    assert_eq!((offset_of!(ScanHead, first_beam_ns), offset_of!(ScanHead, unit_um)), (24, 28));
    assert_eq!((offset_of!(ScanHead, count), offset_of!(ScanHead, valid_to)), (32, 34));
    assert_eq!((offset_of!(ScanHead, no_return), offset_of!(ScanHead, beyond)), (36, 38));
    assert_eq!((offset_of!(ScanHead, collisions), offset_of!(ScanHead, family)), (40, 42));
    assert_eq!((offset_of!(ScanHead, flags), offset_of!(ScanHead, contents)), (43, 44));
    assert_eq!((offset_of!(ScanHead, intensity_bits), offset_of!(ScanHead, turns)), (45, 46));
    assert_eq!((offset_of!(ScanHead, reserved), offset_of!(ScanHead, turn_ns)), (47, 48));
    assert_eq!(offset_of!(ScanHead, reserved2), 52);
    assert_eq!([ArrayFlags::UPPER, ArrayFlags::WIDE, ArrayFlags::ANGLES, Scan::INCOMPLETE], [1, 2, 4, 1]);
    assert_eq!([0, 1, 2, 4, 7].map(|contents| Scan::len(100, contents)), [264, 364, 464, 664, 964]);
}

#[test]
fn lms_scan_bytes_match_the_vector() {
    let head = ScanHead { intensity_bits: 3, ..ScanHead::lms(401, -50_000, 250, 10, 13) };
    let mut scan = Scan::of(head, &[0; 401]);
    let arrays = scan.arrays();
    (arrays.ranges[0], arrays.ranges[400]) = (0x1234, 0x1FFF);
    (arrays.upper[0], arrays.upper[400]) = (7, 6);
    let expected = golden(
        1267,
        &[
            (0, &(-0.872_664_625_997_164_8_f64).to_le_bytes()),
            (8, &0.004_363_323_129_985_824_f64.to_le_bytes()),
            (16, &0.004_363_323_f32.to_le_bytes()),
            (20, &[0x22, 0x24, 0, 0]),
            (24, &[0x20, 0xCD, 0x65, 0xFD]),
            (28, &[0x10, 0x27, 0, 0]),
            (32, &[0x91, 0x01, 0xF6, 0x1F, 0xFF, 0x1F, 0xF7, 0x1F]),
            (44, &[1, 3, 4, 0, 0x40, 0x3F, 0xCB, 0]),
            (64, &[0x34, 0x12]),
            (864, &[0xFF, 0x1F, 7]),
            (1266, &[6]),
        ],
    );
    assert_eq!(scan.bytes(), expected);
    assert_eq!(read_vector("scan"), expected);
}

/// A clockwise scan with exact angles, a missing packet, and every kind of value.
#[test]
fn revolution_scan_bytes_match_the_vector() {
    let head = ScanHead {
        first_angle: -0.25,
        step: -1.5,
        spacing: 0.75,
        beam_time_ns: 0x0102_0304,
        first_beam_ns: -2,
        unit_um: 250,
        valid_to: 0xFFEF,
        no_return: Code::NoReturn.value(),
        beyond: Code::Beyond.value(),
        collisions: 0x0506,
        family: Family::Ld as u8,
        flags: Scan::INCOMPLETE,
        contents: ArrayFlags::ANGLES | ArrayFlags::WIDE,
        intensity_bits: 12,
        turns: 1,
        ..ScanHead::default()
    };
    let mut scan = Scan::of(head, &[0x1234, 0xFFEF, 0xFFFE, 0xFFFF, 0xFFFD]);
    let arrays = scan.arrays();
    arrays.angles.copy_from_slice(&[-0.125, -1.5, -3.25, f32::NAN, -6.5]);
    arrays.wide.copy_from_slice(&[0x0ABC, 1, 0, 0, 0x0FFF]);
    let expected = golden(
        104,
        &[
            (0, &(-0.25_f64).to_le_bytes()),
            (8, &(-1.5_f64).to_le_bytes()),
            (16, &0.75_f32.to_le_bytes()),
            (20, &[4, 3, 2, 1]),
            (24, &[0xFE, 0xFF, 0xFF, 0xFF, 250, 0, 0, 0]),
            (32, &[5, 0, 0xEF, 0xFF, 0xFE, 0xFF, 0xFD, 0xFF]),
            (40, &[6, 5, 1, 1, 6, 12, 1]),
            (64, &[0, 0, 0, 0xBE, 0, 0, 0xC0, 0xBF, 0, 0, 0x50, 0xC0, 0, 0, 0xC0, 0x7F, 0, 0, 0xD0, 0xC0]),
            (84, &[0x34, 0x12, 0xEF, 0xFF, 0xFE, 0xFF, 0xFF, 0xFF, 0xFD, 0xFF]),
            (94, &[0xBC, 0x0A, 1, 0, 0, 0, 0, 0, 0xFF, 0x0F]),
        ],
    );
    assert_eq!(scan.bytes(), expected);
    assert_eq!(read_vector("scan_turn"), expected);
}

/// Meanings of the values above the ranges, for an LMS and for all other families.
#[test]
fn code_and_family_names_are_unchanged() {
    let word = |code: Option<Code>| code.map(Code::name);
    let lms =
        Scan::of(ScanHead::lms(9, 0, 1000, 10, 13), &[8191, 8190, 8189, 8188, 8187, 8186, 8185, 8184, 8183]);
    let words: Vec<_> = (0..9).map(|i| word(lms.code(i)).unwrap()).collect();
    let expected = "no_return too_bright overflow overflow weak error overflow overflow beyond";
    assert_eq!(words.join(" "), expected);
    let head = ScanHead { family: Family::Ld as u8, valid_to: 0xFFEF, ..ScanHead::default() };
    let ranges: Vec<u16> = (0xFFEF..=0xFFFF).rev().collect();
    let other = Scan::of(head, &ranges);
    let words: Vec<_> = (0..16).map(|i| word(other.code(i)).unwrap()).collect();
    let expected = "not_measured no_return beyond too_near too_bright weak overflow error";
    assert_eq!(words[..8].join(" "), expected);
    assert!(words[8..].iter().all(|word| *word == "error"));
    assert_eq!((other.code(16), other.range(16)), (None, Some(0xFFEF)));
    assert_eq!(
        Family::ALL.map(|family| (family as u8, family.name())),
        [(0, "lms"), (1, "ld"), (2, "rplidar")]
    );
}

#[test]
fn early_layout_is_unchanged() {
    assert_eq!((size_of::<Early>(), align_of::<Early>()), (12, 4));
    assert_eq!((offset_of!(Early, verdict), offset_of!(Early, flags), offset_of!(Early, beam)), (0, 1, 2));
    assert_eq!(
        (offset_of!(Early, distance_mm), offset_of!(Early, bytes_seen), offset_of!(Early, beams_seen)),
        (4, 8, 10)
    );
}

#[test]
fn early_bytes_match_the_vector() {
    let early = Early {
        verdict: Verdict::Stop as u8,
        flags: Early::WITHDRAWN,
        beam: 0x0102,
        distance_mm: 0x0304_0506,
        bytes_seen: 0x0708,
        beams_seen: 0x090A,
    };
    let expected = golden(12, &[(0, &[2, 1, 2, 1, 6, 5, 4, 3, 8, 7, 0x0A, 9])]);
    assert_eq!(bytemuck::bytes_of(&early), expected);
    assert_eq!(bytemuck::bytes_of(&early), read_vector("early"));
}

#[test]
fn lines_layout_is_unchanged() {
    assert_eq!((size_of::<Lines>(), align_of::<Lines>()), (3340, 4));
    assert_eq!((offset_of!(Lines, count), offset_of!(Lines, corners), offset_of!(Lines, flags)), (0, 1, 2));
    assert_eq!(
        (offset_of!(Lines, readings), offset_of!(Lines, on_lines), offset_of!(Lines, noise_m)),
        (4, 6, 8)
    );
    assert_eq!((offset_of!(Lines, line_array), offset_of!(Lines, corner_array)), (12, 2572));
    assert_eq!((size_of::<Line>(), align_of::<Line>(), MAX_LINES), (40, 4, 64));
    assert_eq!((offset_of!(Line, x1_m), offset_of!(Line, y1_m), offset_of!(Line, x2_m)), (0, 4, 8));
    assert_eq!((offset_of!(Line, y2_m), offset_of!(Line, r_m), offset_of!(Line, alpha_rad)), (12, 16, 20));
    assert_eq!(
        (offset_of!(Line, sd_r_m), offset_of!(Line, sd_alpha_rad), offset_of!(Line, first)),
        (24, 28, 32)
    );
    assert_eq!((offset_of!(Line, last), offset_of!(Line, points), offset_of!(Line, reserved)), (34, 36, 38));
    assert_eq!((size_of::<Corner>(), align_of::<Corner>()), (12, 4));
    assert_eq!((offset_of!(Corner, x_m), offset_of!(Corner, y_m)), (0, 4));
    assert_eq!((offset_of!(Corner, first_line), offset_of!(Corner, second_line)), (8, 10));
}

#[test]
fn lines_bytes_match_the_vector() {
    let mut lines = Lines {
        count: 64,
        corners: 64,
        flags: Lines::OVERFLOW,
        readings: 0x0102,
        on_lines: 0x0304,
        noise_m: 1.0,
        ..Lines::default()
    };
    lines.line_array[63] = Line {
        x1_m: 1.0,
        y1_m: -1.0,
        x2_m: 2.0,
        y2_m: -2.0,
        r_m: 0.5,
        alpha_rad: -0.5,
        sd_r_m: 0.25,
        sd_alpha_rad: 4.0,
        first: 0x0506,
        last: 0x0708,
        points: 0x090A,
        reserved: 0,
    };
    lines.corner_array[63] = Corner { x_m: 1.0, y_m: -1.0, first_line: 62, second_line: 63 };
    let line = [
        0, 0, 0x80, 0x3F, 0, 0, 0x80, 0xBF, 0, 0, 0, 0x40, 0, 0, 0, 0xC0, 0, 0, 0, 0x3F, 0, 0, 0, 0xBF, 0, 0,
        0x80, 0x3E, 0, 0, 0x80, 0x40, 6, 5, 8, 7, 0x0A, 9,
    ];
    let corner = [0, 0, 0x80, 0x3F, 0, 0, 0x80, 0xBF, 62, 0, 63];
    let head = [64, 64, 1, 0, 2, 1, 4, 3, 0, 0, 0x80, 0x3F];
    let expected = golden(3340, &[(0, &head), (12 + 63 * 40, &line), (2572 + 63 * 12, &corner)]);
    assert_eq!(bytemuck::bytes_of(&lines), expected);
    assert_eq!(bytemuck::bytes_of(&lines), read_vector("lines"));
}

#[test]
fn motion_layout_is_unchanged() {
    assert_eq!((size_of::<Motion>(), align_of::<Motion>()), (120, 8));
    assert_eq!((offset_of!(Motion, x_m), offset_of!(Motion, y_m), offset_of!(Motion, yaw_rad)), (0, 8, 16));
    assert_eq!(
        (offset_of!(Motion, dx_m), offset_of!(Motion, dy_m), offset_of!(Motion, dyaw_rad)),
        (24, 28, 32)
    );
    assert_eq!((offset_of!(Motion, covariance), offset_of!(Motion, overlap)), (36, 72));
    assert_eq!(
        (offset_of!(Motion, method), offset_of!(Motion, flags), offset_of!(Motion, refused_steps)),
        (76, 77, 78)
    );
    assert_eq!((offset_of!(Motion, pose_covariance), offset_of!(Motion, reserved)), (80, 116));
    let names = MotionMethod::ALL.map(MotionMethod::name);
    assert_eq!(names.join(" "), "first refused beams points lines both");
}

#[test]
fn motion_bytes_match_the_vector() {
    let motion = Motion {
        x_m: 1.0,
        y_m: -2.0,
        yaw_rad: 0.5,
        dx_m: 0.25,
        dy_m: -0.125,
        dyaw_rad: -0.0625,
        covariance: std::array::from_fn(|i| (i + 1) as f32 / 64.0),
        overlap: 0.75,
        method: MotionMethod::Both as u8,
        flags: Motion::DEGENERATE,
        refused_steps: 0x0102,
        pose_covariance: std::array::from_fn(|i| -((i + 1) as f32) / 32.0),
        reserved: 0,
    };
    let [x, y, yaw] = [1.0_f64, -2.0, 0.5].map(f64::to_le_bytes);
    let step = [0.25_f32, -0.125, -0.0625].map(f32::to_le_bytes);
    let covariance: [f32; 9] = std::array::from_fn(|i| (i + 1) as f32 / 64.0);
    let covariance = covariance.map(f32::to_le_bytes);
    let of_pose: [f32; 9] = std::array::from_fn(|i| -((i + 1) as f32) / 32.0);
    let of_pose = of_pose.map(f32::to_le_bytes);
    let expected = golden(
        120,
        &[
            (0, &x),
            (8, &y),
            (16, &yaw),
            (24, step.as_flattened()),
            (36, covariance.as_flattened()),
            (72, &0.75_f32.to_le_bytes()),
            (76, &[5, 1, 2, 1]),
            (80, of_pose.as_flattened()),
        ],
    );
    assert_eq!(bytemuck::bytes_of(&motion), expected);
    assert_eq!(read_vector("motion"), expected);
}

#[test]
fn tilt_layout_is_unchanged() {
    assert_eq!((size_of::<Tilt>(), align_of::<Tilt>()), (16, 8));
    assert_eq!((offset_of!(Tilt, angle_rad), offset_of!(Tilt, rate_rad_s)), (0, 8));
}

#[test]
fn tilt_bytes_match_the_vector() {
    let tilt = Tilt { angle_rad: -0.5, rate_rad_s: 2.0 };
    let expected = golden(16, &[(6, &[0xE0, 0xBF]), (15, &[0x40])]);
    assert_eq!(bytemuck::bytes_of(&tilt), expected);
    assert_eq!(bytemuck::bytes_of(&tilt), read_vector("tilt"));
}

#[test]
fn cloud_layout_is_unchanged() {
    assert_eq!((size_of::<CloudHead>(), align_of::<CloudHead>(), Cloud::HEAD), (16, 4, 16));
    assert_eq!((size_of::<CloudWord>(), align_of::<CloudWord>()), (8, 8));
    assert_eq!((offset_of!(CloudHead, sweep), offset_of!(CloudHead, generation)), (0, 4));
    assert_eq!((offset_of!(CloudHead, count), offset_of!(CloudHead, flags)), (8, 10));
    assert_eq!(offset_of!(CloudHead, reserved), 11);
    assert_eq!((size_of::<CloudPoint>(), align_of::<CloudPoint>()), (16, 4));
    assert_eq!((offset_of!(CloudPoint, at), offset_of!(CloudPoint, beam)), (0, 12));
    assert_eq!((offset_of!(CloudPoint, point_class), offset_of!(CloudPoint, reserved)), (14, 15));
    assert_eq!(Cloud::len(401), 6432);
}

#[test]
fn cloud_bytes_match_the_vector() {
    let head = CloudHead {
        sweep: 0x0102_0304,
        generation: 0x0506_0708,
        flags: Cloud::FIRST | Cloud::LAST | Cloud::COMPLETE | Cloud::UNRELIABLE,
        ..CloudHead::default()
    };
    let point_class = PointClass::Behind as u8;
    let point = CloudPoint { at: [1.0, -1.0, 0.5], beam: 0x0102, point_class, reserved: 0 };
    let cloud = Cloud::of(head, &[CloudPoint::default(), point]);
    let point = [0, 0, 0x80, 0x3F, 0, 0, 0x80, 0xBF, 0, 0, 0, 0x3F, 2, 1, 3];
    let expected = golden(48, &[(0, &[4, 3, 2, 1, 8, 7, 6, 5, 2, 0, 15]), (32, &point)]);
    assert_eq!(cloud.bytes(), expected);
    assert_eq!(cloud.bytes(), read_vector("cloud"));
}

#[test]
fn obstacles_layout_is_unchanged() {
    assert_eq!((size_of::<Obstacles>(), align_of::<Obstacles>(), MAX_OBSTACLES), (3088, 4, 64));
    assert_eq!((offset_of!(Obstacles, sweep), offset_of!(Obstacles, generation)), (0, 4));
    assert_eq!((offset_of!(Obstacles, dropped), offset_of!(Obstacles, count)), (8, 12));
    assert_eq!((offset_of!(Obstacles, flags), offset_of!(Obstacles, reserved)), (13, 14));
    assert_eq!(offset_of!(Obstacles, obstacle_array), 16);
    assert_eq!((size_of::<Obstacle>(), align_of::<Obstacle>()), (48, 4));
    assert_eq!((offset_of!(Obstacle, middle), offset_of!(Obstacle, low)), (0, 12));
    assert_eq!((offset_of!(Obstacle, high), offset_of!(Obstacle, distance_m)), (24, 36));
    assert_eq!((offset_of!(Obstacle, points), offset_of!(Obstacle, flags)), (40, 44));
    assert_eq!(offset_of!(Obstacle, reserved), 45);
}

#[test]
fn obstacles_bytes_match_the_vector() {
    let mut found = Obstacles {
        sweep: 0x0102_0304,
        generation: 0x0506_0708,
        dropped: 0x090A_0B0C,
        count: 63,
        flags: Obstacles::COMPLETE | Obstacles::UNRELIABLE,
        ..Obstacles::default()
    };
    found.push(Obstacle {
        middle: [1.0, -1.0, 0.5],
        low: [0.5, -2.0, 0.25],
        high: [2.0, -0.5, 4.0],
        distance_m: 0.5,
        points: 0x0D0E_0F10,
        flags: Obstacle::FOREGROUND | Obstacle::NEAR,
        ..Obstacle::default()
    });
    let obstacle = [
        0, 0, 0x80, 0x3F, 0, 0, 0x80, 0xBF, 0, 0, 0, 0x3F, 0, 0, 0, 0x3F, 0, 0, 0, 0xC0, 0, 0, 0x80, 0x3E, 0,
        0, 0, 0x40, 0, 0, 0, 0xBF, 0, 0, 0x80, 0x40, 0, 0, 0, 0x3F, 0x10, 0x0F, 0x0E, 0x0D, 3,
    ];
    let head = [4, 3, 2, 1, 8, 7, 6, 5, 0x0C, 0x0B, 0x0A, 9, 64, 12];
    let expected = golden(3088, &[(0, &head[..]), (16 + 63 * 48, &obstacle)]);
    assert_eq!(bytemuck::bytes_of(&found), expected);
    assert_eq!(bytemuck::bytes_of(&found), read_vector("obstacles"));
}

#[test]
fn tracks_layout_is_unchanged() {
    assert_eq!((size_of::<Tracks>(), align_of::<Tracks>(), MAX_TRACKS, MAX_TRACK_SENSORS), (7432, 8, 64, 32));
    assert_eq!(
        (offset_of!(Tracks, count), offset_of!(Tracks, sensors), offset_of!(Tracks, reserved)),
        (0, 1, 2)
    );
    assert_eq!((offset_of!(Tracks, track_array), offset_of!(Tracks, sensor_array)), (8, 5128));
    assert_eq!((size_of::<Track>(), align_of::<Track>()), (80, 8));
    assert_eq!((offset_of!(Track, id), offset_of!(Track, x_m), offset_of!(Track, y_m)), (0, 8, 12));
    assert_eq!((offset_of!(Track, vx_m_s), offset_of!(Track, vy_m_s)), (16, 20));
    assert_eq!((offset_of!(Track, covariance), offset_of!(Track, score)), (24, 36));
    assert_eq!((offset_of!(Track, age_ms), offset_of!(Track, sensors)), (40, 44));
    assert_eq!(
        (offset_of!(Track, room_text), offset_of!(Track, state), offset_of!(Track, reserved)),
        (48, 72, 73)
    );
    assert_eq!((size_of::<TrackSensor>(), align_of::<TrackSensor>()), (72, 4));
    assert_eq!((offset_of!(TrackSensor, x_m), offset_of!(TrackSensor, y_m)), (0, 4));
    assert_eq!((offset_of!(TrackSensor, yaw_rad), offset_of!(TrackSensor, upside_down)), (8, 12));
    assert_eq!((offset_of!(TrackSensor, reserved), offset_of!(TrackSensor, name_text)), (13, 16));
}

#[test]
fn event_layout_is_unchanged() {
    assert_eq!((size_of::<Event>(), align_of::<Event>()), (112, 8));
    assert_eq!((offset_of!(Event, id), offset_of!(Event, kind), offset_of!(Event, reserved)), (0, 8, 9));
    assert_eq!((offset_of!(Event, room_text), offset_of!(Event, door_text)), (16, 40));
    assert_eq!((offset_of!(Event, from_text), offset_of!(Event, to_text)), (64, 88));
}

#[test]
fn tracks_bytes_match_the_vector() {
    let mut tracks = Tracks { count: 64, sensors: 31, ..Tracks::default() };
    let pose = Pose { x_m: 1.0, y_m: -1.0, yaw_rad: 0.5, upside_down: 1, ..Pose::default() };
    tracks.push_sensor(TrackSensor::new("kitchen.rear", &pose));
    let track = &mut tracks.track_array[63];
    *track = Track {
        id: 0x0102_0304_0506_0708,
        x_m: 1.0,
        y_m: -1.0,
        vx_m_s: 2.0,
        vy_m_s: -2.0,
        covariance: [0.5, -0.5, 0.25],
        score: 4.0,
        age_ms: 0x0A0B_0C0D,
        sensors: 0x8000_0001,
        state: TrackState::BetweenRooms as u8,
        ..Track::default()
    };
    track.set_room("hall");
    let bytes = [
        8, 7, 6, 5, 4, 3, 2, 1, 0, 0, 0x80, 0x3F, 0, 0, 0x80, 0xBF, 0, 0, 0, 0x40, 0, 0, 0, 0xC0, 0, 0, 0,
        0x3F, 0, 0, 0, 0xBF, 0, 0, 0x80, 0x3E, 0, 0, 0x80, 0x40, 0x0D, 0x0C, 0x0B, 0x0A, 1, 0, 0, 0x80, b'h',
        b'a', b'l', b'l',
    ];
    let mut sensor = vec![0, 0, 0x80, 0x3F, 0, 0, 0x80, 0xBF, 0, 0, 0, 0x3F, 1, 0, 0, 0];
    sensor.extend(b"kitchen.rear");
    let last = 8 + 63 * 80;
    let fields = [(0, &[64, 32][..]), (last, &bytes), (last + 72, &[3]), (5128 + 31 * 72, &sensor)];
    let expected = golden(7432, &fields);
    assert_eq!(bytemuck::bytes_of(&tracks), expected);
    assert_eq!(bytemuck::bytes_of(&tracks), read_vector("tracks"));
}

#[test]
fn event_bytes_match_the_vector() {
    let event = Event::new(EventKind::Door, 0x0102_0304_0506_0708, Some("kitchen"))
        .with_door("left", "hall", "kitchen");
    let fields = [
        (0, &[8, 7, 6, 5, 4, 3, 2, 1, 2][..]),
        (16, b"kitchen"),
        (40, b"left"),
        (64, b"hall"),
        (88, b"kitchen"),
    ];
    assert_eq!(bytemuck::bytes_of(&event), golden(112, &fields));
    assert_eq!(bytemuck::bytes_of(&event), read_vector("event"));
}
