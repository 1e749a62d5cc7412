//! The payloads as they are sent over a network: the fields of shared memory in their order, without unused elements of
//! arrays. A received payload is checked against its own counts before it is used.

use bytemuck::{Pod, Zeroable, bytes_of, bytes_of_mut, cast_slice, cast_slice_mut, pod_read_unaligned};

use super::{Announce, Datagram, DatagramError};
use crate::limits::TopicLimits;
use crate::{
    BEAMS, Background, BackgroundHead, Cloud, CloudHead, CloudPoint, Contents, Corner, Early, Event,
    EventKind, Foreground, ForegroundArrays, ForegroundHead, LINES, Line, Lines, MARKS, Marks, Motion,
    OBSTACLES, Obstacle, Obstacles, SEGMENTS, Scan, ScanHead, Segment, Status, TRACK_SENSORS, TRACKS,
    Telegram, Tilt, Topic, Track, TrackSensor, Tracks, Verdict, ZONES, Zones,
};

/// A payload that can be sent over a network.
pub trait Packed {
    /// Writes the payload to the start of `room`. Returns its length, or `None` if there is too little room.
    fn pack(&self, room: &mut [u8]) -> Option<usize>;

    /// Returns the bytes of memory that `payload` fills. `None` if it is shorter than its own counts require or
    /// contradicts itself. Bytes after it belong to a later revision.
    fn room(payload: &[u8]) -> Option<usize>;

    /// Raises `limits` until a topic that is created with them has room for `payload`, for which [`room`](Self::room)
    /// returned a length.
    fn widen(limits: &mut TopicLimits, payload: &[u8]) {
        let _ = (limits, payload);
    }

    /// Replaces the value by `payload`. Returns `false`, and leaves the value undefined, if `payload` has no
    /// [`room`](Self::room) or there is too little memory.
    #[must_use]
    fn unpack(&mut self, payload: &[u8]) -> bool;

    /// Does the same as [`unpack`](Self::unpack), and makes `place` longer if it is too short.
    #[must_use]
    fn unpack_into(place: &mut Box<Self>, payload: &[u8]) -> bool;
}

impl<'a> Datagram<'a> {
    /// Returns the payload of topic `telegram` as a telegram, if it is one of the sensor's family.
    pub fn telegram(&self) -> Option<Telegram<'a>> {
        Telegram::of(self.head.family, self.payload)
    }

    /// Checks that the topic is known, and that the payload is valid for it.
    ///
    /// # Errors
    ///
    /// Returns [`DatagramError::Skipped`] if this version does not have the topic, and [`DatagramError::Payload`] if
    /// the payload is not valid for it.
    pub fn check_payload(&self) -> Result<(), DatagramError> {
        let is_sound = match Topic::of_number(self.head.topic) {
            None if self.head.topic == Announce::NUMBER => Announce::unpack(self.payload).is_some(),
            None => return Err(DatagramError::Skipped),
            Some(Topic::Telegram) => self.telegram().is_some(),
            Some(topic) => is_sound(topic, self.payload),
        };
        if is_sound && self.head.revision > 0 && self.head.parts == 1 {
            Ok(())
        } else {
            Err(DatagramError::Payload)
        }
    }
}

macro_rules! check {
    ($($topic:ident $payload:tt, $name:ident, $($column:tt),*: $about:literal;)*) => {
        /// Returns whether the payload is valid for `topic`.
        fn is_sound(topic: Topic, payload: &[u8]) -> bool {
            match topic { $(Topic::$topic => <crate::payload_type!($payload)>::room(payload).is_some(),)* }
        }
    };
}

crate::for_each_topic!(check);

impl Packed for [u8] {
    fn pack(&self, room: &mut [u8]) -> Option<usize> {
        write(room, &[self])
    }

    fn room(payload: &[u8]) -> Option<usize> {
        (1..=Telegram::MAX).contains(&payload.len()).then_some(payload.len())
    }

    fn widen(limits: &mut TopicLimits, payload: &[u8]) {
        limits.telegram = limits.telegram.max(payload.len());
    }

    fn unpack(&mut self, payload: &[u8]) -> bool {
        let Some(len) = <[u8]>::room(payload) else { return false };
        self.get_mut(..len).map(|memory| memory.copy_from_slice(payload)).is_some()
    }

    fn unpack_into(place: &mut Box<[u8]>, payload: &[u8]) -> bool {
        <[u8]>::room(payload).map(|_| *place = payload.into()).is_some()
    }
}

