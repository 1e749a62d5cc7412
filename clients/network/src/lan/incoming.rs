//! Receiving end of a network. It refuses a datagram, or records it in the table of gateways. A new sample is returned
//! together with everything that is known about its sender.
//!
//! With a key, only datagrams that are authenticated with that key are accepted. Recorded datagrams that are sent again
//! are refused: a sensor is accepted only after an announcement that was sent just now, by this machine's clock. From
//! then on, each sequence number is accepted once, and none that was used before that announcement.

use std::collections::HashMap;

use scanhub_schema::datagram::{Announce, Datagram, DatagramError, DatagramPayload, Head, LanFlags};
use scanhub_schema::{Flags, Header, Quality, Topic};

use super::address::Address;
use super::gateways::{AcceptedDatagram, GatewayTable};
use super::reassembly::Reassembler;
use super::sequence::SequenceStatus;
use super::{Key, WallTimestamp};

/// Receiving end of a network.
pub struct Incoming {
    gateways: GatewayTable,
    reassembler: Reassembler,
    key: Option<Key>,
    /// Gateways whose datagrams are received. If the list is empty, datagrams of all gateways are received.
    hubs: Vec<u64>,
}

/// Maximum difference, in ns, between this machine's clock and the stamp of a sensor's first announcement, if there is
/// a key.
const MAX_FIRST_CLOCK_DIFFERENCE_NS: u64 = 5_000_000_000;

/// Result of receiving a datagram.
pub enum ReceiveOutcome<'a> {
    /// The datagram was refused and counted.
    Refused {
        /// Reason under which it is counted.
        reason: DatagramError,
        /// Number of the gateway, if two gateways are known to send under this number.
        shared: Option<u64>,
    },
    /// The datagram was refused: it is the first announcement of a sensor and is authenticated, but its stamp differs
    /// too much from this machine's clock. Either the clocks differ, or the announcement was recorded earlier and sent
    /// again.
    Untimely {
        /// This machine's clock minus the stamp, in ns.
        behind_ns: i64,
    },
    /// The datagram comes from a gateway that is not among those to receive from. It is not counted.
    Ignored,
    /// The datagram arrived under a name that does not match its content. It is not counted.
    Foreign,
    /// A part of a sample that is not complete yet.
    Part,
    /// A duplicate, or an announcement that is older than the last one.
    Duplicate,
    /// An announcement of a sensor.
    Announced(Announcement),
    /// A new sample.
    Sample(RemoteSample<'a>),
}

/// Newest announcement of a sensor.
pub struct Announcement {
    /// Header of its datagram.
    pub head: Head,
    /// Content.
    pub announce: Announce,
    /// CLOCK_MONOTONIC of this machine at its arrival, in ns.
    pub arrival_ns: u64,
    /// Whether a run of the gateway begins with this datagram.
    pub begins: bool,
    /// Whether the sensor was printed under its number before, and its name is known now.
    pub is_named: bool,
    /// This machine's clock minus the gateway's, in ns, if the clocks differ. It is present in only one announcement of
    /// each gateway.
    pub behind_ns: Option<i64>,
    /// Whether its gateway has the key, or has delivered samples for a second or more.
    pub is_proven: bool,
}

/// A sample, and what is known about its sender.
pub struct RemoteSample<'a> {
    /// The sample.
    pub remote: ReceivedSample<'a>,
    /// Last announcement of its sensor.
    pub announced: Option<Announce>,
    /// Whether a run of the gateway begins with this datagram.
    pub begins: bool,
    /// Number of samples of the topic that were sent between the previous sample and this one, and have not arrived; 0
    /// for a late sample.
    pub missed: u32,
    /// Whether its gateway has the key, or has delivered samples for a second or more.
    pub is_proven: bool,
}

