//! Subscriber of two topics, such as `scan` and `foreground`, that the hub computes from the same telegram. It returns
//! the samples of both topics in pairs.
//!
//! The samples of each topic arrive in order, so the subscriber keeps only one sample of each topic. If the numbers of
//! the two samples differ, the earlier sample has no partner.

use std::collections::VecDeque;
use std::time::Duration;

use scanhub_schema::Header;
use scanhub_shm::Payload;

use crate::builder::SubscriberBuilder;
use crate::clock;
use crate::error::Error;
use crate::session::Session;
use crate::silence::Silence;
use crate::subscribe::sealed::Sealed;
use crate::subscribe::{ItemSource, Subscribe, Subscriber, WithTimeout};
use crate::topic_reader::{Received, TopicReader};

/// Subscribes to the topics of `sensor` that carry `A` and `B`, in the domain that SCANHUB_DOMAIN names. The subscriber
/// returns the samples in pairs with the same `seq`. [`JoinedSubscriber::builder`] has options.
///
/// # Examples
///
/// ```no_run
/// use scanhub_client::{Error, Foreground, Scan, joined};
///
/// fn main() -> Result<(), Error> {
///     for pair in joined::<Scan, Foreground>("front")?.iter() {
///         let pair = pair?;
///         println!("{} beams, {} missed", pair.first.beams(), pair.missed);
///     }
///     Ok(())
/// }
/// ```
///
/// # Errors
///
/// [`ErrorKind::InvalidInput`](crate::ErrorKind) if a name is invalid.
pub fn joined<A: Payload + ?Sized, B: Payload + ?Sized>(
    sensor: &str,
) -> Result<JoinedSubscriber<A, B>, Error> {
    JoinedSubscriber::builder(sensor).open()
}

/// Two samples of one telegram.
#[derive(Debug)]
pub struct Joined<A: Payload + ?Sized, B: Payload + ?Sized> {
    /// The sample of the first topic.
    pub first: Received<A>,
    /// The sample of the second topic.
    pub second: Received<B>,
    /// Number of incomplete pairs between the last pair and this one: one or both samples were missed, or one was never
    /// sent. It is the smallest number that is consistent with the sequence numbers of both topics. 0 for the first
    /// pair.
    pub missed: u64,
    /// Whether the hub was restarted since the last pair.
    pub restarted: bool,
}

/// Subscriber of two topics of one sensor. A sample waits for its partner for at most one period.
pub type JoinedSubscriber<A, B> = Subscriber<Joined<A, B>>;

/// Source of the pairs.
pub struct PairSource<A: Payload + ?Sized, B: Payload + ?Sized> {
    first: JoinedTopic<A>,
    second: JoinedTopic<B>,
    discarded: DiscardedTelegrams,
    /// Whether a pair was returned before.
    has_returned_pair: bool,
}

/// State of one of the two topics.
struct JoinedTopic<P: Payload + ?Sized> {
    reader: TopicReader<P>,
    /// Sample without a partner, and the time until which it waits, in ns of CLOCK_MONOTONIC.
    waiting: Option<(Received<P>, u64)>,
    /// Number of samples since the last pair that were missed or have no partner.
    missed: u64,
    restarted: bool,
}

/// Telegrams since the last pair that had only one sample in time. That sample was dropped.
#[derive(Default)]
struct DiscardedTelegrams {
    count: u64,
    /// `boot` and `seq` of the last of these telegrams, so that each is counted once. The partner of a dropped sample
    /// may arrive too late, and is then dropped, too.
    recent: VecDeque<(u64, u64)>,
}

/// Maximum length of `recent`, in telegrams. No partner arrives later than that, because no topic has a longer queue.
const MAX_RECENT: usize = 128;

/// Time for which a sample without a period waits for its partner, in ns.
const DEFAULT_WAIT_NS: u64 = 500_000_000;

impl<A: Payload + ?Sized, B: Payload + ?Sized> Sealed for Joined<A, B> {}

impl<A: Payload + ?Sized, B: Payload + ?Sized> WithTimeout for Joined<A, B> {}

impl<A: Payload + ?Sized, B: Payload + ?Sized> Subscribe for Joined<A, B> {
    type Sensors<'a> = &'a str;
    type Item = Joined<A, B>;
    type Source = PairSource<A, B>;

    fn source(options: &SubscriberBuilder<Joined<A, B>>) -> PairSource<A, B> {
        let (first, second) = (JoinedTopic::new(options.sensor()), JoinedTopic::new(options.sensor()));
        PairSource { first, second, discarded: DiscardedTelegrams::default(), has_returned_pair: false }
    }
}

