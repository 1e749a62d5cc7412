//! Topics in the memory of one process, with the limits of the real topics. Each subscriber has a queue, which drops
//! its oldest sample when it is full. A topic has a history for late joiners, and its publisher has a limited number of
//! loans.

use std::borrow::{Borrow, BorrowMut};
use std::cell::{Cell, RefCell};
use std::collections::VecDeque;
use std::convert::Infallible;
use std::fmt::Debug;
use std::marker::PhantomData;
use std::rc::Rc;

use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{Early, Header, Nanos, Topic, Verdict, limits};
use scanhub_shm::{LoanError, Payload, SampleTransport, SendError};

use crate::event::Event;
use crate::injected_defects::{Defect, SampleCorrupter};
use crate::line::LinkClock;
use crate::shared::{EventLog, SharedState};
use crate::subscriber::SubscriberId;

/// A sample that was sent.
#[derive(Debug)]
pub(crate) struct Sample {
    pub(crate) topic: Topic,
    pub(crate) header: Header,
    pub(crate) bytes: Vec<u8>,
    /// Time at which the sample was sent; and number of samples of its topic that the same hub had sent before it.
    pub(crate) sent_at: Nanos,
    pub(crate) index: u64,
    /// Number of subscribers to which the sample was sent.
    pub(crate) receivers: usize,
    /// Counts the sample as long as a queue, a history or a subscriber contains it.
    _counted: LiveCount,
}

/// Increments a counter, and decrements it when dropped.
#[derive(Debug)]
struct LiveCount(Rc<Cell<usize>>);

impl LiveCount {
    fn new(count: &Rc<Cell<usize>>) -> LiveCount {
        count.set(count.get() + 1);
        LiveCount(count.clone())
    }
}

impl Drop for LiveCount {
    fn drop(&mut self) {
        self.0.set(self.0.get() - 1);
    }
}

/// All topics of all sensors.
pub(crate) struct TopicBoard {
    sensors: Vec<[Channel; Topic::ALL.len()]>,
    /// Number of loans that were not sent; and number of samples that are held, queued or in a history.
    loans: Rc<Cell<usize>>,
    samples: Rc<Cell<usize>>,
    /// For each sensor, the number of times that a subscriber has attached.
    attached: Vec<u32>,
    /// Whether every publisher runs out of memory.
    pub(crate) lacks_memory: bool,
}

#[derive(Default)]
struct Channel {
    slots: Vec<SubscriberSlot>,
    history: VecDeque<Rc<Sample>>,
}

struct SubscriberSlot {
    subscriber: SubscriberId,
    queue: VecDeque<Rc<Sample>>,
    is_connected: bool,
    /// Whether the subscriber sleeps on the event of the sensor.
    is_listener: bool,
    /// Whether the subscriber's process was killed. The next hub removes a killed subscriber.
    was_killed: bool,
}

impl TopicBoard {
    pub(crate) fn new(sensors: usize) -> TopicBoard {
        TopicBoard {
            sensors: (0..sensors).map(|_| Default::default()).collect(),
            loans: Rc::default(),
            samples: Rc::default(),
            attached: vec![0; sensors],
            lacks_memory: false,
        }
    }

    /// Returns the number of loans that were not sent, and the number of samples that exist.
    pub(crate) fn in_use(&self) -> (usize, usize) {
        (self.loans.get(), self.samples.get())
    }

    /// Prepares a topic for a new hub. Removes subscribers whose process was killed. All other subscribers must connect
    /// again.
    fn begin(&mut self, sensor: usize, topic: Topic) {
        self.remove_killed();
        let channel = &mut self.sensors[sensor][topic as usize];
        channel.history.clear();
        channel.slots.iter_mut().for_each(|place| place.is_connected = false);
    }

    /// Removes the subscribers that were killed.
    pub(crate) fn remove_killed(&mut self) {
        let channels = self.sensors.iter_mut().flatten();
        channels.for_each(|channel| channel.slots.retain(|place| !place.was_killed));
    }

    /// Clears the history of all topics, because the hub has ended.
    pub(crate) fn end(&mut self) {
        self.sensors.iter_mut().flatten().for_each(|channel| channel.history.clear());
    }

    /// Returns the number of times that a subscriber of `sensor` has attached.
    pub(crate) fn attached(&self, sensor: usize) -> u32 {
        self.attached[sensor]
    }

