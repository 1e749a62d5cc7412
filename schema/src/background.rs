//! The background model of a sensor, and the foreground of a scan. The model has the range at which each beam ends in
//! an empty scene. The foreground has the beams of one scan that end in front of the background, and the segments that
//! these beams form.

use std::fmt;

use bytemuck::{Pod, Zeroable, bytes_of, cast_slice, cast_slice_mut, pod_read_unaligned};
#[cfg(feature = "ipc")]
use iceoryx2::prelude::ZeroCopySend;

use crate::MAX_BEAMS;
use crate::limits::TopicLimits;
use crate::payload::{DatagramPayload, packed_as_is, read_head, sliced, write};
use crate::topic::PayloadLen;

/// Head of a background model, before the ranges. 32 bytes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct BackgroundHead {
    /// Angle of beam 0 in radians, as in a scan.
    pub first_angle: f64,
    /// Angle from one beam to the next in radians; 0 before the first scan.
    pub step: f64,
    /// Generation of the background, counted in this run of the hub.
    pub generation: u32,
    /// Micrometers per device unit.
    pub unit_um: u32,
    /// Number of beams whose background is known.
    pub known_beams: u16,
    /// Number of beams of the model; 0 before the first scan.
    pub count: u16,
    /// Flags: [`Background::FROZEN`].
    pub flags: u8,
    /// 0.
    pub reserved: [u8; 3],
}

sliced! {
    /// The payload of topic `background`: a [`BackgroundHead`], whose fields can be read directly, followed by a range
    /// of two bytes for every beam. The hub publishes the model when a new generation starts, and also with every scan
    /// if configured.
    Background, BackgroundWord, "scanhub.Background.v2", BackgroundHead
}

impl PayloadLen for Background {
    fn max_payload_len(limits: &TopicLimits) -> usize {
        Background::len(limits.beams)
    }
}

packed_as_is!(Background);

impl Background {
    /// Range of a beam whose background is unknown.
    pub const UNKNOWN: u16 = 0;
    /// Range of a beam whose background is beyond the sensor's maximum range.
    pub const FAR: u16 = u16::MAX;
    /// Flag: learning is stopped.
    pub const FROZEN: u8 = 1;

    /// Returns the length in bytes of a model of `beams` beams.
    pub const fn len(beams: usize) -> usize {
        Background::HEAD + 2 * beams
    }

    /// Returns a model with `head`, and a beam for each of `ranges`.
    pub fn of(head: BackgroundHead, ranges: &[u16]) -> Box<Background> {
        let mut model = Background::zeroed(Background::len(ranges.len()));
        model.begin(BackgroundHead { count: ranges.len() as u16, ..head }).copy_from_slice(ranges);
        model
    }

    /// Writes `head` and returns the ranges, which the caller must fill.
    ///
    /// # Panics
    ///
    /// Panics if the memory is too short for the head and the ranges.
    pub fn begin(&mut self, head: BackgroundHead) -> &mut [u16] {
        **self = head;
        cast_slice_mut(&mut self.memory_mut()[Background::HEAD..Background::len(head.count.into())])
    }

    /// Returns the ranges of the beams in device units. A range can be [`Background::UNKNOWN`] or [`Background::FAR`].
    pub fn ranges(&self) -> &[u16] {
        let room = self.memory().len().saturating_sub(Background::HEAD) / 2;
        let beams = usize::from(self.count).min(room);
        self.memory().get(Background::HEAD..Background::len(beams)).map_or(&[], cast_slice)
    }

    /// Returns the ranges for writing.
    pub fn ranges_mut(&mut self) -> &mut [u16] {
        let head = **self;
        self.begin(head)
    }

    /// Returns whether learning is stopped.
    pub fn is_frozen(&self) -> bool {
        self.flags & Background::FROZEN != 0
    }

    /// Returns the model in `bytes`, or `None` if its head is not valid or the length of `bytes` does not match the
    /// number of beams in the head.
    pub fn read(bytes: &[u8]) -> Option<Box<Background>> {
        let mut model = Background::zeroed(bytes.len());
        (model.unpack(bytes) && model.bytes().len() == bytes.len()).then_some(model)
    }

    fn used(&self) -> usize {
        Background::len(self.ranges().len())
    }

