//! SICK LMS 2xx scanners. At the start, a scanner has any rate and any state, and its link configures any variant. The
//! scans are computed once for all worlds.

use std::rc::Rc;
use std::sync::{Arc, LazyLock, Mutex, PoisonError};

use scanhub_drivers::lms;
use scanhub_drivers::lms::command::Request;
use scanhub_drivers::lms::measured::MEASURED;
use scanhub_drivers::lms::variant::{Baud, Mode, Unit, Variant};
use scanhub_schema::{MILLIS, Nanos, Scan};
use scanhub_sim::ChunkSize;
use scanhub_sim::device::Device;
use scanhub_sim::machine::{LmsSimulator, ProtocolQuirks, Settings, StartState};
use scanhub_sim::operating::OperatingMode;
use scanhub_sim::operating::ScanSource;
use scanhub_sim::room::Room;
use scanhub_sim::room::{Changes, PrecomputedScans};

use super::{Family, Scanner, quirks, rooms};
use crate::scenario::Action;

/// An LMS with its link.
#[derive(Clone)]
pub(super) struct Lms {
    settings: Settings,
    /// Whether the link has no family.
    is_auto: bool,
    variant: Variant,
    baud: Baud,
}

impl Lms {
    pub(super) fn draw(random: &mut fastrand::Rng) -> Lms {
        let variant = if random.u8(..8) == 0 { Variant::ALL[random.usize(..5)] } else { Variant::HALF };
        let baud = if random.u8(..6) == 0 { Baud::B38400 } else { Baud::B500000 };
        let found = [baud, Baud::B9600, Baud::B38400, Baud::B19200][random.usize(..4)];
        let states = [
            StartState::Operating(OperatingMode::OnRequest),
            StartState::Operating(OperatingMode::Installation),
            StartState::Operating(OperatingMode::All),
            StartState::PowerOn,
        ];
        let settings = Settings {
            baud: found,
            permanent_baud: [None, Some(baud)][random.usize(..2)],
            variant: if random.bool() { variant } else { Variant::HALF },
            start: states[random.usize(..4)].clone(),
            boot_ns: random.u64(100..1_500) * MILLIS,
            chunk: if random.bool() { ChunkSize::Uart } else { ChunkSize::Usb },
            seed: random.u64(..),
            ..Settings::default()
        };
        Lms { settings, is_auto: false, variant, baud }
    }
}

impl Family for Lms {
    fn keys(&self) -> Vec<String> {
        if self.is_auto {
            return vec!["family=auto".to_owned()];
        }
        let Variant { angle_deg, resolution_cdeg } = self.variant;
        let resolution = f64::from(resolution_cdeg) / 100.0;
        vec![
            format!("baud={}", self.baud.rate()),
            format!("angle={angle_deg}"),
            format!("resolution={resolution}"),
        ]
    }

    /// An LMS at a link without keys streams in the usual variant at 500,000 baud.
    fn auto(&self) -> Rc<dyn Family> {
        Rc::new(Lms { is_auto: true, variant: Variant::HALF, baud: Baud::B500000, ..self.clone() })
    }

    fn families(&self) -> Vec<scanhub_schema::Family> {
        vec![scanhub_schema::Family::Lms]
    }

    fn baud_rates(&self) -> Vec<u32> {
        Baud::ALL.map(Baud::rate).to_vec()
    }

    /// Returns the times at the rate that the link configures.
    fn scan_times(&self) -> (Nanos, Nanos) {
        let len = 2 * self.variant.beams() + 10;
        let rate = self.baud.rate();
        let turns = (len - 1) / lms::variant::BYTES_PER_REVOLUTION;
        let on_line = scanhub_schema::line_time(len, rate) + turns as Nanos * lms::variant::MIRROR_PERIOD;
        let period = self.variant.period(len, rate);
        (period, period + on_line)
    }

    fn initial_scanner(&self, changes: Changes) -> Box<dyn Scanner> {
        let (settings, series) = (self.settings.clone(), measured(self.variant));
        let machine = machine(&settings, &series, &changes);
        Box::new(LmsScanner { machine, settings, series, changes })
    }

