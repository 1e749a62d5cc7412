//! The way in: what others send is checked against the name that it came under, counted, and published as topics of this
//! machine. However much comes, what waits is bounded, and the rest is counted. Refuses to know what carries it.

mod asking;

use std::io::{stderr, stdout};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::time::{Duration, Instant};

use scanhub_network::lan::address::{ANNOUNCE, Address, LIVE, PREFIX, live};
use scanhub_network::{Origin, Reception, Wanted, Words, now};
use scanhub_schema::datagram::{HEAD, MAC};
use scanhub_schema::{Failure, Topic};
use scanhub_verbs::output::{End, Output};

use crate::PublishOptions;
use crate::session::{Connection, Subscriber, ZenohSession};
use asking::Asking;

/// What was heard.
enum Heard {
    /// A payload under a name.
    Sample(Box<str>, Vec<u8>),
    /// A sensor came.
    Live(Box<str>),
}

/// What comes in, between the threads of Zenoh and the one that takes it.
#[derive(Clone)]
struct Inlet {
    to: SyncSender<Heard>,
    counts: Arc<Counts>,
}

/// What was refused before it was looked at.
#[derive(Default)]
struct Counts {
    /// Longer than a sample can be, or no payload.
    long: AtomicU64,
    /// Came faster than it could be taken.
    overrun: AtomicU64,
}

/// So much may wait: 32 MB of the longest samples, a second of many sensors.
const WAITING: usize = 512;
/// The longest sample in one piece, in bytes.
const LONGEST: usize = HEAD + u16::MAX as usize + MAC;
/// The longest name that is looked at; ours have 56 bytes at most.
const LONGEST_NAME: usize = 128;
/// What is taken before anything else has its turn.
const TURN: usize = 64;
/// So often it is looked whether something is due.
const LOOK_EVERY: Duration = Duration::from_millis(100);

/// Takes what comes until it `is_over`; the account is told then and whenever `tell` is set.
pub(crate) fn run(
    options: &PublishOptions,
    json: bool,
    connection: &Connection,
    tell: &AtomicBool,
    is_over: &AtomicBool,
) -> Result<(), End> {
    let (mut out, mut notes) = (stdout(), stderr());
    let wanted = Wanted {
        topics: options.topics.clone(),
        heard: options.topics.clone(),
        names: &options.names,
        hubs: &options.hubs,
        key: None,
        state: None,
        publish: Some(&options.domain),
        limits: options.limits,
        memory: options.memory,
        // Zenoh's configuration controls access.
        only_proven: false,
        stats: true,
    };
    let reception =
        Reception::open(wanted, json, Words::BRIDGE, Output::new(&mut out), Output::new(&mut notes))?;
    let Some(session) = connection.session(is_over) else { return Ok(()) };
    let (to, inbox) = sync_channel(WAITING);
    let inlet = Inlet { to, counts: Arc::default() };
    let subscribers = inlet.listen(session, &options.topics)?;
    let asks = inlet.clone();
    let ask = |address: &Address<'_>| {
        let asks = asks.clone();
        session.query(&address.to_string(), LONGEST, move |key, payload| asks.take(key, payload))
    };
    let refused = || connection.refused();
    let asking = Asking::new(Instant::now());
    let counts = inlet.counts;
    let mut receiving = Receiving {
        reception,
        asked: asked(&options.topics),
        asking,
        counts,
        foreign: 0,
        ask: Box::new(ask),
        refused: Box::new(refused),
    };
    receiving.run(&inbox, tell, is_over, move || drop(subscribers))
}

impl Inlet {
    /// Hears announcements, samples of `topics`, and who comes.
    fn listen(&self, session: &ZenohSession, topics: &[Topic]) -> Result<Vec<Subscriber>, Failure> {
        // All in one word: who has rights to all needs no more.
        let words = match topics.len() == Topic::ALL.len() {
            true => vec!["*"],
            false => std::iter::once(ANNOUNCE).chain(topics.iter().map(|topic| topic.name())).collect(),
        };
        let mut subscribers = Vec::new();
        for word in words {
            let samples = self.clone();
            let hear = move |key: &str, payload| samples.take(key, payload);
            subscribers.push(session.subscribe(&format!("{PREFIX}/*/*/{word}"), LONGEST, hear)?);
        }
        let tokens = self.clone();
        subscribers.push(session.watch(&format!("{PREFIX}/*/*/{LIVE}"), move |key| {
            if key.len() <= LONGEST_NAME {
                tokens.put(Heard::Live(key.into()));
            }
        })?);
        Ok(subscribers)
    }

