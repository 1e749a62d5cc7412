//! `scanhub tilt`: computes points and obstacles in three dimensions with a scanner on a mount, and prints and
//! publishes them.

use std::io::{self, Write};
use std::sync::atomic::Ordering;
use std::time::Duration;

use clap::Args;
use scanhub_client::streams::Sample;
use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{Cloud, CloudHead, CloudPoint, Failure, Header, Kind, Obstacles, Topic, WakeEvent};
use scanhub_shm::Domain;
use scanhub_verbs::context::Context;
use scanhub_verbs::follow::{Event, RunLimits, TopicRun};
use scanhub_verbs::names::TopicName;
use scanhub_verbs::output::{ExitReason, verb_result};
use scanhub_verbs::{duration, json, text};
use serde::{Serialize, Serializer};

use super::own_name;
use super::results::{Results, Topics};
use crate::tilt::{Angle, Counts, DropReason, Mount, MountCheck, Point, Settings, Sweep, TiltScanner};

/// Find obstacles in three dimensions with a scanner on a tilting mount
#[derive(Args, Clone, Debug)]
#[command(after_help = EXAMPLES)]
pub struct TiltArgs {
    /// Sensor whose scanner is on the mount
    #[arg(value_name = "SENSOR")]
    sensor: String,
    /// Name under which a program publishes the angles of the mount
    #[arg(long, value_name = "MOUNT", value_parser = own_name)]
    angles: String,
    /// Also publish the topics NAME/cloud and NAME/obstacles. NAME must not be in use
    #[arg(long = "as", value_name = "NAME", value_parser = own_name)]
    name: Option<String>,
    /// Point on the mount's axis in the robot's frame, in meters: x ahead, y left, z above the floor
    #[arg(long, value_name = "X,Y,Z", value_parser = numbers::<3>, allow_hyphen_values = true)]
    axis_at: [f64; 3],
    /// Direction of the mount's axis. Angles are right-handed: with the default axis, a larger angle tilts the scanner
    /// down
    #[arg(long, default_value = "0,1,0", value_name = "X,Y,Z", value_parser = axis, allow_hyphen_values = true)]
    axis: [f64; 3],
    /// Origin of the beams while the mount is level, in the robot's frame, in meters [default: the point of --axis-at]
    #[arg(long, value_name = "X,Y,Z", value_parser = numbers::<3>, allow_hyphen_values = true)]
    sensor_at: Option<[f64; 3]>,
    /// Angle of the mount at which the scanner is level
    #[arg(long, default_value_t = 0.0, value_name = "RADIANS", value_parser = number, allow_hyphen_values = true)]
    level: f64,
    /// Direction of the scanner while the mount is level, counterclockwise from ahead
    #[arg(long, default_value_t = 0.0, value_name = "RADIANS", value_parser = number, allow_hyphen_values = true)]
    yaw: f64,
    /// The scanner is mounted upside down
    #[arg(long)]
    upside_down: bool,
    /// Box in which every object is an obstacle, even if it belongs to the background:
    /// MIN_X,MAX_X,MIN_Y,MAX_Y,MIN_Z,MAX_Z, in meters
    #[arg(long, value_name = "X,X,Y,Y,Z,Z", value_parser = cuboid, allow_hyphen_values = true)]
    near: Option<[[f64; 2]; 3]>,
    /// Number of sweeps that must contain a surface before it is background
    #[arg(long, default_value_t = Settings::default().sweeps, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    sweeps: u16,
    /// Check --axis-at, --axis, --sensor-at and --level with the points of a flat floor and a wall ahead, and exit. The
    /// exit code is 5 if a value is wrong
    #[arg(long, conflicts_with_all = ["name", "near"])]
    check: bool,
    /// Stop after this time, for example 10s, 250ms, 5m
    #[arg(long = "for", value_name = "DURATION", value_parser = duration::parse)]
    run_for: Option<Duration>,
    /// Exit with code 3 if neither a scan nor an angle arrives for this time
    #[arg(long, value_name = "DURATION", value_parser = duration::parse)]
    timeout: Option<Duration>,
}

