//! The layouts of version 2 as text, for all languages: `tests/vectors/v2/layouts.txt` has a line for each struct, its type
//! name, size and alignment, and one for each of its fields, name and offset. What `v2.rs` holds fast is what stands there.

use std::fmt::Write as _;
use std::mem::{offset_of, size_of};

use schema::{
    BackgroundHead, CloudHead, CloudPoint, Corner, Early, Event, ForegroundHead, Header, Line, Lines, Mark,
    Marks, Motion, Obstacle, Obstacles, Pose, ScanHead, Segment, Status, Tilt, Track, TrackSensor, Tracks,
    Zone, Zones,
};

/// The lines of one struct.
macro_rules! layout {
    ($text:ident, $type:ident: $($field:ident)*) => {
        writeln!(
            $text,
            concat!("scanhub.", stringify!($type), ".v2 {} {}"),
            size_of::<$type>(),
            align_of::<$type>()
        )
        .expect("a String takes everything");
        $(writeln!($text, concat!("  ", stringify!($field), " {}"), offset_of!($type, $field))
            .expect("a String takes everything");)*
        // A field that is not named above does not compile.
        let _ = |value: $type| { let $type { $($field: _),* } = value; };
    };
}

#[test]
fn the_text_says_what_the_structs_are() {
    let mut text = String::new();
    layout!(text, Header: seq topic_seq stamp_first_ns stamp_last_ns wall_ns boot sensor quality flags family
        period_us hub_pid reasons hub_time);
    layout!(text, ScanHead: first_angle step spacing beam_time_ns first_beam_ns unit_um count valid_to no_return beyond
        collapsed family flags contents intensity_bits turns reserved turn_ns reserved2);
    layout!(text, Mark: angle_mdeg range_dmm weight peak edge first_beam last_beam);
    layout!(text, Marks: count flags reserved mark_array);
    layout!(text, Zone: radius_mm beams violated reserved);
    layout!(text, Zones: verdict count nearest_beam nearest_mm invalid_beams flags reserved zone_array);
    layout!(text, Segment: first last nearest width x_mm y_mm);
    layout!(text, ForegroundHead: generation unit_um count beams segments left_out supported);
    layout!(text, BackgroundHead: first_angle step generation unit_um taught count flags reserved);
    layout!(text, Pose: x_m y_m yaw_rad upside_down reserved);
    layout!(text, Status: state mode unit_mm family baud since_ns rate_mhz angle_deg resolution_cdeg type_text
        port_text last_error_text counters pose);
    layout!(text, Line: x1_m y1_m x2_m y2_m r_m alpha_rad sd_r_m sd_alpha_rad first last points reserved);
    layout!(text, Corner: x_m y_m first_line second_line);
    layout!(text, Lines: count corners flags reserved readings on_lines noise_m line_array corner_array);
    layout!(text, Motion: x_m y_m yaw_rad dx_m dy_m dyaw_rad covariance overlap method flags breaks
        pose_covariance reserved);
    layout!(text, Early: verdict flags beam distance_mm bytes_seen beams_seen);
    layout!(text, Track: id x_m y_m vx_m_s vy_m_s covariance score age_ms sensors room_text state reserved);
    layout!(text, TrackSensor: x_m y_m yaw_rad upside_down reserved name_text);
    layout!(text, Tracks: count sensors reserved track_array sensor_array);
    layout!(text, Event: id kind reserved room_text door_text from_text to_text);
    layout!(text, Tilt: angle_rad rate_rad_s);
    layout!(text, CloudHead: sweep generation count flags reserved);
    layout!(text, CloudPoint: at beam point_class reserved);
    layout!(text, Obstacle: middle low high distance_m points flags reserved);
    layout!(text, Obstacles: sweep generation left_out count flags reserved obstacle_array);
    let golden = include_str!("../../tests/vectors/v2/layouts.txt");
    assert_eq!(text, golden);
}