    /// Returns whether the event of `sensor` has a listener. A killed listener counts until the next hub removes it.
    pub(crate) fn has_listeners(&self, sensor: usize) -> bool {
        self.sensors[sensor].iter().flat_map(|channel| &channel.slots).any(|place| place.is_listener)
    }

    /// Attaches `subscriber`, which sleeps on the event of the sensor if `is_listener`. Returns whether there was a
    /// free slot.
    pub(crate) fn attach(
        &mut self,
        sensor: usize,
        topic: Topic,
        subscriber: SubscriberId,
        is_listener: bool,
    ) -> bool {
        self.attached[sensor] += 1;
        let places = &mut self.sensors[sensor][topic as usize].slots;
        let has_room = places.len() < TopicLimits::default().subscribers;
        if has_room {
            let queue = VecDeque::new();
            places.push(SubscriberSlot {
                subscriber,
                queue,
                is_connected: false,
                is_listener,
                was_killed: false,
            });
        }
        has_room
    }

    /// Removes `subscriber`, or marks it as killed.
    pub(crate) fn detach(&mut self, sensor: usize, topic: Topic, subscriber: SubscriberId, is_killed: bool) {
        let places = &mut self.sensors[sensor][topic as usize].slots;
        if is_killed {
            places.iter_mut().for_each(|place| place.was_killed |= place.subscriber == subscriber);
        } else {
            places.retain(|place| place.subscriber != subscriber);
        }
    }

    /// Takes the oldest sample from the queue of `subscriber`.
    pub(crate) fn take(
        &mut self,
        sensor: usize,
        topic: Topic,
        subscriber: SubscriberId,
    ) -> Option<Rc<Sample>> {
        let places = &mut self.sensors[sensor][topic as usize].slots;
        places.iter_mut().find(|place| place.subscriber == subscriber)?.queue.pop_front()
    }

    /// Returns the number of subscribers of a topic.
    fn subscribers(&self, sensor: usize, topic: Topic) -> usize {
        self.sensors[sensor][topic as usize].slots.len()
    }

    fn connect(&mut self, sensor: usize, topic: Topic, log: &EventLog, now: Nanos) {
        let Channel { slots, history } = &mut self.sensors[sensor][topic as usize];
        for place in slots.iter_mut().filter(|place| !place.is_connected) {
            place.is_connected = true;
            history.iter().for_each(|sample| place.push(sample, log, now));
        }
    }

    fn send(&mut self, sensor: usize, sample: &Rc<Sample>, log: &EventLog, now: Nanos) -> usize {
        self.connect(sensor, sample.topic, log, now);
        let Channel { slots, history } = &mut self.sensors[sensor][sample.topic as usize];
        slots.iter_mut().for_each(|place| place.push(sample, log, now));
        if limits::history_len(sample.topic) > 0 {
            if history.len() == limits::history_len(sample.topic) {
                history.pop_front();
            }
            history.push_back(sample.clone());
        }
        slots.len()
    }
}

impl SubscriberSlot {
    fn push(&mut self, sample: &Rc<Sample>, log: &EventLog, now: Nanos) {
        if self.queue.len() == limits::queue_len(sample.topic)
            && let Some(oldest) = self.queue.pop_front()
        {
            log.record(now, &Event::Dropped { subscriber: self.subscriber, sample: &oldest });
        }
        self.queue.push_back(sample.clone());
    }
}

/// The publisher of one topic of one sensor.
pub(crate) struct SimTransport<P: ?Sized> {
    shared: Rc<SharedState>,
    clock: Rc<LinkClock>,
    sensor: usize,
    /// Number of loans of this publisher that were not sent.
    loaned: Rc<Cell<usize>>,
    sent: Cell<u64>,
    /// Sample that an injected defect holds back.
    delayed: RefCell<Option<Rc<Sample>>>,
    corrupter: RefCell<SampleCorrupter>,
    payload: PhantomData<fn(&P)>,
}

/// Loaned memory for a sample.
pub(crate) struct Loan<P: Payload + ?Sized> {
    payload: P::Owned,
    _counted: (LiveCount, LiveCount),
}

impl<P: Payload + ?Sized> SimTransport<P> {
    pub(crate) fn new(shared: &Rc<SharedState>, clock: &Rc<LinkClock>, sensor: usize) -> Self {
        shared.topics.borrow_mut().begin(sensor, P::TOPIC);
        let (shared, clock) = (shared.clone(), clock.clone());
        SimTransport {
            shared,
            clock,
            sensor,
            loaned: Rc::default(),
            sent: Cell::new(0),
            delayed: RefCell::default(),
            corrupter: RefCell::default(),
            payload: PhantomData,
        }
    }
}