/// Payload of a sample in the form that it has in a datagram. It was checked, and is valid for its topic.
#[derive(Clone, Copy, Debug)]
pub struct CheckedPayload<'a> {
    /// The payload as it was received.
    pub bytes: &'a [u8],
    /// Bytes of memory that the payload fills when it is unpacked, as [`DatagramPayload::room`] returned.
    pub room: usize,
}

/// A sample of another machine.
#[derive(Clone, Copy)]
pub struct ReceivedSample<'a> {
    /// Topic of the sample.
    pub topic: Topic,
    /// Header of its datagram.
    pub head: Head,
    /// Payload of the sample.
    pub payload: CheckedPayload<'a>,
    /// Run of its hub; 0 if unknown.
    pub boot: u64,
    /// CLOCK_MONOTONIC of this machine at its arrival, in ns.
    pub arrival_ns: u64,
    /// Age at its arrival, in ns, if the clocks agree.
    pub age_ns: Option<u64>,
    /// Whether the sample arrived after a newer one of its topic.
    pub late: bool,
    /// Whether it was authenticated with the receiver's key.
    pub authenticated: bool,
}

impl ReceivedSample<'_> {
    /// Returns the header with which process `pid` publishes the sample on this machine. Its stamps are the time of
    /// arrival, and `wall_ns` is the stamp from the datagram. The header has no period, because a gateway may thin out
    /// samples.
    pub fn header(&self, pid: u32) -> Header {
        let head = &self.head;
        let quality = if head.flags & LanFlags::SUSPECT != 0 { Quality::Suspect } else { Quality::Clean };
        let same = LanFlags::SIMULATED | LanFlags::REPLAYED | LanFlags::STAMP_ESTIMATED;
        Header {
            seq: head.counter.into(),
            topic_seq: head.sequence.into(),
            stamp_first_ns: self.arrival_ns,
            stamp_last_ns: self.arrival_ns,
            wall_ns: head.stamp_ns,
            boot: self.boot,
            sensor: head.sensor,
            quality: quality as u8,
            flags: head.flags & same | Flags::REMOTE,
            family: head.family,
            hub_pid: pid,
            ..Header::default()
        }
    }
}

impl CheckedPayload<'_> {
    /// Returns the payload as a value. `P` must be the payload type of the topic. `None` if there is too little memory.
    pub fn unpack<P: DatagramPayload + ?Sized>(&self) -> Option<Box<P>>
    where
        Box<P>: Default,
    {
        let mut payload = Box::default();
        P::make_room(&mut payload, self.room);
        payload.fill(self.bytes, self.room).then_some(payload)
    }
}

impl ReceiveOutcome<'_> {
    /// Returns the header of the datagram if a run of its gateway begins with it.
    pub fn begins(&self) -> Option<&Head> {
        match self {
            ReceiveOutcome::Announced(announced) if announced.begins => Some(&announced.head),
            ReceiveOutcome::Sample(sample) if sample.begins => Some(&sample.remote.head),
            _ => None,
        }
    }
}

impl Incoming {
    /// Creates a receiving end without a key. Announcements are accepted for `topics`, as [`GatewayTable::new`]
    /// explains.
    pub fn new(topics: &[Topic]) -> Incoming {
        let (gateways, parts) = (GatewayTable::new(topics), Reassembler::default());
        Incoming { gateways, reassembler: parts, key: None, hubs: Vec::new() }
    }

    /// Creates a receiving end that accepts only datagrams that are authenticated with `key`. `epochs` has the highest
    /// epoch of each gateway that was received before, see [`take_epochs`](Incoming::take_epochs).
    pub fn with_key(topics: &[Topic], key: Key, epochs: HashMap<u64, u32>) -> Incoming {
        let end = Incoming::new(topics);
        Incoming { gateways: end.gateways.with_key(epochs), key: Some(key), ..end }
    }

    /// Receives only from the gateways in `hubs`, or from all gateways if `hubs` is empty.
    pub fn with_hubs(self, hubs: Vec<u64>) -> Incoming {
        Incoming { hubs, ..self }
    }

