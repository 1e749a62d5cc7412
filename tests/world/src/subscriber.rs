//! Models of subscribers. Prompt subscribers sleep until they are woken. Slow subscribers poll at fixed intervals. Some
//! subscribers hold samples. A robot accepts the verdicts of a sensor's zones. All models use the rules of the client
//! library.

use std::collections::VecDeque;
use std::rc::Rc;

use bytemuck::pod_read_unaligned;
use scanhub_client::clock::Timestamp;
use scanhub_client::streams::{SequenceGap, SequenceTracker, StalenessTimer};
use scanhub_schema::{DoorbellWord, MICROS, MILLIS, Nanos, Topic, Verdict, Zones};

use crate::event::Event;
use crate::shared::SharedState;
use crate::topics::Sample;

/// ID of a subscriber.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(crate) struct SubscriberId(pub(crate) u32);

/// Behavior of a subscriber.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Behavior {
    /// Sleeps until it is woken, then takes all queued samples.
    Prompt,
    /// Takes one sample every `every_ms` milliseconds.
    Slow { every_ms: u64 },
    /// Like `Prompt`, but sleeps on the event of the sensor.
    Listener,
    /// Like `Prompt`, and also accepts the verdicts of the zones.
    Robot,
}

/// Something on which subscribers of a sensor sleep.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum WakeSource {
    /// A word of the doorbell.
    Ring(DoorbellWord),
    /// The event of the sensor.
    Event,
}

/// A subscriber to one topic of one sensor.
pub(crate) struct Subscriber {
    pub(crate) id: SubscriberId,
    pub(crate) sensor: usize,
    pub(crate) topic: Topic,
    behavior: Behavior,
    /// Samples that the subscriber holds, and the maximum number of held samples.
    held_samples: VecDeque<Rc<Sample>>,
    max_held: usize,
    sequence: SequenceTracker,
    /// Time of the next poll. It is [`Nanos::MAX`] if only a wakeup starts the next poll.
    next_poll_at: Nanos,
    /// Time until which the subscriber is stalled.
    stalled_until: Nanos,
    accepted: Option<(StalenessTimer, Verdict)>,
}

impl Subscriber {
    /// Attaches a subscriber at `now`. Returns `None` if there is no free slot.
    pub(crate) fn attach(
        shared: &SharedState,
        id: SubscriberId,
        (sensor, topic): (usize, Topic),
        behavior: Behavior,
        max_held: usize,
        now: Nanos,
    ) -> Option<Subscriber> {
        let (is_prompt, is_listener) = (behavior == Behavior::Prompt, behavior == Behavior::Listener);
        if !shared.topics.borrow_mut().attach(sensor, topic, id, is_listener) {
            return None;
        }
        shared.log.record(now, &Event::Attached { subscriber: id, sensor, topic, is_prompt, is_listener });
        let accepted =
            (behavior == Behavior::Robot).then(|| (StalenessTimer::new(moment(now)), Verdict::Unknown));
        let next_poll_at = now + HISTORY_DELAY;
        let (held_samples, sequence) = (VecDeque::new(), SequenceTracker::default());
        Some(Subscriber {
            id,
            sensor,
            topic,
            behavior,
            held_samples,
            max_held,
            sequence,
            next_poll_at,
            stalled_until: 0,
            accepted,
        })
    }

    /// Wakes the subscriber if it sleeps on `source`. At `at`, the hub rang this doorbell word or sent this event.
    pub(crate) fn wake(&mut self, source: WakeSource, at: Nanos) {
        let awaited = match self.behavior {
            Behavior::Listener => WakeSource::Event,
            _ => WakeSource::Ring(self.topic.spec().doorbell_word),
        };
        if source == awaited {
            self.poll_at(at);
        }
    }

    /// Makes the subscriber poll for samples at `at`, unless it polls at fixed intervals.
    pub(crate) fn poll_at(&mut self, at: Nanos) {
        if !matches!(self.behavior, Behavior::Slow { .. }) {
            self.next_poll_at = self.next_poll_at.min(at + WAKE_DELAY);
        }
    }

