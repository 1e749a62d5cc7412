//! A serial port with the properties of a Linux tty: a buffer, a baud rate, and one owner. The port can be unplugged,
//! and is another device after it is plugged in again. The port logs everything that happens to bytes.

use std::collections::VecDeque;

use scanhub_port::PortError;
use scanhub_schema::Nanos;
use scanhub_sim::device::{ChunkKind, SentTelegram};
use scanhub_sim::line_model::BaudMismatch;
use scanhub_sim::line_model::Delivery;

use crate::event::{Event, Telegram};
use crate::sensor::{Sensor, SensorEvent};
use crate::shared::EventLog;

/// A port together with the sensor at its line.
pub(crate) struct Tty {
    number: usize,
    pub(crate) sensor: Sensor,
    /// ID of the device that is plugged in, if any.
    device: Option<u64>,
    /// Number of devices that have been plugged in so far.
    devices: u64,
    /// Whether the device has another name than the configured one.
    has_other_name: bool,
    /// Rates that the port does not support.
    unsupported_rates: Vec<u32>,
    /// Error that opening the port returns although the port exists.
    pub(crate) open_error: Option<PortError>,
    is_open: bool,
    rate: u32,
    /// Rate that the hub has set. It differs from `rate` if another process has changed the port's rate.
    hub_rate: u32,
    baud_mismatch: BaudMismatch,
    buffer: VecDeque<u8>,
    /// Number of bytes that have ever entered the buffer.
    received: u64,
    /// Telegram that is on the line.
    partial_telegram: Option<PartialTelegram>,
}

/// Telegram that is on the line.
struct PartialTelegram {
    /// Position of the telegram's first byte; and time at which that byte entered the buffer.
    first: u64,
    first_at: Nanos,
    /// Reason why the telegram is damaged, or `None`.
    damage: Option<&'static str>,
}

/// Maximum number of bytes that a tty buffers, as in a pty of Linux. Further bytes are lost.
const BUFFER_LEN: usize = 17_024;
/// Maximum number of buffered bytes in the line discipline. A single read returns only these bytes, and the tty reports
/// only these bytes as readable. The other bytes are in the driver's buffers.
const LINE_DISCIPLINE_LEN: usize = 4_095;

impl Tty {
    /// Creates the port of a sensor, which does not support the rates in `unsupported_rates`.
    pub(crate) fn new(number: usize, sensor: Sensor, unsupported_rates: Vec<u32>) -> Tty {
        Tty {
            number,
            sensor,
            device: Some(0),
            devices: 1,
            has_other_name: false,
            unsupported_rates,
            open_error: None,
            is_open: false,
            rate: 9_600,
            hub_rate: 9_600,
            baud_mismatch: BaudMismatch::default(),
            buffer: VecDeque::with_capacity(BUFFER_LEN),
            received: 0,
            partial_telegram: None,
        }
    }

