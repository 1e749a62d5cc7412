//! Tests of the sending end, from samples to datagrams.

use std::num::NonZeroU64;
use std::time::Duration;

use crate::lan::GatewayTable;
use scanhub_schema::datagram::{Announce, Datagram, HEADER_LEN, Head, MIN_MTU, MTU_SAFE};
use scanhub_schema::{
    Background, BackgroundHead, Early, Family, Flags, Header, Status, Topic, Verdict, Zones,
};

use super::{Form, Outgoing, PayloadRef, Sample, Transmit};
use crate::lan::{Key, WallTimestamp};

/// A network that records datagrams, and may refuse them.
#[derive(Default)]
struct RecordingNetwork {
    datagrams: Vec<(Vec<u8>, u8, u8)>,
    is_cut: bool,
}

impl Transmit for RecordingNetwork {
    fn transmit(&mut self, datagram: &[u8], group: u8, above: u8) -> bool {
        self.datagrams.push((datagram.to_vec(), group, above));
        !self.is_cut
    }
}

impl RecordingNetwork {
    /// Returns the headers of the datagrams since the last call.
    fn heads(&mut self) -> Vec<Head> {
        let all = std::mem::take(&mut self.datagrams);
        all.iter().map(|(bytes, ..)| Datagram::read(bytes).expect("a datagram").head).collect()
    }

    /// Returns the topic and sequence number of each datagram since the last call.
    fn numbers(&mut self) -> Vec<(u8, u32)> {
        self.heads().iter().map(|head| (head.topic, head.sequence)).collect()
    }
}

const ZONES: u8 = Topic::Zones as u8 + 1;
const EARLY: u8 = Topic::Early as u8 + 1;
const BACKGROUND: u8 = Topic::Background as u8 + 1;

fn outgoing(form: Form) -> Outgoing {
    Outgoing::new(7, 9, form, MTU_SAFE)
}

fn each(_: Topic) -> Option<NonZeroU64> {
    Some(NonZeroU64::MIN)
}

fn at(ms: u64) -> WallTimestamp {
    WallTimestamp { monotonic_ns: ms * 1_000_000, wall_ns: 5_000_000_000 + ms * 1_000_000 }
}

fn header(boot: u64, sensor: u8, seq: u64) -> Header {
    Header { boot, sensor, seq, wall_ns: 4_000_000_000 + seq, ..Header::default() }
}

fn zones(verdict: Verdict) -> Zones {
    Zones { verdict: verdict as u8, ..Zones::unknown() }
}

/// Sends zones. Returns the topics and sequence numbers of the datagrams.
fn send(out: &mut Outgoing, sensor: usize, header: Option<Header>, verdict: Verdict) -> Vec<(u8, u32)> {
    let (mut network, zones) = (RecordingNetwork::default(), zones(verdict));
    let sample = Sample { header: header.as_ref(), missed: 0, payload: PayloadRef::Zones(&zones) };
    out.sample(sensor, &sample, at(0), &mut network);
    network.numbers()
}

#[test]
fn announces_each_run_of_the_hub_before_samples() {
    let mut out = outgoing(Form::Sealed);
    let front = out.follow("front", each);
    assert_eq!((out.position("front"), out.position("rear")), (Some(front), None));
    let mut send = |boot, seq| send(&mut out, front, Some(header(boot, 3, seq)), Verdict::Clear);
    assert_eq!(send(1, 0), [(Announce::NUMBER, 0), (ZONES, 0)]);
    assert_eq!(send(1, 1), [(ZONES, 1)]);
    assert_eq!(send(2, 0), [(Announce::NUMBER, 1), (ZONES, 2)]);
    let mut network = RecordingNetwork::default();
    out.announce(at(1000), &mut network);
    let (bytes, group, above) = &network.datagrams[0];
    let Datagram { head, payload, .. } = Datagram::read(bytes).unwrap();
    let announce = Announce::unpack(payload).unwrap();
    assert_eq!((announce.sensor(), announce.boot, announce.topics().len()), ("front", 2, Topic::ALL.len()));
    assert_eq!(announce.topics()[Topic::Zones as usize].next, 3);
    assert_eq!((head.hub, head.epoch, head.sensor, head.stamp_ns), (7, 9, 3, 6_000_000_000));
    assert_eq!((*group, *above), (Announce::GROUP, 0));
}