    fn take(&self, key: &str, payload: Option<Vec<u8>>) {
        match payload.filter(|_| key.len() <= LONGEST_NAME) {
            Some(payload) => self.put(Heard::Sample(key.into(), payload)),
            None => _ = self.counts.long.fetch_add(1, Ordering::Relaxed),
        }
    }

    /// Nobody waits: whoever sends more than can be taken delays nobody but himself.
    fn put(&self, heard: Heard) {
        if self.to.try_send(heard).is_err() {
            self.counts.overrun.fetch_add(1, Ordering::Relaxed);
        }
    }
}

type Ask<'a> = dyn Fn(&Address<'_>) -> Result<(), Failure> + 'a;

struct Receiving<'a> {
    reception: Reception<'a>,
    /// What sensors that come are asked for.
    asked: Vec<Option<Topic>>,
    asking: Asking,
    counts: Arc<Counts>,
    /// What came under a name that is not its own.
    foreign: u64,
    /// Asks for what is sent under an address.
    ask: Box<Ask<'a>>,
    /// Connections that were refused so far.
    refused: Box<dyn Fn() -> u64 + 'a>,
}

impl Receiving<'_> {
    /// Takes what is in the `inbox` until it `is_over`; then nothing more is let in by `close`, and what waits is taken.
    fn run(
        &mut self,
        inbox: &Receiver<Heard>,
        tell: &AtomicBool,
        is_over: &AtomicBool,
        close: impl FnOnce(),
    ) -> Result<(), End> {
        self.reception.begin()?;
        while !is_over.load(Ordering::Relaxed) {
            let more = self.take(inbox)?;
            self.ask_next()?;
            self.reception.wake();
            self.reception.look(Instant::now(), more)?;
            if tell.swap(false, Ordering::Relaxed) {
                self.tell()?;
            }
        }
        close();
        inbox.try_iter().take(WAITING).try_for_each(|heard| self.heard(&heard))?;
        self.asking.give_up();
        self.reception.wake();
        self.tell()
    }

    /// Takes what waits, up to a turn; whether there may be more.
    fn take(&mut self, inbox: &Receiver<Heard>) -> Result<bool, End> {
        let mut next = inbox.recv_timeout(LOOK_EVERY).ok();
        for _ in 0..TURN {
            match next.take().or_else(|| inbox.try_recv().ok()) {
                Some(heard) => self.heard(&heard)?,
                None => return Ok(false),
            }
        }
        Ok(true)
    }

    fn heard(&mut self, heard: &Heard) -> Result<(), End> {
        match heard {
            Heard::Sample(key, payload) => return self.sample(key, payload),
            Heard::Live(key) => match live(key) {
                Some((hub, sensor)) => self.asking.came(hub, sensor),
                None => self.foreign += 1,
            },
        }
        Ok(())
    }

    fn sample(&mut self, key: &str, payload: &[u8]) -> Result<(), End> {
        let Some(name) = Address::parse(key) else {
            self.foreign += 1;
            return Ok(());
        };
        // Zenoh does not report the sender. Its access control decides who may send.
        let origin = Origin { sender: 0, address: None, name: Some(name), arrival: now() };
        self.reception.take(payload, origin)
    }

    /// Asks sensors that came for what they said last, rather than waiting until they say it again.
    fn ask_next(&mut self) -> Result<(), End> {
        while let Some((hub, sensor)) = self.asking.next(Instant::now()) {
            let asked =
                self.asked.iter().try_for_each(|&topic| (self.ask)(&Address { hub, sensor: &sensor, topic }));
            if let Err(failure) = asked {
                self.asking.unasked += 1;
                self.reception.trouble(&failure.to_string())?;
            }
        }
        Ok(())
    }

    fn tell(&mut self) -> Result<(), End> {
        let count = |count: &AtomicU64| count.load(Ordering::Relaxed);
        let Counts { long, overrun } = &*self.counts;
        let others = [
            ("key", self.foreign + self.reception.foreign),
            ("long", count(long)),
            ("overrun", count(overrun)),
            ("unasked", self.asking.unasked),
            ("connection", (self.refused)()),
        ];
        self.reception.tell(&others)
    }
}

/// What is asked for where `topics` are received: first the name, without which no sample is published.
fn asked(topics: &[Topic]) -> Vec<Option<Topic>> {
    let kept = [Topic::Status, Topic::Background].into_iter().filter(|topic| topics.contains(topic));
    std::iter::once(None).chain(kept.map(Some)).collect()
}

#[cfg(test)]
mod tests;
