//! Telegrams in JSON lines of programs, and checks that they are complete and in order.

use scanhub_drivers::lms;
use scanhub_drivers::lms::telegram::Telegram;
use scanhub_drivers::lms::variant::Unit;
use serde_json::Value;
use sha2::{Digest, Sha256};

use super::Outcome;

/// Command of a measured-value telegram.
pub(crate) const MEASURED_VALUES: u64 = 0xB0;

/// Telegram that the simulator has sent, as its log describes it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct SimulatedTelegram {
    pub(crate) is_reply: bool,
    pub(crate) hash: String,
    pub(crate) fault: Option<String>,
    /// CLOCK_MONOTONIC after the last byte was sent, in nanoseconds.
    pub(crate) sent_ns: u64,
}

impl SimulatedTelegram {
    /// Reads a telegram from a line of the simulator's log.
    pub(crate) fn of(line: &Value) -> SimulatedTelegram {
        let text = |key: &str| line[key].as_str().map(str::to_owned);
        SimulatedTelegram {
            is_reply: line["kind"] == "reply",
            hash: text("sha256").unwrap_or_else(|| panic!("no sha256 in {line}")),
            fault: text("fault"),
            sent_ns: number(line, "sent_ns"),
        }
    }

    /// Returns whether the telegram is a scan that the simulator sent without a fault.
    pub(crate) fn is_intact_scan(&self) -> bool {
        !self.is_reply && self.fault.is_none()
    }
}

/// Returns the SHA-256 hash of `bytes` in lower-case hexadecimal.
pub(crate) fn hash(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Returns the bytes of the telegram in a line of class `telegram`. Asserts that its checksum is right and that the
/// command and the address in the line match the bytes.
pub(crate) fn bytes_of(line: &Value) -> Vec<u8> {
    let text = line["data"].as_str().unwrap_or_else(|| panic!("no data in {line}"));
    let pair =
        |at| u8::from_str_radix(&text[at..at + 2], 16).unwrap_or_else(|_| panic!("not hexadecimal: {text}"));
    let bytes: Vec<u8> = (0..text.len()).step_by(2).map(pair).collect();
    let telegram = Telegram::check(&bytes)
        .unwrap_or_else(|| panic!("the telegram is incomplete or has a wrong checksum: {line}"));
    assert_eq!(u64::from(telegram.command()), number(line, "command"), "{line}");
    assert_eq!(u64::from(telegram.address()), number(line, "address"), "{line}");
    bytes
}

/// Returns a telegram with a scan of 361 beams. Scans with different seeds differ.
pub(crate) fn scan(seed: u16) -> Vec<u8> {
    let words: [u16; 361] = std::array::from_fn(|beam| 500 + (seed * 7 + beam as u16 * 11) % 4000);
    lms::measured::encode(0, Unit::Mm, &words, 0x10).bytes().to_vec()
}

/// Returns the number that a JSON line has under the key `key`.
pub(crate) fn number(line: &Value, key: &str) -> u64 {
    line[key].as_u64().unwrap_or_else(|| panic!("no number {key} in {line}"))
}

/// Returns the numbers that `lines` have under the key `key`. Asserts that each number is the previous one plus 1.
pub(crate) fn contiguous_numbers(lines: &[Value], key: &str) -> Vec<u64> {
    let numbers: Vec<u64> = lines.iter().map(|line| number(line, key)).collect();
    for pair in numbers.windows(2) {
        assert_eq!(pair[1], pair[0] + 1, "a gap in {key}");
    }
    numbers
}

/// Returns the `topic_seq` of the samples of `topic` that a client printed. Asserts that the numbers are in order and
/// that the client reported every gap as missed samples. A client on a busy machine may miss samples.
pub(crate) fn checked_topic_seqs(outcome: &Outcome, topic: &str) -> Vec<u64> {
    let lines = outcome.of_class(topic);
    // The line with which a client reports a silence has no `topic_seq`.
    let mut numbers: Vec<u64> = lines.iter().filter_map(|line| line["topic_seq"].as_u64()).collect();
    numbers.dedup();
    assert!(numbers.is_sorted_by(|one, next| one < next), "topic_seq is out of order: {numbers:?}");
    let (Some(first), Some(last)) = (numbers.first(), numbers.last()) else { return numbers };
    let notices = outcome.of_class("notice");
    let missed = notices.iter().filter(|line| line["kind"] == "missed" && line["topic"] == topic);
    let missed: u64 = missed.map(|line| number(line, "missed")).sum();
    assert_eq!(
        numbers.len() as u64 + missed,
        last - first + 1,
        "{topic}: a gap was not reported as missed: {outcome}"
    );
    numbers
}

/// Returns a condition that is true for lines of `class`.
pub(crate) fn is_class(class: &str) -> impl Fn(&Value) -> bool {
    move |line| line["class"] == class
}
