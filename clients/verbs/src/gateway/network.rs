//! The datagrams: each is numbered, sealed and handed to every destination, in a buffer that is always the same. Refuses
//! to know where samples come from.

use std::sync::atomic::AtomicBool;

use schema::datagram::{Announce, HEAD, Head, MTU_ETHERNET, MTU_LEAST, PORT, group};
use schema::{Failure, Kind, Topic};

use super::life::Life;
use super::udp_destination::UdpDestination;
use super::uplink::Uplink;

/// What goes out, and the account of it.
pub(super) struct Lan {
    pub(super) life: Life,
    /// The groups, if an interface was named for them.
    pub(super) groups: Option<Groups>,
    /// Hosts that get copies.
    pub(super) copies: Vec<UdpDestination>,
    sensors: Vec<Rows>,
    form: Form,
    longest: usize,
    /// What did not fit into a datagram.
    pub(super) unfit: u64,
    buffer: [u8; MTU_ETHERNET],
}

/// The groups on an interface.
pub(super) struct Groups {
    pub(super) interface: Uplink,
    destination: UdpDestination,
}

/// How a payload becomes a datagram.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Form {
    /// Behind a header.
    Sealed,
    /// By itself, to a port of its sensor.
    Bare,
}

/// The account of one sensor.
#[derive(Default)]
pub(super) struct Rows {
    /// Who had this number last.
    pub(super) name: String,
    rows: [Row; KINDS],
}

/// The account of one sensor and topic.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Row {
    /// Datagrams that the groups were sent, or without groups a host at least.
    pub(super) sent: u64,
    /// Datagrams that have a number and were not sent there.
    pub(super) failed: u64,
    /// Bytes in what was sent.
    pub(super) bytes: u64,
    /// Samples that the hub sent and the gateway did not receive; they have no number.
    pub(super) missed: u64,
    fit: Fit,
}

/// Whether all samples of a topic fit into datagrams.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum Fit {
    #[default]
    All,
    NotAll,
    /// And that is told.
    Told,
}

impl Row {
    /// The number of the next datagram.
    pub(super) fn next(&self) -> u32 {
        (self.sent + self.failed) as u32
    }
}

impl Rows {
    /// All topics of which anything was sent or ought to have been, announcements as nothing.
    pub(super) fn used(&self) -> impl Iterator<Item = (Option<Topic>, &Row)> {
        let numbered = self.rows.iter().enumerate().filter(|(_, row)| **row != Row::default());
        numbered.map(|(number, row)| (Topic::of_number(number as u8), row))
    }
}

impl Lan {
    /// Datagrams of at most `longest` bytes, as `life`, to the groups on `interface`, if there is one, which routers pass on
    /// `ttl` times, and to the hosts in `to`.
    ///
    /// [`Kind::Configuration`] if `longest` is not possible, a host is none or is named twice; [`Kind::Failed`] without sockets;
    /// [`Kind::Interrupted`] if `stop` is set before it is known where the hosts are.
    pub(super) fn open(
        life: Life,
        interface: Option<Uplink>,
        to: &[String],
        form: Form,
        ttl: u8,
        longest: usize,
        stop: &AtomicBool,
    ) -> Result<Lan, Failure> {
        if !(MTU_LEAST..=MTU_ETHERNET).contains(&longest) {
            let what = format!("datagrams of {longest} bytes are not possible");
            let hint = format!("from {MTU_LEAST} to {MTU_ETHERNET}, the most that an Ethernet carries");
            return Err(Failure::new(Kind::Configuration, what, hint));
        }
        let (port, more) = match form {
            Form::Sealed => (PORT, 0),
            Form::Bare => (BARE_PORT, u16::from(u8::MAX)),
        };
        let groups = interface.map(|interface| {
            let destination = UdpDestination::groups(interface.name(), port, ttl)?;
            Ok(Groups { interface, destination })
        });
        let groups = groups.transpose()?;
        let mut copies: Vec<UdpDestination> = Vec::new();
        for text in to {
            let copy = UdpDestination::host(text, more, stop)?;
            if let Some(other) = copies.iter().find(|other| other.is_as(&copy)) {
                let what = format!("cannot send to {text}: it is named twice");
                let hint = format!("{} already gets a copy; name each host and port once", other.name);
                return Err(Failure::new(Kind::Configuration, what, hint));
            }
            copies.push(copy);
        }
        let (sensors, buffer) = (Vec::new(), [0; MTU_ETHERNET]);
        let mut lan = Lan { life, groups, copies, sensors, form, longest, unfit: 0, buffer };
        let room = lan.groups.as_mut().and_then(|groups| {
            groups.use_interface();
            groups.destination.room(groups.interface.index()?)
        });
        lan.longest = longest.min(room.unwrap_or(longest)).max(HEAD);
        Ok(lan)
    }

    /// The longest datagram that goes out.
    pub(super) fn longest(&self) -> usize {
        self.longest
    }

