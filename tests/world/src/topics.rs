//! The topics in the memory of one process, with the limits of the real ones: a queue for each consumer that drops the oldest
//! sample when it is full, the history for late joiners, the loans of a publisher. Refuses to know what a sample means.

use std::borrow::{Borrow, BorrowMut};
use std::cell::{Cell, RefCell};
use std::collections::VecDeque;
use std::convert::Infallible;
use std::fmt::Debug;
use std::marker::PhantomData;
use std::rc::Rc;

use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{Early, Header, Nanos, Topic, Verdict, limits};
use scanhub_shm::{LoanError, Medium, Payload, SendError};

use crate::consumer::Number;
use crate::event::Event;
use crate::line::LinkClock;
use crate::planted::{Defect, Spoiler};
use crate::shared::{Log, Shared};

/// A sample that was sent.
#[derive(Debug)]
pub(crate) struct Sample {
    pub(crate) topic: Topic,
    pub(crate) header: Header,
    pub(crate) bytes: Vec<u8>,
    /// When it was sent, and how many of its topic were sent before it by the same hub.
    pub(crate) at: Nanos,
    pub(crate) index: u64,
    /// Number of subscribers to which it was sent.
    pub(crate) reached: usize,
    /// Samples that are in memory count as long as anybody has them.
    _counted: Counted,
}

/// One of the things that are counted while they are there.
#[derive(Debug)]
struct Counted(Rc<Cell<usize>>);

impl Counted {
    fn new(count: &Rc<Cell<usize>>) -> Counted {
        count.set(count.get() + 1);
        Counted(count.clone())
    }
}

impl Drop for Counted {
    fn drop(&mut self) {
        self.0.set(self.0.get() - 1);
    }
}

/// All topics of all sensors.
pub(crate) struct Board {
    sensors: Vec<[Channel; Topic::ALL.len()]>,
    /// Loans that were not sent, and samples that are held, wait or are kept.
    loans: Rc<Cell<usize>>,
    samples: Rc<Cell<usize>>,
    /// For each sensor, the number of times that a subscriber has attached.
    attached: Vec<u32>,
    /// No publisher gets memory.
    pub(crate) lacks_memory: bool,
}

#[derive(Default)]
struct Channel {
    places: Vec<Place>,
    kept: VecDeque<Rc<Sample>>,
}

struct Place {
    consumer: Number,
    queue: VecDeque<Rc<Sample>>,
    is_connected: bool,
    /// Whether the subscriber sleeps on the event of the sensor.
    is_listener: bool,
    /// Its process was killed; the next hub cleans up.
    is_dead: bool,
}

impl Board {
    pub(crate) fn new(sensors: usize) -> Board {
        Board {
            sensors: (0..sensors).map(|_| Default::default()).collect(),
            loans: Rc::default(),
            samples: Rc::default(),
            attached: vec![0; sensors],
            lacks_memory: false,
        }
    }

    /// Loans and samples that are there.
    pub(crate) fn in_use(&self) -> (usize, usize) {
        (self.loans.get(), self.samples.get())
    }

    /// A hub begins to publish: what dead ones left is cleaned up, and everybody has to connect anew.
    fn begin(&mut self, sensor: usize, topic: Topic) {
        self.clean();
        let channel = &mut self.sensors[sensor][topic as usize];
        channel.kept.clear();
        channel.places.iter_mut().for_each(|place| place.is_connected = false);
    }

    /// What killed consumers left is removed.
    pub(crate) fn clean(&mut self) {
        let channels = self.sensors.iter_mut().flatten();
        channels.for_each(|channel| channel.places.retain(|place| !place.is_dead));
    }

    /// The hub is gone: nobody keeps anything for late joiners any more.
    pub(crate) fn end(&mut self) {
        self.sensors.iter_mut().flatten().for_each(|channel| channel.kept.clear());
    }

    /// Returns the number of times that a subscriber of `sensor` has attached.
    pub(crate) fn attached(&self, sensor: usize) -> u32 {
        self.attached[sensor]
    }

