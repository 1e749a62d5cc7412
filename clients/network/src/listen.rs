//! `scanhub listen`: receives samples from gateways, prints or publishes them, and counts those that did not arrive.
//!
//! With `--publish`, a datagram takes this path. `Listener::receive_batch` reads the socket and calls
//! `RemoteReceiver::handle_datagram`, which runs all other steps in this order. Subscribers are woken after each batch.
//!
//! | step | code | work |
//! |---|---|---|
//! | socket | `MulticastReceiver::receive` | returns the bytes, the sender and the time of arrival |
//! | header | `Incoming::receive_named` | checks length, checksum and `--hub`, then the MAC if there is a key |
//! | parts | `Incoming::complete` | waits for all parts of a sample, and continues with the last one |
//! | gateway | `GatewayTable::take` | checks run, sender, sequence number and payload, and counts the sample |
//! | sample | `RemoteReceiver::on_sample` | prints the sample, or passes it on |
//! | publisher | `Republisher::sample` | copies it into the topic of its sensor |

mod multicast_receiver;

use std::net::SocketAddrV4;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use clap::Args;
use scanhub_schema::datagram::{Announce, group};
use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{Failure, Kind, Topic};
use scanhub_shm::{Domain, StateDirectory};
use scanhub_verbs::context::Context;
use scanhub_verbs::follow::RunLimits;
use scanhub_verbs::output::{ExitReason, Output, verb_result};

use self::multicast_receiver::{MAX_DATAGRAM_LEN, MulticastReceiver};
use crate::key_file;
use crate::remote_receiver::{ClassNames, Origin, ReceiverConfig, RemoteReceiver};

/// Receive topics from gateways of other machines, and show what was lost
#[derive(Args, Debug)]
#[command(after_help = AFTER_HELP)]
pub struct ListenArgs {
    /// Network interface to listen on [default: all that have a link]
    #[arg(long, value_name = "IF")]
    interface: Option<String>,
    /// Topic to receive from all sensors, for example zones [default: all topics]
    #[arg(long = "topic", value_name = "TOPIC")]
    topics: Vec<String>,
    /// Name for a hub, in place of its 16 hex digits, for example robot1=5f3a12bc00d1e2f3
    #[arg(long = "name", value_name = "NAME=HUB")]
    names: Vec<String>,
    /// Hub to receive from: its 16 hex digits, or its name from --name [default: all]
    #[arg(long = "hub", value_name = "HUB")]
    hubs: Vec<String>,
    /// Accept only datagrams that are authenticated with the key in this file, and each of them once. The clocks of
    /// sender and receiver must agree within 5 s
    #[arg(long, value_name = "FILE")]
    key_file: Option<PathBuf>,
    /// Print only the counts: received, lost, duplicate, reordered, refused
    #[arg(long)]
    stats: bool,
    /// Publish the received topics in a domain of this machine as HUB.SENSOR/TOPIC, instead of printing them. All
    /// programs here can use them like topics of a hub
    #[arg(long)]
    publish: bool,
    /// Maximum number of subscribers of each published topic, 1 to 250
    #[arg(long, value_name = "N", requires = "publish", default_value_t = 32, value_parser = clap::value_parser!(u16).range(1..=250))]
    subscribers: u16,
    /// Shared memory that all published topics may take together, in MB (2^20 bytes). A sensor that does not fit is
    /// refused
    #[arg(long, value_name = "MB", requires = "publish", default_value_t = 64, value_parser = clap::value_parser!(u32).range(1..))]
    memory: u32,
    #[command(flatten)]
    limits: RunLimits,
}

/// Example and signals, for the end of the help.
const AFTER_HELP: &str = "\
Example:
  scanhub listen --interface eth0 --stats

SIGUSR1: print the counts so far";

