//! The platform of one link in a world: an implementation of [`scanhub_daemon::platform::Platform`] with simulated
//! ports, topics and files.

use std::cell::Cell;
use std::rc::Rc;
use std::sync::Arc;

use rustix::io::Errno;
use scanhub_daemon::SaveQueue;
use scanhub_daemon::platform::{Platform, SavedState};
use scanhub_port::{PortError, PortSpec};
use scanhub_schema::{DoorbellWord, Failure, Kind, MICROS, Nanos, WakeEvent};
use scanhub_shm::Payload;

use crate::event::Event;
use crate::injected_defects::Defect;
use crate::line::{Handle, LinkClock, OpenLine};
use crate::shared::SharedState;
use crate::subscriber::WakeSource;
use crate::topics::SimTransport;

/// Platform of the link with index `number`. The link's sensor has the same index.
pub(crate) struct SimPlatform<'a> {
    pub(crate) shared: Rc<SharedState>,
    pub(crate) number: usize,
    pub(crate) clock: Rc<LinkClock>,
    pub(crate) save_slot: Option<scanhub_daemon::SaveSlot<'a>>,
    /// Whether an injected defect currently delays the first ring of the doorbell for a scan.
    is_ring_delayed: Cell<bool>,
}

impl<'a> SimPlatform<'a> {
    /// Creates the platform for a hub that starts at the current time of the world.
    pub(crate) fn new(
        shared: &Rc<SharedState>,
        number: usize,
        sensor: &str,
        queue: Option<&'a Arc<SaveQueue>>,
    ) -> Self {
        let clock = Rc::new(LinkClock::default());
        clock.advance_to(shared.clock.get());
        let save_slot = queue.and_then(|queue| queue.slot(sensor));
        SimPlatform { shared: shared.clone(), number, clock, save_slot, is_ring_delayed: Cell::default() }
    }

    /// Rings the doorbell word `ring`, which wakes the subscribers that sleep on it.
    fn wake_subscribers(&self, ring: DoorbellWord) {
        let (now, SharedState { defect, wakeups: woken, log, .. }) = (self.clock.now(), &*self.shared);
        if !defect.triggers(Defect::LostWake, 200) {
            log.record(now, &Event::Rung { sensor: self.number, ring });
            woken.borrow_mut().push((self.number, WakeSource::Ring(ring), now));
            if defect.triggers(Defect::NeedlessRing, 100) {
                log.record(now, &Event::Rung { sensor: self.number, ring });
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
    type Port = OpenLine;
    type Transport<P: Payload + ?Sized> = SimTransport<P>;

    fn now(&self) -> Nanos {
        self.clock.now()
    }

    fn wall_ns(&self) -> u64 {
        self.clock.now() + self.shared.wall_offset.get()
    }

    fn pause(&self, until: Nanos) {
        // A sleeping thread typically wakes 50 us late.
        self.clock.advance_to(until + 50 * MICROS);
    }

    fn take_name(&self) -> Result<(), Failure> {
        Ok(())
    }

    fn open(&self, _: &PortSpec, baud: u32) -> Option<Result<OpenLine, PortError>> {
        if self.shared.lacks_descriptors.get() {
            return Some(Err(PortError::ResourceExhausted(Errno::MFILE)));
        }
        let mut tty = self.shared.ports[self.number].borrow_mut();
        let opened = tty.open(baud, &self.shared.log, self.clock.now());
        drop(tty);
        Some(opened.map(|device| {
            let line = self.line(device);
            if self.shared.defect.is_active(Defect::UnreleasedHandle) {
                std::mem::forget(line.handle.clone());
            }
            line
        }))
    }

    fn explain(&self, error: &PortError, source: &PortSpec) -> Failure {
        let kind = match error {
            PortError::Missing | PortError::NoDevice => Kind::PortMissing,
            PortError::PermissionDenied => Kind::PortPermission,
            PortError::Busy => Kind::PortBusy,
            PortError::ResourceExhausted(_) => Kind::ResourceExhausted,
            _ => Kind::PortNotTty,
        };
        Failure::new(kind, format!("{}: {error}", source.name()), "")
    }

    fn altering_program(&self, _: &PortSpec) -> Option<String> {
        None
    }

    fn take_kept_port(&self, name: &str, _: &PortSpec, baud: u32) -> Option<OpenLine> {
        let handle = self.shared.stored_lines.borrow().get(name).cloned()?;
        let mut tty = self.shared.ports[handle.port].borrow_mut();
        let is_same = tty.adopt(handle.device, baud, &self.shared.log, self.clock.now());
        drop(tty);
        if !is_same {
            self.release(name);
        }
        is_same.then(|| OpenLine { handle, clock: self.clock.clone() })
    }

    fn keep_open(&self, name: &str, line: &OpenLine) {
        if self.shared.keeps_ports {
            self.shared.stored_lines.borrow_mut().insert(name.to_owned(), line.handle.clone());
        }
    }

    fn release(&self, name: &str) {
        // The borrow must end before the line is dropped, because the drop may close the port.
        let kept = self.shared.stored_lines.borrow_mut().remove(name);
        drop(kept);
    }

    fn transport<P: Payload + ?Sized>(&self, _: &str) -> Result<SimTransport<P>, Failure> {
        Ok(SimTransport::new(&self.shared, &self.clock, self.number))
    }

    fn attach_count(&self) -> Option<u32> {
        let SharedState { topics: board, defect, .. } = &*self.shared;
        Some(if defect.is_active(Defect::UnnoticedSubscriber) {
            0
        } else {
            board.borrow().attached(self.number)
        })
    }

    fn has_listeners(&self) -> bool {
        self.shared.topics.borrow().has_listeners(self.number)
    }

    fn ring(&self, ring: DoorbellWord) {
        if ring == DoorbellWord::First && self.shared.defect.is_active(Defect::OneRing) {
            self.is_ring_delayed.set(true);
        } else {
            self.wake_subscribers(ring);
        }
    }

    fn notify_event(&self, _: WakeEvent) {
        let (now, SharedState { defect, wakeups: woken, log, .. }) = (self.clock.now(), &*self.shared);
        if !defect.triggers(Defect::UnsentEvent, 20) {
            log.record(now, &Event::Notified { sensor: self.number });
            woken.borrow_mut().push((self.number, WakeSource::Event, now));
        }
        if self.is_ring_delayed.take() {
            self.wake_subscribers(DoorbellWord::First);
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
