//! Check of a telegram's header. A position in the stream becomes a candidate only if its header passes this check. The
//! check uses the first 5 or 7 bytes, and not the checksum.

use crate::lms::command;
use crate::lms::measured::MEASURED;
use crate::lms::telegram::{FRAME_LEN, MAX_LENGTH, REPLY, STX};
use crate::lms::variant::MAX_BEAMS;

/// Part of a telegram that is expected next at a position in the stream. The variants are the six states of Fig. 3 of
/// the paper.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum State {
    /// The start byte. No header has begun.
    Stx,
    /// The address.
    Address,
    /// The low byte of the length. It is checked together with the high byte.
    LengthLow,
    /// The high byte of the length.
    LengthHigh,
    /// Command, data and status.
    Body,
    /// The two bytes of the checksum.
    Crc,
}

/// Reason why a start byte did not become a delivered telegram.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reject {
    /// The address is not a reply's address, or it belongs to another scanner.
    Address,
    /// The length exceeds [`MAX_LENGTH`], or differs from the expected length.
    Length,
    /// The command is not a reply's command, or the reply is not expected.
    Command,
    /// The count word does not match the length, or differs from the expected count word.
    Count,
    /// The checksum is wrong.
    Crc,
    /// The checksum was right, but another telegram with a right checksum began inside this telegram.
    Vetoed,
    /// Another telegram was complete first.
    Superseded,
}

impl Reject {
    /// Number of reasons. A table with one counter for each reason has this length.
    pub const COUNT: usize = 7;
}

/// First seven bytes of every measured-value telegram in a stream whose mode is known: STX, address, length, command
/// and count word.
pub type StreamHeader = [u8; 7];

/// Headers that the framer accepts at the moment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ExpectedHeaders {
    /// Any reply of at most [`MAX_LENGTH`] bytes. The length of a measured-value telegram must match its count word.
    Anything,
    /// Telegrams of a stream in a known mode, the reply to the open request, and the refusal of this request. Some
    /// replies may arrive late, twice or after power-on. The framer always accepts these replies if they have their
    /// usual length.
    Stream {
        /// First bytes of each measured-value telegram.
        header: StreamHeader,
        /// Command byte of the reply to the open request. `None` if no request is open.
        reply: Option<u8>,
    },
}

/// Result of checking the first bytes at a position.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum HeaderCheck {
    /// The bytes are the beginning of an acceptable header. Contains the state for the next missing byte.
    Prefix(State),
    /// The bytes begin with a complete and acceptable header. The telegram has `len` bytes from STX to checksum.
    Candidate { len: usize },
    /// The header is not acceptable.
    Refused(Reject),
}

/// Checks the header that begins at `bytes[0]`, which must be STX. Ignores bytes after the header.
pub(crate) fn check_header(bytes: &[u8], expect: &ExpectedHeaders) -> HeaderCheck {
    use HeaderCheck::{Candidate, Prefix, Refused};
    let Some(&stx) = bytes.first() else { return Prefix(State::Stx) };
    debug_assert_eq!(stx, STX);
    let Some(&address) = bytes.get(1) else { return Prefix(State::Address) };
    if !address_fits(address, expect) {
        return Refused(Reject::Address);
    }
    let Some(&low) = bytes.get(2) else { return Prefix(State::LengthLow) };
    let Some(&high) = bytes.get(3) else { return Prefix(State::LengthHigh) };
    let length = usize::from(u16::from_le_bytes([low, high]));
    if !length_fits(length, expect) {
        return Refused(Reject::Length);
    }
    let Some(&command) = bytes.get(4) else { return Prefix(State::Body) };
    match command_fits(command, length, expect) {
        Err(reject) => return Refused(reject),
        Ok(HasCount::No) => return Candidate { len: length + FRAME_LEN },
        Ok(HasCount::Yes) => {}
    }
    let (Some(&count_low), Some(&count_high)) = (bytes.get(5), bytes.get(6)) else {
        return Prefix(State::Body);
    };
    if !count_fits([count_low, count_high], length, expect) {
        return Refused(Reject::Count);
    }
    Candidate { len: length + FRAME_LEN }
}

/// Whether a count word follows the command.
enum HasCount {
    Yes,
    No,
}

