//! What a gateway makes of the samples of a hub's sensors: whole datagrams, with announcements, thinned and numbered. A
//! sample goes in with the time, datagrams come out at once. Refuses to know sockets and clocks.

mod numbering;
mod sample;
mod sensor;
mod slots;

use std::num::NonZeroU64;
use std::time::Duration;

use scanhub_schema::Topic;

use crate::lan::Stamp;
use numbering::Numbering;
pub use numbering::{Form, Handed, Row, Rows, Transmit};
pub use sample::{PayloadRef, Sample};
use sensor::Sensor;

/// The outgoing end of one gateway in one of its lives.
pub struct Outgoing {
    numbering: Numbering,
    sensors: Vec<Sensor>,
}

/// Between two announcements of a sensor.
pub const ANNOUNCE_EVERY: Duration = Duration::from_secs(1);

impl Outgoing {
    /// Makes the end of gateway `hub` in its life `epoch`. Its datagrams have at most `longest` bytes, and never more than
    /// [`MTU_ETHERNET`](scanhub_schema::datagram::MTU_ETHERNET).
    pub fn new(hub: u64, epoch: u32, form: Form, longest: usize) -> Outgoing {
        Outgoing { numbering: Numbering::new(hub, epoch, form, longest), sensors: Vec::new() }
    }

    /// Makes the end of gateway `hub` in its life `epoch` for a way that is slow at times: of each sensor and topic the newest
    /// sample waits until [`hand`](Outgoing::hand) asks for it. Samples are whole, in one datagram however long.
    pub fn waiting(hub: u64, epoch: u32) -> Outgoing {
        Outgoing { numbering: Numbering::waiting(hub, epoch), sensors: Vec::new() }
    }

    /// Takes the sensor called `name`, of whose topics every so many samples go out; nothing: none do. Returns its position,
    /// by which it is named from now on.
    pub fn follow(&mut self, name: &str, every: impl Fn(Topic) -> Option<NonZeroU64>) -> usize {
        self.sensors.push(Sensor::new(name, every));
        self.sensors.len() - 1
    }

    /// Returns the position of the sensor called `name`, if it was taken.
    pub fn position(&self, name: &str) -> Option<usize> {
        self.sensors.iter().position(|sensor| sensor.name == name)
    }

    /// Returns whether samples of this topic are wanted: they go out, or an announcement says what they say.
    pub fn wants(&self, sensor: usize, topic: Topic) -> bool {
        let is_announced = self.numbering.announces();
        self.sensors[sensor].sends(topic) || is_announced && topic == Topic::Status
    }

    /// Takes a sample of the sensor at this position, or a silence of its zones, and hands what becomes of it to `to`: before
    /// the first sample of a life of the hub an announcement; no datagram if the sample is thinned away, if it is a background
    /// that went out, or if it came from another machine.
    pub fn sample(&mut self, sensor: usize, sample: &Sample<'_>, now: Stamp, to: &mut impl Transmit) {
        self.sensors[sensor].take(sample, now, &mut self.numbering, to);
    }

    /// Announces all sensors of which anything was heard. To be called each [`ANNOUNCE_EVERY`], and at the end.
    pub fn announce(&mut self, now: Stamp, to: &mut impl Transmit) {
        self.sensors.iter().for_each(|sensor| sensor.announce(now, &mut self.numbering, to));
    }

    /// Sends all backgrounds again that went out longer than `every` ago.
    pub fn repeat(&mut self, every: Duration, now: Stamp, to: &mut impl Transmit) {
        self.sensors.iter_mut().for_each(|sensor| sensor.repeat(every, now, &mut self.numbering, to));
    }

    /// Returns the sample that has waited for longest, with its number, as it is sent `now`; nothing if none waits.
    pub fn hand(&mut self, now: Stamp) -> Option<Handed<'_>> {
        self.numbering.hand(now)
    }

    /// Returns whether a sample waits.
    pub fn is_waiting(&self) -> bool {
        self.numbering.is_waiting()
    }

    /// Takes note that the last sample which [`hand`](Outgoing::hand) returned of this sensor and topic, of so many `bytes`,
    /// went nowhere: its number is used up.
    pub fn not_taken(&mut self, sensor: u8, topic: Option<Topic>, bytes: usize) {
        self.numbering.not_taken(sensor, topic, bytes);
    }

    /// Returns the announcement (no topic), the status or the background of the sensor called `name` that was handed on last,
    /// as it is sent again `now` to who asks: with the number that it has, so that it is counted once.
    pub fn again(&mut self, name: &str, topic: Option<Topic>, now: Stamp) -> Option<&[u8]> {
        self.numbering.again(name, topic, now)
    }

    /// Returns the sensors and topics (`None`: announcements) for which [`again`](Outgoing::again) has a sample. The
    /// announcement of a sensor comes before its samples.
    pub fn kept(&self) -> impl Iterator<Item = (&str, Option<Topic>)> {
        self.numbering.kept()
    }

    /// Drops the samples that [`again`](Outgoing::again) returns.
    pub fn forget_kept(&mut self) {
        self.numbering.forget_kept();
    }

    /// Returns whether samples wait, so that newer ones may replace them: then announcements say how many were.
    pub fn tells_replaced(&self) -> bool {
        self.numbering.tells_replaced()
    }

    /// Returns the longest datagram that goes out, in bytes.
    pub fn longest(&self) -> usize {
        self.numbering.longest()
    }

    /// Returns the account, by the sensors' numbers in the hub.
    pub fn account(&self) -> impl Iterator<Item = &Rows> {
        self.numbering.sensors()
    }

    /// Returns the number of samples that did not fit into as many datagrams as one may have.
    pub fn unfit(&self) -> u64 {
        self.numbering.unfit()
    }

    /// Returns `SENSOR/TOPIC` of which something did not fit into a datagram; each is told once.
    pub fn misfit(&mut self) -> Option<String> {
        self.numbering.misfit()
    }
}

#[cfg(test)]
mod tests;