    /// Returns whether the subscriber sleeps on the doorbell and takes all samples as soon as it is woken.
    pub(crate) fn is_prompt(&self) -> bool {
        self.behavior == Behavior::Prompt
    }

    /// Stops the subscriber until `until`. A stopped robot has no verdict.
    pub(crate) fn stall(&mut self, shared: &SharedState, until: Nanos) {
        self.stalled_until = until;
        if let Some((_, verdict)) = &mut self.accepted {
            accept_verdict(shared, self.sensor, verdict, Verdict::Unknown);
        }
    }

    /// Returns the time at which the subscriber next does something.
    pub(crate) fn next_ns(&self, now: Nanos) -> Nanos {
        let left = self.accepted.as_ref().and_then(|(freshness, _)| freshness.time_left(moment(now)));
        let silent = left.map_or(Nanos::MAX, |left| now.saturating_add(left.as_nanos() as Nanos));
        self.next_poll_at.min(silent).max(self.stalled_until)
    }

    /// Takes the samples that are due at `now`, and drops a verdict that has become stale.
    pub(crate) fn run(&mut self, shared: &SharedState, now: Nanos) {
        match self.behavior {
            Behavior::Slow { every_ms } => {
                self.next_poll_at = now + every_ms * MILLIS;
                self.take(shared, now);
            }
            Behavior::Prompt | Behavior::Listener | Behavior::Robot => {
                self.next_poll_at = Nanos::MAX;
                while self.take(shared, now) {}
            }
        }
        if let Some((freshness, verdict)) = &mut self.accepted
            && freshness.silence(moment(now))
        {
            accept_verdict(shared, self.sensor, verdict, Verdict::Unknown);
        }
    }

    /// Takes all queued samples.
    pub(crate) fn drain(&mut self, shared: &SharedState) {
        while self.take(shared, shared.clock.get()) {}
    }

    /// Removes the subscriber, which has left or was killed. `is_drained` means that the subscriber's queue is empty.
    pub(crate) fn detach(self, shared: &SharedState, is_killed: bool, is_drained: bool) {
        shared.topics.borrow_mut().detach(self.sensor, self.topic, self.id, is_killed);
        shared.log_event(&Event::Detached { subscriber: self.id, is_drained });
    }

    fn take(&mut self, shared: &SharedState, now: Nanos) -> bool {
        let sample = shared.topics.borrow_mut().take(self.sensor, self.topic, self.id);
        let Some(sample) = sample else { return false };
        let SequenceGap { missed, .. } = self.sequence.note(&sample.header);
        shared.log.record(now, &Event::Taken { subscriber: self.id, sample: &sample, missed });
        if let Some((freshness, verdict)) = &mut self.accepted {
            let zones: Zones = pod_read_unaligned(&sample.bytes);
            let is_fresh = freshness.update(&sample.header, zones.verdict(), moment(now));
            let verdict_now = if is_fresh { zones.verdict() } else { Verdict::Unknown };
            accept_verdict(shared, self.sensor, verdict, verdict_now);
        }
        if self.max_held > 0 {
            self.held_samples.push_back(sample);
            if self.held_samples.len() > self.max_held {
                self.held_samples.pop_front();
            }
        }
        true
    }
}

fn accept_verdict(shared: &SharedState, sensor: usize, verdict: &mut Verdict, new: Verdict) {
    if std::mem::replace(verdict, new) != new {
        shared.log_event(&Event::VerdictAccepted { sensor, verdict: new });
    }
}

/// Returns the timestamp for `now`. The machine is never suspended.
fn moment(now: Nanos) -> Timestamp {
    Timestamp { monotonic_ns: now, boottime_ns: now }
}

/// Time from the hub's ring until a subscriber has a sample.
const WAKE_DELAY: Nanos = 60 * MICROS;
/// Maximum time until a running hub passes the history to a new subscriber. The hub does not wake the subscriber for
/// the history.
const HISTORY_DELAY: Nanos = 110 * MILLIS;
