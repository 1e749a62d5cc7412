//! One remote sensor: the numbers and periods of its topics, and the state that it publishes while nothing arrives.

use scanhub_schema::datagram::{Announce, DatagramPayload, Head, MTU_ETHERNET};
use scanhub_schema::{Failure, Header, State, Status, Topic, WakeEvent, Zones};

use super::SensorTopics;
use crate::lan::WallTimestamp;
use crate::lan::gateways::{Arrival, EvictionRank};
use crate::lan::incoming::{CheckedPayload, ReceivedSample};

/// A sensor of another machine.
pub(super) struct RemoteSensor<T: SensorTopics> {
    /// Name in this domain, `HUB.SENSOR`.
    pub(super) name: String,
    /// Gateway, its epoch, and the sensor's number, as last announced.
    source: Option<(u64, u32, u8)>,
    /// Bit n is set if the last announcement contains topic number n.
    announced: u64,
    /// Rank by which sensors are compared if one of them must be evicted to make room for another.
    pub(super) rank: EvictionRank,
    /// Whether it was reported that all announced topics exist.
    pub(super) is_reported: bool,
    /// Numbers and period of each topic; `None` for a topic that does not exist.
    streams: [Option<Stream>; Topic::ALL.len()],
    /// Last status with its header.
    last_status: Option<(Status, Header)>,
    /// Header of the last zones.
    last_zones: Option<Header>,
    /// Time of the last sample, in ns of CLOCK_MONOTONIC; `None` while the sensor is silent.
    last_sample_ns: Option<u64>,
    /// Event with which subscribers must be woken; `None` if nothing was published since they were woken last.
    pending_wake: Option<WakeEvent>,
    /// ID of the process that publishes the sensor.
    pid: u32,
    topics: T,
}

/// Outcome of publishing a sample.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Outcome {
    /// The sample was published.
    Published,
    /// The sensor has no such topic.
    NoTopic,
    /// The memory that remote sensors may use has no room for so long a sample.
    NoRoom,
}

/// Time without a sample after which the sensor counts as silent, in ns: three times the interval of announcements.
const SILENT_AFTER_NS: u64 = 3_000_000_000;

impl<T: SensorTopics> RemoteSensor<T> {
    /// Creates the sensor `name`, which process `pid` publishes. It has no `topics` yet.
    pub(super) fn new(name: &str, topics: T, pid: u32) -> RemoteSensor<T> {
        RemoteSensor {
            name: name.to_owned(),
            source: None,
            announced: 0,
            rank: EvictionRank::NONE,
            is_reported: false,
            streams: [const { None }; Topic::ALL.len()],
            last_status: None,
            last_zones: None,
            last_sample_ns: None,
            pending_wake: None,
            pid,
            topics,
        }
    }

    /// Returns whether the topic exists.
    pub(super) fn has_topic(&self, topic: Topic) -> bool {
        self.streams[topic as usize].is_some()
    }

    /// Creates `topic`, which does not exist.
    pub(super) fn add(&mut self, topic: Topic) -> Result<(), Failure> {
        self.topics.add(topic)?;
        self.streams[topic as usize] = Some(Stream::default());
        Ok(())
    }

    /// Removes `topic`.
    pub(super) fn remove(&mut self, topic: Topic) {
        self.topics.remove(topic);
        self.streams[topic as usize] = None;
    }

    /// Records `announce` with `head`, which belongs to this sensor.
    pub(super) fn on_announcement(&mut self, head: &Head, announce: &Announce, arrival: Arrival) {
        self.rank.take(arrival);
        self.source = Some((head.hub, head.epoch, head.sensor));
        let numbers = announce.topics().iter().map(|announced| announced.topic).filter(|number| *number < 64);
        self.announced = numbers.fold(0, |bits, number| bits | 1 << number);
    }

    /// Publishes that the sensor is silent, because its number or its room belongs to another sensor from now on.
    pub(super) fn retire(&mut self, now: WallTimestamp) {
        self.source = None;
        self.last_sample_ns = None;
        if let Some(header) = self.last_zones.take().filter(|_| self.has_topic(Topic::Zones)) {
            self.send(Topic::Zones, &stamped(header, now), &Zones::unknown());
            self.pending_wake = Some(WakeEvent::Telegram);
        }
        self.publish_silence(now);
        self.wake();
    }

