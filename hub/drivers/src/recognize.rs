//! Recognition of the scanner family from raw bytes, such as the bytes of a stream file. This module counts the bytes
//! that each family's framer accepts.

use scanhub_schema::{Family, MILLIS, Nanos};

use crate::line::framing::fill;
use crate::line::{Action, Event, Protocol as _, ScannerSession as _};
use crate::lms::framer::{Framer, VETO_HOLD_TIME};
use crate::{Session, Settings, features};

/// Number of bytes at the start of a stream that this module examines.
pub const EXAMINED_BYTES: usize = 64 * 1024;

/// Returns the family whose telegrams or packets contain most of the first [`EXAMINED_BYTES`] bytes of `bytes`. Returns
/// `None` if these telegrams or packets contain less than half of these bytes.
pub fn family_of(bytes: &[u8]) -> Option<Family> {
    let examined = bytes.len().min(EXAMINED_BYTES);
    let [(first, max_bytes), ..] = bytes_by_family(bytes);
    (max_bytes > 0 && 2 * max_bytes >= examined).then_some(first)
}

/// Returns each family with the number of bytes in its telegrams or packets, among the first [`EXAMINED_BYTES`] bytes
/// of `bytes`. The family with the most bytes comes first.
pub fn bytes_by_family(bytes: &[u8]) -> [(Family, usize); Family::ALL.len()] {
    let bytes = &bytes[..bytes.len().min(EXAMINED_BYTES)];
    let mut counts = Family::ALL.map(|family| (family, accepted_bytes(family, bytes)));
    counts.sort_by_key(|(_, accepted)| core::cmp::Reverse(*accepted));
    counts
}

/// Returns the name of a scan mode that determines how `bytes` are divided into packets of `family`. Returns `None` if
/// the bytes alone determine this. Packets of several modes may have the same length, so a decoder may need a mode
/// other than the returned one.
pub fn framing_mode(family: Family, bytes: &[u8]) -> Option<&'static str> {
    bytes_in_mode(family, &bytes[..bytes.len().min(EXAMINED_BYTES)])?.1
}

/// Returns the number of bytes in telegrams or packets of `family`. Returns 0 if the number is so small that noise can
/// explain it.
fn accepted_bytes(family: Family, bytes: &[u8]) -> usize {
    match bytes_in_mode(family, bytes) {
        None => bytes_in_telegrams(bytes),
        Some((len, _)) if len > MAX_CHANCE_BYTES => len,
        Some(_) => 0,
    }
}

/// Returns the number of bytes in packets of `family`, and the [mode](framing_mode) that determines how the bytes are
/// divided. Returns `None` if the family does not send packets.
fn bytes_in_mode(family: Family, bytes: &[u8]) -> Option<(usize, Option<&'static str>)> {
    let in_mode = |mode| {
        let settings = Settings { mode, fixed_rate: true, listen_only: true, ..Settings::default() };
        bytes_in_packets(Session::begin(family, &settings, 0), bytes)
    };
    if features(family).has_whole_telegrams {
        return None;
    }
    let (len, is_ambiguous) = in_mode(None);
    if !is_ambiguous {
        return Some((len, None));
    }
    let modes = features(family).modes.iter().copied();
    let lengths = modes.map(|mode| (in_mode(Some(mode)).0, Some(mode)));
    lengths.max_by_key(|(len, _)| *len).filter(|(best, _)| *best > len).or(Some((len, None)))
}

fn bytes_in_telegrams(mut bytes: &[u8]) -> usize {
    let mut framer = Framer::default();
    loop {
        while framer.poll().is_some() {}
        if bytes.is_empty() {
            break;
        }
        let len = fill(framer.read_buffer(), &mut bytes);
        framer.commit(len);
    }
    // No more bytes will arrive, so the held telegram cannot be disproved.
    framer.release(VETO_HOLD_TIME);
    while framer.poll().is_some() {}
    framer.counters().in_telegrams as usize
}

/// Returns the number of bytes in packets, and whether the session needs a setting to determine the kind of packets.
fn bytes_in_packets(mut session: Session, mut bytes: &[u8]) -> (usize, bool) {
    let mut accepted = 0;
    let mut is_ended = false;
    loop {
        loop {
            match session.poll_action() {
                Action::Event(Event::Telegram(received)) => accepted += received.bytes.len(),
                Action::Transmit { .. } => session.handle_transmitted(0),
                Action::Event(Event::Scan(_)) | Action::SetRate(_) | Action::SetDtr(_) => {}
                Action::SleepUntil(_) | Action::Wait { .. } => break,
            }
        }
        if is_ended {
            return (accepted, session.missing_setting().is_some());
        }
        let len = fill(session.read_buffer(), &mut bytes);
        session.commit(0, len);
        if len == 0 {
            is_ended = true;
            // No more bytes will arrive, so the held packets cannot be disproved.
            session.handle_timeout(HOLD_TIMEOUT);
        }
    }
}

/// Time without a byte after which every session releases the packets that it holds back.
const HOLD_TIMEOUT: Nanos = 100 * MILLIS;
/// Maximum number of bytes that may be noise whose checksum is right by chance.
const MAX_CHANCE_BYTES: usize = 100;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lms::measured;
    use crate::lms::variant::Unit;

    fn telegrams(count: u16) -> Vec<u8> {
        let scan = |i: u16| measured::encode(0, Unit::Mm, &[700 + i % 50; 181], 0x10).bytes().to_vec();
        (0..count).flat_map(scan).collect()
    }

    #[test]
    fn family_needs_at_least_half_of_the_bytes() {
        let telegrams = telegrams(10);
        let mut random = fastrand::Rng::with_seed(1);
        let mut with_noise = |len: usize| {
            let noise: Vec<u8> = (0..len).map(|_| random.u8(3..=0x7F)).collect();
            family_of(&[&telegrams[..], &noise].concat())
        };
        assert_eq!(with_noise(0), Some(Family::Lms));
        assert_eq!(with_noise(telegrams.len()), Some(Family::Lms));
        assert_eq!(with_noise(telegrams.len() + 2), None);
        assert_eq!(bytes_by_family(&telegrams)[0], (Family::Lms, telegrams.len()));
    }

    #[test]
    fn only_the_first_bytes_determine_the_family() {
        let (telegrams, noise) = (telegrams(400), vec![0x42; EXAMINED_BYTES]);
        assert!(telegrams.len() > EXAMINED_BYTES);
        assert_eq!(family_of(&[&telegrams[..], &noise, &noise, &noise].concat()), Some(Family::Lms));
        assert_eq!(family_of(&[&noise[..], &telegrams].concat()), None);
    }

    #[test]
    fn noise_and_empty_input_have_no_family() {
        assert_eq!(family_of(&[]), None);
        for seed in 0..40 {
            let mut random = fastrand::Rng::with_seed(seed);
            let len = random.usize(1..4_000);
            let noise: Vec<u8> = (0..len).map(|_| random.u8(..)).collect();
            assert_eq!(family_of(&noise), None, "seed {seed}");
        }
        for byte in [0x00, 0x02, 0x42, 0x54, 0xAA, 0xFF] {
            assert_eq!(family_of(&[byte; 2_000]), None, "{byte:02x}");
        }
    }
}
