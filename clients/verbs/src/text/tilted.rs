//! The lines of mounts, and of what is seen in three dimensions from them. Not a contract, like its parent module.

use std::io::{self, Write};

use scanhub_schema::{Cloud, Header, Obstacle, Obstacles, PointClass, Tilt};

use super::numbers;

pub(crate) fn tilt(line: &mut Vec<u8>, header: &Header, tilt: &Tilt) -> io::Result<()> {
    numbers(line, header)?;
    write!(line, " {:.2} deg", tilt.angle_rad.to_degrees())?;
    match tilt.rate_rad_s() {
        Some(rate) => write!(line, ", {:.1} deg/s", rate.to_degrees()),
        None => Ok(()),
    }
}

pub(crate) fn cloud(line: &mut Vec<u8>, header: &Header, cloud: &Cloud) -> io::Result<()> {
    numbers(line, header)?;
    write!(line, " sweep {} {} points", cloud.sweep, cloud.points().len())?;
    let of = |class| cloud.points().iter().filter(|point| point.class() == class).count();
    let foreground = of(PointClass::Foreground);
    if foreground > 0 {
        write!(line, ", {foreground} in the foreground")?;
    }
    if cloud.has(Cloud::LAST) {
        write!(line, ", the last")?;
    }
    sweep_words(line, cloud.has(Cloud::COMPLETE), cloud.has(Cloud::DOUBTED))
}

/// Writes number and stamp of a sweep, and its obstacles.
///
/// # Errors
///
/// Returns the error of the write.
pub fn obstacles(line: &mut Vec<u8>, header: &Header, found: &Obstacles) -> io::Result<()> {
    numbers(line, header)?;
    let count = found.obstacles().len();
    write!(line, " sweep {} {count} {}", found.sweep, if count == 1 { "obstacle" } else { "obstacles" })?;
    for one in found.obstacles() {
        let ([x_m, y_m, _], [bottom, top]) = (one.middle, [one.low[2], one.high[2]]);
        write!(line, ", at ({x_m:.2}, {y_m:.2}) m from {bottom:.2} to {top:.2} m above the floor")?;
        if one.has(Obstacle::NEAR) {
            write!(line, " too near")?;
        }
    }
    if found.left_out > 0 {
        write!(line, ", {} left out", found.left_out)?;
    }
    sweep_words(line, found.has(Obstacles::COMPLETE), found.has(Obstacles::DOUBTED))
}

fn sweep_words(line: &mut Vec<u8>, is_complete: bool, is_doubted: bool) -> io::Result<()> {
    if !is_complete {
        write!(line, ", incomplete")?;
    }
    if is_doubted { write!(line, ", doubted") } else { Ok(()) }
}
