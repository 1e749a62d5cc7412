//! `scanhub tilt --check`: checks the description of a mount (axis, arm and level) against a floor and a wall.

use std::io::{self, Write};

use crate::tilt::{Check, Mount};
use scanhub_schema::{Failure, Kind};
use serde::Serialize;

use scanhub_verbs::output::{End, Output};

/// Complete sweeps that a check takes.
pub(super) const SWEEPS: u32 = 6;
/// Greatest error of the height, in meters.
const HEIGHT_M: f64 = 0.02;
/// Greatest error of the level and of the roll, in degrees.
const LEVEL_DEG: f64 = 0.3;
/// Greatest lean of a wall that the level does not explain, in degrees.
const LEAN_DEG: f64 = 0.5;

/// Class `tilt_check`.
#[derive(Serialize)]
struct Finding<'a> {
    class: &'static str,
    sensor: &'a str,
    name: &'static str,
    state: &'static str,
    off_m: Option<f64>,
    off_deg: Option<f64>,
    finding: String,
    remedy: String,
}

/// Writes what `check` has found of `mount`: a line for each item.
///
/// # Errors
///
/// Returns [`Kind::Check`] if an item has failed.
pub(super) fn tell(
    check: &Check,
    mount: &Mount,
    sensor: &str,
    is_json: bool,
    out: &mut Output<'_>,
) -> Result<(), End> {
    let findings = find(check, mount, sensor);
    for finding in &findings {
        match is_json {
            true => out.json(finding)?,
            false => out.line(|line| text(line, finding))?,
        }
    }
    match findings.iter().any(|finding| finding.state == "failed") {
        true => {
            let message = "the flags do not describe the mount";
            Err(Failure::new(Kind::Check, message, "its remedy is printed below each item that failed")
                .into())
        }
        false => Ok(()),
    }
}

fn text(line: &mut Vec<u8>, finding: &Finding<'_>) -> io::Result<()> {
    let Finding { name, state, finding, remedy, .. } = finding;
    write!(line, "{state:<8} {name}: {finding}")?;
    if remedy.is_empty() { Ok(()) } else { write!(line, "; {remedy}") }
}

fn find<'a>(check: &Check, mount: &Mount, sensor: &'a str) -> Vec<Finding<'a>> {
    let item =
        |name, off_m: Option<f64>, off_deg: Option<f64>, is_ok: bool, finding: String, remedy: String| {
            let (state, remedy) = if is_ok { ("ok", String::new()) } else { ("failed", remedy) };
            Finding { class: "tilt_check", sensor, name, state, off_m, off_deg, finding, remedy }
        };
    let Some(floor) = check.floor(mount) else {
        let remedy =
            "let the mount swing over a flat floor that is free within 3 m, and check --axis-at and --level";
        return vec![item(
            "floor",
            None,
            None,
            false,
            "there is no flat floor near height 0".into(),
            remedy.into(),
        )];
    };
    let moved = |at: [f64; 3]| format!("{:.3},{:.3},{:.3}", at[0], at[1], at[2] - floor.height_m);
    let [level_deg, roll_deg] = [floor.level_rad, floor.roll_rad].map(f64::to_degrees);
    let mut findings = vec![
        item(
            "floor",
            Some(floor.height_m),
            None,
            floor.height_m.abs() <= HEIGHT_M,
            format!(
                "its height is {:.3} m, from {} points with a standard deviation of {:.3} m",
                floor.height_m, floor.points, floor.deviation_m
            ),
            format!("--axis-at {} --sensor-at {}", moved(mount.axis_at), moved(mount.sensor_at)),
        ),
        item(
            "level",
            None,
            Some(level_deg),
            level_deg.abs() <= LEVEL_DEG,
            format!("the floor rises by {level_deg:.2} degrees in the direction in which the mount tilts"),
            format!("--level {:.4}", mount.level_rad - floor.level_rad),
        ),
        item(
            "axis",
            None,
            Some(roll_deg),
            roll_deg.abs() <= LEVEL_DEG,
            format!("the floor rises by {roll_deg:.2} degrees along the axis"),
            "level axis and scanner across, or describe the axis with --axis".into(),
        ),
    ];
    findings.push(match check.wall() {
        None => Finding {
            state: "skipped",
            remedy: "let the mount swing in front of an upright wall within 6 m, at least 0.7 m high".into(),
            ..item("arm", None, None, true, "there is no wall ahead".into(), String::new())
        },
        Some(wall) => {
            let off_deg = (wall.lean_rad + floor.level_rad).to_degrees();
            item(
                "arm",
                None,
                Some(off_deg),
                off_deg.abs() <= LEAN_DEG,
                format!(
                    "the wall at {:.2} m leans by {off_deg:.2} degrees more than the floor explains, from {} points with a \
                     standard deviation of {:.3} m",
                    wall.distance_m, wall.points, wall.deviation_m
                ),
                "measure again from the axis to the scanner (--sensor-at), and check whether the wall is upright".into(),
            )
        }
    });
    findings
}