fn address_fits(address: u8, expect: &ExpectedHeaders) -> bool {
    match expect {
        ExpectedHeaders::Anything => address & REPLY != 0,
        ExpectedHeaders::Stream { header, .. } => address == header[1],
    }
}

fn length_fits(length: usize, expect: &ExpectedHeaders) -> bool {
    match expect {
        ExpectedHeaders::Anything | ExpectedHeaders::Stream { reply: Some(_), .. } => {
            (MIN_LENGTH..=MAX_LENGTH).contains(&length)
        }
        ExpectedHeaders::Stream { header, reply: None } => {
            length == stream_length(header)
                || REPLIES_IN_STREAM.iter().any(|(_, lengths)| lengths.contains(&length))
        }
    }
}

fn command_fits(command: u8, length: usize, expect: &ExpectedHeaders) -> Result<HasCount, Reject> {
    match expect {
        ExpectedHeaders::Anything if command == MEASURED => Ok(HasCount::Yes),
        ExpectedHeaders::Anything if command & REPLY != 0 => Ok(HasCount::No),
        ExpectedHeaders::Stream { header, .. } if command == MEASURED => {
            if length == stream_length(header) {
                Ok(HasCount::Yes)
            } else {
                Err(Reject::Length)
            }
        }
        ExpectedHeaders::Stream { reply: Some(reply), .. }
            if command == *reply || command == crate::lms::reply::REFUSED =>
        {
            Ok(HasCount::No)
        }
        ExpectedHeaders::Stream { .. }
            if REPLIES_IN_STREAM
                .iter()
                .any(|(allowed, lengths)| *allowed == command && lengths.contains(&length)) =>
        {
            Ok(HasCount::No)
        }
        _ => Err(Reject::Command),
    }
}

fn count_fits(word: [u8; 2], length: usize, expect: &ExpectedHeaders) -> bool {
    match expect {
        ExpectedHeaders::Anything => {
            let count = usize::from(u16::from_le_bytes(word) & 0x03FF);
            // Command, count word and status. Two more bytes follow if the scanner sends real-time indices.
            let len_without_indices = 2 * count + 4;
            (1..=MAX_BEAMS).contains(&count)
                && (length == len_without_indices || length == len_without_indices + 2)
        }
        ExpectedHeaders::Stream { header, .. } => word == [header[5], header[6]],
    }
}

fn stream_length(header: &StreamHeader) -> usize {
    usize::from(u16::from_le_bytes([header[2], header[3]]))
}

/// Returns whether some operating mode makes a scanner send telegrams with this command byte continuously, without a
/// request for each telegram.
pub(crate) fn is_data(command: u8) -> bool {
    STREAM_COMMANDS.contains(&command)
}

/// Command bytes of telegrams that a scanner sends continuously (Telegram listing, 20h). In this order, they contain
/// all values, means, a sub-range, a sub-range with field values, means of a sub-range, ranges with the reflectivity of
/// a sub-range, ranges and reflectivities, and Cartesian coordinates.
const STREAM_COMMANDS: [u8; 8] = [MEASURED, 0xB6, 0xB7, 0xBE, 0xBF, 0xC4, 0xF5, 0xF6];
/// Replies to a session's requests, the refusal, and the boot message, each with its possible values of LENGTH. Type
/// texts have 20 or 21 characters, and configurations have 32 or 34 bytes. Without this restriction, the bytes of scans
/// would often look like one of these replies.
const REPLIES_IN_STREAM: [(u8, core::ops::RangeInclusive<usize>); 7] = [
    (crate::lms::reply::POWER_ON, 20..=26),
    (crate::lms::reply::REFUSED, 2..=2),
    (command::MODE | REPLY, 3..=3),
    (command::STATUS | REPLY, 0x9A..=0x9A),
    (command::TYPE | REPLY, 20..=26),
    (command::VARIANT | REPLY, 7..=7),
    (command::CONFIGURATION | REPLY, 33..=36),
];
/// Minimum LENGTH, of a telegram that has only the command byte and the status byte.
const MIN_LENGTH: usize = 2;
/// Number of bytes of the longest header.
pub(crate) const MAX_HEADER_LEN: usize = 7;
/// Minimum distance between two acceptable headers, in bytes. The high byte of a length is at most 3. It is therefore
/// not a valid address, so no acceptable header begins one byte before it. It may be a start byte, so the next header
/// can begin three bytes after the first one.
pub(crate) const MIN_HEADER_DISTANCE: usize = 3;