    fn telegrams<'a>(&self, sample: &'a [u8]) -> Vec<&'a [u8]> {
        vec![sample]
    }

    fn max_telegrams(&self) -> usize {
        1
    }

    fn is_data(&self, unit: &[u8]) -> bool {
        unit[4] == MEASURED
    }

    fn is_scan_of(&self, scan: &Scan, sample: &[u8]) -> bool {
        let [_, _, _, _, MEASURED, low, high, values @ ..] = sample else { return false };
        let count = usize::from(u16::from_le_bytes([*low, *high]) & 0x01FF);
        let (words, _) = values.as_chunks::<2>();
        let mask = scan.no_return;
        let same = |(range, word): (&u16, &[u8; 2])| *range == u16::from_le_bytes(*word) & mask;
        scan.beams() == count && words.len() >= count && scan.ranges().iter().zip(&words[..count]).all(same)
    }

    /// Returns whether a damaged telegram of the same length differs from `got` in only a few bytes. A damaged telegram
    /// has a valid checksum in 1 of 65,536 cases.
    fn is_collision(&self, got: &[u8], damaged: &mut dyn Iterator<Item = &[u8]>) -> bool {
        let others = |sent: &[u8], got: &[u8]| sent.iter().zip(got).filter(|(sent, got)| sent != got).count();
        damaged.filter(|sent| sent.len() == got.len()).any(|sent| {
            let Some(first) = sent.iter().zip(got).position(|(sent, got)| sent != got) else {
                return false;
            };
            let last = sent.iter().zip(got).rposition(|(sent, got)| sent != got).unwrap_or(first);
            let (sent, got) = (&sent[first..=last], &got[first..=last]);
            // If one byte is inserted and another byte is lost, all bytes between these two are shifted.
            let shifted = [others(&sent[1..], got), others(sent, &got[1..])];
            others(sent, got).min(shifted[0]).min(shifted[1]) <= MAX_CHANGED_BYTES
        })
    }
}

/// A simulated LMS.
struct LmsScanner {
    machine: LmsSimulator,
    settings: Settings,
    series: Arc<PrecomputedScans>,
    changes: Changes,
}

impl Scanner for LmsScanner {
    fn device(&self) -> &dyn Device {
        &self.machine
    }

    fn device_mut(&mut self) -> &mut dyn Device {
        &mut self.machine
    }

    /// Replaces the scanner with one that has the rate of `action`, and is idle or streams already.
    fn exchange(&mut self, action: &Action, _: Nanos) -> Vec<u8> {
        let baud = Baud::ALL[action.value("rate") as usize % Baud::ALL.len()];
        let seed = self.settings.seed.wrapping_add(1);
        let start = StartState::Operating(OperatingMode::OnRequest);
        self.settings = Settings { baud, seed, start, ..self.settings.clone() };
        self.machine = machine(&self.settings, &self.series, &self.changes);
        let streams = action.value("streams") > 0;
        if streams { Request::Stream.encode(0).bytes().to_vec() } else { Vec::new() }
    }

    fn misbehave(&mut self, action: Option<&Action>) {
        self.machine.set_quirks(action.map_or_else(ProtocolQuirks::default, quirks));
    }
}

fn machine(settings: &Settings, series: &Arc<PrecomputedScans>, changes: &Changes) -> LmsSimulator {
    let room = Room::of_series(series.clone(), changes.clone());
    LmsSimulator::new(settings.clone(), ScanSource::Room(room))
}

/// Returns the scans of a scanner with `variant`, computed once.
fn measured(variant: Variant) -> Arc<PrecomputedScans> {
    type MeasuredScans = Mutex<Vec<(Variant, Arc<PrecomputedScans>)>>;
    static MEASURED_SCANS: LazyLock<MeasuredScans> = LazyLock::new(MeasuredScans::default);
    let mut known = MEASURED_SCANS.lock().unwrap_or_else(PoisonError::into_inner);
    match known.iter().find(|(of, _)| *of == variant) {
        Some((_, series)) => series.clone(),
        None => {
            let made = Arc::new(PrecomputedScans::new(
                rooms(|scene| scene),
                SCANS_PER_ROOM,
                variant,
                Unit::Mm,
                Mode(1),
            ));
            known.push((variant, made.clone()));
            made
        }
    }
}

/// Number of different scans of each room. With a single scan, processors would receive the same scan all the time.
const SCANS_PER_ROOM: usize = 12;
/// Maximum number of changed bytes in a telegram that still looks intact. If the line changes more bytes than this, it
/// also damages the neighboring telegrams, and the hub marks the telegram as suspect.
const MAX_CHANGED_BYTES: usize = 32;
