//! The lines of the results that the hub computes from a scan. Not a contract, like its parent module.

use std::io::{self, Write};

use scanhub_client::{Heard, Robot};
use scanhub_schema::{
    Background, BackgroundHead, Early, Flags, Foreground, Header, Lines, Marks, Motion, Verdict,
};

use super::numbers;

pub(crate) fn marks(line: &mut Vec<u8>, header: &Header, marks: &Marks) -> io::Result<()> {
    numbers(line, header)?;
    if marks.lacks_level() {
        let why = "unavailable: nobody said from which intensity on this scanner sees a reflector";
        return write!(line, " {why}: set link.NAME.marks.level");
    }
    if !marks.is_available() {
        // A sample does not tell whether the mode of a recording is known; `info` does.
        return if header.flags & Flags::REPLAYED != 0 {
            write!(
                line,
                " unavailable: the recording has no reflector bits, or does not contain its measuring mode: "
            )?;
            write!(line, "then set link.NAME.mode")
        } else {
            write!(line, " unavailable: the sensor's measuring mode has no reflector bits")
        };
    }
    let count = marks.marks().len();
    write!(line, " {count} {}", if count == 1 { "mark" } else { "marks" })?;
    for mark in marks.marks() {
        let (angle_deg, range_mm) = (f64::from(mark.angle_mdeg) / 1000.0, f64::from(mark.range_dmm) / 10.0);
        write!(line, ", {range_mm:.1} mm at {angle_deg:.3} deg")?;
    }
    if marks.is_overflow() { write!(line, ", and more") } else { Ok(()) }
}

pub(crate) fn lines(line: &mut Vec<u8>, header: &Header, lines: &Lines) -> io::Result<()> {
    numbers(line, header)?;
    let count = lines.lines().len();
    write!(
        line,
        " {count} {}, {} corners",
        if count == 1 { "line" } else { "lines" },
        lines.corners().len()
    )?;
    write!(line, ", {} of {} beams", lines.on_lines, lines.readings)?;
    for found in lines.lines() {
        let (r_m, alpha_deg) = (found.r_m, found.alpha_rad.to_degrees());
        write!(line, ", r {r_m:.3} m alpha {alpha_deg:.2} deg")?;
    }
    if lines.is_overflow() { write!(line, ", and more") } else { Ok(()) }
}

pub(crate) fn motion(line: &mut Vec<u8>, header: &Header, motion: &Motion) -> io::Result<()> {
    numbers(line, header)?;
    write!(line, " {}", motion.how())?;
    if motion.has_step() {
        let Motion { dx_m, dy_m, dyaw_rad, .. } = motion;
        let [sd_x, sd_y, sd_yaw] = [0, 4, 8].map(|at| motion.covariance[at].max(0.0).sqrt());
        write!(line, ", step ({dx_m:.4}, {dy_m:.4}) m {:.3} deg", dyaw_rad.to_degrees())?;
        write!(line, " +- ({sd_x:.4}, {sd_y:.4}) m {:.3} deg", sd_yaw.to_degrees())?;
        if motion.is_degenerate() {
            write!(line, ", a direction is open")?;
        }
    }
    if motion.has_pose() {
        let Motion { x_m, y_m, yaw_rad, .. } = motion;
        write!(line, ", at ({x_m:.3}, {y_m:.3}) m {:.2} deg", yaw_rad.to_degrees())?;
        if !motion.has_valid_pose() {
            write!(line, " (not valid)")?;
        } else if let Some(covariance) = motion.sum_covariance() {
            let [sd_x, sd_y, sd_yaw] = [0, 4, 8].map(|at| covariance[at].max(0.0).sqrt());
            write!(line, " +- ({sd_x:.3}, {sd_y:.3}) m {:.2} deg", sd_yaw.to_degrees())?;
        }
    }
    if motion.breaks > 0 { write!(line, ", {} steps refused", motion.breaks) } else { Ok(()) }
}

pub(crate) fn early(line: &mut Vec<u8>, header: &Header, early: &Early) -> io::Result<()> {
    numbers(line, header)?;
    let verdict = early.verdict().name();
    if early.is_withdrawn() {
        return write!(line, " {verdict} withdrawn");
    }
    let Early { beam, distance_mm, bytes_seen, .. } = early;
    write!(line, " {verdict} {distance_mm} mm, beam {beam}, after {bytes_seen} bytes")
}

