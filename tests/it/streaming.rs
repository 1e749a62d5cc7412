//! Tests of two sensors that stream to a running hub with subscribers in separate processes: all telegrams that were
//! sent arrive, bit for bit and in order, and all verbs report the same values.

use crate::testkit::{
    INT, MEASURED_VALUES, REAL_REPLY_TIME, TERM, TestEnv, bytes_of, contiguous_numbers, hash, is_class,
    number,
};
use scanhub_drivers::lms;
use scanhub_drivers::lms::framer::{Framer, FramerEvent};
use scanhub_drivers::lms::measured::MeasuredValues;
use scanhub_drivers::lms::telegram::Telegram;
use scanhub_schema::Topic;
use serde_json::Value;

#[test]
fn everything_sent_arrives_bit_for_bit_and_in_order() {
    let env = TestEnv::new();
    let hub = env.hub(&[env.link("front"), env.link("rear")]);
    let sensors = ["front", "rear"];
    // The subscribers start before the simulator sends the first telegram, so they must receive all telegrams.
    let mut subscribers =
        sensors.map(|sensor| ["telegram", "scan"].map(|topic| env.echo(&[&format!("{sensor}/{topic}")])));
    let simulator = env.simulator(&sensors, &["--seed=11", REAL_REPLY_TIME]);
    for [telegrams, scans] in &mut subscribers {
        telegrams.await_lines(300, "a measured telegram", |line| line["command"] == MEASURED_VALUES);
        scans.await_lines(300, "a scan", is_class("scan"));
    }
    for (sensor, [telegrams, scans]) in sensors.into_iter().zip(subscribers) {
        let truth = env.truth(sensor);
        let telegrams = telegrams.end(INT).of_class("telegram");
        let scans = scans.end(INT).of_class("scan");
        let intact: Vec<_> =
            truth.iter().filter(|sent| sent.is_intact_scan()).map(|sent| &sent.hash).collect();
        let measured: Vec<_> = telegrams.iter().filter(|line| line["command"] == MEASURED_VALUES).collect();
        let arrived: Vec<_> = measured.iter().map(|line| hash(&bytes_of(line))).collect();
        let span = intact.len().min(arrived.len());
        assert!(span >= 300, "{} sent, {} received", intact.len(), arrived.len());
        assert!(arrived[..span].iter().eq(intact[..span].iter().copied()), "not what {sensor} sent");
        assert_eq!(contiguous_numbers(&telegrams, "seq")[0], 0);
        assert_eq!(contiguous_numbers(&telegrams, "topic_seq")[0], 0);
        assert_eq!(contiguous_numbers(&scans, "topic_seq")[0], 0);
        for (scan, telegram) in scans.iter().zip(measured) {
            assert_eq!(scan["seq"], telegram["seq"]);
            assert_eq!(scan["stamp_ns"], telegram["stamp_ns"]);
            check_scan(scan, &bytes_of(telegram));
        }
    }
    assert_eq!(hub.end(TERM).exit_code, Some(0));
    assert_eq!(simulator.end(TERM).exit_code, Some(0));
    for sensor in sensors {
        let (sent, eeprom_writes) = env.simulator_totals(sensor);
        assert_eq!((sent, eeprom_writes), (env.truth(sensor).len() as u64, 0));
    }
}

/// Asserts that a line of class `scan` has the values of `telegram`, which was sent in measuring mode 1 (13 bits of
/// range and 3 bits of reflector level).
fn check_scan(scan: &Value, telegram: &[u8]) {
    let telegram = Telegram::check(telegram).expect("an intact telegram");
    let measured = MeasuredValues::decode(telegram).expect("a measured telegram");
    let values = |key: &str| scan[key].as_array().unwrap_or_else(|| panic!("no {key}: {scan}")).clone();
    let (ranges, levels, mut codes) = (values("ranges"), values("intensities"), values("codes").into_iter());
    assert_eq!((ranges.len(), levels.len()), (measured.count(), measured.count()));
    assert_eq!((number(scan, "count"), number(scan, "unit_um")), (361, 1000));
    assert_eq!((scan["first_angle_deg"].as_f64(), scan["step_deg"].as_f64()), (Some(-90.0), Some(0.5)));
    for (beam, word) in measured.words().enumerate() {
        let range = u64::from(word & 0x1FFF);
        assert_eq!(levels[beam], word >> 13, "level of beam {beam}");
        if range > LARGEST_RANGE {
            assert_eq!(ranges[beam], Value::Null, "beam {beam}");
            assert_eq!(codes.next(), Some(serde_json::json!([beam, CODES[8191 - range as usize]])));
        } else {
            assert_eq!(ranges[beam], range, "beam {beam}");
        }
    }
    assert_eq!(codes.next(), None);
}

