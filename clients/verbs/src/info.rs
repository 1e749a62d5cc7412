//! `scanhub info`: prints the state of links and their sensors, from the last status of each.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use clap::Args;
use scanhub_client::clock;
use scanhub_client::streams::{STARTUP_GRACE, Session, TopicReader, find};
use scanhub_schema::{Counter, Failure, Family, Kind, Pose, Status, check_any_sensor};
use scanhub_shm::{Domain, is_starting};

use crate::context::Context;
use crate::json;
use crate::names::{as_argument, no_sensor};
use crate::output::{Output, table, verb_result};

/// Show state, settings and counters of sensors
#[derive(Args, Clone, Debug)]
#[command(after_help = "Example:\n  scanhub info front")]
pub struct InfoArgs {
    /// Sensor to show [default: all]
    pub sensor: Option<String>,
}

impl InfoArgs {
    /// Writes state, properties, counters and last error of the sensors to stdout.
    ///
    /// # Errors
    ///
    /// - [`Kind::NoHub`] within a second if no hub runs.
    /// - [`Kind::NoTopic`] if the sensor does not exist; the message lists the sensors.
    /// - [`Kind::Timeout`] if the status of a sensor does not arrive.
    /// - [`Kind::Interrupted`] if a signal stops the run.
    pub fn run(&self, context: &mut Context) -> Result<(), Failure> {
        let (locations, stop) = (context.domain.locations()?, context.signals.stop()?);
        self.sensor.iter().try_for_each(|sensor| as_argument(check_any_sensor(sensor)))?;
        let domain = find(&locations)?;
        let sensors = selected_sensors(self.sensor.as_deref(), &domain)?;
        let now_ns = clock::now().monotonic_ns;
        let mut output = Output::new(&mut context.out);
        for (sensor, status) in statuses(&domain, &sensors, &stop)? {
            let Some(status) = status else {
                let hint = "the hub runs but does not publish: check its log";
                return Err(Failure::new(Kind::Timeout, format!("no status of {sensor} arrived"), hint));
            };
            verb_result(if context.json {
                output.json(&json::status(&sensor, &status))
            } else {
                table(&mut output, &properties(&sensor, &status, now_ns))
                    .and_then(|()| table(&mut output, &counters(&status)))
            })?;
        }
        Ok(())
    }
}

/// Returns the sensors to print. If a sensor is missing, waits for it while the hub may still be starting.
fn selected_sensors(sensor: Option<&str>, domain: &Domain) -> Result<Vec<String>, Failure> {
    let deadline = Instant::now() + STARTUP_GRACE;
    loop {
        let sensors = scanhub_shm::links(domain)?;
        match sensor {
            None => return Ok(sensors),
            Some(sensor) if sensors.iter().any(|it| it == sensor) => return Ok(vec![sensor.to_owned()]),
            Some(sensor) if Instant::now() >= deadline && !is_starting(domain.root())? => {
                return Err(no_sensor(sensor, &sensors));
            }
            Some(_) => std::thread::sleep(RETRY_INTERVAL),
        }
    }
}

/// Returns the last status of each sensor in `sensors`; `None` if the status does not arrive in time.
pub(crate) fn statuses(
    domain: &Domain,
    sensors: &[String],
    stop: &AtomicBool,
) -> Result<Vec<(String, Option<Status>)>, Failure> {
    let deadline = Instant::now() + STATUS_TIMEOUT;
    let mut session = Session::new(vec![domain.clone()]);
    let mut followers: Vec<_> = sensors.iter().map(|sensor| TopicReader::<Status>::new(sensor)).collect();
    let mut found: Vec<_> = sensors.iter().map(|sensor| (sensor.clone(), None)).collect();
    loop {
        session.check_hub()?;
        for (reader, (_, status)) in followers.iter_mut().zip(&mut found) {
            while let Some(sample) = reader.receive(&mut session)? {
                *status = Some(*sample);
            }
        }
        if found.iter().all(|(_, status)| status.is_some()) || Instant::now() >= deadline {
            return Ok(found);
        }
        if stop.load(Ordering::Relaxed) {
            return Err(Failure::new(Kind::Interrupted, "interrupted", ""));
        }
        session.wait(Some((Instant::now() + RETRY_INTERVAL).min(deadline)))?;
    }
}

/// Maximum wait for a status. Unless the machine is busy, a new subscriber receives the last status within 100 ms.
const STATUS_TIMEOUT: Duration = Duration::from_secs(5);

