//! Models of consumers: prompt ones that sleep until they are woken, slow ones that look now and then, those that hold samples,
//! and a robot that believes the verdict of a sensor's zones, with the client library's own rules. Refuses to know who
//! publishes.

use std::collections::VecDeque;
use std::rc::Rc;

use bytemuck::pod_read_unaligned;
use scanhub_client::clock::Moment;
use scanhub_client::streams::{Freshness, Noted, Numbers};
use scanhub_schema::{MICROS, MILLIS, Nanos, Ring, Topic, Verdict, Zones};

use crate::event::Event;
use crate::shared::Shared;
use crate::topics::Sample;

/// Which consumer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(crate) struct Number(pub(crate) u32);

/// What a consumer does.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Habit {
    /// Sleeps until it is woken, then takes all that waits.
    Prompt,
    /// Takes one sample each so many milliseconds.
    Slow { every_ms: u64 },
    /// As a prompt one, but it sleeps on the event of the sensor.
    Listener,
    /// As a prompt one, and believes what it hears.
    Robot,
}

/// Something on which subscribers of a sensor sleep.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Bell {
    /// A word of the doorbell.
    Ring(Ring),
    /// The event.
    Event,
}

/// One consumer of one topic of one sensor.
pub(crate) struct Consumer {
    pub(crate) number: Number,
    pub(crate) sensor: usize,
    pub(crate) topic: Topic,
    habit: Habit,
    /// The samples that it holds, and how many it wants to.
    held: VecDeque<Rc<Sample>>,
    holds: usize,
    numbers: Numbers,
    /// When it looks again; [`Nanos::MAX`] if only somebody else can wake it.
    next_at: Nanos,
    /// Until when it does not run.
    stopped_until: Nanos,
    belief: Option<(Freshness, Verdict)>,
}

impl Consumer {
    /// Attaches at `now`. Returns `None` if there is no place.
    pub(crate) fn attach(
        shared: &Shared,
        number: Number,
        (sensor, topic): (usize, Topic),
        habit: Habit,
        holds: usize,
        now: Nanos,
    ) -> Option<Consumer> {
        let (is_prompt, is_listener) = (habit == Habit::Prompt, habit == Habit::Listener);
        if !shared.board.borrow_mut().attach(sensor, topic, number, is_listener) {
            return None;
        }
        shared.log.tell(now, &Event::Attached { consumer: number, sensor, topic, is_prompt, is_listener });
        let belief = (habit == Habit::Robot).then(|| (Freshness::new(moment(now)), Verdict::Unknown));
        let next_at = now + GREETING;
        let (held, numbers) = (VecDeque::new(), Numbers::default());
        Some(Consumer {
            number,
            sensor,
            topic,
            habit,
            held,
            holds,
            numbers,
            next_at,
            stopped_until: 0,
            belief,
        })
    }

    /// Wakes the subscriber if it sleeps on `bell`, which the hub rang at `at`.
    pub(crate) fn wake(&mut self, bell: Bell, at: Nanos) {
        let awaited = match self.habit {
            Habit::Listener => Bell::Event,
            _ => Bell::Ring(self.topic.row().ring),
        };
        if bell == awaited {
            self.look_at(at);
        }
    }

    /// Makes the subscriber poll for samples at `at`, unless it polls at fixed intervals.
    pub(crate) fn look_at(&mut self, at: Nanos) {
        if !matches!(self.habit, Habit::Slow { .. }) {
            self.next_at = self.next_at.min(at + TAKES);
        }
    }

    /// Whether it takes everything as soon as it is woken.
    pub(crate) fn is_prompt(&self) -> bool {
        self.habit == Habit::Prompt
    }

    /// It does not run until then. A robot that does not run believes nothing.
    pub(crate) fn stop(&mut self, shared: &Shared, until: Nanos) {
        self.stopped_until = until;
        if let Some((_, verdict)) = &mut self.belief {
            believe(shared, self.sensor, verdict, Verdict::Unknown);
        }
    }

    /// When it does something next.
    pub(crate) fn next_ns(&self, now: Nanos) -> Nanos {
        let left = self.belief.as_ref().and_then(|(freshness, _)| freshness.left(moment(now)));
        let silent = left.map_or(Nanos::MAX, |left| now.saturating_add(left.as_nanos() as Nanos));
        self.next_at.min(silent).max(self.stopped_until)
    }

    /// Does what it does at `now`.
    pub(crate) fn run(&mut self, shared: &Shared, now: Nanos) {
        match self.habit {
            Habit::Slow { every_ms } => {
                self.next_at = now + every_ms * MILLIS;
                self.take(shared, now);
            }
            Habit::Prompt | Habit::Listener | Habit::Robot => {
                self.next_at = Nanos::MAX;
                while self.take(shared, now) {}
            }
        }
        if let Some((freshness, verdict)) = &mut self.belief
            && freshness.silence(moment(now))
        {
            believe(shared, self.sensor, verdict, Verdict::Unknown);
        }
    }

    /// Takes all that waits.
    pub(crate) fn drain(&mut self, shared: &Shared) {
        while self.take(shared, shared.clock.get()) {}
    }

    /// It is gone, because it left or because it was killed; if it `is_drained`, nothing waited for it any more.
    pub(crate) fn leave(self, shared: &Shared, is_killed: bool, is_drained: bool) {
        shared.board.borrow_mut().detach(self.sensor, self.topic, self.number, is_killed);
        shared.tell(&Event::Left { consumer: self.number, is_drained });
    }

    fn take(&mut self, shared: &Shared, now: Nanos) -> bool {
        let sample = shared.board.borrow_mut().take(self.sensor, self.topic, self.number);
        let Some(sample) = sample else { return false };
        let Noted { missed, .. } = self.numbers.note(&sample.header);
        shared.log.tell(now, &Event::Taken { consumer: self.number, sample: &sample, missed });
        if let Some((freshness, verdict)) = &mut self.belief {
            let zones: Zones = pod_read_unaligned(&sample.bytes);
            let is_fresh = freshness.heard(&sample.header, zones.verdict(), moment(now));
            let heard = if is_fresh { zones.verdict() } else { Verdict::Unknown };
            believe(shared, self.sensor, verdict, heard);
        }
        if self.holds > 0 {
            self.held.push_back(sample);
            if self.held.len() > self.holds {
                self.held.pop_front();
            }
        }
        true
    }
}

fn believe(shared: &Shared, sensor: usize, verdict: &mut Verdict, new: Verdict) {
    if std::mem::replace(verdict, new) != new {
        shared.tell(&Event::Believes { sensor, verdict: new });
    }
}

/// The machine is never suspended.
fn moment(now: Nanos) -> Moment {
    Moment { monotonic_ns: now, boottime_ns: now }
}

/// From the hub's ring to a consumer that has a sample.
const TAKES: Nanos = 60 * MICROS;
/// A hub that lives hands what it keeps to newcomers within so long, and wakes nobody for it.
const GREETING: Nanos = 110 * MILLIS;