impl Packed for Scan {
    fn pack(&self, room: &mut [u8]) -> Option<usize> {
        write(room, &[self.bytes()])
    }

    fn room(payload: &[u8]) -> Option<usize> {
        let head: ScanHead = pod_read_unaligned(payload.get(..Scan::HEAD)?);
        let len = Scan::len(head.count.into(), head.contents);
        let is_known = usize::from(head.count) <= BEAMS && head.contents & !Contents::ALL == 0;
        let is_finite = head.first_angle.is_finite() && head.step.is_finite() && head.spacing.is_finite();
        (is_known && is_finite && len <= payload.len()).then_some(len)
    }

    fn widen(limits: &mut TopicLimits, payload: &[u8]) {
        let Some(head) = payload.get(..Scan::HEAD) else { return };
        let head: ScanHead = pod_read_unaligned(head);
        limits.beams = limits.beams.max(head.count.into());
        limits.contents |= head.contents;
    }

    fn unpack(&mut self, payload: &[u8]) -> bool {
        Scan::room(payload).is_some_and(|len| self.copy_from(&payload[..len]))
    }

    fn unpack_into(place: &mut Box<Self>, payload: &[u8]) -> bool {
        Scan::room(payload).is_some_and(|len| {
            Scan::grow(place, len);
            place.unpack(payload)
        })
    }
}

impl Packed for Marks {
    fn pack(&self, room: &mut [u8]) -> Option<usize> {
        write(room, &[&bytes_of(self)[..MARKS_HEAD + 16 * self.marks().len()]])
    }

    fn room(payload: &[u8]) -> Option<usize> {
        let count = usize::from(*payload.first()?);
        fits(payload, MARKS_HEAD + 16 * count).filter(|_| count <= MARKS)
    }

    fn unpack(&mut self, payload: &[u8]) -> bool {
        take(self, payload)
    }

    fn unpack_into(place: &mut Box<Self>, payload: &[u8]) -> bool {
        place.unpack(payload)
    }
}

impl Packed for Zones {
    fn pack(&self, room: &mut [u8]) -> Option<usize> {
        write(room, &[&bytes_of(self)[..ZONES_HEAD + 8 * self.zones().len()]])
    }

    fn room(payload: &[u8]) -> Option<usize> {
        let count = usize::from(*payload.get(1)?);
        fits(payload, ZONES_HEAD + 8 * count).filter(|_| count <= ZONES)
    }

    fn unpack(&mut self, payload: &[u8]) -> bool {
        take(self, payload)
    }

    fn unpack_into(place: &mut Box<Self>, payload: &[u8]) -> bool {
        place.unpack(payload)
    }
}

impl Packed for Status {
    fn pack(&self, room: &mut [u8]) -> Option<usize> {
        write(room, &[bytes_of(self)])
    }

    fn room(payload: &[u8]) -> Option<usize> {
        fits(payload, size_of::<Status>())
    }

    fn unpack(&mut self, payload: &[u8]) -> bool {
        take(self, payload)
    }

    fn unpack_into(place: &mut Box<Self>, payload: &[u8]) -> bool {
        place.unpack(payload)
    }
}

impl Packed for Early {
    fn pack(&self, room: &mut [u8]) -> Option<usize> {
        write(room, &[bytes_of(self)])
    }

    fn room(payload: &[u8]) -> Option<usize> {
        let is_warning =
            [Verdict::Slow, Verdict::Stop].map(|verdict| verdict as u8).contains(payload.first()?);
        fits(payload, size_of::<Early>()).filter(|_| is_warning)
    }

    fn unpack(&mut self, payload: &[u8]) -> bool {
        take(self, payload)
    }

    fn unpack_into(place: &mut Box<Self>, payload: &[u8]) -> bool {
        place.unpack(payload)
    }
}

impl Packed for Background {
    fn pack(&self, room: &mut [u8]) -> Option<usize> {
        write(room, &[self.bytes()])
    }

    fn room(payload: &[u8]) -> Option<usize> {
        let head: BackgroundHead = pod_read_unaligned(payload.get(..Background::HEAD)?);
        let is_finite = head.first_angle.is_finite() && head.step.is_finite();
        let is_known = usize::from(head.count) <= BEAMS && is_finite;
        fits(payload, Background::len(head.count.into())).filter(|_| is_known)
    }

