//! The topics of one remote sensor: which there are, and what is said of it when nothing comes. Refuses to know how a sample
//! gets to its consumers.

use crate::lan::{Arrival, Standing};
use scanhub_schema::datagram::{Announce, Head, MTU_ETHERNET, Packed};
use scanhub_schema::{Failure, Header, State, Status, Topic, Wake, Zones};

use super::store::SensorTopics;
use super::stream::{Placed, Stream};
use crate::lan::Stamp;
use crate::lan::incoming::Remote;

/// One sensor of another machine.
pub(super) struct RemoteSensor<T: SensorTopics> {
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
    streams: [Option<Stream>; Topic::ALL.len()],
    /// The last status, and the header it came with.
    last: Option<(Status, Header)>,
    /// The header of the last zones.
    zoned: Option<Header>,
    /// When the last sample came: CLOCK_MONOTONIC in ns.
    heard_ns: Option<u64>,
    /// Why consumers are to be woken.
    news: Option<Wake>,
    /// The process that publishes it here.
    pid: u32,
    topics: T,
}

/// Outcome of a sample.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Outcome {
    /// The sample was published.
    Published,
    /// The sensor has no such topic.
    NoTopic,
    /// The memory that remote sensors may use has no room for so long a sample.
    NoRoom,
}

/// So long nothing comes before the sensor counts as silent: three announcements.
const SILENT_AFTER_NS: u64 = 3_000_000_000;

impl<T: SensorTopics> RemoteSensor<T> {
    /// The sensor `name`, with no `topics` yet, which process `pid` publishes.
    pub(super) fn new(name: &str, topics: T, pid: u32) -> RemoteSensor<T> {
        RemoteSensor {
            name: name.to_owned(),
            source: None,
            announced: 0,
            standing: Standing::NONE,
            is_told: false,
            streams: [const { None }; Topic::ALL.len()],
            last: None,
            zoned: None,
            heard_ns: None,
            news: None,
            pid,
            topics,
        }
    }

    /// It has this topic.
    pub(super) fn has(&self, topic: Topic) -> bool {
        self.streams[topic as usize].is_some()
    }

    /// Makes `topic`, which it does not have.
    pub(super) fn add(&mut self, topic: Topic) -> Result<(), Failure> {
        self.topics.add(topic)?;
        self.streams[topic as usize] = Some(Stream::default());
        Ok(())
    }

    /// Takes `topic` away.
    pub(super) fn remove(&mut self, topic: Topic) {
        self.topics.remove(topic);
        self.streams[topic as usize] = None;
    }

    /// `announce` came with `head`: it is this one.
    pub(super) fn announced(&mut self, head: &Head, announce: &Announce, arrival: Arrival) {
        self.standing.take(arrival);
        self.source = Some((head.hub, head.epoch, head.sensor));
        let numbers = announce.topics().iter().map(|announced| announced.topic).filter(|number| *number < 64);
        self.announced = numbers.fold(0, |bits, number| bits | 1 << number);
    }