    /// Returns whether the sensor's gateway announces this topic.
    pub(super) fn is_announced(&self, topic: Topic) -> bool {
        self.announced >> topic.number() & 1 == 1
    }

    /// Returns whether this sensor sent `head`.
    pub(super) fn has_sent(&self, head: &Head) -> bool {
        self.source == Some((head.hub, head.epoch, head.sensor))
    }

    /// Returns whether the sensor belongs to this gateway and epoch.
    pub(super) fn belongs_to(&self, hub: u64, epoch: u32) -> bool {
        self.source.is_some_and(|source| (source.0, source.1) == (hub, epoch))
    }

    /// Publishes `remote` if the sensor has the topic and room for the sample.
    pub(super) fn publish(&mut self, remote: &ReceivedSample<'_>) -> Outcome {
        self.last_sample_ns = Some(remote.arrival_ns);
        self.rank.take(Arrival { is_sample: true, now_ns: remote.arrival_ns });
        let topic = remote.topic;
        let Some(stream) = &mut self.streams[topic as usize] else { return Outcome::NoTopic };
        // The number of this sample is skipped later, before the next sample that fits.
        if !self.topics.fits(topic, remote.payload) {
            return Outcome::NoRoom;
        }
        let LocalNumber { skip_count, header } = stream.assign_number(remote, self.pid);
        self.topics.skip(topic, skip_count);
        if topic != Topic::Status {
            self.topics.send(topic, &header, remote.payload);
        } else if let Some(status) = remote.payload.unpack::<Status>() {
            self.publish_status(*status, &header);
        }
        if topic == Topic::Zones {
            self.last_zones = Some(remote.header(self.pid));
        }
        let event = if topic == Topic::Status { WakeEvent::Status } else { WakeEvent::Telegram };
        self.pending_wake = match self.pending_wake {
            Some(WakeEvent::Telegram) => Some(WakeEvent::Telegram),
            _ => Some(event),
        };
        Outcome::Published
    }

    /// Wakes the subscribers if something was published since the last call.
    pub(super) fn wake(&mut self) {
        if let Some(event) = self.pending_wake.take() {
            self.topics.wake(event);
        }
    }

    /// Publishes that the sensor is silent, once per silence, if it was silent at `read`. Sends the history to late
    /// joiners.
    pub(super) fn do_periodic_work(&mut self, read: WallTimestamp) {
        if self.last_sample_ns.is_some_and(|at_ns| read.monotonic_ns.saturating_sub(at_ns) >= SILENT_AFTER_NS)
        {
            self.last_sample_ns = None;
            self.publish_silence(read);
            self.wake();
        }
        let keeps = |topic: &Topic| topic.spec().history_len > 0 && self.has_topic(*topic);
        Topic::ALL.into_iter().filter(keeps).for_each(|topic| self.topics.connect(topic));
    }

    /// Returns the number of samples for which there was no memory.
    pub(super) fn failed(&self) -> u64 {
        self.topics.failed()
    }

    /// Publishes a received status. The time at which its state began comes from another machine's clock. It is
    /// replaced by the time at which this machine first received the state.
    fn publish_status(&mut self, mut status: Status, header: &Header) {
        let same = self.last_status.filter(|(last, _)| last.state == status.state);
        status.since_ns = same.map_or(header.stamp_first_ns, |(last, _)| last.since_ns);
        self.last_status = Some((status, *header));
        if self.has_topic(Topic::Status) {
            self.send(Topic::Status, header, &status);
        }
    }

    /// Publishes that the sensor is silent, because its last status would otherwise remain forever.
    fn publish_silence(&mut self, now: WallTimestamp) {
        let Some((mut status, header)) = self.last_status else { return };
        status.state = State::Silent as u8;
        status.rate_mhz = 0;
        status.set_last_error("nothing arrives over the network");
        if self.has_topic(Topic::Status) {
            self.publish_status(status, &stamped(header, now));
            self.pending_wake = self.pending_wake.or(Some(WakeEvent::Status));
        }
    }

