//! Golden size, offsets and bytes of every payload of version 1. Do not change these tests: another layout is another
//! version.

use std::mem::{offset_of, size_of};

use schema::{
    BEAMS, COUNTERS, Counter, Counters, Failure, Header, Kind, Request, Response, Scan, State, Status, Verb,
};

/// Builds the expected bytes: `size` zeros with `fields` written over them.
fn golden(size: usize, fields: &[(usize, &[u8])]) -> Vec<u8> {
    let mut bytes = vec![0; size];
    for &(offset, field) in fields {
        bytes[offset..offset + field.len()].copy_from_slice(field);
    }
    bytes
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
    assert_eq!(offset_of!(Header, reserved), 61);
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
        reserved: [0; 3],
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
            (60, &[0x12]),
        ],
    );
    assert_eq!(bytemuck::bytes_of(&header), expected);
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
}

#[test]
fn status_layout() {
    assert_eq!((size_of::<Status>(), align_of::<Status>()), (592, 8));
    assert_eq!((size_of::<Counters>(), COUNTERS), (256, 32));
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
        ],
    );
    assert_eq!(bytemuck::bytes_of(&status), expected);
}

#[test]
fn counters_in_order() {
    let names: Vec<_> = Counter::ALL.iter().map(|counter| counter.name()).collect();
    assert_eq!(
        names.join(" "),
        "bytes_read bytes_in_telegrams bytes_acknowledge bytes_discarded bytes_buffered telegrams suspect aborted \
         resyncs reconnects lost_in_restart wakeups loan_failed rejected_address rejected_length rejected_command \
         rejected_count rejected_crc rejected_vetoed rejected_superseded line_errors"
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
}

#[test]
fn response_bytes() {
    assert_eq!(Response(Ok(())).encode(), [0, 0, 0, 0]);
    let refused = Response(Err(Failure::new(Kind::Short, "busy", "wait")));
    assert_eq!(refused.encode(), b"\x4b\0\x09\0busy\nwait");
}
