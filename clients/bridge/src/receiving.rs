//! Receives samples of other machines over Zenoh: checks each against the address that it arrived under, counts it, and
//! publishes it as a topic of this machine. All queues are limited, and what exceeds them is counted.

use std::collections::VecDeque;
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

/// Input from Zenoh.
enum Heard {
    /// A payload with its key.
    Sample(Box<str>, Vec<u8>),
    /// Key of a sensor that has appeared.
    Live(Box<str>),
}

/// Queue between the threads of Zenoh and the thread that takes the samples.
#[derive(Clone)]
struct Inlet {
    to: SyncSender<Heard>,
    counts: Arc<Counts>,
}

/// Inputs that were rejected before they were checked.
#[derive(Default)]
struct Counts {
    /// Inputs that are longer than a sample can be, or have no payload.
    long: AtomicU64,
    /// Inputs that found the queue full.
    overrun: AtomicU64,
}

/// Maximum number of inputs in the queue: 32 MB of the longest samples, or one second of many sensors.
const WAITING: usize = 512;
/// Maximum length of a sample in one piece, in bytes.
const LONGEST: usize = HEAD + u16::MAX as usize + MAC;
/// Maximum length of a key, in bytes. Keys of scanhub have at most 56.
const LONGEST_NAME: usize = 128;
/// Maximum number of inputs that are taken before other work is done.
const TURN: usize = 64;
/// Maximum wait for input.
const LOOK_EVERY: Duration = Duration::from_millis(100);

/// Takes samples until `is_over` is set. Reports the counts then, and whenever `tell` is set.
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
    /// Subscribes to announcements, samples of `topics`, and the tokens of sensors.
    fn listen(&self, session: &ZenohSession, topics: &[Topic]) -> Result<Vec<Subscriber>, Failure> {
        // One key expression for all topics: a user with rights to all topics needs only this one.
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

    /// Never waits, so a sender that is too fast does not delay others.
    fn put(&self, heard: Heard) {
        if self.to.try_send(heard).is_err() {
            self.counts.overrun.fetch_add(1, Ordering::Relaxed);
        }
    }
}

type Ask<'a> = dyn Fn(&Address<'_>) -> Result<(), Failure> + 'a;

struct Receiving<'a> {
    reception: Reception<'a>,
    /// Topics that a new sensor is queried for.
    asked: Vec<Option<Topic>>,
    asking: Asking,
    counts: Arc<Counts>,
    /// Inputs under keys that are not of scanhub.
    foreign: u64,
    /// Queries an address.
    ask: Box<Ask<'a>>,
    /// Returns the number of connections that were refused so far.
    refused: Box<dyn Fn() -> u64 + 'a>,
}

impl Receiving<'_> {
    /// Takes what is in the `inbox` until `is_over` is set. Then `close` ends the subscriptions, and the rest of the
    /// queue is taken.
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

    /// Takes at most [`TURN`] inputs. Returns whether there may be more.
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

    /// Queries new sensors for their last samples, because the next ones may take long.
    fn ask_next(&mut self) -> Result<(), End> {
        while let Some((hub, sensor)) = self.asking.next(Instant::now()) {
            let asked =
                self.asked.iter().try_for_each(|&topic| (self.ask)(&Address { hub, sensor: &sensor, topic }));
            if let Err(failure) = asked {
                self.asking.not_requested += 1;
                self.reception.problem(&failure.to_string())?;
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
            ("not_requested", self.asking.not_requested),
            ("connection", (self.refused)()),
        ];
        self.reception.tell(&others)
    }
}

/// Returns what a new sensor is queried for if `topics` are received: first its announcement, without which no sample
/// is published.
fn asked(topics: &[Topic]) -> Vec<Option<Topic>> {
    let kept = [Topic::Status, Topic::Background].into_iter().filter(|topic| topics.contains(topic));
    std::iter::once(None).chain(kept.map(Some)).collect()
}

