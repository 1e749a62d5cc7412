//! A serial port as the kernel has it: a buffer of 4,095 bytes, a rate, one owner; it can be pulled out and come back
//! as another device. Says everything that happens to bytes. Refuses to know who reads them.

use std::collections::VecDeque;

use scanhub_port::PortError;
use scanhub_schema::Nanos;
use scanhub_sim::device::{Part, Sent};
use scanhub_sim::wire::BaudMismatch;
use scanhub_sim::wire::Delivery;

use crate::event::{Event, Telegram};
use crate::sensor::{Happening, Sensor};
use crate::shared::Log;

/// A port and the sensor at its line.
pub(crate) struct Tty {
    number: usize,
    pub(crate) sensor: Sensor,
    /// The number of the device that is plugged in, if one is.
    device: Option<u64>,
    /// Devices that were there until now.
    devices: u64,
    /// The device has another name than the one that is configured.
    is_elsewhere: bool,
    /// Rates that it cannot have.
    impossible: Vec<u32>,
    /// Why it cannot be opened although it is there.
    pub(crate) refuses: Option<PortError>,
    is_open: bool,
    rate: u32,
    /// Rate that the hub has set; another process may have set another one.
    own_rate: u32,
    mistuned: BaudMismatch,
    buffer: VecDeque<u8>,
    /// Bytes that went into the buffer, ever.
    put: u64,
    /// Telegram that is on the line.
    begun: Option<Begun>,
}

/// Telegram that is on the line.
struct Begun {
    /// Place of its first byte, and when that went into the port.
    first: u64,
    first_at: Nanos,
    /// Why it is damaged.
    damage: Option<&'static str>,
}

/// Bytes that a tty holds, as a pty of Linux does; more are lost.
const ROOM: usize = 17_024;
/// Those of them of which it tells, and that it hands out at once; the rest waits in the driver's buffers.
const LINE_DISCIPLINE: usize = 4_095;

impl Tty {
    /// Creates the port of a sensor. It cannot have the rates in `impossible`.
    pub(crate) fn new(number: usize, sensor: Sensor, impossible: Vec<u32>) -> Tty {
        Tty {
            number,
            sensor,
            device: Some(0),
            devices: 1,
            is_elsewhere: false,
            impossible,
            refuses: None,
            is_open: false,
            rate: 9_600,
            own_rate: 9_600,
            mistuned: BaudMismatch::default(),
            buffer: VecDeque::with_capacity(ROOM),
            put: 0,
            begun: None,
        }
    }

    /// Lets the sensor's time be `to`.
    pub(crate) fn advance(&mut self, to: Nanos, log: &Log) {
        // The sensor is lent out, so that what arrives can go into the buffer.
        let Tty { number, sensor, device, is_open, rate, mistuned, buffer, put, begun, .. } = self;
        sensor.advance(to, |at, happening| {
            let carried = match happening {
                Happening::Arrived(carried) => carried,
                Happening::Measured(points) => {
                    return log.tell(at, &Event::Measured { sensor: *number, points: &points });
                }
            };
            let Delivery { bytes, rate: sent_at, idle_after, part, fault } = carried;
            let mut damage = fault.map(|fault| fault.name());
            let mut bytes = bytes;
            if device.is_none() || !*is_open {
                damage = damage.or(Some("unread"));
                bytes.clear();
            } else if sent_at != *rate {
                damage = damage.or(Some("baud"));
                bytes = mistuned.receive((sent_at, *rate), &bytes, idle_after);
            } else {
                mistuned.reset();
            }
            if bytes.len() > ROOM - buffer.len() {
                damage = damage.or(Some("overrun"));
                bytes.truncate(ROOM - buffer.len());
            }
            if matches!(part, Some(Part::Telegram | Part::End(_))) {
                begun.get_or_insert(Begun { first: *put, first_at: at, damage: None });
            }
            if let Some(begun) = begun {
                begun.damage = begun.damage.or(damage);
            }
            *put += bytes.len() as u64;
            buffer.extend(bytes);
            if let Some(Part::End(Sent { telegram, aborted, is_reply })) = part
                && let Some(Begun { first, first_at, damage }) = begun.take()
            {
                let span = (first, *put);
                let telegram =
                    Telegram { bytes: &telegram, span, first_at, rate: sent_at, damage, aborted, is_reply };
                log.tell(at, &Event::Sent { sensor: *number, telegram: &telegram });
            }
        });
    }

