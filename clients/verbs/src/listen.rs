//! `scanhub listen`: what gateways send over the network, checked, with an account of what did not come. Refuses to know
//! who sends it, and to answer.

mod crowd;
mod duplicate_gateways;
mod epochs;
mod multicast_receiver;
mod names;
mod publish;
mod remote;
mod report;
mod wanted;

use std::collections::HashMap;
use std::io::Write;
use std::net::SocketAddrV4;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use lan::incoming::{Announcement, Arrived, Incoming, RemoteSample};
use lan::{Key, Stamp};
use schema::datagram::{DatagramError, Head, group};
use schema::limits::TopicLimits;
use schema::{Domain, Failure, Kind, StateDirectory, Topic};

use self::crowd::{Crowd, Crowding};
use self::epochs::Epochs;
use self::multicast_receiver::{LONGEST, MulticastReceiver};
use self::names::{Hubs, Names};
use self::publish::Publication;
use self::report::Report;
use self::wanted::{groups, topics};
use crate::follow::Bounds;
use crate::interface::is_of_this_machine;
use crate::key_file;
use crate::output::{End, Output, quiet};
use crate::stamp;

/// What `listen` is asked for.
#[derive(Clone, Debug)]
pub struct ListenOptions {
    /// The network interface to hear on; none: all that have a link.
    pub interface: Option<String>,
    /// Names of topics, without sensors; none: all.
    pub topics: Vec<String>,
    /// `NAME=HUB`: what to call a gateway, instead of its 16 hex digits.
    pub names: Vec<String>,
    /// The gateways to hear, by 16 hex digits or by one of `names`; none: all. What others send is passed over, before the
    /// account.
    pub hubs: Vec<String>,
    /// The file with the key without which nothing is believed; none: everything is.
    pub key_file: Option<PathBuf>,
    /// Where it keeps what has to survive it, if anywhere.
    pub state: Option<StateDirectory>,
    /// Only the account, no samples.
    pub stats: bool,
    /// Instead of writing samples, publish them in this domain, as `HUB.SENSOR`.
    pub publish: Option<Domain>,
    /// What the topics are made for that are published.
    pub limits: TopicLimits,
    /// Objects instead of text.
    pub json: bool,
    /// `out` is a terminal: the account is shown each second.
    pub terminal: bool,
    /// When it ends by itself.
    pub bounds: Bounds,
}

/// Writes the samples that come to `out`, and the account at the end and whenever `tell` is set; what is no sample goes to
/// `notes` (stderr) if `out` is not JSON. Ends when the bounds are reached, `stop` is set, or nobody reads any more.
///
/// With a domain to publish in no samples are written: what comes is to be followed there, without a copy for each
/// consumer. Then it takes the place of a listener in the domain, of which there is one.
///
/// [`Kind::Usage`] with the topics that there are, [`Kind::Configuration`] if there is no such interface or a name or hub is not possible,
/// [`Kind::DomainHeld`] if another listener publishes in the domain, [`Kind::Short`] if memory for that is, [`Kind::Failed`]
/// if the port cannot be had, [`Kind::Timeout`], [`Kind::Interrupted`] if bounded and `stop` came first.
pub fn listen(
    options: &ListenOptions,
    out: &mut dyn Write,
    notes: &mut dyn Write,
    tell: &AtomicBool,
    stop: &AtomicBool,
) -> Result<(), Failure> {
    let wanted = topics(&options.topics)?;
    let names = Names::parse(&options.names)?;
    let hubs = Hubs::parse(&options.hubs, &names)?;
    let key = options.key_file.as_deref().map(key_file::read).transpose()?;
    let groups = groups(&wanted);
    let now = Instant::now();
    let publication =
        options.publish.as_ref().map(|domain| publish::open(domain, options.limits)).transpose()?;
    let receiver = MulticastReceiver::open(options.interface.as_deref(), &groups, now)?;
    // Of topics whose group is not joined announcements would tell as lost what nobody wanted.
    let heard: Vec<_> = Topic::ALL.into_iter().filter(|&topic| groups.contains(&group(topic))).collect();
    let key_name = key.as_ref().map(Key::name);
    let epochs = key.as_ref().map(|key| Epochs::of(key, options.state.clone()));
    let (known, unreadable) = match epochs.as_ref().map_or(Ok(HashMap::new()), Epochs::read) {
        Ok(known) => (known, None),
        Err(failure) => (HashMap::new(), Some(failure)),
    };
    let incoming = match key {
        Some(key) => Incoming::with_key(&heard, key, known),
        None => Incoming::new(&heard),
    };
    let mut listener = Listener {
        options,
        wanted,
        hubs,
        receiver,
        publication,
        told: Vec::new(),
        incoming,
        epochs,
        crowd: Crowd::default(),
        report: Report::new(options.json, Output::new(out), Output::new(notes), names, key_name),
        started: now,
        last_sample: now,
        taken: Stamp::default(),
        draw_at: now,
        received: 0,
    };
    quiet(listener.listen(unreadable, tell, stop))
}