/// Sensors that have appeared and were not queried yet. Any sender can report new ones, so their number is limited, and
/// the rest is counted. Time is an argument.
struct Asking {
    /// Hub and name of each sensor, the oldest first.
    waiting: VecDeque<(u64, Box<str>)>,
    /// Number of sensors that were queried since `second`.
    asked: usize,
    second: Instant,
    /// Sensors that are not queried, because there was no room or the query failed. Their announcement arrives without
    /// it.
    not_requested: u64,
}

/// Maximum number of sensors that are queried in a second.
const ASKED: usize = 64;
/// Maximum number of sensors that wait: queries for 16 s, with at most 96 kB of names.
const WAITING_SENSORS: usize = 1024;
const SECOND: Duration = Duration::from_secs(1);

impl Asking {
    fn new(now: Instant) -> Asking {
        Asking { waiting: VecDeque::new(), asked: 0, second: now, not_requested: 0 }
    }

    /// Adds the sensor `name` of `hub`, which has appeared.
    fn came(&mut self, hub: u64, name: &str) {
        if self.waiting.iter().any(|(other, its)| (*other, &**its) == (hub, name)) {
            return;
        }
        if self.waiting.len() == WAITING_SENSORS {
            self.not_requested += 1;
        } else {
            self.waiting.push_back((hub, name.into()));
        }
    }

    /// Returns the sensor to query now, if there is one.
    fn next(&mut self, now: Instant) -> Option<(u64, Box<str>)> {
        if now.saturating_duration_since(self.second) >= SECOND {
            (self.second, self.asked) = (now, 0);
        }
        if self.asked == ASKED {
            return None;
        }
        let next = self.waiting.pop_front();
        self.asked += usize::from(next.is_some());
        next
    }

    /// Counts all waiting sensors as not queried, at the end of the run.
    fn give_up(&mut self) {
        self.not_requested += self.waiting.drain(..).count() as u64;
    }
}

#[cfg(test)]
mod tests {
    use std::cell::RefCell;

    use scanhub_schema::datagram::{Head, Packed};
    use scanhub_schema::limits::TopicLimits;
    use scanhub_schema::{Kind, Zones};

    use super::*;

    const HUB: u64 = 0x5f3a_12bc_00d1_e2f3;