    /// Another sensor has the number or the place that this one had: nothing comes of it any more, which is said at once.
    pub(super) fn replaced(&mut self, now: Stamp) {
        self.source = None;
        self.heard_ns = None;
        if let Some(header) = self.zoned.take().filter(|_| self.has(Topic::Zones)) {
            self.say(Topic::Zones, &stamped(header, now), &Zones::unknown());
            self.news = Some(Wake::Telegram);
        }
        self.silent(now);
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

    /// Publishes `remote` if the sensor has the topic and room for the sample. The payload was checked before.
    pub(super) fn publish(&mut self, remote: &Remote<'_>) -> Outcome {
        self.heard_ns = Some(remote.arrival_ns);
        self.standing.take(Arrival { delivers: true, now_ns: remote.arrival_ns });
        let topic = remote.topic;
        let Some(stream) = &mut self.streams[topic as usize] else { return Outcome::NoTopic };
        // Its number is left out before the next sample that fits.
        if !self.topics.fits(topic, remote.datagram.payload) {
            return Outcome::NoRoom;
        }
        let Placed { left_out, header } = stream.place(remote, self.pid);
        self.topics.skip(topic, left_out);
        if topic != Topic::Status {
            self.topics.send(topic, &header, remote.datagram.payload);
        } else if let Some(status) = remote.payload::<Status>() {
            self.tell(*status, &header);
        }
        if topic == Topic::Zones {
            self.zoned = Some(remote.header(self.pid));
        }
        let why = if topic == Topic::Status { Wake::Status } else { Wake::Telegram };
        self.news = match self.news {
            Some(Wake::Telegram) => Some(Wake::Telegram),
            _ => Some(why),
        };
        Outcome::Published
    }

    /// Wakes the consumers, if something was published since the last call.
    pub(super) fn wake(&mut self) {
        if let Some(why) = self.news.take() {
            self.topics.wake(why);
        }
    }

    /// Says that the sensor is silent, once per silence, if it was so at `read`: what came before that was taken. Gives late
    /// joiners what they would else get with the next sample.
    pub(super) fn look(&mut self, read: Stamp) {
        if self.heard_ns.is_some_and(|at_ns| read.monotonic_ns.saturating_sub(at_ns) >= SILENT_AFTER_NS) {
            self.heard_ns = None;
            self.silent(read);
            self.wake();
        }
        let keeps = |topic: &Topic| topic.row().kept > 0 && self.has(*topic);
        Topic::ALL.into_iter().filter(keeps).for_each(|topic| self.topics.connect(topic));
    }

    /// Samples for which there was no memory.
    pub(super) fn failed(&self) -> u64 {
        self.topics.failed()
    }

    /// Publishes a status as it came, but for the beginning of its state: that is on a clock of another machine. Here the
    /// state began when it was first heard of.
    fn tell(&mut self, mut status: Status, header: &Header) {
        let same = self.last.filter(|(last, _)| last.state == status.state);
        status.since_ns = same.map_or(header.stamp_first_ns, |(last, _)| last.since_ns);
        self.last = Some((status, *header));
        if self.has(Topic::Status) {
            self.say(Topic::Status, header, &status);
        }
    }

    /// Nothing comes any more: what was last said would stand for ever.
    fn silent(&mut self, now: Stamp) {
        let Some((mut status, header)) = self.last else { return };
        status.state = State::Silent as u8;
        status.rate_mhz = 0;
        status.set_last_error("nothing arrives over the network");
        if self.has(Topic::Status) {
            self.tell(status, &stamped(header, now));
            self.news = self.news.or(Some(Wake::Status));
        }
    }

    /// Publishes what did not come so.
    fn say(&mut self, topic: Topic, header: &Header, payload: &impl Packed) {
        let mut room = [0; MTU_ETHERNET];
        if let Some(len) = payload.pack(&mut room) {
            self.topics.send(topic, header, &room[..len]);
        }
    }
}

/// The header of what is said now, although nothing came.
fn stamped(header: Header, now: Stamp) -> Header {
    let Stamp { monotonic_ns, wall_ns } = now;
    Header { stamp_first_ns: monotonic_ns, stamp_last_ns: monotonic_ns, wall_ns, ..header }
}

#[cfg(test)]
mod tests {
    use super::*;

    use scanhub_schema::datagram::{Datagram, HEAD};

    /// What was said of a sensor's status: the state, and its stamps in ms.
    #[derive(Default)]
    struct Said(Vec<(Option<State>, u64, u64)>);

    impl SensorTopics for Said {
        fn add(&mut self, _: Topic) -> Result<(), Failure> {
            Ok(())
        }

        fn remove(&mut self, _: Topic) {}

        fn skip(&mut self, _: Topic, _: u64) {}

        fn send(&mut self, _: Topic, header: &Header, payload: &[u8]) {
            let mut status = Status::default();
            assert!(status.unpack(payload));
            self.0.push((status.state(), header.stamp_last_ns / MS, status.since_ns / MS));
        }

        fn connect(&self, _: Topic) {}

        fn wake(&self, _: Wake) {}

        fn failed(&self) -> u64 {
            0
        }
    }

    const MS: u64 = 1_000_000;

    #[test]
    fn a_silence_is_said_as_of_when_everything_was_read() {
        let mut sensor = RemoteSensor::new("robot1.front", Said::default(), 1);
        sensor.add(Topic::Status).unwrap();
        let mut bytes = [0; MTU_ETHERNET];
        let status = Status { state: State::Streaming as u8, ..Status::default() };
        let len = status.pack(&mut bytes[HEAD..]).unwrap();
        let head = Head { topic: Topic::Status.number(), revision: 1, hub: 5, epoch: 1, ..Head::default() };
        let datagram = Datagram::read(head.seal(&mut bytes, len).unwrap()).unwrap();
        let came = |ms| Remote {
            topic: Topic::Status,
            datagram,
            boot: 1,
            arrival_ns: ms * MS,
            age_ns: None,
            late: false,
            authenticated: false,
        };
        let read = |ms| Stamp { monotonic_ns: ms * MS, wall_ns: ms * MS };
        assert_eq!(sensor.publish(&came(1_000)), Outcome::Published);
        // The listener is behind: what came at 4.6 s is the next that it will read.
        [3_999, 4_500, 4_550].into_iter().for_each(|ms| sensor.look(read(ms)));
        assert_eq!(sensor.publish(&came(4_600)), Outcome::Published);
        sensor.look(read(5_000));
        let (streams, silent) = (Some(State::Streaming), Some(State::Silent));
        assert_eq!(
            sensor.topics.0,
            [(streams, 1_000, 1_000), (silent, 4_500, 4_500), (streams, 4_600, 4_600)]
        );
    }
}