    /// Opens it at `rate`; returns the number of its device.
    pub(crate) fn open(&mut self, rate: u32, log: &Log, now: Nanos) -> Result<u64, PortError> {
        self.advance(now, log);
        let device = self.device.filter(|_| !self.is_elsewhere).ok_or(PortError::Missing)?;
        if let Some(error) = &self.refuses {
            return Err(error.clone());
        }
        if self.is_open {
            return Err(PortError::Busy);
        }
        if !self.can_have(rate) {
            return Err(PortError::Rate { wanted: rate, given: 9_600 });
        }
        self.is_open = true;
        (self.rate, self.own_rate) = (rate, rate);
        log.tell(now, &Event::Opened { sensor: self.number, offset: self.taken() });
        Ok(device)
    }

    /// Another hub goes on with it, at `rate`; whether it is still the same.
    pub(crate) fn adopt(&mut self, device: u64, rate: u32, log: &Log, now: Nanos) -> bool {
        self.advance(now, log);
        if !self.is_there(device) || self.is_elsewhere || !self.can_have(rate) {
            return false;
        }
        (self.rate, self.own_rate) = (rate, rate);
        log.tell(now, &Event::Opened { sensor: self.number, offset: self.taken() });
        true
    }

    /// The last owner of `device` is gone.
    pub(crate) fn close(&mut self, device: u64, log: &Log, now: Nanos) {
        if self.is_there(device) {
            self.advance(now, log);
            self.flush(log, now);
            self.is_open = false;
            log.tell(now, &Event::Closed { sensor: self.number });
        }
    }

    /// Whether `device` is plugged in.
    pub(crate) fn is_there(&self, device: u64) -> bool {
        self.device == Some(device)
    }

    /// Bytes that wait to be read, as far as a driver tells: those of its line discipline.
    pub(crate) fn waiting(&self) -> usize {
        self.buffer.len().min(LINE_DISCIPLINE)
    }

    /// Reads what there is into `into`, at most what the line discipline holds.
    pub(crate) fn read(&mut self, into: &mut [u8], log: &Log, now: Nanos) -> usize {
        let len = into.len().min(self.waiting());
        for (place, byte) in into.iter_mut().zip(self.buffer.drain(..len)) {
            *place = byte;
        }
        if len > 0 {
            log.tell(now, &Event::Read { sensor: self.number, len, to: self.taken() });
        }
        len
    }

    pub(crate) fn write(&mut self, byte: u8, now: Nanos) {
        self.sensor.write(now, byte, self.rate);
    }

    /// Returns whether the port can have this rate.
    pub(crate) fn can_have(&self, rate: u32) -> bool {
        !self.impossible.contains(&rate)
    }

    /// Changes the rate, and discards what arrived.
    pub(crate) fn set_rate(&mut self, rate: u32, log: &Log, now: Nanos) {
        self.flush(log, now);
        (self.rate, self.own_rate) = (rate, rate);
        log.tell(now, &Event::Retuned { sensor: self.number });
    }

    /// Sets the rate as another process does.
    pub(crate) fn alter(&mut self, rate: u32, log: &Log, now: Nanos) {
        self.advance(now, log);
        if self.is_open && rate != self.rate {
            self.rate = rate;
            log.tell(now, &Event::Altered { sensor: self.number });
        }
    }

    /// Returns the rate that another process has set since the hub did.
    pub(crate) fn altered(&self) -> Option<u32> {
        (self.rate != self.own_rate).then_some(self.rate)
    }

    /// The adapter is pulled out.
    pub(crate) fn unplug(&mut self, log: &Log, now: Nanos) {
        self.advance(now, log);
        if self.device.take().is_some() {
            self.flush(log, now);
            self.sensor.cut();
            if std::mem::take(&mut self.is_open) {
                log.tell(now, &Event::Closed { sensor: self.number });
            }
        }
    }

    /// It is plugged in again, as another device, which may have another name.
    pub(crate) fn plug(&mut self, is_elsewhere: bool, log: &Log, now: Nanos) {
        self.advance(now, log);
        self.is_elsewhere = is_elsewhere;
        if self.device.is_none() {
            self.device = Some(self.devices);
            self.devices += 1;
        }
    }

    fn flush(&mut self, log: &Log, now: Nanos) {
        let from = self.taken();
        self.buffer.clear();
        if from < self.put {
            if let Some(begun) = &mut self.begun {
                begun.damage = begun.damage.or(Some("flushed"));
            }
            log.tell(now, &Event::Flushed { sensor: self.number, from, to: self.put });
        }
    }

    /// Bytes that are not in the buffer any more.
    fn taken(&self) -> u64 {
        self.put - self.buffer.len() as u64
    }
}