    /// Returns the length in bytes of the model in a datagram's payload, or `None` if the model is not valid.
    fn packed_len(payload: &[u8]) -> Option<usize> {
        let head: BackgroundHead = read_head(payload)?;
        let len = Background::len(head.count.into());
        let is_finite = head.first_angle.is_finite() && head.step.is_finite();
        (usize::from(head.count) <= MAX_BEAMS && is_finite && len <= payload.len()).then_some(len)
    }

    fn widen(limits: &mut TopicLimits, head: &BackgroundHead) {
        limits.beams = limits.beams.max(head.count.into());
    }
}

impl fmt::Debug for Background {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Background").field("head", &**self).field("ranges", &self.ranges()).finish()
    }
}

/// Maximum number of segments of a scan.
pub const MAX_SEGMENTS: usize = 64;

/// Head of a foreground, before the arrays. 24 bytes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub struct ForegroundHead {
    /// Generation of the background that the scan was compared with.
    pub generation: u32,
    /// Micrometers per device unit.
    pub unit_um: u32,
    /// Number of beams of the scan.
    pub count: u16,
    /// Number of beams in the foreground.
    pub beams: u16,
    /// Number of segments, at most [`MAX_SEGMENTS`].
    pub segments: u16,
    /// Number of segments that did not fit into the sample.
    pub dropped: u16,
    /// Bit i is set if segment i is supported: it has several beams, or is near the previous scan's foreground.
    pub supported: u64,
}

sliced! {
    /// The payload of topic `foreground`, one sample per scan even if it is empty. The payload starts with a
    /// [`ForegroundHead`], whose fields can be read directly. The arrays follow:
    ///
    /// - [`MAX_SEGMENTS`] segments of 16 bytes,
    /// - a bit for every beam of the scan, padded to an even number of bytes,
    /// - a range of two bytes for every beam of the scan.
    ///
    /// In the arrays of segments and ranges, the used elements come first, and the others are 0.
    Foreground, ForegroundWord, "scanhub.Foreground.v2", ForegroundHead
}

/// Neighboring foreground beams that belong together.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Pod, Zeroable)]
#[cfg_attr(feature = "ipc", derive(ZeroCopySend), type_name("scanhub.Segment.v2"))]
#[repr(C)]
pub struct Segment {
    /// First beam.
    pub first: u16,
    /// Last beam.
    pub last: u16,
    /// Lowest range in device units.
    pub nearest: u16,
    /// Distance from the first to the last point, in device units.
    pub width: u16,
    /// Mean of the points: mm ahead of the robot's center.
    pub x_mm: i32,
    /// Mean of the points: mm to the left of the center.
    pub y_mm: i32,
}

/// Arrays of a foreground, for writing.
#[derive(Debug)]
pub struct ForegroundArrays<'a> {
    /// Room for [`MAX_SEGMENTS`] segments.
    pub segments: &'a mut [Segment],
    /// Beams in the foreground: beam i is bit i % 8 of byte i / 8.
    pub bits: &'a mut [u8],
    /// Ranges of the foreground beams in device units, in the order of the beams. The array has room for all beams of
    /// the scan.
    pub ranges: &'a mut [u16],
}

impl PayloadLen for Foreground {
    fn max_payload_len(limits: &TopicLimits) -> usize {
        Foreground::len(limits.beams)
    }
}

impl Foreground {
    /// Returns the length in bytes of a foreground for `beams` beams.
    pub const fn len(beams: usize) -> usize {
        BITS_OFFSET + bit_set_len(beams) + 2 * beams
    }

    /// Returns an empty foreground of a scan of `beams` beams.
    pub fn of(beams: usize) -> Box<Foreground> {
        let mut foreground = Foreground::zeroed(Foreground::len(beams));
        foreground.count = beams as u16;
        foreground
    }