    /// Returns the highest authenticated epoch of each gateway, if one of them is new since the last call. The caller
    /// must save them for the next process.
    pub fn take_epochs(&mut self) -> Option<HashMap<u64, u32>> {
        self.gateways.take_epochs()
    }

    /// Returns the table of gateways, with all counters.
    pub fn gateways(&self) -> &GatewayTable {
        &self.gateways
    }

    /// Counts a sample of `hub` that did not fit into the memory that remote sensors may use.
    pub(crate) fn count_no_room(&mut self, hub: u64) {
        self.gateways.count_no_room(hub);
    }

    /// Returns the name of the sensor that sent `head`, for printing: its name, or `#` and its number.
    pub(crate) fn printed_name(&mut self, head: &Head) -> String {
        self.gateways.printed_name(head)
    }

    /// Handles `bytes`, a whole datagram that arrived at `arrival`. `from` identifies the sender, for example by its
    /// address and port. A sample that was sent in parts is written to `whole` once it is complete.
    pub fn receive<'a>(
        &mut self,
        bytes: &'a [u8],
        from: u64,
        arrival: WallTimestamp,
        whole: &'a mut Vec<u8>,
    ) -> ReceiveOutcome<'a> {
        self.receive_named(bytes, None, from, arrival, whole)
    }

    /// Does the same as [`receive`](Incoming::receive), for a network that delivers each datagram under a name. A
    /// datagram whose content does not match `name` is not handled.
    pub fn receive_named<'a>(
        &mut self,
        bytes: &'a [u8],
        name: Option<&Address<'_>>,
        from: u64,
        arrival: WallTimestamp,
        whole: &'a mut Vec<u8>,
    ) -> ReceiveOutcome<'a> {
        // Checksums are checked only here.
        let read = Datagram::read(bytes);
        if let Ok(datagram) = &read {
            if name.is_some_and(|name| !name.is_of(datagram, &self.gateways)) {
                return ReceiveOutcome::Foreign;
            }
            if !self.hubs.is_empty() && !self.hubs.contains(&datagram.head.hub) {
                return ReceiveOutcome::Ignored;
            }
        }
        let taken = read
            .and_then(|datagram| self.check_key(bytes, &datagram, arrival).map(|()| datagram))
            .and_then(|datagram| self.complete(datagram, from, whole));
        let datagram = match taken {
            Ok(Some(datagram)) => datagram,
            Ok(None) => return ReceiveOutcome::Part,
            Err(reason) => {
                self.gateways.refuse(reason);
                return match read {
                    Ok(Datagram { head, .. })
                        if reason == DatagramError::Untimely && head.topic == Announce::NUMBER =>
                    {
                        ReceiveOutcome::Untimely {
                            behind_ns: arrival.wall_ns.wrapping_sub(head.stamp_ns) as i64,
                        }
                    }
                    _ => ReceiveOutcome::Refused { reason, shared: None },
                };
            }
        };
        let head = &datagram.head;
        let may_move = self.key.is_some() && is_timely(head, arrival);
        match self.gateways.take(&datagram, from, may_move, arrival.monotonic_ns) {
            Ok(AcceptedDatagram { status: SequenceStatus::Duplicate, .. }) => ReceiveOutcome::Duplicate,
            Ok(accepted) => self.on_accepted(&datagram, &accepted, arrival),
            Err(reason) => {
                self.gateways.refuse(reason);
                let may_be_shared = matches!(reason, DatagramError::Epoch | DatagramError::Twin);
                let is_shared = may_be_shared && self.gateways.is_duplicate(head, arrival.monotonic_ns);
                ReceiveOutcome::Refused { reason, shared: is_shared.then_some(head.hub) }
            }
        }
    }

    /// If there is a key, checks that `datagram`, which was read from `bytes`, is authenticated. Also refuses the
    /// datagram if its epoch, or the stamp of a sensor's first announcement, shows that it may be a recorded one.
    fn check_key(
        &self,
        bytes: &[u8],
        datagram: &Datagram<'_>,
        arrival: WallTimestamp,
    ) -> Result<(), DatagramError> {
        let (Some(key), head) = (&self.key, &datagram.head) else { return Ok(()) };
        if !key.is_of(bytes, datagram.mac.ok_or(DatagramError::Unauthenticated)?) {
            return Err(DatagramError::Mac);
        }
        if self.gateways.stored_epoch(head.hub).is_some_and(|kept| head.epoch < kept) {
            return Err(DatagramError::Epoch);
        }
        if !self.gateways.is_announced(head) && !is_timely(head, arrival) {
            return Err(DatagramError::Untimely);
        }
        Ok(())
    }

    /// Returns the sample that `datagram` completes. That is `datagram` itself, unless it is a part: then the whole
    /// sample is written to `whole`. `None` if further parts of the sample are missing.
    fn complete<'a>(
        &mut self,
        datagram: Datagram<'a>,
        from: u64,
        whole: &'a mut Vec<u8>,
    ) -> Result<Option<Datagram<'a>>, DatagramError> {
        if datagram.head.parts == 1 {
            return Ok(Some(datagram));
        }
        let is_known = self.gateways.check_part(&datagram.head)?;
        let complete = self.reassembler.take(&datagram, from, is_known, whole);
        Ok(complete.map(|head| Datagram { head, payload: whole, mac: None }))
    }

    /// Handles a datagram that was accepted and is not a duplicate.
    fn on_accepted<'a>(
        &mut self,
        datagram: &Datagram<'a>,
        accepted: &AcceptedDatagram,
        arrival: WallTimestamp,
    ) -> ReceiveOutcome<'a> {
        let (head, late) = (datagram.head, accepted.status == SequenceStatus::Late);
        let (begins, arrival_ns) = (accepted.begins, arrival.monotonic_ns);
        let is_proven = self.key.is_some() || self.gateways.is_proven(head.hub, head.epoch);
        let Some(topic) = Topic::of_number(head.topic) else {
            // A late announcement is ignored, because a newer one arrived before it.
            let Some(announce) = accepted.announce.filter(|_| !late) else {
                return ReceiveOutcome::Duplicate;
            };
            let (behind_ns, is_named) = self.gateways.announce(&head, &announce, arrival.wall_ns);
            return ReceiveOutcome::Announced(Announcement {
                head,
                announce,
                arrival_ns,
                begins,
                is_named,
                behind_ns,
                is_proven,
            });
        };
        let announced = self.gateways.announced(head.hub, head.epoch, head.sensor).copied();
        // Bytes after the telegram belong to fields of a later revision.
        let (room, is_telegram) = (accepted.room, topic == Topic::Telegram);
        let bytes = if is_telegram { &datagram.payload[..room] } else { datagram.payload };
        let remote = ReceivedSample {
            topic,
            head,
            payload: CheckedPayload { bytes, room },
            boot: announced.map_or(0, |announced| announced.boot),
            arrival_ns,
            age_ns: self.gateways.age_ns(&head, arrival.wall_ns),
            late,
            authenticated: self.key.is_some(),
        };
        let missed = if late { 0 } else { accepted.missed };
        ReceiveOutcome::Sample(RemoteSample { remote, announced, begins, missed, is_proven })
    }
}