pub(crate) fn zones(line: &mut Vec<u8>, heard: &Heard) -> io::Result<()> {
    let Heard { zones, header, .. } = heard;
    let Some(header) = header else {
        return write!(line, "unknown: no recent data");
    };
    numbers(line, header)?;
    if heard.stale {
        return write!(line, " unknown: too old");
    }
    write!(line, " {}", zones.verdict().name())?;
    match zones.nearest() {
        Some((beam, mm)) => write!(line, " nearest {mm} mm, beam {beam}")?,
        None => write!(line, " {}", without_nearest(zones.verdict()))?,
    }
    for zone in zones.zones() {
        let violated = if zone.violated != 0 { " violated" } else { "" };
        write!(line, ", {} mm{violated} {}", zone.radius_mm, zone.beams)?;
    }
    if zones.invalid_beams > 0 { write!(line, ", {} invalid", zones.invalid_beams) } else { Ok(()) }
}

/// The fold over all sensors.
pub(crate) fn robot(line: &mut Vec<u8>, robot: &Robot) -> io::Result<()> {
    write!(line, "{}", robot.verdict().name())?;
    match robot.nearest() {
        Some((mm, sensor)) => write!(line, " nearest {mm} mm, {sensor}:")?,
        None => write!(line, " {}:", without_nearest(robot.verdict()))?,
    }
    for (sensor, verdict) in robot.sensors() {
        write!(line, " {sensor} {}", verdict.name())?;
    }
    Ok(())
}

/// In place of what is nearest, where no beam met anything.
fn without_nearest(verdict: Verdict) -> &'static str {
    if verdict == Verdict::Unknown { "nearest not known" } else { "nothing near" }
}

pub(crate) fn foreground(line: &mut Vec<u8>, header: &Header, foreground: &Foreground) -> io::Result<()> {
    numbers(line, header)?;
    write!(line, " {} beams, {} segments", foreground.beams, foreground.segments)?;
    for (i, segment) in foreground.segments().iter().enumerate() {
        let support = if foreground.has_support(i) { "" } else { " without support" };
        let width_mm = u64::from(segment.width) * u64::from(foreground.unit_um) / 1000;
        write!(line, ", {width_mm} mm wide at ({}, {}){support}", segment.x_mm, segment.y_mm)?;
    }
    Ok(())
}

pub(crate) fn background(line: &mut Vec<u8>, model: &Background) -> io::Result<()> {
    let far = model.ranges().iter().filter(|&&range| range == Background::FAR).count();
    let frozen = if model.is_frozen() { ", frozen" } else { "" };
    let BackgroundHead { generation, taught, count, unit_um, .. } = **model;
    let unit_mm = f64::from(unit_um) / 1000.0;
    write!(
        line,
        "generation {generation}: {taught} of {count} beams known, {far} far, in {unit_mm} mm{frozen}"
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use scanhub_schema::Zones;

    #[test]
    fn what_is_not_known_is_not_called_far() {
        let text = |verdict: Verdict| {
            let zones = Zones { verdict: verdict as u8, ..Zones::unknown() };
            let mut line = Vec::new();
            let header = Some(Header::default());
            super::zones(&mut line, &Heard { zones, header, missed: 0, stale: false, said: zones }).unwrap();
            String::from_utf8(line).unwrap()
        };
        assert!(text(Verdict::Clear).ends_with(" clear nothing near"));
        assert!(text(Verdict::Unknown).ends_with(" unknown nearest not known"));
        let mut line = Vec::new();
        robot(&mut line, &Robot::default()).unwrap();
        assert_eq!(line, b"unknown nearest not known:");
    }

    #[test]
    fn a_segment_without_support_says_so() {
        let mut found = Foreground::of(3);
        let head = scanhub_schema::ForegroundHead {
            unit_um: 10_000,
            count: 3,
            beams: 3,
            segments: 2,
            supported: 1,
            ..scanhub_schema::ForegroundHead::default()
        };
        let segments = found.begin(head).segments;
        segments[0] =
            scanhub_schema::Segment { first: 0, last: 1, width: 7, x_mm: 900, y_mm: -4, ..segments[0] };
        segments[1] = scanhub_schema::Segment { first: 2, last: 2, x_mm: 8, ..segments[1] };
        let mut line = Vec::new();
        foreground(&mut line, &Header::default(), &found).unwrap();
        let line = String::from_utf8(line).unwrap();
        assert!(
            line.ends_with(
                " 3 beams, 2 segments, 70 mm wide at (900, -4), 0 mm wide at (8, 0) without support"
            )
        );
        let json =
            serde_json::to_value(crate::json::foreground("front", &Header::default(), &found)).unwrap();
        let supports: Vec<_> =
            json["segments"].as_array().unwrap().iter().map(|segment| &segment["support"]).collect();
        assert_eq!(supports, [true, false]);
    }
}
