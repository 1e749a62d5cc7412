//! Tests of the codec of replies, in both directions. The tests use printed replies, recorded replies, and replies that
//! follow from the layout. The checksum reveals the misprints of the documents. Telegrams with any bytes and a valid
//! checksum cause no panic, and are encoded as they were decoded.

use proptest::prelude::*;
use scanhub_drivers::lms::command::{Request, SubRange};
use scanhub_drivers::lms::configuration::Configuration;
use scanhub_drivers::lms::explain::{Headline, explain};
use scanhub_drivers::lms::measured::{MeasuredValues, Rows, ScanFrame};
use scanhub_drivers::lms::reply::Reply;
use scanhub_drivers::lms::status::{Errors, StatusByte};
use scanhub_drivers::lms::telegram::{EncodedTelegram, Telegram, Writer};
use scanhub_drivers::lms::variant::{Mode, Unit, Variant};
use scanhub_drivers::lms::{measured, reply};

/// Parses bytes as documents print them: hexadecimal, and text in quotes.
fn bytes(text: &str) -> Vec<u8> {
    let mut bytes = Vec::new();
    for (number, part) in text.split('"').enumerate() {
        if number % 2 == 1 {
            bytes.extend(part.as_bytes());
        } else {
            bytes.extend(
                part.split_whitespace().map(|pair| u8::from_str_radix(pair, 16).expect("two digits")),
            );
        }
    }
    bytes
}

const ZERO_BYTES: &str = "00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00";