const EXAMPLES: &str = "\
Examples:
  scanhub tilt front --angles mount --axis-at 0,0,0.9 --as hall
  scanhub tilt front --angles mount --axis-at 0,0,0.9 --near 0.3,1.2,-0.5,0.5,0.05,1.6";

fn number(text: &str) -> Result<f64, String> {
    let number = text.trim().parse().ok().filter(|number: &f64| number.is_finite());
    number.ok_or_else(|| format!("{text:?} is not a number"))
}

/// Parses `N` numbers with commas between them.
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

impl TiltArgs {
    /// Subscribes to the scans of the sensor and the angles of its mount, and writes the obstacles of each sweep to
    /// stdout. Without `--json`, reports about the angles and notices go to stderr. Ends at a limit of the arguments,
    /// by a signal, or when the reader closes stdout.
    ///
    /// # Errors
    ///
    /// - [`Kind::NoTopic`] if the sensor or the mount does not exist; the message lists the sensors.
    /// - [`Kind::NoHub`] if the run is bounded and no hub runs at its start.
    /// - [`Kind::Timeout`] if neither a scan nor an angle arrives in time.
    /// - [`Kind::Interrupted`] if a signal stops a bounded run or a check before its end.
    /// - [`Kind::Check`] if a check has failed.
    /// - The errors of [`PublishSession::open_named`](scanhub_client::PublishSession::open_named) if the run publishes.
    pub fn run(&self, context: &mut Context) -> Result<(), Failure> {
        let (locations, stop) = (context.domain.locations()?, context.signals.stop()?);
        let names = [(&self.sensor, Topic::Scan), (&self.angles, Topic::Tilt)]
            .map(|(sensor, topic)| TopicName { sensor: sensor.clone(), topic });
        let mount = Mount {
            axis_at: self.axis_at,
            axis: self.axis,
            level_rad: self.level,
            sensor_at: self.sensor_at.unwrap_or(self.axis_at),
            yaw_rad: self.yaw,
            is_upside_down: self.upside_down,
        };
        let settings = Settings { sweeps: self.sweeps, near: self.near, ..Settings::default() };
        let limits = RunLimits { count: None, run_for: self.run_for, timeout: self.timeout };
        let name = self.name.as_deref().unwrap_or(DEFAULT_NAME);
        let mut run = TiltRun {
            args: self,
            locations: &locations,
            scanner: TiltScanner::new(mount, settings),
            problem: ProblemFilter::default(),
            late_ns: 0,
            check: self.check.then(MountCheck::default),
            beams: None,
            writer: SweepWriter {
                results: Results::new(name, context.json, &mut context.out, &mut context.notes),
                to_wall_ns: 0,
                obstacles: Box::default(),
                first_error: Ok(()),
            },
        };
        let followed = run.follow(&mut TopicRun::new(&names, &[], &locations, &limits, &stop));
        let TiltRun { check: Some(check), writer, .. } = &mut run else { return verb_result(followed) };
        if check.sweeps() < CHECKED_SWEEPS {
            verb_result(followed)?;
            let message =
                format!("the check ended after {} of {CHECKED_SWEEPS} whole sweeps", check.sweeps());
            let kind = if stop.load(Ordering::Relaxed) { Kind::Interrupted } else { Kind::Timeout };
            return Err(Failure::new(kind, message, "let it run until it ends by itself"));
        }
        verb_result(write_findings(check, &mount, &mut writer.results))
    }
}

/// Name in the lines of a run that does not publish.
const DEFAULT_NAME: &str = "tilted";
/// Minimum duration of a problem with the angles that is reported, in ns. A shorter problem appears only in the
/// counters.
const MIN_PROBLEM_NS: u64 = 300_000_000;

struct TiltRun<'a> {
    args: &'a TiltArgs,
    locations: &'a [Domain],
    scanner: TiltScanner,
    problem: ProblemFilter,
    /// Delay of the angles' stamps in the last report, in ns.
    late_ns: i64,
    check: Option<MountCheck>,
    /// Number of beams of the first scan; `None` until this scan has arrived.
    beams: Option<usize>,
    writer: SweepWriter<'a>,
}

