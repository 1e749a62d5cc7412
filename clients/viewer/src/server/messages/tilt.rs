//! The angle of a mount as an object of JSON. Refuses to know what is mounted on it.

use scanhub_schema::Tilt;
use serde::Serialize;

use super::{beside_scan, bytes, json};
use crate::server::board::Channel;

/// The angles of `mount`, see [`tilt`].
pub fn tilt_channel(mount: &str) -> Channel {
    let schema = include_str!("tilt.json");
    Channel { is_kept: false, ..json(beside_scan(mount, "tilt"), "scanhub.Tilt", schema) }
}

/// How a mount stands, and how fast it turns if that is known.
pub fn tilt(said: &Tilt) -> Vec<u8> {
    #[derive(Serialize)]
    struct Told {
        angle_deg: f64,
        rate_deg_s: Option<f64>,
    }
    bytes(&Told {
        angle_deg: said.angle_rad.to_degrees(),
        rate_deg_s: said.rate_rad_s().map(f64::to_degrees),
    })
}