impl<A: Payload + ?Sized, B: Payload + ?Sized> ItemSource for PairSource<A, B> {
    type Item = Joined<A, B>;

    fn subscribed(&self) -> bool {
        self.first.reader.subscribed() && self.second.reader.subscribed()
    }

    /// Receives samples until a pair is complete or no sample waits.
    fn receive(&mut self, session: &mut Session) -> Result<Option<Joined<A, B>>, Error> {
        loop {
            self.first.fill(session)?;
            self.second.fill(session)?;
            let is_first_earlier = match (self.first.header(), self.second.header()) {
                (Some(a), Some(b)) if (a.boot, a.seq) == (b.boot, b.seq) => return Ok(self.pair()),
                (Some(a), Some(b)) if a.boot == b.boot => a.seq < b.seq,
                // The samples belong to two runs of the hub, and the earlier run has ended.
                (Some(a), Some(b)) => a.stamp_last_ns < b.stamp_last_ns,
                (Some(_), None) if self.first.is_overdue() => true,
                (None, Some(_)) if self.second.is_overdue() => false,
                _ => return Ok(None),
            };
            let dropped = if is_first_earlier { self.first.discard() } else { self.second.discard() };
            dropped.into_iter().for_each(|telegram| self.discarded.add(telegram));
        }
    }

    /// Returns the time until a sample has waited for its partner long enough.
    fn time_left(&self) -> Option<Duration> {
        let overdue = [self.first.overdue_ns(), self.second.overdue_ns()].into_iter().flatten().min()?;
        Some(Duration::from_nanos(overdue.saturating_sub(clock::now_ns())))
    }

    fn why_silent(&mut self, session: &mut Session) -> Silence {
        match self.first.reader.why_silent(session) {
            Silence::Waiting => self.second.reader.why_silent(session),
            reason => reason,
        }
    }
}

impl<A: Payload + ?Sized, B: Payload + ?Sized> PairSource<A, B> {
    fn pair(&mut self) -> Option<Joined<A, B>> {
        let (first, second) = (self.first.waiting.take()?.0, self.second.waiting.take()?.0);
        // A missed sample and a dropped one may belong to the same telegram, so count the larger number.
        let lost = std::mem::take(&mut self.first.missed).max(std::mem::take(&mut self.second.missed));
        let lost = lost.max(std::mem::take(&mut self.discarded).count);
        let missed = if std::mem::replace(&mut self.has_returned_pair, true) { lost } else { 0 };
        let restarted =
            std::mem::take(&mut self.first.restarted) | std::mem::take(&mut self.second.restarted);
        Some(Joined { first, second, missed, restarted })
    }
}

impl<P: Payload + ?Sized> JoinedTopic<P> {
    fn new(sensor: &str) -> JoinedTopic<P> {
        JoinedTopic { reader: TopicReader::new(sensor), waiting: None, missed: 0, restarted: false }
    }

    /// Receives a sample, if none waits for its partner.
    fn fill(&mut self, session: &mut Session) -> Result<(), Error> {
        if self.waiting.is_none()
            && let Some(sample) = self.reader.receive(session)?
        {
            self.missed += sample.missed;
            self.restarted |= sample.restarted;
            let period_ns = match sample.header().period_us {
                0 => DEFAULT_WAIT_NS,
                period_us => u64::from(period_us) * 1000,
            };
            self.waiting = Some((sample, clock::now_ns() + period_ns));
        }
        Ok(())
    }

    fn header(&self) -> Option<&Header> {
        self.waiting.as_ref().map(|(sample, _)| sample.header())
    }

    fn overdue_ns(&self) -> Option<u64> {
        self.waiting.as_ref().map(|(_, overdue_ns)| *overdue_ns)
    }

    fn is_overdue(&self) -> bool {
        self.overdue_ns().is_some_and(|overdue_ns| overdue_ns <= clock::now_ns())
    }

    /// Drops the sample that waits. Returns `boot` and `seq` of its telegram.
    fn discard(&mut self) -> Option<(u64, u64)> {
        let (sample, _) = self.waiting.take()?;
        self.missed += 1;
        Some((sample.header().boot, sample.header().seq))
    }
}

impl DiscardedTelegrams {
    /// Counts `telegram` unless it was counted before.
    fn add(&mut self, telegram: (u64, u64)) {
        if self.recent.contains(&telegram) {
            return;
        }
        if self.recent.len() == MAX_RECENT {
            self.recent.pop_front();
        }
        self.recent.push_back(telegram);
        self.count += 1;
    }
}
