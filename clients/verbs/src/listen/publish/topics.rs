//! The topics of one remote sensor in shared memory: which there are, and what is said of it when nothing comes. Refuses to
//! know how a sample gets there.

use std::time::{Duration, Instant};

use scanhub_client::{PublishSession, SensorPublisher, clock};
use schema::datagram::{Announce, Arrival, Head, Standing};
use schema::{Failure, Header, State, Status, Topic, Wake, Zones};

use super::super::remote::Remote;
use super::remote_publisher::{AnyPublisher, RemotePublisher};

/// One sensor of another machine.
pub(super) struct RemoteTopics {
    /// Its name here, `HUB.SENSOR`.
    pub(super) name: String,
    /// Gateway, its life, and the sensor's number in it, as last announced.
    source: Option<(u64, u32, u8)>,
    /// Bit n: topic number n was announced last.
    announced: u64,
    /// What it is worth when there is no room for another.
    pub(super) standing: Standing,
    /// It has all that was announced, and that was told.
    pub(super) is_told: bool,
    /// One for each of [`Topic::ALL`].
    topics: [Option<AnyPublisher>; Topic::ALL.len()],
    /// The last status, and the header it came with.
    last: Option<(Status, Header)>,
    /// The header of the last zones.
    zoned: Option<Header>,
    heard_at: Option<Instant>,
    /// Why consumers are to be woken.
    news: Option<Wake>,
    // Behind the topics: it wakes their consumers.
    sensor: SensorPublisher,
}

/// So long nothing comes before the sensor counts as silent: three announcements.
const SILENT_AFTER: Duration = Duration::from_secs(3);

impl RemoteTopics {
    /// The sensor `name`, without topics.
    pub(super) fn new(session: &PublishSession, name: &str) -> Result<RemoteTopics, Failure> {
        Ok(RemoteTopics {
            name: name.to_owned(),
            source: None,
            announced: 0,
            standing: Standing::NONE,
            is_told: false,
            topics: [const { None }; Topic::ALL.len()],
            last: None,
            zoned: None,
            heard_at: None,
            news: None,
            sensor: session.sensor(name)?,
        })
    }

    /// It has this topic.
    pub(super) fn has(&self, topic: Topic) -> bool {
        self.topics[topic as usize].is_some()
    }

    /// Makes `topic`, which it does not have.
    pub(super) fn add(&mut self, topic: Topic) -> Result<(), Failure> {
        self.topics[topic as usize] = Some(AnyPublisher::new(topic, &self.sensor)?);
        Ok(())
    }

    /// Takes `topic` away.
    pub(super) fn remove(&mut self, topic: Topic) {
        self.topics[topic as usize] = None;
    }

    fn zones(&mut self) -> Option<&mut RemotePublisher<Zones>> {
        match &mut self.topics[Topic::Zones as usize] {
            Some(AnyPublisher::Zones(zones)) => Some(zones),
            _ => None,
        }
    }

    fn status(&mut self) -> Option<&mut RemotePublisher<Status>> {
        match &mut self.topics[Topic::Status as usize] {
            Some(AnyPublisher::Status(status)) => Some(status),
            _ => None,
        }
    }

    /// `announce` came with `head`: it is this one.
    pub(super) fn announced(&mut self, head: &Head, announce: &Announce, arrival: Arrival) {
        self.standing.take(arrival);
        self.source = Some((head.hub, head.epoch, head.sensor));
        let numbers = announce.topics().iter().map(|announced| announced.topic).filter(|number| *number < 64);
        self.announced = numbers.fold(0, |bits, number| bits | 1 << number);
    }

    /// Another sensor has the number or the place that this one had: nothing comes of it any more, which is said at once.
    pub(super) fn replaced(&mut self) {
        self.source = None;
        self.heard_at = None;
        if let (Some(mut header), Some(zones)) = (self.zoned.take(), self.zones()) {
            stamp(&mut header);
            zones.send(&header, |sample| *sample = Zones::unknown());
            self.news = Some(Wake::Telegram);
        }
        self.silent();
        self.wake();
    }

