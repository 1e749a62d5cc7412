//! `scanhub listen`: receives what gateways send, and prints or publishes it with counters of what did not arrive.
//!
//! The path of a datagram, from top to bottom:
//!
//! 1. The socket ([`MulticastReceiver::receive`]) returns its bytes, sender and time of arrival.
//! 2. The header: [`Incoming::receive`](crate::lan::incoming::Incoming::receive) checks the lengths and the checksum, whether
//!    the gateway was selected by `--hub`, and the MAC if there is a key.
//! 3. Parts: the sample is complete with the last of them.
//! 4. The gateway: [`GatewayTable`](crate::lan::GatewayTable) checks the run, the sender, the sequence number and the payload,
//!    and counts the sample.
//! 5. The sample: [`Reception::take`] prints it, or passes it on.
//! 6. The publisher: [`Republisher`](crate::lan::republish::Republisher) copies it into the topic of its sensor.

mod multicast_receiver;

use std::io::{IsTerminal, Write};
use std::net::SocketAddrV4;
use std::os::fd::AsFd;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use clap::Args;
use scanhub_schema::datagram::{Announce, group};
use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{Failure, Kind, Topic};
use scanhub_shm::{Domain, StateDirectory};
use scanhub_verbs::follow::Bounds;
use scanhub_verbs::output::{End, Output, quiet};

use self::multicast_receiver::{LONGEST, MulticastReceiver};
use crate::lan::Stamp;
use crate::reception::{Origin, Reception, Wanted, Words};
use crate::{VerbOptions, key_file};

/// Arguments of `scanhub listen`.
#[derive(Args, Debug)]
pub struct ListenArgs {
    /// Network interface to listen on [default: all that have a link]
    #[arg(long, value_name = "IF")]
    interface: Option<String>,
    /// Topic to listen to, of all sensors, for example zones [default: all topics]
    #[arg(long = "topic", value_name = "TOPIC")]
    topics: Vec<String>,
    /// Name a hub, instead of its 16 hex digits, for example robot1=5f3a12bc00d1e2f3
    #[arg(long = "name", value_name = "NAME=HUB")]
    names: Vec<String>,
    /// Hub to listen to, by its 16 hex digits or its name from --name [default: all]
    #[arg(long = "hub", value_name = "HUB")]
    hubs: Vec<String>,
    /// Accept only datagrams that are authenticated with the key in this file, and each of them once. Clocks must agree
    /// within 5 s
    #[arg(long, value_name = "FILE")]
    key_file: Option<PathBuf>,
    /// Print only the counts: received, lost, duplicate, reordered, refused
    #[arg(long)]
    stats: bool,
    /// Publish the samples in this machine's domain as HUB.SENSOR instead of printing them, so that all programs here can
    /// use them like sensors of a hub
    #[arg(long)]
    publish: bool,
    /// Places for consumers of each published topic, 1 to 250
    #[arg(long, value_name = "N", requires = "publish", default_value_t = 32, value_parser = clap::value_parser!(u16).range(1..=250))]
    consumers: u16,
    /// Shared memory that all published topics may take together, in MB (2^20 bytes). A sensor that does not fit is refused
    #[arg(long, value_name = "MB", requires = "publish", default_value_t = 64, value_parser = clap::value_parser!(u32).range(1..))]
    memory: u32,
    #[command(flatten)]
    bounds: Bounds,
}

/// Signals, for the end of the help.
pub const LISTEN_SIGNALS: &str = "SIGUSR1: print the counts so far";

impl ListenArgs {
    /// Prints received samples to `out`, and the counters at the end and whenever `tell` is set. Everything else goes to
    /// `notes` (stderr) if `out` is not JSON. Ends when the bounds are reached, `stop` is set, or the reader has closed the
    /// output.
    ///
    /// With `--publish`, samples are published instead of printed, without a copy for each subscriber. Only one listener may
    /// publish in a domain.
    ///
    /// # Errors
    ///
    /// Returns
    ///
    /// - [`Kind::Usage`] if there is no such topic,
    /// - [`Kind::Configuration`] if there is no such interface, or a name or hub is not valid,
    /// - [`Kind::DomainHeld`] if another listener publishes in the domain,
    /// - [`Kind::Short`] if there is too little memory for that,
    /// - [`Kind::Failed`] if the port is not available,
    /// - [`Kind::Timeout`], or [`Kind::Interrupted`] if `stop` is set before the bounds are reached.
    pub fn run(
        &self,
        options: &VerbOptions<'_>,
        out: &mut (impl Write + AsFd),
        notes: &mut dyn Write,
        tell: &AtomicBool,
        stop: &AtomicBool,
    ) -> Result<(), Failure> {
        let publish = self.publish.then(|| options.publisher_domain()).transpose()?;
        let is_drawn = self.stats && !options.json && out.as_fd().is_terminal();
        let topics = topics(&self.topics)?;
        let key = self.key_file.as_deref().map(key_file::read).transpose()?;
        let (groups, now) = (groups(&topics), Instant::now());
        let wanted = Wanted {
            // Announcements of topics whose group is not joined would count their samples as lost.
            heard: Topic::ALL.into_iter().filter(|&topic| groups.contains(&group(topic))).collect(),
            topics,
            names: &self.names,
            hubs: &self.hubs,
            key,
            state: StateDirectory::of_domain(options.domain),
            publish: publish.as_ref(),
            limits: TopicLimits { consumers: self.consumers.into(), ..TopicLimits::default() },
            memory: u64::from(self.memory) << 20,
            only_proven: self.key_file.is_none(),
            stats: self.stats,
        };
        let (out, notes) = (Output::new(out), Output::new(notes));
        let reception = Reception::open(wanted, options.json, Words::LAN, out, notes)?;
        let receiver = MulticastReceiver::open(self.interface.as_deref(), &groups, now)?;
        let mut listener =
            Listener { args: self, publish, is_drawn, receiver, reception, started: now, draw_at: now };
        quiet(listener.listen(tell, stop))
    }
}

