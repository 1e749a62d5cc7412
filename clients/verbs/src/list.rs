//! `scanhub list`: prints the topics of the running hub, or the live domains of this user.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use clap::Args;
use scanhub_client::streams::find;
use scanhub_schema::{Failure, Family, PublishRate, State, Status, Topic};
use scanhub_shm::{DEFAULT_DOMAIN, Domain, Environment, RunningHub, publisher_pid};
use scanhub_shm::{Node, Payload, PortFactory};
use serde::{Serialize, Serializer};

use crate::context::Context;
use crate::info::statuses;
use crate::output::{Output, table, verb_result};

/// List the sensors and topics of the running hub
#[derive(Args, Clone, Debug)]
#[command(after_help = "Example:\n  scanhub list")]
pub struct ListArgs {
    /// List the domains that are in use, instead of the sensors of one domain
    #[arg(long)]
    pub domains: bool,
}

impl ListArgs {
    /// Writes the topics of every sensor of the hub to stdout, with rate, subscribers, payload type and revision. In
    /// text output, the problems of the sensors follow.
    ///
    /// With `--domains`, writes every live domain instead, or only the domains below `--root` if it is given. The hubs
    /// that this user cannot reach follow, each with a command that reaches it.
    ///
    /// # Errors
    ///
    /// - [`Kind::NoHub`](scanhub_schema::Kind) within a second if no hub runs.
    /// - [`Kind::Interrupted`](scanhub_schema::Kind) if a signal ends the run.
    /// - The errors of [`Domain::candidates`], and the error of a write to stdout.
    pub fn run(&self, context: &mut Context) -> Result<(), Failure> {
        let (json, out) = (context.json, &mut context.out);
        match (self.domains, &context.domain.root) {
            (false, _) => topics(json, &context.domain.locations()?, out, &*context.signals.stop()?),
            (true, Some(root)) => domains(json, &[root.to_owned()], &[], out),
            (true, None) => {
                let hubs = RunningHub::all(Path::new("/"));
                domains(json, &Environment::of_process().bases(), &hubs, out)
            }
        }
    }
}

fn topics(json: bool, locations: &[Domain], out: &mut dyn Write, stop: &AtomicBool) -> Result<(), Failure> {
    let domain = find(locations)?;
    let node = scanhub_shm::client_node(&domain)?;
    let sensors = scanhub_shm::sensors(&domain)?;
    let (mut lines, mut problems) = (Vec::new(), Vec::new());
    for sensor in &sensors {
        of_sensor(&node, sensor, &mut lines)?;
    }
    for (sensor, status) in statuses(&domain, &scanhub_shm::links(&domain)?, stop)? {
        for line in lines
            .iter_mut()
            .filter(|line| line.sensor == sensor && line.topic.spec().publish_rate == PublishRate::Scan)
        {
            // A telegram is a scan only for an LMS. For other scanners, `hz` measures the rate of telegrams.
            let is_of_scans =
                |status: &&Status| line.topic != Topic::Telegram || status.family() == Some(Family::Lms);
            line.hz = status.as_ref().filter(is_of_scans).and_then(Status::rate_hz);
        }
        if let Some(status) = status.filter(|status| !status.last_error().is_empty()) {
            // A port that is in use or forbidden is not absent. The message states the reason.
            let state = match status.state() {
                Some(State::Absent) => String::new(),
                state => format!("{}: ", state.map_or("unknown", State::name)),
            };
            problems.push(format!("{sensor}: {state}{}", status.last_error()));
        }
    }
    let mut output = Output::new(out);
    if json {
        return verb_result(lines.iter().try_for_each(|line| output.json(line)));
    }
    let mut rows = vec![["TOPIC", "HZ", "SUBSCRIBERS", "PAYLOAD", "REVISION"].map(String::from).to_vec()];
    rows.extend(lines.iter().map(TopicJson::row));
    verb_result(
        table(&mut output, &rows).and_then(|()| {
            problems.iter().try_for_each(|problem| output.line(|line| write!(line, "{problem}")))
        }),
    )
}

