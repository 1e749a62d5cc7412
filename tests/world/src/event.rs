//! Everything that happens in a world, as the judges see it and as its hash has it. Refuses to know what is right.

use scanhub_network::lan::StreamCounters;
use scanhub_network::lan::outgoing;
use scanhub_schema::datagram::{Datagram, DatagramError};
use scanhub_schema::{DoorbellWord, Header, Nanos, Status, Topic, Verdict, Zones};
use scanhub_sim::ld::TruePoint;

use crate::hash::HistoryHash;
use crate::remote::Forgery;
use crate::subscriber::SubscriberId;
use crate::topics::Sample;

/// Something that happened, at a time that is told beside it.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Event<'a> {
    /// Hub number so many begins; its links have these names.
    HubStarted { run: u64, boot: u64 },
    /// It is gone, because it was killed or ended in order.
    HubEnded { run: u64, killed: bool },
    /// The process of the hub does not run until then.
    Stalled { until: Nanos },
    /// The hub opened the line to a sensor, whose port had taken so many bytes before that nobody gets any more.
    PortOpened { sensor: usize, offset: u64 },
    /// The line has no owner any more.
    PortClosed { sensor: usize },
    /// Another sensor is there instead of the one that was.
    ScannerExchanged { sensor: usize },
    /// A scanner whose head turns measured these points.
    Measured { sensor: usize, points: &'a [TruePoint] },
    /// The last byte of a telegram went into the port, or did not.
    Sent { sensor: usize, telegram: &'a Telegram<'a> },
    /// Bytes that were in the port are gone, those from one to the other.
    Flushed { sensor: usize, from: u64, to: u64 },
    /// The port has another rate: what a session knew of bytes before is void.
    RateChanged { sensor: usize },
    /// Another process has set the port to another rate.
    RateAltered { sensor: usize },
    /// The hub has written bytes to the port.
    Written { sensor: usize },
    /// The hub has read so many bytes, up to this one.
    Read { sensor: usize, len: usize, to: u64 },
    /// A sample went to whoever is attached.
    Published { sensor: usize, sample: &'a Sample },
    /// Whoever sleeps at the bell of a sensor for topics of this ring is woken.
    Rung { sensor: usize, ring: DoorbellWord },
    /// The hub sent the event of a sensor, which wakes its listeners.
    Notified { sensor: usize },
    /// A sample got no memory.
    OutOfMemory { sensor: usize, topic: Topic },
    /// A consumer came.
    Attached { subscriber: SubscriberId, sensor: usize, topic: Topic, is_prompt: bool, is_listener: bool },
    /// It took a sample, of which it was told by its number that it missed so many before.
    Taken { subscriber: SubscriberId, sample: &'a Sample, missed: u64 },
    /// A sample fell out of its full queue.
    Dropped { subscriber: SubscriberId, sample: &'a Sample },
    /// It is gone, after it took all that waited, or not.
    Detached { subscriber: SubscriberId, is_drained: bool },
    /// A robot believes this of a sensor's zones from now on.
    VerdictAccepted { sensor: usize, verdict: Verdict },
    /// A gateway begins, as a consumer of the hub's topics.
    GatewayStarted { epoch: u32 },
    /// It is gone.
    GatewayEnded { epoch: u32, is_killed: bool },
    /// It made a datagram, which its sockets took or not.
    Transmitted { datagram: &'a Datagram<'a>, bytes: &'a [u8], is_taken: bool },
    /// A row of the account of a gateway that ends; announcements are of no topic.
    GatewayCounters { sensor: usize, topic: Option<Topic>, row: &'a outgoing::TopicStats },
    /// Somebody else sent this.
    Forged { forgery: Forgery, bytes: &'a [u8] },
    /// A listener begins.
    ListenerStarted { run: u64 },
    /// It took what had come to its machine, which may be a datagram, at some time before.
    Arrived {
        arrived_at: Nanos,
        datagram: Option<&'a Datagram<'a>>,
        bytes: &'a [u8],
        outcome: DatagramOutcome,
    },
    /// A consumer of remote sensors got a sample; the payload is as in a datagram.
    Republished { sensor: usize, topic: Topic, header: &'a Header, payload: &'a [u8] },
    /// A remote robot believes this of a sensor's zones from now on.
    RemoteVerdictAccepted { sensor: usize, verdict: Verdict },
    /// A row of the account of a listener that ends.
    ListenerCounters { row: &'a StreamCounters },
    /// It is gone: what it refused, the lives of gateways that it gave up, and how many sensors it published.
    ListenerEnded { run: u64, refused: u64, evicted: u64, sensors: usize },
    /// An action.
    ActionTaken { text: &'a str },
    /// From now on nothing goes wrong.
    FaultsCleared,
    /// It is over, and the last hub has ended.
    WorldEnded { eeprom_writes: u64, handles: usize, loans: usize, held: usize },
}

/// What a listener makes of what came.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum DatagramOutcome {
    /// It is refused.
    Refused(DatagramError),
    /// A part of a sample that is not whole yet.
    Part,
    /// It came before, or is an announcement that a newer one overtook.
    Duplicate,
    /// An announcement.
    Announcement,
    /// A sample, before all newer ones or not.
    Sample { late: bool },
}

/// A telegram that left a sensor.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Telegram<'a> {
    /// As it should have been.
    pub(crate) bytes: &'a [u8],
    /// Place of its first byte, and of the one behind its last, among all bytes that went into the port.
    pub(crate) span: (u64, u64),
    /// Time at which its first bytes went into the port, and its baud rate.
    pub(crate) first_at: Nanos,
    pub(crate) rate: u32,
    /// Why it did not go into the port as it should have been.
    pub(crate) damage: Option<&'static str>,
    /// The sensor did not send all of it.
    pub(crate) aborted: bool,
    /// It is a reply, and no measured values.
    pub(crate) is_reply: bool,
}

/// How much of what happens is told to standard error.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Detail {
    /// Nothing.
    Nothing,
    /// What does not happen with each telegram.
    Rare,
    /// Verdicts, too.
    All,
}

/// What the turns of heads were like that the judges of turns saw.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RevolutionFigures {
    /// Scans, and those that were marked because packets of them are missing.
    pub scans: u64,
    /// See above.
    pub incomplete: u64,
    /// Points that were found among the true ones.
    pub points: u64,
    /// How far the exact angle of one was off at most, in degrees.
    pub angle_deg: f64,
    /// How far its range was off at most, in millimetres.
    pub range_mm: f64,
    /// How far the stamp of a scan was off at most, of those that are judged.
    pub stamp_ns: Nanos,
    /// By how much the time between two of them was another one than that which passed, at most.
    pub uneven_ns: Nanos,
    /// Points of scans without any mark that are more than 5 cm from everything that was measured.
    pub wrong: u64,
    /// Packets that a hub counted as lost on the line.
    pub lost: u64,
    /// When a hub had the first packet of measured values, and the first scan; what a scanner waited for its motor not
    /// counted.
    pub data_ns: Nanos,
    /// See above.
    pub scan_ns: Nanos,
}

impl RevolutionFigures {
    /// Takes over what is worse in `other`, and adds what it counts.
    pub fn add(&mut self, other: &RevolutionFigures) {
        self.scans += other.scans;
        self.incomplete += other.incomplete;
        self.points += other.points;
        self.angle_deg = self.angle_deg.max(other.angle_deg);
        self.range_mm = self.range_mm.max(other.range_mm);
        self.stamp_ns = self.stamp_ns.max(other.stamp_ns);
        self.uneven_ns = self.uneven_ns.max(other.uneven_ns);
        self.wrong += other.wrong;
        self.lost += other.lost;
        self.data_ns = self.data_ns.max(other.data_ns);
        self.scan_ns = self.scan_ns.max(other.scan_ns);
    }
}

/// What a judge says.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Violation {
    /// The judge.
    pub invariant: &'static str,
    /// When, in virtual nanoseconds.
    pub at_ns: Nanos,
    /// What is not as it should be.
    pub message: String,
}

impl std::fmt::Display for Violation {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{:.3} s, {}: {}", self.at_ns as f64 / 1e9, self.invariant, self.message)
    }
}

impl Event<'_> {
    /// Takes it into the hash of everything.
    pub(crate) fn hash(&self, at: Nanos, history: &mut HistoryHash) {
        // The hash contains the replies of the scanner.
        if matches!(self, Event::Written { .. }) {
            return;
        }
        history.add_number(at);
        let mut numbers = |numbers: &[u64]| numbers.iter().for_each(|&number| history.add_number(number));
        match *self {
            Event::HubStarted { run, boot } => numbers(&[1, run, boot]),
            Event::HubEnded { run, killed } => numbers(&[2, run, killed.into()]),
            Event::Stalled { until } => numbers(&[3, until]),
            Event::PortOpened { sensor, offset } => numbers(&[4, sensor as u64, offset]),
            Event::PortClosed { sensor } => numbers(&[5, sensor as u64]),
            Event::ScannerExchanged { sensor } => numbers(&[20, sensor as u64]),
            Event::Sent { sensor, telegram } => {
                numbers(&[6, sensor as u64, telegram.span.0, telegram.span.1, telegram.aborted.into()]);
                history.add_bytes(telegram.bytes);
            }
            Event::Flushed { sensor, from, to } => numbers(&[7, sensor as u64, from, to]),
            Event::RateChanged { sensor } => numbers(&[8, sensor as u64]),
            Event::RateAltered { sensor } => numbers(&[31, sensor as u64]),
            Event::Read { sensor, to, .. } => numbers(&[9, sensor as u64, to]),
            Event::Published { sensor, sample } => {
                numbers(&[10, sensor as u64, sample.topic as u64]);
                // The process is another one in each run.
                history.add_bytes(bytemuck::bytes_of(&Header { hub_pid: 0, ..sample.header }));
                history.add_bytes(&sample.bytes);
            }
            // What it tells of them is hashed.
            Event::Measured { .. } | Event::Written { .. } => {}
            Event::Rung { sensor, ring } => numbers(&[29, sensor as u64, ring as u64]),
            Event::Notified { sensor } => numbers(&[32, sensor as u64]),
            Event::OutOfMemory { sensor, topic } => numbers(&[11, sensor as u64, topic as u64]),
            Event::Attached { subscriber, sensor, topic, .. } => {
                numbers(&[12, subscriber.0.into(), sensor as u64, topic as u64]);
            }
            Event::Taken { subscriber, sample, missed } => {
                numbers(&[13, subscriber.0.into(), sample.header.topic_seq, missed]);
            }
            Event::Dropped { subscriber, sample } => {
                numbers(&[14, subscriber.0.into(), sample.header.topic_seq]);
            }
            Event::Detached { subscriber, is_drained } => {
                numbers(&[15, subscriber.0.into(), is_drained.into()])
            }
            Event::VerdictAccepted { sensor, verdict } => numbers(&[16, sensor as u64, verdict as u64]),
            Event::ActionTaken { text } => history.add_bytes(text.as_bytes()),
            Event::FaultsCleared => numbers(&[18]),
            Event::WorldEnded { eeprom_writes, handles, loans, held } => {
                numbers(&[19, eeprom_writes, handles as u64, loans as u64, held as u64]);
            }
            Event::GatewayStarted { epoch } => numbers(&[20, epoch.into()]),
            Event::GatewayEnded { epoch, is_killed } => numbers(&[21, epoch.into(), is_killed.into()]),
            Event::Transmitted { bytes, is_taken, .. } => {
                numbers(&[22, is_taken.into()]);
                history.add_bytes(bytes);
            }
            Event::Forged { forgery, bytes } => {
                numbers(&[30, forgery as u64]);
                history.add_bytes(bytes);
            }
            Event::ListenerStarted { run } => numbers(&[23, run]),
            Event::Arrived { arrived_at, bytes, outcome, .. } => {
                numbers(&[24, arrived_at, bytes.len() as u64, outcome.verdict_number()])
            }
            Event::Republished { sensor, topic, header, payload } => {
                numbers(&[25, sensor as u64, topic as u64]);
                history.add_bytes(bytemuck::bytes_of(header));
                history.add_bytes(payload);
            }
            Event::RemoteVerdictAccepted { sensor, verdict } => numbers(&[26, sensor as u64, verdict as u64]),
            Event::ListenerCounters { row } => {
                numbers(&[27, row.epoch.into(), row.sensor.into(), row.topic.into()]);
                numbers(&[row.received, row.lost(), row.duplicate, row.reordered]);
            }
            // It follows from all that is told of before.
            Event::GatewayCounters { .. } => {}
            Event::ListenerEnded { run, refused, evicted: given_up, sensors } => {
                numbers(&[28, run, refused, given_up, sensors as u64]);
            }
        }
    }

    /// What to say of it to whoever wants to see so much of it.
    pub(crate) fn describe(&self, detail: Detail) -> Option<String> {
        match self {
            Event::Sent {
                telegram: Telegram { damage: None, aborted: false, is_reply: false, .. }, ..
            } => None,
            Event::Sent { sensor, telegram } => {
                let Telegram { bytes, span, damage, aborted, .. } = telegram;
                Some(format!("{sensor} sent {:02X?} {span:?} {damage:?} aborted {aborted}", prefix(bytes)))
            }
            Event::Published { sensor, sample } => {
                let Sample { topic, header, bytes, .. } = sample;
                match topic {
                    Topic::Zones if detail == Detail::All => {
                        let zones: Zones = bytemuck::pod_read_unaligned(bytes);
                        let Header { seq, stamp_last_ns, flags, reasons, .. } = header;
                        let (verdict, ms) = (zones.verdict(), stamp_last_ns / 1_000_000);
                        Some(format!(
                            "{sensor} zones {verdict:?} seq {seq} of {ms} ms, flags {flags} reasons {reasons}"
                        ))
                    }
                    Topic::Status => {
                        let status: Status = bytemuck::pod_read_unaligned(bytes);
                        let (state, error) = (status.state()?.name(), status.last_error());
                        Some(format!("{sensor} status {state} {} {error}", status.baud))
                    }
                    Topic::Telegram if header.reasons != 0 => {
                        let Header { seq, reasons, .. } = header;
                        Some(format!("{sensor} published {:02X?} seq {seq} reasons {reasons}", prefix(bytes)))
                    }
                    _ => None,
                }
            }
            Event::Taken { .. } | Event::Read { .. } | Event::Dropped { .. } | Event::OutOfMemory { .. } => {
                None
            }
            Event::Rung { .. } | Event::Notified { .. } => None,
            Event::Measured { .. } | Event::Written { .. } => None,
            Event::Transmitted { .. } | Event::Republished { .. } | Event::ListenerCounters { .. } => None,
            Event::GatewayCounters { .. } => None,
            Event::Forged { forgery, .. } => Some(format!("forged: {forgery:?}")),
            Event::Arrived { outcome: DatagramOutcome::Refused(why), .. } => {
                Some(format!("refused: {why:?}"))
            }
            Event::Arrived { .. } => None,
            other => Some(format!("{other:?}")),
        }
    }
}

/// Enough to know what it is.
fn prefix(bytes: &[u8]) -> &[u8] {
    &bytes[..bytes.len().min(8)]
}

impl DatagramOutcome {
    fn verdict_number(self) -> u64 {
        match self {
            DatagramOutcome::Refused(why) => 10 + why as u64,
            DatagramOutcome::Duplicate => 0,
            DatagramOutcome::Part => 4,
            DatagramOutcome::Announcement => 1,
            DatagramOutcome::Sample { late } => 2 + u64::from(late),
        }
    }
}
