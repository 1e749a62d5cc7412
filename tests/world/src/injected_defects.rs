//! Injected defects: bugs that tests build in to prove that invariants find them. The bugs are in the models around the
//! hub and its network. No bug is in the hub's own code, so the hub need not be compiled a second time.

use std::cell::Cell;

use scanhub_drivers::lms::telegram::Writer;
use scanhub_schema::{Counter, Family, Flags, Header, Scan, ScanHead, Status, Topic};

/// An injected defect.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Defect {
    /// Some rings of the doorbell are lost.
    LostWake,
    /// The hub wakes subscribers to zones only after it has sent all samples of a scan.
    OneRing,
    /// The last byte of some reads is lost.
    LostByte,
    /// A bit of some reads is flipped.
    FlippedBit,
    /// Unknown zones are published as clear.
    SurvivingVerdict,
    /// An open line is never closed.
    UnreleasedHandle,
    /// Some samples are sent twice.
    SentTwice,
    /// Some samples have the sequence number of the previous sample.
    Renumbered,
    /// Some telegrams are not sent.
    UnsentTelegram,
    /// The memory of some samples is never released.
    LeakedLoan,
    /// A request writes the EEPROM of the scanner.
    EepromWrite,
    /// The hub is not notified of a hang-up of the line.
    SwallowedHangUp,
    /// Some samples are sent late, together with the next sample.
    Delayed,
    /// Some pairs of samples arrive in the wrong order.
    Reordered,
    /// The second half of some revolutions comes from the previous revolution.
    MergedRevolution,
    /// Some scans have an additional beam.
    ExtraBeam,
    /// A backlogged scan has the time of its publication as its stamp.
    StampedOnArrival,
    /// An incomplete revolution is not marked.
    UnmarkedRevolution,
    /// Packets that are lost on the line are not counted.
    UncountedLoss,
    /// A byte of some remote samples is changed.
    RemoteAltered,
    /// A listener treats some parts as complete samples.
    RemoteHalf,
    /// A listener accepts some datagrams twice.
    RemoteCountedTwice,
    /// A datagram has the time at which it was read instead of the time of its arrival.
    RemoteStampedLate,
    /// A remote robot does not detect a silence.
    RemoteSurvivingVerdict,
    /// A listener with a key does not check MACs.
    RemoteUnchecked,
    /// A gateway announces its sensors only once.
    Unannounced,
    /// A bridge does not reconnect to a router that was killed.
    RouterNotReconnected,
    /// A bridge drops some queued samples, and counts them as sent.
    UncountedDrop,
    /// Some packets with a wrong checksum are published.
    WrongChecksum,
    /// Packets next to damaged bytes are not marked.
    UnmarkedNeighbor,
    /// A scanner ignores all requests while it measures, even the request to stop.
    IgnoredRequests,
    /// Requests to start a motor are lost.
    UnstartedMotor,
    /// All points of some revolutions are shifted by one degree.
    ShiftedPoints,
    /// A false early warning is not withdrawn.
    KeptWarning,
    /// The port hides that another process has changed its rate.
    HiddenRate,
    /// An estimated stamp of a telegram is not marked.
    UnmarkedEstimate,
    /// Every stamp is marked as an estimate.
    NeedlessEstimate,
    /// No early warning is sent.
    UnsentWarning,
    /// Some scans have the wrong family.
    WrongFamily,
    /// The hub sends an unnecessary byte to some streaming scanners.
    NeedlessByte,
    /// The hub is not notified of a new subscriber.
    UnnoticedSubscriber,
    /// The hub rings the doorbell sometimes although no subscriber has a new sample.
    NeedlessRing,
    /// Some events are not sent.
    UnsentEvent,
}

impl Defect {
    /// All defects.
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

/// The injected defect of a world, if any.
#[derive(Debug, Default)]
pub(crate) struct InjectedDefect {
    defect: Option<Defect>,
    opportunities: Cell<u64>,
}

impl InjectedDefect {
    pub(crate) fn new(defect: Option<Defect>) -> InjectedDefect {
        InjectedDefect { defect, opportunities: Cell::new(0) }
    }

    /// Returns whether `defect` is injected.
    pub(crate) fn is_active(&self, defect: Defect) -> bool {
        self.defect == Some(defect)
    }

    /// Counts an opportunity for the injected defect. Returns whether the injected defect is `defect` and takes effect
    /// now, which happens at one of every `of` opportunities.
    pub(crate) fn triggers(&self, defect: Defect, of: u64) -> bool {
        if !self.is_active(defect) {
            return false;
        }
        self.opportunities.set(self.opportunities.get() + 1);
        self.opportunities.get().is_multiple_of(of)
    }
}

/// Applies those [`Defect`]s that change published samples.
#[derive(Debug, Default)]
pub(crate) struct SampleCorrupter {
    /// The last published scan, as it was before the injected defect changed it.
    last_scan: Option<Box<Scan>>,
}

impl SampleCorrupter {
    /// Changes a sample of `topic` that is sent at `now`, if the injected defect requires a change.
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

    /// Returns whether the injected defect changes published samples.
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

/// Minimum age at which a sample counts as backlogged, in ns.
const BACKLOG_AGE_NS: u64 = 100_000_000;

/// Returns a request that writes the EEPROM. The request is 66h, which sets the baud rate after power-on.
pub(crate) fn eeprom_request() -> Vec<u8> {
    Writer::new(0, 0x66).byte(0x42).finish().bytes().to_vec()
}