    fn widen(limits: &mut TopicLimits, payload: &[u8]) {
        let Some(head) = payload.get(..Background::HEAD) else { return };
        let head: BackgroundHead = pod_read_unaligned(head);
        limits.beams = limits.beams.max(head.count.into());
    }

    fn unpack(&mut self, payload: &[u8]) -> bool {
        Background::room(payload).is_some_and(|len| self.copy_from(&payload[..len]))
    }

    fn unpack_into(place: &mut Box<Self>, payload: &[u8]) -> bool {
        Background::room(payload).is_some_and(|len| {
            Background::grow(place, len);
            place.unpack(payload)
        })
    }
}

/// Returns `len` if `payload` has at least this number of bytes.
fn fits(payload: &[u8], len: usize) -> Option<usize> {
    (len <= payload.len()).then_some(len)
}

/// Sets the start of `value` to the start of `payload`, and the rest to 0.
fn take<T: Pod + Packed>(value: &mut T, payload: &[u8]) -> bool {
    let Some(len) = T::room(payload) else { return false };
    *value = T::zeroed();
    bytes_of_mut(value)[..len].copy_from_slice(&payload[..len]);
    true
}

/// Writes `parts` one after the other. Returns their total length.
fn write(room: &mut [u8], parts: &[&[u8]]) -> Option<usize> {
    let mut end = 0;
    for part in parts {
        room.get_mut(end..end + part.len())?.copy_from_slice(part);
        end += part.len();
    }
    Some(end)
}

const MARKS_HEAD: usize = 4;
const ZONES_HEAD: usize = 12;

impl Packed for Foreground {
    /// Writes head, bits, the used ranges, and as many segments as there is room for. The other segments are counted as
    /// left out.
    fn pack(&self, room: &mut [u8]) -> Option<usize> {
        let fixed = |head: &ForegroundHead, room: &mut [u8]| {
            write(room, &[bytes_of(head), self.bits(), cast_slice::<u16, u8>(self.ranges())])
        };
        let used = fixed(self, room)?;
        let fit = self.segments().len().min((room.len() - used) / size_of::<Segment>());
        let left_out = usize::from(self.left_out) + self.segments().len() - fit;
        let left_out = left_out.min(usize::from(u16::MAX)) as u16;
        let supported = self.supported & only(fit);
        let used = fixed(&ForegroundHead { segments: fit as u16, left_out, supported, ..**self }, room)?;
        Some(used + write(&mut room[used..], &[cast_slice(&self.segments()[..fit])])?)
    }

    fn room(payload: &[u8]) -> Option<usize> {
        let (head, parts) = foreground_parts(payload)?;
        let inside = |segment: &Segment| segment.first <= segment.last && segment.last < head.count;
        let segments_inside = parts.segments.chunks_exact(size_of::<Segment>()).map(pod_read_unaligned);
        let members: u32 = parts.bits.iter().map(|byte| byte.count_ones()).sum();
        let unused = parts.bits.last().map_or(0, |last| match head.count % 8 {
            0 => 0,
            used => last >> used,
        });
        let is_sound = segments_inside.into_iter().all(|segment| inside(&segment))
            && members == u32::from(head.beams)
            && unused == 0
            && head.supported & !only(head.segments.into()) == 0;
        is_sound.then_some(Foreground::len(head.count.into()))
    }

    fn widen(limits: &mut TopicLimits, payload: &[u8]) {
        let Some(head) = payload.get(..Foreground::HEAD) else { return };
        let head: ForegroundHead = pod_read_unaligned(head);
        limits.beams = limits.beams.max(head.count.into());
    }

    fn unpack(&mut self, payload: &[u8]) -> bool {
        if Foreground::room(payload).is_none_or(|room| !self.clear(room)) {
            return false;
        }
        let Some((head, parts)) = foreground_parts(payload) else { return false };
        let ForegroundArrays { segments, bits, ranges } = self.begin(head);
        bits.copy_from_slice(parts.bits);
        cast_slice_mut(&mut ranges[..head.beams.into()]).copy_from_slice(parts.ranges);
        cast_slice_mut(&mut segments[..head.segments.into()]).copy_from_slice(parts.segments);
        true
    }

    fn unpack_into(place: &mut Box<Self>, payload: &[u8]) -> bool {
        Foreground::room(payload).is_some_and(|len| {
            Foreground::grow(place, len);
            place.unpack(payload)
        })
    }
}

/// Returns a word with a bit for each of the first `segments` segments.
fn only(segments: usize) -> u64 {
    if segments < SEGMENTS { (1 << segments) - 1 } else { u64::MAX }
}

