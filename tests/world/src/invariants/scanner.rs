//! Invariants on the hub's access to a scanner: its family, the rate of its port, and its EEPROM.

use std::rc::Rc;

use scanhub_schema::{Family as FamilyName, MILLIS, Nanos, State, Status, Topic};

use super::{Invariant, ViolationReporter};
use crate::event::{Event, Telegram};
use crate::family::{Family, is_ld_packet};
use crate::topics::Sample;

/// Invariant: a sample has the family of its scanner. If a link has no family, its samples have no family until the
/// scanner is found. Until the scanner is found, the link publishes no telegram and no scan, and publishes a status
/// without a family only while the hub searches or has no port. The hub sends no byte to an LDROBOT that streams
/// undisturbed.
pub(crate) struct Families(Vec<FamilyProgress>);

struct FamilyProgress {
    /// The family of the scanner. The list has both families if an exchange replaces the scanner with one of another
    /// family.
    families: Vec<FamilyName>,
    is_auto: bool,
    opened_at: Nanos,
    /// Time from which the hub must find a scanner of another family as soon as any other scanner.
    search_from: Nanos,
    /// Time since which packets have arrived without damage and without gaps; and time of the last packet.
    clean_since: Option<Nanos>,
    last_at: Nanos,
    /// Position after the last packet.
    sent_end: u64,
}

impl Families {
    pub(crate) fn new(sensors: &[Rc<dyn Family>]) -> Families {
        let sensor = |family: &Rc<dyn Family>| FamilyProgress {
            families: family.families(),
            is_auto: family.keys().iter().any(|key| key == "family=auto"),
            opened_at: 0,
            search_from: 0,
            clean_since: None,
            last_at: 0,
            sent_end: 0,
        };
        Families(sensors.iter().map(sensor).collect())
    }
}

impl Invariant for Families {
    fn name(&self) -> &'static str {
        "family"
    }

    fn on_event(&mut self, at: Nanos, event: &Event<'_>, reporter: &mut ViolationReporter<'_>) {
        match *event {
            Event::PortOpened { sensor, .. } => self.0[sensor].opened_at = at,
            Event::Sent { sensor, telegram } => self.0[sensor].send(at, telegram),
            Event::ScannerExchanged { sensor } => {
                let of = &mut self.0[sensor];
                of.clean_since = None;
                // The session of the previous family first waits for its own scanner.
                of.search_from = if of.families.len() > 1 { at + SEARCH_TIMEOUT } else { at };
            }
            Event::RateAltered { sensor } => self.0[sensor].clean_since = None,
            Event::Written { sensor } if self.0[sensor].is_undisturbed(at) => {
                reporter.report(format!("sensor {sensor}: the hub sent a byte to an LDROBOT that streams"));
            }
            Event::Published { sensor, sample } => {
                if let Err(words) = self.0[sensor].check(sample) {
                    reporter.report(format!("sensor {sensor}: {words}"));
                }
            }
            _ => {}
        }
    }
}

impl FamilyProgress {
    /// Returns whether an LDROBOT has streamed since the port was opened, or for longer than the search takes to detect
    /// the stream.
    fn is_undisturbed(&self, at: Nanos) -> bool {
        // The hub may have saved the other of two families. It then tries the rates of that family first.
        let is_known = self.families == [FamilyName::Ld];
        let is_old = |since: Nanos| {
            is_known && since <= self.opened_at || since.max(self.search_from) + SEARCH_ROUND < at
        };
        at < self.last_at + MAX_PACKET_GAP && self.clean_since.is_some_and(is_old)
    }

    fn send(&mut self, at: Nanos, telegram: &Telegram<'_>) {
        let begin = std::mem::replace(&mut self.sent_end, telegram.span.1);
        // With these kinds of damage, the scanner and the line still work. The bytes are lost because the port has
        // another rate or the hub does not read.
        let is_harmless = |damage: &str| matches!(damage, "baud" | "unread" | "flushed");
        let is_clean = is_ld_packet(telegram.bytes)
            && telegram.damage.is_none_or(is_harmless)
            && telegram.span.0 <= begin;
        let is_next = at < std::mem::replace(&mut self.last_at, at) + MAX_PACKET_GAP;
        self.clean_since = self.clean_since.filter(|_| is_next).or(Some(at)).filter(|_| is_clean);
    }