impl<P: Payload + ?Sized> SampleTransport<P> for SimTransport<P> {
    type Loan = Loan<P>;

    fn subscribers(&self) -> usize {
        self.shared.topics.borrow().subscribers(self.sensor, P::TOPIC)
    }

    fn connect(&self) -> Result<(), impl Debug + use<P>> {
        let mut board = self.shared.topics.borrow_mut();
        board.connect(self.sensor, P::TOPIC, &self.shared.log, self.clock.now());
        Ok::<(), Infallible>(())
    }

    fn loan(&self, len: usize) -> Result<Loan<P>, LoanError> {
        let board = self.shared.topics.borrow();
        if self.loaned.get() == limits::MAX_LOANED_SAMPLES {
            return Err(LoanError::ExceedsMaxLoans);
        }
        if board.lacks_memory {
            let lacking = Event::OutOfMemory { sensor: self.sensor, topic: P::TOPIC };
            self.shared.log.record(self.clock.now(), &lacking);
            return Err(LoanError::OutOfMemory);
        }
        let _counted = (LiveCount::new(&board.loans), LiveCount::new(&self.loaned));
        Ok(Loan { payload: P::owned(len), _counted })
    }

    fn payload_mut(loan: &mut Loan<P>) -> &mut P {
        loan.payload.borrow_mut()
    }

    fn send(&self, loan: Loan<P>, header: &Header) -> Result<usize, SendError> {
        let reached = self.send_now(loan, header);
        self.shared.change_subscribers(self.sensor, self.clock.now());
        reached
    }
}

impl<P: Payload + ?Sized> SimTransport<P> {
    fn send_now(&self, loan: Loan<P>, header: &Header) -> Result<usize, SendError> {
        let now = self.clock.now();
        let SharedState { topics: board, log, defect, .. } = &*self.shared;
        let mut board = board.borrow_mut();
        let payload: &P = loan.payload.borrow();
        let mut bytes = payload.bytes().to_vec();
        let _counted = LiveCount::new(&board.samples);
        let mut header = *header;
        let topic = P::TOPIC;
        if topic == Topic::Telegram && defect.triggers(Defect::UnsentTelegram, 100) {
            return Ok(0);
        }
        if topic == Topic::Early && defect.is_active(Defect::UnsentWarning) {
            return Ok(0);
        }
        if topic == Topic::Early && defect.is_active(Defect::KeptWarning) && bytes[1] == Early::WITHDRAWN {
            return Ok(0);
        }
        if topic == Topic::Zones && defect.is_active(Defect::SurvivingVerdict) && bytes[0] == UNKNOWN {
            bytes[0] = Verdict::Clear as u8;
        }
        if header.topic_seq > 0 && defect.triggers(Defect::Renumbered, 100) {
            header.topic_seq -= 1;
        }
        if SampleCorrupter::is_needed(defect) {
            self.corrupter.borrow_mut().corrupt(defect, (topic, now), &mut header, &mut bytes);
        }
        let index = self.sent.replace(self.sent.get() + 1);
        let receivers = board.subscribers(self.sensor, topic);
        let sample = Rc::new(Sample { topic, header, bytes, sent_at: now, index, receivers, _counted });
        log.record(now, &Event::Published { sensor: self.sensor, sample: &sample });
        if defect.triggers(Defect::LeakedLoan, 1_000) {
            std::mem::forget(loan);
        }
        if defect.triggers(Defect::Delayed, 100) || defect.triggers(Defect::Reordered, 100) {
            return Ok(self
                .delayed
                .replace(Some(sample))
                .map_or(1, |late| board.send(self.sensor, &late, log, now)));
        }
        let late = self.delayed.take();
        let is_behind = late.is_some() && defect.is_active(Defect::Reordered);
        let (first, second) = if is_behind { (Some(sample), late) } else { (late, Some(sample)) };
        let mut receivers = 0;
        for sample in first.into_iter().chain(second) {
            let times = if defect.triggers(Defect::SentTwice, 100) { 2 } else { 1 };
            (0..times).for_each(|_| receivers = board.send(self.sensor, &sample, log, now));
        }
        Ok(receivers)
    }
}

/// Value of the first byte in the payload of unknown zones.
const UNKNOWN: u8 = Verdict::Unknown as u8;
