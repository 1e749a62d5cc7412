//! The payloads as they are sent over a network: the fields of shared memory in their order, without unused parts. A
//! received payload is checked against its own counts before it is used.

use bytemuck::{Pod, bytes_of, bytes_of_mut, cast_slice, cast_slice_mut};

use super::{Announce, Datagram, DatagramError};
use crate::{
    BEAMS, Background, CONTENTS_UPPER, Foreground, MARKS, Marks, SEGMENTS, Scan, Segment, Status, Telegram,
    Topic, ZONES, Zones,
};

/// A payload that can go over a network.
pub trait Packed {
    /// Writes the payload to the beginning of `room`; answers its length, or `None` if there is too little room.
    fn pack(&self, room: &mut [u8]) -> Option<usize>;

    /// Takes over what `payload` says, every byte of it; what follows behind it is a later revision's. `false` if it is
    /// shorter than its own counts say or contradicts itself: then the value is of no use.
    #[must_use]
    fn unpack(&mut self, payload: &[u8]) -> bool;
}

/// Returns the telegram that a payload begins with: STX, two bytes with the length of what lies between them and the CRC.
pub fn telegram(payload: &[u8]) -> Option<Telegram<'_>> {
    let [STX, _, low, high, ..] = payload else { return None };
    let len = usize::from(u16::from_le_bytes([*low, *high])) + AROUND_DATA;
    payload.get(..len).filter(|bytes| bytes.len() <= Telegram::MAX).map(Telegram)
}

impl Datagram<'_> {
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
            Some(topic) => is_sound(topic, self.payload),
        };
        if is_sound && self.head.revision > 0 { Ok(()) } else { Err(DatagramError::Payload) }
    }
}

macro_rules! check {
    ($($topic:ident $payload:tt, $name:literal, $($column:tt),*: $about:literal;)*) => {
        /// Returns whether the payload is one of `topic`.
        fn is_sound(topic: Topic, payload: &[u8]) -> bool {
            match topic { $(Topic::$topic => read!($payload, payload),)* }
        }
    };
}

macro_rules! read {
    ([u8], $bytes:ident) => {
        telegram($bytes).is_some()
    };
    ($payload:tt, $bytes:ident) => {
        crate::$payload::default().unpack($bytes)
    };
}

crate::for_each_topic!(check);

impl Packed for Scan {
    /// Without the upper bits where all of them are 0: they were sent, and say nothing.
    fn pack(&self, room: &mut [u8]) -> Option<usize> {
        let (head, ranges) = (&bytes_of(self)[..SCAN_HEAD], cast_slice::<u16, u8>(self.ranges()));
        let says_nothing = self.intensity_bits == 0 && self.upper().iter().all(|&upper| upper == 0);
        let upper = if says_nothing { &[] } else { self.upper() };
        let len = write(room, &[head, ranges, upper])?;
        room[SCAN_CONTENTS] = if upper.is_empty() { 0 } else { CONTENTS_UPPER };
        Some(len)
    }

    fn unpack(&mut self, payload: &[u8]) -> bool {
        *self = Scan::default();
        let Some((head, rest)) = payload.split_at_checked(SCAN_HEAD) else { return false };
        bytes_of_mut(self)[..SCAN_HEAD].copy_from_slice(head);
        let count = usize::from(self.count);
        let has_upper = self.contents & CONTENTS_UPPER != 0;
        if count > BEAMS || rest.len() < 2 * count + usize::from(has_upper) * count || self.range_bits > 16 {
            return false;
        }
        let (ranges, upper) = rest.split_at(2 * count);
        cast_slice_mut(&mut self.range_array[..count]).copy_from_slice(ranges);
        if has_upper {
            self.upper_array[..count].copy_from_slice(&upper[..count]);
        }
        self.contents = CONTENTS_UPPER;
        true
    }
}

impl Packed for Marks {
    fn pack(&self, room: &mut [u8]) -> Option<usize> {
        write(room, &[&bytes_of(self)[..MARKS_HEAD + 16 * self.marks().len()]])
    }

    fn unpack(&mut self, payload: &[u8]) -> bool {
        let used = payload.first().map(|&count| (usize::from(count), MARKS, MARKS_HEAD, 16));
        take(self, payload, used)
    }
}

