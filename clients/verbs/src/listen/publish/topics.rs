//! The topics of one remote sensor in shared memory: which there are, and what is said of it when nothing comes. Refuses to
//! know how a sample gets there.

use std::time::{Duration, Instant};

use scanhub_client::clock;
use schema::datagram::{Announce, Arrival, Head, Standing};
use schema::ipc::{Node, Payload, Waker};
use schema::{Background, Failure, Foreground, Header, Marks, Scan, State, Status, Topic, Wake, Zones};

use super::super::remote::Remote;
use super::outlet::Outlet;

/// One sensor of another machine.
pub(super) struct RemoteTopics {
    /// Its name here, `HUB.SENSOR`.
    pub(super) name: String,
    /// Gateway, its life, and the sensor's number in it, as last announced.
    source: Option<(u64, u32, u8)>,
    /// Bit n: topic number n was announced last.
    announced: u8,
    /// What it is worth when there is no room for another.
    pub(super) standing: Standing,
    /// It has all that was announced, and that was told.
    pub(super) is_told: bool,
    telegram: Option<Outlet<[u8]>>,
    scan: Option<Outlet<Scan>>,
    marks: Option<Outlet<Marks>>,
    zones: Option<Outlet<Zones>>,
    foreground: Option<Outlet<Foreground>>,
    background: Option<Outlet<Background>>,
    status: Option<Outlet<Status>>,
    /// The last status, and the header it came with.
    last: Option<(Status, Header)>,
    /// The header of the last zones.
    zoned: Option<Header>,
    heard_at: Option<Instant>,
    /// Why consumers are to be woken.
    news: Option<Wake>,
    waker: Waker,
}

/// So long nothing comes before the sensor counts as silent: three announcements.
const SILENT_AFTER: Duration = Duration::from_secs(3);

impl RemoteTopics {
    /// The sensor `name`, without topics.
    pub(super) fn new(node: &Node, name: &str) -> Result<RemoteTopics, Failure> {
        Ok(RemoteTopics {
            name: name.to_owned(),
            source: None,
            announced: 0,
            standing: Standing::NONE,
            is_told: false,
            telegram: None,
            scan: None,
            marks: None,
            zones: None,
            foreground: None,
            background: None,
            status: None,
            last: None,
            zoned: None,
            heard_at: None,
            news: None,
            waker: Waker::new(node, name)?,
        })
    }

    /// It has this topic.
    pub(super) fn has(&self, topic: Topic) -> bool {
        match topic {
            Topic::Telegram => self.telegram.is_some(),
            Topic::Scan => self.scan.is_some(),
            Topic::Marks => self.marks.is_some(),
            Topic::Zones => self.zones.is_some(),
            Topic::Foreground => self.foreground.is_some(),
            Topic::Background => self.background.is_some(),
            Topic::Status => self.status.is_some(),
        }
    }

    /// Makes `topic`, which it does not have.
    pub(super) fn add(&mut self, node: &Node, topic: Topic) -> Result<(), Failure> {
        let name = &self.name;
        match topic {
            Topic::Telegram => self.telegram = Some(Outlet::new(node, name)?),
            Topic::Scan => self.scan = Some(Outlet::new(node, name)?),
            Topic::Marks => self.marks = Some(Outlet::new(node, name)?),
            Topic::Zones => self.zones = Some(Outlet::new(node, name)?),
            Topic::Foreground => self.foreground = Some(Outlet::new(node, name)?),
            Topic::Background => self.background = Some(Outlet::new(node, name)?),
            Topic::Status => self.status = Some(Outlet::new(node, name)?),
        }
        Ok(())
    }

    /// Takes `topic` away.
    pub(super) fn remove(&mut self, topic: Topic) {
        match topic {
            Topic::Telegram => self.telegram = None,
            Topic::Scan => self.scan = None,
            Topic::Marks => self.marks = None,
            Topic::Zones => self.zones = None,
            Topic::Foreground => self.foreground = None,
            Topic::Background => self.background = None,
            Topic::Status => self.status = None,
        }
    }

