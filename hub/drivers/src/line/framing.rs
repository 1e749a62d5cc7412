//! What begins at a place in a stream of packets of one length, of which bytes may be missing.
//!
//! A checksum of 8 bits is right by chance in 1 of 256, and a packet that lost bytes would take the head of the next one
//! along. So a packet in which another header begins is believed only if a header follows it, or if what begins inside
//! turns out to be none. Refuses to know what a packet says.

/// Packets of one length, which begin with a header of two bytes.
pub trait Format {
    /// Why bytes that begin like a packet are none.
    type Reject;

    /// Bytes of a packet.
    fn packet_len(&self) -> usize;

    /// Whether a header may begin here, as far as there are bytes; nothing may become one.
    fn begins(&self, bytes: &[u8]) -> bool;

    /// Whether so many bytes are a packet, by themselves.
    ///
    /// # Errors
    ///
    /// They are none, for this reason.
    fn check(&self, packet: &[u8]) -> Result<(), Self::Reject>;
}

/// What begins at a place.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict<R> {
    /// A packet.
    Packet,
    /// None; the reason, if it began like one and failed by itself.
    Nothing(Option<R>),
    /// More bytes will tell.
    Open,
    /// It would be a packet, if what begins inside is none, which more bytes will tell.
    Held,
}

/// What begins with `open`. If `is_released`, what begins inside is given up.
pub fn judge<F: Format>(format: &F, open: &[u8], is_released: bool) -> Verdict<F::Reject> {
    let len = format.packet_len();
    if !format.begins(open) {
        return Verdict::Nothing(None);
    }
    let Some(packet) = open.get(..len) else { return Verdict::Open };
    if let Err(reject) = format.check(packet) {
        return Verdict::Nothing(Some(reject));
    }
    if open.len() >= len + HEADER && format.begins(&open[len..]) {
        return Verdict::Packet;
    }
    for inside in (1..len).filter(|&inside| format.begins(&open[inside..])) {
        match open.get(inside..inside + len).map(|rival| format.check(rival)) {
            Some(Ok(())) => return Verdict::Nothing(None),
            Some(Err(_)) => {}
            None if is_released => {}
            None => return Verdict::Held,
        }
    }
    Verdict::Packet
}

/// Bytes of a header.
const HEADER: usize = 2;