    /// Advances the sensor's time to `to`.
    pub(crate) fn advance(&mut self, to: Nanos, log: &EventLog) {
        // Borrow the fields separately, because the sensor adds bytes to the buffer.
        let Tty {
            number,
            sensor,
            device,
            is_open,
            rate,
            baud_mismatch,
            buffer,
            received,
            partial_telegram,
            ..
        } = self;
        sensor.advance(to, |at, happening| {
            let carried = match happening {
                SensorEvent::Arrived(carried) => carried,
                SensorEvent::Measured(points) => {
                    return log.record(at, &Event::Measured { sensor: *number, points: &points });
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
                bytes = baud_mismatch.receive((sent_at, *rate), &bytes, idle_after);
            } else {
                baud_mismatch.reset();
            }
            if bytes.len() > BUFFER_LEN - buffer.len() {
                damage = damage.or(Some("overrun"));
                bytes.truncate(BUFFER_LEN - buffer.len());
            }
            if matches!(part, Some(ChunkKind::Telegram | ChunkKind::End(_))) {
                partial_telegram.get_or_insert(PartialTelegram {
                    first: *received,
                    first_at: at,
                    damage: None,
                });
            }
            if let Some(partial_telegram) = partial_telegram {
                partial_telegram.damage = partial_telegram.damage.or(damage);
            }
            *received += bytes.len() as u64;
            buffer.extend(bytes);
            if let Some(ChunkKind::End(SentTelegram { telegram, aborted, is_reply })) = part
                && let Some(PartialTelegram { first, first_at, damage }) = partial_telegram.take()
            {
                let span = (first, *received);
                let telegram =
                    Telegram { bytes: &telegram, span, first_at, rate: sent_at, damage, aborted, is_reply };
                log.record(at, &Event::Sent { sensor: *number, telegram: &telegram });
            }
        });
    }

    /// Opens the port at `rate`. Returns the ID of its device.
    ///
    /// # Errors
    ///
    /// Returns the error of the port if it is missing, denied or already open, or does not support `rate`.
    pub(crate) fn open(&mut self, rate: u32, log: &EventLog, now: Nanos) -> Result<u64, PortError> {
        self.advance(now, log);
        let device = self.device.filter(|_| !self.has_other_name).ok_or(PortError::Missing)?;
        if let Some(error) = &self.open_error {
            return Err(error.clone());
        }
        if self.is_open {
            return Err(PortError::Busy);
        }
        if !self.supports_rate(rate) {
            return Err(PortError::Rate { requested: rate, actual: 9_600 });
        }
        self.is_open = true;
        (self.rate, self.hub_rate) = (rate, rate);
        log.record(now, &Event::PortOpened { sensor: self.number, offset: self.removed() });
        Ok(device)
    }

    /// Takes over the open port for another hub, at `rate`. Returns false if `device` is no longer plugged in.
    pub(crate) fn adopt(&mut self, device: u64, rate: u32, log: &EventLog, now: Nanos) -> bool {
        self.advance(now, log);
        if !self.is_plugged_in(device) || self.has_other_name || !self.supports_rate(rate) {
            return false;
        }
        (self.rate, self.hub_rate) = (rate, rate);
        log.record(now, &Event::PortOpened { sensor: self.number, offset: self.removed() });
        true
    }

    /// Closes `device` after its last owner has released it.
    pub(crate) fn close(&mut self, device: u64, log: &EventLog, now: Nanos) {
        if self.is_plugged_in(device) {
            self.advance(now, log);
            self.flush(log, now);
            self.is_open = false;
            log.record(now, &Event::PortClosed { sensor: self.number });
        }
    }

    /// Returns whether `device` is plugged in.
    pub(crate) fn is_plugged_in(&self, device: u64) -> bool {
        self.device == Some(device)
    }

    /// Returns the number of bytes that the tty reports as readable. These are the bytes in the line discipline.
    pub(crate) fn waiting(&self) -> usize {
        self.buffer.len().min(LINE_DISCIPLINE_LEN)
    }

    /// Reads buffered bytes into `into`, but no more than those in the line discipline. Returns the number of bytes
    /// read.
    pub(crate) fn read(&mut self, into: &mut [u8], log: &EventLog, now: Nanos) -> usize {
        let len = into.len().min(self.waiting());
        for (place, byte) in into.iter_mut().zip(self.buffer.drain(..len)) {
            *place = byte;
        }
        if len > 0 {
            log.record(now, &Event::Read { sensor: self.number, len, to: self.removed() });
        }
        len
    }

    pub(crate) fn write(&mut self, byte: u8, now: Nanos) {
        self.sensor.write(now, byte, self.rate);
    }

    /// Returns whether the port supports this rate.
    pub(crate) fn supports_rate(&self, rate: u32) -> bool {
        !self.unsupported_rates.contains(&rate)
    }

    /// Changes the rate, and discards all buffered bytes.
    pub(crate) fn set_rate(&mut self, rate: u32, log: &EventLog, now: Nanos) {
        self.flush(log, now);
        (self.rate, self.hub_rate) = (rate, rate);
        log.record(now, &Event::RateChanged { sensor: self.number });
    }

    /// Sets the rate on behalf of another process.
    pub(crate) fn alter(&mut self, rate: u32, log: &EventLog, now: Nanos) {
        self.advance(now, log);
        if self.is_open && rate != self.rate {
            self.rate = rate;
            log.record(now, &Event::RateAltered { sensor: self.number });
        }
    }

    /// Returns the rate that another process has set since the hub set its own rate, or `None`.
    pub(crate) fn altered_rate(&self) -> Option<u32> {
        (self.rate != self.hub_rate).then_some(self.rate)
    }

    /// Unplugs the adapter.
    pub(crate) fn unplug(&mut self, log: &EventLog, now: Nanos) {
        self.advance(now, log);
        if self.device.take().is_some() {
            self.flush(log, now);
            self.sensor.drop_outgoing();
            if std::mem::take(&mut self.is_open) {
                log.record(now, &Event::PortClosed { sensor: self.number });
            }
        }
    }

    /// Plugs the adapter in again as another device, perhaps with another name.
    pub(crate) fn plug(&mut self, has_other_name: bool, log: &EventLog, now: Nanos) {
        self.advance(now, log);
        self.has_other_name = has_other_name;
        if self.device.is_none() {
            self.device = Some(self.devices);
            self.devices += 1;
        }
    }

    fn flush(&mut self, log: &EventLog, now: Nanos) {
        let from = self.removed();
        self.buffer.clear();
        if from < self.received {
            if let Some(partial_telegram) = &mut self.partial_telegram {
                partial_telegram.damage = partial_telegram.damage.or(Some("flushed"));
            }
            log.record(now, &Event::Flushed { sensor: self.number, from, to: self.received });
        }
    }

    /// Returns the number of bytes that have left the buffer.
    fn removed(&self) -> u64 {
        self.received - self.buffer.len() as u64
    }
}
