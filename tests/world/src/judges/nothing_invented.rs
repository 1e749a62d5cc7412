//! Nothing is delivered that no sensor sent, unless it is marked suspect: each telegram byte by byte, as often as it was sent,
//! and each scan value by value.

use std::collections::{HashMap, VecDeque};

use lms::Nanos;
use lms::measured::MEASURED;
use schema::datagram::Packed;
use schema::{Scan, Topic};

use super::{Judge, Say};
use crate::event::Event;
use crate::hash::History;

/// What each sensor sent.
pub(crate) struct NothingInvented {
    sensors: Vec<OfSensor>,
}

#[derive(Default)]
struct OfSensor {
    /// How often a telegram was sent and not published.
    open: HashMap<u64, u32>,
    /// The last telegrams that the line damaged.
    damaged: VecDeque<Vec<u8>>,
    /// Number, life and bytes of the last published telegram.
    last: (u64, u64, Vec<u8>),
}

impl NothingInvented {
    pub(crate) fn new(sensors: usize) -> NothingInvented {
        NothingInvented { sensors: (0..sensors).map(|_| OfSensor::default()).collect() }
    }
}

impl OfSensor {
    /// Whether the line made of a telegram another one as long with a right checksum: one of 65,536 damaged ones, which nobody
    /// can know.
    fn is_collision(&self, bytes: &[u8]) -> bool {
        let others = |sent: &[u8], got: &[u8]| sent.iter().zip(got).filter(|(sent, got)| sent != got).count();
        self.damaged.iter().filter(|sent| sent.len() == bytes.len()).any(|sent| {
            let Some(first) = sent.iter().zip(bytes).position(|(sent, got)| sent != got) else {
                return false;
            };
            let last = sent.iter().zip(bytes).rposition(|(sent, got)| sent != got).unwrap_or(first);
            let (sent, got) = (&sent[first..=last], &bytes[first..=last]);
            // A byte too many and one too few shift what is between.
            let shifted = [others(&sent[1..], got), others(sent, &got[1..])];
            others(sent, got).min(shifted[0]).min(shifted[1]) <= MOST_OTHERS
        })
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
                *of.open.entry(key(telegram.bytes)).or_default() += 1;
                if telegram.damage.is_some() {
                    of.damaged.truncate(REMEMBERED - 1);
                    of.damaged.push_front(telegram.bytes.to_vec());
                }
            }
            Event::Published { sensor, sample } if sample.topic == Topic::Telegram => {
                let of = &mut self.sensors[sensor];
                let open = of.open.get_mut(&key(&sample.bytes)).filter(|count| **count > 0);
                let is_known = open.map(|count| *count -= 1).is_some();
                if !is_known && sample.header.reasons == 0 && !of.is_collision(&sample.bytes) {
                    let (command, len) = (sample.bytes[4], sample.bytes.len());
                    say.broken(format!("sensor {sensor} did not send this {command:02X} of {len} bytes"));
                }
                (of.last.0, of.last.1) = (sample.header.seq, sample.header.boot);
                of.last.2.clear();
                of.last.2.extend_from_slice(&sample.bytes);
            }
            Event::Published { sensor, sample } if sample.topic == Topic::Scan => {
                let (seq, boot, telegram) = &self.sensors[sensor].last;
                let mut scan = Box::<Scan>::default();
                if !Scan::unpack_into(&mut scan, &sample.bytes) {
                    say.broken(format!("sensor {sensor}: what is no scan"));
                }
                if (*seq, *boot) == (sample.header.seq, sample.header.boot) && !is_scan_of(&scan, telegram) {
                    say.broken(format!("sensor {sensor}: a scan that is not that of telegram {seq}"));
                }
            }
            _ => {}
        }
    }
}

/// Whether `scan` has the values of `telegram`.
fn is_scan_of(scan: &Scan, telegram: &[u8]) -> bool {
    let [_, _, _, _, MEASURED, low, high, values @ ..] = telegram else { return false };
    let count = usize::from(u16::from_le_bytes([*low, *high]) & 0x01FF);
    let (words, _) = values.as_chunks::<2>();
    let mask = scan.no_return;
    let same = |(range, word): (&u16, &[u8; 2])| *range == u16::from_le_bytes(*word) & mask;
    scan.beams() == count && words.len() >= count && scan.ranges().iter().zip(&words[..count]).all(same)
}

fn key(bytes: &[u8]) -> u64 {
    let mut history = History::new();
    history.bytes(bytes);
    history.value()
}

/// So many damaged telegrams are remembered.
const REMEMBERED: usize = 4;
/// A line that changes more bytes of a telegram changes its neighbours, too, and then it is suspect.
const MOST_OTHERS: usize = 32;
