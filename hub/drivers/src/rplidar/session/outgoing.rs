//! Requests on their way out, byte by byte. Knows no answer.

use crate::rplidar::request::Request;

/// Bytes on their way out.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Outgoing {
    bytes: [u8; 32],
    len: usize,
    sent: usize,
}

impl Outgoing {
    /// `request` goes out after what is here, as far as there is room.
    pub(super) fn push(&mut self, request: &Request) {
        for byte in request.bytes() {
            if let Some(place) = self.bytes.get_mut(self.len) {
                *place = *byte;
                self.len += 1;
            }
        }
    }

    pub(super) fn next(&self) -> Option<u8> {
        self.bytes[self.sent..self.len].first().copied()
    }

    /// The next byte was written. Whether it was the last one.
    pub(super) fn advance(&mut self) -> bool {
        self.sent += 1;
        let is_done = self.sent >= self.len;
        if is_done {
            *self = Outgoing::default();
        }
        is_done
    }
}
