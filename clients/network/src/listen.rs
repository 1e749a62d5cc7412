//! `scanhub listen`: what gateways send over the network, checked, with an account of what did not come. Refuses to know
//! who sends it, and to answer.

mod multicast_receiver;
mod wanted;

use std::io::Write;
use std::net::SocketAddrV4;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use crate::lan::Stamp;
use scanhub_schema::datagram::group;
use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{Failure, Kind, Topic};
use scanhub_shm::{Domain, StateDirectory};

use self::multicast_receiver::{LONGEST, MulticastReceiver};
use self::wanted::{groups, topics};
use crate::key_file;
use crate::reception::{Origin, Reception, Wanted, Words};
use scanhub_verbs::follow::Bounds;
use scanhub_verbs::output::{End, Output, quiet};

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
    /// Bytes of shared memory that all published topics may take together.
    pub memory: u64,
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
    let key = options.key_file.as_deref().map(key_file::read).transpose()?;
    let groups = groups(&wanted);
    let now = Instant::now();
    // Of topics whose group is not joined announcements would tell as lost what nobody wanted.
    let heard = Topic::ALL.into_iter().filter(|&topic| groups.contains(&group(topic))).collect();
    let wanted = Wanted {
        topics: wanted,
        heard,
        names: &options.names,
        hubs: &options.hubs,
        key,
        state: options.state.clone(),
        publish: options.publish.as_ref(),
        limits: options.limits,
        memory: options.memory,
        only_proven: options.key_file.is_none(),
        stats: options.stats,
    };
    let reception = Reception::open(wanted, options.json, Words::LAN, Output::new(out), Output::new(notes))?;
    let receiver = MulticastReceiver::open(options.interface.as_deref(), &groups, now)?;
    let mut listener = Listener { options, receiver, reception, started: now, draw_at: now };
    quiet(listener.listen(tell, stop))
}

struct Listener<'a> {
    options: &'a ListenOptions,
    receiver: MulticastReceiver,
    reception: Reception<'a>,
    started: Instant,
    draw_at: Instant,
}

/// Datagrams that are taken before anything else has its turn, so that no flood keeps it from ending.
const TURN: usize = 64;

/// The longest sleep: so often interfaces and reasons to stop are looked at.
const LONGEST_WAIT: Duration = Duration::from_millis(100);

/// Between two accounts on a terminal.
const DRAW_EVERY: Duration = Duration::from_secs(1);

impl Listener<'_> {
    fn listen(&mut self, tell: &AtomicBool, stop: &AtomicBool) -> Result<(), End> {
        self.reception.report.ready(&self.receiver.interfaces(), self.options.publish.as_ref())?;
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
            let (now, bounds) = (Instant::now(), &self.options.bounds);
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

    /// Takes what waits, up to a turn; whether there may be more.
    fn take(&mut self, buffer: &mut [u8]) -> Result<bool, End> {
        for _ in 0..TURN {
            let Some(caught) = self.receiver.receive(buffer)? else { return Ok(false) };
            let origin = Origin {
                sender: sender(caught.from),
                address: Some((*caught.from.ip()).into()),
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
        self.options.bounds.count.is_some_and(|count| self.reception.received >= count)
    }

    /// What is due now and then; `more` may wait.
    fn look(&mut self, now: Instant, more: bool) -> Result<(), End> {
        self.receiver.look(now);
        if let Some(what) = self.receiver.take_trouble() {
            self.reception.trouble(&what)?;
        }
        self.reception.look(now, more)?;
        if self.options.stats && self.options.terminal && !self.options.json && now >= self.draw_at {
            self.draw_at = now + DRAW_EVERY;
            self.reception.draw()?;
        }
        Ok(())
    }

    fn left(&self, now: Instant) -> Duration {
        let bounds = &self.options.bounds;
        let end = bounds.run_for.and_then(|limit| self.started.checked_add(limit));
        let silence = bounds.timeout.and_then(|limit| self.reception.last_sample.checked_add(limit));
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
                let what = format!("{} of {count} samples arrived in time", self.reception.received);
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