    /// Puts `heard` into the inbox of a receiver and runs it, with `is_over` set or not. Returns its output and the
    /// number of queries.
    fn run(heard: Vec<Heard>, is_over: bool, ask: impl Fn(&str) -> Result<(), Failure>) -> (String, u64) {
        let (mut out, mut notes) = (Vec::new(), Vec::new());
        let wanted = Wanted {
            topics: Topic::ALL.to_vec(),
            heard: Topic::ALL.to_vec(),
            names: &[],
            hubs: &[],
            key: None,
            state: None,
            publish: None,
            limits: TopicLimits::default(),
            memory: 0,
            only_proven: false,
            stats: true,
        };
        let (to_out, to_notes) = (Output::new(&mut out), Output::new(&mut notes));
        let reception = Reception::open(wanted, true, Words::BRIDGE, to_out, to_notes).unwrap();
        let (to, inbox) = sync_channel(WAITING);
        let inlet = Inlet { to, counts: Arc::default() };
        heard.into_iter().for_each(|heard| inlet.put(heard));
        let questions = RefCell::new(0);
        let over = AtomicBool::new(is_over);
        let ask_and_end = |address: &Address<'_>| {
            *questions.borrow_mut() += 1;
            over.store(true, Ordering::Relaxed);
            ask(&address.to_string())
        };
        let mut receiving = Receiving {
            reception,
            asked: asked(&Topic::ALL),
            asking: Asking::new(Instant::now()),
            counts: inlet.counts.clone(),
            foreign: 0,
            ask: Box::new(ask_and_end),
            refused: Box::new(|| 0),
        };
        // Input after the end is not accepted.
        receiving.run(&inbox, &AtomicBool::new(false), &over, || drop(inlet)).unwrap();
        drop(receiving);
        (String::from_utf8(out).unwrap(), questions.into_inner())
    }

    fn zones(sequence: u32) -> Heard {
        let mut buffer = [0; 100];
        let len = Zones::unknown().pack(&mut buffer[scanhub_schema::datagram::HEAD..]).unwrap();
        let head = Head {
            topic: Topic::Zones.number(),
            revision: 1,
            hub: HUB,
            epoch: 1,
            sequence,
            ..Head::default()
        };
        Heard::Sample(
            format!("{PREFIX}/{HUB:016x}/front/zones").into(),
            head.seal(&mut buffer, len).unwrap().to_vec(),
        )
    }

    #[test]
    fn what_waits_at_the_end_is_in_the_account() {
        let (told, _) = run((0..WAITING as u32 + 7).map(zones).collect(), true, |_| Ok(()));
        assert!(told.contains(&format!("\"received\":{WAITING},")), "{told}");
        assert!(told.contains("\"overrun\":7"), "{told}");
    }

    #[test]
    fn another_version_is_told_once_and_counted() {
        let spoilt = |at: usize, value: u8| {
            let Heard::Sample(key, mut bytes) = zones(0) else { panic!("a sample") };
            bytes[at] = value;
            Heard::Sample(key, bytes)
        };
        // The version follows the magic number.
        let (told, _) = run(vec![spoilt(4, 9), spoilt(4, 9), zones(0)], true, |_| Ok(()));
        assert_eq!(told.matches("another version").count(), 1, "{told}");
        assert!(told.contains("\"version\":2,") && told.contains("\"received\":1,"), "{told}");
    }

    #[test]
    fn a_question_that_cannot_be_asked_is_told_and_ends_nothing() {
        let heard = vec![Heard::Live(format!("{PREFIX}/{HUB:016x}/front/{LIVE}").into()), zones(0)];
        let (told, asked) =
            run(heard, false, |key| Err(Failure::new(Kind::Failed, format!("Zenoh refuses {key}"), "")));
        assert_eq!(asked, 1);
        assert!(told.contains("Zenoh refuses") && told.contains("\"not_requested\":1"), "{told}");
        assert!(told.contains("\"received\":1,"), "{told}");
    }

    /// Returns the names of all sensors that are queried at `now`.
    fn asked_at(asking: &mut Asking, now: Instant) -> Vec<String> {
        std::iter::from_fn(|| asking.next(now)).map(|(_, name)| name.into()).collect()
    }

    #[test]
    fn who_comes_with_many_others_is_asked_later() {
        let begin = Instant::now();
        let mut asking = Asking::new(begin);
        let names: Vec<_> = (0..150).map(|n| format!("s{n}")).collect();
        names.iter().for_each(|name| asking.came(5, name));
        asking.came(5, "s149");
        assert_eq!(asked_at(&mut asking, begin), names[..64]);
        assert_eq!(asked_at(&mut asking, begin + SECOND / 2), names[..0]);
        assert_eq!(asked_at(&mut asking, begin + SECOND), names[64..128]);
        assert_eq!(
            (asked_at(&mut asking, begin + 2 * SECOND), asking.not_requested),
            (names[128..].to_vec(), 0)
        );
        asking.came(5, "s0");
        assert_eq!(asked_at(&mut asking, begin + 3 * SECOND), ["s0"], "it came again");
    }

    #[test]
    fn of_ten_thousand_that_come_at_once_the_rest_is_counted() {
        let begin = Instant::now();
        let mut asking = Asking::new(begin);
        (0..10_000).for_each(|hub| asking.came(hub, "front"));
        assert_eq!(asking.not_requested, 10_000 - WAITING_SENSORS as u64);
        let all: usize = (0..100).map(|second| asked_at(&mut asking, begin + second * SECOND).len()).sum();
        assert_eq!(all, WAITING_SENSORS);
    }
}
