//! Formats the classes of `--json` as text for users. Each sample is one line, with the most important values first.
//! The text is not a contract.

use std::f64::consts::TAU;
use std::fmt;
use std::io::{self, Write};
use std::rc::Rc;

use scanhub_client::streams::Sample;
use scanhub_client::{Robot, ZonesUpdate};
use scanhub_schema::{
    Background, BackgroundHead, Cloud, Early, Event, EventKind, Failure, Flags, Foreground, Header, Lines,
    Marks, Motion, Obstacle, Obstacles, PacketInfo, PointClass, Reasons, Scan, Status, Telegram, Tilt,
    Tracks, Verdict, in_degrees,
};

use crate::follow::Notice;
use crate::names::TopicName;
use crate::receive_stats::ReceiveStats;
use crate::show;

/// Formats bytes as lowercase hex digits without spaces.
pub(crate) struct Hex<'a>(pub(crate) &'a [u8]);

impl fmt::Display for Hex<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

/// Writes a line for a sample.
pub(crate) fn sample(line: &mut Vec<u8>, name: &TopicName, sample: &Sample) -> io::Result<()> {
    write!(line, "{name} ")?;
    show::text(sample, line)
}

/// Writes a line for a notice, which goes to stderr. A notice about the hub is the same for all topics.
pub(crate) fn notice(line: &mut Vec<u8>, names: &[Rc<TopicName>], notice: &Notice) -> io::Result<()> {
    match notice {
        Notice::NoHub(Failure { message, hint, .. }) => {
            return write!(line, "{message}, waiting for one: {hint}");
        }
        Notice::HubGone => return write!(line, "no hub, waiting for one"),
        Notice::HubBack => return write!(line, "the hub runs now"),
        Notice::Missed(_) | Notice::Stale => {}
    }
    for name in names {
        write!(line, "{name}: ")?;
    }
    match notice {
        Notice::Missed(missed) => write!(line, "missed {missed}"),
        _ => write!(line, "no samples arrive any more"),
    }
}

/// Writes the summary of a topic at the end of a run.
pub(crate) fn summary(line: &mut Vec<u8>, name: &TopicName, stats: &ReceiveStats) -> io::Result<()> {
    write!(line, "{name}: {} received, {} missed in {:.1} s", stats.received, stats.missed, stats.seconds())?;
    if let Some(hz) = stats.hz() {
        write!(line, ", {hz:.2} Hz")?;
    }
    // Print only losses above 0.
    if let Some(lost) = stats.loss.lost_on_line.filter(|&lost| lost > 0) {
        write!(line, ", {lost} lost on the line")?;
    }
    match stats.loss.damaged.filter(|&share| share > 0.0) {
        Some(share) => write!(line, ", {:.2} % of its bytes damaged", 100.0 * share),
        None => Ok(()),
    }
}

fn numbers(line: &mut Vec<u8>, header: &Header) -> io::Result<()> {
    let seconds = header.stamp_first_ns as f64 / 1e9;
    write!(
        line,
        "seq {} topic_seq {} at {seconds:.6} {}",
        header.seq,
        header.topic_seq,
        header.quality().name()
    )?;
    for reason in Reasons::names(header.reasons) {
        write!(line, " {reason}")?;
    }
    if header.flags & Flags::STAMP_ESTIMATED != 0 { write!(line, " stamp_estimated") } else { Ok(()) }
}

/// Writes the text after the name of a sample of topic `telegram`.
pub(crate) fn telegram(line: &mut Vec<u8>, header: &Header, bytes: &[u8]) -> io::Result<()> {
    const MAX_BYTES_SHOWN: usize = 16;
    numbers(line, header)?;
    let telegram = Telegram { family: header.family(), bytes };
    if telegram.is_lms() {
        write!(line, " address {:02x} command {:02x}", telegram.address(), telegram.command())?;
    }
    match telegram.packets() {
        Some(PacketInfo { kind, packets: 1, .. }) => write!(line, " {kind} of 1 packet")?,
        Some(PacketInfo { kind, packets, .. }) => write!(line, " {kind} of {packets} packets")?,
        None => {}
    }
    write!(line, " {} bytes ", bytes.len())?;
    write!(line, "{}", Hex(&bytes[..bytes.len().min(MAX_BYTES_SHOWN)]))?;
    if bytes.len() > MAX_BYTES_SHOWN { write!(line, "...") } else { Ok(()) }
}

/// Writes the text after the name of a sample of topic `scan`.
pub(crate) fn scan(line: &mut Vec<u8>, header: &Header, scan: &Scan) -> io::Result<()> {
    numbers(line, header)?;
    let beams = scan.beams();
    // Use the angles of the grid, because exact angles of the first beams may differ by a full revolution.
    let (first, last) = (scan.first_angle, scan.first_angle + scan.step * beams.saturating_sub(1) as f64);
    if (last - first).abs() + scan.step.abs() > TAU - 1e-6 {
        write!(line, " {beams} beams all around")?;
    } else {
        write!(line, " {beams} beams {} to {} deg", in_degrees(first), in_degrees(last))?;
    }
    let valid = (0..beams).filter_map(|i| Some((scan.distance_mm(i)?, i)));
    write!(line, " {} valid", valid.clone().count())?;
    match valid.min() {
        Some((mm, i)) => {
            // Print the angle between -180 and 180 degrees.
            let angle = scan.angle(i);
            let turns = (angle / TAU).round();
            write!(line, " nearest {mm} mm at {} deg", in_degrees(angle - TAU * turns))
        }
        None => Ok(()),
    }
}

