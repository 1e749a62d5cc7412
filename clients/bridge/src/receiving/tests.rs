//! A way in whose inbox is filled by hand: what is taken, counted and asked for.

use std::cell::RefCell;

use scanhub_schema::datagram::{Head, Packed};
use scanhub_schema::limits::TopicLimits;
use scanhub_schema::{Kind, Zones};

use super::*;

const HUB: u64 = 0x5f3a_12bc_00d1_e2f3;

/// Runs a way in that `is_over` at once after `heard` was put into its inbox; what it told, and what it asked for.
fn run(heard: Vec<Heard>, is_over: bool, ask: impl Fn(&str) -> Result<(), Failure>) -> (String, u64) {
    let (mut out, mut notes) = (Vec::new(), Vec::new());
    let wanted = Wanted {
        topics: Topic::ALL.to_vec(),
        heard: Topic::ALL.to_vec(),
        names: &[],
        hubs: &[],
        key: None,
        state: None,
        publish: None,
        limits: TopicLimits::default(),
        memory: 0,
        only_proven: false,
        stats: true,
    };
    let (to_out, to_notes) = (Output::new(&mut out), Output::new(&mut notes));
    let reception = Reception::open(wanted, true, Words::BRIDGE, to_out, to_notes).unwrap();
    let (to, inbox) = sync_channel(WAITING);
    let inlet = Inlet { to, counts: Arc::default() };
    heard.into_iter().for_each(|heard| inlet.put(heard));
    let questions = RefCell::new(0);
    let over = AtomicBool::new(is_over);
    let ask_and_end = |address: &Address<'_>| {
        *questions.borrow_mut() += 1;
        over.store(true, Ordering::Relaxed);
        ask(&address.to_string())
    };
    let mut receiving = Receiving {
        reception,
        asked: asked(&Topic::ALL),
        asking: Asking::new(Instant::now()),
        counts: inlet.counts.clone(),
        foreign: 0,
        ask: Box::new(ask_and_end),
        refused: Box::new(|| 0),
    };
    // What comes behind the end is not let in.
    receiving.run(&inbox, &AtomicBool::new(false), &over, || drop(inlet)).unwrap();
    drop(receiving);
    (String::from_utf8(out).unwrap(), questions.into_inner())
}

fn zones(sequence: u32) -> Heard {
    let mut buffer = [0; 100];
    let len = Zones::unknown().pack(&mut buffer[scanhub_schema::datagram::HEAD..]).unwrap();
    let head =
        Head { topic: Topic::Zones.number(), revision: 1, hub: HUB, epoch: 1, sequence, ..Head::default() };
    Heard::Sample(
        format!("{PREFIX}/{HUB:016x}/front/zones").into(),
        head.seal(&mut buffer, len).unwrap().to_vec(),
    )
}

#[test]
fn what_waits_at_the_end_is_in_the_account() {
    let (told, _) = run((0..WAITING as u32 + 7).map(zones).collect(), true, |_| Ok(()));
    assert!(told.contains(&format!("\"received\":{WAITING},")), "{told}");
    assert!(told.contains("\"overrun\":7"), "{told}");
}

#[test]
fn another_version_is_told_once_and_counted() {
    let spoilt = |at: usize, value: u8| {
        let Heard::Sample(key, mut bytes) = zones(0) else { panic!("a sample") };
        bytes[at] = value;
        Heard::Sample(key, bytes)
    };
    // The version stands behind the magic.
    let (told, _) = run(vec![spoilt(4, 9), spoilt(4, 9), zones(0)], true, |_| Ok(()));
    assert_eq!(told.matches("another version").count(), 1, "{told}");
    assert!(told.contains("\"version\":2,") && told.contains("\"received\":1,"), "{told}");
}

#[test]
fn a_question_that_cannot_be_asked_is_told_and_ends_nothing() {
    let heard = vec![Heard::Live(format!("{PREFIX}/{HUB:016x}/front/{LIVE}").into()), zones(0)];
    let (told, asked) =
        run(heard, false, |key| Err(Failure::new(Kind::Failed, format!("Zenoh refuses {key}"), "")));
    assert_eq!(asked, 1);
    assert!(told.contains("Zenoh refuses") && told.contains("\"unasked\":1"), "{told}");
    assert!(told.contains("\"received\":1,"), "{told}");
}