/// Interval between polls. The hub sends the history without waking the subscriber.
const RETRY_INTERVAL: Duration = Duration::from_millis(10);

fn properties(sensor: &str, status: &Status, now_ns: u64) -> Vec<Vec<String>> {
    let seconds = now_ns.saturating_sub(status.since_ns) as f64 / 1e9;
    let state = status.state().map_or("unknown", |state| state.name());
    let step_deg = f64::from(status.resolution_cdeg) / 100.0;
    let known = |text: String, known: bool| if known { text } else { "unknown".into() };
    let row = |label: &str, value: String| vec![format!("{label:<LABEL_WIDTH$}"), value];
    let mut rows = vec![
        row(sensor, format!("{state} for {seconds:.1} s")),
        row("  family", status.family().map_or("unknown", |family| family.name()).into()),
        row(
            "  model",
            status.model().map_or_else(|| "unknown".into(), |model| Status::display_model(&model)),
        ),
        row("  type", known(status.sensor_type().into(), !status.sensor_type().is_empty())),
        row("  port", status.port().into()),
        row("  baud rate", known(format!("{} Bd", status.baud), status.baud != 0)),
        row("  unit", known(format!("{} mm", status.unit_mm), status.unit_mm != 0)),
        row(
            "  view",
            known(format!("{} deg in steps of {step_deg}", status.angle_deg), status.angle_deg != 0),
        ),
        row("  rate", status.rate_hz().map_or_else(|| "unknown".into(), |hz| format!("{hz:.2} Hz"))),
        row("  line", line(status)),
        row("  pose", pose(&status.pose)),
        row("  marks", marks(sensor, status)),
    ];
    if let Some(mode) = mode(status) {
        rows.insert(6, row("  mode", mode));
    }
    if !status.last_error().is_empty() {
        rows.push(row("  last error", status.last_error().into()));
    }
    rows
}

/// Returns the number of an LMS's measuring mode, or the name of another scanner's mode. Returns `None` for a scanner
/// that has only one mode.
fn mode(status: &Status) -> Option<String> {
    match status.mode {
        Status::MODE_UNKNOWN if status.family() == Some(Family::Lms) => Some("unknown".into()),
        Status::MODE_UNKNOWN => status.mode_name().map(str::to_owned),
        mode => Some(format!("{mode:02x}h")),
    }
}

/// Returns the losses on the line, in the last 10 s and since the hub's start.
fn line(status: &Status) -> String {
    if let Some((discarded, read)) = status.discarded_and_read() {
        return format!("{discarded} of {read} bytes were in no intact telegram, and no scans arrive");
    }
    let percent = |share: f64| format!("{:.2} %", 100.0 * share);
    let lost = match (status.lost_on_line(), status.lost_share()) {
        (Some(lost), Some(share)) => {
            let due = status.counters[Counter::DueOnLine];
            format!(
                "{} of the {} lost in 10 s, {lost} of {due} in all",
                percent(share),
                status.transmission_name()
            )
        }
        _ => "the loss is unknown".to_owned(),
    };
    format!("{} of the bytes damaged, {lost}", percent(status.damaged_share()))
}

fn pose(pose: &Pose) -> String {
    let Pose { x_m, y_m, yaw_rad, upside_down, .. } = pose;
    let mounted = if *upside_down == 0 { "" } else { ", upside down" };
    format!("x {x_m} m, y {y_m} m, yaw {:.1} deg{mounted}", yaw_rad.to_degrees())
}

fn marks(sensor: &str, status: &Status) -> String {
    let is_lms = status.family() == Some(Family::Lms);
    match (status.has_marks(), json::marks_remedy(sensor, status)) {
        (None, _) if is_lms && status.is_replayed() => {
            format!("unavailable: the recording does not contain its measuring mode; set link.{sensor}.mode")
        }
        (None, _) => "unknown".into(),
        (Some(true), _) => "available".into(),
        (Some(false), None) => "unavailable: the recording has no reflector bits".into(),
        (Some(false), Some(remedy)) if is_lms => format!("unavailable: no reflector bits; `{remedy}`"),
        (Some(false), Some(remedy)) => format!("unavailable: {remedy}"),
    }
}

fn counters(status: &Status) -> Vec<Vec<String>> {
    status
        .counters
        .named_values()
        .map(|(name, value)| vec![format!("  {name:<0$}", LABEL_WIDTH - 2), value.to_string()])
        .collect()
}

/// Width of the labels: the longest counter name with its indent.
const LABEL_WIDTH: usize = 21;
