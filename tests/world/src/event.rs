//! Events of a world. Every invariant and the history hash receive every event.

use scanhub_network::lan::StreamCounters;
use scanhub_network::lan::outgoing;
use scanhub_schema::datagram::{Datagram, DatagramError};
use scanhub_schema::{DoorbellWord, Header, Nanos, Status, Topic, Verdict, Zones};
use scanhub_sim::ld::TruePoint;

use crate::hash::HistoryHash;
use crate::remote::Forgery;
use crate::subscriber::SubscriberId;
use crate::topics::Sample;

/// An event of a world. The time of the event is passed separately.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Event<'a> {
    /// The hub has started with the boot ID `boot`, as run number `run`.
    HubStarted { run: u64, boot: u64 },
    /// The hub was killed, or it ended in an orderly way.
    HubEnded { run: u64, killed: bool },
    /// The process of the hub is stopped until the time `until`.
    Stalled { until: Nanos },
    /// The hub has opened the line to a sensor. The `offset` bytes that the port had received before are lost.
    PortOpened { sensor: usize, offset: u64 },
    /// No hub has the line open any more.
    PortClosed { sensor: usize },
    /// Another scanner is connected to the line.
    ScannerExchanged { sensor: usize },
    /// A rotating scanner has measured these points.
    Measured { sensor: usize, points: &'a [TruePoint] },
    /// The last byte of a telegram has arrived at the port, or was lost on the way.
    Sent { sensor: usize, telegram: &'a Telegram<'a> },
    /// The port has discarded the bytes in its buffer from position `from` up to position `to`.
    Flushed { sensor: usize, from: u64, to: u64 },
    /// The hub has changed the rate of the port. Results that a session has derived from earlier bytes are no longer
    /// valid.
    RateChanged { sensor: usize },
    /// Another process has set the port to another rate.
    RateAltered { sensor: usize },
    /// The hub has written bytes to the port.
    Written { sensor: usize },
    /// The hub has read `len` bytes. `to` is the position after the last of them.
    Read { sensor: usize, len: usize, to: u64 },
    /// A sample was sent to all attached subscribers.
    Published { sensor: usize, sample: &'a Sample },
    /// The hub rang the doorbell of a sensor for the subscribers of the word `ring`.
    Rung { sensor: usize, ring: DoorbellWord },
    /// The hub sent the event of a sensor, which wakes its listeners.
    Notified { sensor: usize },
    /// There was no memory for a sample.
    OutOfMemory { sensor: usize, topic: Topic },
    /// A subscriber has attached.
    Attached { subscriber: SubscriberId, sensor: usize, topic: Topic, is_prompt: bool, is_listener: bool },
    /// A subscriber took a sample. The sequence number shows that the subscriber missed `missed` samples before it.
    Taken { subscriber: SubscriberId, sample: &'a Sample, missed: u64 },
    /// A sample was dropped from a subscriber's queue, because the queue was full.
    Dropped { subscriber: SubscriberId, sample: &'a Sample },
    /// A subscriber has left or was killed. If `is_drained`, it had taken all samples before.
    Detached { subscriber: SubscriberId, is_drained: bool },
    /// A robot accepts this verdict on a sensor's zones from now on.
    VerdictAccepted { sensor: usize, verdict: Verdict },
    /// A gateway has started, as a subscriber of the hub's topics.
    GatewayStarted { epoch: u32 },
    /// A gateway has ended.
    GatewayEnded { epoch: u32, is_killed: bool },
    /// A gateway sent a datagram. Its sockets accepted the datagram if `is_taken`.
    Transmitted { datagram: &'a Datagram<'a>, bytes: &'a [u8], is_taken: bool },
    /// A row of the counters of a gateway that ends. The row that counts announcements has no topic.
    GatewayCounters { sensor: usize, topic: Option<Topic>, row: &'a outgoing::TopicStats },
    /// A sender other than the gateway sent these bytes.
    Forged { forgery: Forgery, bytes: &'a [u8] },
    /// A listener has started.
    ListenerStarted { run: u64 },
    /// A listener took a message that had arrived at its machine at `arrived_at`. `datagram` is `None` if the message
    /// is not a datagram.
    Arrived {
        arrived_at: Nanos,
        datagram: Option<&'a Datagram<'a>>,
        bytes: &'a [u8],
        outcome: DatagramOutcome,
    },
    /// A subscriber of a remote sensor received a sample. The payload is encoded as in a datagram.
    Republished { sensor: usize, topic: Topic, header: &'a Header, payload: &'a [u8] },
    /// A remote robot accepts this verdict on a sensor's zones from now on.
    RemoteVerdictAccepted { sensor: usize, verdict: Verdict },
    /// A row of the counters of a listener that ends.
    ListenerCounters { row: &'a StreamCounters },
    /// A listener has ended. It refused `refused` datagrams, evicted `evicted` runs of gateways and published `sensors`
    /// sensors.
    ListenerEnded { run: u64, refused: u64, evicted: u64, sensors: usize },
    /// An action, as text.
    ActionTaken { text: &'a str },
    /// All faults are cleared, and no further faults follow.
    FaultsCleared,
    /// The world is at its end, and its last hub has ended. The numbers count EEPROM writes, open lines, unused loans
    /// and held samples.
    WorldEnded { eeprom_writes: u64, handles: usize, loans: usize, held: usize },
}

/// Result of a message that a listener took.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum DatagramOutcome {
    /// The listener refuses the datagram.
    Refused(DatagramError),
    /// A part of a sample that is not complete yet.
    Part,
    /// The datagram has arrived before, or it is an announcement and a newer announcement has arrived.
    Duplicate,
    /// An announcement.
    Announcement,
    /// A complete sample. The sample is `late` if a newer sample was complete before it.
    Sample { late: bool },
}

/// A telegram or packet that a scanner sent.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Telegram<'a> {
    /// The bytes as the scanner sent them.
    pub(crate) bytes: &'a [u8],
    /// Position of the first byte and position after the last byte, counted over all bytes that arrived at the port.
    pub(crate) span: (u64, u64),
    /// Time at which the first bytes arrived at the port, and baud rate of the scanner.
    pub(crate) first_at: Nanos,
    pub(crate) rate: u32,
    /// Reason why the bytes did not arrive as they were sent.
    pub(crate) damage: Option<&'static str>,
    /// Whether the scanner stopped before it had sent the whole telegram.
    pub(crate) aborted: bool,
    /// Whether the telegram is a reply, which has no measured values.
    pub(crate) is_reply: bool,
}

/// Selection of the events that a world prints to standard error.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Detail {
    /// Nothing.
    Nothing,
    /// Events that do not occur with every telegram.
    Rare,
    /// The rare events, and all verdicts.
    All,
}

/// Figures of all revolutions that the invariant `turns` checked.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RevolutionFigures {
    /// Number of scans.
    pub scans: u64,
    /// Number of scans that the hub marked as incomplete because packets are missing.
    pub incomplete: u64,
    /// Number of reported points for which a measured point was found.
    pub points: u64,
    /// Largest error of an angle, in degrees.
    pub angle_deg: f64,
    /// Largest error of a range, in millimeters.
    pub range_mm: f64,
    /// Largest error of a scan's stamp, among scans whose stamps must be right.
    pub stamp_ns: Nanos,
    /// Largest error of the time between two consecutive scans, calculated from their stamps.
    pub uneven_ns: Nanos,
    /// Number of points that are more than 5 cm from every measured point, in scans that the hub did not mark.
    pub wrong: u64,
    /// Number of packets that the hub counted as lost on the line.
    pub lost: u64,
    /// Time until the hub had the first packet of measured values, without the time for which the scanner waited for
    /// its motor.
    pub data_ns: Nanos,
    /// Time until the hub published the first scan, without the time for which the scanner waited for its motor.
    pub scan_ns: Nanos,
}

impl RevolutionFigures {
    /// Adds the counts of `other`. For errors and times, takes the larger of the two values.
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

/// A violation of an invariant.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Violation {
    /// Name of the invariant.
    pub invariant: &'static str,
    /// Time of the violation, in virtual nanoseconds.
    pub at_ns: Nanos,
    /// Description of the violation.
    pub message: String,
}

impl std::fmt::Display for Violation {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{:.3} s, {}: {}", self.at_ns as f64 / 1e9, self.invariant, self.message)
    }
}

impl Event<'_> {
    /// Adds the event to the history hash.
    pub(crate) fn hash(&self, at: Nanos, history: &mut HistoryHash) {
        // The hash does not need the written bytes, because it contains the scanner's replies.
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
                // The process ID differs from run to run.
                history.add_bytes(bytemuck::bytes_of(&Header { hub_pid: 0, ..sample.header }));
                history.add_bytes(&sample.bytes);
            }
            // The hash does not need the points, because it contains the packets with these points.
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
            // The hash does not need the counters, because they follow from events in the hash.
            Event::GatewayCounters { .. } => {}
            Event::ListenerEnded { run, refused, evicted: given_up, sensors } => {
                numbers(&[28, run, refused, given_up, sensors as u64]);
            }
        }
    }

    /// Returns the line to print for the event, or `None` if `detail` excludes the event.
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

/// Returns a prefix of the bytes that is long enough to recognize a telegram.
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
