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
    MergedTurn,
    /// Now and then a scan has a beam more.
    OtherBeams,
    /// A scan that waited for the hub is stamped when it was made.
    StampedOnArrival,
    /// A turn of which packets are missing is not marked.
    UnmarkedTurn,
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
    RouterGivenUp,
    /// Now and then a bridge throws a sample away that waits, and its account says that it was sent.
    RouterUntold,
    /// Now and then a packet is published whose checksum is wrong.
    WrongChecksum,
    /// What comes beside damaged bytes is not marked.
    UnmarkedNeighbour,
    /// A scanner that measures hears nothing, not even that it shall stop.
    DeafScanner,
    /// No request for a motor gets through.
    UnturnedHead,
    /// Now and then all points of a turn are a degree beside their places.
    WrongPlaces,
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
    UnseenSubscriber,
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
        Defect::MergedTurn,
        Defect::OtherBeams,
        Defect::StampedOnArrival,
        Defect::UnmarkedTurn,
        Defect::UncountedLoss,
        Defect::RemoteAltered,
        Defect::RemoteHalf,
        Defect::RemoteCountedTwice,
        Defect::RemoteStampedLate,
        Defect::RemoteSurvivingVerdict,
        Defect::RemoteUnchecked,
        Defect::Unannounced,
        Defect::RouterGivenUp,
        Defect::RouterUntold,
        Defect::WrongChecksum,
        Defect::UnmarkedNeighbour,
        Defect::DeafScanner,
        Defect::UnturnedHead,
        Defect::WrongPlaces,
        Defect::KeptWarning,
        Defect::HiddenRate,
        Defect::UnmarkedEstimate,
        Defect::NeedlessEstimate,
        Defect::UnsentWarning,
        Defect::WrongFamily,
        Defect::NeedlessByte,
        Defect::UnseenSubscriber,
        Defect::NeedlessRing,
        Defect::UnsentEvent,
    ];
}

/// What is planted in a world, if anything.
#[derive(Debug, Default)]
pub(crate) struct Planted {
    defect: Option<Defect>,
    chances: Cell<u64>,
}

impl Planted {
    pub(crate) fn new(defect: Option<Defect>) -> Planted {
        Planted { defect, chances: Cell::new(0) }
    }

    /// Whether `defect` is there.
    pub(crate) fn is(&self, defect: Defect) -> bool {
        self.defect == Some(defect)
    }

    /// Whether `defect` shows this time: of so many chances with the last.
    pub(crate) fn strikes(&self, defect: Defect, of: u64) -> bool {
        if !self.is(defect) {
            return false;
        }
        self.chances.set(self.chances.get() + 1);
        self.chances.get().is_multiple_of(of)
    }
}

/// What [`Defect`]s of turns make of scans and of what is counted.
#[derive(Debug, Default)]
pub(crate) struct Spoiler {
    /// The last scan as it was.
    before: Option<Box<Scan>>,
}

impl Spoiler {
    /// Spoils a sample of `topic` that is sent at `now`, if one of these defects is `planted`.
    pub(crate) fn spoil(
        &mut self,
        planted: &Planted,
        (topic, now): (Topic, u64),
        header: &mut Header,
        bytes: &mut Vec<u8>,
    ) {
        if topic == Topic::Status && planted.is(Defect::UncountedLoss) {
            let status: &mut Status = bytemuck::from_bytes_mut(bytes);
            status.counters[Counter::LostOnLine] = 0;
        }
        if topic == Topic::Telegram && planted.strikes(Defect::WrongChecksum, 100) {
            let middle = bytes.len() / 2;
            bytes[middle] ^= 4;
        }
        if planted.is(Defect::UnmarkedNeighbour) {
            (header.reasons, header.quality) = (0, 0);
        }
        if topic == Topic::Telegram && planted.is(Defect::UnmarkedEstimate) {
            header.flags &= !Flags::STAMP_ESTIMATED;
        }
        if topic == Topic::Telegram && planted.is(Defect::NeedlessEstimate) {
            header.flags |= Flags::STAMP_ESTIMATED;
        }
        if topic != Topic::Scan {
            return;
        }
        if planted.strikes(Defect::WrongFamily, 20) {
            header.family = (header.family + 1) % Family::ALL.len() as u8;
        }
        if planted.is(Defect::StampedOnArrival) {
            let late = now.saturating_sub(header.stamp_last_ns + STALE_NS);
            (header.stamp_first_ns, header.stamp_last_ns) =
                (header.stamp_first_ns + late, header.stamp_last_ns + late);
        }
        let mut scan = Scan::of_bytes(bytes);
        if planted.is(Defect::UnmarkedTurn) {
            scan.flags &= !Scan::INCOMPLETE;
        }
        if planted.strikes(Defect::OtherBeams, 100) {
            let head = ScanHead { count: scan.count + 1, ..**scan };
            scan = Scan::zeroed(Scan::len(head.count.into(), head.contents));
            scan.begin(head).ranges.fill(Scan::NOT_MEASURED);
        }
        let before = self.before.replace(scan.clone()).filter(|before| before.beams() == scan.beams());
        if let Some(mut before) = before.filter(|_| planted.strikes(Defect::MergedTurn, 20)) {
            let half = scan.beams() / 2;
            let (into, from) = (scan.arrays(), before.arrays());
            into.ranges[half..].copy_from_slice(&from.ranges[half..]);
            if !into.angles.is_empty() {
                into.angles[half..].copy_from_slice(&from.angles[half..]);
            }
        }
        if planted.strikes(Defect::WrongPlaces, 20) {
            scan.arrays().angles.iter_mut().for_each(|angle| *angle += 1f32.to_radians());
        }
        bytes.clear();
        bytes.extend_from_slice(scan.bytes());
    }

    /// Whether one of these is `planted`.
    pub(crate) fn is_needed(planted: &Planted) -> bool {
        let mine = [
            Defect::MergedTurn,
            Defect::OtherBeams,
            Defect::StampedOnArrival,
            Defect::UnmarkedTurn,
            Defect::UncountedLoss,
            Defect::WrongChecksum,
            Defect::UnmarkedNeighbour,
            Defect::WrongPlaces,
            Defect::UnmarkedEstimate,
            Defect::NeedlessEstimate,
            Defect::WrongFamily,
        ];
        mine.into_iter().any(|defect| planted.is(defect))
    }
}

/// What waited for so long did not come just now.
const STALE_NS: u64 = 100_000_000;

/// A request that writes the EEPROM: 66h, the rate after power-on.
pub(crate) fn eeprom_request() -> Vec<u8> {
    Writer::new(0, 0x66).byte(0x42).finish().bytes().to_vec()
}