/// Arrays after the head of a packed foreground.
struct ForegroundParts<'a> {
    bits: &'a [u8],
    ranges: &'a [u8],
    segments: &'a [u8],
}

/// Returns head and arrays of a packed foreground, or `None` if it is too short.
fn foreground_parts(payload: &[u8]) -> Option<(ForegroundHead, ForegroundParts<'_>)> {
    let (head, rest) = payload.split_at_checked(Foreground::HEAD)?;
    let head: ForegroundHead = pod_read_unaligned(head);
    let (count, beams, most) = (usize::from(head.count), usize::from(head.beams), usize::from(head.segments));
    if count > BEAMS || beams > count || most > SEGMENTS {
        return None;
    }
    let (bits, rest) = rest.split_at_checked(count.div_ceil(8))?;
    let (ranges, rest) = rest.split_at_checked(2 * beams)?;
    let segments = rest.get(..most * size_of::<Segment>())?;
    Some((head, ForegroundParts { bits, ranges, segments }))
}

impl Packed for Lines {
    fn pack(&self, room: &mut [u8]) -> Option<usize> {
        let head = &bytes_of(self)[..LINES_HEAD];
        write(room, &[head, cast_slice(self.lines()), cast_slice(self.corners())])
    }

    fn room(payload: &[u8]) -> Option<usize> {
        let (head, lines, corners) = lines_parts(payload)?;
        let is_finite = |bytes: &[u8]| pod_read_unaligned::<f32>(bytes).is_finite();
        let are_finite = |bytes: &[u8]| bytes.chunks_exact(size_of::<f32>()).all(is_finite);
        let is_sound = are_finite(&head[LINES_NOISE..])
            && lines.chunks_exact(size_of::<Line>()).all(|line| are_finite(&line[..LINE_BEAMS]))
            && corners.chunks_exact(size_of::<Corner>()).all(|corner| {
                let Corner { x_m, y_m, first_line, second_line } = pod_read_unaligned(corner);
                x_m.is_finite() && y_m.is_finite() && first_line.max(second_line) < head[0].into()
            });
        is_sound.then_some(LINES_HEAD + lines.len() + corners.len())
    }

    fn unpack(&mut self, payload: &[u8]) -> bool {
        let Some((head, lines, corners)) = Lines::room(payload).and_then(|_| lines_parts(payload)) else {
            return false;
        };
        *self = Lines::zeroed();
        bytes_of_mut(self)[..LINES_HEAD].copy_from_slice(head);
        bytes_of_mut(&mut self.line_array)[..lines.len()].copy_from_slice(lines);
        bytes_of_mut(&mut self.corner_array)[..corners.len()].copy_from_slice(corners);
        true
    }

    fn unpack_into(place: &mut Box<Self>, payload: &[u8]) -> bool {
        place.unpack(payload)
    }
}

/// Returns head, lines and corners of packed lines, or `None` if they are too short.
fn lines_parts(payload: &[u8]) -> Option<(&[u8], &[u8], &[u8])> {
    let (head, rest) = payload.split_at_checked(LINES_HEAD)?;
    let (count, corners) = (usize::from(head[0]), usize::from(head[1]));
    if count > LINES || corners > LINES {
        return None;
    }
    let (lines, rest) = rest.split_at_checked(count * size_of::<Line>())?;
    Some((head, lines, rest.get(..corners * size_of::<Corner>())?))
}

const LINES_HEAD: usize = std::mem::offset_of!(Lines, line_array);
const LINES_NOISE: usize = std::mem::offset_of!(Lines, noise_m);
const LINE_BEAMS: usize = std::mem::offset_of!(Line, first);

impl Packed for Motion {
    fn pack(&self, room: &mut [u8]) -> Option<usize> {
        write(room, &[bytes_of(self)])
    }

    fn room(payload: &[u8]) -> Option<usize> {
        let motion = read_motion(payload)?;
        let pose = [motion.x_m, motion.y_m, motion.yaw_rad];
        let step = [motion.dx_m, motion.dy_m, motion.dyaw_rad, motion.overlap];
        let numbers = step.iter().chain(&motion.covariance).chain(&motion.pose_covariance);
        let is_finite =
            pose.iter().all(|number| number.is_finite()) && { numbers }.all(|number| number.is_finite());
        is_finite.then_some(size_of::<Motion>())
    }

    fn unpack(&mut self, payload: &[u8]) -> bool {
        let Some(motion) = Motion::room(payload).and_then(|_| read_motion(payload)) else { return false };
        *self = motion;
        true
    }

