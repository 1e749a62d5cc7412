//! The hub's end of a port: an implementation of [`scanhub_daemon::platform::Line`] for a simulated tty.

use std::cell::Cell;
use std::io;
use std::path::Path;
use std::rc::Rc;

use scanhub_daemon::platform::PortIo;
use scanhub_port::{ReadBudget, SettingsChange};
use scanhub_schema::Nanos;

use crate::event::Event;
use crate::injected_defects::{Defect, eeprom_request};
use crate::shared::SharedState;

/// The clock of one link. While the link's thread writes a request byte by byte, its clock may be ahead of the other
/// clocks.
#[derive(Default)]
pub(crate) struct LinkClock(Cell<Nanos>);

impl LinkClock {
    /// Returns the time. Each call takes [`CLOCK_READ_TIME`].
    pub(crate) fn now(&self) -> Nanos {
        self.0.set(self.0.get() + CLOCK_READ_TIME);
        self.0.get()
    }

    /// Returns the time without advancing it.
    pub(crate) fn peek(&self) -> Nanos {
        self.0.get()
    }

    /// Advances the clock to `time`. If the clock is already later than `time`, it does not change.
    pub(crate) fn advance_to(&self, time: Nanos) {
        self.0.set(self.0.get().max(time));
    }
}

/// Time that a read of the clock takes.
const CLOCK_READ_TIME: Nanos = 40;

/// An open descriptor of a port. The port is closed when the last descriptor is dropped.
pub(crate) struct Handle {
    pub(crate) shared: Rc<SharedState>,
    pub(crate) port: usize,
    pub(crate) device: u64,
}

impl Drop for Handle {
    fn drop(&mut self) {
        let SharedState { handles, ports, log, clock, .. } = &*self.shared;
        handles.set(handles.get() - 1);
        ports[self.port].borrow_mut().close(self.device, log, clock.get());
    }
}

/// An open line of a link.
pub(crate) struct OpenLine {
    pub(crate) handle: Rc<Handle>,
    pub(crate) clock: Rc<LinkClock>,
}

impl OpenLine {
    /// Returns whether the device is connected.
    ///
    /// # Errors
    ///
    /// Returns the same error as the kernel if the device is not connected.
    fn check(&self, is_connected: bool) -> io::Result<bool> {
        let is_hang_up_reported = !self.handle.shared.defect.is_active(Defect::SwallowedHangUp);
        if is_connected || !is_hang_up_reported {
            Ok(is_connected)
        } else {
            Err(io::Error::new(io::ErrorKind::UnexpectedEof, "the line hung up"))
        }
    }
}

impl PortIo for OpenLine {
    fn read(&self, buffer: &mut [u8]) -> io::Result<usize> {
        let Handle { shared, port, device } = &*self.handle;
        let (mut tty, now) = (shared.ports[*port].borrow_mut(), self.clock.now());
        tty.advance(now, &shared.log);
        let defect = &shared.defect;
        if !self.check(tty.is_plugged_in(*device))? {
            return Ok(0);
        }
        let len = tty.read(buffer, &shared.log, now);
        if len > 0 && defect.triggers(Defect::FlippedBit, 100) {
            buffer[len / 2] ^= 4;
        }
        if defect.triggers(Defect::EepromWrite, 500) {
            eeprom_request().into_iter().for_each(|byte| tty.write(byte, now));
        }
        if defect.triggers(Defect::NeedlessByte, 100) {
            tty.write(0, now);
            shared.log.record(now, &Event::Written { sensor: *port });
        }
        Ok(if len > 1 && defect.triggers(Defect::LostByte, 100) { len - 1 } else { len })
    }

    fn write(&self, bytes: &[u8]) -> io::Result<()> {
        let Handle { shared, port, device } = &*self.handle;
        let (mut tty, now) = (shared.ports[*port].borrow_mut(), self.clock.now());
        tty.advance(now, &shared.log);
        let is_deaf = shared.defect.is_active(Defect::IgnoredRequests) && tty.sensor.is_streaming();
        // Without its command byte, a request is incomplete and has no effect.
        let cuts = shared.defect.is_active(Defect::UnstartedMotor);
        let is_cut = |byte: &&u8| cuts && matches!(byte, 0xF0 | 0xA8);
        if self.check(tty.is_plugged_in(*device))? && !is_deaf {
            bytes.iter().filter(|byte| !is_cut(byte)).for_each(|byte| tty.write(*byte, now));
            shared.log.record(now, &Event::Written { sensor: *port });
        }
        Ok(())
    }

    fn set_baud(&self, baud: u32) -> io::Result<Option<io::Error>> {
        let Handle { shared, port, device } = &*self.handle;
        let (mut tty, now) = (shared.ports[*port].borrow_mut(), self.clock.now());
        tty.advance(now, &shared.log);
        if !self.check(tty.is_plugged_in(*device))? {
            return Ok(None);
        }
        if !tty.supports_rate(baud) {
            return Ok(Some(io::Error::other(format!("{baud} Bd is not possible here"))));
        }
        tty.set_rate(baud, &shared.log, now);
        Ok(None)
    }

    fn alteration(&self) -> io::Result<Option<SettingsChange>> {
        let Handle { shared, port, device } = &*self.handle;
        let tty = shared.ports[*port].borrow();
        let is_rate_reported =
            self.check(tty.is_plugged_in(*device))? && !shared.defect.is_active(Defect::HiddenRate);
        Ok(tty.altered_rate().filter(|_| is_rate_reported).map(SettingsChange::Rate))
    }

    fn restore(&self, baud: u32) -> io::Result<()> {
        self.set_baud(baud).map(drop)
    }

    fn set_dtr(&self, _: bool) -> io::Result<()> {
        Ok(())
    }

    fn buffered_len(&self) -> Option<usize> {
        let Handle { shared, port, device } = &*self.handle;
        let mut tty = shared.ports[*port].borrow_mut();
        tty.advance(self.clock.now(), &shared.log);
        tty.is_plugged_in(*device).then(|| tty.waiting())
    }

    fn read_budget(&self, _: u32) -> Option<ReadBudget> {
        None
    }

    fn line_errors(&self) -> u64 {
        0
    }

    fn device(&self) -> Option<&Path> {
        None
    }

    fn is_simulated(&self) -> bool {
        false
    }
}