/// Returns whether `head` belongs to an announcement that was sent just now, by this machine's clock.
fn is_timely(head: &Head, arrival: WallTimestamp) -> bool {
    head.topic == Announce::NUMBER && arrival.wall_ns.abs_diff(head.stamp_ns) <= MAX_FIRST_CLOCK_DIFFERENCE_NS
}

#[cfg(test)]
mod tests {
    use scanhub_schema::Zones;
    use scanhub_schema::datagram::{Announced, HEADER_LEN, PORT, group};

    use super::*;

    const SECOND: u64 = 1_000_000_000;

    fn key() -> Key {
        Key::new(&[7; 32])
    }

    fn sealed(head: Head, pack: impl FnOnce(&mut [u8]) -> Option<usize>) -> Vec<u8> {
        let mut buffer = [0; 400];
        let len = pack(&mut buffer[HEADER_LEN..]).unwrap();
        let head = Head { revision: 1, hub: 5, ..head };
        head.seal_with(&mut buffer, len, |covered| key().mac(covered)).unwrap().to_vec()
    }

    /// Returns an announcement of sensor 0 that was sent at `at_s` of the gateway's clock. `next` is the next number of
    /// the zones.
    fn announcement(epoch: u32, sequence: u32, at_s: u64, next: u32) -> Vec<u8> {
        announced_of(1, epoch, sequence, at_s, next)
    }