impl ListenArgs {
    /// Prints received samples to stdout, and the counters at the end and after each SIGUSR1. Everything else goes to
    /// stderr, or to stdout with `--json`. Ends when a limit from the options is reached, a signal stops the listener,
    /// or the reader has closed stdout.
    ///
    /// With `--publish`, samples are published instead of printed, without a copy for each subscriber. Only one
    /// listener may publish in a domain.
    ///
    /// # Errors
    ///
    /// Returns
    ///
    /// - [`Kind::Usage`] if a named topic does not exist,
    /// - [`Kind::Configuration`] if the named interface does not exist, or a name or hub is not valid,
    /// - [`Kind::DomainHeld`] if another listener publishes in the domain,
    /// - [`Kind::ResourceExhausted`] if there is too little memory for publishing,
    /// - [`Kind::Failed`] if the UDP port is not available,
    /// - [`Kind::Timeout`] if too few samples arrive in time, or [`Kind::Interrupted`] if a signal stops the run before
    ///   a limit from the options is reached.
    pub fn run(&self, context: &mut Context) -> Result<(), Failure> {
        let (report_requested, stop) = (context.signals.report()?, context.signals.stop()?);
        let publish = self.publish.then(|| context.domain.of_publisher()).transpose()?;
        let is_drawn = self.stats && !context.json && context.is_terminal;
        let topics = topics(&self.topics)?;
        let key = self.key_file.as_deref().map(key_file::read).transpose()?;
        let (groups, now) = (groups(&topics), Instant::now());
        let config = ReceiverConfig {
            // Announcements of topics whose group is not joined are ignored, because the samples of these topics would
            // count as lost.
            announced_topics: Topic::ALL
                .into_iter()
                .filter(|&topic| groups.contains(&group(topic)))
                .collect(),
            topics,
            names: &self.names,
            hubs: &self.hubs,
            key,
            state: StateDirectory::of_domain(&context.domain.name),
            publish: publish.as_ref(),
            limits: TopicLimits { subscribers: self.subscribers.into(), ..TopicLimits::default() },
            memory: u64::from(self.memory) << 20,
            only_proven: self.key_file.is_none(),
            stats: self.stats,
        };
        let (out, notes) = (Output::new(&mut context.out), Output::new(&mut context.notes));
        let remote_receiver = RemoteReceiver::open(config, context.json, ClassNames::LAN, out, notes)?;
        let receiver = MulticastReceiver::open(self.interface.as_deref(), &groups, now)?;
        let mut listener =
            Listener { args: self, publish, is_drawn, receiver, remote_receiver, started: now, draw_at: now };
        verb_result(listener.listen(&report_requested, &stop))
    }
}

/// A running listener.
struct Listener<'a> {
    args: &'a ListenArgs,
    publish: Option<Domain>,
    /// Whether the counters are drawn on a terminal.
    is_drawn: bool,
    receiver: MulticastReceiver,
    remote_receiver: RemoteReceiver<'a>,
    started: Instant,
    draw_at: Instant,
}

/// Maximum number of datagrams that are handled in a row. Then the other work is done, so that the listener can end
/// even during a flood of datagrams.
const BATCH_SIZE: usize = 64;

/// Maximum sleep, after which interfaces and reasons to stop are checked.
const MAX_SLEEP: Duration = Duration::from_millis(100);

/// Interval at which the counters are drawn on a terminal.
const DRAW_INTERVAL: Duration = Duration::from_secs(1);

