//! Golden size, offsets and bytes of topics `tracks` and `events`.

use std::mem::{offset_of, size_of};

use scanhub_schema::{Event, EventKind, Pose, TRACK_SENSORS, TRACKS, Track, TrackSensor, TrackState, Tracks};

use super::{golden, shared};

#[test]
fn tracks_layout() {
    assert_eq!((size_of::<Tracks>(), align_of::<Tracks>(), TRACKS, TRACK_SENSORS), (7432, 8, 64, 32));
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
fn event_layout() {
    assert_eq!((size_of::<Event>(), align_of::<Event>()), (112, 8));
    assert_eq!((offset_of!(Event, id), offset_of!(Event, kind), offset_of!(Event, reserved)), (0, 8, 9));
    assert_eq!((offset_of!(Event, room_text), offset_of!(Event, door_text)), (16, 40));
    assert_eq!((offset_of!(Event, from_text), offset_of!(Event, to_text)), (64, 88));
}

#[test]
fn tracks_bytes() {
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
    assert_eq!(bytemuck::bytes_of(&tracks), shared("tracks.hex"));
}

#[test]
fn event_bytes() {
    let event = Event::new(EventKind::Door, 0x0102_0304_0506_0708, Some("kitchen"))
        .through("left", "hall", "kitchen");
    let fields = [
        (0, &[8, 7, 6, 5, 4, 3, 2, 1, 2][..]),
        (16, b"kitchen"),
        (40, b"left"),
        (64, b"hall"),
        (88, b"kitchen"),
    ];
    assert_eq!(bytemuck::bytes_of(&event), golden(112, &fields));
    assert_eq!(bytemuck::bytes_of(&event), shared("event.hex"));
}