    /// Publishes a payload that this process has created or changed.
    fn send(&mut self, topic: Topic, header: &Header, payload: &impl DatagramPayload) {
        let mut room = [0; MTU_ETHERNET];
        let Some(len) = payload.pack(&mut room) else { return };
        let payload = CheckedPayload { bytes: &room[..len], room: len };
        self.topics.send(topic, header, payload);
    }
}

/// Returns `header` with `now` as its stamps, for a sample that was not received.
fn stamped(header: Header, now: WallTimestamp) -> Header {
    let WallTimestamp { monotonic_ns, wall_ns } = now;
    Header { stamp_first_ns: monotonic_ns, stamp_last_ns: monotonic_ns, wall_ns, ..header }
}

/// Numbers and period of one topic. The numbers continue over runs of the gateway, so that subscribers see what the
/// network lost.
#[derive(Default)]
struct Stream {
    /// Epoch, sensor's number and sequence number of the last sample. The first sample after a start of the listener is
    /// published under the sequence number of its datagram. Subscribers that outlive a listener therefore see what was
    /// lost in between.
    last: Option<(u32, u8, u32)>,
    period_estimator: PeriodEstimator,
}

/// Number and header of a sample in this domain.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct LocalNumber {
    /// Count of numbers of the topic that are skipped before this sample, because their samples are missing.
    skip_count: u64,
    /// Header with the estimated period, and without the number in the topic.
    header: Header,
}

impl Stream {
    /// Assigns the next number of the topic to `remote`, which is not late and is published by process `pid`. The
    /// numbers between the last sample and `remote` are skipped, whether their samples were lost or not published. In a
    /// new run of the gateway, all numbers before `remote` are skipped. If the sensor's number in the hub has changed,
    /// none is skipped, because the numbers in between may belong to another sensor.
    fn assign_number(&mut self, remote: &ReceivedSample<'_>, pid: u32) -> LocalNumber {
        let head = &remote.head;
        let next = (head.epoch, head.sensor, head.sequence);
        let steps = self.last.and_then(|last| steps(last, next));
        let skip_count = match (steps, self.last) {
            (Some(steps), _) => steps.wrapping_sub(1),
            (None, Some((epoch, ..))) if head.epoch == epoch => 0,
            (None, _) => head.sequence,
        };
        self.last = Some(next);
        let period_us = self.period_estimator.period_us(remote.arrival_ns, steps.unwrap_or_default().into());
        LocalNumber { skip_count: skip_count.into(), header: Header { period_us, ..remote.header(pid) } }
    }
}

/// Returns by how much `next` is ahead of `last`, each with its epoch and the sensor's number. `None` if they belong to
/// different sequences. Late samples are not published, so a lower number belongs to a sender that replaced a silent
/// one.
fn steps(last: (u32, u8, u32), next: (u32, u8, u32)) -> Option<u32> {
    let steps = next.2.wrapping_sub(last.2);
    ((next.0, next.1) == (last.0, last.1) && steps <= u32::MAX / 2).then_some(steps)
}

/// Estimator of the period at which samples of a topic are sent. A gateway may thin out samples, and its datagrams do
/// not contain the thinning factor.
#[derive(Default)]
struct PeriodEstimator {
    last_ns: Option<u64>,
    /// Times between consecutive samples as they were sent, in ns; the last few of them.
    distances_ns: [u64; MEDIAN_SAMPLES],
    count: usize,
}

/// Number of times between samples whose median is the period. Two gaps and a burst among them do not change the
/// median.
const MEDIAN_SAMPLES: usize = 5;

/// Maximum period, in ns. A longer time between samples is a silence, and a verdict of that age is useless.
const MAX_PERIOD_NS: u64 = 2_500_000_000;