#[test]
fn verbs_agree_on_rate_state_and_counters() {
    let env = TestEnv::new();
    let _simulator = env.simulator(&["front"], &["--seed=12", "--baud=500000"]);
    let hub = env.hub(&[env.link("front")]);
    let mut raw = env.start(&["echo", "--raw", "front/telegram"]);
    raw.await_bytes(40 * 732);
    let rate = env.run(&["hz", "front/scan", "--json", "-n", "60"]);
    let summary = &rate.of_class("summary")[0];
    assert_eq!(
        (rate.exit_code, number(summary, "received"), number(summary, "missed")),
        (Some(0), 60, 0),
        "{rate}"
    );
    let hz = summary["hz"].as_f64().unwrap_or_default();
    let listed = env.run(&["list", "--json"]).of_class("topic");
    let topics: Vec<_> = listed.iter().map(|line| (&line["topic"], &line["payload"])).collect();
    let expected = Topic::OF_LINKS.map(|topic| (topic.name().into(), topic.payload().into()));
    assert_eq!(topics, expected.each_ref().map(|(name, payload): &(Value, Value)| (name, payload)));
    assert_eq!(number(&listed[0], "subscribers"), 1, "{listed:?}");
    let info = env.await_info("front", |info| info["hz"].as_f64().is_some_and(|hz| hz > 0.0));
    // `info` and `hz` each measure the rate of the same stream, and neither is exact on a busy machine.
    let hz_of_info = info["hz"].as_f64().unwrap_or_default();
    assert!((hz_of_info / hz - 1.0).abs() < 0.3, "info says {hz_of_info}, hz {hz}");
    let facts = ["state", "baud", "mode", "unit_mm", "angle_deg", "last_error"].map(|key| info[key].clone());
    let expected: [Value; 6] =
        ["streaming".into(), 500_000.into(), 1.into(), 1.into(), 180.into(), "".into()];
    assert_eq!(facts, expected);
    let counter = |name: &str| number(&info["counters"], name);
    assert_eq!(
        counter("bytes_read"),
        ["bytes_in_telegrams", "bytes_acknowledge", "bytes_discarded", "bytes_buffered"]
            .map(counter)
            .into_iter()
            .sum::<u64>()
    );
    assert_eq!((counter("rejected_crc"), counter("loan_failed"), counter("reconnects")), (0, 0, 0));

    let outcome = raw.end(INT);
    assert_eq!(outcome.exit_code, Some(0));
    let (telegrams, rest) = frame(&outcome.stdout);
    assert!(telegrams >= 40 && rest == 0, "{telegrams} telegrams and {rest} other bytes");
    assert_eq!(hub.end(TERM).exit_code, Some(0));
}

/// Returns the number of telegrams in `bytes`, and the number of bytes outside of telegrams.
fn frame(mut bytes: &[u8]) -> (u64, u64) {
    let mut framer = Framer::default();
    while !bytes.is_empty() {
        let spare = framer.read_buffer();
        let len = spare.len().min(bytes.len());
        spare[..len].copy_from_slice(&bytes[..len]);
        bytes = &bytes[len..];
        framer.commit(len);
        while let Some(found) = framer.poll() {
            assert!(matches!(found, FramerEvent::Telegram(_)));
        }
    }
    // Release the last telegram, because no later bytes can contradict it.
    framer.release(lms::framer::VETO_HOLD_TIME);
    while framer.poll().is_some() {}
    let tally = framer.counters();
    (tally.telegrams, tally.read - tally.in_telegrams)
}

/// Largest range in 13 bits. Larger values are codes (Telegram listing, table 6-9).
const LARGEST_RANGE: u64 = 8183 - 1;
/// Names of the codes, from the largest value downwards.
const CODES: [&str; 9] =
    ["no_return", "too_bright", "overflow", "overflow", "weak", "error", "overflow", "overflow", "beyond"];