#[test]
fn thinned_samples_use_no_number_and_unknown_is_sent() {
    let mut out = outgoing(Form::Sealed);
    let front = out.follow("front", |topic| NonZeroU64::new(4).filter(|_| topic == Topic::Zones));
    let mut send = |seq, verdict| send(&mut out, front, Some(header(1, 0, seq)), verdict);
    assert_eq!(send(0, Verdict::Clear), [(Announce::NUMBER, 0), (ZONES, 0)]);
    assert_eq!(send(1, Verdict::Stop), []);
    assert_eq!(send(2, Verdict::Unknown), [(ZONES, 1)]);
    assert_eq!(send(3, Verdict::Unknown), []);
    assert_eq!(send(4, Verdict::Clear), [(ZONES, 2)]);
    assert!(
        out.needs(front, Topic::Zones) && out.needs(front, Topic::Status),
        "announcements need the type in the status"
    );
    assert!(!out.needs(front, Topic::Scan));
}

#[test]
fn warnings_are_thinned_like_their_zones() {
    let mut out = outgoing(Form::Sealed);
    let thinned = |topic| NonZeroU64::new(2).filter(|_| matches!(topic, Topic::Zones | Topic::Early));
    let front = out.follow("front", thinned);
    let of = |seq| {
        let mut header = Header { family: Family::Ld as u8, ..header(1, 0, seq) };
        header.set_sent_at(1_000 + seq);
        header
    };
    let mut sent = Vec::new();
    for revolution in 0..6 {
        let mut network = RecordingNetwork::default();
        let warning = Early { verdict: Verdict::Slow as u8, ..Early::default() };
        // Each packet of a revolution has a number. Zones have the number of the last packet.
        for (seq, payload) in [
            (20 * revolution + 7, PayloadRef::Early(&warning)),
            (20 * revolution + 19, PayloadRef::Zones(&zones(Verdict::Slow))),
        ] {
            let sample = Sample { header: Some(&of(seq)), missed: 0, payload };
            out.sample(front, &sample, at(0), &mut network);
        }
        let topics = network.numbers().into_iter().map(|(topic, _)| topic);
        sent.push(topics.filter(|topic| *topic != Announce::NUMBER).collect::<Vec<u8>>());
    }
    let both = vec![EARLY, ZONES];
    assert_eq!(sent, [both.clone(), vec![], both.clone(), vec![], both, vec![]]);
}

#[test]
fn silence_is_sent_as_unknown_zones() {
    let mut out = outgoing(Form::Sealed);
    let (front, rear) = (out.follow("front", each), out.follow("rear", each));
    assert_eq!(send(&mut out, front, None, Verdict::Unknown), [], "no sample yet");
    assert_eq!(send(&mut out, front, Some(header(1, 0, 0)), Verdict::Clear).len(), 2);
    assert_eq!(send(&mut out, front, None, Verdict::Unknown), [(ZONES, 1)]);
    // The hub restarts with its sensors in another order. Samples of the earlier run are dropped.
    assert_eq!(send(&mut out, rear, Some(header(2, 0, 0)), Verdict::Clear), [(0, 1), (ZONES, 2)]);
    assert_eq!(send(&mut out, front, None, Verdict::Unknown), []);
    assert_eq!(send(&mut out, front, Some(header(1, 0, 1)), Verdict::Clear), []);
    let names: Vec<_> = out.counters().map(|stats| stats.name.as_str()).collect();
    assert_eq!(names, ["rear"]);
}