impl TiltRun<'_> {
    fn follow(&mut self, following: &mut TopicRun<'_>) -> Result<(), ExitReason> {
        let end = self.take_events(following);
        if self.check.is_none() && !matches!(end, Err(ExitReason::ReaderClosed)) {
            self.sum_up()?;
        }
        end
    }

    fn take_events(&mut self, following: &mut TopicRun<'_>) -> Result<(), ExitReason> {
        while let Some(event) = following.next(None)? {
            match event {
                Event::Sample(_, sample, _) => self.sample(&sample)?,
                Event::Notice(names, notice) => self.writer.results.notice(&names, &notice)?,
                Event::Tick(_) => self.publish()?,
                _ => {}
            }
        }
        Ok(())
    }

    /// Creates the topics if the run publishes and the number of beams is known. This number determines the maximum
    /// length of samples.
    fn publish(&mut self) -> Result<(), ExitReason> {
        let results = &mut self.writer.results;
        if let (Some(_), Some(beams), None) = (&self.args.name, self.beams, &results.topics) {
            results.publish(TopicLimits { beams, ..TopicLimits::default() }, self.locations)?;
        }
        Ok(())
    }

    fn sample(&mut self, sample: &Sample) -> Result<(), ExitReason> {
        let TiltRun { scanner, writer, check, .. } = self;
        let mut take = |sweep: &Sweep<'_>| match check {
            Some(check) => check.take(sweep),
            None => writer.write(sweep),
        };
        match sample {
            Sample::Scan(scan) => {
                let header = scan.header();
                self.beams.get_or_insert(scan.beams());
                scanner.take_scan(header.stamp_first_ns, scan, &mut take);
                writer.to_wall_ns = header.wall_ns.wrapping_sub(header.stamp_last_ns) as i64;
                writer.results.take_flags(header);
                if let Some(problem) = self.problem.changed(header.stamp_first_ns, scanner.problem()) {
                    writer.write_angles(problem, scanner.late_ns(), None)?;
                }
            }
            Sample::Tilt(tilt) => {
                let stamp_ns = tilt.header().stamp_first_ns;
                let angle = Angle { stamp_ns, angle_rad: tilt.angle_rad, rate_rad_s: tilt.rate_rad_s };
                scanner.take_angle(angle, &mut take);
            }
            _ => {}
        }
        if scanner.late_ns() != self.late_ns {
            self.late_ns = scanner.late_ns();
            writer.write_angles(self.problem.reported, self.late_ns, Some(&self.args.angles))?;
        }
        if check.as_ref().is_some_and(|check| check.sweeps() >= CHECKED_SWEEPS) {
            // End the run without a summary.
            return Err(ExitReason::ReaderClosed);
        }
        std::mem::replace(&mut writer.first_error, Ok(()))
    }

    fn sum_up(&mut self) -> Result<(), ExitReason> {
        let results = &mut self.writer.results;
        let line = TiltJson::Summary {
            sensor: results.name,
            counts: self.scanner.counts(),
            missed: results.missed,
            failed: results.failed(),
            late_ns: self.scanner.late_ns(),
        };
        results.result(&line, |out| line.text(out))
    }
}

/// Filter that drops short problems with the angles.
#[derive(Default)]
struct ProblemFilter {
    reported: Option<DropReason>,
    now: Option<DropReason>,
    since_ns: u64,
}

impl ProblemFilter {
    /// Updates the filter with the problem `now` of a scan with the stamp `stamp_ns`. Returns `None` if nothing must be
    /// reported now. `Some(Some(..))` reports a problem, and `Some(None)` the end of a problem.
    fn changed(&mut self, stamp_ns: u64, now: Option<DropReason>) -> Option<Option<DropReason>> {
        if now != self.now || self.since_ns == 0 {
            (self.now, self.since_ns) = (now, stamp_ns);
        }
        let is_old = stamp_ns.saturating_sub(self.since_ns) >= MIN_PROBLEM_NS;
        (is_old && now != self.reported).then(|| {
            self.reported = now;
            now
        })
    }
}

/// Writer and publisher of sweeps.
struct SweepWriter<'a> {
    results: Results<'a, Cloud, Obstacles>,
    /// Offset from CLOCK_MONOTONIC to the wall clock, in ns.
    to_wall_ns: i64,
    /// Obstacles of the last sweep.
    obstacles: Box<Obstacles>,
    /// First error since the last sample.
    first_error: Result<(), ExitReason>,
}

