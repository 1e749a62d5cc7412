//! Nothing is delivered that no sensor sent, unless it is marked suspect: each telegram byte by byte, as often as it was sent,
//! and each scan value by value.

use std::collections::hash_map::Entry;
use std::collections::{HashMap, VecDeque};
use std::rc::Rc;

use scanhub_schema::datagram::Packed;
use scanhub_schema::{Nanos, Scan, Topic};

use super::{Judge, Say};
use crate::event::Event;
use crate::family::Family;
use crate::hash::History;

/// What each sensor sent.
pub(crate) struct NothingInvented {
    sensors: Vec<OfSensor>,
}

struct OfSensor {
    family: Rc<dyn Family>,
    /// How often a telegram was sent and not published.
    open: HashMap<u64, u32>,
    /// What was published and not sent, until the next telegram tells whether bytes that nobody sent came before it: more was
    /// read than the telegrams have that are known.
    strange: Vec<Vec<u8>>,
    /// Place behind the last byte that was read.
    read: u64,
    /// The last telegrams that the line damaged, and nothing where it brought bytes between two.
    damaged: VecDeque<Vec<u8>>,
    /// Place behind the last telegram.
    end: u64,
    /// Number, life and bytes of the last published sample of telegrams.
    last: (u64, u64, Vec<u8>),
}

impl NothingInvented {
    pub(crate) fn new(sensors: &[Rc<dyn Family>]) -> NothingInvented {
        let sensor = |family: &Rc<dyn Family>| OfSensor {
            family: family.clone(),
            open: HashMap::new(),
            strange: Vec::new(),
            read: 0,
            damaged: VecDeque::new(),
            end: 0,
            last: Default::default(),
        };
        NothingInvented { sensors: sensors.iter().map(sensor).collect() }
    }
}

impl Judge for NothingInvented {
    fn name(&self) -> &'static str {
        "nothing_invented"
    }

    fn note(&mut self, _: Nanos, event: &Event<'_>, say: &mut Say<'_>) {
        match *event {
            Event::Sent { sensor, telegram } => {
                let of = &mut self.sensors[sensor];
                *of.open.entry(History::of(telegram.bytes)).or_default() += 1;
                let (begin, end) = telegram.span;
                if std::mem::replace(&mut of.end, end) < begin {
                    of.damage(&[]);
                }
                if telegram.damage.is_some() {
                    of.damage(telegram.bytes);
                }
                of.judge_strange(sensor, say);
            }
            Event::Read { sensor, to, .. } => self.sensors[sensor].read = to,
            Event::Published { sensor, sample } if sample.topic == Topic::Telegram => {
                let of = &mut self.sensors[sensor];
                for unit in of.family.units(&sample.bytes) {
                    let is_known = of.take(History::of(unit));
                    let mut damaged = of.damaged.iter().map(Vec::as_slice);
                    let is_clean = sample.header.reasons == 0;
                    if !is_known && is_clean && !of.family.is_collision(unit, &mut damaged) {
                        of.strange.push(unit.to_vec());
                    }
                }
                if of.read <= of.end {
                    of.judge_strange(sensor, say);
                }
                (of.last.0, of.last.1) = (sample.header.seq, sample.header.boot);
                of.last.2.clear();
                of.last.2.extend_from_slice(&sample.bytes);
            }
            Event::Published { sensor, sample } if sample.topic == Topic::Scan => {
                let OfSensor { family, last: (seq, boot, telegram), .. } = &self.sensors[sensor];
                let mut scan = Box::<Scan>::default();
                if !Scan::unpack_into(&mut scan, &sample.bytes) {
                    say.broken(format!("sensor {sensor}: what is no scan"));
                }
                if (*seq, *boot) == (sample.header.seq, sample.header.boot)
                    && !family.is_scan_of(&scan, telegram)
                {
                    say.broken(format!("sensor {sensor}: a scan that is not that of telegram {seq}"));
                }
            }
            _ => {}
        }
    }
}

impl OfSensor {
    /// Says what is strange and is no mixture of what the line damaged.
    fn judge_strange(&mut self, sensor: usize, say: &mut Say<'_>) {
        for unit in std::mem::take(&mut self.strange) {
            if !self.family.is_collision(&unit, &mut self.damaged.iter().map(Vec::as_slice)) {
                say.broken(format!("sensor {sensor} did not send {unit:02X?}"));
            }
        }
    }

    /// The line damaged `telegram`.
    fn damage(&mut self, telegram: &[u8]) {
        self.damaged.truncate(REMEMBERED - 1);
        self.damaged.push_front(telegram.to_vec());
    }

    /// Takes one of those that were sent and not published, if there is one.
    fn take(&mut self, key: u64) -> bool {
        let Entry::Occupied(mut entry) = self.open.entry(key) else { return false };
        *entry.get_mut() -= 1;
        if *entry.get() == 0 {
            entry.remove();
        }
        true
    }
}

/// So many damaged telegrams are remembered.
const REMEMBERED: usize = 4;
