//! The payloads as they are sent over a network: the fields of shared memory in their order, without unused parts. A
//! received payload is checked against its own counts before it is used.

mod foreground;
mod lines;
mod motion;
mod tilted;
mod tracks;

use bytemuck::{Pod, bytes_of, bytes_of_mut, pod_read_unaligned};

use super::{Announce, Datagram, DatagramError};
use crate::limits::TopicLimits;
use crate::{
    BEAMS, Background, BackgroundHead, Contents, Early, MARKS, Marks, Scan, ScanHead, Status, Telegram,
    Topic, Verdict, ZONES, Zones,
};

/// A payload that can go over a network.
pub trait Packed {
    /// Writes the payload to the beginning of `room`; answers its length, or `None` if there is too little room.
    fn pack(&self, room: &mut [u8]) -> Option<usize>;

    /// Returns the bytes of memory that `payload` fills; `None` if it is shorter than its own counts say or contradicts
    /// itself. What follows behind it is a later revision's.
    fn room(payload: &[u8]) -> Option<usize>;

    /// Widens `limits` until a topic that is made as they say has room for `payload`, which has a [`room`](Self::room).
    fn widen(limits: &mut TopicLimits, payload: &[u8]) {
        let _ = (limits, payload);
    }

    /// Takes over what `payload` says, every byte of it. `false` if it has no [`room`](Self::room), or there is too little
    /// here: then the value is of no use.
    #[must_use]
    fn unpack(&mut self, payload: &[u8]) -> bool;

    /// As [`unpack`](Self::unpack), into a `place` that is made longer where it is too short.
    #[must_use]
    fn unpack_into(place: &mut Box<Self>, payload: &[u8]) -> bool;
}

impl<'a> Datagram<'a> {
    /// Returns the telegram that the payload of topic `telegram` is, if it is one of the sensor's family.
    pub fn telegram(&self) -> Option<Telegram<'a>> {
        Telegram::of(self.head.family, self.payload)
    }

    /// Checks what stands after the header: its topic is known, and the payload is one of that topic.
    ///
    /// # Errors
    ///
    /// [`DatagramError::Skipped`] if the topic is not known here, [`DatagramError::Payload`] if the payload is not one of
    /// it.
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
    ($($topic:ident $payload:tt, $name:literal, $($column:tt),*: $about:literal;)*) => {
        /// Returns whether the payload is one of `topic`.
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

/// `len`, if there are so many bytes.
fn fits(payload: &[u8], len: usize) -> Option<usize> {
    (len <= payload.len()).then_some(len)
}

/// Takes the beginning of `payload` for the beginning of `value` and 0 for the rest.
fn take<T: Pod + Packed>(value: &mut T, payload: &[u8]) -> bool {
    let Some(len) = T::room(payload) else { return false };
    *value = T::zeroed();
    bytes_of_mut(value)[..len].copy_from_slice(&payload[..len]);
    true
}

/// Writes `parts` one behind the other; answers their length.
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Foreground, ForegroundHead, Mark, Segment, Zone};

    /// `value`, which is packed into `len` bytes and back into `back`.
    pub(super) fn there_and_back<T: Packed + PartialEq + std::fmt::Debug + ?Sized>(
        value: &T,
        back: &mut T,
        len: usize,
    ) {
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

    /// 64 beams in the foreground of 361, and as many segments.
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
}