impl Listener<'_> {
    /// Prints the first lines, runs the listener, and prints the final counters.
    fn listen(&mut self, report_requested: &AtomicBool, stop: &AtomicBool) -> Result<(), ExitReason> {
        self.remote_receiver.report.ready(&self.receiver.interfaces(), self.publish.as_ref())?;
        self.remote_receiver.begin()?;
        let end = self.run(report_requested, stop);
        if !matches!(end, Err(ExitReason::ReaderClosed)) {
            self.remote_receiver.report_counters(&[])?;
        }
        end
    }

    /// Receives until a limit from the options is reached or `stop` is set.
    fn run(&mut self, report_requested: &AtomicBool, stop: &AtomicBool) -> Result<(), ExitReason> {
        let mut buffer = vec![0; MAX_DATAGRAM_LEN];
        loop {
            let may_have_more = self.receive_batch(&mut buffer)?;
            self.remote_receiver.wake();
            let (now, limits) = (Instant::now(), &self.args.limits);
            if self.has_all_samples() {
                return Ok(());
            }
            if stop.load(Ordering::Relaxed) {
                return self.end_of_stop();
            }
            if limits.run_for.is_some_and(|limit| now - self.started >= limit) {
                return self.end_of_time();
            }
            if let Some(limit) =
                limits.timeout.filter(|&limit| now - self.remote_receiver.last_sample >= limit)
            {
                return Err(nothing_arrived(limit).into());
            }
            self.do_periodic_work(now, may_have_more)?;
            if report_requested.swap(false, Ordering::Relaxed) {
                self.remote_receiver.report_counters(&[])?;
            }
            if !may_have_more {
                self.receiver.wait(self.time_to_sleep(now));
            }
        }
    }

    /// Handles waiting datagrams, up to a batch. Returns whether there may be more.
    fn receive_batch(&mut self, buffer: &mut [u8]) -> Result<bool, ExitReason> {
        for _ in 0..BATCH_SIZE {
            let Some(datagram) = self.receiver.receive(buffer)? else { return Ok(false) };
            let origin = Origin {
                sender: sender_id(datagram.from),
                address: Some((*datagram.from.ip()).into()),
                name: None,
                arrival: datagram.arrival,
            };
            self.remote_receiver.handle_datagram(datagram.bytes, origin)?;
            if self.has_all_samples() {
                return Ok(true);
            }
        }
        Ok(true)
    }

    /// Returns whether the requested number of samples has arrived.
    fn has_all_samples(&self) -> bool {
        self.args.limits.count.is_some_and(|count| self.remote_receiver.received >= count)
    }

    /// Does what is due at `now`: updates the interfaces, reports problems and silent sensors, and draws the counters.
    fn do_periodic_work(&mut self, now: Instant, may_have_more: bool) -> Result<(), ExitReason> {
        self.receiver.update_interfaces(now);
        if let Some(what) = self.receiver.take_problem() {
            self.remote_receiver.problem(&what)?;
        }
        self.remote_receiver.do_periodic_work(now, may_have_more)?;
        if self.is_drawn && now >= self.draw_at {
            self.draw_at = now + DRAW_INTERVAL;
            self.remote_receiver.draw()?;
        }
        Ok(())
    }

    /// Returns the time until a limit from the options is reached, but at most [`MAX_SLEEP`].
    fn time_to_sleep(&self, now: Instant) -> Duration {
        let limits = &self.args.limits;
        let end = limits.run_for.and_then(|limit| self.started.checked_add(limit));
        let silence = limits.timeout.and_then(|limit| self.remote_receiver.last_sample.checked_add(limit));
        let first = [end, silence].into_iter().flatten().min();
        first.map_or(MAX_SLEEP, |at| at.saturating_duration_since(now).min(MAX_SLEEP))
    }

    /// Returns the result of a run that `stop` has ended.
    fn end_of_stop(&self) -> Result<(), ExitReason> {
        if self.args.limits.is_bounded() {
            return Err(Failure::new(Kind::Interrupted, "interrupted before the end", "").into());
        }
        Ok(())
    }

    /// Returns the result of a run whose time has elapsed.
    fn end_of_time(&self) -> Result<(), ExitReason> {
        match self.args.limits.count {
            Some(count) => {
                let what = format!("{} of {count} samples arrived in time", self.remote_receiver.received);
                Err(Failure::new(Kind::Timeout, what, NOTHING_ARRIVED_HINT).into())
            }
            None => Ok(()),
        }
    }
}

/// Returns a number that identifies the sender at this address and port. Gateways are distinguished by it.
fn sender_id(from: SocketAddrV4) -> u64 {
    u64::from(from.ip().to_bits()) << 16 | u64::from(from.port())
}

fn nothing_arrived(limit: Duration) -> Failure {
    Failure::new(Kind::Timeout, format!("nothing arrived for {limit:?}"), NOTHING_ARRIVED_HINT)
}

/// Hint for a timeout.
const NOTHING_ARRIVED_HINT: &str = "is `scanhub gateway` running in the same network? `scanhub listen --stats` counts what is \
                            refused, --interface names another interface";

/// Returns the topics with these names, or all topics if `names` is empty.
fn topics(names: &[String]) -> Result<Vec<Topic>, Failure> {
    if names.is_empty() {
        return Ok(Topic::ALL.to_vec());
    }
    let known: Vec<_> = Topic::ALL.iter().map(|topic| topic.name()).collect();
    let parse = |name: &String| {
        Topic::parse(name).ok_or_else(|| {
            let hint = format!("there are {}; they are those of all sensors", known.join(", "));
            Failure::new(Kind::Usage, format!("no topic {name:?}"), hint)
        })
    };
    names.iter().map(parse).collect()
}

/// Returns the groups of `topics` and of announcements, without which sensors have no names.
fn groups(topics: &[Topic]) -> Vec<u8> {
    let mut groups = vec![Announce::GROUP];
    groups.extend(topics.iter().map(|&topic| group(topic)));
    groups.sort_unstable();
    groups.dedup();
    groups
}
