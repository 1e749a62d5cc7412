//! Angles of mounts, and what is made of them, as they are sent over a network: as they are, of obstacles those that there are.

use bytemuck::{bytes_of, pod_read_unaligned};

use super::{Packed, fits, take, write};
use crate::limits::TopicLimits;
use crate::{BEAMS, Cloud, CloudHead, CloudPoint, OBSTACLES, Obstacle, Obstacles, Tilt};

impl Packed for Tilt {
    fn pack(&self, room: &mut [u8]) -> Option<usize> {
        write(room, &[bytes_of(self)])
    }

    fn room(payload: &[u8]) -> Option<usize> {
        let len = fits(payload, size_of::<Tilt>())?;
        let Tilt { angle_rad, rate_rad_s } = pod_read_unaligned(&payload[..len]);
        (angle_rad.is_finite() && !rate_rad_s.is_infinite()).then_some(len)
    }

    fn unpack(&mut self, payload: &[u8]) -> bool {
        take(self, payload)
    }

    fn unpack_into(place: &mut Box<Self>, payload: &[u8]) -> bool {
        place.unpack(payload)
    }
}

impl Packed for Cloud {
    fn pack(&self, room: &mut [u8]) -> Option<usize> {
        write(room, &[self.bytes()])
    }

    fn room(payload: &[u8]) -> Option<usize> {
        let count = usize::from(cloud_head(payload)?.count);
        let len = fits(payload, Cloud::len(count)).filter(|_| count <= BEAMS)?;
        let is_finite = |point: &[u8]| are_finite(&point[..std::mem::offset_of!(CloudPoint, beam)]);
        payload[Cloud::HEAD..len].chunks_exact(size_of::<CloudPoint>()).all(is_finite).then_some(len)
    }

    fn widen(limits: &mut TopicLimits, payload: &[u8]) {
        let Some(head) = cloud_head(payload) else { return };
        limits.beams = limits.beams.max(head.count.into());
    }

    fn unpack(&mut self, payload: &[u8]) -> bool {
        Cloud::room(payload).is_some_and(|len| self.copy_from(&payload[..len]))
    }

    fn unpack_into(place: &mut Box<Self>, payload: &[u8]) -> bool {
        Cloud::room(payload).is_some_and(|len| {
            Cloud::grow(place, len);
            place.unpack(payload)
        })
    }
}

impl Packed for Obstacles {
    fn pack(&self, room: &mut [u8]) -> Option<usize> {
        write(room, &[&bytes_of(self)[..OBSTACLES_HEAD + size_of_val(self.obstacles())]])
    }

    fn room(payload: &[u8]) -> Option<usize> {
        let count = usize::from(*payload.get(std::mem::offset_of!(Obstacles, count))?);
        let len = fits(payload, OBSTACLES_HEAD + size_of::<Obstacle>() * count);
        let len = len.filter(|_| count <= OBSTACLES)?;
        let is_finite = |one: &[u8]| are_finite(&one[..std::mem::offset_of!(Obstacle, points)]);
        payload[OBSTACLES_HEAD..len].chunks_exact(size_of::<Obstacle>()).all(is_finite).then_some(len)
    }

    fn unpack(&mut self, payload: &[u8]) -> bool {
        take(self, payload)
    }

    fn unpack_into(place: &mut Box<Self>, payload: &[u8]) -> bool {
        place.unpack(payload)
    }
}

fn cloud_head(payload: &[u8]) -> Option<CloudHead> {
    payload.get(..Cloud::HEAD).map(pod_read_unaligned)
}

/// `bytes` are f32 that are all finite.
fn are_finite(bytes: &[u8]) -> bool {
    bytes.chunks_exact(size_of::<f32>()).all(|bytes| pod_read_unaligned::<f32>(bytes).is_finite())
}

const OBSTACLES_HEAD: usize = std::mem::offset_of!(Obstacles, obstacle_array);

#[cfg(test)]
mod tests {
    use super::*;
    use crate::datagram::payload::tests::there_and_back;

    fn cloud() -> Box<Cloud> {
        let point = CloudPoint { at: [1.0, -2.0, 0.5], beam: 7, point_class: 2, reserved: 0 };
        Cloud::of(CloudHead { sweep: 9, ..CloudHead::default() }, &[point; 3])
    }

    fn obstacles() -> Obstacles {
        let mut found = Obstacles { sweep: 9, ..Obstacles::default() };
        found.push(Obstacle { distance_m: 2.0, points: 8, ..Obstacle::default() });
        found
    }

    #[test]
    fn tilted_payloads_go_there_and_back() {
        let tilt = Tilt { angle_rad: -0.5, rate_rad_s: 0.25 };
        there_and_back(&tilt, &mut Tilt::default(), 16);
        assert!(Tilt::default().unpack(bytes_of(&Tilt::default())), "a rate need not be known");
        there_and_back(&*cloud(), &mut Cloud::zeroed(Cloud::len(3)), 16 + 3 * 16);
        assert!(!Cloud::zeroed(Cloud::len(2)).unpack(cloud().bytes()), "there is too little memory");
        there_and_back(&obstacles(), &mut Obstacles::default(), 16 + 48);
        there_and_back(&Obstacles::default(), &mut Obstacles::default(), 16);
    }

    #[test]
    fn numbers_that_are_none_and_too_many_are_refused() {
        for bad in [
            Tilt { angle_rad: f64::NAN, rate_rad_s: 0.0 },
            Tilt { angle_rad: 0.0, rate_rad_s: f64::INFINITY },
        ] {
            assert_eq!(Tilt::room(bytes_of(&bad)), None);
        }
        let mut bad = cloud();
        bad.begin(CloudHead { count: 3, ..CloudHead::default() })[2].at[2] = f32::NAN;
        assert_eq!(Cloud::room(bad.bytes()), None);
        let mut many = vec![0; Cloud::len(BEAMS + 1)];
        many[8..10].copy_from_slice(&(BEAMS as u16 + 1).to_le_bytes());
        assert_eq!(Cloud::room(&many), None);
        let mut bad = obstacles();
        bad.obstacle_array[0].distance_m = f32::INFINITY;
        assert_eq!(Obstacles::room(bytes_of(&bad)), None);
        let mut many = vec![0; OBSTACLES_HEAD + 65 * size_of::<Obstacle>()];
        many[12] = 65;
        assert_eq!(Obstacles::room(&many), None);
    }

    #[test]
    fn a_topic_is_made_wider_for_a_longer_cloud() {
        let points = [CloudPoint::default(); 500];
        let mut limits = TopicLimits::default();
        Cloud::widen(&mut limits, Cloud::of(CloudHead::default(), &points).bytes());
        assert_eq!(limits.beams, 500);
        Cloud::widen(&mut limits, cloud().bytes());
        assert_eq!(limits.beams, 500);
    }
}
