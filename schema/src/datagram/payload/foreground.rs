//! A foreground as it is sent over a network: without the room for beams and segments that are not in it.

use bytemuck::{bytes_of, cast_slice, cast_slice_mut, pod_read_unaligned};

use super::{Packed, write};
use crate::limits::TopicLimits;
use crate::{BEAMS, Foreground, ForegroundArrays, ForegroundHead, SEGMENTS, Segment};

impl Packed for Foreground {
    /// Head, bits, the ranges that are used, and as many segments as there is room for; the others are left out and counted.
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

/// A bit for each of the first `segments` segments.
fn only(segments: usize) -> u64 {
    if segments < SEGMENTS { (1 << segments) - 1 } else { u64::MAX }
}

/// What stands behind the head of a packed foreground.
struct ForegroundParts<'a> {
    bits: &'a [u8],
    ranges: &'a [u8],
    segments: &'a [u8],
}

/// Head and arrays of a packed foreground, if they are there.
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
