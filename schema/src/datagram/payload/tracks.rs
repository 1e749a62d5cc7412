//! People as they are sent over a network: a head, the persons and the sensors that there are; and an event, as it
//! is.

use bytemuck::{Zeroable, bytes_of, bytes_of_mut, cast_slice, pod_read_unaligned};

use super::{Packed, fits, take, write};
use crate::{Event, EventKind, TRACK_SENSORS, TRACKS, Track, TrackSensor, Tracks};

impl Packed for Tracks {
    fn pack(&self, room: &mut [u8]) -> Option<usize> {
        let head = &bytes_of(self)[..TRACKS_HEAD];
        write(room, &[head, cast_slice(self.tracks()), cast_slice(self.sensors())])
    }

    fn room(payload: &[u8]) -> Option<usize> {
        let (_, tracks, sensors) = tracks_parts(payload)?;
        let named = sensors.len() / size_of::<TrackSensor>();
        let is_sound = |bytes: &[u8]| {
            let Track { x_m, y_m, vx_m_s, vy_m_s, covariance: [xx, xy, yy], score, sensors, .. } =
                pod_read_unaligned(bytes);
            let is_finite =
                [x_m, y_m, vx_m_s, vy_m_s, xx, xy, yy, score].iter().all(|value| value.is_finite());
            is_finite && u64::from(sensors) >> named == 0
        };
        let are_sound = tracks.chunks_exact(size_of::<Track>()).all(is_sound);
        let is_placed = |bytes: &[u8]| {
            let TrackSensor { x_m, y_m, yaw_rad, .. } = pod_read_unaligned(bytes);
            [x_m, y_m, yaw_rad].iter().all(|value| value.is_finite())
        };
        let are_sound = are_sound && sensors.chunks_exact(size_of::<TrackSensor>()).all(is_placed);
        are_sound.then_some(TRACKS_HEAD + tracks.len() + sensors.len())
    }

    fn unpack(&mut self, payload: &[u8]) -> bool {
        let Some((head, tracks, sensors)) = Tracks::room(payload).and_then(|_| tracks_parts(payload)) else {
            return false;
        };
        *self = Tracks::zeroed();
        bytes_of_mut(self)[..TRACKS_HEAD].copy_from_slice(head);
        bytes_of_mut(&mut self.track_array)[..tracks.len()].copy_from_slice(tracks);
        bytes_of_mut(&mut self.sensor_array)[..sensors.len()].copy_from_slice(sensors);
        true
    }

    fn unpack_into(place: &mut Box<Self>, payload: &[u8]) -> bool {
        place.unpack(payload)
    }
}

/// Head, persons and sensors of packed tracks, if they are there.
fn tracks_parts(payload: &[u8]) -> Option<(&[u8], &[u8], &[u8])> {
    let (head, rest) = payload.split_at_checked(TRACKS_HEAD)?;
    let (count, sensors) = (usize::from(head[0]), usize::from(head[1]));
    if count > TRACKS || sensors > TRACK_SENSORS {
        return None;
    }
    let (tracks, rest) = rest.split_at_checked(count * size_of::<Track>())?;
    Some((head, tracks, rest.get(..sensors * size_of::<TrackSensor>())?))
}

const TRACKS_HEAD: usize = std::mem::offset_of!(Tracks, track_array);

impl Packed for Event {
    fn pack(&self, room: &mut [u8]) -> Option<usize> {
        write(room, &[bytes_of(self)])
    }

    fn room(payload: &[u8]) -> Option<usize> {
        let is_known = EventKind::of_number(*payload.get(std::mem::offset_of!(Event, kind))?).is_some();
        fits(payload, size_of::<Event>()).filter(|_| is_known)
    }

    fn unpack(&mut self, payload: &[u8]) -> bool {
        take(self, payload)
    }

    fn unpack_into(place: &mut Box<Self>, payload: &[u8]) -> bool {
        place.unpack(payload)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Pose;
    use crate::datagram::payload::tests::there_and_back;

    fn two() -> Tracks {
        let mut tracks = Tracks::default();
        for name in ["front", "kitchen.rear"] {
            tracks.push_sensor(TrackSensor::new(name, &Pose::default()));
        }
        tracks.push(Track { id: 1, x_m: -1.5, sensors: 3, ..Track::default() });
        tracks.push(Track { id: u64::MAX, age_ms: 9, state: 2, ..Track::default() });
        tracks
    }

    #[test]
    fn people_go_there_and_back() {
        there_and_back(&two(), &mut Tracks::default(), 8 + 2 * 80 + 2 * 72);
        there_and_back(&Tracks::default(), &mut Tracks::default(), 8);
        let event = Event::new(EventKind::Door, 5, Some("hall")).through("left", "kitchen", "hall");
        there_and_back(&event, &mut Event::default(), 112);
    }

    #[test]
    fn tracks_that_contradict_themselves_are_refused() {
        let mut sound = [0; 8 + 2 * 80 + 2 * 72];
        assert_eq!(two().pack(&mut sound), Some(sound.len()));
        for (at, bytes) in [
            (0, &[65][..]),
            (0, &[3]),
            (1, &[33]),
            (1, &[1]),
            (8 + 8, &f32::NAN.to_le_bytes()),
            (88 + 36, &f32::INFINITY.to_le_bytes()),
            (8 + 44, &[4]),
            (8 + 160 + 72 + 8, &f32::NAN.to_le_bytes()),
        ] {
            let mut bad = sound;
            bad[at..at + bytes.len()].copy_from_slice(bytes);
            assert!(!Tracks::default().unpack(&bad), "{bytes:?} at {at}");
        }
        assert!(!Event::default().unpack(&[0; 111]));
        assert!(!Event::default().unpack(&[3; 112]), "no such kind");
    }
}