    /// Writes `head` and returns the arrays, which the caller must fill.
    ///
    /// # Panics
    ///
    /// Panics if the memory is too short for the head and the arrays.
    pub fn begin(&mut self, head: ForegroundHead) -> ForegroundArrays<'_> {
        **self = head;
        let n = usize::from(head.count);
        let (segments, rest) =
            self.memory_mut()[Foreground::HEAD..].split_at_mut(BITS_OFFSET - Foreground::HEAD);
        let (bits, rest) = rest.split_at_mut(bit_set_len(n));
        ForegroundArrays {
            segments: cast_slice_mut(segments),
            bits: &mut bits[..n.div_ceil(8)],
            ranges: cast_slice_mut(&mut rest[..2 * n]),
        }
    }

    /// Returns whether beam `i` is in the foreground.
    pub fn contains(&self, i: usize) -> bool {
        self.bits().get(i / 8).is_some_and(|byte| byte >> (i % 8) & 1 == 1)
    }

    /// Returns index and range of each foreground beam, in the order of the beams. Ranges are in device units.
    pub fn readings(&self) -> impl Iterator<Item = (usize, u16)> + '_ {
        let bytes = self.bits().iter().enumerate().filter(|(_, byte)| **byte != 0);
        let of_byte = |(at, &byte): (usize, &u8)| {
            (0..8).filter(move |bit| byte >> bit & 1 == 1).map(move |bit| 8 * at + bit)
        };
        bytes.flat_map(of_byte).take_while(|&i| i < self.scan_beams()).zip(self.ranges().iter().copied())
    }

    /// Returns the ranges of the foreground beams in device units.
    pub fn ranges(&self) -> &[u16] {
        let (n, begin) =
            (usize::from(self.beams).min(self.scan_beams()), BITS_OFFSET + bit_set_len(self.scan_beams()));
        self.memory().get(begin..begin + 2 * n).map_or(&[], cast_slice)
    }

    /// Returns the used segments.
    pub fn segments(&self) -> &[Segment] {
        let all: &[Segment] = self.memory().get(Foreground::HEAD..BITS_OFFSET).map_or(&[], cast_slice);
        &all[..usize::from(self.segments).min(all.len())]
    }

    /// Returns whether segment `i` is supported. A segment of a single beam is not supported if the previous scan had
    /// no foreground near the beam. Such a segment may come from a flickering edge.
    pub fn has_support(&self, i: usize) -> bool {
        i < self.segments().len() && self.supported >> i & 1 == 1
    }

    /// Returns a bit for every beam of the scan, with the layout of [`ForegroundArrays::bits`].
    fn bits(&self) -> &[u8] {
        self.memory().get(BITS_OFFSET..BITS_OFFSET + self.scan_beams().div_ceil(8)).unwrap_or_default()
    }

    /// Returns the number of beams of the scan, or 0 if the memory is too short for the arrays of all beams.
    fn scan_beams(&self) -> usize {
        let n = usize::from(self.count);
        if Foreground::len(n) <= self.memory().len() { n } else { 0 }
    }

    fn used(&self) -> usize {
        Foreground::len(self.scan_beams())
    }
}

impl DatagramPayload for Foreground {
    /// Writes the head, the bits, the used ranges, and as many segments as fit into `room`. The other segments are
    /// counted as dropped.
    fn pack(&self, room: &mut [u8]) -> Option<usize> {
        let fixed = |head: &ForegroundHead, room: &mut [u8]| {
            write(room, &[bytes_of(head), self.bits(), cast_slice::<u16, u8>(self.ranges())])
        };
        let used = fixed(self, room)?;
        let fit = self.segments().len().min((room.len() - used) / size_of::<Segment>());
        let dropped = usize::from(self.dropped) + self.segments().len() - fit;
        let dropped = dropped.min(usize::from(u16::MAX)) as u16;
        let supported = self.supported & first_bits(fit);
        let used = fixed(&ForegroundHead { segments: fit as u16, dropped, supported, ..**self }, room)?;
        Some(used + write(&mut room[used..], &[cast_slice(&self.segments()[..fit])])?)
    }

    fn room(payload: &[u8]) -> Option<usize> {
        let (head, parts) = PackedArrays::of(payload)?;
        let is_inside = |segment: Segment| segment.first <= segment.last && segment.last < head.count;
        let mut segments = parts.segments.chunks_exact(size_of::<Segment>()).map(pod_read_unaligned);
        let members: u32 = parts.bits.iter().map(|byte| byte.count_ones()).sum();
        let unused = parts.bits.last().map_or(0, |last| match head.count % 8 {
            0 => 0,
            used => last >> used,
        });
        let is_valid = segments.all(is_inside)
            && members == u32::from(head.beams)
            && unused == 0
            && head.supported & !first_bits(head.segments.into()) == 0;
        is_valid.then_some(Foreground::len(head.count.into()))
    }