#[test]
fn does_not_forward_samples_of_other_machines() {
    let mut out = outgoing(Form::Sealed);
    let front = out.follow("front", each);
    let remote = Header { flags: Flags::REMOTE, ..header(1, 0, 0) };
    assert_eq!(send(&mut out, front, Some(remote), Verdict::Clear), []);
}

#[test]
fn sends_new_and_repeated_backgrounds() {
    let mut out = outgoing(Form::Sealed);
    let front = out.follow("front", each);
    let mut network = RecordingNetwork::default();
    let mut send = |out: &mut Outgoing, seq, generation, ms| {
        let background = Background::of(BackgroundHead { generation, ..BackgroundHead::default() }, &[]);
        let header = header(1, 0, seq);
        let payload = PayloadRef::Background(&background);
        out.sample(front, &Sample { header: Some(&header), missed: 0, payload }, at(ms), &mut network);
        network.numbers()
    };
    assert_eq!(send(&mut out, 0, 1, 0), [(Announce::NUMBER, 0), (BACKGROUND, 0)]);
    assert_eq!(send(&mut out, 1, 1, 900), [], "to a late joiner");
    assert_eq!(send(&mut out, 2, 2, 1000), [(BACKGROUND, 1)]);
    let mut repeat = |ms| {
        out.repeat(Duration::from_secs(1), at(ms), &mut network);
        network.numbers()
    };
    assert_eq!(repeat(1999), []);
    assert_eq!(repeat(2000), [(BACKGROUND, 2)]);
    assert_eq!(repeat(2500), []);
}

#[test]
fn status_has_send_time_and_sets_announced_type() {
    let (mut out, mut network) = (outgoing(Form::Sealed), RecordingNetwork::default());
    let front = out.follow("front", each);
    let (header, mut status) = (header(1, 0, 0), Status::default());
    status.set_sensor_type("LMS200");
    let sample = Sample { header: Some(&header), missed: 3, payload: PayloadRef::Status(&status) };
    out.sample(front, &sample, at(70), &mut network);
    let kind = Announce::unpack(Datagram::read(&network.datagrams[0].0).unwrap().payload).unwrap();
    assert_eq!(kind.kind(), "LMS200");
    let stamps: Vec<_> = network.heads().iter().map(|head| head.stamp_ns).collect();
    assert_eq!(stamps, [5_070_000_000, 5_070_000_000]);
    let missed: Vec<_> =
        out.counters().flat_map(|stats| stats.used_topics()).map(|(_, row)| row.missed).collect();
    assert_eq!(missed, [0, 3]);
}

#[test]
fn failures_use_numbers_and_oversize_is_reported_once() {
    // The telegram does not fit into 255 parts.
    let mut out = Outgoing::new(7, 9, Form::Sealed, HEADER_LEN + 2);
    let front = out.follow("front", |topic| NonZeroU64::new(1).filter(|_| topic != Topic::Status));
    let mut network = RecordingNetwork { is_cut: true, ..RecordingNetwork::default() };
    let (header, zones, telegram) = (header(1, 0, 0), Zones::unknown(), [2; 511]);
    for payload in [PayloadRef::Zones(&zones), PayloadRef::Telegram(&telegram), PayloadRef::Zones(&zones)] {
        out.sample(front, &Sample { header: Some(&header), missed: 0, payload }, at(0), &mut network);
        network.is_cut = false;
    }
    let mut numbers = network.numbers();
    numbers.dedup();
    assert_eq!(numbers, [(Announce::NUMBER, 0), (ZONES, 0), (ZONES, 1)]);
    let counts: Vec<_> = out.counters().flat_map(|stats| stats.used_topics()).map(|(_, row)| row).collect();
    let counts: Vec<_> = counts.iter().map(|row| (row.sent, row.failed, row.next_number())).collect();
    assert_eq!(counts, [(0, 1, 1), (0, 1, 1), (1, 1, 2)]);
    assert_eq!(
        (out.take_oversized().as_deref(), out.take_oversized(), out.oversized_samples()),
        (Some("front/telegram"), None, 1)
    );
}