/// Writes the text after the name of a sample of topic `status`.
pub(crate) fn status(line: &mut Vec<u8>, status: &Status) -> io::Result<()> {
    let state = status.state().map_or("unknown", |state| state.name());
    write!(line, "{state} {} Bd ", status.baud)?;
    if let Some(hz) = status.rate_hz() {
        write!(line, "{hz:.2} Hz ")?;
    }
    write!(line, "{}", status.port())?;
    if let Some(loss) = status.line_loss() {
        write!(line, " {loss}")?;
    }
    if !status.last_error().is_empty() {
        write!(line, " last error: {}", status.last_error())?;
    }
    Ok(())
}

pub(crate) fn marks(line: &mut Vec<u8>, header: &Header, marks: &Marks) -> io::Result<()> {
    numbers(line, header)?;
    if marks.lacks_level() {
        let why = "unavailable: the intensity of reflectors is unknown for this scanner";
        return write!(line, " {why}: set link.NAME.marks.level");
    }
    if !marks.is_available() {
        // A sample does not show whether the mode of a recording is known; `info` does.
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
    write!(line, " {}", motion.method())?;
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
    if motion.refused_steps > 0 { write!(line, ", {} steps rejected", motion.refused_steps) } else { Ok(()) }
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

pub(crate) fn zones(line: &mut Vec<u8>, update: &ZonesUpdate) -> io::Result<()> {
    let ZonesUpdate { zones, header, .. } = update;
    let Some(header) = header else {
        return write!(line, "unknown: no recent data");
    };
    numbers(line, header)?;
    if update.stale {
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

/// Writes the combined verdict of all sensors.
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

/// Returns the text that replaces the nearest range if no beam has a range.
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
    let BackgroundHead { generation, known_beams, count, unit_um, .. } = **model;
    let unit_mm = f64::from(unit_um) / 1000.0;
    write!(
        line,
        "generation {generation}: {known_beams} of {count} beams known, {far} far, in {unit_mm} mm{frozen}"
    )
}

pub(crate) fn tracks(line: &mut Vec<u8>, header: &Header, tracks: &Tracks) -> io::Result<()> {
    numbers(line, header)?;
    let count = tracks.tracks().len();
    write!(line, " {count} {}", if count == 1 { "person" } else { "people" })?;
    for track in tracks.tracks() {
        let (x_m, y_m, state) = (track.x_m, track.y_m, track.state().name());
        write!(line, ", {} {state} at ({x_m:.2}, {y_m:.2}) m", track.id)?;
        if let Some(room) = track.room_name() {
            write!(line, " in {room}")?;
        }
    }
    Ok(())
}

pub(crate) fn event(line: &mut Vec<u8>, header: &Header, event: &Event) -> io::Result<()> {
    numbers(line, header)?;
    write!(line, " ")?;
    event_text(line, event)
}

/// Writes an event as a sentence.
///
/// # Errors
///
/// Returns the error of the write.
pub fn event_text(line: &mut Vec<u8>, event: &Event) -> io::Result<()> {
    let (id, room) = (event.id, event.room_name().unwrap_or("no room"));
    match (event.kind(), event.door()) {
        (_, Some((door, from, to))) => write!(line, "{id} went from {from} to {to} through {door}"),
        (Some(EventKind::Appeared), _) => write!(line, "{id} appeared in {room}"),
        (Some(EventKind::Left), _) => write!(line, "{id} left, last in {room}"),
        _ => write!(line, "{id}: event {}", event.kind),
    }
}

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
    sweep_text(line, cloud.has(Cloud::COMPLETE), cloud.has(Cloud::UNRELIABLE))
}

/// Writes sequence number and stamp of a sweep, and its obstacles.
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
    if found.dropped > 0 {
        write!(line, ", {} dropped", found.dropped)?;
    }
    sweep_text(line, found.has(Obstacles::COMPLETE), found.has(Obstacles::UNRELIABLE))
}

fn sweep_text(line: &mut Vec<u8>, is_complete: bool, is_unreliable: bool) -> io::Result<()> {
    if !is_complete {
        write!(line, ", incomplete")?;
    }
    if is_unreliable { write!(line, ", unreliable") } else { Ok(()) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use scanhub_schema::Zones;

    #[test]
    fn unknown_verdict_is_printed_without_a_distance() {
        let text = |verdict: Verdict| {
            let zones = Zones { verdict: verdict as u8, ..Zones::unknown() };
            let mut line = Vec::new();
            let header = Some(Header::default());
            super::zones(
                &mut line,
                &ZonesUpdate { zones, header, missed: 0, stale: false, as_published: zones },
            )
            .unwrap();
            String::from_utf8(line).unwrap()
        };
        assert!(text(Verdict::Clear).ends_with(" clear nothing near"));
        assert!(text(Verdict::Unknown).ends_with(" unknown nearest not known"));
        let mut line = Vec::new();
        robot(&mut line, &Robot::default()).unwrap();
        assert_eq!(line, b"unknown nearest not known:");
    }

    #[test]
    fn text_and_json_mark_unsupported_segments() {
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