    /// Its gateway sends this topic.
    pub(super) fn is_announced(&self, topic: Topic) -> bool {
        self.announced >> topic.number() & 1 == 1
    }

    /// It is the sensor that sent `head`.
    pub(super) fn is(&self, head: &Head) -> bool {
        self.source == Some((head.hub, head.epoch, head.sensor))
    }

    /// Its gateway is this one, in this epoch.
    pub(super) fn is_of(&self, hub: u64, epoch: u32) -> bool {
        self.source.is_some_and(|source| (source.0, source.1) == (hub, epoch))
    }

    /// Publishes `remote`; `false` if it has no such topic. A payload cannot fail to be read: the account has checked it.
    pub(super) fn publish(&mut self, remote: &Remote<'_>, now: Instant) -> bool {
        self.heard_at = Some(now);
        self.standing.take(Arrival { delivers: true, now_ns: remote.arrival_ns });
        if remote.topic == Topic::Status {
            let Some(status) = remote.payload::<Status>() else { return true };
            let Some(header) = self.status().map(|topic| topic.header(remote)) else { return false };
            self.tell(status, &header);
        } else {
            let Some(topic) = &mut self.topics[remote.topic as usize] else { return false };
            topic.publish(remote);
        }
        if remote.topic == Topic::Zones {
            self.zoned = Some(remote.header());
        }
        let why = if remote.topic == Topic::Status { Wake::Status } else { Wake::Telegram };
        self.news = match self.news {
            Some(Wake::Telegram) => Some(Wake::Telegram),
            _ => Some(why),
        };
        true
    }

    /// Wakes the consumers, if something was published since the last call.
    pub(super) fn wake(&mut self) {
        if let Some(why) = self.news.take() {
            // Those that cannot be woken look by themselves ten times a second.
            let _ = self.sensor.wake(why);
        }
    }

    /// Says that the sensor is silent, once per silence, and gives late joiners what they would else get with the next
    /// sample.
    pub(super) fn look(&mut self, now: Instant) {
        if self.heard_at.is_some_and(|at| now - at >= SILENT_AFTER) {
            self.heard_at = None;
            self.silent();
            self.wake();
        }
        let keeps = |(topic, publisher)| Some(publisher).filter(|_| Topic::row(topic).kept > 0);
        let kept = Topic::ALL.into_iter().zip(&self.topics).filter_map(keeps).flatten();
        kept.for_each(AnyPublisher::connect);
    }

    /// Samples for which there was no memory.
    pub(super) fn loan_failed(&self) -> u64 {
        self.topics.iter().flatten().map(AnyPublisher::failed).sum()
    }

    /// Publishes a status as it came, but for the beginning of its state: that is on a clock of another machine. Here the
    /// state began when it was first heard of.
    fn tell(&mut self, mut status: Status, header: &Header) {
        let same = self.last.filter(|(last, _)| last.state == status.state);
        status.since_ns = same.map_or(header.stamp_first_ns, |(last, _)| last.since_ns);
        self.last = Some((status, *header));
        if let Some(topic) = self.status() {
            topic.send(header, |sample| *sample = status);
        }
    }

    /// Nothing comes any more: what was last said would stand for ever.
    fn silent(&mut self) {
        let Some((mut status, mut header)) = self.last else { return };
        status.state = State::Silent as u8;
        status.rate_mhz = 0;
        status.set_last_error("nothing arrives over the network");
        stamp(&mut header);
        if self.has(Topic::Status) {
            self.tell(status, &header);
            self.news = self.news.or(Some(Wake::Status));
        }
    }
}

/// What is said now, although nothing came.
fn stamp(header: &mut Header) {
    (header.stamp_first_ns, header.wall_ns) = (clock::now().monotonic_ns, clock::wall_ns());
    header.stamp_last_ns = header.stamp_first_ns;
}
