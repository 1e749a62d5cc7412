//! Packets to turns. A turn begins where the head passes its zero: half a step of the grid before it, so that the beam
//! ahead is measured in one piece. A turn of which packets are missing is incomplete, two turns are never one, and of a
//! turn less than half of which is there only the count is told. Knows no bytes and no hub's clock.

use line::grid::{NO_RETURN, Point};
use line::{Nanos, TurnCounts};

use crate::packet::{POINTS, Packet, TURN};
use crate::sequence::Place;

/// The turn that is being measured.
#[derive(Clone, Debug)]
pub(crate) struct Turns {
    points: [Point; CAPACITY],
    len: usize,
    open: Option<Open>,
    /// Where the last point is, in hundredths of a degree from the turn's edge; nothing before the first one.
    reached: Option<f32>,
    /// From the edge of a turn to the zero.
    edge: f32,
    /// The number of the last one that began.
    number: u64,
    counts: TurnCounts,
}

#[derive(Clone, Copy, Debug)]
struct Open {
    /// By the scanner's clock, in nanoseconds.
    first: f64,
    last: f64,
    /// Nanoseconds from one point to the next, and how far apart they are.
    point_ns: f32,
    step: f32,
    incomplete: bool,
    reasons: u8,
}

/// A turn that is over, with times of the scanner's clock; its points stay until the next one begins.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Closed {
    pub(crate) number: u64,
    pub(crate) len: usize,
    pub(crate) first: Nanos,
    pub(crate) last: Nanos,
    pub(crate) period: Nanos,
    pub(crate) incomplete: bool,
    pub(crate) reasons: u8,
}

/// How far a packet is put into turns.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Progress {
    /// Whether what lies between it and the last one was looked at.
    joined: bool,
    /// Points that are done.
    point: usize,
}

impl Turns {
    pub(crate) fn new() -> Self {
        let none = Point { angle: 0.0, range: NO_RETURN, intensity: 0 };
        Turns {
            points: [none; CAPACITY],
            len: 0,
            open: None,
            reached: None,
            edge: 0.0,
            number: 0,
            counts: TurnCounts::default(),
        }
    }

    /// From now on turns are for a grid of so many beams; the open one is given up.
    pub(crate) fn begin(&mut self, beams: usize) {
        self.edge = f32::from(TURN) / 2.0 / beams as f32;
        self.give_up();
    }

    pub(crate) fn counts(&self) -> TurnCounts {
        self.counts
    }

    /// The turn that is being measured, as if it ended here.
    pub(crate) fn begun(&self) -> Option<Closed> {
        self.open.map(|open| self.end(&open))
    }

    /// The points of the turn that was closed just now, or that is being measured.
    pub(crate) fn points(&self, closed: &Closed) -> &[Point] {
        &self.points[..closed.len]
    }

    /// Puts `packet` at `place` into turns, from `progress` on. If a turn is over with it, that one; then this is to be
    /// called once more. `reasons` are the packet's, `point_ns` is the time between two points.
    pub(crate) fn add(
        &mut self,
        packet: &Packet<'_>,
        place: Place,
        reasons: u8,
        point_ns: f32,
        progress: &mut Progress,
    ) -> Option<Closed> {
        let turn = f32::from(TURN);
        let time = match place {
            Place::Again => return None,
            Place::Odd => {
                self.open.iter_mut().for_each(|open| open.incomplete = true);
                return None;
            }
            Place::First { time } => {
                if !progress.joined {
                    self.give_up();
                }
                time
            }
            Place::Next { time, .. } => time,
        };
        let step = f32::from(packet.span()) / (POINTS - 1) as f32;
        let start = (f32::from(packet.start()) + self.edge) % turn;
        let time_of = |point: usize| time as f64 - f64::from(point_ns) * (POINTS - 1 - point) as f64;
        let fresh = |point: usize, incomplete| {
            let at = (start + step * point as f32) % turn;
            // Where beam 0 is missing, it is dated as if it were there.
            let before = if incomplete && step > 0.0 { at / step * point_ns } else { 0.0 };
            let first = (time_of(point) - f64::from(before)).max(0.0);
            Open { first, last: first, point_ns, step, incomplete, reasons }
        };
        if let Place::Next { missing, gap, .. } = place
            && !core::mem::replace(&mut progress.joined, true)
            && let Some(before) = self.reached
        {
            let has_gap = missing > 0;
            let edges = ((before + gap - start) / turn + 0.5).max(0.0) as u64;
            if edges > 0 {
                let lacks = |angle: f32| has_gap && angle > 1.5 * step;
                let lacks_end = lacks(turn - before);
                self.open.iter_mut().for_each(|open| open.incomplete |= lacks_end);
                let closed = self.close();
                self.counts.missed += edges - 1;
                self.open(fresh(0, lacks(start) || edges > 1));
                self.reached = Some(start);
                if closed.is_some() {
                    return closed;
                }
            } else if has_gap {
                self.open.iter_mut().for_each(|open| open.incomplete = true);
            }
        }
        progress.joined = true;
        for point in progress.point..POINTS {
            let reached = start + step * point as f32;
            let is_over = reached >= turn && (point == 0 || reached - step < turn);
            if is_over && progress.point != point {
                progress.point = point;
                let closed = self.close();
                self.open(fresh(point, false));
                if closed.is_some() {
                    return closed;
                }
            }
            if let Some(open) = &mut self.open {
                match self.points.get_mut(self.len) {
                    Some(place) => {
                        *place = packet.point(point);
                        self.len += 1;
                    }
                    None => open.incomplete = true,
                }
                open.last = time_of(point);
                open.reasons |= reasons;
            }
            self.reached = Some(reached % turn);
        }
        progress.point = POINTS;
        None
    }

    /// The open turn comes to no end.
    pub(crate) fn give_up(&mut self) {
        if self.open.take().is_some() {
            self.counts.short += 1;
        }
        (self.len, self.reached) = (0, None);
    }

    fn open(&mut self, open: Open) {
        self.number += 1;
        self.open = Some(open);
    }

    /// The open turn is over; nothing if there is none, or too little of it.
    fn close(&mut self) -> Option<Closed> {
        let open = self.open.take();
        let closed = open.map(|open| self.end(&open));
        let len = core::mem::take(&mut self.len);
        if (len as f32) < open?.due() / 2.0 {
            self.counts.short += 1;
            return None;
        }
        self.counts.turns += 1;
        self.counts.incomplete += u64::from(open?.incomplete);
        closed
    }

    fn end(&self, open: &Open) -> Closed {
        Closed {
            number: self.number,
            len: self.len,
            first: open.first as Nanos,
            last: open.last as Nanos,
            period: (open.due() * open.point_ns) as Nanos,
            incomplete: open.incomplete,
            reasons: open.reasons,
        }
    }
}

impl Open {
    /// Points of a whole turn.
    fn due(&self) -> f32 {
        f32::from(TURN) / self.step.max(1e-3)
    }
}

/// Points of an STL27L that turns five times a second, and some; what is more does not fit into a turn.
const CAPACITY: usize = 4_400;