#[test]
fn sends_long_samples_in_parts() {
    let telegram: Vec<u8> = (0..814).map(|i| i as u8).collect();
    for (longest, lengths) in
        [(MTU_SAFE, &[814][..]), (MIN_MTU, &[528, 286]), (HEADER_LEN + 407, &[407, 407])]
    {
        let mut out = Outgoing::new(7, 9, Form::Sealed, longest);
        let front = out.follow("front", |topic| NonZeroU64::new(1).filter(|_| topic == Topic::Telegram));
        let mut network = RecordingNetwork::default();
        let payload = PayloadRef::Telegram(&telegram);
        for seq in 0..2 {
            let header = header(1, 5, seq);
            network.datagrams.clear();
            out.sample(front, &Sample { header: Some(&header), missed: 0, payload }, at(0), &mut network);
            network.datagrams.retain(|(bytes, ..)| bytes[6] == Topic::Telegram.number());
            let parts: Vec<_> =
                network.datagrams.iter().map(|(bytes, ..)| Datagram::read(bytes).unwrap()).collect();
            let numbers: Vec<_> = parts.iter().map(|it| (it.head.sequence, it.head.part)).collect();
            assert_eq!(numbers, (0..lengths.len()).map(|part| (seq as u32, part as u8)).collect::<Vec<_>>());
            assert!(parts.iter().all(|it| usize::from(it.head.parts) == lengths.len()));
            assert!(parts.iter().map(|it| it.payload.len()).eq(lengths.iter().copied()));
            assert_eq!(parts.iter().flat_map(|it| it.payload).copied().collect::<Vec<_>>(), telegram);
        }
        let (_, row) = out.counters().flat_map(|stats| stats.used_topics()).last().unwrap();
        assert_eq!((row.sent, row.failed, row.bytes), (2, 0, 2 * (814 + HEADER_LEN * lengths.len()) as u64));
    }
}

#[test]
fn sends_other_parts_after_a_failed_one() {
    let mut out = Outgoing::new(7, 9, Form::Sealed, MIN_MTU);
    let front = out.follow("front", |topic| NonZeroU64::new(1).filter(|_| topic == Topic::Telegram));
    let (mut network, header, payload) =
        (RecordingNetwork { is_cut: true, ..RecordingNetwork::default() }, header(1, 5, 0), [2; 814]);
    let sample = Sample { header: Some(&header), missed: 0, payload: PayloadRef::Telegram(&payload) };
    out.sample(front, &sample, at(0), &mut network);
    assert_eq!(network.numbers(), [(Announce::NUMBER, 0), (1, 0), (1, 0)]);
    let (_, row) = out.counters().flat_map(|stats| stats.used_topics()).last().unwrap();
    assert_eq!((row.sent, row.failed, row.bytes), (0, 1, 0));
}

#[test]
fn sends_bare_telegrams_to_the_port_of_their_sensor() {
    let (mut out, mut network) = (outgoing(Form::Bare), RecordingNetwork::default());
    let front = out.follow("front", |topic| NonZeroU64::new(1).filter(|_| topic == Topic::Telegram));
    assert!(!out.needs(front, Topic::Status));
    let header = header(1, 5, 0);
    let sample = Sample { header: Some(&header), missed: 0, payload: PayloadRef::Telegram(b"\x02bytes") };
    out.sample(front, &sample, at(0), &mut network);
    out.announce(at(1000), &mut network);
    assert_eq!(network.datagrams, [(b"\x02bytes".to_vec(), 83, 5)]);
}

