//! What all parts of a world have in common: the clock, the ports, the topics, the files, and the log that everything is told
//! to. Lives in one thread.

use std::cell::{Cell, RefCell};
use std::collections::BTreeMap;
use std::rc::Rc;

use scanhub_schema::{Nanos, Topic};

use crate::consumer::{Bell, Consumer, Habit, Number};
use crate::event::{Detail, Event, Figures, Violation};
use crate::hash::History;
use crate::judges::{Judge, Say};
use crate::line::Handle;
use crate::planted::Planted;
use crate::topics::Board;
use crate::tty::Tty;

/// The parts of a world that a hub can reach.
pub(crate) struct Shared {
    /// Nanoseconds since the machine was started.
    pub(crate) clock: Cell<Nanos>,
    /// From the clock to 1970.
    pub(crate) wall_ahead: Cell<u64>,
    pub(crate) ports: Vec<RefCell<Tty>>,
    pub(crate) board: RefCell<Board>,
    pub(crate) log: Log,
    pub(crate) planted: Planted,
    /// The directory in which what was learned is kept, and whether its disk is full.
    pub(crate) files: RefCell<BTreeMap<String, String>>,
    pub(crate) disk_is_full: Cell<bool>,
    /// The little files in the domain's directory.
    pub(crate) records: RefCell<BTreeMap<String, Vec<u8>>>,
    /// A service manager keeps ports of a killed hub.
    pub(crate) keeps_ports: bool,
    pub(crate) kept: RefCell<BTreeMap<String, Rc<Handle>>>,
    /// Lines that are open, kept ones too.
    pub(crate) handles: Cell<usize>,
    /// Nobody can open anything.
    pub(crate) lacks_descriptors: Cell<bool>,
    /// Sensors whose subscribers were woken, the bell, and the time.
    pub(crate) woken: RefCell<Vec<(usize, Bell, Nanos)>>,
    /// Number of the next subscriber.
    pub(crate) next_consumer: Cell<u32>,
    /// Changes of subscribers that happen while a hub sends the samples of a scan.
    pub(crate) changes: RefCell<Vec<Change>>,
    /// Subscribers that such a change has attached, with the milliseconds for which they stay, and those that have left.
    pub(crate) newcomers: RefCell<Vec<(Consumer, u64)>>,
    pub(crate) leavers: RefCell<Vec<Number>>,
}

/// A change of the subscribers of a sensor after it has sent some more samples.
pub(crate) struct Change {
    pub(crate) sensor: usize,
    /// Number of samples that are sent before it happens.
    pub(crate) sends: u64,
    pub(crate) what: Who,
}

/// Subscriber that attaches or leaves.
#[derive(Clone, Copy)]
pub(crate) enum Who {
    /// A new one attaches, and stays for this number of milliseconds.
    Comes { topic: Topic, habit: Habit, holds: usize, span_ms: u64 },
    /// This subscriber of a topic leaves.
    Leaves { topic: Topic, number: Number },
}

impl Shared {
    pub(crate) fn tell(&self, event: &Event<'_>) {
        self.log.tell(self.clock.get(), event);
    }

    /// Returns the number of a new subscriber.
    pub(crate) fn consumer_number(&self) -> Number {
        let number = self.next_consumer.get();
        self.next_consumer.set(number + 1);
        Number(number)
    }

    /// Makes the changes of subscribers that are due after a sample of `sensor` was sent at `now`.
    pub(crate) fn change_subscribers(&self, sensor: usize, now: Nanos) {
        let mut due = Vec::new();
        self.changes.borrow_mut().retain_mut(|change| {
            if change.sensor != sensor {
                return true;
            }
            if change.sends == 0 {
                due.push(change.what);
                return false;
            }
            change.sends -= 1;
            true
        });
        for who in due {
            match who {
                Who::Comes { topic, habit, holds, span_ms } => {
                    let number = self.consumer_number();
                    let came = Consumer::attach(self, number, (sensor, topic), habit, holds, now);
                    self.newcomers.borrow_mut().extend(came.map(|consumer| (consumer, span_ms)));
                }
                Who::Leaves { topic, number } => {
                    self.board.borrow_mut().detach(sensor, topic, number, false);
                    self.log.tell(now, &Event::Left { consumer: number, is_drained: false });
                    self.leavers.borrow_mut().push(number);
                }
            }
        }
    }
}

/// Everything that happens goes through here: into the hash, and to the judges.
pub(crate) struct Log {
    inner: RefCell<Inner>,
    detail: Detail,
    /// Judges of which one violation is enough.
    sought: &'static [&'static str],
    /// Whether one of them has found something.
    is_found: Cell<bool>,
}

struct Inner {
    history: History,
    judges: Vec<Box<dyn Judge>>,
    violations: Vec<Violation>,
    published: u64,
}

impl Log {
    pub(crate) fn new(judges: Vec<Box<dyn Judge>>, detail: Detail, sought: &'static [&'static str]) -> Log {
        let inner = Inner { history: History::new(), judges, violations: Vec::new(), published: 0 };
        Log { inner: RefCell::new(inner), detail, sought, is_found: Cell::new(false) }
    }

    /// Returns whether a judge whose violation is sought has found one.
    pub(crate) fn is_found(&self) -> bool {
        self.is_found.get()
    }

    /// `event` happened at `at`.
    pub(crate) fn tell(&self, at: Nanos, event: &Event<'_>) {
        let Inner { history, judges, violations, published } = &mut *self.inner.borrow_mut();
        if self.detail > Detail::Nothing
            && let Some(words) = event.words(self.detail)
        {
            eprintln!("{:>12.6} {words}", at as f64 / 1e9);
        }
        event.hash(at, history);
        *published += u64::from(matches!(event, Event::Published { .. }));
        for judge in judges {
            let name = judge.name();
            judge.note(at, event, &mut Say { judge: name, at_ns: at, violations });
        }
        if violations.last().is_some_and(|last| self.sought.contains(&last.judge)) {
            self.is_found.set(true);
        }
    }

    /// What the judges said, the hash of everything, how many samples were published, and what the judges measured.
    pub(crate) fn end(&self) -> (Vec<Violation>, u64, u64, Figures) {
        let mut inner = self.inner.borrow_mut();
        let mut figures = Figures::default();
        inner.judges.iter().for_each(|judge| figures.add(&judge.figures()));
        (std::mem::take(&mut inner.violations), inner.history.value(), inner.published, figures)
    }
}