/// Writes every live domain below `bases`, and the domains of `hubs` in other directories. The hubs that this user
/// cannot reach follow.
fn domains(json: bool, bases: &[PathBuf], hubs: &[RunningHub], out: &mut dyn Write) -> Result<(), Failure> {
    #[derive(Serialize)]
    struct DomainJson {
        class: &'static str,
        domain: String,
        root: PathBuf,
        pid: u32,
    }
    /// A hub whose files this user cannot read or find.
    #[derive(Serialize)]
    struct UnreachableHubJson<'a> {
        class: &'static str,
        domain: Option<&'a str>,
        pid: u32,
        user: &'a str,
        remedy: String,
    }
    let mut lines = Vec::new();
    for base in bases {
        for entry in base.read_dir().into_iter().flatten().flatten() {
            let Some(domain) = entry.file_name().to_str().and_then(|name| Domain::at(name, base).ok()) else {
                continue;
            };
            // Do not list a domain of another user here.
            if let Ok(Some(pid)) = publisher_pid(domain.root()) {
                let root = domain.root().to_owned();
                lines.push(DomainJson { class: "domain", domain: domain.name().to_owned(), root, pid });
            }
        }
    }
    let caller = Environment::of_process();
    let mut unreachable = Vec::new();
    for hub in hubs {
        if lines.iter().any(|line| line.pid == hub.pid) {
            continue;
        }
        let location = hub.domain.as_ref().zip(hub.base.as_ref());
        let location = location.and_then(|(domain, base)| Domain::at(domain, base).ok());
        match location {
            Some(place) if publisher_pid(place.root()) == Ok(Some(hub.pid)) => {
                let root = place.root().to_owned();
                lines.push(DomainJson {
                    class: "domain",
                    domain: place.name().to_owned(),
                    root,
                    pid: hub.pid,
                });
            }
            place => unreachable.push(UnreachableHubJson {
                class: "unreachable",
                domain: hub.domain.as_deref(),
                pid: hub.pid,
                user: &hub.user,
                remedy: match place {
                    Some(place) if hub.uid == caller.uid => format!(
                        "it is starting, or it runs in a container: it does not hold {} here",
                        place.root().display()
                    ),
                    _ => hub.command("list", DEFAULT_DOMAIN, &caller),
                },
            }),
        }
    }
    lines.sort_by(|a, b| a.root.cmp(&b.root));
    let mut output = Output::new(out);
    if json {
        return verb_result(
            lines
                .iter()
                .try_for_each(|line| output.json(line))
                .and_then(|()| unreachable.iter().try_for_each(|line| output.json(line))),
        );
    }
    let mut rows = vec![["DOMAIN", "PID", "ROOT"].map(String::from).to_vec()];
    rows.extend(
        lines.iter().map(|it| vec![it.domain.clone(), it.pid.to_string(), it.root.display().to_string()]),
    );
    verb_result(table(&mut output, &rows).and_then(|()| {
        unreachable.iter().try_for_each(|UnreachableHubJson { domain, pid, user, remedy, .. }| {
            let domain = domain.map_or_else(String::new, |domain| format!(" in domain {domain}"));
            output.line(|line| write!(line, "user {user} runs a hub{domain}, process {pid}: {remedy}"))
        })
    }))
}

/// JSON line of class `topic`. The rate is the scan rate that the hub measures. The rate is null if the hub reports no
/// rate, and for topics that are not published once per scan. Marks and foreground are published only while they have a
/// subscriber.
#[derive(Serialize)]
struct TopicJson {
    class: &'static str,
    sensor: String,
    #[serde(serialize_with = "name")]
    topic: Topic,
    payload: &'static str,
    revision: u32,
    hz: Option<f64>,
    subscribers: usize,
}

impl TopicJson {
    fn row(&self) -> Vec<String> {
        vec![
            format!("{}/{}", self.sensor, self.topic.name()),
            self.hz.map_or_else(|| "-".into(), |hz| format!("{hz:.2}")),
            self.subscribers.to_string(),
            self.payload.to_owned(),
            self.revision.to_string(),
        ]
    }
}

macro_rules! lines {
    ($($topic:ident $payload:tt, $name:ident, $($column:tt),*: $about:literal;)*) => {
        /// Adds a line for each topic of `sensor`.
        fn of_sensor(node: &Node, sensor: &str, lines: &mut Vec<TopicJson>) -> Result<(), Failure> {
            $(lines.extend(line::<scanhub_schema::payload_type!($payload)>(node, sensor)?);)*
            Ok(())
        }
    };
}

scanhub_schema::for_each_topic!(lines);

fn line<P: Payload + ?Sized>(node: &Node, sensor: &str) -> Result<Option<TopicJson>, Failure> {
    let topic = P::TOPIC;
    Ok(P::open(node, sensor)?.map(|service| TopicJson {
        class: "topic",
        sensor: sensor.to_owned(),
        topic,
        payload: topic.payload(),
        revision: scanhub_shm::payload_revision(service.attributes()),
        hz: None,
        subscribers: service.dynamic_config().number_of_subscribers(),
    }))
}

fn name<S: Serializer>(topic: &Topic, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_str(topic.name())
}