    fn widen(limits: &mut TopicLimits, payload: &[u8]) {
        if let Some(head) = read_head::<ForegroundHead>(payload) {
            limits.beams = limits.beams.max(head.count.into());
        }
    }

    fn fill(&mut self, payload: &[u8], room: usize) -> bool {
        let Some(memory) = self.memory_mut().get_mut(..room) else { return false };
        memory.fill(0);
        let Some((head, parts)) = PackedArrays::of(payload) else { return false };
        let ForegroundArrays { segments, bits, ranges } = self.begin(head);
        bits.copy_from_slice(parts.bits);
        cast_slice_mut(&mut ranges[..head.beams.into()]).copy_from_slice(parts.ranges);
        cast_slice_mut(&mut segments[..head.segments.into()]).copy_from_slice(parts.segments);
        true
    }

    fn make_room(place: &mut Box<Self>, room: usize) {
        Foreground::grow(place, room);
    }
}

/// Returns a word with a bit for each of the first `segments` segments.
fn first_bits(segments: usize) -> u64 {
    if segments < MAX_SEGMENTS { (1 << segments) - 1 } else { u64::MAX }
}

/// Arrays after the head of a foreground in a datagram, as bytes.
struct PackedArrays<'a> {
    bits: &'a [u8],
    ranges: &'a [u8],
    segments: &'a [u8],
}

impl PackedArrays<'_> {
    /// Returns head and arrays, or `None` if the payload is too short or has too many elements.
    fn of(payload: &[u8]) -> Option<(ForegroundHead, PackedArrays<'_>)> {
        let head: ForegroundHead = read_head(payload)?;
        let [count, beams, used] = [head.count, head.beams, head.segments].map(usize::from);
        if count > MAX_BEAMS || beams > count || used > MAX_SEGMENTS {
            return None;
        }
        let (bits, rest) = payload[Foreground::HEAD..].split_at_checked(count.div_ceil(8))?;
        let (ranges, rest) = rest.split_at_checked(2 * beams)?;
        let segments = rest.get(..used * size_of::<Segment>())?;
        Some((head, PackedArrays { bits, ranges, segments }))
    }
}

impl fmt::Debug for Foreground {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let readings: Vec<_> = self.readings().collect();
        f.debug_struct("Foreground")
            .field("head", &**self)
            .field("readings", &readings)
            .field("segments", &self.segments())
            .finish()
    }
}

/// Offset in bytes from the start of a foreground to its bits.
const BITS_OFFSET: usize = Foreground::HEAD + MAX_SEGMENTS * size_of::<Segment>();

/// Returns the length in bytes of the array with a bit for every beam. The length is even, because the ranges that
/// follow take two bytes each.
const fn bit_set_len(beams: usize) -> usize {
    2 * beams.div_ceil(16)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn background_round_trips_through_bytes() {
        let head =
            BackgroundHead { generation: 3, known_beams: 2, unit_um: 10_000, ..BackgroundHead::default() };
        let model = Background::of(head, &[400, 0, Background::FAR]);
        assert_eq!(model.bytes().len(), 38);
        assert_eq!(Background::read(model.bytes()), Some(model.clone()));
        for bytes in [&model.bytes()[..37], &[model.bytes(), &[0]].concat(), &[], &[0xFF; 816]] {
            assert_eq!(Background::read(bytes), None);
        }
    }

    #[test]
    fn readings_and_support_are_decoded_from_bits() {
        let mut foreground = Foreground::of(401);
        let arrays = foreground.begin(ForegroundHead { count: 401, beams: 2, ..ForegroundHead::default() });
        (arrays.bits[0], arrays.bits[50]) = (0x80, 1);
        arrays.ranges[..2].copy_from_slice(&[700, 800]);
        assert_eq!(foreground.readings().collect::<Vec<_>>(), [(7, 700), (400, 800)]);
        assert!(!foreground.contains(401) && !foreground.contains(10_000));
        foreground.supported = 0b101;
        foreground.segments = 2;
        assert_eq!([0, 1, 2, 64].map(|i| foreground.has_support(i)), [true, false, false, false]);
        foreground.count = 2000;
        assert_eq!(foreground.readings().count(), 0, "there is no memory for so many");
    }
}
