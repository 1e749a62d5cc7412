//! Tests of sessions with rotating scanners. This file has the simulated line from a rotating scanner, which damages
//! bytes.

mod ld;
mod rplidar;

use std::collections::VecDeque;

use scanhub_schema::{Nanos, line_time};

/// Rates of damage to the bytes of packets, as fractions of all bytes.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct DamageRates {
    /// Rate at which a burst of lost bytes begins. The mean length of a burst is four bytes.
    lost: f64,
    /// Rate of inserted bytes.
    inserted: f64,
    /// Rate of bytes with flipped bits.
    flipped: f64,
}

/// The line from a scanner to the host.
pub(crate) struct DamagedLine {
    damage: DamageRates,
    is_in_burst: bool,
    /// Bytes on the line, with the times at which they arrive.
    bytes: VecDeque<(Nanos, u8)>,
}

/// A packet as it was sent.
pub(crate) struct SentPacket {
    bytes: Vec<u8>,
    intact: bool,
    /// Time at which the packet's last byte has left the line, or would have left the line if no byte were lost.
    at: Nanos,
}

impl DamagedLine {
    fn new(damage: DamageRates) -> DamagedLine {
        DamagedLine { damage, is_in_burst: false, bytes: VecDeque::new() }
    }

    /// Puts `packet` on the line at `from` with `baud` bits per second.
    fn transmit(&mut self, packet: &[u8], from: Nanos, baud: u32, random: &mut fastrand::Rng) -> SentPacket {
        let (mut intact, mut at) = (true, from);
        for (place, &byte) in packet.iter().enumerate() {
            at += line_time(1, baud);
            let stays = if self.is_in_burst { 0.75 } else { self.damage.lost };
            self.is_in_burst = random.f64() < stays;
            if random.f64() < self.damage.inserted {
                self.bytes.push_back((at, random.u8(..)));
                intact &= place == 0;
            }
            let flip = if random.f64() < self.damage.flipped { random.u8(1..) } else { 0 };
            intact &= !self.is_in_burst && flip == 0;
            if !self.is_in_burst {
                self.bytes.push_back((at, byte ^ flip));
            }
        }
        SentPacket { bytes: packet.to_vec(), intact, at }
    }

    /// Returns the bytes that have arrived by `now`, at most `max_len`.
    fn read(&mut self, now: Nanos, max_len: usize) -> Vec<u8> {
        let count = self.bytes.iter().take(max_len).take_while(|(at, _)| *at <= now).count();
        self.bytes.drain(..count).map(|(_, byte)| byte).collect()
    }
}
