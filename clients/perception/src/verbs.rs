//! The verbs of this crate: each has a struct with its arguments, and `run`. They subscribe to a hub, and print and publish the
//! results of [`track`](mod@crate::track) and [`tilt`](mod@crate::tilt).

mod results;
mod site;
mod tilt;
mod track;

pub use site::SiteArgs;
pub use tilt::TiltArgs;
pub use track::TrackArgs;

/// Parses a name that topics are published under. A sensor may have it, too.
fn own_name(name: &str) -> Result<String, String> {
    scanhub_schema::check_sensor(name).map(|()| name.to_owned()).map_err(|failure| format!("{failure}"))
}
