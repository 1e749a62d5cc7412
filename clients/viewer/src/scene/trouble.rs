//! Why nothing comes from a sensor, in words, and what a person does about it.

use scanhub_schema::{State, Status};

/// What is wrong, and its remedy.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Trouble {
    /// What is wrong.
    pub what: String,
    /// What to do: often a command. May be empty.
    pub remedy: String,
}

/// Of `sensor` with this status that sends no scans. What the link itself said comes first.
pub(crate) fn trouble(sensor: &str, status: Option<&Status>) -> Trouble {
    let Some(status) = status else {
        return Trouble { what: "nothing was heard of it yet".into(), remedy: String::new() };
    };
    let port = status.port();
    let check = || format!("scanhub doctor {port}");
    let (what, remedy) = match status.state() {
        Some(State::Absent) => {
            ("its port is not there", "plug its adapter in, or name the right port".into())
        }
        Some(State::Probing) => ("looking for the sensor and its rate", check()),
        Some(State::Switching) => ("changing the rate of its line", String::new()),
        Some(State::Starting) => ("starting its stream", String::new()),
        Some(State::Streaming) => ("its telegrams hold no scans yet", check()),
        Some(State::Silent) => ("its telegrams stopped", check()),
        Some(State::Paused) => ("paused on request", format!("scanhub control {sensor} resume")),
        None => ("in a state that this program does not know", "use hub and program of one version".into()),
    };
    let what = if status.last_error().is_empty() { what } else { status.last_error() };
    Trouble { what: what.to_owned(), remedy }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_state_has_words_and_the_links_own_come_first() {
        assert_eq!(trouble("front", None).what, "nothing was heard of it yet");
        let mut status = Status { state: State::Silent as u8, ..Status::default() };
        status.set_port("/dev/ttyUSB0");
        let silent = trouble("front", Some(&status));
        assert_eq!(silent.what, "its telegrams stopped");
        assert_eq!(silent.remedy, "scanhub doctor /dev/ttyUSB0");
        status.set_last_error("permission denied");
        assert_eq!(trouble("front", Some(&status)).what, "permission denied");
        for state in 0..=7 {
            let status = Status { state, ..Status::default() };
            assert!(!trouble("front", Some(&status)).what.is_empty(), "{state}");
        }
    }
}