    /// Returns an announcement of sensor 0 with `boot` as the run of its hub.
    fn announced_of(boot: u64, epoch: u32, sequence: u32, at_s: u64, next: u32) -> Vec<u8> {
        let mut announce = Announce::new(boot, "front", "");
        let topic = Topic::Zones;
        announce.add(Announced { topic: topic.number(), group: group(topic), port: PORT, next });
        sealed(Head { epoch, sequence, stamp_ns: at_s * SECOND, ..Head::default() }, |room| {
            announce.pack(room)
        })
    }

    fn zones(epoch: u32, sequence: u32) -> Vec<u8> {
        sealed(Head { topic: Topic::Zones.number(), epoch, sequence, ..Head::default() }, |room| {
            Zones::unknown().pack(room)
        })
    }

    fn listener(epochs: &[(u64, u32)]) -> Incoming {
        Incoming::with_key(&Topic::ALL, key(), epochs.iter().copied().collect())
    }

    /// Receives `bytes` from sender 1 at `at_s` of the listener's clock. Returns the reason if it is refused.
    fn receive(incoming: &mut Incoming, bytes: &[u8], at_s: u64) -> Option<DatagramError> {
        receive_from(1, incoming, bytes, at_s)
    }

    fn receive_from(from: u64, incoming: &mut Incoming, bytes: &[u8], at_s: u64) -> Option<DatagramError> {
        let arrival = WallTimestamp { monotonic_ns: at_s * SECOND, wall_ns: at_s * SECOND };
        match incoming.receive(bytes, from, arrival, &mut Vec::new()) {
            ReceiveOutcome::Refused { reason: why, .. } => Some(why),
            ReceiveOutcome::Untimely { .. } => Some(DatagramError::Untimely),
            _ => None,
        }
    }

    #[test]
    fn accepts_only_datagrams_with_the_key() {
        let mut incoming = listener(&[]);
        let mut plain = [0; 400];
        let len = Zones::unknown().pack(&mut plain[HEADER_LEN..]).unwrap();
        let head = Head { topic: Topic::Zones.number(), revision: 1, hub: 5, ..Head::default() };
        let bytes = head.seal(&mut plain, len).unwrap().to_vec();
        assert_eq!(receive(&mut incoming, &bytes, 100), Some(DatagramError::Unauthenticated));
        let other = head.seal_with(&mut plain, len, |covered| Key::new(&[8; 32]).mac(covered)).unwrap();
        assert_eq!(receive(&mut incoming, other, 100), Some(DatagramError::Mac));
        assert_eq!(receive(&mut incoming, &announcement(1, 0, 100, 0), 100), None);
        assert_eq!(receive(&mut incoming, &zones(1, 0), 100), None);
        let refused = |why| incoming.gateways().refused(why);
        assert_eq!([DatagramError::Unauthenticated, DatagramError::Mac].map(refused), [1, 1]);
    }

