//! A session and a head with the line between them, in virtual time, and what is to hold whatever happens.

use scanhub_drivers::Settings;
use scanhub_drivers::line;
use scanhub_drivers::line::{Event, Output, Protocol as _, Session as _};
use scanhub_drivers::rplidar::Session;
use scanhub_drivers::rplidar::packet::Kind;
use scanhub_schema::{MILLIS, Nanos};

use crate::session::encode::Sample;
use crate::session::head::Head;

pub(crate) const SECOND: Nanos = 1_000 * MILLIS;
/// Bytes that a tty hands out at once.
const TTY: usize = 4_095;

/// A turn as it was handed out.
#[derive(Debug)]
pub(crate) struct Told {
    /// Its points: degrees clockwise, 0 to 360, and millimetres.
    pub(crate) points: Vec<(f64, u16)>,
    pub(crate) first: Nanos,
    pub(crate) incomplete: bool,
    pub(crate) reasons: u8,
    pub(crate) beams: usize,
}

/// What a recorder keeps of what was handed out.
#[derive(Clone)]
pub(crate) struct Kept {
    pub(crate) first: Nanos,
    pub(crate) last: Nanos,
    pub(crate) bytes: Vec<u8>,
    pub(crate) reasons: u8,
}

#[derive(Default)]
pub(crate) struct Log {
    pub(crate) packets: Vec<Vec<u8>>,
    pub(crate) turns: Vec<Told>,
    pub(crate) replies: usize,
    /// All that was handed out but turns.
    pub(crate) heard: Vec<Kept>,
    pub(crate) reads: usize,
    pub(crate) bauds: Vec<u32>,
    pub(crate) dtr: Vec<bool>,
}

pub(crate) struct Bench {
    pub(crate) session: Session,
    pub(crate) head: Head,
    pub(crate) now: Nanos,
    pub(crate) log: Log,
}

impl Bench {
    pub(crate) fn new(settings: Settings, head: Head) -> Bench {
        Bench { session: Session::new(settings, 0), head, now: 0, log: Log::default() }
    }

    /// Drives the session until `until`.
    pub(crate) fn run(&mut self, until: Nanos) {
        while self.now < until {
            let (wakes_at, waits) = self.drain();
            let ready = if waits { self.head.next(wakes_at.min(until), self.now) } else { Nanos::MAX };
            self.now = wakes_at.min(ready.max(self.now)).min(until).max(self.now);
            self.read(self.now >= wakes_at);
        }
    }

    /// Drives it until `done`, for `most` at most. How long that took.
    pub(crate) fn until(&mut self, most: Nanos, done: impl Fn(&Bench) -> bool) -> Nanos {
        let begun = self.now;
        while !done(self) {
            assert!(self.now < begun + most, "{:?} {:?}", self.session.state(), self.session.trouble());
            self.run(self.now + 5 * MILLIS);
        }
        self.now - begun
    }

    pub(crate) fn read(&mut self, is_timeout: bool) {
        let room = self.session.spare().len().min(TTY);
        let mut bytes = self.head.read(self.now, room);
        if self.session.rate() != self.head.baud {
            // Another rate makes noise of it.
            let made = |byte: &u8| if self.head.is_text { b'0' | byte & 15 } else { byte | 0x80 };
            bytes = bytes.iter().step_by(3).map(made).collect();
        }
        self.session.spare()[..bytes.len()].copy_from_slice(&bytes);
        self.session.commit(self.now, bytes.len());
        self.log.reads += 1;
        if bytes.is_empty() && is_timeout {
            self.session.handle_timeout(self.now);
        }
        let account = self.session.account();
        assert_eq!(account.read, account.in_telegrams + account.discarded + account.buffered);
    }