    fn unpack_into(place: &mut Box<Self>, payload: &[u8]) -> bool {
        place.unpack(payload)
    }
}

/// Returns the motion in `payload`; `None` if it is too short. Revision 1 ends before the covariance of the pose.
fn read_motion(payload: &[u8]) -> Option<Motion> {
    let mut motion = Motion::zeroed();
    let len = if payload.len() < size_of::<Motion>() { MOTION_1 } else { size_of::<Motion>() };
    bytes_of_mut(&mut motion)[..len].copy_from_slice(payload.get(..len)?);
    Some(motion)
}

/// Length of a motion of revision 1.
const MOTION_1: usize = std::mem::offset_of!(Motion, pose_covariance);

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

/// Returns whether all f32 in `bytes` are finite.
fn are_finite(bytes: &[u8]) -> bool {
    bytes.chunks_exact(size_of::<f32>()).all(|bytes| pod_read_unaligned::<f32>(bytes).is_finite())
}

const OBSTACLES_HEAD: usize = std::mem::offset_of!(Obstacles, obstacle_array);

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

/// Returns head, people and sensors of packed tracks, or `None` if they are too short.
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
    use crate::{Mark, Pose, Zone};

    /// Packs `value` into `len` bytes, and unpacks it into `back`.
    fn there_and_back<T: Packed + PartialEq + std::fmt::Debug + ?Sized>(value: &T, back: &mut T, len: usize) {
        let mut room = [0xAA; 2000];
        assert_eq!(value.pack(&mut room), Some(len));
        assert!(back.unpack(&room[..len + 7]), "what follows is a later revision's");
        assert_eq!(back, value);
        for short in 0..len {
            assert!(!back.unpack(&room[..short]), "{short} of {len} bytes");
            assert_eq!(value.pack(&mut [0; 2000][..short]), None, "room for {short} of {len} bytes");
        }
    }

    #[test]
    fn payloads_go_there_and_back() {
        let head =
            ScanHead { unit_um: 1000, valid_to: 8182, contents: Contents::UPPER, ..ScanHead::default() };
        let mut scan = Scan::of(head, &[0; 361]);
        scan.arrays().ranges[360] = 0x1234;
        let mut room = Scan::zeroed(64 + 3 * 361);
        there_and_back(&*scan, &mut room, 64 + 3 * 361);
        assert!(!Scan::zeroed(64 + 3 * 360).unpack(scan.bytes()), "there is too little memory");
        let mut marks = Marks { count: 2, flags: 1, ..Marks::default() };
        marks.mark_array[1] = Mark { angle_mdeg: -1, ..Mark::default() };
        there_and_back(&marks, &mut Marks::default(), 4 + 32);
        let mut zones = Zones { count: 2, ..Zones::unknown() };
        zones.zone_array[1] = Zone { radius_mm: 600, ..Zone::default() };
        there_and_back(&zones, &mut Zones::default(), 12 + 16);
        let early = Early { verdict: 2, beam: 90, distance_mm: 512, bytes_seen: 240, ..Early::default() };
        there_and_back(&early, &mut Early::default(), 12);
        let model = Background::of(BackgroundHead::default(), &[0, 0, 7]);
        there_and_back(&*model, &mut Background::zeroed(38), 32 + 6);
        there_and_back(&Status { baud: 500_000, ..Status::default() }, &mut Status::default(), 592);
    }

    /// Returns a foreground of 361 beams with 64 foreground beams and as many segments.
    fn foreground() -> Box<Foreground> {
        let mut foreground = Foreground::of(361);
        let head = ForegroundHead {
            count: 361,
            beams: 64,
            segments: 64,
            left_out: 3,
            supported: 0xF0F0_0000_0000_F5A3,
            ..ForegroundHead::default()
        };
        let arrays = foreground.begin(head);
        for i in 0..64 {
            arrays.bits[i / 2] |= if i % 2 == 0 { 1 } else { 16 };
            arrays.ranges[i] = i as u16;
            let beam = 4 * i as u16;
            arrays.segments[i] = Segment { first: beam, last: beam, ..Segment::default() };
        }
        foreground
    }

    #[test]
    fn a_foreground_leaves_out_the_segments_without_room() {
        let foreground = foreground();
        let mut room = [0; 24 + 46 + 128 + 16 * 10 + 15];
        assert_eq!(foreground.pack(&mut room), Some(24 + 46 + 128 + 160));
        let mut back = Foreground::zeroed(Foreground::len(361));
        assert!(back.unpack(&room));
        assert_eq!((back.segments, back.left_out, back.supported), (10, 57, 0x1A3));
        assert_eq!(back.segments(), &foreground.segments()[..10]);
        assert!(back.readings().eq(foreground.readings()));
        let mut whole = [0; 2000];
        let len = foreground.pack(&mut whole).unwrap();
        assert!(back.unpack(&whole[..len]));
        assert_eq!((len, back), (24 + 46 + 128 + 1024, foreground));
    }

    #[test]
    fn what_contradicts_itself_is_refused() {
        let refused = |payload: &[u8]| !Foreground::of(3).unpack(payload);
        let mut good = [0; 24 + 1 + 2];
        (good[8], good[10], good[24]) = (3, 1, 4);
        assert!(!refused(&good));
        for (at, byte) in [(24, 8), (24, 3), (24, 0), (10, 4), (9, 2), (12, 1), (16, 1), (23, 0x80)] {
            let mut bad = good;
            bad[at] = byte;
            assert!(refused(&bad), "{byte} at {at}");
        }
        assert_eq!([0, 3, 4].map(|verdict| Early::room(&[verdict; 12])), [None; 3], "no warning");
        let other = Scan::of(ScanHead { step: f64::NAN, ..ScanHead::default() }, &[1]);
        assert_eq!(Scan::room(other.bytes()), None, "no angle is known");
        assert_eq!((Marks::room(&[65; 2000]), Zones::room(&[9; 2000])), (None, None));
        assert_eq!((Scan::room(&[0xFF; 2000]), Background::room(&[0xFF; 2000])), (None, None));
    }

    #[test]
    fn lines_go_there_and_back() {
        let mut lines = Lines { count: 2, corners: 1, ..Lines::default() };
        lines.line_array[1] = Line { alpha_rad: -1.0, last: 7, ..Line::default() };
        lines.corner_array[0] = Corner { x_m: 2.0, second_line: 1, ..Corner::default() };
        there_and_back(&lines, &mut Lines::default(), 12 + 80 + 12);
    }

    #[test]
    fn lines_that_contradict_themselves_are_refused() {
        let mut lines = [0; 12 + 40 + 12];
        (lines[0], lines[1]) = (1, 1);
        assert_eq!(Lines::room(&lines), Some(lines.len()));
        for (at, bytes) in [
            (0, &[65][..]),
            (1, &[65]),
            (8, &f32::NAN.to_le_bytes()),
            (12, &f32::NAN.to_le_bytes()),
            (40, &f32::INFINITY.to_le_bytes()),
            (52, &f32::NAN.to_le_bytes()),
            (60, &[1]),
        ] {
            let mut bad = lines;
            bad[at..at + bytes.len()].copy_from_slice(bytes);
            assert!(!Lines::default().unpack(&bad), "{bytes:?} at {at}");
        }
    }

    #[test]
    fn a_motion_goes_there_and_back() {
        let mut motion = Motion { x_m: -1.5, dyaw_rad: 0.25, method: 5, breaks: 3, ..Motion::default() };
        motion.pose_covariance[8] = 0.5;
        let (mut room, mut back) = ([0xAA; 127], Motion::default());
        assert_eq!((motion.pack(&mut room[..119]), motion.pack(&mut room)), (None, Some(120)));
        assert!(back.unpack(&room) && back == motion, "bytes after it belong to a later revision");
        assert_eq!(back.sum_covariance(), Some(&motion.pose_covariance));
        // Revision 1 has no covariance of the pose.
        for short in 80..120 {
            assert!(back.unpack(&room[..short]));
            assert_eq!(back, Motion { pose_covariance: [0.0; 9], ..motion }, "{short}");
            assert_eq!((back.has_valid_pose(), back.sum_covariance()), (true, None));
        }
        assert!((0..80).all(|short| !back.unpack(&room[..short])));
        for (at, bytes) in [
            (16, &f64::NAN.to_le_bytes()[..]),
            (24, &f32::NAN.to_le_bytes()),
            (72, &f32::INFINITY.to_le_bytes()),
            (112, &f32::NAN.to_le_bytes()),
        ] {
            let mut bad = [0; 120];
            bad[at..at + bytes.len()].copy_from_slice(bytes);
            assert!(!Motion::default().unpack(&bad), "{bytes:?} at {at}");
        }
    }

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