#[test]
fn authenticates_each_part_without_damaging_the_next() {
    let key = Key::new(&[7; 32]);
    let mut out = Outgoing::new(7, 9, Form::Authenticated(key.clone()), MIN_MTU);
    let front = out.follow("front", each);
    let telegram: Vec<u8> = (0..2000_u32).map(|n| (n * 7) as u8).collect();
    let header = header(1, 3, 0);
    let sample = Sample { header: Some(&header), missed: 0, payload: PayloadRef::Telegram(&telegram) };
    let mut network = RecordingNetwork::default();
    out.sample(front, &sample, at(0), &mut network);
    let mut whole: Vec<u8> = Vec::new();
    for (bytes, ..) in &network.datagrams {
        let datagram = Datagram::read(bytes).expect("a datagram");
        assert!(bytes.len() <= MIN_MTU && key.is_of(bytes, datagram.mac.expect("a MAC")));
        if datagram.head.topic == Topic::Telegram.number() {
            whole.extend(datagram.payload);
        }
    }
    assert!(
        whole == telegram && network.datagrams.len() == 1 + 2000_usize.div_ceil(MIN_MTU - HEADER_LEN - 16)
    );
}

/// Adds zones to the queue.
fn wait(out: &mut Outgoing, sensor: usize, seq: u64) {
    assert_eq!(send(out, sensor, Some(header(1, 0, seq)), Verdict::Clear), []);
}

/// Takes all waiting samples in order, and returns their datagrams.
fn take_all(out: &mut Outgoing) -> Vec<Vec<u8>> {
    let mut all = Vec::new();
    while let Some(sample) = out.take_next(at(700)) {
        all.push(sample.datagram.to_vec());
    }
    all
}

/// Returns how many zones a new receiver counts as received and as lost.
fn count_zones(datagrams: &[&[u8]]) -> (u64, u64) {
    let mut stats = GatewayTable::new(&Topic::ALL);
    for bytes in datagrams {
        stats.receive(bytes, 1, 0).expect("a datagram");
    }
    let zones = stats.rows().find(|row| row.topic == ZONES);
    zones.map_or((0, 0), |row| (row.received, row.lost()))
}

#[test]
fn late_receiver_counts_no_earlier_samples_as_lost() {
    let mut out = Outgoing::with_queue(7, 9);
    let front = out.follow("front", each);
    for seq in 0..100 {
        wait(&mut out, front, seq);
        take_all(&mut out);
    }
    // Zones are queued before the announcement, so that they get a number before the announcement is sent.
    wait(&mut out, front, 100);
    out.announce(at(0), &mut RecordingNetwork::default());
    let [_, announced] = &take_all(&mut out)[..] else { panic!("zones and an announcement") };
    for seq in 101..110 {
        wait(&mut out, front, seq);
        take_all(&mut out);
    }
    let head = Datagram::read(announced).expect("a datagram").head;
    assert_eq!(head.stamp_ns, at(700).wall_ns, "when it is sent, not when it began to wait");
    let resent = out.resend_last("front", None, at(900)).expect("an announcement").to_vec();
    wait(&mut out, front, 110);
    let [zones] = &take_all(&mut out)[..] else { panic!("zones") };
    assert_eq!(count_zones(&[&resent, zones]), (1, 0), "it has the numbers of now");
    assert_eq!(count_zones(&[announced, zones]), (1, 9), "nine were sent after the announcement");
    assert_eq!(count_zones(&[announced, &resent, zones]), (1, 9), "the same number");
    assert_eq!(count_zones(&[&resent, announced, zones]), (1, 0), "in either order");
}

#[test]
fn payload_packs_itself_for_its_topic() {
    let (mut room, unknown) = ([0; 20], Zones::unknown());
    let (zones, telegram) = (PayloadRef::Zones(&unknown), PayloadRef::Telegram(&[2, 0x80, 0]));
    assert_eq!((zones.topic(), telegram.topic()), (Topic::Zones, Topic::Telegram));
    assert_eq!((zones.pack(&mut room), zones.pack(&mut room[..11])), (Some(12), None));
    assert_eq!((telegram.pack(&mut room), telegram.pack(&mut room[..2])), (Some(3), None));
    assert_eq!(room[..3], [2, 0x80, 0]);
}