impl PeriodEstimator {
    /// Records a sample that arrived at `now_ns`, `steps` numbers after the last one; 0 if that is unknown. Returns the
    /// period in us, or 0 while it is unknown. The period is the median of the last times between samples, and of two
    /// middle ones the shorter. Lost samples do not extend the period, because a verdict would otherwise be valid for
    /// longer on a bad link than on a good one.
    fn period_us(&mut self, now_ns: u64, steps: u64) -> u32 {
        let before_ns = self.last_ns.replace(now_ns);
        let distance_ns = before_ns.and_then(|before_ns| now_ns.checked_sub(before_ns)?.checked_div(steps));
        if let Some(distance_ns) = distance_ns.filter(|distance_ns| *distance_ns <= MAX_PERIOD_NS) {
            self.distances_ns[self.count % MEDIAN_SAMPLES] = distance_ns;
            self.count += 1;
        }
        let mut known = self.distances_ns;
        let known = &mut known[..self.count.min(MEDIAN_SAMPLES)];
        known.sort_unstable();
        let median_ns = known.get(known.len().saturating_sub(1) / 2);
        median_ns.map_or(0, |median_ns| (median_ns / 1000) as u32)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    use scanhub_schema::datagram::{Datagram, HEADER_LEN};

    /// Published statuses of a sensor: the state, the stamp, and the start of the state, both in ms.
    #[derive(Default)]
    struct StatusLog(Vec<(Option<State>, u64, u64)>);

    impl SensorTopics for StatusLog {
        fn add(&mut self, _: Topic) -> Result<(), Failure> {
            Ok(())
        }

        fn remove(&mut self, _: Topic) {}

        fn skip(&mut self, _: Topic, _: u64) {}

        fn send(&mut self, _: Topic, header: &Header, payload: CheckedPayload<'_>) {
            let mut status = Status::default();
            assert!(status.unpack(payload.bytes));
            self.0.push((status.state(), header.stamp_last_ns / MS, status.since_ns / MS));
        }

        fn connect(&self, _: Topic) {}

        fn wake(&self, _: WakeEvent) {}

        fn failed(&self) -> u64 {
            0
        }
    }

    const MS: u64 = 1_000_000;

    #[test]
    fn reports_silence_as_of_the_last_read() {
        let mut sensor = RemoteSensor::new("robot1.front", StatusLog::default(), 1);
        sensor.add(Topic::Status).unwrap();
        let mut bytes = [0; MTU_ETHERNET];
        let status = Status { state: State::Streaming as u8, ..Status::default() };
        let len = status.pack(&mut bytes[HEADER_LEN..]).unwrap();
        let head = Head { topic: Topic::Status.number(), revision: 1, hub: 5, epoch: 1, ..Head::default() };
        let datagram = Datagram::read(head.seal(&mut bytes, len).unwrap()).unwrap();
        let arrived = |ms| ReceivedSample {
            topic: Topic::Status,
            head: datagram.head,
            payload: CheckedPayload { bytes: datagram.payload, room: len },
            boot: 1,
            arrival_ns: ms * MS,
            age_ns: None,
            late: false,
            authenticated: false,
        };
        let read = |ms| WallTimestamp { monotonic_ns: ms * MS, wall_ns: ms * MS };
        assert_eq!(sensor.publish(&arrived(1_000)), Outcome::Published);
        // The listener lags. It reads the sample that arrived at 4.6 s only after these calls.
        [3_999, 4_500, 4_550].into_iter().for_each(|ms| sensor.do_periodic_work(read(ms)));
        assert_eq!(sensor.publish(&arrived(4_600)), Outcome::Published);
        sensor.do_periodic_work(read(5_000));
        let (streams, silent) = (Some(State::Streaming), Some(State::Silent));
        assert_eq!(
            sensor.topics.0,
            [(streams, 1_000, 1_000), (silent, 4_500, 4_500), (streams, 4_600, 4_600)]
        );
    }

    #[test]
    fn restarted_numbers_are_another_sequence() {
        assert_eq!(steps((1, 0, 100), (1, 0, 103)), Some(3));
        assert_eq!(steps((1, 0, u32::MAX), (1, 0, 1)), Some(2));
        assert_eq!(steps((1, 0, 100), (1, 0, 20)), None);
        assert_eq!(steps((1, 0, 100), (2, 0, 103)), None);
        assert_eq!(steps((1, 0, 100), (1, 1, 103)), None);
    }

    use scanhub_client::clock::Timestamp;
    use scanhub_client::streams::StalenessTimer;
    use scanhub_schema::{Flags, Header, Verdict};

    fn periods_ms(arrivals_ms: &[u64]) -> Vec<u32> {
        let mut arrivals = PeriodEstimator::default();
        arrivals_ms.iter().map(|at_ms| arrivals.period_us(at_ms * MS, 1) / 1000).collect()
    }

    #[test]
    fn period_is_the_median_of_the_last_distances() {
        assert_eq!(periods_ms(&[100, 600, 1600, 2100, 2600]), [0, 500, 500, 500, 500]);
        // Lost samples, and a burst of samples that waited.
        assert_eq!(
            periods_ms(&[0, 100, 200, 500, 600, 901, 902, 903]),
            [0, 100, 100, 100, 100, 100, 100, 100]
        );
        // After 100 ms, samples are thinned. Three of the longer times change the median.
        assert_eq!(periods_ms(&[0, 20, 40, 60, 80, 100, 1100, 2100, 3100]).split_off(6), [20, 20, 1000]);
    }

    #[test]
    fn lost_samples_do_not_extend_the_period() {
        let mut arrivals = PeriodEstimator::default();
        let mut arrive = |at_ms: u64, steps| arrivals.period_us(at_ms * MS, steps) / 1000;
        assert_eq!([arrive(0, 1), arrive(20, 1), arrive(2_020, 100), arrive(4_020, 100)], [0, 20, 20, 20]);
        assert_eq!(arrive(64_020, 3_000), 20, "no samples for a minute");
        // In another run of the gateway, the number of samples in between is unknown.
        assert_eq!([arrive(65_020, 0), arrive(65_040, 1), arrive(65_060, 1)], [20, 20, 20]);
    }

    #[test]
    fn silence_does_not_count_as_a_period() {
        assert_eq!(periods_ms(&[0, 90_000, 90_020, 190_000, 190_020]), [0, 0, 20, 20, 20]);
        assert_eq!(periods_ms(&[0, 2_500, 5_001, 7_501]), [0, 2_500, 2_500, 2_500]);
        assert_eq!(periods_ms(&[500, 400, 300]), [0, 0, 0], "a clock that is set back");
    }

    /// Simulates a stream for a minute. A sample arrives every `period_ms`, and it is the only one of `sent` samples
    /// that arrives. Returns how often the verdict becomes unknown before the end of the stream, and after how many ms
    /// without a sample it does so at the end.
    fn follow(period_ms: u64, jitter_ms: u64, sent: u64) -> (u32, u64) {
        let (mut arrivals, mut freshness) = (PeriodEstimator::default(), StalenessTimer::new(at(0)));
        let mut silences = 0;
        let mut next_ms = 0;
        let mut last_ms = 0;
        for ms in 0..75_000 {
            let now = at(ms);
            if ms == next_ms && ms < 60_000 {
                let period_us = arrivals.period_us(now.monotonic_ns, sent);
                let header = Header {
                    stamp_last_ns: now.monotonic_ns,
                    period_us,
                    flags: Flags::REMOTE,
                    ..Header::default()
                };
                assert!(freshness.update(&header, Verdict::Clear, now));
                last_ms = ms;
                let number = ms / period_ms + 1;
                next_ms = number * period_ms + number * 7 % (jitter_ms + 1);
            }
            if freshness.silence(now) {
                silences += 1;
                if next_ms >= 60_000 {
                    return (silences - 1, ms - last_ms);
                }
            }
        }
        panic!("never silent after the end");
    }

    fn at(ms: u64) -> Timestamp {
        Timestamp { monotonic_ns: ms * MS, boottime_ns: ms * MS }
    }

    #[test]
    fn verdict_expires_with_the_period() {
        for (period_ms, jitter_ms) in [(27, 0), (27, 20), (230, 0), (400, 60), (1_000, 100), (2_000, 200)] {
            let (silences, ended_ms) = follow(period_ms, jitter_ms, 1);
            let limit_ms = 2 * (period_ms + jitter_ms) + 41;
            // The period of a slow stream is unknown before its second sample.
            let before_known = u32::from(period_ms > 500);
            assert_eq!(silences, before_known, "a sample every {period_ms} ms");
            assert!(
                (500..=limit_ms.max(500)).contains(&ended_ms),
                "a sample every {period_ms} ms: {ended_ms} ms"
            );
        }
        assert!(follow(3_000, 0, 1).0 > 15, "too slow for a verdict");
    }

    #[test]
    fn bad_link_does_not_extend_a_verdict() {
        // A sample is sent every 30 ms, and one arrives every 2 s. The verdict is known for a quarter of the time.
        assert_eq!(follow(2_010, 0, 67), (29, 500));
    }
}
