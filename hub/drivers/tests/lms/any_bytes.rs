//! Any bytes at all, as telegrams with a right checksum: nothing panics, and what was understood is said again as it
//! came.

use proptest::prelude::*;
use scanhub_drivers::lms::command::Request;
use scanhub_drivers::lms::explain::{Headline, explain};
use scanhub_drivers::lms::reply::Reply;
use scanhub_drivers::lms::telegram::{Encoded, Telegram, Writer};
use scanhub_drivers::lms::variant::Mode;

fn telegram(address: u8, command: u8, data: &[u8]) -> Encoded {
    Writer::new(address, command).slice(data).finish()
}

/// Commands that mean something, more often than others.
fn commands() -> impl Strategy<Value = u8> {
    let known: Vec<u8> = (0x10..=0x7C).chain(0x90..=0xFC).collect();
    prop_oneof![proptest::sample::select(known), any::<u8>()]
}

/// Data of which the counts are small enough to fit now and then.
fn data() -> impl Strategy<Value = Vec<u8>> {
    prop_oneof![
        proptest::collection::vec(any::<u8>(), 0..800),
        proptest::collection::vec(0u8..6, 0..60),
        (any::<u8>(), proptest::collection::vec(any::<u8>(), 0..12)).prop_map(|(first, mut rest)| {
            rest.insert(0, first);
            rest
        }),
        proptest::sample::select(vec![1, 4, 5, 32, 33, 34, 35, 84, 85, 152])
            .prop_flat_map(|len| proptest::collection::vec(any::<u8>(), len)),
    ]
}

/// Explains `telegram`; every byte of it must be in one field, in order.
fn explained(telegram: Telegram<'_>, mode: Option<Mode>) -> String {
    let mut text = Headline(telegram).to_string();
    let mut at = 0;
    explain(telegram, mode, &mut |field| {
        assert_eq!(
            (field.offset, field.bytes),
            (at, &telegram.bytes()[at..at + field.bytes.len()]),
            "{}",
            field.name
        );
        assert!(!field.bytes.is_empty() && !field.name.is_empty());
        at += field.bytes.len();
        text += &field.words.map(|words| words.to_string()).unwrap_or_default();
    });
    assert_eq!(at, telegram.bytes().len());
    text
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 4000, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn bytes_without_a_checksum(bytes in proptest::collection::vec(any::<u8>(), 0..900)) {
        if let Some(telegram) = Telegram::check(&bytes) {
            let _ = (Request::decode(telegram), Reply::decode(telegram));
        }
    }

    #[test]
    fn explanations(
        address in any::<u8>(),
        command in commands(),
        data in data(),
        mode in proptest::option::of(any::<u8>().prop_map(Mode)),
    ) {
        prop_assert!(!explained(telegram(address, command, &data).telegram(), mode).is_empty());
    }

    #[test]
    fn requests(address in 0u8..0x80, command in commands(), data in data()) {
        let encoded = telegram(address, command, &data);
        let telegram = encoded.telegram();
        prop_assert_eq!(Reply::decode(telegram), None);
        if let Some(request) = Request::decode(telegram) {
            let again = request.encode(address);
            prop_assert_eq!(again.bytes(), telegram.bytes(), "{:?}", request);
        }
    }

    #[test]
    fn replies(address in 0x80u8.., command in commands(), data in data(), status in any::<u8>()) {
        let encoded = Writer::new(address, command).slice(&data).byte(status).finish();
        let telegram = encoded.telegram();
        prop_assert_eq!(Request::decode(telegram), None);
        if let Some(reply) = Reply::decode(telegram) {
            // What a sensor may say in more than one way is said in one: yes and no, and names with their spaces.
            let again = reply.encode(address, status).expect("it was short enough before");
            prop_assert_eq!(again.telegram().status(), telegram.status());
            prop_assert_eq!(Reply::decode(again.telegram()), Some(reply));
            let in_one_way = !matches!(
                reply,
                Reply::Mode { .. } | Reply::Variant { .. } | Reply::ConfigurationWritten { .. }
                    | Reply::Configuration2Written { .. } | Reply::PowerOn(_) | Reply::Type(_) | Reply::Refused
            );
            prop_assert!(!in_one_way || again.bytes() == telegram.bytes(), "{:?}", reply);
        }
    }
}
