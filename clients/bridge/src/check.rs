//! `bridge --check`: connects for a test, and finds reasons why a bridge does not work, for example an unreachable
//! router, a wrong clock or another version. `scanhub doctor` shows the same findings. Nothing is sent or published.

use std::collections::BTreeMap;
use std::convert::Infallible;
use std::io::Write;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use scanhub_network::lan::address::{Address, LIVE, PREFIX, parse_live};
use scanhub_network::now;
use scanhub_schema::datagram::{Datagram, DatagramError};
use scanhub_schema::{Failure, Kind, Printable};
use scanhub_verbs::output::verb_result;
use serde::Serialize;

use crate::diagnosis::{Diagnosis, UNREACHED};
use crate::session::{CheckedConfig, Connection, LinkEvent, ZenohSession};
use crate::{BridgeOptions, now_s};

/// A finding: one line of output.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
struct Finding {
    class: &'static str,
    state: &'static str,
    finding: String,
    /// Remedy for the user, or an empty string.
    remedy: String,
}

/// Three time limits: for the first connection, for a connection to another router after one router has refused, and
/// for the announcements of the hubs.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);
const REFUSAL_TIMEOUT: Duration = Duration::from_secs(1);
const ANNOUNCEMENT_TIMEOUT: Duration = Duration::from_secs(2);
/// Interval between checks for a connection and for new sensors.
const POLL_INTERVAL: Duration = Duration::from_millis(20);
/// Maximum difference between the clocks of two machines. An announcement gets its stamp when it is created, and it
/// arrives within this time. A larger difference therefore means that a clock is wrong. A listener with a key has the
/// same limit.
const MAX_CLOCK_DIFFERENCE_NS: u64 = 5_000_000_000;
/// Maximum number of sensors that are queried. The number is limited because any connected program can announce
/// sensors.
const MAX_SENSORS: usize = 256;

/// Connects with `options`, and writes one line for each finding to `out`, as JSON if `options.json` is set.
///
/// # Errors
///
/// [`Kind::Check`] if something keeps the bridge from working, [`Kind::Interrupted`] if `stop` is set.
pub fn check(options: &BridgeOptions, stop: &AtomicBool, out: &mut dyn Write) -> Result<(), Failure> {
    let findings = find(options, stop)?;
    for finding in &findings {
        let written = if options.json {
            let line = serde_json::to_string(finding).unwrap_or_default();
            writeln!(out, "{}", Printable(&line))
        } else {
            let Finding { state, finding, remedy, .. } = finding;
            writeln!(out, "{state:<8} {}", Printable(finding)).and_then(|()| match remedy.as_str() {
                "" => Ok(()),
                remedy => writeln!(out, "{:9}{}", "", Printable(remedy)),
            })
        };
        verb_result(written.map_err(Into::into))?;
    }
    match findings.iter().filter(|finding| finding.state == "failed").count() {
        0 => Ok(()),
        _ => Err(Failure::new(
            Kind::Check,
            "the bridge would not work with these settings",
            "the remedy is printed below each problem",
        )),
    }
}

fn find(options: &BridgeOptions, stop: &AtomicBool) -> Result<Vec<Finding>, Failure> {
    let opened = CheckedConfig::read(options, now_s()).and_then(Connection::open);
    let connection = match opened {
        Ok(connection) => connection,
        Err(failure) => return Ok(vec![Finding::failed(failure.message, failure.hint)]),
    };
    connection.begin();
    let mut reasons = Vec::new();
    let mut is_linked = false;
    let begin = Instant::now();
    let mut end_at = begin + CONNECT_TIMEOUT;
    while !is_linked && Instant::now() < end_at && connection.failure().is_none() {
        if stop.load(Ordering::Relaxed) {
            return Err(Failure::new(Kind::Interrupted, "interrupted", ""));
        }
        thread::sleep(POLL_INTERVAL);
        let event = |event| {
            match event {
                LinkEvent::Up => is_linked = true,
                LinkEvent::Down => is_linked = false,
                LinkEvent::Failing(why) => reasons.push(why),
            }
            Ok::<_, Infallible>(())
        };
        let Ok(()) = connection.events(event);
        // A router has refused the client. Another router may still accept the client, but would reply soon.
        if Diagnosis::of(&reasons.join("; ")).is_some_and(|known| known != UNREACHED) {
            end_at = end_at.min(Instant::now() + REFUSAL_TIMEOUT);
        }
    }
    if let Some(failure) = connection.failure() {
        return Ok(vec![Finding::failed(failure.message, failure.hint)]);
    }
    let findings = match connection.session(&AtomicBool::new(true)) {
        Some(session) if is_linked => query_hubs(session)?,
        _ if !options.listen.is_empty() => {
            vec![Finding::ok("the bridge can listen; no client is connected yet".to_owned())]
        }
        _ => vec![unreachable(&reasons)],
    };
    connection.close();
    Ok(findings)
}

/// Returns the finding for a connection that failed for these `reasons`, which are messages of Zenoh.
fn unreachable(reasons: &[String]) -> Finding {
    let message = reasons.join("; ");
    let Diagnosis { finding, remedy } = Diagnosis::of(&message).unwrap_or(UNREACHED);
    let message = if message.is_empty() { finding.to_owned() } else { format!("{finding}: {message}") };
    Finding::failed(message, remedy)
}

/// Replies of the hubs by ID. A reply is the time by which this machine's clock is ahead of the hub's clock, in ns, or
/// the error in the hub's datagram.
type HubReplies = BTreeMap<u64, Result<i64, DatagramError>>;