    #[test]
    fn refuses_replayed_recording() {
        let recorded = [announcement(1, 3, 100, 40), zones(1, 40), zones(1, 41)];
        let mut incoming = listener(&[]);
        let again = recorded.each_ref().map(|bytes| receive(&mut incoming, bytes, 200));
        assert_eq!(again, [Some(DatagramError::Untimely); 3], "the gateway has exited");
        // The gateway continues. Its announcement is accepted, but nothing that was sent before that announcement.
        assert_eq!(receive(&mut incoming, &zones(1, 90), 200), Some(DatagramError::Untimely));
        assert_eq!(receive(&mut incoming, &announcement(1, 50, 200, 91), 203), None);
        assert_eq!(receive(&mut incoming, &zones(1, 91), 203), None);
        let again = recorded.each_ref().map(|bytes| receive(&mut incoming, bytes, 204));
        assert_eq!(again, [Some(DatagramError::Stale); 3]);
        let clocks = [announcement(2, 0, 94, 0), announcement(2, 0, 106, 0)];
        let refused = clocks.map(|bytes| receive(&mut listener(&[]), &bytes, 100));
        assert_eq!(refused, [Some(DatagramError::Untimely); 2]);
    }

    #[test]
    fn epochs_only_increase_over_restarts() {
        let mut incoming = listener(&[]);
        assert_eq!(receive(&mut incoming, &announcement(7, 0, 100, 0), 100), None);
        let kept: Vec<_> =
            incoming.take_epochs().unwrap().iter().map(|(hub, epoch)| (*hub, *epoch)).collect();
        assert_eq!((kept.as_slice(), incoming.take_epochs()), (&[(5, 7)][..], None));
        let mut next = listener(&kept);
        assert_eq!(receive(&mut next, &announcement(6, 0, 100, 0), 100), Some(DatagramError::Epoch));
        assert_eq!(receive(&mut next, &announcement(7, 1, 101, 0), 101), None);
        assert_eq!(
            (receive(&mut next, &announcement(8, 0, 102, 0), 102), next.take_epochs().is_some()),
            (None, true)
        );
        assert_eq!(receive(&mut next, &zones(7, 0), 102), Some(DatagramError::Epoch));
    }

    #[test]
    fn refuses_other_sender_of_a_silent_gateway() {
        let mut incoming = listener(&[]);
        assert_eq!(receive(&mut incoming, &announcement(7, 0, 100, 0), 100), None);
        assert_eq!(receive_from(2, &mut incoming, &zones(7, 0), 110), Some(DatagramError::Twin));
    }

    #[test]
    fn gateway_may_move_while_its_hub_restarts() {
        let mut incoming = listener(&[]);
        let twin = Some(DatagramError::Twin);
        assert_eq!(receive(&mut incoming, &announcement(7, 4, 100, 0), 100), None);
        assert_eq!(receive(&mut incoming, &zones(7, 0), 100), None);
        let mut moved = |bytes: &[u8], at_s| receive_from(2, &mut incoming, bytes, at_s);
        assert_eq!(moved(&announced_of(2, 7, 5, 102, 1), 102), twin, "the old address has just sent");
        assert_eq!(moved(&announced_of(2, 7, 6, 104, 1), 110), twin, "recorded");
        assert_eq!(moved(&announced_of(2, 7, 4, 110, 1), 110), twin, "a number that has arrived");
        assert_eq!(moved(&zones(7, 1), 110), twin, "not announced from there yet");
        assert_eq!(moved(&announced_of(2, 7, 8, 110, 1), 110), None);
        assert_eq!(moved(&zones(7, 0), 110), None, "a duplicate");
        assert_eq!(moved(&zones(7, 1), 110), None);
        assert_eq!(incoming.gateways().rows().map(|row| row.received).sum::<u64>(), 4);
        assert_eq!(receive(&mut incoming, &announcement(7, 9, 110, 1), 110), None, "and back, the same boot");
        assert_eq!(receive(&mut incoming, &zones(7, 2), 110), None);
    }

