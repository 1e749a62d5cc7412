//! What goes out of which samples.

use std::num::NonZeroU64;
use std::time::Duration;

use crate::lan::GatewayTable;
use scanhub_schema::datagram::{Announce, Datagram, HEAD, Head, MTU_LEAST, MTU_SAFE};
use scanhub_schema::{
    Background, BackgroundHead, Early, Family, Flags, Header, Status, Topic, Verdict, Zones,
};

use super::{Form, Outgoing, PayloadRef, Sample, Transmit};
use crate::lan::{Key, Stamp};

/// What went out, and whether it is taken.
#[derive(Default)]
struct Taken {
    datagrams: Vec<(Vec<u8>, u8, u8)>,
    is_cut: bool,
}

impl Transmit for Taken {
    fn transmit(&mut self, datagram: &[u8], group: u8, above: u8) -> bool {
        self.datagrams.push((datagram.to_vec(), group, above));
        !self.is_cut
    }
}

impl Taken {
    /// The headers of what went out since the last call.
    fn heads(&mut self) -> Vec<Head> {
        let all = std::mem::take(&mut self.datagrams);
        all.iter().map(|(bytes, ..)| Datagram::read(bytes).expect("a datagram").head).collect()
    }

    /// Topic's number and sequence of what went out since the last call.
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

fn at(ms: u64) -> Stamp {
    Stamp { monotonic_ns: ms * 1_000_000, wall_ns: 5_000_000_000 + ms * 1_000_000 }
}

fn header(boot: u64, sensor: u8, seq: u64) -> Header {
    Header { boot, sensor, seq, wall_ns: 4_000_000_000 + seq, ..Header::default() }
}

fn zones(verdict: Verdict) -> Zones {
    Zones { verdict: verdict as u8, ..Zones::unknown() }
}

/// Sends zones; topics and numbers of what went out.
fn send(out: &mut Outgoing, sensor: usize, header: Option<Header>, verdict: Verdict) -> Vec<(u8, u32)> {
    let (mut taken, zones) = (Taken::default(), zones(verdict));
    let sample = Sample { header: header.as_ref(), missed: 0, payload: PayloadRef::Zones(&zones) };
    out.sample(sensor, &sample, at(0), &mut taken);
    taken.numbers()
}

#[test]
fn each_life_of_the_hub_is_announced_before_its_first_sample() {
    let mut out = outgoing(Form::Sealed);
    let front = out.follow("front", each);
    assert_eq!((out.position("front"), out.position("rear")), (Some(front), None));
    let mut send = |boot, seq| send(&mut out, front, Some(header(boot, 3, seq)), Verdict::Clear);
    assert_eq!(send(1, 0), [(Announce::NUMBER, 0), (ZONES, 0)]);
    assert_eq!(send(1, 1), [(ZONES, 1)]);
    assert_eq!(send(2, 0), [(Announce::NUMBER, 1), (ZONES, 2)]);
    let mut taken = Taken::default();
    out.announce(at(1000), &mut taken);
    let (bytes, group, above) = &taken.datagrams[0];
    let Datagram { head, payload, .. } = Datagram::read(bytes).unwrap();
    let announce = Announce::unpack(payload).unwrap();
    assert_eq!((announce.sensor(), announce.boot, announce.topics().len()), ("front", 2, Topic::ALL.len()));
    assert_eq!(announce.topics()[Topic::Zones as usize].next, 3);
    assert_eq!((head.hub, head.epoch, head.sensor, head.stamp_ns), (7, 9, 3, 6_000_000_000));
    assert_eq!((*group, *above), (Announce::GROUP, 0));
}

#[test]
fn what_is_thinned_has_no_number_and_what_is_unknown_is_not_thinned() {
    let mut out = outgoing(Form::Sealed);
    let front = out.follow("front", |topic| NonZeroU64::new(4).filter(|_| topic == Topic::Zones));
    let mut send = |seq, verdict| send(&mut out, front, Some(header(1, 0, seq)), verdict);
    assert_eq!(send(0, Verdict::Clear), [(Announce::NUMBER, 0), (ZONES, 0)]);
    assert_eq!(send(1, Verdict::Stop), []);
    assert_eq!(send(2, Verdict::Unknown), [(ZONES, 1)]);
    assert_eq!(send(3, Verdict::Unknown), []);
    assert_eq!(send(4, Verdict::Clear), [(ZONES, 2)]);
    assert!(out.wants(front, Topic::Zones) && out.wants(front, Topic::Status), "its status says its type");
    assert!(!out.wants(front, Topic::Scan));
}

#[test]
fn warnings_of_a_turn_are_no_turn_of_their_own_and_go_with_its_zones() {
    let mut out = outgoing(Form::Sealed);
    let thinned = |topic| NonZeroU64::new(2).filter(|_| matches!(topic, Topic::Zones | Topic::Early));
    let front = out.follow("front", thinned);
    let of = |seq| {
        let mut header = Header { family: Family::Ld as u8, ..header(1, 0, seq) };
        header.set_sent_at(1_000 + seq);
        header
    };
    let mut gone = Vec::new();
    for turn in 0..6 {
        let mut taken = Taken::default();
        let warning = Early { verdict: Verdict::Slow as u8, ..Early::default() };
        // The packets of a turn have numbers, and its last one is that of its zones.
        for (seq, payload) in [
            (20 * turn + 7, PayloadRef::Early(&warning)),
            (20 * turn + 19, PayloadRef::Zones(&zones(Verdict::Slow))),
        ] {
            let sample = Sample { header: Some(&of(seq)), missed: 0, payload };
            out.sample(front, &sample, at(0), &mut taken);
        }
        let topics = taken.numbers().into_iter().map(|(topic, _)| topic);
        gone.push(topics.filter(|topic| *topic != Announce::NUMBER).collect::<Vec<u8>>());
    }
    let both = vec![EARLY, ZONES];
    assert_eq!(gone, [both.clone(), vec![], both.clone(), vec![], both, vec![]]);
}

#[test]
fn a_silence_is_unknown_zones_of_the_last_sensor() {
    let mut out = outgoing(Form::Sealed);
    let (front, rear) = (out.follow("front", each), out.follow("rear", each));
    assert_eq!(send(&mut out, front, None, Verdict::Unknown), [], "nobody spoke yet");
    assert_eq!(send(&mut out, front, Some(header(1, 0, 0)), Verdict::Clear).len(), 2);
    assert_eq!(send(&mut out, front, None, Verdict::Unknown), [(ZONES, 1)]);
    // The hub starts again with its sensors in another order: what is left of before is of nobody.
    assert_eq!(send(&mut out, rear, Some(header(2, 0, 0)), Verdict::Clear), [(0, 1), (ZONES, 2)]);
    assert_eq!(send(&mut out, front, None, Verdict::Unknown), []);
    assert_eq!(send(&mut out, front, Some(header(1, 0, 1)), Verdict::Clear), []);
    let names: Vec<_> = out.account().map(|rows| rows.name.as_str()).collect();
    assert_eq!(names, ["rear"]);
}

#[test]
fn what_came_from_another_machine_is_not_sent_on() {
    let mut out = outgoing(Form::Sealed);
    let front = out.follow("front", each);
    let remote = Header { flags: Flags::REMOTE, ..header(1, 0, 0) };
    assert_eq!(send(&mut out, front, Some(remote), Verdict::Clear), []);
}

#[test]
fn a_background_goes_out_when_it_is_new_and_when_it_is_to_be_repeated() {
    let mut out = outgoing(Form::Sealed);
    let front = out.follow("front", each);
    let mut taken = Taken::default();
    let mut send = |out: &mut Outgoing, seq, generation, ms| {
        let background = Background::of(BackgroundHead { generation, ..BackgroundHead::default() }, &[]);
        let header = header(1, 0, seq);
        let payload = PayloadRef::Background(&background);
        out.sample(front, &Sample { header: Some(&header), missed: 0, payload }, at(ms), &mut taken);
        taken.numbers()
    };
    assert_eq!(send(&mut out, 0, 1, 0), [(Announce::NUMBER, 0), (BACKGROUND, 0)]);
    assert_eq!(send(&mut out, 1, 1, 900), [], "to a late joiner");
    assert_eq!(send(&mut out, 2, 2, 1000), [(BACKGROUND, 1)]);
    let mut repeat = |ms| {
        out.repeat(Duration::from_secs(1), at(ms), &mut taken);
        taken.numbers()
    };
    assert_eq!(repeat(1999), []);
    assert_eq!(repeat(2000), [(BACKGROUND, 2)]);
    assert_eq!(repeat(2500), []);
}

#[test]
fn a_status_is_stamped_when_it_is_sent_and_tells_the_type() {
    let (mut out, mut taken) = (outgoing(Form::Sealed), Taken::default());
    let front = out.follow("front", each);
    let (header, mut status) = (header(1, 0, 0), Status::default());
    status.set_sensor_type("LMS200");
    let sample = Sample { header: Some(&header), missed: 3, payload: PayloadRef::Status(&status) };
    out.sample(front, &sample, at(70), &mut taken);
    let kind = Announce::unpack(Datagram::read(&taken.datagrams[0].0).unwrap().payload).unwrap();
    assert_eq!(kind.kind(), "LMS200");
    let stamps: Vec<_> = taken.heads().iter().map(|head| head.stamp_ns).collect();
    assert_eq!(stamps, [5_070_000_000, 5_070_000_000]);
    let missed: Vec<_> = out.account().flat_map(|rows| rows.used()).map(|(_, row)| row.missed).collect();
    assert_eq!(missed, [0, 3]);
}

#[test]
fn a_failure_uses_the_number_up_and_what_does_not_fit_is_told_once() {
    // Of the telegram 255 parts are not enough.
    let mut out = Outgoing::new(7, 9, Form::Sealed, HEAD + 2);
    let front = out.follow("front", |topic| NonZeroU64::new(1).filter(|_| topic != Topic::Status));
    let mut taken = Taken { is_cut: true, ..Taken::default() };
    let (header, zones, telegram) = (header(1, 0, 0), Zones::unknown(), [2; 511]);
    for payload in [PayloadRef::Zones(&zones), PayloadRef::Telegram(&telegram), PayloadRef::Zones(&zones)] {
        out.sample(front, &Sample { header: Some(&header), missed: 0, payload }, at(0), &mut taken);
        taken.is_cut = false;
    }
    let mut numbers = taken.numbers();
    numbers.dedup();
    assert_eq!(numbers, [(Announce::NUMBER, 0), (ZONES, 0), (ZONES, 1)]);
    let counts: Vec<_> = out.account().flat_map(|rows| rows.used()).map(|(_, row)| row).collect();
    let counts: Vec<_> = counts.iter().map(|row| (row.sent, row.failed, row.next())).collect();
    assert_eq!(counts, [(0, 1, 1), (0, 1, 1), (1, 1, 2)]);
    assert_eq!((out.misfit().as_deref(), out.misfit(), out.unfit()), (Some("front/telegram"), None, 1));
}

#[test]
fn what_is_longer_than_a_datagram_goes_in_parts() {
    let telegram: Vec<u8> = (0..814).map(|i| i as u8).collect();
    for (longest, lengths) in [(MTU_SAFE, &[814][..]), (MTU_LEAST, &[528, 286]), (HEAD + 407, &[407, 407])] {
        let mut out = Outgoing::new(7, 9, Form::Sealed, longest);
        let front = out.follow("front", |topic| NonZeroU64::new(1).filter(|_| topic == Topic::Telegram));
        let mut taken = Taken::default();
        let payload = PayloadRef::Telegram(&telegram);
        for seq in 0..2 {
            let header = header(1, 5, seq);
            taken.datagrams.clear();
            out.sample(front, &Sample { header: Some(&header), missed: 0, payload }, at(0), &mut taken);
            taken.datagrams.retain(|(bytes, ..)| bytes[6] == Topic::Telegram.number());
            let parts: Vec<_> =
                taken.datagrams.iter().map(|(bytes, ..)| Datagram::read(bytes).unwrap()).collect();
            let numbers: Vec<_> = parts.iter().map(|it| (it.head.sequence, it.head.part)).collect();
            assert_eq!(numbers, (0..lengths.len()).map(|part| (seq as u32, part as u8)).collect::<Vec<_>>());
            assert!(parts.iter().all(|it| usize::from(it.head.parts) == lengths.len()));
            assert!(parts.iter().map(|it| it.payload.len()).eq(lengths.iter().copied()));
            assert_eq!(parts.iter().flat_map(|it| it.payload).copied().collect::<Vec<_>>(), telegram);
        }
        let (_, row) = out.account().flat_map(|rows| rows.used()).last().unwrap();
        assert_eq!((row.sent, row.failed, row.bytes), (2, 0, 2 * (814 + HEAD * lengths.len()) as u64));
    }
}

#[test]
fn a_sample_of_which_a_part_was_not_sent_is_a_failure_and_the_rest_goes_out() {
    let mut out = Outgoing::new(7, 9, Form::Sealed, MTU_LEAST);
    let front = out.follow("front", |topic| NonZeroU64::new(1).filter(|_| topic == Topic::Telegram));
    let (mut taken, header, payload) =
        (Taken { is_cut: true, ..Taken::default() }, header(1, 5, 0), [2; 814]);
    let sample = Sample { header: Some(&header), missed: 0, payload: PayloadRef::Telegram(&payload) };
    out.sample(front, &sample, at(0), &mut taken);
    assert_eq!(taken.numbers(), [(Announce::NUMBER, 0), (1, 0), (1, 0)]);
    let (_, row) = out.account().flat_map(|rows| rows.used()).last().unwrap();
    assert_eq!((row.sent, row.failed, row.bytes), (0, 1, 0));
}

#[test]
fn bare_telegrams_go_to_a_port_of_their_sensor() {
    let (mut out, mut taken) = (outgoing(Form::Bare), Taken::default());
    let front = out.follow("front", |topic| NonZeroU64::new(1).filter(|_| topic == Topic::Telegram));
    assert!(!out.wants(front, Topic::Status));
    let header = header(1, 5, 0);
    let sample = Sample { header: Some(&header), missed: 0, payload: PayloadRef::Telegram(b"\x02bytes") };
    out.sample(front, &sample, at(0), &mut taken);
    out.announce(at(1000), &mut taken);
    assert_eq!(taken.datagrams, [(b"\x02bytes".to_vec(), 83, 5)]);
}

#[test]
fn parts_with_a_key_have_each_a_mac_and_together_the_sample() {
    let key = Key::new(&[7; 32]);
    let mut out = Outgoing::new(7, 9, Form::Authenticated(key.clone()), MTU_LEAST);
    let front = out.follow("front", each);
    let telegram: Vec<u8> = (0..2000_u32).map(|n| (n * 7) as u8).collect();
    let header = header(1, 3, 0);
    let sample = Sample { header: Some(&header), missed: 0, payload: PayloadRef::Telegram(&telegram) };
    let mut taken = Taken::default();
    out.sample(front, &sample, at(0), &mut taken);
    let mut whole: Vec<u8> = Vec::new();
    for (bytes, ..) in &taken.datagrams {
        let datagram = Datagram::read(bytes).expect("a datagram");
        assert!(bytes.len() <= MTU_LEAST && key.is_of(bytes, datagram.mac.expect("a MAC")));
        if datagram.head.topic == Topic::Telegram.number() {
            whole.extend(datagram.payload);
        }
    }
    assert!(whole == telegram && taken.datagrams.len() == 1 + 2000_usize.div_ceil(MTU_LEAST - HEAD - 16));
}

/// Sends zones over a way where they wait.
fn wait(out: &mut Outgoing, sensor: usize, seq: u64) {
    assert_eq!(send(out, sensor, Some(header(1, 0, seq)), Verdict::Clear), []);
}

/// What waits, in its order.
fn handed(out: &mut Outgoing) -> Vec<Vec<u8>> {
    let mut all = Vec::new();
    while let Some(handed) = out.hand(at(700)) {
        all.push(handed.datagram.to_vec());
    }
    all
}

/// Zones that are received and lost of what comes to somebody who heard nothing before.
fn heard(datagrams: &[&[u8]]) -> (u64, u64) {
    let mut stats = GatewayTable::new(&Topic::ALL);
    for bytes in datagrams {
        stats.receive(bytes, 1, 0).expect("a datagram");
    }
    let zones = stats.rows().find(|row| row.topic == ZONES);
    zones.map_or((0, 0), |row| (row.received, row.lost()))
}

#[test]
fn who_comes_late_counts_nothing_that_came_before() {
    let mut out = Outgoing::waiting(7, 9);
    let front = out.follow("front", each);
    for seq in 0..100 {
        wait(&mut out, front, seq);
        handed(&mut out);
    }
    // Zones wait, and then the announcement, so that they have a number before it goes out.
    wait(&mut out, front, 100);
    out.announce(at(0), &mut Taken::default());
    let [_, announced] = &handed(&mut out)[..] else { panic!("zones and an announcement") };
    for seq in 101..110 {
        wait(&mut out, front, seq);
        handed(&mut out);
    }
    let head = Datagram::read(announced).expect("a datagram").head;
    assert_eq!(head.stamp_ns, at(700).wall_ns, "when it is sent, not when it began to wait");
    let asked = out.again("front", None, at(900)).expect("it was announced").to_vec();
    wait(&mut out, front, 110);
    let [zones] = &handed(&mut out)[..] else { panic!("zones") };
    assert_eq!(heard(&[&asked, zones]), (1, 0), "the answer says what is so now");
    assert_eq!(heard(&[announced, zones]), (1, 9), "nine were sent since it was announced");
    assert_eq!(heard(&[announced, &asked, zones]), (1, 9), "it was sent before, with the same number");
    assert_eq!(heard(&[&asked, announced, zones]), (1, 0), "in whichever order they come");
}