#[test]
fn printed_and_captured_replies_round_trip() {
    let f4 = format!("02 80 24 00 F4 00 00 70 00 00 04 01 00 00 02 02 {ZERO_BYTES} 02 00 10 36 FE");
    let f7 = format!("02 80 25 00 F7 01 00 00 70 00 00 00 01 00 00 02 02 {ZERO_BYTES} 02 00 10 C5 7A");
    let (f4, f7) = (bytes(&f4), bytes(&f7));
    let vectors: [(&str, Reply<'_>); 12] = [
        ("02 80 03 00 A0 00 10 16 0A", Reply::Mode { done: true }),
        ("02 81 03 00 A0 00 10 36 1A", Reply::Mode { done: true }),
        ("02 80 03 00 A0 00 11 17 0A", Reply::Mode { done: true }),
        ("02 80 02 00 91 10 79 30", Reply::Reset),
        ("02 80 02 00 92 10 7F 33", Reply::Refused),
        ("02 80 02 00 B2 10 3F 13", Reply::Errors(Errors::new(&[]).unwrap())),
        (
            "02 80 07 00 BB 01 B4 00 32 00 10 03 9D",
            Reply::Variant { done: true, angle_deg: 180, resolution_cdeg: 50 },
        ),
        ("02 80 17 00 BA \"LMS200;301063;V02.10 \" 10 22 61", Reply::Type(b"LMS200;301063;V02.10")),
        ("02 80 17 00 BA \"LMS200;S18063;V02.19 \" 10 85 6A", Reply::Type(b"LMS200;S18063;V02.19")),
        ("02 80 17 00 BA \"LMS200;S18063;V02.19 \" 11 84 6A", Reply::Type(b"LMS200;S18063;V02.19")),
        ("", Reply::Configuration(Configuration::new(&f4[5..39]).unwrap())),
        (
            "",
            Reply::ConfigurationWritten {
                done: true,
                configuration: Configuration::new(&f7[6..40]).unwrap(),
            },
        ),
    ];
    for (text, expected) in vectors {
        let bytes = match expected {
            Reply::Configuration(_) => f4.clone(),
            Reply::ConfigurationWritten { .. } => f7.clone(),
            _ => bytes(text),
        };
        let telegram = Telegram::check(&bytes).unwrap_or_else(|| panic!("{text}: wrong checksum"));
        assert_eq!(Reply::decode(telegram), Some(expected), "{text}");
        let status = telegram.status().expect("a reply has one");
        let again = expected.encode(telegram.address(), status).expect("it is short enough");
        assert_eq!(again.bytes(), bytes, "{expected:?}");
    }
    assert_eq!(reply::configuration_reply(0, Mode(4), Unit::Mm, 0x10).bytes(), f4);
    assert_eq!(reply::mode_reply(1, true, 0x10).bytes(), bytes("02 81 03 00 A0 00 10 36 1A"));
    assert_eq!(reply::refusal(0, 0x10).bytes(), bytes("02 80 02 00 92 10 7F 33"));
    let name = b"LMS200;S18063;V02.19 ";
    assert_eq!(reply::type_reply(0, name, 0x10).bytes()[26..], [0x10, 0x85, 0x6A]);
    assert_eq!(reply::variant_reply(0, true, Variant::HALF, 0x10).bytes()[11..], [0x03, 0x9D]);
}

/// Misprints in the documents. The right bytes were found by calculating the checksums.
#[test]
fn misprinted_telegrams_are_refused() {
    let a_zero_lost =
        format!("02 80 25 00 F7 01 00 00 70 00 00 00 01 00 00 02 02 {} 02 00 10 C5 7A", &ZERO_BYTES[3..]);
    for text in [
        // The request for installation mode, with the checksum of table 6-4. Programs have copied this checksum.
        "02 00 0A 00 20 00 \"SICK_LMS\" 5F B2",
        // The boot message of tables 6-2 and 7-5.
        "02 80 17 00 90 \"LMS200;301063;V02.10 \" 10 63 56",
        // STX and address are swapped, with a matching checksum (7-105).
        "00 02 01 00 69 7D 0A",
        // A zero byte is missing, as in 6-8 of the document.
        &a_zero_lost,
        // LENGTH is 0, as in the C1h, C2h and E6h of the document.
        "02 80 00 00 C1 10 00 00",
    ] {
        assert_eq!(Telegram::check(&bytes(text)), None, "{text}");
    }
    // Two of these telegrams without the misprints.
    assert!(Telegram::check(&bytes("02 00 0A 00 20 00 \"SICK_LMS\" BE C5")).is_some());
    let up = bytes("02 80 17 00 90 \"LMS200;301063;V02.10 \" 10 63 5E");
    let up = Telegram::check(&up).map(Reply::decode);
    assert_eq!(up, Some(Some(Reply::PowerOn(b"LMS200;301063;V02.10"))));
}

fn encode_and_decode(reply: &Reply<'_>) -> EncodedTelegram {
    let encoded = reply.encode(0, StatusByte::OK.0).expect("it is short enough");
    assert_eq!(Reply::decode(encoded.telegram()).as_ref(), Some(reply));
    encoded
}

#[test]
fn unprinted_replies_round_trip() {
    let span = SubRange { first: 27, last: 28 };
    let scan = measured::encode_with(
        0,
        ScanFrame { unit: Unit::Mm, partial: None, indices: Some((1, 2)) },
        &[7, 8],
        0x10,
    );
    let Some(Reply::Measured(values)) = Reply::decode(scan.telegram()) else { panic!("no scan") };
    encode_and_decode(&Reply::Measured(values));
    encode_and_decode(&Reply::PowerOn(b"LMS200;301063;V02.10"));
    encode_and_decode(&Reply::Counters { hours_by_2: 4000, power_ons: 12 });
    encode_and_decode(&Reply::Mode { done: false });
    encode_and_decode(&Reply::Means { scans: 250, values });
    encode_and_decode(&Reply::Range { span, values });
    encode_and_decode(&Reply::RangeMeans { scans: 2, span, values });
    encode_and_decode(&Reply::PowerOnSet { outcome: 1, set: 0 });
    encode_and_decode(&Reply::Configuration2(&[3; 84]));
    encode_and_decode(&Reply::Configuration2Written { done: true, parameters: &[3; 84] });
    for command in [0xC0, 0xC1, 0xC2, 0xC5, 0xC6, 0xCA, 0xE9, 0xF6] {
        encode_and_decode(&Reply::Undecoded { command, data: &[1, 2, 3] });
    }
    let errors = [0x84, 0x16, 0x01, 0x31];
    assert_eq!(encode_and_decode(&Reply::Errors(Errors::new(&errors).unwrap())).telegram().data(), errors);
    let old = [0; 32];
    let f4 = encode_and_decode(&Reply::Configuration(Configuration::new(&old).unwrap()));
    assert_eq!(f4.telegram().length(), 0x22);
}

#[test]
fn rejects_malformed_and_oversized_replies() {
    let reply = |command: u8, data: &[u8]| {
        let encoded = Writer::new(0x80, command).slice(data).byte(0x10).finish();
        Reply::decode(encoded.telegram()).is_some()
    };
    assert!(!reply(0xB1, &[0; 151]) && !reply(0xB2, &[1]) && !reply(0xB5, &[0; 3]));
    assert!(!reply(0xB6, &[]) && !reply(0xB7, &[1, 0, 2]) && !reply(0xBB, &[1]) && !reply(0xF4, &[0; 31]));
    assert!(!reply(0xF5, &[1, 0]) && !reply(0xC4, &[1]) && !reply(0xBE, &[0; 5]) && !reply(0x99, &[]));
    let request = Writer::new(0, 0xA0).byte(0).finish();
    assert_eq!(Reply::decode(request.telegram()), None, "a host sends no reply");
    assert!(Reply::Configuration2(&[0; 900]).encode(0, 0x10).is_none());
    assert!(Reply::Type(&[b'x'; 900]).encode(0, 0x10).is_none());
    // The longest telegram of values can be encoded. Replies with the same values and more data cannot.
    let frame = ScanFrame { unit: Unit::Mm, partial: None, indices: Some((1, 2)) };
    let longest = measured::encode_with(0, frame, &[7; 401], 0x10);
    let values = MeasuredValues::decode(longest.telegram()).expect("is one");
    let span = SubRange { first: 1, last: 401 };
    assert!(Reply::Measured(values).encode(0, 0x10).is_some());
    assert!(Reply::Means { scans: 2, values }.encode(0, 0x10).is_none());
    assert!(Reply::Range { span, values }.encode(0, 0x10).is_none());
    assert!(Reply::RangeMeans { scans: 2, span, values }.encode(0, 0x10).is_none());
    let data = [&[1, 0, 101, 0, 101, 0][..], &[0; 8 * 101]].concat();
    let fields = Rows::of_fields(&data).expect("is one");
    assert!(Reply::RangeFields(fields).encode(0, 0x10).is_none());
}

fn telegram(address: u8, command: u8, data: &[u8]) -> EncodedTelegram {
    Writer::new(address, command).slice(data).finish()
}

/// Generates commands, most of which are known.
fn commands() -> impl Strategy<Value = u8> {
    let known: Vec<u8> = (0x10..=0x7C).chain(0x90..=0xFC).collect();
    prop_oneof![proptest::sample::select(known), any::<u8>()]
}

/// Generates data whose counts are small enough to match the length sometimes.
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

/// Explains `telegram`. Checks that every byte belongs to exactly one field, in order.
fn explain_all(telegram: Telegram<'_>, mode: Option<Mode>) -> String {
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
        text += &field.meaning.map(|words| words.to_string()).unwrap_or_default();
    });
    assert_eq!(at, telegram.bytes().len());
    text
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 4000, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn decoding_of_any_bytes_does_not_panic(bytes in proptest::collection::vec(any::<u8>(), 0..900)) {
        if let Some(telegram) = Telegram::check(&bytes) {
            let _ = (Request::decode(telegram), Reply::decode(telegram));
        }
    }

    #[test]
    fn every_telegram_has_an_explanation(
        address in any::<u8>(),
        command in commands(),
        data in data(),
        mode in proptest::option::of(any::<u8>().prop_map(Mode)),
    ) {
        prop_assert!(!explain_all(telegram(address, command, &data).telegram(), mode).is_empty());
    }

    #[test]
    fn any_decoded_request_round_trips(address in 0u8..0x80, command in commands(), data in data()) {
        let encoded = telegram(address, command, &data);
        let telegram = encoded.telegram();
        prop_assert_eq!(Reply::decode(telegram), None);
        if let Some(request) = Request::decode(telegram) {
            let again = request.encode(address);
            prop_assert_eq!(again.bytes(), telegram.bytes(), "{:?}", request);
        }
    }

    #[test]
    fn any_decoded_reply_round_trips(address in 0x80u8.., command in commands(), data in data(), status in any::<u8>()) {
        let encoded = Writer::new(address, command).slice(&data).byte(status).finish();
        let telegram = encoded.telegram();
        prop_assert_eq!(Request::decode(telegram), None);
        if let Some(reply) = Reply::decode(telegram) {
            // Some values have several encodings, for example names with trailing spaces. The encoder uses one of them.
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
