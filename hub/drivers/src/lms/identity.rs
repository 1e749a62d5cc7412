//! What a session knows of a sensor that streams and does not tell in its scans, in few bytes: for a session that goes on with
//! the same stream, and can say what the values mean before it has asked. Refuses to know where it is kept, and for how
//! long it is worth anything.

use crate::line;
use crate::lms::header::StreamHeader;
use crate::lms::sensor::KIND_LEN;
use crate::lms::variant::Mode;

/// Who streams, and how its values are split.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Identity {
    /// How each of its scans begins.
    pub(crate) header: StreamHeader,
    pub(crate) mode: Mode,
    /// Its type, 0 behind the end.
    pub(crate) kind: [u8; KIND_LEN],
}

impl Identity {
    /// As bytes: header, mode, type.
    pub(crate) fn to_bytes(self) -> line::Identity {
        let mut bytes = line::Identity::default();
        let (header, rest) = bytes.split_at_mut(self.header.len());
        header.copy_from_slice(&self.header);
        rest[0] = self.mode.0;
        rest[1..].copy_from_slice(&self.kind);
        bytes
    }

    /// What [`to_bytes`](Self::to_bytes) made bytes of.
    pub(crate) fn from_bytes(bytes: line::Identity) -> Identity {
        let mut identity = Identity { header: Default::default(), mode: Mode(0), kind: [0; KIND_LEN] };
        let (header, rest) = bytes.split_at(identity.header.len());
        identity.header.copy_from_slice(header);
        identity.mode = Mode(rest[0]);
        identity.kind.copy_from_slice(&rest[1..]);
        identity
    }
}

const _: () = assert!(size_of::<StreamHeader>() + 1 + KIND_LEN == size_of::<line::Identity>());

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_comes_back_from_its_bytes() {
        let kind = *b"LMS200;301063;V02.30\0\0\0\0";
        let identity = Identity { header: [2, 0x80, 0xd6, 2, 0xb0, 0x69, 0x41], mode: Mode(4), kind };
        assert_eq!(Identity::from_bytes(identity.to_bytes()), identity);
        assert_eq!(identity.to_bytes()[6..9], [0x41, 4, b'L']);
    }
}
