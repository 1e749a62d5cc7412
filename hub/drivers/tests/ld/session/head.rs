//! A head that turns evenly, and the line behind it with its damage: each point's range says which one it is.

use std::collections::VecDeque;

use scanhub_drivers::ld::Model;
use scanhub_drivers::ld::packet::{CLOCK_TURN, Contents, LEN, POINTS, TURN};
use scanhub_schema::{MILLIS, Nanos, line_time};

/// What goes wrong with bytes; shares of all bytes.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Damage {
    /// Begins of bursts that are lost, four bytes long on the mean.
    pub(crate) lost: f64,
    /// Bytes before which a foreign one comes.
    pub(crate) inserted: f64,
    /// Bytes with bits that are turned over.
    pub(crate) flipped: f64,
}

/// A packet as it was sent.
pub(crate) struct Sent {
    pub(crate) bytes: [u8; LEN],
    pub(crate) intact: bool,
    /// When its last byte was through, if all of them were.
    pub(crate) at: Nanos,
}

pub(crate) struct Head {
    pub(crate) model: Model,
    /// Points in a turn.
    pub(crate) points: f64,
    /// By how much its clock is slow.
    pub(crate) drift: f64,
    /// Share by which the speed in every other packet differs from the true one.
    pub(crate) jitter: f64,
    damage: Damage,
    random: fastrand::Rng,
    burst: bool,
    /// Bytes on their way, with the time at which they arrive.
    line: VecDeque<(Nanos, u8)>,
    pub(crate) sent: Vec<Sent>,
    /// When it was switched on, and how many packets it has sent since.
    pub(crate) zero: Nanos,
    packets: u64,
}

impl Head {
    pub(crate) fn new(model: Model, points: f64, seed: u64, damage: Damage) -> Head {
        Head {
            model,
            points,
            drift: 0.0,
            jitter: 0.0,
            damage,
            random: fastrand::Rng::with_seed(seed),
            burst: false,
            line: VecDeque::new(),
            sent: Vec::new(),
            zero: 1_000 * MILLIS,
            packets: 0,
        }
    }

    /// When point number `point` is measured, by the hub's clock.
    pub(crate) fn time(&self, point: u64) -> Nanos {
        let sensor_s = point as f64 / f64::from(self.model.points_per_second());
        self.zero + (sensor_s / (1.0 - self.drift) * 1e9) as Nanos
    }

    /// Where point number `point` is, in hundredths of a degree, over all turns.
    pub(crate) fn angle(&self, point: u64) -> f64 {
        point as f64 * f64::from(TURN) / self.points
    }

    /// The range of point number `point`: by which it is known again.
    pub(crate) fn range(point: u64) -> u16 {
        100 + (point % 20_011) as u16
    }

    /// The point of this range that is the nearest to number `about`.
    pub(crate) fn point_of(range: u16, about: u64) -> u64 {
        let off = (u64::from(range) + 20_011 - 100 - about % 20_011) % 20_011;
        if off > 10_005 { about + off - 20_011 } else { about + off }
    }

    /// Bytes that have arrived by `now`, `room` at most.
    pub(crate) fn read(&mut self, now: Nanos, room: usize) -> Vec<u8> {
        self.send_until(now);
        let count = self.line.iter().take(room).take_while(|(at, _)| *at <= now).count();
        self.line.drain(..count).map(|(_, byte)| byte).collect()
    }

    /// When the next byte arrives.
    pub(crate) fn next(&mut self) -> Nanos {
        let mut until = self.time((self.packets + 2) * POINTS as u64);
        while self.line.is_empty() {
            self.send_until(until);
            until += 10 * MILLIS;
        }
        self.line[0].0
    }

    fn send_until(&mut self, now: Nanos) {
        loop {
            let first = self.packets * POINTS as u64;
            let last = first + POINTS as u64 - 1;
            let done = self.time(last);
            if done > now {
                return;
            }
            self.packets += 1;
            let sensor_ms = last as f64 / f64::from(self.model.points_per_second()) * 1e3;
            let hz = f64::from(self.model.points_per_second()) / self.points;
            let word = |angle: f64| (angle % f64::from(TURN)) as u16;
            let packet = Contents {
                speed: (360.0 * hz * (1.0 + self.jitter * (self.packets % 2) as f64)).round() as u16,
                start: word(self.angle(first)),
                points: std::array::from_fn(|i| (Head::range(first + i as u64), (i * 7) as u8)),
                end: word(self.angle(last)),
                millis: ((sensor_ms + 12_345.0) % f64::from(CLOCK_TURN)) as u16,
            };
            self.put(packet.encode(), done);
        }
    }

    fn put(&mut self, bytes: [u8; LEN], done: Nanos) {
        let mut intact = true;
        let byte_ns = line_time(1, self.model.baud());
        let mut at = done;
        for (place, byte) in bytes.into_iter().enumerate() {
            at += byte_ns;
            let stays = if self.burst { 0.75 } else { self.damage.lost };
            self.burst = self.random.f64() < stays;
            if self.random.f64() < self.damage.inserted {
                self.line.push_back((at, self.random.u8(..)));
                intact &= place == 0;
            }
            let flip = if self.random.f64() < self.damage.flipped { self.random.u8(1..) } else { 0 };
            intact &= !self.burst && flip == 0;
            if !self.burst {
                self.line.push_back((at, byte ^ flip));
            }
        }
        self.sent.push(Sent { bytes, intact, at });
    }

    /// What is on the line is lost, and so are the next bytes up to `until`.
    pub(crate) fn cut(&mut self, until: Nanos) {
        self.send_until(until);
        self.line.retain(|(at, _)| *at > until);
        let lost = self.sent.iter_mut().rev().take_while(|sent| sent.at + 3 * MILLIS > self.zero);
        lost.filter(|sent| sent.at <= until + 3 * MILLIS).for_each(|sent| sent.intact = false);
    }
}