struct Listener<'a> {
    args: &'a ListenArgs,
    publish: Option<Domain>,
    /// Whether the counters are drawn on a terminal.
    is_drawn: bool,
    receiver: MulticastReceiver,
    reception: Reception<'a>,
    started: Instant,
    draw_at: Instant,
}

/// Datagrams that are handled before everything else has its turn, so that a flood cannot keep the listener from ending.
const BATCH_SIZE: usize = 64;

/// Maximum sleep, after which interfaces and reasons to stop are checked.
const MAX_SLEEP: Duration = Duration::from_millis(100);

/// Interval at which the counters are drawn on a terminal.
const DRAW_INTERVAL: Duration = Duration::from_secs(1);

impl Listener<'_> {
    fn listen(&mut self, tell: &AtomicBool, stop: &AtomicBool) -> Result<(), End> {
        self.reception.report.ready(&self.receiver.interfaces(), self.publish.as_ref())?;
        self.reception.begin()?;
        let end = self.run(tell, stop);
        if !matches!(end, Err(End::ReaderGone)) {
            self.reception.tell(&[])?;
        }
        end
    }

    fn run(&mut self, tell: &AtomicBool, stop: &AtomicBool) -> Result<(), End> {
        let mut buffer = vec![0; LONGEST];
        loop {
            let more = self.take(&mut buffer)?;
            self.reception.wake();
            let (now, bounds) = (Instant::now(), &self.args.bounds);
            if self.has_enough() {
                return Ok(());
            }
            if stop.load(Ordering::Relaxed) {
                return self.stopped();
            }
            if bounds.run_for.is_some_and(|limit| now - self.started >= limit) {
                return self.time_is_over();
            }
            if let Some(limit) = bounds.timeout.filter(|&limit| now - self.reception.last_sample >= limit) {
                return Err(nothing_came(limit).into());
            }
            self.look(now, more)?;
            if tell.swap(false, Ordering::Relaxed) {
                self.reception.tell(&[])?;
            }
            if !more {
                self.receiver.wait(self.left(now));
            }
        }
    }

    /// Handles the waiting datagrams, up to a batch. Returns whether there may be more.
    fn take(&mut self, buffer: &mut [u8]) -> Result<bool, End> {
        for _ in 0..BATCH_SIZE {
            let Some(caught) = self.receiver.receive(buffer)? else { return Ok(false) };
            let origin = Origin {
                sender: sender(caught.from),
                address: Some((*caught.from.ip()).into()),
                name: None,
                arrival: Stamp { monotonic_ns: caught.arrival_ns, wall_ns: caught.wall_ns },
            };
            self.reception.take(caught.bytes, origin)?;
            if self.has_enough() {
                return Ok(true);
            }
        }
        Ok(true)
    }

    fn has_enough(&self) -> bool {
        self.args.bounds.count.is_some_and(|count| self.reception.received >= count)
    }

    /// Does what is due regularly. `more` says whether datagrams may be waiting.
    fn look(&mut self, now: Instant, more: bool) -> Result<(), End> {
        self.receiver.look(now);
        if let Some(what) = self.receiver.take_trouble() {
            self.reception.trouble(&what)?;
        }
        self.reception.look(now, more)?;
        if self.is_drawn && now >= self.draw_at {
            self.draw_at = now + DRAW_INTERVAL;
            self.reception.draw()?;
        }
        Ok(())
    }

    fn left(&self, now: Instant) -> Duration {
        let bounds = &self.args.bounds;
        let end = bounds.run_for.and_then(|limit| self.started.checked_add(limit));
        let silence = bounds.timeout.and_then(|limit| self.reception.last_sample.checked_add(limit));
        let first = [end, silence].into_iter().flatten().min();
        first.map_or(MAX_SLEEP, |at| at.saturating_duration_since(now).min(MAX_SLEEP))
    }

    fn stopped(&self) -> Result<(), End> {
        if self.args.bounds.bounded() {
            return Err(Failure::new(Kind::Interrupted, "interrupted before it was done", "").into());
        }
        Ok(())
    }

    fn time_is_over(&self) -> Result<(), End> {
        match self.args.bounds.count {
            Some(count) => {
                let what = format!("{} of {count} samples arrived in time", self.reception.received);
                Err(Failure::new(Kind::Timeout, what, NOTHING_CAME).into())
            }
            None => Ok(()),
        }
    }
}

/// Returns the number of a sender, by which gateways are distinguished.
fn sender(from: SocketAddrV4) -> u64 {
    u64::from(from.ip().to_bits()) << 16 | u64::from(from.port())
}

fn nothing_came(limit: Duration) -> Failure {
    Failure::new(Kind::Timeout, format!("nothing arrived for {limit:?}"), NOTHING_CAME)
}

const NOTHING_CAME: &str = "is `scanhub gateway` running in the same network? `scanhub listen --stats` counts what is \
                            refused, --interface names another interface";

/// Returns the topics with these names, or all if there are none.
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
