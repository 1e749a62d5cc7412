//! What all parts of a world have in common: the clock, the ports, the topics, the files, and the log that everything is told
//! to. Lives in one thread.

use std::cell::{Cell, RefCell};
use std::collections::BTreeMap;
use std::rc::Rc;

use scanhub_schema::{Nanos, Ring};

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
    /// Sensors whose consumers were woken, of which topics, and when.
    pub(crate) woken: RefCell<Vec<(usize, Ring, Nanos)>>,
}

impl Shared {
    pub(crate) fn tell(&self, event: &Event<'_>) {
        self.log.tell(self.clock.get(), event);
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
