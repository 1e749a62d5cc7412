//! Values of the golden datagrams.

use bytemuck::Zeroable;
use scanhub_schema::datagram::{Announce, Announced, DatagramPayload, Head, LanFlags};
use scanhub_schema::{
    ArrayFlags, Background, BackgroundHead, Cloud, CloudHead, CloudPoint, Code, Corner, Counter, Counters,
    Early, Event, EventKind, Family, Foreground, ForegroundHead, Line, Lines, MAX_COUNTERS, Mark, Marks,
    Motion, MotionMethod, Obstacle, Obstacles, PointClass, Pose, Scan, ScanHead, Segment, State, Status,
    Tilt, Topic, Track, TrackSensor, TrackState, Tracks, Verdict, Zone, Zones,
};

/// Name in the list of golden datagrams, header, and function that writes the payload.
pub(crate) type GoldenDatagram = (&'static str, Head, fn(&mut [u8]) -> Option<usize>);

/// Datagrams that a gateway of this version sends.
pub(crate) const GOLDEN_DATAGRAMS: [GoldenDatagram; 22] = [
    ("announce", Head { sequence: 7, counter: 0, ..head(None) }, announce),
    ("telegram", Head { sequence: u32::MAX, ..head(Some(Topic::Telegram)) }, telegram),
    ("packets", Head { sequence: 5, family: Family::Ld as u8, ..head(Some(Topic::Telegram)) }, packets),
    ("scan", Head { flags: LanFlags::SUSPECT, ..head(Some(Topic::Scan)) }, |room| {
        scan(361, -90_000, 500, 0).pack(room)
    }),
    (
        "scan_intensities",
        Head { flags: LanFlags::SIMULATED, sequence: 2, ..head(Some(Topic::Scan)) },
        |room| scan(401, -50_000, 250, 3).pack(room),
    ),
    ("scan_turn", Head { sequence: 3, family: Family::Ld as u8, ..head(Some(Topic::Scan)) }, |room| {
        full_circle_scan().pack(room)
    }),
    ("marks", head(Some(Topic::Marks)), |room| marks().pack(room)),
    ("zones", ZONES_HEAD, |room| zones().pack(room)),
    ("zones_unknown", Head { sequence: 5001, ..ZONES_HEAD }, |room| {
        Zones { invalid_beams: 361, flags: Zones::PROVISIONAL, ..Zones::unknown() }.pack(room)
    }),
    ("foreground", head(Some(Topic::Foreground)), |room| foreground().pack(room)),
    ("background", Head { flags: LanFlags::REPLAYED, ..head(Some(Topic::Background)) }, |room| {
        background().pack(room)
    }),
    (
        "status",
        Head { flags: LanFlags::STAMP_ESTIMATED, counter: u32::MAX, ..head(Some(Topic::Status)) },
        |room| status().pack(room),
    ),
    ("lines", head(Some(Topic::Lines)), |room| lines().pack(room)),
    ("motion", Head { revision: 2, ..head(Some(Topic::Motion)) }, |room| motion().pack(room)),
    ("early", head(Some(Topic::Early)), |room| EARLY_WARNING.pack(room)),
    ("early_withdrawn", head(Some(Topic::Early)), |room| {
        Early { flags: Early::WITHDRAWN, ..EARLY_WARNING }.pack(room)
    }),
    ("tracks", head(Some(Topic::Tracks)), |room| tracks().pack(room)),
    ("events", head(Some(Topic::Events)), |room| {
        Event::new(EventKind::Door, 3, Some("kitchen")).with_door("left", "hall", "kitchen").pack(room)
    }),
    ("tilt", head(Some(Topic::Tilt)), |room| Tilt { angle_rad: -0.40625, rate_rad_s: 0.53125 }.pack(room)),
    ("tilt_no_rate", Head { sequence: 2, ..head(Some(Topic::Tilt)) }, |room| {
        Tilt { angle_rad: 0.125, ..Tilt::default() }.pack(room)
    }),
    ("cloud", head(Some(Topic::Cloud)), |room| cloud().pack(room)),
    ("obstacles", head(Some(Topic::Obstacles)), |room| obstacles().pack(room)),
];

fn tracks() -> Tracks {
    let mut tracks = Tracks::default();
    let pose = Pose { x_m: 12.5, y_m: -0.5, yaw_rad: 1.5, upside_down: 1, ..Pose::default() };
    for (name, pose) in [("front", Pose::default()), ("kitchen.rear", pose)] {
        tracks.push_sensor(TrackSensor::new(name, &pose));
    }
    let mut first = Track {
        id: 3,
        x_m: 1.5,
        y_m: -2.25,
        vx_m_s: 0.75,
        vy_m_s: -0.125,
        covariance: [0.007_812_5, 0.0, 0.003_906_25],
        score: 0.9375,
        age_ms: 12_345,
        sensors: 3,
        state: TrackState::Confirmed as u8,
        ..Track::default()
    };
    first.set_room("hall");
    let mut second = Track {
        id: (1 << 32) + 1,
        x_m: 9.5,
        y_m: 2.0,
        covariance: [0.5, 0.125, 0.25],
        score: 0.5,
        age_ms: 600_000,
        state: TrackState::BetweenRooms as u8,
        ..Track::default()
    };
    second.set_room("Küche");
    tracks.push(first);
    tracks.push(second);
    tracks
}

const EARLY_WARNING: Early = Early {
    verdict: Verdict::Slow as u8,
    flags: 0,
    beam: 117,
    distance_mm: 80_012,
    bytes_seen: 303,
    beams_seen: 148,
};

/// Header of a datagram with `zones`.
pub(crate) const ZONES_HEAD: Head = Head { sequence: 5000, ..head(Some(Topic::Zones)) };

const fn head(topic: Option<Topic>) -> Head {
    Head {
        part: 0,
        parts: 1,
        family: Family::Lms as u8,
        topic: match topic {
            Some(topic) => topic as u8 + 1,
            None => Announce::NUMBER,
        },
        flags: 0,
        hub: 0x1122_3344_5566_7788,
        epoch: 1_700_000_000,
        sequence: 1,
        stamp_ns: 1_700_000_123_456_789_012,
        sensor: 1,
        revision: 1,
        counter: 4660,
    }
}

const SCANNER_TYPE: &str = "LMS200;301063;V02.30";

fn announce(buffer: &mut [u8]) -> Option<usize> {
    let mut announce = Announce::new(0x99AA_BBCC_DDEE_FF00, "front", SCANNER_TYPE);
    for (topic, next) in [(Topic::Scan, u32::MAX - 1), (Topic::Zones, 5001), (Topic::Status, 3)] {
        let group = scanhub_schema::datagram::group(topic);
        announce.add(Announced { topic: topic.number(), group, port: 22_200, next });
    }
    announce.pack(buffer)
}

/// Writes the example packet in the manual of the LD06, twice.
fn packets(buffer: &mut [u8]) -> Option<usize> {
    const PACKET: [u8; 47] = [
        0x54, 0x2C, 0x68, 0x08, 0xAB, 0x7E, 0xE0, 0x00, 0xE4, 0xDC, 0x00, 0xE2, 0xD9, 0x00, 0xE5, 0xD5, 0x00,
        0xE3, 0xD3, 0x00, 0xE4, 0xD0, 0x00, 0xE9, 0xCD, 0x00, 0xE4, 0xCA, 0x00, 0xE2, 0xC7, 0x00, 0xE9, 0xC5,
        0x00, 0xE5, 0xC2, 0x00, 0xE5, 0xC0, 0x00, 0xE5, 0xBE, 0x82, 0x3A, 0x1A, 0x50,
    ];
    [PACKET, PACKET].concat().pack(buffer)
}

fn telegram(buffer: &mut [u8]) -> Option<usize> {
    let telegram = [0x02, 0x80, 0x03, 0x00, 0xA0, 0x00, 0x10, 0x16, 0x0A];
    buffer[..telegram.len()].copy_from_slice(&telegram);
    Some(telegram.len())
}

/// Returns a scan in which every 60th beam has a code. If there are no intensities, all upper bits are 0.
fn scan(count: u16, first_angle_mdeg: i32, step_mdeg: u32, intensity_bits: u8) -> Box<Scan> {
    let head = ScanHead::lms(count.into(), first_angle_mdeg, step_mdeg, 1, 13);
    let range = |i| if i % 60 == 0 { 0x1FFF - i / 60 } else { 1000 + 37 * i % 7000 };
    let ranges: Vec<u16> = (0..count).map(range).collect();
    let mut scan = Scan::of(ScanHead { intensity_bits, ..head }, &ranges);
    for (i, upper) in scan.arrays().upper.iter_mut().enumerate() {
        *upper = if intensity_bits > 0 { (i % 8) as u8 } else { 0 };
    }
    scan
}

/// Returns eight beams of a clockwise revolution with all arrays. Every second beam has a code. The first of these
/// codes is `not_measured`.
fn full_circle_scan() -> Box<Scan> {
    let head = ScanHead {
        first_angle: -0.375,
        step: -0.75,
        spacing: 0.0625,
        beam_time_ns: 12_500_000,
        first_beam_ns: -3,
        unit_um: 250,
        valid_to: 0xFFEF,
        no_return: Code::NoReturn.value(),
        beyond: Code::NoReturn.value(),
        collisions: 5,
        family: Family::Ld as u8,
        flags: Scan::INCOMPLETE,
        contents: ArrayFlags::ALL,
        intensity_bits: 16,
        turns: 1,
        ..ScanHead::default()
    };
    let code = [Scan::NOT_MEASURED, Code::NoReturn.value(), Code::Weak.value(), Code::Error.value()];
    let ranges: Vec<u16> = (0..8).map(|i| if i % 2 == 0 { code[i / 2] } else { 4000 + i as u16 }).collect();
    let mut scan = Scan::of(head, &ranges);
    let arrays = scan.arrays();
    for i in 0..8_u8 {
        let of = usize::from(i);
        arrays.angles[of] = if i == 0 { f32::NAN } else { -0.375 - 0.6875 * f32::from(i) };
        arrays.wide[of] = 1000 * u16::from(i);
        arrays.upper[of] = i;
    }
    scan
}

fn marks() -> Marks {
    let mut marks = Marks { count: 2, flags: Marks::OVERFLOW, ..Marks::default() };
    marks.mark_array[0] = Mark {
        angle_mdeg: -89_750,
        range_dmm: 12_345,
        weight: 11,
        peak: 5,
        edge: 1,
        first_beam: 0,
        last_beam: 2,
    };
    marks.mark_array[1] = Mark {
        angle_mdeg: 0,
        range_dmm: 79_999,
        weight: 7,
        peak: 7,
        edge: 0,
        first_beam: 180,
        last_beam: 180,
    };
    marks
}

/// Returns a motion whose numbers are exact as 32-bit floats.
fn motion() -> Motion {
    Motion {
        x_m: 12.5,
        y_m: -0.75,
        yaw_rad: 1.25,
        dx_m: 0.03125,
        dy_m: -0.0078125,
        dyaw_rad: 0.015625,
        covariance: [0.0625, 0.0, 0.0, 0.0, 0.03125, 0.0, 0.0, 0.0, 0.0078125],
        overlap: 0.875,
        method: MotionMethod::Lines as u8,
        flags: Motion::DEGENERATE,
        refused_steps: 2,
        pose_covariance: [0.5, 0.125, 0.0, 0.125, 0.25, 0.0, 0.0, 0.0, 0.015625],
        reserved: 0,
    }
}

/// Returns lines whose numbers are exact as 32-bit floats.
fn lines() -> Lines {
    let mut lines = Lines {
        count: 2,
        corners: 1,
        flags: Lines::OVERFLOW,
        readings: 361,
        on_lines: 350,
        noise_m: 0.0078125,
        ..Lines::default()
    };
    lines.line_array[0] = Line {
        x1_m: 0.0,
        y1_m: -2.5,
        x2_m: 4.0,
        y2_m: -2.5,
        r_m: 2.5,
        alpha_rad: -1.5703125,
        sd_r_m: 0.00390625,
        sd_alpha_rad: 0.001953125,
        first: 0,
        last: 115,
        points: 110,
        reserved: 0,
    };
    lines.line_array[1] = Line {
        x1_m: 4.0,
        y1_m: -2.5,
        x2_m: 4.0,
        y2_m: 3.0,
        r_m: 4.0,
        alpha_rad: 0.0,
        sd_r_m: 0.0009765625,
        sd_alpha_rad: 0.00048828125,
        first: 116,
        last: 360,
        points: 240,
        reserved: 0,
    };
    lines.corner_array[0] = Corner { x_m: 4.0, y_m: -2.5, first_line: 0, second_line: 1 };
    lines
}

fn zones() -> Zones {
    let mut zones = Zones {
        verdict: Verdict::Slow as u8,
        count: 2,
        nearest_beam: 180,
        nearest_mm: 733,
        invalid_beams: 4,
        ..Zones::unknown()
    };
    zones.zone_array[0] = Zone { radius_mm: 1000, beams: 17, violated: 1, reserved: [0; 3] };
    zones.zone_array[1] = Zone { radius_mm: 600, ..Zone::default() };
    zones
}

/// Returns a foreground with 64 segments of three beams each. Only 54 of these segments fit into a datagram.
fn foreground() -> Box<Foreground> {
    let mut foreground = Foreground::of(361);
    let head = ForegroundHead {
        generation: 9,
        unit_um: 1000,
        count: 361,
        beams: 192,
        segments: 64,
        dropped: 0,
        supported: 0x8123_4567_89AB_CDEF,
    };
    let arrays = foreground.begin(head);
    for s in 0..64_u16 {
        for k in 0..3 {
            let (at, beam) = (usize::from(3 * s + k), 5 * s + k);
            arrays.bits[usize::from(beam) / 8] |= 1 << (beam % 8);
            arrays.ranges[at] = 2000 + beam;
        }
        arrays.segments[usize::from(s)] = Segment {
            first: 5 * s,
            last: 5 * s + 2,
            nearest: 2000 + 5 * s,
            width: 30 + s,
            x_mm: i32::from(s) - 1000,
            y_mm: 1000 - 100 * i32::from(s),
        };
    }
    foreground
}

fn background() -> Box<Background> {
    let head = BackgroundHead {
        first_angle: -90_f64.to_radians(),
        step: 1_f64.to_radians(),
        generation: 9,
        unit_um: 10_000,
        known_beams: 162,
        flags: Background::FROZEN,
        ..BackgroundHead::default()
    };
    let range = |i: u16| match i % 10 {
        0 => Background::UNKNOWN,
        1 => Background::FAR,
        _ => 3000 + i,
    };
    Background::of(head, &(0..181).map(range).collect::<Vec<_>>())
}

fn status() -> Status {
    let mut counters = [0; MAX_COUNTERS];
    // Counters that were added after `line_errors` are 0 here.
    for (i, counter) in counters[..=Counter::LineErrors as usize].iter_mut().enumerate() {
        *counter = 1_000_000_000_000_000 + i as u64;
    }
    let mut status = Status {
        state: State::Streaming as u8,
        mode: 1,
        unit_mm: 1,
        baud: 500_000,
        since_ns: 123_456_789_012_345,
        rate_mhz: 37_538,
        angle_deg: 180,
        resolution_cdeg: 50,
        counters: Counters(counters),
        pose: Pose { x_m: 0.25, y_m: -0.125, yaw_rad: 1.5, upside_down: 1, ..Pose::zeroed() },
        ..Status::default()
    };
    status.set_sensor_type(SCANNER_TYPE);
    status.set_port("/dev/ttyUSB0");
    status.set_last_error("größer");
    status
}

fn cloud() -> Box<Cloud> {
    let point = |at, beam, class| CloudPoint { at, beam, point_class: class as u8, reserved: 0 };
    let flags = Cloud::FIRST | Cloud::COMPLETE;
    let points = [
        point([1.5, -2.25, 0.125], 0, PointClass::Background),
        point([1.25, 0.0, 0.5], 180, PointClass::Foreground),
        point([-0.5, 3.75, -0.0625], 360, PointClass::Unknown),
    ];
    Cloud::of(CloudHead { sweep: 12, generation: 3, flags, ..CloudHead::default() }, &points)
}

fn obstacles() -> Obstacles {
    let mut found = Obstacles {
        sweep: 12,
        generation: 3,
        dropped: 1,
        flags: Obstacles::COMPLETE,
        ..Obstacles::default()
    };
    found.push(Obstacle {
        middle: [1.25, 0.0, 0.5],
        low: [1.125, -0.125, 0.0],
        high: [1.375, 0.125, 1.0],
        distance_m: 1.125,
        points: 120,
        flags: Obstacle::FOREGROUND | Obstacle::NEAR,
        ..Obstacle::default()
    });
    found.push(Obstacle {
        middle: [4.0, -1.5, 0.75],
        low: [3.875, -1.75, 0.0],
        high: [4.25, -1.25, 1.75],
        distance_m: 4.1875,
        points: 64,
        flags: Obstacle::FOREGROUND,
        ..Obstacle::default()
    });
    found
}
