//! Lines as they are sent over a network: their head, the lines and the corners that are used.

use bytemuck::{Zeroable, bytes_of, bytes_of_mut, cast_slice, pod_read_unaligned};

use super::{Packed, write};
use crate::{Corner, LINES, Line, Lines};

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

/// Head, lines and corners of packed lines, if they are there.
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::datagram::payload::tests::there_and_back;

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
}