impl Packed for Zones {
    fn pack(&self, room: &mut [u8]) -> Option<usize> {
        write(room, &[&bytes_of(self)[..ZONES_HEAD + 8 * self.zones().len()]])
    }

    fn unpack(&mut self, payload: &[u8]) -> bool {
        let used = payload.get(1).map(|&count| (usize::from(count), ZONES, ZONES_HEAD, 8));
        take(self, payload, used)
    }
}

impl Packed for Background {
    fn pack(&self, room: &mut [u8]) -> Option<usize> {
        write(room, &[self.packed()])
    }

    fn unpack(&mut self, payload: &[u8]) -> bool {
        let count = payload.get(6..8).map(|count| usize::from(u16::from_le_bytes([count[0], count[1]])));
        take(self, payload, count.map(|count| (count, BEAMS, Background::HEAD, 2)))
    }
}

impl Packed for Status {
    fn pack(&self, room: &mut [u8]) -> Option<usize> {
        write(room, &[bytes_of(self)])
    }

    fn unpack(&mut self, payload: &[u8]) -> bool {
        take(self, payload, Some((1, 1, size_of::<Status>(), 0)))
    }
}

impl Packed for Foreground {
    /// With as many segments as there is room for; the others are left out and counted.
    fn pack(&self, room: &mut [u8]) -> Option<usize> {
        let count = usize::from(self.count).min(BEAMS);
        let fixed = [
            &bytes_of(self)[..FOREGROUND_HEAD],
            &self.bit_array[..count.div_ceil(8)],
            cast_slice::<u16, u8>(self.ranges()),
        ];
        let used = write(room, &fixed)?;
        let fit = self.segments().len().min((room.len() - used) / size_of::<Segment>());
        let left_out = usize::from(self.left_out) + self.segments().len() - fit;
        room[FOREGROUND_LEFT_OUT] = left_out.min(usize::from(u8::MAX)) as u8;
        room[FOREGROUND_SEGMENTS..FOREGROUND_HEAD].copy_from_slice(&(fit as u16).to_le_bytes());
        Some(used + write(&mut room[used..], &[cast_slice(&self.segments()[..fit])])?)
    }

    fn unpack(&mut self, payload: &[u8]) -> bool {
        *self = Foreground::default();
        let Some((head, rest)) = payload.split_at_checked(FOREGROUND_HEAD) else { return false };
        bytes_of_mut(self)[..FOREGROUND_HEAD].copy_from_slice(head);
        let (count, beams) = (usize::from(self.count), usize::from(self.beams));
        let segments = usize::from(self.segments);
        if count > BEAMS || beams > count || segments > SEGMENTS {
            return false;
        }
        let set = count.div_ceil(8);
        if rest.len() < set + 2 * beams + size_of::<Segment>() * segments {
            return false;
        }
        let (bits, rest) = rest.split_at(set);
        let (ranges, rest) = rest.split_at(2 * beams);
        self.bit_array[..set].copy_from_slice(bits);
        cast_slice_mut(&mut self.range_array[..beams]).copy_from_slice(ranges);
        let segment_bytes = &rest[..size_of::<Segment>() * segments];
        cast_slice_mut(&mut self.segment_array[..segments]).copy_from_slice(segment_bytes);
        let members = (0..BEAMS).filter(|&i| self.contains(i));
        let inside =
            self.segments().iter().all(|segment| segment.first <= segment.last && segment.last < self.count);
        inside && members.clone().all(|i| i < count) && members.count() == beams
    }
}

