//! Where people are and whither they walk, as `geometry_msgs/msg/PoseArray`. Refuses to know how they are drawn.

use scanhub_schema::{Header, TrackState, Tracks};

use crate::cdr::Cdr;

/// Writes the people of `tracks` who are known, in the map called `frame`, to the end of `message`: each looks whither it walks, or
/// along x if it stands.
pub fn people_poses(message: &mut Vec<u8>, frame: &str, header: &Header, tracks: &Tracks) {
    let known = || tracks.tracks().iter().filter(|track| track.state() != TrackState::Tentative);
    let mut cdr = Cdr::begin(message);
    cdr.header(header.wall_ns, frame);
    cdr.u32(known().count() as u32);
    for track in known() {
        let [x, y, ahead, aside] = [track.x_m, track.y_m, track.vx_m_s, track.vy_m_s].map(f64::from);
        let walks = ahead.hypot(aside) >= WALKS_M_S;
        let (sin, cos) = if walks { (aside.atan2(ahead) / 2.0).sin_cos() } else { (0.0, 1.0) };
        [x, y, 0.0, 0.0, 0.0, sin, cos].into_iter().for_each(|value| cdr.f64(value));
    }
}

/// Who is slower stands.
const WALKS_M_S: f64 = 0.2;

#[cfg(test)]
mod tests {
    use scanhub_schema::Track;

    use super::*;
    use crate::{POSE_ARRAY, Value, read};

    #[test]
    fn people_look_whither_they_walk() {
        let mut tracks = Tracks::default();
        for (state, vy_m_s) in [(1, 1.0), (0, 1.0), (2, 0.1)] {
            tracks.push(Track { x_m: 2.0, y_m: -0.5, vy_m_s, state, ..Track::default() });
        }
        let header = Header { wall_ns: 3_000_000_005, ..Header::default() };
        let mut message = Vec::new();
        people_poses(&mut message, "house", &header, &tracks);
        let told = read(&POSE_ARRAY, &message).unwrap();
        assert_eq!(told.sequence("poses").map(<[Value]>::len), Some(2), "nobody who is tentative");
        assert_eq!(told.text("header.frame_id"), Some("house"));
        assert_eq!(
            (told.number("poses.0.position.x"), told.number("poses.0.position.y")),
            (Some(2.0), Some(-0.5))
        );
        // A quarter turn to the left.
        let half = std::f64::consts::FRAC_1_SQRT_2;
        for axis in ["z", "w"] {
            let value = told.number(&format!("poses.0.orientation.{axis}")).unwrap();
            assert!((value - half).abs() < 1e-12, "{axis}: {value}");
        }
        assert_eq!(told.number("poses.1.orientation.w"), Some(1.0));
    }
}