struct Listener<'a> {
    options: &'a ListenOptions,
    wanted: Vec<Topic>,
    hubs: Hubs,
    receiver: MulticastReceiver,
    publication: Option<Publication>,
    /// What was told that is wrong here.
    told: Vec<String>,
    incoming: Incoming,
    /// Where the epochs of gateways are kept that had the key, if there is one.
    epochs: Option<Epochs>,
    crowd: Crowd,
    report: Report<'a>,
    started: Instant,
    last_sample: Instant,
    /// When the last datagram came that was taken, by the kernel.
    taken: Stamp,
    draw_at: Instant,
    received: u64,
}

/// Datagrams that are taken before anything else has its turn, so that no flood keeps it from ending.
const TURN: usize = 64;

/// The longest sleep: so often interfaces and reasons to stop are looked at.
const LONGEST_WAIT: Duration = Duration::from_millis(100);

/// The most things that are told to be wrong: it may be the network that makes them.
const TOLD: usize = 16;

/// Between two accounts on a terminal.
const DRAW_EVERY: Duration = Duration::from_secs(1);

impl Listener<'_> {
    fn listen(
        &mut self,
        unreadable: Option<Failure>,
        tell: &AtomicBool,
        stop: &AtomicBool,
    ) -> Result<(), End> {
        self.report.ready(&self.receiver.interfaces(), self.options.publish.as_ref())?;
        if let Some(failure) = unreadable {
            self.trouble(&failure.to_string())?;
        }
        let end = self.run(tell, stop);
        if !matches!(end, Err(End::ReaderGone)) {
            self.tell()?;
        }
        end
    }

    /// The account so far.
    fn tell(&mut self) -> Result<(), End> {
        self.report.stats(self.incoming.stats(), self.incoming.peers())?;
        self.publication.iter().try_for_each(|publication| self.report.publication(publication))
    }

    fn run(&mut self, tell: &AtomicBool, stop: &AtomicBool) -> Result<(), End> {
        let (mut buffer, mut whole) = (vec![0; LONGEST], Vec::new());
        loop {
            let more = self.take(&mut buffer, &mut whole)?;
            if let Some(publication) = &mut self.publication {
                publication.wake();
            }
            let (now, bounds) = (Instant::now(), &self.options.bounds);
            if bounds.count.is_some_and(|count| self.received >= count) {
                return Ok(());
            }
            if stop.load(Ordering::Relaxed) {
                return self.stopped();
            }
            if bounds.run_for.is_some_and(|limit| now - self.started >= limit) {
                return self.time_is_over();
            }
            if let Some(limit) = bounds.timeout.filter(|&limit| now - self.last_sample >= limit) {
                return Err(nothing_came(limit).into());
            }
            self.look(now, more)?;
            if tell.swap(false, Ordering::Relaxed) {
                self.tell()?;
            }
            if !more {
                self.receiver.wait(self.left(now));
            }
        }
    }

    /// Takes what waits, up to a turn; whether there may be more. What comes in parts becomes `whole`.
    fn take(&mut self, buffer: &mut [u8], whole: &mut Vec<u8>) -> Result<bool, End> {
        for _ in 0..TURN {
            let Some(caught) = self.receiver.receive(buffer)? else { return Ok(false) };
            let bytes = caught.bytes;
            let arrival = Stamp { monotonic_ns: caught.arrival_ns, wall_ns: caught.wall_ns };
            self.taken = arrival;
            if !self.hubs.want(bytes) {
                continue;
            }
            let arrived = self.incoming.receive(bytes, sender(caught.from), arrival, whole);
            if let (Some(head), Some(publication)) = (arrived.begins(), &mut self.publication) {
                // If a life of the same epoch went on until now, that was another sender's.
                publication.begun(head, stamp::now());
            }
            match arrived {
                Arrived::Sample(sample) => self.sample(&sample, caught.from)?,
                Arrived::Announced(announcement) => self.announced(&announcement, caught.from)?,
                Arrived::Refused { shared: Some(hub), .. } => self.is_shared(hub)?,
                Arrived::Untimely { behind_ns } => self.trouble(untimely(behind_ns))?,
                Arrived::Refused { shared: None, .. } | Arrived::Part | Arrived::Known => {}
            }
            self.keep_epochs()?;
            if self.options.bounds.count.is_some_and(|count| self.received >= count) {
                return Ok(true);
            }
        }
        Ok(true)
    }

    /// Keeps the epochs of gateways that had the key, if one is new: once in a life of a gateway.
    fn keep_epochs(&mut self) -> Result<(), End> {
        let kept = match (self.incoming.take_epochs(), &self.epochs) {
            (Some(known), Some(epochs)) => epochs.keep(known),
            _ => return Ok(()),
        };
        kept.or_else(|failure| self.trouble(&failure.to_string()))
    }

    /// A sample that was not there before.
    fn sample(&mut self, sample: &RemoteSample<'_>, from: SocketAddrV4) -> Result<(), End> {
        let RemoteSample { remote, missed, .. } = sample;
        let (head, topic) = (&remote.datagram.head, remote.topic);
        if !self.wanted.contains(&topic) {
            return Ok(());
        }
        self.received += 1;
        self.last_sample = Instant::now();
        if let Some(publication) = &mut self.publication {
            let made = publication.sample(sample, || self.report.names.of(head.hub), stamp::now());
            return self.made(head, made, from);
        }
        if self.options.stats {
            return Ok(());
        }
        let sensor = &self.incoming.written(head);
        if *missed > 0 {
            self.report.missed(head, sensor, topic, *missed)?;
        }
        self.report.sample(sensor, remote)
    }

    /// A sensor was announced, in newer words than before.
    fn announced(&mut self, announcement: &Announcement, from: SocketAddrV4) -> Result<(), End> {
        let Announcement { head, announce, is_named, behind_ns, .. } = announcement;
        if *is_named {
            self.report.named(head, announce.sensor())?;
        }
        if let Some(behind_ns) = behind_ns {
            self.report.clocks_differ(head, *behind_ns)?;
        }
        let Some(publication) = &mut self.publication else { return Ok(()) };
        let made = publication.announced(announcement, &self.report.names.of(head.hub), stamp::now());
        self.made(head, made, from)
    }

    /// What became of the topics of the sensor that sent `head`: they may have been `made` just now.
    fn made(
        &mut self,
        head: &Head,
        made: Result<Option<String>, Failure>,
        from: SocketAddrV4,
    ) -> Result<(), End> {
        match made {
            Ok(Some(name)) => self.report.published(head, &name, is_of_this_machine((*from.ip()).into())),
            Ok(None) => Ok(()),
            Err(failure) => self.trouble(&failure.to_string()),
        }
    }

    /// Two gateways send as `hub`, and what one of them sends is refused.
    fn is_shared(&mut self, hub: u64) -> Result<(), End> {
        let what = duplicate_gateways::remedy(&self.report.names.of(hub));
        self.trouble(&what)
    }

    /// Tells what is wrong here, once; of ever new things only the first ones.
    fn trouble(&mut self, what: &str) -> Result<(), End> {
        if self.told.len() == TOLD || self.told.iter().any(|told| told == what) {
            return Ok(());
        }
        self.told.push(what.to_owned());
        self.report.trouble(what)
    }

    /// What is due now and then; `more` may wait.
    fn look(&mut self, now: Instant, more: bool) -> Result<(), End> {
        self.receiver.look(now);
        if let Some(what) = self.receiver.take_trouble() {
            self.trouble(&what)?;
        }
        if let Some(publication) = &mut self.publication {
            let now = stamp::now();
            publication.look(now.monotonic_ns, if more { self.taken } else { now });
        }
        let so_far = self.crowding();
        if let Some(what) = self.crowd.look(so_far, now) {
            self.report.trouble(&what)?;
        }
        if self.options.stats && self.options.terminal && !self.options.json && now >= self.draw_at {
            self.draw_at = now + DRAW_EVERY;
            self.report.draw(self.incoming.stats(), self.incoming.peers())?;
        }
        Ok(())
    }

    fn crowding(&self) -> Crowding {
        let publication = self.publication.as_ref();
        Crowding {
            gateways: self.incoming.stats().given_up().displaced,
            refused: self.incoming.stats().refused(DatagramError::Capacity),
            sensors: publication.map_or(0, |publication| publication.displaced),
            samples: publication.map_or(0, |publication| publication.left_out.capacity),
        }
    }

    fn left(&self, now: Instant) -> Duration {
        let bounds = &self.options.bounds;
        let end = bounds.run_for.and_then(|limit| self.started.checked_add(limit));
        let silence = bounds.timeout.and_then(|limit| self.last_sample.checked_add(limit));
        let first = [end, silence].into_iter().flatten().min();
        first.map_or(LONGEST_WAIT, |at| at.saturating_duration_since(now).min(LONGEST_WAIT))
    }

    fn stopped(&self) -> Result<(), End> {
        if self.options.bounds.bounded() {
            return Err(Failure::new(Kind::Interrupted, "interrupted before it was done", "").into());
        }
        Ok(())
    }

    fn time_is_over(&self) -> Result<(), End> {
        match self.options.bounds.count {
            Some(count) => {
                let what = format!("{} of {count} samples arrived in time", self.received);
                Err(Failure::new(Kind::Timeout, what, NOTHING_CAME).into())
            }
            None => Ok(()),
        }
    }
}

/// The number of a sender in the account.
fn sender(from: SocketAddrV4) -> u64 {
    u64::from(from.ip().to_bits()) << 16 | u64::from(from.port())
}

fn nothing_came(limit: Duration) -> Failure {
    Failure::new(Kind::Timeout, format!("nothing arrived for {limit:?}"), NOTHING_CAME)
}

const NOTHING_CAME: &str = "is `scanhub gateway` running in the same network? `scanhub listen --stats` counts what is \
                            refused, --interface names another interface";

/// What is wrong where an announcement has the key and is not believed; in so few words that it is told once.
fn untimely(behind_ns: i64) -> &'static str {
    match behind_ns < 0 {
        true => {
            "a gateway has the key, and its clock is more than 5 s ahead of this machine's: it is not believed; set the clocks"
        }
        false => {
            "a gateway has the key, and its clock is more than 5 s behind this machine's, or somebody sends again what was \
             recorded: it is not believed; set the clocks"
        }
    }
}
