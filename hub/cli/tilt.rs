//! `scanhub tilt` on the command line.

use std::time::Duration;

use clap::Args;
use scanhub_perception::tilt::{Mount, Settings};
use scanhub_perception::verbs::TiltOptions;
use scanhub_schema::Failure;
use scanhub_verbs::{Bounds, duration};

use super::Everywhere;

#[derive(Args, Debug)]
pub(crate) struct Tilt {
    /// The scanner
    #[arg(value_name = "SENSOR")]
    sensor: String,
    /// Name under which a program publishes the angles of the mount
    #[arg(long, value_name = "MOUNT", value_parser = own_name)]
    angles: String,
    /// Also publish the topics NAME/cloud and NAME/obstacles. NAME must not be in use
    #[arg(long = "as", value_name = "NAME", value_parser = own_name)]
    name: Option<String>,
    /// A point of the mount's axis in the robot's frame, in metres: x ahead, y left, z above the floor
    #[arg(long, value_name = "X,Y,Z", value_parser = numbers::<3>, allow_hyphen_values = true)]
    axis_at: [f64; 3],
    /// Direction of the mount's axis. Angles are right-handed: around y, a larger angle tilts the scanner down
    #[arg(long, default_value = "0,1,0", value_name = "X,Y,Z", value_parser = axis, allow_hyphen_values = true)]
    axis: [f64; 3],
    /// Where the beams come from while the mount is level [default: the point of --axis-at]
    #[arg(long, value_name = "X,Y,Z", value_parser = numbers::<3>, allow_hyphen_values = true)]
    sensor_at: Option<[f64; 3]>,
    /// Angle of the mount at which the scanner measures level
    #[arg(long, default_value_t = 0.0, value_name = "RADIANS", value_parser = number, allow_hyphen_values = true)]
    level: f64,
    /// Where the scanner looks while the mount is level, counter-clockwise from ahead
    #[arg(long, default_value_t = 0.0, value_name = "RADIANS", value_parser = number, allow_hyphen_values = true)]
    yaw: f64,
    /// The scanner hangs
    #[arg(long)]
    upside_down: bool,
    /// Report every object in this box, even if it is background: MIN_X,MAX_X,MIN_Y,MAX_Y,MIN_Z,MAX_Z, in meters
    #[arg(long, value_name = "X,X,Y,Y,Z,Z", value_parser = cuboid, allow_hyphen_values = true)]
    near: Option<[[f64; 2]; 3]>,
    /// Sweeps in which a surface must be seen before it is background
    #[arg(long, default_value_t = Settings::default().sweeps, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    sweeps: u16,
    /// Only check axis, arm and level against a flat floor and a wall ahead, and exit: with 5 if one of them is wrong
    #[arg(long, conflicts_with_all = ["name", "near"])]
    check: bool,
    /// Stop after this time, for example 10s, 250ms, 5m
    #[arg(long = "for", value_name = "DURATION", value_parser = duration::parse)]
    run_for: Option<Duration>,
    /// Exit with 3 after this time without a scan and without an angle
    #[arg(long, value_name = "DURATION", value_parser = duration::parse)]
    timeout: Option<Duration>,
}

/// A name that something can have which is no sensor.
fn own_name(name: &str) -> Result<String, String> {
    scanhub_schema::check_sensor(name).map(|()| name.to_owned()).map_err(|failure| format!("{failure}"))
}

fn number(text: &str) -> Result<f64, String> {
    let number = text.trim().parse().ok().filter(|number: &f64| number.is_finite());
    number.ok_or_else(|| format!("{text:?} is not a number"))
}

/// `N` numbers with commas between them.
fn numbers<const N: usize>(text: &str) -> Result<[f64; N], String> {
    let numbers = text.split(',').map(number).collect::<Result<Vec<_>, _>>()?;
    numbers.try_into().map_err(|numbers: Vec<_>| format!("expected {N} numbers, found {}", numbers.len()))
}

fn axis(text: &str) -> Result<[f64; 3], String> {
    let axis = numbers(text)?;
    if axis == [0.0; 3] {
        Err("the axis must not be 0,0,0; for example, 0,1,0 points from right to left".into())
    } else {
        Ok(axis)
    }
}

fn cuboid(text: &str) -> Result<[[f64; 2]; 3], String> {
    let [x, to_x, y, to_y, z, to_z] = numbers(text)?;
    let cuboid = [[x, to_x], [y, to_y], [z, to_z]];
    match cuboid.iter().all(|[from, to]| from < to) {
        true => Ok(cuboid),
        false => {
            Err("each minimum must be less than its maximum: MIN_X,MAX_X,MIN_Y,MAX_Y,MIN_Z,MAX_Z".into())
        }
    }
}

impl Tilt {
    pub(crate) fn options(&self, everywhere: &Everywhere) -> Result<TiltOptions, Failure> {
        Ok(TiltOptions {
            sensor: self.sensor.clone(),
            angles: self.angles.clone(),
            name: self.name.clone(),
            mount: Mount {
                axis_at: self.axis_at,
                axis: self.axis,
                level_rad: self.level,
                sensor_at: self.sensor_at.unwrap_or(self.axis_at),
                yaw_rad: self.yaw,
                is_upside_down: self.upside_down,
            },
            settings: Settings { sweeps: self.sweeps, near: self.near, ..Settings::default() },
            check: self.check,
            json: everywhere.json,
            bounds: Bounds { count: None, run_for: self.run_for, timeout: self.timeout },
            places: everywhere.places()?,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_and_boxes_are_read_and_what_is_none_is_refused() {
        assert_eq!(numbers("0.1, -2,3"), Ok([0.1, -2.0, 3.0]));
        assert_eq!(numbers::<3>("1,2").unwrap_err(), "expected 3 numbers, found 2");
        assert_eq!(numbers::<1>("inf").unwrap_err(), "\"inf\" is not a number");
        assert!(axis("0,0,0").unwrap_err().contains("must not be 0,0,0"));
        assert_eq!(cuboid("0,1,-1,1,0.1,2"), Ok([[0.0, 1.0], [-1.0, 1.0], [0.1, 2.0]]));
        assert!(cuboid("1,0,-1,1,0.1,2").unwrap_err().contains("less"));
    }
}
