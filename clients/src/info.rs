//! `scanhub info`: how the links and their sensors are, from the last status that each has published.

use std::io::Write;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use schema::{Domain, Failure, Kind, Status, ipc};

use crate::follower::Follower;
use crate::json;
use crate::names::no_sensor;
use crate::output::{Output, quiet, table};
use crate::presence::find;
use crate::session::Session;

/// What `info` is asked for.
#[derive(Clone, Debug)]
pub struct InfoOptions {
    /// The sensor; none: all of them.
    pub sensor: Option<String>,
    /// Objects instead of text.
    pub json: bool,
    /// Where the domain may be, see [`Domain::candidates`].
    pub places: Vec<Domain>,
}

/// Writes state, properties, counters and last error of the sensors to `out`.
///
/// [`Kind::NoHub`] within a second if there is none, [`Kind::NoTopic`] with the sensors that there are,
/// [`Kind::Timeout`] if a sensor's status does not come, [`Kind::Interrupted`] if `stop` is set.
pub fn info(options: &InfoOptions, out: &mut dyn Write, stop: &AtomicBool) -> Result<(), Failure> {
    let domain = find(&options.places)?;
    let mut sensors = ipc::sensors(&domain)?;
    if let Some(wanted) = &options.sensor {
        if !sensors.contains(wanted) {
            return Err(no_sensor(wanted, &sensors));
        }
        sensors.retain(|sensor| sensor == wanted);
    }
    let now_ns = monotonic_ns();
    let mut output = Output::new(out);
    for (sensor, status) in statuses(&domain, &sensors, stop)? {
        let Some(status) = status else {
            let hint = "the hub is there and does not publish: look at its log";
            return Err(Failure::new(Kind::Timeout, format!("no status of {sensor} came"), hint));
        };
        quiet(if options.json {
            output.json(&json::status(&sensor, &status))
        } else {
            table(&mut output, &rows(&sensor, &status, now_ns))
        })?;
    }
    Ok(())
}

/// The last status of each of `sensors`, or none for one whose status does not come in time.
pub(crate) fn statuses(
    domain: &Domain,
    sensors: &[String],
    stop: &AtomicBool,
) -> Result<Vec<(String, Option<Status>)>, Failure> {
    let give_up_at = Instant::now() + PATIENCE;
    let mut session = Session::new(vec![domain.clone()]);
    let mut followers: Vec<_> = sensors.iter().map(|sensor| Follower::<Status>::new(sensor)).collect();
    let mut found: Vec<_> = sensors.iter().map(|sensor| (sensor.clone(), None)).collect();
    loop {
        session.look()?;
        for (follower, (_, status)) in followers.iter_mut().zip(&mut found) {
            while let Some(sample) = follower.receive(&mut session)? {
                *status = Some(*sample);
            }
        }
        if found.iter().all(|(_, status)| status.is_some()) || Instant::now() >= give_up_at {
            return Ok(found);
        }
        if stop.load(Ordering::Relaxed) {
            return Err(Failure::new(Kind::Interrupted, "interrupted", ""));
        }
        session.wait(Some((Instant::now() + ASK_AGAIN).min(give_up_at)))?;
    }
}

/// The hub hands its last status to newcomers ten times a second.
const PATIENCE: Duration = Duration::from_millis(1500);

/// The history comes without a wake-up.
const ASK_AGAIN: Duration = Duration::from_millis(10);

fn rows(sensor: &str, status: &Status, now_ns: u64) -> Vec<Vec<String>> {
    let unknown = |text: String, known: bool| if known { text } else { "unknown".into() };
    let seconds = now_ns.saturating_sub(status.since_ns) as f64 / 1e9;
    let state = status.state().map_or("unknown", |state| state.name());
    let step_deg = f64::from(status.resolution_cdeg) / 100.0;
    let mut rows = vec![
        vec![sensor.to_owned(), format!("{state} for {seconds:.1} s")],
        vec!["  type".into(), unknown(status.sensor_type().into(), !status.sensor_type().is_empty())],
        vec!["  port".into(), status.port().into()],
        vec!["  baud rate".into(), unknown(status.baud.to_string(), status.baud != 0)],
        vec!["  mode".into(), unknown(format!("{:02x}", status.mode), status.mode != Status::MODE_UNKNOWN)],
        vec!["  unit".into(), unknown(format!("{} mm", status.unit_mm), status.unit_mm != 0)],
        vec![
            "  view".into(),
            unknown(format!("{} degrees in steps of {step_deg}", status.angle_deg), status.angle_deg != 0),
        ],
        vec!["  rate".into(), format!("{:.2} Hz", f64::from(status.rate_mhz) / 1000.0)],
    ];
    if !status.last_error().is_empty() {
        rows.push(vec!["  last error".into(), status.last_error().into()]);
    }
    rows.extend(status.counters.named().map(|(name, value)| vec![format!("  {name}"), value.to_string()]));
    rows
}

fn monotonic_ns() -> u64 {
    let now = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
    now.tv_sec as u64 * 1_000_000_000 + now.tv_nsec as u64
}
