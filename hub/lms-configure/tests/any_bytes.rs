//! Property tests with random bytes in telegrams with a right checksum. Nothing panics. A telegram that decodes to a
//! write encodes to the same bytes again, does not decode to a request, and its explanation states the same fields.

use proptest::prelude::*;
use scanhub_drivers::lms::command::Request;
use scanhub_drivers::lms::explain::explain;
use scanhub_drivers::lms::telegram::{EncodedTelegram, Telegram, Writer};
use scanhub_lms_configure::eeprom::{EepromWrite, PowerOn};

fn telegram(address: u8, command: u8, data: &[u8]) -> EncodedTelegram {
    Writer::new(address, command).slice(data).finish()
}

/// Commands. Commands with a meaning are more frequent than others.
fn commands() -> impl Strategy<Value = u8> {
    let known: Vec<u8> = (0x10..=0x7C).chain(0x90..=0xFC).collect();
    prop_oneof![proptest::sample::select(known), any::<u8>()]
}

/// Data in which small numbers are frequent, so that some of the counts in it are valid.
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

proptest! {
    #![proptest_config(ProptestConfig { cases: 4000, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn decoding_of_any_bytes_does_not_panic(bytes in proptest::collection::vec(any::<u8>(), 0..900)) {
        if let Some(telegram) = Telegram::check(&bytes) {
            let _ = EepromWrite::decode(telegram);
        }
    }

    #[test]
    fn any_decoded_eeprom_write_is_no_request(address in 0u8..0x80, command in commands(), data in data()) {
        let encoded = telegram(address, command, &data);
        let telegram = encoded.telegram();
        if Request::decode(telegram).is_some() {
            prop_assert_eq!(EepromWrite::decode(telegram), None);
        }
        if let Some(write) = EepromWrite::decode(telegram) {
            let again = write.encode(address);
            prop_assert_eq!(again.as_ref().map(|again| again.bytes()), Some(telegram.bytes()));
        }
    }
}

#[test]
fn every_power_on_setting_has_an_explanation() {
    for (power_on, words) in
        PowerOn::ALL.into_iter().zip(["9600", "the present rate is kept", "the type is kept"])
    {
        let encoded = EepromWrite::PowerOn(power_on).encode(0).expect("one byte fits");
        let mut output = String::new();
        explain(encoded.telegram(), None, &mut |field| {
            output += &field.meaning.map(|words| words.to_string()).unwrap_or_default();
        });
        assert!(output.contains(words), "{power_on:?}: {output}");
    }
}