/// Takes the beginning of `payload` for the beginning of `value` and 0 for the rest. `used`: items, the most there may
/// be, bytes before them and of each.
fn take<T: Pod>(value: &mut T, payload: &[u8], used: Option<(usize, usize, usize, usize)>) -> bool {
    *value = T::zeroed();
    let Some((items, most, head, each)) = used else { return false };
    match payload.get(..head + items * each) {
        Some(bytes) if items <= most => {
            bytes_of_mut(value)[..bytes.len()].copy_from_slice(bytes);
            true
        }
        _ => false,
    }
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

const STX: u8 = 0x02;
/// STX, address, length and CRC (Telegram listing 4).
const AROUND_DATA: usize = 6;
const SCAN_HEAD: usize = 12;
const SCAN_CONTENTS: usize = 11;
const MARKS_HEAD: usize = 4;
const ZONES_HEAD: usize = 12;
const FOREGROUND_HEAD: usize = 12;
const FOREGROUND_LEFT_OUT: usize = 9;
const FOREGROUND_SEGMENTS: usize = 10;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Mark, Zone};

    fn there_and_back<T: Packed + Pod + PartialEq + std::fmt::Debug>(value: T, len: usize) {
        let mut room = [0xAA; 2000];
        assert_eq!(value.pack(&mut room), Some(len));
        let mut back = T::zeroed();
        assert!(back.unpack(&room[..len + 7]), "what follows is a later revision's");
        assert_eq!(back, value);
        for short in 0..len {
            assert!(!back.unpack(&room[..short]), "{short} of {len} bytes");
            assert_eq!(value.pack(&mut [0; 2000][..short]), None, "room for {short} of {len} bytes");
        }
    }

    #[test]
    fn payloads_go_there_and_back() {
        let mut scan = Scan { count: 361, unit_mm: 1, range_bits: 13, contents: 1, ..Scan::default() };
        scan.range_array[360] = 0x1234;
        there_and_back(scan, 12 + 722);
        (scan.intensity_bits, scan.upper_array[360]) = (3, 7);
        there_and_back(scan, 12 + 3 * 361);
        let mut marks = Marks { count: 2, flags: 1, ..Marks::default() };
        marks.mark_array[1] = Mark { angle_mdeg: -1, ..Mark::default() };
        there_and_back(marks, 4 + 32);
        let mut zones = Zones { count: 2, ..Zones::unknown() };
        zones.zone_array[1] = Zone { radius_mm: 600, ..Zone::default() };
        there_and_back(zones, 12 + 16);
        let mut model = Background { count: 3, ..Background::default() };
        model.range_array[2] = 7;
        there_and_back(model, 12 + 6);
        there_and_back(Status { baud: 500_000, ..Status::default() }, 592);
    }

    #[test]
    fn a_foreground_leaves_out_the_segments_without_room() {
        let mut foreground =
            Foreground { count: 361, beams: 64, segments: 64, left_out: 3, ..Foreground::default() };
        for i in 0..64 {
            foreground.bit_array[i / 2] |= if i % 2 == 0 { 1 } else { 16 };
            foreground.range_array[i] = i as u16;
            let beam = 4 * i as u16;
            foreground.segment_array[i] = Segment { first: beam, last: beam, ..Segment::default() };
        }
        let mut room = [0; 12 + 46 + 128 + 16 * 10 + 15];
        assert_eq!(foreground.pack(&mut room), Some(12 + 46 + 128 + 160));
        let mut back = Foreground::default();
        assert!(back.unpack(&room));
        assert_eq!((back.segments, back.left_out), (10, 57));
        assert_eq!(back.segments(), &foreground.segments()[..10]);
        assert!(back.readings().eq(foreground.readings()));
        there_and_back(Foreground { segments: 0, ..back }.cut(), 12 + 46 + 128);
    }

    impl Foreground {
        fn cut(mut self) -> Self {
            self.segment_array.fill(Segment::default());
            self
        }
    }

    #[test]
    fn what_contradicts_itself_is_refused() {
        let refused = |payload: &[u8]| !Foreground::default().unpack(payload);
        let mut good = [0; 12 + 1 + 2];
        (good[4], good[6], good[12]) = (3, 1, 4);
        assert!(Foreground::default().unpack(&good));
        for (at, byte) in [(12, 8), (12, 3), (12, 0), (6, 4), (5, 2), (11, 1)] {
            let mut bad = good;
            bad[at] = byte;
            assert!(refused(&bad), "{byte} at {at}");
        }
        assert!(!Marks::default().unpack(&[65; 2000]) && !Zones::default().unpack(&[9; 2000]));
        assert!(!Scan::default().unpack(&[0xFF; 2000]) && !Background::default().unpack(&[0xFF; 2000]));
    }
}