    /// Returns whether the event of `sensor` has a listener. A killed one counts until the next hub cleans up.
    pub(crate) fn has_listeners(&self, sensor: usize) -> bool {
        self.sensors[sensor].iter().flat_map(|channel| &channel.places).any(|place| place.is_listener)
    }

    /// Attaches `consumer`, which sleeps on the event of the sensor if it `is_listener`. Returns whether there was a place.
    pub(crate) fn attach(
        &mut self,
        sensor: usize,
        topic: Topic,
        consumer: Number,
        is_listener: bool,
    ) -> bool {
        self.attached[sensor] += 1;
        let places = &mut self.sensors[sensor][topic as usize].places;
        let has_room = places.len() < TopicLimits::default().subscribers;
        if has_room {
            let queue = VecDeque::new();
            places.push(Place { consumer, queue, is_connected: false, is_listener, is_dead: false });
        }
        has_room
    }

    /// `consumer` leaves, or is killed.
    pub(crate) fn detach(&mut self, sensor: usize, topic: Topic, consumer: Number, is_killed: bool) {
        let places = &mut self.sensors[sensor][topic as usize].places;
        if is_killed {
            places.iter_mut().for_each(|place| place.is_dead |= place.consumer == consumer);
        } else {
            places.retain(|place| place.consumer != consumer);
        }
    }

    /// The oldest sample that waits for `consumer`.
    pub(crate) fn take(&mut self, sensor: usize, topic: Topic, consumer: Number) -> Option<Rc<Sample>> {
        let places = &mut self.sensors[sensor][topic as usize].places;
        places.iter_mut().find(|place| place.consumer == consumer)?.queue.pop_front()
    }

    /// Returns the number of subscribers of a topic.
    fn subscribers(&self, sensor: usize, topic: Topic) -> usize {
        self.sensors[sensor][topic as usize].places.len()
    }

    fn connect(&mut self, sensor: usize, topic: Topic, log: &Log, now: Nanos) {
        let Channel { places, kept } = &mut self.sensors[sensor][topic as usize];
        for place in places.iter_mut().filter(|place| !place.is_connected) {
            place.is_connected = true;
            kept.iter().for_each(|sample| place.push(sample, log, now));
        }
    }

    fn send(&mut self, sensor: usize, sample: &Rc<Sample>, log: &Log, now: Nanos) -> usize {
        self.connect(sensor, sample.topic, log, now);
        let Channel { places, kept } = &mut self.sensors[sensor][sample.topic as usize];
        places.iter_mut().for_each(|place| place.push(sample, log, now));
        if limits::history(sample.topic) > 0 {
            if kept.len() == limits::history(sample.topic) {
                kept.pop_front();
            }
            kept.push_back(sample.clone());
        }
        places.len()
    }
}

impl Place {
    fn push(&mut self, sample: &Rc<Sample>, log: &Log, now: Nanos) {
        if self.queue.len() == limits::buffer(sample.topic)
            && let Some(oldest) = self.queue.pop_front()
        {
            log.tell(now, &Event::Dropped { consumer: self.consumer, sample: &oldest });
        }
        self.queue.push_back(sample.clone());
    }
}

/// The publishing end of one topic of one sensor.
pub(crate) struct Carrier<P: ?Sized> {
    shared: Rc<Shared>,
    clock: Rc<LinkClock>,
    sensor: usize,
    /// Loans of this publisher that were not sent.
    loaned: Rc<Cell<usize>>,
    sent: Cell<u64>,
    /// A sample that a planted defect holds back.
    late: RefCell<Option<Rc<Sample>>>,
    spoiler: RefCell<Spoiler>,
    payload: PhantomData<fn(&P)>,
}

/// Memory of a sample.
pub(crate) struct Loan<P: Payload + ?Sized> {
    payload: P::Owned,
    _counted: (Counted, Counted),
}

