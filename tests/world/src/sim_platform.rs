//! The platform of one link in a world: it implements [`scanhub_daemon::platform::Platform`] with simulated ports, topics and
//! files.

use std::cell::Cell;
use std::rc::Rc;
use std::sync::Arc;

use rustix::io::Errno;
use scanhub_daemon::SaveQueue;
use scanhub_daemon::platform::{Platform, SavedState};
use scanhub_port::{PortError, Source};
use scanhub_schema::{Failure, Kind, MICROS, Nanos, Ring, Wake};
use scanhub_shm::Payload;

use crate::consumer::Bell;
use crate::event::Event;
use crate::line::{Handle, LinkClock, OpenLine};
use crate::planted::Defect;
use crate::shared::Shared;
use crate::topics::Carrier;

/// Platform of link number `number`, whose sensor has the same number.
pub(crate) struct SimPlatform<'a> {
    pub(crate) shared: Rc<Shared>,
    pub(crate) number: usize,
    pub(crate) clock: Rc<LinkClock>,
    pub(crate) save_slot: Option<scanhub_daemon::SaveSlot<'a>>,
    /// A planted defect owes the first ring.
    is_owed: Cell<bool>,
}

impl<'a> SimPlatform<'a> {
    /// Of a hub that began at the world's present time.
    pub(crate) fn new(
        shared: &Rc<Shared>,
        number: usize,
        sensor: &str,
        queue: Option<&'a Arc<SaveQueue>>,
    ) -> Self {
        let clock = Rc::new(LinkClock::default());
        clock.pass(shared.clock.get());
        let save_slot = queue.and_then(|queue| queue.slot(sensor));
        SimPlatform { shared: shared.clone(), number, clock, save_slot, is_owed: Cell::default() }
    }

    /// Whoever sleeps for topics of `ring` will hear it.
    fn rouse(&self, ring: Ring) {
        let (now, Shared { planted, woken, log, .. }) = (self.clock.now(), &*self.shared);
        if !planted.strikes(Defect::LostWake, 200) {
            log.tell(now, &Event::Rung { sensor: self.number, ring });
            woken.borrow_mut().push((self.number, Bell::Ring(ring), now));
            if planted.strikes(Defect::NeedlessRing, 100) {
                log.tell(now, &Event::Rung { sensor: self.number, ring });
            }
        }
    }

    fn line(&self, device: u64) -> OpenLine {
        let (shared, port) = (self.shared.clone(), self.number);
        shared.handles.set(shared.handles.get() + 1);
        OpenLine { handle: Rc::new(Handle { shared, port, device }), clock: self.clock.clone() }
    }
}

impl Platform for SimPlatform<'_> {
    type Line = OpenLine;
    type Medium<P: Payload + ?Sized> = Carrier<P>;

    fn now(&self) -> Nanos {
        self.clock.now()
    }

    fn wall_ns(&self) -> u64 {
        self.clock.now() + self.shared.wall_ahead.get()
    }

    fn pause(&self, until: Nanos) {
        // A sleeping thread is late by about so much.
        self.clock.pass(until + 50 * MICROS);
    }

    fn take_name(&self) -> Result<(), Failure> {
        Ok(())
    }

    fn open(&self, _: &Source, baud: u32) -> Option<Result<OpenLine, PortError>> {
        if self.shared.lacks_descriptors.get() {
            return Some(Err(PortError::Short(Errno::MFILE)));
        }
        let mut tty = self.shared.ports[self.number].borrow_mut();
        let opened = tty.open(baud, &self.shared.log, self.clock.now());
        drop(tty);
        Some(opened.map(|device| {
            let line = self.line(device);
            if self.shared.planted.is(Defect::UnreleasedHandle) {
                std::mem::forget(line.handle.clone());
            }
            line
        }))
    }

    fn explain(&self, error: &PortError, source: &Source) -> Failure {
        let kind = match error {
            PortError::Missing | PortError::Dead => Kind::PortMissing,
            PortError::Denied => Kind::PortPermission,
            PortError::Busy => Kind::PortBusy,
            PortError::Short(_) => Kind::Short,
            _ => Kind::PortNotTty,
        };
        Failure::new(kind, format!("{}: {error}", source.name()), "")
    }

    fn altering_program(&self, _: &Source) -> Option<String> {
        None
    }

    fn take_kept(&self, name: &str, _: &Source, baud: u32) -> Option<OpenLine> {
        let handle = self.shared.kept.borrow().get(name).cloned()?;
        let mut tty = self.shared.ports[handle.port].borrow_mut();
        let is_same = tty.adopt(handle.device, baud, &self.shared.log, self.clock.now());
        drop(tty);
        if !is_same {
            self.release(name);
        }
        is_same.then(|| OpenLine { handle, clock: self.clock.clone() })
    }

    fn keep(&self, name: &str, line: &OpenLine) {
        if self.shared.keeps_ports {
            self.shared.kept.borrow_mut().insert(name.to_owned(), line.handle.clone());
        }
    }

    fn release(&self, name: &str) {
        // Not while it is borrowed: the port may be closed with it.
        let kept = self.shared.kept.borrow_mut().remove(name);
        drop(kept);
    }

    fn medium<P: Payload + ?Sized>(&self, _: &str) -> Result<Carrier<P>, Failure> {
        Ok(Carrier::new(&self.shared, &self.clock, self.number))
    }

    fn attached(&self) -> Option<u32> {
        let Shared { board, planted, .. } = &*self.shared;
        Some(if planted.is(Defect::UnseenSubscriber) { 0 } else { board.borrow().attached(self.number) })
    }

    fn has_listeners(&self) -> bool {
        self.shared.board.borrow().has_listeners(self.number)
    }

    fn ring(&self, ring: Ring) {
        if ring == Ring::First && self.shared.planted.is(Defect::OneRing) {
            self.is_owed.set(true);
        } else {
            self.rouse(ring);
        }
    }

    fn notify_event(&self, _: Wake) {
        let (now, Shared { planted, woken, log, .. }) = (self.clock.now(), &*self.shared);
        if !planted.strikes(Defect::UnsentEvent, 20) {
            log.tell(now, &Event::Notified { sensor: self.number });
            woken.borrow_mut().push((self.number, Bell::Event, now));
        }
        if self.is_owed.take() {
            self.rouse(Ring::First);
        }
    }

    fn load_record(&self, name: &str, record: &mut [u8]) -> Option<usize> {
        let records = self.shared.records.borrow();
        let known = records.get(name)?;
        let len = known.len().min(record.len());
        record[..len].copy_from_slice(&known[..len]);
        Some(len)
    }

    fn store_record(&self, name: &str, record: &[u8]) {
        let mut records = self.shared.records.borrow_mut();
        let kept = records.entry(name.to_owned()).or_default();
        kept.clear();
        kept.extend_from_slice(record);
    }

    fn saved_state(&self) -> Option<&dyn SavedState> {
        self.save_slot.as_ref().map(|slot| slot as &dyn SavedState)
    }
}
