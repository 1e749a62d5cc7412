//! Defects that are built into the models around the hub and its network on purpose, to see that the judges find them.
//! None is in the hub's own code, so that nothing has to be built twice. Refuses to know who notices.

use std::cell::Cell;

use scanhub_drivers::lms::telegram::Writer;
use scanhub_schema::{Counter, Family, Flags, Header, Scan, ScanHead, Status, Topic};

/// A defect.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Defect {
    /// Now and then nobody is woken.
    LostWake,
    /// Whoever waits for zones is woken only when all is sent.
    OneRing,
    /// Now and then the last byte of a read is lost.
    LostByte,
    /// Now and then a bit of what is read is another one.
    FlippedBit,
    /// The hub's word that the zones are unknown says that they are clear.
    SurvivingVerdict,
    /// A line that was opened is never closed.
    UnreleasedHandle,
    /// Now and then a sample is sent twice.
    SentTwice,
    /// Now and then a sample has the number of the one before it.
    Renumbered,
    /// Now and then a telegram is not sent.
    UnsentTelegram,
    /// Now and then the memory of a sample is not given back.
    LeakedLoan,
    /// Something writes the sensor's EEPROM.
    EepromWrite,
    /// Nobody is told that a line hung up.
    SwallowedHangUp,
    /// Now and then a sample is sent only with the next one.
    Delayed,
    /// Now and then two samples come in the wrong order.
    Reordered,
    /// Now and then the second half of a turn is that of the turn before it.
    MergedRevolution,
    /// Now and then a scan has a beam more.
    ExtraBeam,
    /// A scan that waited for the hub is stamped when it was made.
    StampedOnArrival,
    /// A turn of which packets are missing is not marked.
    UnmarkedRevolution,
    /// What was lost on the line is not counted.
    UncountedLoss,
    /// Now and then a byte of a remote sample is another one.
    RemoteAltered,
    /// Now and then a listener takes a part for the whole sample.
    RemoteHalf,
    /// Now and then a listener takes one datagram twice.
    RemoteCountedTwice,
    /// A datagram has the time at which it was read, not that at which it came.
    RemoteStampedLate,
    /// A remote robot does not see that nothing comes.
    RemoteSurvivingVerdict,
    /// A listener with a key checks no MAC.
    RemoteUnchecked,
    /// A gateway says only once who its sensors are.
    Unannounced,
    /// A bridge does not come back to a router that was killed.
    RouterNotReconnected,
    /// Now and then a bridge throws a sample away that waits, and its account says that it was sent.
    UncountedDrop,
    /// Now and then a packet is published whose checksum is wrong.
    WrongChecksum,
    /// What comes beside damaged bytes is not marked.
    UnmarkedNeighbor,
    /// A scanner that measures hears nothing, not even that it shall stop.
    IgnoredRequests,
    /// No request for a motor gets through.
    UnstartedMotor,
    /// Now and then all points of a turn are a degree beside their places.
    ShiftedPoints,
    /// A warning that does not hold is not taken back.
    KeptWarning,
    /// The port hides that another process set its rate.
    HiddenRate,
    /// An estimated stamp of a telegram is not marked.
    UnmarkedEstimate,
    /// Every stamp is marked as an estimate.
    NeedlessEstimate,
    /// No early warning is sent.
    UnsentWarning,
    /// Now and then a scan has another family than its scanner.
    WrongFamily,
    /// Now and then the hub sends a needless byte to a scanner that streams.
    NeedlessByte,
    /// The hub is not told that a subscriber has attached.
    UnnoticedSubscriber,
    /// Now and then the hub rings although no subscriber has a new sample.
    NeedlessRing,
    /// Now and then the event is not sent.
    UnsentEvent,
}

impl Defect {
    /// All of them.
    pub const ALL: [Defect; 43] = [
        Defect::LostWake,
        Defect::OneRing,
        Defect::LostByte,
        Defect::FlippedBit,
        Defect::SurvivingVerdict,
        Defect::UnreleasedHandle,
        Defect::SentTwice,
        Defect::Renumbered,
        Defect::UnsentTelegram,
        Defect::LeakedLoan,
        Defect::EepromWrite,
        Defect::SwallowedHangUp,
        Defect::Delayed,
        Defect::Reordered,
        Defect::MergedRevolution,
        Defect::ExtraBeam,
        Defect::StampedOnArrival,
        Defect::UnmarkedRevolution,
        Defect::UncountedLoss,
        Defect::RemoteAltered,
        Defect::RemoteHalf,
        Defect::RemoteCountedTwice,
        Defect::RemoteStampedLate,
        Defect::RemoteSurvivingVerdict,
        Defect::RemoteUnchecked,
        Defect::Unannounced,
        Defect::RouterNotReconnected,
        Defect::UncountedDrop,
        Defect::WrongChecksum,
        Defect::UnmarkedNeighbor,
        Defect::IgnoredRequests,
        Defect::UnstartedMotor,
        Defect::ShiftedPoints,
        Defect::KeptWarning,
        Defect::HiddenRate,
        Defect::UnmarkedEstimate,
        Defect::NeedlessEstimate,
        Defect::UnsentWarning,
        Defect::WrongFamily,
        Defect::NeedlessByte,
        Defect::UnnoticedSubscriber,
        Defect::NeedlessRing,
        Defect::UnsentEvent,
    ];
}