    #[test]
    fn refuses_replayed_parts_before_storing_them() {
        let mut incoming = listener(&[]);
        let part = |sequence, part| {
            let topic = Topic::Zones.number();
            let head = Head { topic, epoch: 7, sequence, part, parts: 2, ..Head::default() };
            sealed(head, |room| {
                let len = Zones::unknown().pack(room)? / 2;
                room.copy_within(len * usize::from(part)..len * (usize::from(part) + 1), 0);
                Some(len)
            })
        };
        assert_eq!(receive(&mut incoming, &announcement(7, 0, 100, 40), 100), None);
        assert_eq!(receive(&mut incoming, &part(39, 0), 100), Some(DatagramError::Stale));
        assert_eq!([0, 1].map(|at| receive(&mut incoming, &part(40, at), 100)), [None; 2]);
        // A new partial sample is kept, no matter how many complete samples are sent again in the meantime.
        assert_eq!(receive(&mut incoming, &part(60, 0), 101), None);
        for sequence in (41..50).chain(52..60) {
            [0, 1].iter().for_each(|&at| assert_eq!(receive(&mut incoming, &part(sequence, at), 101), None));
        }
        for sequence in 41..50 {
            assert_eq!(receive(&mut incoming, &part(sequence, 0), 101), None);
        }
        assert_eq!(receive(&mut incoming, &part(60, 1), 101), None);
        let received: u64 =
            incoming.gateways().rows().filter(|row| row.topic != 0).map(|row| row.received).sum();
        assert_eq!((received, incoming.gateways().refused(DatagramError::Stale)), (19, 1));
    }

    /// Returns a datagram with zones of gateway 5, without a MAC.
    fn plain_zones(epoch: u32, sequence: u32) -> Vec<u8> {
        let mut buffer = [0; 100];
        let len = Zones::unknown().pack(&mut buffer[HEADER_LEN..]).unwrap();
        let topic = Topic::Zones.number();
        let head = Head { topic, revision: 1, hub: 5, epoch, sequence, ..Head::default() };
        head.seal(&mut buffer, len).unwrap().to_vec()
    }

    #[test]
    fn run_begins_once_even_in_one_instant() {
        let mut incoming = Incoming::new(&Topic::ALL);
        let mut begins = |epoch, sequence, from, ms: u64| {
            let arrival = WallTimestamp { monotonic_ns: ms * 1_000_000, wall_ns: 0 };
            let bytes = plain_zones(epoch, sequence);
            let mut whole = Vec::new();
            let arrived = incoming.receive(&bytes, from, arrival, &mut whole);
            arrived.begins().map(|head| head.epoch)
        };
        assert_eq!([begins(7, 0, 1, 10), begins(7, 1, 1, 10), begins(7, 2, 1, 11)], [Some(7), None, None]);
        assert_eq!([begins(8, 0, 1, 11), begins(8, 1, 1, 11), begins(7, 3, 1, 11)], [Some(8), None, None]);
        assert_eq!([begins(8, 0, 2, 3000), begins(8, 0, 2, 3011)], [None, Some(8)], "another gateway");
    }

    #[test]
    fn receives_only_from_selected_hubs() {
        let mut incoming = Incoming::new(&Topic::ALL).with_hubs(vec![4, 5]);
        let mut is_ignored = |bytes: &[u8]| {
            matches!(
                incoming.receive(bytes, 1, WallTimestamp::default(), &mut Vec::new()),
                ReceiveOutcome::Ignored
            )
        };
        let other = Head { hub: 6, ..Head::default() }.seal(&mut [0; HEADER_LEN], 0).unwrap().to_vec();
        assert!(is_ignored(&other) && !is_ignored(&plain_zones(1, 0)));
        assert!(!is_ignored(b"a broken datagram is counted"));
        assert_eq!(DatagramError::ALL.map(|why| incoming.gateways().refused(why)).iter().sum::<u64>(), 1);
    }
}