    /// When the session's rest or wait is over, and whether it is a wait.
    fn drain(&mut self) -> (Nanos, bool) {
        loop {
            match self.session.poll_output() {
                Output::SetRate(baud) => {
                    self.head.read(self.now, usize::MAX);
                    self.log.bauds.push(baud);
                }
                Output::SetDtr(on) => {
                    self.head.dtr = on;
                    self.log.dtr.push(on);
                }
                Output::Transmit { bytes, not_before } => {
                    self.now = self.now.max(not_before);
                    assert!(bytes.len() > 1, "a request is one write: {bytes:?}");
                    let bytes = bytes.to_vec();
                    let rate = self.session.rate();
                    bytes.into_iter().for_each(|byte| self.head.write(byte, rate, self.now));
                    self.session.transmitted(self.now);
                }
                Output::Rest(until) => {
                    assert!(until > self.now && until <= self.now + 5 * MILLIS);
                    return (until, false);
                }
                Output::Wait { until, .. } => return (until, true),
                Output::Event(Event::Telegram(received)) => {
                    assert!(received.first <= received.last && received.last <= self.now, "{received:?}");
                    self.log.heard.push(Kept {
                        first: received.first,
                        last: received.last,
                        bytes: received.bytes.to_vec(),
                        reasons: received.reasons,
                    });
                    if received.is_reply {
                        self.log.replies += 1;
                        continue;
                    }
                    assert!(received.last - received.first <= 12 * MILLIS, "{received:?}");
                    let len = received.bytes.len() / received.count;
                    assert_eq!(received.is_checked, len > 5);
                    self.log.packets.extend(received.bytes.chunks_exact(len).map(<[u8]>::to_vec));
                }
                Output::Event(Event::Scan(turn)) => {
                    let points = turn.points().iter();
                    self.log.turns.push(Told {
                        points: points
                            .map(|point| (-f64::from(point.angle).to_degrees(), point.range))
                            .collect(),
                        first: turn.first,
                        incomplete: turn.is_incomplete(),
                        reasons: turn.reasons,
                        beams: turn.beams(),
                    });
                }
            }
        }
    }

    /// Checks the turns of the stream that still goes on: each has points of one turn of the head at their right places, and
    /// one that is not marked has all of them. Returns the worst error of a stamp, and how many points of unmarked turns
    /// are wrong.
    pub(crate) fn judge(&self, turns: &[Told]) -> (Nanos, usize) {
        let kind = self.head.kind().expect("measuring");
        let (step, mut worst, mut wrong) = (self.head.step(), 0, 0);
        let begun = self.head.time(0.0).expect("measuring");
        let per_turn = 360.0 / step;
        let mut last_turn = -1.0;
        for told in turns.iter().filter(|told| told.first > begun) {
            // Beam 0's edge is half a beam before the zero.
            let edge = 180.0 / told.beams as f64;
            let about = (told.first - begun) as f64 / (self.head.time(1.0).unwrap() - begun) as f64;
            let turn = ((about + shift(kind) / -step) / per_turn).round();
            assert!(turn > last_turn, "two turns are one: {turn} after {last_turn}");
            last_turn = turn;
            let zero = (turn * 360.0 + shift(kind) - edge) / step;
            worst = worst.max(told.first.abs_diff(self.head.time(zero).expect("measuring")));
            let bad = told.points.iter().filter(|point| !self.is_right(kind, turn, **point, edge)).count();
            assert!(told.points.len() as f64 <= per_turn + 12.0, "merged: {}", told.points.len());
            if !told.incomplete && told.reasons == 0 {
                wrong += bad;
                let lacking = per_turn - told.points.len() as f64;
                assert!(lacking < 12.0, "{lacking} points lack in turn {turn}");
            }
        }
        (worst, wrong)
    }

    fn is_right(&self, kind: Kind, turn: f64, (degrees, range): (f64, u16), edge: f64) -> bool {
        let step = self.head.step();
        if !(-edge - 0.1..360.0 - edge + 0.1).contains(&degrees) {
            return false;
        }
        let around = (turn * 360.0 + degrees) / step;
        let (from, to) = (around - 2.0, around + 10.0 / step + 2.0);
        (from.max(0.0) as u64..to.max(0.0) as u64).any(|point| {
            let sample = Head::sample(point);
            let range = if range == line::NO_RETURN { 0 } else { u32::from(range) };
            // A difference from no return cannot be told.
            let is_untold = kind == Kind::Ultra && point % 3 == 2 && Head::sample(point + 1).range == 0;
            let sample = if is_untold { Sample { range: 0, ..sample } } else { sample };
            let angle = point as f64 * step - Head::before(kind, sample);
            sample.range.abs_diff(range) <= 4 && (angle - turn * 360.0 - degrees).abs() < 0.1
        })
    }

    pub(crate) fn intact_packets_came_once_in_order(&self) {
        let mut came = self.log.packets.iter();
        for sent in self.head.sent.iter().filter(|sent| sent.intact && sent.at + 20 * MILLIS < self.now) {
            assert!(came.any(|bytes| *bytes == sent.bytes), "lost: {:?} at {}", sent.bytes, sent.at);
        }
    }
}

/// Degrees by which points lie before their places on the mean.
fn shift(kind: Kind) -> f64 {
    match kind {
        Kind::Express => 4.0,
        Kind::Ultra => 7.2,
        _ => 0.0,
    }
}