/// The defect that is injected into a world, if any.
#[derive(Debug, Default)]
pub(crate) struct InjectedDefect {
    defect: Option<Defect>,
    opportunities: Cell<u64>,
}

impl InjectedDefect {
    pub(crate) fn new(defect: Option<Defect>) -> InjectedDefect {
        InjectedDefect { defect, opportunities: Cell::new(0) }
    }

    /// Whether `defect` is there.
    pub(crate) fn is_active(&self, defect: Defect) -> bool {
        self.defect == Some(defect)
    }

    /// Whether `defect` shows this time: of so many chances with the last.
    pub(crate) fn triggers(&self, defect: Defect, of: u64) -> bool {
        if !self.is_active(defect) {
            return false;
        }
        self.opportunities.set(self.opportunities.get() + 1);
        self.opportunities.get().is_multiple_of(of)
    }
}

/// What [`Defect`]s of turns make of scans and of what is counted.
#[derive(Debug, Default)]
pub(crate) struct SampleCorrupter {
    /// The last scan as it was.
    last_scan: Option<Box<Scan>>,
}

impl SampleCorrupter {
    /// Spoils a sample of `topic` that is sent at `now`, if one of these defects is `defect`.
    pub(crate) fn corrupt(
        &mut self,
        defect: &InjectedDefect,
        (topic, now): (Topic, u64),
        header: &mut Header,
        bytes: &mut Vec<u8>,
    ) {
        if topic == Topic::Status && defect.is_active(Defect::UncountedLoss) {
            let status: &mut Status = bytemuck::from_bytes_mut(bytes);
            status.counters[Counter::LostOnLine] = 0;
        }
        if topic == Topic::Telegram && defect.triggers(Defect::WrongChecksum, 100) {
            let middle = bytes.len() / 2;
            bytes[middle] ^= 4;
        }
        if defect.is_active(Defect::UnmarkedNeighbor) {
            (header.reasons, header.quality) = (0, 0);
        }
        if topic == Topic::Telegram && defect.is_active(Defect::UnmarkedEstimate) {
            header.flags &= !Flags::STAMP_ESTIMATED;
        }
        if topic == Topic::Telegram && defect.is_active(Defect::NeedlessEstimate) {
            header.flags |= Flags::STAMP_ESTIMATED;
        }
        if topic != Topic::Scan {
            return;
        }
        if defect.triggers(Defect::WrongFamily, 20) {
            header.family = (header.family + 1) % Family::ALL.len() as u8;
        }
        if defect.is_active(Defect::StampedOnArrival) {
            let late = now.saturating_sub(header.stamp_last_ns + BACKLOG_AGE_NS);
            (header.stamp_first_ns, header.stamp_last_ns) =
                (header.stamp_first_ns + late, header.stamp_last_ns + late);
        }
        let mut scan = Scan::of_bytes(bytes);
        if defect.is_active(Defect::UnmarkedRevolution) {
            scan.flags &= !Scan::INCOMPLETE;
        }
        if defect.triggers(Defect::ExtraBeam, 100) {
            let head = ScanHead { count: scan.count + 1, ..**scan };
            scan = Scan::zeroed(Scan::len(head.count.into(), head.contents));
            scan.begin(head).ranges.fill(Scan::NOT_MEASURED);
        }
        let before = self.last_scan.replace(scan.clone()).filter(|before| before.beams() == scan.beams());
        if let Some(mut before) = before.filter(|_| defect.triggers(Defect::MergedRevolution, 20)) {
            let half = scan.beams() / 2;
            let (into, from) = (scan.arrays(), before.arrays());
            into.ranges[half..].copy_from_slice(&from.ranges[half..]);
            if !into.angles.is_empty() {
                into.angles[half..].copy_from_slice(&from.angles[half..]);
            }
        }
        if defect.triggers(Defect::ShiftedPoints, 20) {
            scan.arrays().angles.iter_mut().for_each(|angle| *angle += 1f32.to_radians());
        }
        bytes.clear();
        bytes.extend_from_slice(scan.bytes());
    }

    /// Whether one of these is `defect`.
    pub(crate) fn is_needed(injected: &InjectedDefect) -> bool {
        let mine = [
            Defect::MergedRevolution,
            Defect::ExtraBeam,
            Defect::StampedOnArrival,
            Defect::UnmarkedRevolution,
            Defect::UncountedLoss,
            Defect::WrongChecksum,
            Defect::UnmarkedNeighbor,
            Defect::ShiftedPoints,
            Defect::UnmarkedEstimate,
            Defect::NeedlessEstimate,
            Defect::WrongFamily,
        ];
        mine.into_iter().any(|defect| injected.is_active(defect))
    }
}

/// What waited for so long did not come just now.
const BACKLOG_AGE_NS: u64 = 100_000_000;

/// A request that writes the EEPROM: 66h, the rate after power-on.
pub(crate) fn eeprom_request() -> Vec<u8> {
    Writer::new(0, 0x66).byte(0x42).finish().bytes().to_vec()
}
