//! A motion as it is sent over a network: as it is, and its numbers are finite.

use bytemuck::{Zeroable, bytes_of, bytes_of_mut, pod_read_unaligned};

use super::{Packed, write};
use crate::Motion;

impl Packed for Motion {
    fn pack(&self, room: &mut [u8]) -> Option<usize> {
        write(room, &[bytes_of(self)])
    }

    fn room(payload: &[u8]) -> Option<usize> {
        let motion: Motion = pod_read_unaligned(payload.get(..size_of::<Motion>())?);
        let pose = [motion.x_m, motion.y_m, motion.yaw_rad];
        let step = [motion.dx_m, motion.dy_m, motion.dyaw_rad, motion.overlap];
        let numbers = step.iter().chain(&motion.covariance);
        let is_finite =
            pose.iter().all(|number| number.is_finite()) && { numbers }.all(|number| number.is_finite());
        is_finite.then_some(size_of::<Motion>())
    }

    fn unpack(&mut self, payload: &[u8]) -> bool {
        let Some(len) = Motion::room(payload) else { return false };
        *self = Motion::zeroed();
        bytes_of_mut(self).copy_from_slice(&payload[..len]);
        true
    }

    fn unpack_into(place: &mut Box<Self>, payload: &[u8]) -> bool {
        place.unpack(payload)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::datagram::payload::tests::there_and_back;

    #[test]
    fn a_motion_goes_there_and_back() {
        let motion = Motion { x_m: -1.5, dyaw_rad: 0.25, method: 5, breaks: 3, ..Motion::default() };
        there_and_back(&motion, &mut Motion::default(), 80);
        for (at, bytes) in [
            (16, &f64::NAN.to_le_bytes()[..]),
            (24, &f32::NAN.to_le_bytes()),
            (72, &f32::INFINITY.to_le_bytes()),
        ] {
            let mut bad = [0; 80];
            bad[at..at + bytes.len()].copy_from_slice(bytes);
            assert!(!Motion::default().unpack(&bad), "{bytes:?} at {at}");
        }
    }
}