    /// All destinations, the groups first.
    pub(super) fn destinations(&self) -> impl Iterator<Item = &UdpDestination> {
        self.groups.iter().map(|groups| &groups.destination).chain(&self.copies)
    }

    /// As [`destinations`](Lan::destinations).
    pub(super) fn destinations_mut(&mut self) -> impl Iterator<Item = &mut UdpDestination> {
        self.groups.iter_mut().map(|groups| &mut groups.destination).chain(&mut self.copies)
    }

    /// Goes on where the interface is now; whether its state is another one than before.
    pub(super) fn look(&mut self) -> bool {
        let Some(groups) = &mut self.groups else { return false };
        let changed = groups.interface.look();
        if changed {
            groups.use_interface();
        }
        changed
    }

    /// Sensor number `number` is called `name`.
    pub(super) fn claim(&mut self, number: u8, name: &str) {
        let at = usize::from(number);
        if self.sensors.len() <= at {
            self.sensors.resize_with(at + 1, Rows::default);
        }
        if self.sensors[at].name != name {
            name.clone_into(&mut self.sensors[at].name);
        }
    }

    /// Whether `name` was the last to claim `number`: a hub that is started anew may number its sensors otherwise.
    pub(super) fn is_claimed(&self, number: u8, name: &str) -> bool {
        self.sensors.get(usize::from(number)).is_some_and(|rows| rows.name == name)
    }

    /// The number of the next datagram of this sensor and topic.
    pub(super) fn next(&self, number: u8, topic: Topic) -> u32 {
        let rows = self.sensors.get(usize::from(number));
        rows.map_or(0, |rows| rows.rows[usize::from(topic.number())].next())
    }

    /// The hub sent so many samples that did not come here.
    pub(super) fn miss(&mut self, number: u8, topic: Topic, missed: u64) {
        if let Some(row) = self.row(number, topic.number()) {
            row.missed += missed;
        }
    }

    /// The account, by the sensors' numbers.
    pub(super) fn sensors(&self) -> impl Iterator<Item = &Rows> {
        self.sensors.iter()
    }

    /// Sends what `pack` writes, under the next number of this sensor and topic; `head` lacks hub, epoch and sequence. A
    /// failure uses the number up.
    pub(super) fn send(&mut self, head: Head, pack: impl FnOnce(&mut [u8]) -> Option<usize>) {
        let (hub, epoch) = (self.life.hub, self.life.epoch);
        let Some(row) = self.row(head.sensor, head.topic) else { return };
        let head = Head { hub, epoch, sequence: row.next(), ..head };
        let payload = pack(&mut self.buffer[HEAD..self.longest]);
        let (datagram, above) = match (self.form, payload) {
            (_, None) => (None, 0),
            (Form::Sealed, Some(len)) => (head.seal(&mut self.buffer, len), 0),
            (Form::Bare, Some(len)) => (self.buffer.get(HEAD..HEAD + len), head.sensor),
        };
        let group = Topic::of_number(head.topic).map_or(Announce::GROUP, group);
        let mut taken = None;
        if let Some(datagram) = datagram {
            let of_groups =
                self.groups.as_mut().map(|groups| groups.destination.send(datagram, group, above));
            let mut of_copies = false;
            for copy in &mut self.copies {
                of_copies |= copy.send(datagram, group, above);
            }
            taken = of_groups.unwrap_or(of_copies).then_some(datagram.len());
        }
        if let Some(row) = self.row(head.sensor, head.topic) {
            match taken {
                Some(len) => {
                    row.sent += 1;
                    row.bytes += len as u64;
                }
                None => row.failed += 1,
            }
            if payload.is_none() && row.fit == Fit::All {
                row.fit = Fit::NotAll;
            }
        }
        self.unfit += u64::from(payload.is_none());
    }

    /// `SENSOR/TOPIC` of which something did not fit into a datagram; each is told once.
    pub(super) fn misfit(&mut self) -> Option<String> {
        self.sensors.iter_mut().find_map(|Rows { name, rows }| {
            let (number, row) = rows.iter_mut().enumerate().find(|(_, row)| row.fit == Fit::NotAll)?;
            row.fit = Fit::Told;
            let topic = Topic::of_number(number as u8).map_or("announce", Topic::name);
            Some(format!("{name}/{topic}"))
        })
    }

    fn row(&mut self, number: u8, topic: u8) -> Option<&mut Row> {
        self.sensors.get_mut(usize::from(number))?.rows.get_mut(usize::from(topic))
    }
}

impl Groups {
    fn use_interface(&mut self) {
        self.destination.is_cut = !self.interface.is_up();
        if let Some(index) = self.interface.index() {
            self.destination.use_interface(index);
        }
    }
}

/// Announcements, and the topics by their numbers.
const KINDS: usize = 1 + Topic::ALL.len();
/// The port of sensor 0 where nothing but telegrams goes out; the next sensor has the next one.
const BARE_PORT: u16 = PORT + 1;