    /// Checks the family of a sample.
    ///
    /// # Errors
    ///
    /// Returns a description of the error.
    fn check(&self, Sample { topic, header, bytes, .. }: &Sample) -> Result<(), String> {
        let family = header.family();
        let may_be_unknown = match topic {
            Topic::Status => {
                let status: Status = bytemuck::pod_read_unaligned(bytes);
                if status.family() != family {
                    return Err(format!(
                        "a status with family {:?}, and a header with {family:?}",
                        status.family()
                    ));
                }
                let searches = matches!(status.state(), Some(State::Probing | State::Paused | State::Absent));
                searches
            }
            Topic::Telegram | Topic::Scan | Topic::Early => false,
            // Zones may have the verdict `unknown`, and the background may be the saved one. No scanner is needed for
            // these samples.
            _ => true,
        };
        let is_unknown = self.is_auto && may_be_unknown && family.is_none();
        if is_unknown || family.is_some_and(|family| self.families.contains(&family)) {
            return Ok(());
        }
        Err(format!("{topic:?} with family {family:?}, and the scanner has {:?}", self.families))
    }
}

/// Maximum time between two packets of a scanner that streams without gaps.
const MAX_PACKET_GAP: Nanos = 50 * MILLIS;
/// Maximum duration of one round of the search, in which it tries all rates. If a scanner has begun to stream, the
/// search detects the stream within one round.
const SEARCH_ROUND: Nanos = 4_000 * MILLIS;
/// Time without data from the scanner after which the search starts again.
const SEARCH_TIMEOUT: Nanos = 10_000 * MILLIS;

/// Invariant: if another process sets a port to another rate, the hub soon restores its own rate. The hub reads bytes
/// at the wrong rate for less than a second.
pub(crate) struct PortRate {
    sensors: Vec<PortState>,
}

#[derive(Clone, Copy, Default)]
struct PortState {
    is_altered: bool,
    /// Time of the first read after the other process changed the rate, or after the last telegram if that is later.
    misread_since: Option<Nanos>,
    /// Whether the last read happened too long after `misread_since`.
    is_overdue: bool,
}

impl PortRate {
    pub(crate) fn new(sensors: usize) -> PortRate {
        PortRate { sensors: vec![PortState::default(); sensors] }
    }
}

impl Invariant for PortRate {
    fn name(&self) -> &'static str {
        "settings"
    }

    fn on_event(&mut self, at: Nanos, event: &Event<'_>, reporter: &mut ViolationReporter<'_>) {
        match *event {
            Event::RateAltered { sensor } => {
                self.sensors[sensor] = PortState { is_altered: true, ..PortState::default() };
            }
            Event::RateChanged { sensor }
            | Event::PortOpened { sensor, .. }
            | Event::PortClosed { sensor } => {
                self.sensors[sensor] = PortState::default();
            }
            Event::Published { sensor, sample } if sample.topic == Topic::Telegram => {
                let of = &mut self.sensors[sensor];
                (of.misread_since, of.is_overdue) = (None, false);
            }
            Event::Read { sensor, .. } if self.sensors[sensor].is_altered => {
                let of = &mut self.sensors[sensor];
                if of.is_overdue {
                    reporter.report(format!("sensor {sensor}: the port keeps the rate of another process"));
                    of.is_altered = false;
                }
                // The hub restores its rate after a read, not before the read.
                of.is_overdue = at > *of.misread_since.get_or_insert(at) + MAX_MISREAD_TIME;
            }
            _ => {}
        }
    }
}

/// Maximum time for which the hub may read bytes at the wrong rate.
const MAX_MISREAD_TIME: Nanos = 1_000 * MILLIS;

/// Invariant: no request of the hub writes the EEPROM of a scanner. The invariant is checked at the end of the world.
pub(crate) struct Eeprom;

impl Invariant for Eeprom {
    fn name(&self) -> &'static str {
        "eeprom"
    }

    fn on_event(&mut self, _: Nanos, event: &Event<'_>, reporter: &mut ViolationReporter<'_>) {
        if let Event::WorldEnded { eeprom_writes, .. } = *event
            && eeprom_writes > 0
        {
            reporter.report(format!("scanners received {eeprom_writes} requests that write the EEPROM"));
        }
    }
}