/// Queries all sensors for their announcements, and returns the findings about their hubs.
fn query_hubs(session: &ZenohSession) -> Result<Vec<Finding>, Failure> {
    let live_sensors: Arc<Mutex<Vec<String>>> = Arc::default();
    let replies: Arc<Mutex<HubReplies>> = Arc::default();
    let (tokens, begin) = (live_sensors.clone(), Instant::now());
    let _tokens = session.watch(&format!("{PREFIX}/*/*/{LIVE}"), move |key| {
        let mut tokens = tokens.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((hub, sensor)) = parse_live(key).filter(|_| tokens.len() < MAX_SENSORS) {
            tokens.push(Address { hub, sensor, topic: None }.to_string());
        }
    })?;
    let mut queried = 0;
    while begin.elapsed() < ANNOUNCEMENT_TIMEOUT {
        thread::sleep(POLL_INTERVAL);
        let new_keys = live_sensors.lock().unwrap_or_else(PoisonError::into_inner)[queried..].to_vec();
        queried += new_keys.len();
        for key in new_keys {
            let replies = replies.clone();
            session.query(&key, usize::from(u16::MAX), move |key, payload| {
                let Some(Address { hub, .. }) = Address::parse(key) else { return };
                let ahead_ns = match Datagram::read(&payload.unwrap_or_default()) {
                    Ok(datagram) => Ok(now().wall_ns.wrapping_sub(datagram.head.stamp_ns) as i64),
                    Err(error) => Err(error),
                };
                replies.lock().unwrap_or_else(PoisonError::into_inner).insert(hub, ahead_ns);
            })?;
        }
    }
    let replies = replies.lock().unwrap_or_else(PoisonError::into_inner);
    Ok(check_hubs(&replies))
}

fn check_hubs(hubs: &HubReplies) -> Vec<Finding> {
    let bad = |(hub, reply): (&u64, &Result<i64, DatagramError>)| match reply {
        Err(DatagramError::Version) => Some(Finding::failed(
            format!("hub {hub:016x} uses another version"),
            "install the same version of scanhub-bridge on both machines",
        )),
        Err(error) => Some(Finding::failed(
            format!("the announcement of hub {hub:016x} was rejected as `{}`", error.name()),
            "another program sends under its ID: check the access control of the router",
        )),
        Ok(ahead_ns) if ahead_ns.unsigned_abs() > MAX_CLOCK_DIFFERENCE_NS => {
            let (seconds, which) =
                (ahead_ns.unsigned_abs() / 1_000_000_000, if *ahead_ns > 0 { "behind" } else { "ahead of" });
            Some(Finding {
                state: "warning",
                ..Finding::failed(
                    format!("the clock of hub {hub:016x} is {seconds} s {which} this one"),
                    "synchronize the clocks of both machines (`timedatectl set-ntp true`): otherwise, ages are wrong",
                )
            })
        }
        Ok(_) => None,
    };
    let mut findings: Vec<Finding> = hubs.iter().filter_map(bad).collect();
    if findings.is_empty() {
        let text = match hubs.len() {
            0 => "no hub has announced itself".to_owned(),
            _ => {
                let names: Vec<String> = hubs.keys().map(|hub| format!("{hub:016x}")).collect();
                format!("hubs: {}; their clocks and versions match", names.join(", "))
            }
        };
        findings.push(Finding::ok(format!("connected; {text}")));
    }
    findings
}

impl Finding {
    fn ok(finding: String) -> Finding {
        Finding { class: "bridge_check", state: "ok", finding, remedy: String::new() }
    }

    fn failed(finding: impl Into<String>, remedy: impl Into<String>) -> Finding {
        let (finding, remedy) = (finding.into(), remedy.into());
        Finding { class: "bridge_check", state: "failed", finding, remedy }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unreachable_router_has_a_finding_and_a_remedy() {
        let failure =
            unreachable(&["Unable to connect to tls/r:1! invalid peer certificate: Expired".into()]);
        assert!(failure.state == "failed" && failure.remedy.contains("renew"), "{failure:?}");
        assert_eq!(
            failure.finding,
            "a certificate has expired: Unable to connect to tls/r:1! invalid peer certificate: Expired"
        );
        assert_eq!(unreachable(&[]).finding, "no router is reached");
    }

    #[test]
    fn clocks_and_versions_are_checked_per_hub() {
        const SECOND: i64 = 1_000_000_000;
        let of = |hubs: &[(u64, Result<i64, DatagramError>)]| check_hubs(&hubs.iter().copied().collect());
        let well = of(&[(1, Ok(SECOND)), (2, Ok(-4 * SECOND))]);
        assert!(
            well.len() == 1 && well[0].state == "ok" && well[0].finding.contains("0000000000000002"),
            "{well:?}"
        );
        assert!(of(&[])[0].finding.contains("no hub has announced"));
        let bad =
            of(&[(1, Ok(7 * SECOND)), (2, Ok(-60 * SECOND)), (3, Err(DatagramError::Version)), (4, Ok(0))]);
        let states: Vec<_> = bad.iter().map(|it| it.state).collect();
        assert_eq!(states, ["warning", "warning", "failed"]);
        assert!(bad[0].finding.ends_with("is 7 s behind this one"), "{bad:?}");
        assert!(bad[1].finding.ends_with("is 60 s ahead of this one"), "{bad:?}");
        assert!(bad[2].remedy.contains("same version"), "{bad:?}");
    }
}
