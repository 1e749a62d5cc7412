//! State of sensors and of the hub: the verdict as `std_msgs/msg/String`, diagnostics as
//! `diagnostic_msgs/msg/DiagnosticArray`.

use scanhub_schema::{State, Status, Verdict};

use crate::cdr::Cdr;

/// Appends the name of `verdict` to `message`: `clear`, `slow`, `stop` or `unknown`.
pub fn verdict_message(message: &mut Vec<u8>, verdict: Verdict) {
    Cdr::begin(message).text(verdict.name());
}

/// Appends the diagnostics of `sensor` at `now_ns` (since 1970) to `message`. `status` is the last status of the
/// sensor, or `None` if no hub publishes its status. `age_ns` is the age of the last scan.
pub fn diagnosis(
    message: &mut Vec<u8>,
    sensor: &str,
    now_ns: u64,
    status: Option<&Status>,
    age_ns: Option<u64>,
) {
    let (level, summary) = status.map_or((STALE, NO_HUB.to_owned()), assess);
    let hardware = status.map_or("", |status| status.sensor_type().trim());
    let values = status.map_or(Vec::new(), |status| values(status, age_ns));
    write(message, now_ns, level, [sensor, &summary, hardware], &values);
}

/// Appends the diagnostics of the hub at `now_ns` (since 1970) to `message`. These diagnostics report whether the hub
/// runs.
pub fn hub_diagnosis(message: &mut Vec<u8>, now_ns: u64, is_running: bool) {
    let (level, summary) = if is_running { (OK, "running") } else { (STALE, NO_HUB) };
    write(message, now_ns, level, ["hub", summary, ""], &[]);
}

/// Writes a DiagnosticArray with one status.
fn write(
    message: &mut Vec<u8>,
    now_ns: u64,
    level: u8,
    [name, summary, hardware]: [&str; 3],
    values: &[(&str, String)],
) {
    let mut cdr = Cdr::begin(message);
    cdr.header(now_ns, "");
    cdr.u32(1);
    cdr.u8(level);
    cdr.text(&format!("scanhub: {name}"));
    cdr.text(summary);
    cdr.text(hardware);
    cdr.u32(values.len() as u32);
    for (key, value) in values {
        cdr.text(key);
        cdr.text(value);
    }
}

/// Returns level and message of a status.
fn assess(status: &Status) -> (u8, String) {
    let state = status.state();
    let name = state.map_or("unknown state", State::name);
    let loss = status.line_loss();
    let level = match state {
        Some(State::Streaming) if loss.is_none() => OK,
        Some(State::Absent | State::Silent) => ERROR,
        _ => WARN,
    };
    (level, loss.map_or(name.to_owned(), |loss| format!("{name}, {loss}")))
}

/// Returns the values of a status, with their units in the keys.
fn values(status: &Status, age_ns: Option<u64>) -> Vec<(&'static str, String)> {
    let mut values = vec![
        ("state", status.state().map_or("unknown", State::name).to_owned()),
        ("rate_hz", (f64::from(status.rate_mhz) / 1e3).to_string()),
        ("damaged", status.damaged_share().to_string()),
    ];
    values.extend(status.lost_share().map(|share| ("lost", share.to_string())));
    values.extend(age_ns.map(|age| ("age_s", (age as f64 / 1e9).to_string())));
    values.push(("port", status.port().to_owned()));
    if !status.last_error().is_empty() {
        values.push(("last_error", status.last_error().to_owned()));
    }
    values
}

/// Message if no hub publishes the status.
const NO_HUB: &str = "no hub";

/// Levels of a `DiagnosticStatus`.
const OK: u8 = 0;
const WARN: u8 = 1;
const ERROR: u8 = 2;
const STALE: u8 = 3;

#[cfg(test)]
mod tests {
    use scanhub_schema::Counter;

    use super::*;
    use crate::{DIAGNOSTIC_ARRAY, STRING, Value, read};

    #[test]
    fn verdict_is_encoded_as_its_name() {
        let mut message = Vec::new();
        verdict_message(&mut message, Verdict::Unknown);
        assert_eq!(read(&STRING, &message).unwrap().text("data"), Some("unknown"));
    }

    fn diagnosis_of(status: Option<&Status>, age_ns: Option<u64>) -> Value {
        let mut message = Vec::new();
        diagnosis(&mut message, "front", 9_000_000_001, status, age_ns);
        read(&DIAGNOSTIC_ARRAY, &message).unwrap()
    }

    #[test]
    fn diagnostic_level_depends_on_state_and_line_loss() {
        let mut status = Status { rate_mhz: 37_500, ..Status::default() };
        status.set_sensor_type("LMS291-S05 30106");
        let mut diagnose = |state: State, damaged_ppm: u64| {
            status.state = state as u8;
            status.counters[Counter::DamagedPpm] = damaged_ppm;
            let decoded = diagnosis_of(Some(&status), Some(250_000_000));
            (
                decoded.number("status.0.level").unwrap() as u8,
                decoded.text("status.0.message").unwrap().to_owned(),
            )
        };
        assert_eq!(diagnose(State::Streaming, 0), (0, "streaming".to_owned()));
        assert_eq!(
            diagnose(State::Streaming, 430_000),
            (1, "streaming, 43 % damaged on the line".to_owned())
        );
        assert_eq!(diagnose(State::Probing, 0), (1, "probing".to_owned()));
        assert_eq!(diagnose(State::Silent, 0), (2, "silent".to_owned()));
        assert_eq!(diagnose(State::Absent, 0), (2, "absent".to_owned()));
        let decoded = diagnosis_of(Some(&status), Some(250_000_000));
        assert_eq!(
            (decoded.number("header.stamp.sec"), decoded.number("header.stamp.nanosec")),
            (Some(9.0), Some(1.0))
        );
        assert_eq!(decoded.text("status.0.name"), Some("scanhub: front"));
        assert_eq!(decoded.text("status.0.hardware_id"), Some("LMS291-S05 30106"));
        let values: Vec<_> = (0..decoded.sequence("status.0.values").unwrap().len())
            .map(|i| {
                let [key, value] =
                    ["key", "value"].map(|of| decoded.text(&format!("status.0.values.{i}.{of}")).unwrap());
                (key, value)
            })
            .collect();
        let wanted =
            [("state", "absent"), ("rate_hz", "37.5"), ("damaged", "0"), ("age_s", "0.25"), ("port", "")];
        assert_eq!(values, wanted);
    }

    #[test]
    fn sensor_without_a_hub_is_stale() {
        let decoded = diagnosis_of(None, None);
        assert_eq!(
            (decoded.number("status.0.level"), decoded.text("status.0.message")),
            (Some(3.0), Some("no hub"))
        );
    }

    #[test]
    fn hub_diagnostic_reports_running_or_missing() {
        let diagnoses = [true, false].map(|is_there| {
            let mut message = Vec::new();
            hub_diagnosis(&mut message, 9_000_000_001, is_there);
            let decoded = read(&DIAGNOSTIC_ARRAY, &message).unwrap();
            let text = |key: &str| decoded.text(key).unwrap().to_owned();
            (decoded.number("status.0.level").unwrap() as u8, text("status.0.name"), text("status.0.message"))
        });
        let wanted = [(0, "running"), (3, "no hub")];
        assert_eq!(
            diagnoses,
            wanted.map(|(level, words)| (level, "scanhub: hub".to_owned(), words.to_owned()))
        );
    }
}