impl SweepWriter<'_> {
    fn write(&mut self, sweep: &Sweep<'_>) {
        let header = self.publish(sweep);
        let SweepWriter { results, obstacles, .. } = self;
        let line = json::obstacles(results.name, &header, obstacles);
        let written = results.result(&line, |out| text::obstacles(out, &header, obstacles));
        if self.first_error.is_ok() {
            self.first_error = written;
        }
    }

    /// Stores the obstacles of a sweep. Publishes the points and the obstacles if the topics exist. Returns the header
    /// of the obstacles.
    fn publish(&mut self, sweep: &Sweep<'_>) -> Header {
        let flags = if sweep.is_complete { Obstacles::COMPLETE } else { 0 }
            | if sweep.is_unreliable { Obstacles::UNRELIABLE } else { 0 };
        *self.obstacles = Obstacles {
            sweep: sweep.number,
            generation: sweep.generation,
            dropped: sweep.dropped,
            flags,
            ..Obstacles::default()
        };
        sweep.obstacles.iter().for_each(|one| self.obstacles.push(*one));
        let (shared, to_wall_ns) = (self.results.header, self.to_wall_ns);
        let header_of = |seq, from_ns, until_ns: u64| Header {
            seq,
            topic_seq: seq,
            stamp_first_ns: from_ns,
            stamp_last_ns: until_ns,
            wall_ns: until_ns.wrapping_add_signed(to_wall_ns),
            ..shared
        };
        let header = header_of(sweep.number.into(), sweep.from_ns, sweep.until_ns);
        let Some(Topics { publications: (cloud, obstacles), sensor }) = &mut self.results.topics else {
            return header;
        };
        let mut scans = scans(sweep.points, sensor.limits().beams).peekable();
        let mut first = Cloud::FIRST;
        while let Some(points) = scans.next() {
            let last = if scans.peek().is_none() { Cloud::LAST } else { 0 };
            let head = CloudHead {
                sweep: sweep.number,
                generation: sweep.generation,
                count: points.len() as u16,
                flags: flags | std::mem::take(&mut first) | last,
                ..CloudHead::default()
            };
            if cloud.subscribers() == 0 {
                cloud.skip(1);
                continue;
            }
            let times = || points.iter().map(|point| point.stamp_ns);
            let (from_ns, until_ns) = (times().min().unwrap_or(0), times().max().unwrap_or(0));
            let header = header_of(cloud.next_number(), from_ns, until_ns);
            // Ignore errors. Subscribers detect a missing sample by the gap in the sequence numbers, and poll if they
            // cannot be woken.
            let _ = cloud.send_len_with(&header, Cloud::len(points.len()), |sample| {
                for (slot, point) in sample.begin(head).iter_mut().zip(points) {
                    *slot = CloudPoint {
                        at: point.at,
                        beam: point.beam,
                        point_class: point.class as u8,
                        ..CloudPoint::default()
                    };
                }
            });
        }
        let _ = obstacles.send_with(&header, |sample| *sample = *self.obstacles);
        let _ = sensor.wake(WakeEvent::Telegram);
        header
    }

    /// Reports a problem with the angles, or the end of a problem. If `mount` is given, reports a new delay of the
    /// angles' stamps.
    fn write_angles(
        &mut self,
        problem: Option<DropReason>,
        late_ns: i64,
        mount: Option<&str>,
    ) -> Result<(), ExitReason> {
        let line = TiltJson::Angles { sensor: self.results.name, problem, late_ns, mount };
        self.results.note(&line, |out| line.text(out))
    }
}

/// Returns the points of each scan in chunks of at most `most` points. Within a scan, beam indexes increase.
fn scans(points: &[Point], most: usize) -> impl Iterator<Item = &[Point]> {
    points.chunk_by(|one, next| one.beam < next.beam).flat_map(move |scan| scan.chunks(most.max(1)))
}