const _: () = assert!(MAX_LENGTH < 0x0400, "MIN_HEADER_DISTANCE depends on it");

#[cfg(test)]
mod tests {
    use super::*;

    const HEADER: StreamHeader = [0x02, 0x80, 0xD6, 0x02, 0xB0, 0x69, 0x41];

    #[test]
    fn header_is_refused_at_the_first_wrong_byte() {
        let stream = ExpectedHeaders::Stream { header: HEADER, reply: None };
        let states =
            [State::Address, State::LengthLow, State::LengthHigh, State::Body, State::Body, State::Body];
        for (n, state) in states.into_iter().enumerate() {
            assert_eq!(check_header(&HEADER[..=n], &stream), HeaderCheck::Prefix(state));
        }
        assert_eq!(check_header(&HEADER, &stream), HeaderCheck::Candidate { len: 732 });
        for (at, reject) in [
            (1, Reject::Address),
            (2, Reject::Length),
            (3, Reject::Length),
            (4, Reject::Command),
            (5, Reject::Count),
            (6, Reject::Count),
        ] {
            let mut bytes = HEADER;
            bytes[at] ^= 1;
            let decides = if at == 2 { 3 } else { at.max(if at == 5 { 6 } else { at }) };
            assert_eq!(check_header(&bytes[..=decides], &stream), HeaderCheck::Refused(reject), "byte {at}");
        }
    }

    #[test]
    fn accepts_any_reply_while_the_mode_is_unknown() {
        let any = ExpectedHeaders::Anything;
        assert_eq!(check_header(&[0x02, 0x81, 3, 0, 0xA0], &any), HeaderCheck::Candidate { len: 9 });
        assert_eq!(check_header(&[0x02, 0x00], &any), HeaderCheck::Refused(Reject::Address));
        assert_eq!(check_header(&[0x02, 0x80, 0x02, 0x80], &any), HeaderCheck::Refused(Reject::Length));
        assert_eq!(check_header(&[0x02, 0x80, 3, 0, 0x20], &any), HeaderCheck::Refused(Reject::Command));
        assert_eq!(
            check_header(&[0x02, 0x80, 0xD6, 0x02, 0xB0, 0x67, 0x41], &any),
            HeaderCheck::Refused(Reject::Count)
        );
        assert_eq!(check_header(&HEADER, &any), HeaderCheck::Candidate { len: 732 });
    }

    #[test]
    fn accepts_the_pending_reply_in_a_stream() {
        let open = ExpectedHeaders::Stream { header: HEADER, reply: Some(0xB1) };
        assert_eq!(check_header(&[0x02, 0x80, 0x9A, 0, 0xB1], &open), HeaderCheck::Candidate { len: 160 });
        assert_eq!(check_header(&[0x02, 0x80, 2, 0, 0x92], &open), HeaderCheck::Candidate { len: 8 });
        assert_eq!(check_header(&[0x02, 0x80, 0x17, 0, 0xCA], &open), HeaderCheck::Refused(Reject::Command));
        assert_eq!(check_header(&[0x02, 0x80, 0x17, 0, 0xB0], &open), HeaderCheck::Refused(Reject::Length));
    }

    #[test]
    fn accepts_late_reply_in_stream_with_own_length() {
        let stream = ExpectedHeaders::Stream { header: HEADER, reply: None };
        for (command, length) in
            [(0x90, 0x17), (0x92, 2), (0xA0, 3), (0xB1, 0x9A), (0xBA, 0x17), (0xBB, 7), (0xF4, 0x24)]
        {
            let mut header = [0x02, 0x80, length, 0, command];
            assert_eq!(
                check_header(&header, &stream),
                HeaderCheck::Candidate { len: usize::from(length) + FRAME_LEN }
            );
            header[4] = 0xC0;
            assert_eq!(check_header(&header, &stream), HeaderCheck::Refused(Reject::Command));
            header[2] = 0x50;
            assert_eq!(check_header(&header, &stream), HeaderCheck::Refused(Reject::Length));
        }
    }
}
