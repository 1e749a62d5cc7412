//! State that all parts of a world share: the clock, the ports, the topics, the files, and the log of events. The state
//! belongs to one thread.

use std::cell::{Cell, RefCell};
use std::collections::BTreeMap;
use std::rc::Rc;

use scanhub_schema::{Nanos, Topic};

use crate::event::{Detail, Event, RevolutionFigures, Violation};
use crate::hash::HistoryHash;
use crate::injected_defects::InjectedDefect;
use crate::invariants::{Invariant, ViolationReporter};
use crate::line::Handle;
use crate::subscriber::{Behavior, Subscriber, SubscriberId, WakeSource};
use crate::topics::TopicBoard;
use crate::tty::Tty;

/// The parts of a world that a hub can access.
pub(crate) struct SharedState {
    /// Nanoseconds since the machine was started.
    pub(crate) clock: Cell<Nanos>,
    /// Number of nanoseconds that is added to `clock` to get the time since 1970.
    pub(crate) wall_offset: Cell<u64>,
    pub(crate) ports: Vec<RefCell<Tty>>,
    pub(crate) topics: RefCell<TopicBoard>,
    pub(crate) log: EventLog,
    pub(crate) defect: InjectedDefect,
    /// Files with learned state, and whether their disk is full.
    pub(crate) files: RefCell<BTreeMap<String, String>>,
    pub(crate) disk_is_full: Cell<bool>,
    /// Records in the domain's directory, by name.
    pub(crate) records: RefCell<BTreeMap<String, Vec<u8>>>,
    /// Whether a service manager keeps the ports of a killed hub.
    pub(crate) keeps_ports: bool,
    pub(crate) stored_lines: RefCell<BTreeMap<String, Rc<Handle>>>,
    /// Number of open lines, including those that a service manager keeps.
    pub(crate) handles: Cell<usize>,
    /// Whether every attempt to open a port fails, because no file descriptor is free.
    pub(crate) lacks_descriptors: Cell<bool>,
    /// Wakeups that are not delivered yet: sensor, source and time.
    pub(crate) wakeups: RefCell<Vec<(usize, WakeSource, Nanos)>>,
    /// ID of the next subscriber.
    pub(crate) next_subscriber: Cell<u32>,
    /// Changes of subscribers that must happen while a hub sends the samples of a scan.
    pub(crate) changes: RefCell<Vec<SubscriberChange>>,
    /// Subscribers that `changes` have attached, each with the number of milliseconds for which it stays; and
    /// subscribers that `changes` have removed.
    pub(crate) attached: RefCell<Vec<(Subscriber, u64)>>,
    pub(crate) detached: RefCell<Vec<SubscriberId>>,
}

/// A change of a sensor's subscribers, which happens after the hub has sent a number of the sensor's samples.
pub(crate) struct SubscriberChange {
    pub(crate) sensor: usize,
    /// Number of samples that are sent before the change.
    pub(crate) after_sends: u64,
    pub(crate) kind: ChangeKind,
}

/// Kind of a change.
#[derive(Clone, Copy)]
pub(crate) enum ChangeKind {
    /// A new subscriber attaches, and stays for this number of milliseconds.
    Attach { topic: Topic, behavior: Behavior, max_held: usize, span_ms: u64 },
    /// This subscriber of a topic leaves.
    Detach { topic: Topic, id: SubscriberId },
}

impl SharedState {
    pub(crate) fn log_event(&self, event: &Event<'_>) {
        self.log.record(self.clock.get(), event);
    }

    /// Returns the ID of a new subscriber.
    pub(crate) fn next_subscriber_id(&self) -> SubscriberId {
        let number = self.next_subscriber.get();
        self.next_subscriber.set(number + 1);
        SubscriberId(number)
    }

    /// Applies the changes of subscribers that are due at `now`, when a sample of `sensor` was sent.
    pub(crate) fn change_subscribers(&self, sensor: usize, now: Nanos) {
        let mut due = Vec::new();
        self.changes.borrow_mut().retain_mut(|change| {
            if change.sensor != sensor {
                return true;
            }
            if change.after_sends == 0 {
                due.push(change.kind);
                return false;
            }
            change.after_sends -= 1;
            true
        });
        for due_change in due {
            match due_change {
                ChangeKind::Attach { topic, behavior, max_held: holds, span_ms } => {
                    let number = self.next_subscriber_id();
                    let subscriber = Subscriber::attach(self, number, (sensor, topic), behavior, holds, now);
                    self.attached.borrow_mut().extend(subscriber.map(|client| (client, span_ms)));
                }
                ChangeKind::Detach { topic, id: number } => {
                    self.topics.borrow_mut().detach(sensor, topic, number, false);
                    self.log.record(now, &Event::Detached { subscriber: number, is_drained: false });
                    self.detached.borrow_mut().push(number);
                }
            }
        }
    }
}

/// Log that adds each event to the hash and passes it to all invariants.
pub(crate) struct EventLog {
    inner: RefCell<LogState>,
    detail: Detail,
    /// Invariants that end the world at their first violation.
    sought_invariants: &'static [&'static str],
    /// Whether one of the `sought_invariants` has reported a violation.
    is_found: Cell<bool>,
}

struct LogState {
    history: HistoryHash,
    invariants: Vec<Box<dyn Invariant>>,
    violations: Vec<Violation>,
    published: u64,
}

impl EventLog {
    pub(crate) fn new(
        invariants: Vec<Box<dyn Invariant>>,
        detail: Detail,
        sought_invariants: &'static [&'static str],
    ) -> EventLog {
        let inner =
            LogState { history: HistoryHash::new(), invariants, violations: Vec::new(), published: 0 };
        EventLog { inner: RefCell::new(inner), detail, sought_invariants, is_found: Cell::new(false) }
    }

    /// Returns whether one of the sought invariants has reported a violation.
    pub(crate) fn is_found(&self) -> bool {
        self.is_found.get()
    }

    /// Handles an event at time `at`.
    pub(crate) fn record(&self, at: Nanos, event: &Event<'_>) {
        let LogState { history, invariants, violations, published } = &mut *self.inner.borrow_mut();
        if self.detail > Detail::Nothing
            && let Some(words) = event.describe(self.detail)
        {
            eprintln!("{:>12.6} {words}", at as f64 / 1e9);
        }
        event.hash(at, history);
        *published += u64::from(matches!(event, Event::Published { .. }));
        for invariant in invariants {
            let name = invariant.name();
            invariant.on_event(at, event, &mut ViolationReporter { invariant: name, at_ns: at, violations });
        }
        if violations.last().is_some_and(|last| self.sought_invariants.contains(&last.invariant)) {
            self.is_found.set(true);
        }
    }

    /// Returns all violations, the hash, the number of published samples, and the figures of the invariants.
    pub(crate) fn finish(&self) -> (Vec<Violation>, u64, u64, RevolutionFigures) {
        let mut inner = self.inner.borrow_mut();
        let mut figures = RevolutionFigures::default();
        inner.invariants.iter().for_each(|invariant| figures.add(&invariant.figures()));
        (std::mem::take(&mut inner.violations), inner.history.value(), inner.published, figures)
    }
}
