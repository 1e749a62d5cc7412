//! Invariants after any scenario, as far as they are visible from outside the program.

use std::collections::HashSet;

use scanhub_sim::simulate::Record;
use serde_json::Value;

use crate::testkit::{Outcome, bytes_of, number};

/// Number of telegrams that must arrive at the end of a run, after the last fault.
pub(super) const FAULTLESS_TELEGRAMS: usize = 60;

/// Asserts that every byte that was read is counted in exactly one category.
pub(super) fn bytes_are_conserved(info: &Value) {
    let count = |name: &str| number(&info["counters"], name);
    let known = ["bytes_in_telegrams", "bytes_acknowledge", "bytes_discarded", "bytes_buffered"].map(count);
    assert_eq!(count("bytes_read"), known.iter().sum::<u64>(), "{info}");
}

/// Asserts that every published sample was received or counted as missed. In each run of the hub, `topic_seq` starts at
/// 0.
pub(super) fn all_samples_are_counted(received: &[Value], outcome: &Outcome) {
    let [summary] = &outcome.of_class("summary")[..] else { panic!("{outcome}") };
    let mut published = 0;
    for run in received.chunk_by(|one, next| one["boot"] == next["boot"]) {
        let numbers: Vec<u64> = run.iter().map(|line| number(line, "topic_seq")).collect();
        assert!(numbers.windows(2).all(|pair| pair[0] < pair[1]), "out of order: {numbers:?}");
        // The subscriber receives the samples of each hub from the first one on. The first hub is an exception, because
        // it started before the subscriber.
        let first = if published == 0 { numbers[0] } else { 0 };
        published += numbers[numbers.len() - 1] - first + 1;
    }
    let boots: HashSet<_> = received.iter().map(|line| line["boot"].as_str()).collect();
    let runs = received.chunk_by(|one, next| one["boot"] == next["boot"]).count();
    assert_eq!(boots.len(), runs, "a boot ID appeared again");
    assert_eq!(received.len() as u64 + number(summary, "missed"), published, "{summary}");
}

/// Asserts that the sensor has sent each clean telegram that was received, in the same order and no more than once.
pub(super) fn nothing_is_invented(received: &[Value], sent: &[Record]) {
    let mut rest = sent.iter();
    for line in received.iter().filter(|line| line["quality"] == "clean") {
        let hash = Record::hash(&bytes_of(line));
        assert!(rest.any(|record| record.sha256 == hash), "never sent, or sent before the last one: {line}");
    }
}

/// Asserts that, after the last fault, every telegram that reached the port intact was received or counted as missed.
pub(super) fn nothing_is_lost(received: &[Value], sent: &[Record], outcome: &Outcome) {
    let [summary] = &outcome.of_class("summary")[..] else { panic!("{outcome}") };
    let calm = &received[received.len() - FAULTLESS_TELEGRAMS..];
    let ends = [&calm[0], &calm[FAULTLESS_TELEGRAMS - 1]].map(|line| Record::hash(&bytes_of(line)));
    let place =
        |hash| sent.iter().rposition(|record| record.sha256 == hash).expect("a telegram that was sent");
    let [first, last] = ends.map(place);
    let intact = sent[first..=last].iter().filter(|record| record.fault.is_none()).count();
    let missed = number(summary, "missed") as usize;
    assert!(
        intact <= FAULTLESS_TELEGRAMS + missed,
        "{intact} arrived intact, {FAULTLESS_TELEGRAMS} were published, {missed} missed"
    );
}
