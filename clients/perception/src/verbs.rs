//! Verbs of this crate, each with its arguments and a function `run`. The verbs subscribe to a hub, and print and
//! publish the results of [`track`](mod@crate::track) and [`tilt`](mod@crate::tilt).

mod results;
mod site;
mod tilt;
mod track;

pub use site::SiteArgs;
pub use tilt::TiltArgs;
pub use track::TrackArgs;

/// Parses a name under which topics are published. The name must be valid as the name of a sensor.
fn own_name(name: &str) -> Result<String, String> {
    scanhub_schema::check_sensor(name).map(|()| name.to_owned()).map_err(|failure| format!("{failure}"))
}