impl<P: Payload + ?Sized> Carrier<P> {
    pub(crate) fn new(shared: &Rc<Shared>, clock: &Rc<LinkClock>, sensor: usize) -> Self {
        shared.board.borrow_mut().begin(sensor, P::TOPIC);
        let (shared, clock) = (shared.clone(), clock.clone());
        Carrier {
            shared,
            clock,
            sensor,
            loaned: Rc::default(),
            sent: Cell::new(0),
            late: RefCell::default(),
            spoiler: RefCell::default(),
            payload: PhantomData,
        }
    }
}

impl<P: Payload + ?Sized> Medium<P> for Carrier<P> {
    type Loan = Loan<P>;

    fn subscribers(&self) -> usize {
        self.shared.board.borrow().subscribers(self.sensor, P::TOPIC)
    }

    fn connect(&self) -> Result<(), impl Debug + use<P>> {
        let mut board = self.shared.board.borrow_mut();
        board.connect(self.sensor, P::TOPIC, &self.shared.log, self.clock.now());
        Ok::<(), Infallible>(())
    }

    fn loan(&self, len: usize) -> Result<Loan<P>, LoanError> {
        let board = self.shared.board.borrow();
        if self.loaned.get() == limits::LOANED {
            return Err(LoanError::ExceedsMaxLoans);
        }
        if board.lacks_memory {
            let lacking = Event::Lacking { sensor: self.sensor, topic: P::TOPIC };
            self.shared.log.tell(self.clock.now(), &lacking);
            return Err(LoanError::OutOfMemory);
        }
        let _counted = (Counted::new(&board.loans), Counted::new(&self.loaned));
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

impl<P: Payload + ?Sized> Carrier<P> {
    fn send_now(&self, loan: Loan<P>, header: &Header) -> Result<usize, SendError> {
        let now = self.clock.now();
        let Shared { board, log, planted, .. } = &*self.shared;
        let mut board = board.borrow_mut();
        let payload: &P = loan.payload.borrow();
        let mut bytes = payload.bytes().to_vec();
        let _counted = Counted::new(&board.samples);
        let mut header = *header;
        let topic = P::TOPIC;
        if topic == Topic::Telegram && planted.strikes(Defect::UnsentTelegram, 100) {
            return Ok(0);
        }
        if topic == Topic::Early && planted.is(Defect::UnsentWarning) {
            return Ok(0);
        }
        if topic == Topic::Early && planted.is(Defect::KeptWarning) && bytes[1] == Early::WITHDRAWN {
            return Ok(0);
        }
        if topic == Topic::Zones && planted.is(Defect::SurvivingVerdict) && bytes[0] == UNKNOWN {
            bytes[0] = Verdict::Clear as u8;
        }
        if header.topic_seq > 0 && planted.strikes(Defect::Renumbered, 100) {
            header.topic_seq -= 1;
        }
        if Spoiler::is_needed(planted) {
            self.spoiler.borrow_mut().spoil(planted, (topic, now), &mut header, &mut bytes);
        }
        let index = self.sent.replace(self.sent.get() + 1);
        let reached = board.subscribers(self.sensor, topic);
        let sample = Rc::new(Sample { topic, header, bytes, at: now, index, reached, _counted });
        log.tell(now, &Event::Published { sensor: self.sensor, sample: &sample });
        if planted.strikes(Defect::LeakedLoan, 1_000) {
            std::mem::forget(loan);
        }
        if planted.strikes(Defect::Delayed, 100) || planted.strikes(Defect::Reordered, 100) {
            return Ok(self
                .late
                .replace(Some(sample))
                .map_or(1, |late| board.send(self.sensor, &late, log, now)));
        }
        let late = self.late.take();
        let is_behind = late.is_some() && planted.is(Defect::Reordered);
        let (first, second) = if is_behind { (Some(sample), late) } else { (late, Some(sample)) };
        let mut reached = 0;
        for sample in first.into_iter().chain(second) {
            let times = if planted.strikes(Defect::SentTwice, 100) { 2 } else { 1 };
            (0..times).for_each(|_| reached = board.send(self.sensor, &sample, log, now));
        }
        Ok(reached)
    }
}

/// The first byte of zones of which nothing is known.
const UNKNOWN: u8 = Verdict::Unknown as u8;