/// Lines that only `tilt` writes. The variant determines the class.
#[derive(Serialize)]
#[serde(tag = "class", rename_all = "snake_case")]
enum TiltJson<'a> {
    Angles {
        sensor: &'a str,
        problem: Option<DropReason>,
        #[serde(rename = "late_ms", serialize_with = "milliseconds")]
        late_ns: i64,
        /// Name of the mount, if the line reports a new delay.
        #[serde(skip)]
        mount: Option<&'a str>,
    },
    TiltCheck(Finding<'a>),
    Summary {
        sensor: &'a str,
        #[serde(flatten)]
        counts: Counts,
        missed: u64,
        /// Number of samples that were not published because memory was short.
        failed: u64,
        #[serde(rename = "late_ms", serialize_with = "milliseconds")]
        late_ns: i64,
    },
}

impl TiltJson<'_> {
    fn text(&self, out: &mut Vec<u8>) -> io::Result<()> {
        match self {
            TiltJson::Angles { mount: Some(mount), late_ns, .. } => write!(
                out,
                "the stamps of {mount}/tilt are {}, or its gears have play: corrected. Publish each angle with the time of \
                 its measurement",
                lateness(*late_ns)
            ),
            TiltJson::Angles { problem, .. } => {
                let text = match problem {
                    None => "the angles are reliable again",
                    Some(DropReason::Silent) => {
                        "no points: no angles arrive, or they are too late; is the program that publishes them \
                         running, and its clock right?"
                    }
                    Some(DropReason::Jumped) => "no points: the angles have jumped",
                    Some(DropReason::Inconsistent) => "no points: the angles contradict their rates",
                    Some(DropReason::Standing) => "no points: the mount stands, or its encoder is stuck",
                };
                out.write_all(text.as_bytes())
            }
            TiltJson::TiltCheck(Finding { name, state, finding, remedy, .. }) => {
                write!(out, "{state:<8} {name}: {finding}")?;
                if remedy.is_empty() { Ok(()) } else { write!(out, "; {remedy}") }
            }
            TiltJson::Summary { counts, missed, failed, late_ns, .. } => {
                let Counts { sweeps, incomplete, unreliable, scans, points, angles, .. } = counts;
                write!(
                    out,
                    "{sweeps} sweeps ({incomplete} incomplete, {unreliable} unreliable) of {scans} scans, "
                )?;
                let [silent, jumped, inconsistent, standing] = counts.points_dropped;
                write!(out, "{points} points; beams dropped: {silent} without an angle, {jumped} jumped, ")?;
                write!(out, "{inconsistent} inconsistent, {standing} standing; {angles} angles; dropped: ")?;
                let Counts { angles_out_of_order, angles_in_future, angles_invalid, .. } = counts;
                write!(
                    out,
                    "{angles_out_of_order} late, {angles_in_future} in the future, {angles_invalid} invalid, {missed} missed"
                )?;
                if *late_ns != 0 {
                    write!(out, "; stamps of angles {}, corrected", lateness(*late_ns))?;
                }
                if *failed > 0 { write!(out, "; {failed} not published: no memory") } else { Ok(()) }
            }
        }
    }
}

/// Converts ns to ms, rounded to one decimal.
fn late_ms(late_ns: i64) -> f64 {
    (late_ns as f64 / 1e5).round() / 10.0
}

fn milliseconds<S: Serializer>(late_ns: &i64, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_f64(late_ms(*late_ns))
}

/// Formats the delay of stamps as text.
fn lateness(late_ns: i64) -> String {
    format!("{:.1} ms {}", late_ms(late_ns).abs(), if late_ns < 0 { "early" } else { "late" })
}

/// Number of complete sweeps that a check needs.
const CHECKED_SWEEPS: u32 = 6;
/// Maximum error of the floor's height, in meters.
const MAX_HEIGHT_ERROR_M: f64 = 0.02;
/// Maximum error of level and roll, in degrees.
const MAX_LEVEL_ERROR_DEG: f64 = 0.3;
/// Maximum lean of a wall in degrees, without the part that the error of the level angle explains.
const MAX_LEAN_DEG: f64 = 0.5;

/// Result of one item of a check.
#[derive(Serialize)]
struct Finding<'a> {
    sensor: &'a str,
    name: &'static str,
    state: &'static str,
    off_m: Option<f64>,
    off_deg: Option<f64>,
    finding: String,
    remedy: String,
}