    /// `announce` came with `head`: it is this one.
    pub(super) fn announced(&mut self, head: &Head, announce: &Announce, arrival: Arrival) {
        self.standing.take(arrival);
        self.source = Some((head.hub, head.epoch, head.sensor));
        let numbers = announce.topics().iter().map(|announced| announced.topic).filter(|number| *number < 8);
        self.announced = numbers.fold(0, |bits, number| bits | 1 << number);
    }

    /// Another sensor has the number or the place that this one had: nothing comes of it any more, which is said at once.
    pub(super) fn replaced(&mut self) {
        self.source = None;
        self.heard_at = None;
        if let (Some(mut header), Some(outlet)) = (self.zoned.take(), &mut self.zones) {
            stamp(&mut header);
            header.topic_seq = outlet.own_number();
            outlet.send(&header, |sample| *sample = Zones::unknown());
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
        let sent = match remote.topic {
            Topic::Telegram => self.telegram.as_mut().map(|outlet| outlet.send_telegram(remote)),
            Topic::Scan => self.scan.as_mut().map(|outlet| outlet.unpack(remote)),
            Topic::Marks => self.marks.as_mut().map(|outlet| outlet.unpack(remote)),
            Topic::Zones => {
                self.zoned = Some(remote.header());
                self.zones.as_mut().map(|outlet| outlet.unpack(remote))
            }
            Topic::Foreground => self.foreground.as_mut().map(|outlet| outlet.unpack(remote)),
            Topic::Background => self.background.as_mut().map(|outlet| outlet.unpack(remote)),
            Topic::Status => {
                let Some(status) = remote.payload::<Status>() else { return true };
                let header = self.status.as_mut().map(|outlet| outlet.header(remote));
                header.map(|header| self.tell(status, &header))
            }
        };
        if sent.is_some() {
            let why = if remote.topic == Topic::Status { Wake::Status } else { Wake::Telegram };
            self.news = match self.news {
                Some(Wake::Telegram) => Some(Wake::Telegram),
                _ => Some(why),
            };
        }
        sent.is_some()
    }

    /// Wakes the consumers, if something was published since the last call.
    pub(super) fn wake(&mut self) {
        if let Some(why) = self.news.take() {
            // Those that cannot be woken look by themselves ten times a second.
            let _ = self.waker.wake(why);
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
        connect(&self.status);
        connect(&self.zones);
        connect(&self.background);
    }

    /// Samples for which there was no memory.
    pub(super) fn loan_failed(&self) -> u64 {
        fn of<P: Payload + ?Sized>(outlet: &Option<Outlet<P>>) -> u64 {
            outlet.as_ref().map_or(0, |outlet| outlet.failed)
        }
        let of_scans = of(&self.scan) + of(&self.marks) + of(&self.zones) + of(&self.foreground);
        of(&self.telegram) + of_scans + of(&self.background) + of(&self.status)
    }

    /// Publishes a status as it came, but for the beginning of its state: that is on a clock of another machine. Here the
    /// state began when it was first heard of.
    fn tell(&mut self, mut status: Status, header: &Header) {
        let same = self.last.filter(|(last, _)| last.state == status.state);
        status.since_ns = same.map_or(header.stamp_first_ns, |(last, _)| last.since_ns);
        self.last = Some((status, *header));
        if let Some(outlet) = &mut self.status {
            outlet.send(header, |sample| *sample = status);
        }
    }

    /// Nothing comes any more: what was last said would stand for ever.
    fn silent(&mut self) {
        let Some((mut status, mut header)) = self.last else { return };
        status.state = State::Silent as u8;
        status.rate_mhz = 0;
        status.set_last_error("nothing arrives over the network");
        stamp(&mut header);
        if let Some(number) = self.status.as_mut().map(Outlet::own_number) {
            header.topic_seq = number;
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

fn connect<P: Payload + ?Sized>(outlet: &Option<Outlet<P>>) {
    if let Some(outlet) = outlet {
        outlet.connect();
    }
}
