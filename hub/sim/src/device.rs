//! What is at the sensor's end of a line, as the line sees it: chunks of bytes with the time at which they are through go
//! out, the host's bytes come in. Knows no family.
//!
//! To drive one, call [`Device::poll_transmit`] until it returns `None`, pass the host's bytes, and call again at
//! [`Device::poll_timeout`].

use schema::Nanos;

use crate::request_decoder::{Arrival, Dropped};

/// A simulated sensor.
pub trait Device {
    /// The next bytes that are through at `now`.
    fn poll_transmit(&mut self, now: Nanos) -> Option<Chunk>;

    /// When there will be something to transmit.
    fn poll_timeout(&self) -> Option<Nanos>;

    /// Hears a byte of the host. Call it after [`Device::poll_transmit`] answered `None` for `arrival.not_after`.
    fn receive(&mut self, byte: u8, arrival: Arrival);

    /// The power goes off and on. Returns whether a telegram was broken off.
    fn power_cycle(&mut self, now: Nanos) -> bool;

    /// The voltage dips at `now`, and the sensor restarts by itself. Returns whether a telegram was broken off.
    fn brown_out(&mut self, now: Nanos) -> bool {
        self.power_cycle(now)
    }

    /// Breaks off what it is sending; a stream continues with a whole telegram.
    fn break_off(&mut self, now: Nanos);

    /// The rate at which it speaks and hears now, in bits per second.
    fn rate(&self) -> u32;

    /// Whether it sends unasked now.
    fn streams(&self) -> bool;

    /// Bytes of each of its telegrams, if they all have as many; else they say it themselves.
    fn telegram_len(&self) -> Option<usize>;

    /// The last request that it dropped because of its gaps; returned once.
    fn take_dropped(&mut self) -> Option<Dropped>;

    /// Requests heard that would change what it keeps without power, done or refused.
    fn eeprom_writes(&self) -> u64;
}

/// Bytes that the host's hardware hands over at once.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Chunk {
    /// Up to 62 bytes; none at the end of a telegram that was broken off between two bursts.
    pub bytes: Vec<u8>,
    /// The rate they were sent at, in bits per second.
    pub rate: u32,
    /// Whether the line is idle after them.
    pub idle_after: bool,
    /// What they are part of.
    pub part: Part,
}

/// The position of a chunk in its telegram.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Part {
    /// A single ACK or NAK.
    Acknowledge,
    /// Bytes of a telegram, not its last ones.
    Telegram,
    /// The last bytes of a telegram that leave.
    End(Sent),
}

/// A telegram that has left.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Sent {
    /// Measured values of the stream, or a reply.
    pub is_reply: bool,
    /// The telegram as it should have been.
    pub telegram: Vec<u8>,
    /// Whether it was broken off, by a request or by the power.
    pub aborted: bool,
}