/// Writes a line for each item of a check.
///
/// # Errors
///
/// Returns [`Kind::Check`] if an item has failed.
fn write_findings(
    check: &MountCheck,
    mount: &Mount,
    results: &mut Results<'_, Cloud, Obstacles>,
) -> Result<(), ExitReason> {
    let findings = find(check, mount, results.name);
    let has_failed = findings.iter().any(|finding| finding.state == "failed");
    for finding in findings {
        let line = TiltJson::TiltCheck(finding);
        results.result(&line, |out| line.text(out))?;
    }
    if has_failed {
        let message = "the flags do not describe the mount";
        let hint = "the remedy is printed below each item that failed";
        return Err(Failure::new(Kind::Check, message, hint).into());
    }
    Ok(())
}

/// Evaluates each item of a check.
fn find<'a>(check: &MountCheck, mount: &Mount, sensor: &'a str) -> Vec<Finding<'a>> {
    let item =
        |name, off_m: Option<f64>, off_deg: Option<f64>, is_ok: bool, finding: String, remedy: String| {
            let (state, remedy) = if is_ok { ("ok", String::new()) } else { ("failed", remedy) };
            Finding { sensor, name, state, off_m, off_deg, finding, remedy }
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
            floor.height_m.abs() <= MAX_HEIGHT_ERROR_M,
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
            level_deg.abs() <= MAX_LEVEL_ERROR_DEG,
            format!("the floor rises by {level_deg:.2} degrees in the direction in which the mount tilts"),
            format!("--level {:.4}", mount.level_rad - floor.level_rad),
        ),
        item(
            "axis",
            None,
            Some(roll_deg),
            roll_deg.abs() <= MAX_LEVEL_ERROR_DEG,
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
                off_deg.abs() <= MAX_LEAN_DEG,
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn short_problems_are_not_reported() {
        const MS: u64 = 1_000_000;
        let mut problem = ProblemFilter::default();
        let (well, silent, jumped) = (None, Some(DropReason::Silent), Some(DropReason::Jumped));
        // No angle has arrived at the start.
        assert_eq!(problem.changed(1000 * MS, silent), None);
        assert_eq!(problem.changed(1027 * MS, well), None);
        assert_eq!(problem.changed(1400 * MS, silent), None);
        assert_eq!(problem.changed(1690 * MS, silent), None);
        assert_eq!(problem.changed(1700 * MS, silent), Some(silent));
        assert_eq!(problem.changed(1800 * MS, silent), None, "once");
        assert_eq!(problem.changed(1900 * MS, jumped), None);
        assert_eq!(problem.changed(2200 * MS, jumped), Some(jumped));
        assert_eq!([2300, 2600].map(|ms| problem.changed(ms * MS, well)), [None, Some(well)]);
    }

    #[test]
    fn points_are_split_by_scan_and_maximum() {
        let point = |beam| Point { beam, ..Point::default() };
        let points = [3, 4, 7, 1, 2, 2, 0, 1, 2].map(point);
        let lengths = |most| scans(&points, most).map(<[Point]>::len).collect::<Vec<_>>();
        assert_eq!(lengths(401), [3, 2, 1, 3]);
        assert_eq!(lengths(2), [2, 1, 2, 1, 2, 1]);
        assert_eq!(scans(&[], 9).count(), 0);
    }

    #[test]
    fn positions_axes_and_boxes_are_parsed_or_refused() {
        assert_eq!(numbers("0.1, -2,3"), Ok([0.1, -2.0, 3.0]));
        assert_eq!(numbers::<3>("1,2").unwrap_err(), "expected 3 numbers, found 2");
        assert_eq!(numbers::<1>("inf").unwrap_err(), "\"inf\" is not a number");
        assert!(axis("0,0,0").unwrap_err().contains("must not be 0,0,0"));
        assert_eq!(cuboid("0,1,-1,1,0.1,2"), Ok([[0.0, 1.0], [-1.0, 1.0], [0.1, 2.0]]));
        assert!(cuboid("1,0,-1,1,0.1,2").unwrap_err().contains("less"));
    }
}
