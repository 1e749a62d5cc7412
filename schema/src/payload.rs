//! Conversion of payloads between memory and the form in which they are sent over a network. This form has the fields
//! in the same order as in shared memory, without the unused elements of arrays. A received payload is checked against
//! its own counts before it is used.
//!
//! Most payloads are structs of fixed size and implement only [`FixedPayload`]. The others have a head of fixed size
//! and arrays whose length depends on the number of beams. The macro `sliced!` defines them, and they implement
//! [`DatagramPayload`] themselves. Their length is a multiple of eight bytes, so that every array is aligned.

use bytemuck::{Pod, bytes_of, bytes_of_mut, pod_read_unaligned};

use crate::datagram::{Announce, Datagram, DatagramError};
use crate::limits::TopicLimits;
use crate::{Telegram, Topic};

/// A payload that can be sent over a network.
pub trait DatagramPayload {
    /// Writes the payload to the start of `room`. Returns its length, or `None` if there is too little room.
    fn pack(&self, room: &mut [u8]) -> Option<usize>;

    /// Returns the number of bytes of memory that the value in `payload` needs. Returns `None` if `payload` is shorter
    /// than its own counts require or contradicts itself. More bytes at the end of `payload` belong to a later
    /// revision.
    fn room(payload: &[u8]) -> Option<usize>;

    /// Raises `limits` until a topic that is created with these limits has room for `payload`. [`room`](Self::room)
    /// must have returned a length for `payload`.
    fn widen(limits: &mut TopicLimits, payload: &[u8]) {
        let _ = (limits, payload);
    }

    /// Replaces the value by `payload`, for which [`room`](Self::room) returned `room`. Returns `false`, and leaves the
    /// value undefined, if the value has too little memory.
    #[must_use]
    fn fill(&mut self, payload: &[u8], room: usize) -> bool;

    /// Replaces `target` by a value with memory for `room` bytes if `target` has less memory.
    fn make_room(target: &mut Box<Self>, room: usize) {
        let _ = (target, room);
    }

    /// Replaces the value by `payload`. Returns `false`, and leaves the value undefined, if [`room`](Self::room)
    /// returns `None` for `payload` or the value has too little memory.
    #[must_use]
    fn unpack(&mut self, payload: &[u8]) -> bool {
        Self::room(payload).is_some_and(|room| self.fill(payload, room))
    }

    /// Does the same as [`unpack`](Self::unpack), and makes `target` longer if `target` is too short.
    #[must_use]
    fn unpack_into(target: &mut Box<Self>, payload: &[u8]) -> bool {
        Self::room(payload).is_some_and(|room| {
            Self::make_room(target, room);
            target.fill(payload, room)
        })
    }
}

/// A payload whose struct has a fixed size.
pub trait FixedPayload: Pod {
    /// Arrays at the end of the struct. A datagram has only their used elements.
    const ARRAYS: &'static [UsedElements] = &[];
    /// Length in bytes of the first revision. In a payload of the first revision, fields that were added later are read
    /// as 0.
    const FIRST_REVISION_LEN: usize = size_of::<Self>();

    /// Returns whether the values are consistent, and all numbers that must be finite are finite.
    fn is_valid(&self) -> bool {
        true
    }
}

/// Position of an array in a payload, and of the number of its used elements. Offsets and sizes are in bytes.
#[derive(Clone, Copy, Debug)]
pub struct UsedElements {
    /// Offset of the first element.
    pub at: usize,
    /// Size of an element.
    pub element: usize,
    /// Number of elements in the struct.
    pub max: usize,
    /// Offset of the field with the number of used elements. The field has one byte.
    pub count_at: usize,
}

/// Returns the [`UsedElements`] of a field: `used_elements!(Marks, mark_array: [Mark; MAX_MARKS], count)`.
macro_rules! used_elements {
    ($payload:ty, $array:ident: [$element:ty; $max:expr], $count:ident) => {
        $crate::payload::UsedElements {
            at: std::mem::offset_of!($payload, $array),
            element: size_of::<$element>(),
            max: $max,
            count_at: std::mem::offset_of!($payload, $count),
        }
    };
}

pub(crate) use used_elements;

impl<P: FixedPayload> DatagramPayload for P {
    fn pack(&self, room: &mut [u8]) -> Option<usize> {
        let bytes = bytes_of(self);
        let head = P::ARRAYS.first().map_or(bytes.len(), |array| array.at);
        let mut end = write(room, &[&bytes[..head]])?;
        for array in P::ARRAYS {
            let used = usize::from(bytes[array.count_at]).min(array.max);
            end += write(&mut room[end..], &[&bytes[array.at..][..used * array.element]])?;
        }
        Some(end)
    }

    fn room(payload: &[u8]) -> Option<usize> {
        let mut value = P::zeroed();
        unpack_fields::<P>(bytes_of_mut(&mut value), payload).filter(|()| value.is_valid())?;
        Some(size_of::<P>())
    }

    fn fill(&mut self, payload: &[u8], _: usize) -> bool {
        *self = P::zeroed();
        unpack_fields::<P>(bytes_of_mut(self), payload).is_some()
    }
}

/// Copies the fields in `payload` into `memory`. Returns `None` if `payload` is too short, or has more elements than
/// the array in the struct.
fn unpack_fields<P: FixedPayload>(memory: &mut [u8], payload: &[u8]) -> Option<()> {
    let whole = if payload.len() < memory.len() { P::FIRST_REVISION_LEN } else { memory.len() };
    let head = P::ARRAYS.first().map_or(whole, |array| array.at);
    let (head, mut rest) = payload.split_at_checked(head)?;
    memory[..head.len()].copy_from_slice(head);
    for array in P::ARRAYS {
        let used = usize::from(head[array.count_at]);
        let elements = rest.split_off(..used * array.element).filter(|_| used <= array.max)?;
        memory[array.at..][..elements.len()].copy_from_slice(elements);
    }
    Some(())
}

/// Implements [`DatagramPayload`] for a payload of variable length that is sent as it is in memory. The type provides
/// `packed_len`, the length of a valid payload, and `widen`, the limits that a payload needs.
macro_rules! packed_as_is {
    ($payload:ident) => {
        impl $crate::payload::DatagramPayload for $payload {
            fn pack(&self, room: &mut [u8]) -> Option<usize> {
                $crate::payload::write(room, &[self.bytes()])
            }

            fn room(payload: &[u8]) -> Option<usize> {
                $payload::packed_len(payload)
            }

            fn widen(limits: &mut TopicLimits, payload: &[u8]) {
                if let Some(head) = $crate::payload::read_head(payload) {
                    $payload::widen(limits, &head);
                }
            }

            fn fill(&mut self, payload: &[u8], room: usize) -> bool {
                self.copy_from(&payload[..room])
            }

            fn make_room(place: &mut Box<Self>, room: usize) {
                $payload::grow(place, room);
            }
        }
    };
}

pub(crate) use packed_as_is;

impl<'a> Datagram<'a> {
    /// Returns the payload as a telegram of the sensor's family, or `None` if the payload is not a telegram. The topic
    /// must be `telegram`; this is not checked here.
    pub fn telegram(&self) -> Option<Telegram<'a>> {
        Telegram::of(self.head.family, self.payload)
    }

    /// Returns the announcement in the payload, or `None` if the datagram is not a valid announcement.
    pub fn announce(&self) -> Option<Announce> {
        let is_announcement = self.head.topic == Announce::NUMBER && self.is_versioned();
        if is_announcement { Announce::unpack(self.payload) } else { None }
    }

    /// Returns whether the datagram has a whole sample, and the payload has a revision.
    fn is_versioned(&self) -> bool {
        self.head.revision > 0 && self.head.parts == 1
    }

    /// Checks that this version has the topic, and that the payload is valid for this topic. Returns the number of
    /// bytes of memory that the payload needs, as [`DatagramPayload::room`] does. The number is 0 for an announcement.
    ///
    /// # Errors
    ///
    /// Returns [`DatagramError::Skipped`] if this version does not have the topic, and [`DatagramError::Payload`] if
    /// the payload is not valid for this topic.
    pub fn check_payload(&self) -> Result<usize, DatagramError> {
        let room = match Topic::of_number(self.head.topic) {
            None if self.head.topic == Announce::NUMBER => self.announce().map(|_| 0),
            None => return Err(DatagramError::Skipped),
            Some(Topic::Telegram) => self.telegram().map(|telegram| telegram.bytes.len()),
            Some(topic) => room(topic, self.payload),
        };
        room.filter(|_| self.is_versioned()).ok_or(DatagramError::Payload)
    }
}

macro_rules! rooms {
    ($($topic:ident $payload:tt, $name:ident, $($column:tt),*: $about:literal;)*) => {
        /// Returns the number of bytes of memory that the payload of `topic` needs, or `None` if the payload is not
        /// valid.
        fn room(topic: Topic, payload: &[u8]) -> Option<usize> {
            match topic { $(Topic::$topic => <crate::payload_type!($payload)>::room(payload),)* }
        }
    };
}

crate::for_each_topic!(rooms);

impl DatagramPayload for [u8] {
    fn pack(&self, room: &mut [u8]) -> Option<usize> {
        write(room, &[self])
    }

    fn room(payload: &[u8]) -> Option<usize> {
        (1..=Telegram::MAX_LEN).contains(&payload.len()).then_some(payload.len())
    }

    fn widen(limits: &mut TopicLimits, payload: &[u8]) {
        limits.telegram = limits.telegram.max(payload.len());
    }

    fn fill(&mut self, payload: &[u8], room: usize) -> bool {
        self.get_mut(..room).map(|memory| memory.copy_from_slice(&payload[..room])).is_some()
    }

    fn make_room(place: &mut Box<[u8]>, room: usize) {
        if place.len() != room {
            *place = vec![0; room].into();
        }
    }
}

/// Returns the head that `payload` starts with, or `None` if `payload` is too short.
pub(crate) fn read_head<H: Pod>(payload: &[u8]) -> Option<H> {
    payload.get(..size_of::<H>()).map(pod_read_unaligned)
}

/// Returns whether all numbers are finite.
pub(crate) fn are_finite<'a, N: Copy + Into<f64> + 'a>(numbers: impl IntoIterator<Item = &'a N>) -> bool {
    numbers.into_iter().all(|&number| number.into().is_finite())
}

/// Writes `parts` one after the other to the start of `room`. Returns their total length, or `None` if `room` is too
/// short.
pub(crate) fn write(room: &mut [u8], parts: &[&[u8]]) -> Option<usize> {
    let mut end = 0;
    for part in parts {
        room.get_mut(end..end + part.len())?.copy_from_slice(part);
        end += part.len();
    }
    Some(end)
}

/// Defines the type of a payload and the type of the words that the payload consists of. The shared-memory library
/// identifies the payload by the name of the words' type.
macro_rules! sliced {
    ($(#[$about:meta])* $payload:ident, $word:ident, $name:tt, $head:ident) => {
        #[doc = concat!("Eight bytes of a [`", stringify!($payload), "`].")]
        #[derive(Clone, Copy, Debug, Default, PartialEq, Eq, bytemuck::Pod, bytemuck::Zeroable)]
        #[cfg_attr(feature = "ipc", derive(ZeroCopySend), type_name($name))]
        #[repr(C)]
        pub struct $word {
            word: u64,
        }

        $(#[$about])*
        #[derive(bytemuck::TransparentWrapper)]
        #[repr(transparent)]
        pub struct $payload([$word]);

        impl $payload {
            /// Bytes before the arrays.
            pub const HEAD: usize = size_of::<$head>();

            /// Returns a payload filled with 0. It has memory for `len` bytes, and at least for a head.
            pub fn zeroed(len: usize) -> Box<Self> {
                let words = vec![$word::default(); Self::words(len)].into_boxed_slice();
                bytemuck::allocation::TransparentWrapperAlloc::wrap_box(words)
            }

            /// Returns the number of words for `len` bytes, at least the number for a head.
            pub const fn words(len: usize) -> usize {
                let len = if len > Self::HEAD { len } else { Self::HEAD };
                len.div_ceil(size_of::<$word>())
            }

            /// Returns the payload in `words`.
            pub fn of_words(words: &[$word]) -> &Self {
                bytemuck::TransparentWrapper::wrap_ref(words)
            }

            /// Returns the payload in `words`, for writing.
            pub fn of_words_mut(words: &mut [$word]) -> &mut Self {
                bytemuck::TransparentWrapper::wrap_mut(words)
            }

            /// Returns a copy of the used bytes in the memory of this process.
            pub fn boxed(&self) -> Box<Self> {
                Self::of_bytes(self.bytes())
            }

            /// Returns a payload with a copy of `bytes`. The caller got `bytes` from [`bytes`](Self::bytes).
            pub fn of_bytes(bytes: &[u8]) -> Box<Self> {
                let mut copy = Self::zeroed(bytes.len());
                copy.copy_from(bytes);
                copy
            }

            /// Replaces `payload` by a payload of `len` bytes, filled with 0, if `payload` has memory for fewer bytes.
            pub fn grow(payload: &mut Box<Self>, len: usize) {
                if payload.capacity() < len {
                    *payload = Self::zeroed(len);
                }
            }

            /// Returns the number of bytes that the payload has memory for.
            pub fn capacity(&self) -> usize {
                self.memory().len()
            }

            /// Returns the used bytes.
            pub fn bytes(&self) -> &[u8] {
                let memory = self.memory();
                memory.get(..self.used()).unwrap_or(memory)
            }

            /// Writes `bytes` to the start of the payload. Returns `false` if the payload has too little memory.
            pub fn copy_from(&mut self, bytes: &[u8]) -> bool {
                let memory = self.memory_mut().get_mut(..bytes.len());
                memory.map(|memory| memory.copy_from_slice(bytes)).is_some()
            }

            fn memory(&self) -> &[u8] {
                bytemuck::cast_slice(&self.0)
            }

            fn memory_mut(&mut self) -> &mut [u8] {
                bytemuck::cast_slice_mut(&mut self.0)
            }
        }

        impl std::ops::Deref for $payload {
            type Target = $head;

            fn deref(&self) -> &$head {
                const NONE: [$word; size_of::<$head>() / size_of::<$word>()] = [$word { word: 0 }; size_of::<$head>() / size_of::<$word>()];
                // A sample of an unknown publisher may be shorter than a head. The head is then read as zeros, so the
                // sample has no beams.
                let head = self.memory().get(..Self::HEAD);
                bytemuck::from_bytes(head.unwrap_or(bytemuck::cast_slice(&NONE)))
            }
        }

        impl std::ops::DerefMut for $payload {
            fn deref_mut(&mut self) -> &mut $head {
                bytemuck::from_bytes_mut(&mut self.memory_mut()[..Self::HEAD])
            }
        }

        impl Default for Box<$payload> {
            fn default() -> Self {
                $payload::zeroed(0)
            }
        }

        impl Clone for Box<$payload> {
            fn clone(&self) -> Self {
                self.boxed()
            }
        }

        impl PartialEq for $payload {
            fn eq(&self, other: &Self) -> bool {
                self.bytes() == other.bytes()
            }
        }

        impl Eq for $payload {}
    };
}

pub(crate) use sliced;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        ArrayFlags, Background, BackgroundHead, Cloud, CloudHead, CloudPoint, Corner, Early, Event,
        EventKind, Foreground, ForegroundHead, Line, Lines, MAX_BEAMS, Mark, Marks, Motion, Obstacle,
        Obstacles, Pose, Scan, ScanHead, Segment, Status, Tilt, Track, TrackSensor, Tracks, Zone, Zones,
    };

    /// Packs `value` into `len` bytes, and unpacks it into `back`.
    fn check_round_trip<T: DatagramPayload + PartialEq + std::fmt::Debug + ?Sized>(
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
    fn payloads_round_trip() {
        let head =
            ScanHead { unit_um: 1000, valid_to: 8182, contents: ArrayFlags::UPPER, ..ScanHead::default() };
        let mut scan = Scan::of(head, &[0; 361]);
        scan.arrays().ranges[360] = 0x1234;
        let mut room = Scan::zeroed(64 + 3 * 361);
        check_round_trip(&*scan, &mut room, 64 + 3 * 361);
        assert!(!Scan::zeroed(64 + 3 * 360).unpack(scan.bytes()), "there is too little memory");
        let mut marks = Marks { count: 2, flags: 1, ..Marks::default() };
        marks.mark_array[1] = Mark { angle_mdeg: -1, ..Mark::default() };
        check_round_trip(&marks, &mut Marks::default(), 4 + 32);
        let mut zones = Zones { count: 2, ..Zones::unknown() };
        zones.zone_array[1] = Zone { radius_mm: 600, ..Zone::default() };
        check_round_trip(&zones, &mut Zones::default(), 12 + 16);
        let early = Early { verdict: 2, beam: 90, distance_mm: 512, bytes_seen: 240, ..Early::default() };
        check_round_trip(&early, &mut Early::default(), 12);
        let model = Background::of(BackgroundHead::default(), &[0, 0, 7]);
        check_round_trip(&*model, &mut Background::zeroed(38), 32 + 6);
        check_round_trip(&Status { baud: 500_000, ..Status::default() }, &mut Status::default(), 592);
    }

    /// Returns a foreground of 361 beams with 64 foreground beams and as many segments.
    fn foreground() -> Box<Foreground> {
        let mut foreground = Foreground::of(361);
        let head = ForegroundHead {
            count: 361,
            beams: 64,
            segments: 64,
            dropped: 3,
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
    fn foreground_drops_segments_without_room() {
        let foreground = foreground();
        let mut room = [0; 24 + 46 + 128 + 16 * 10 + 15];
        assert_eq!(foreground.pack(&mut room), Some(24 + 46 + 128 + 160));
        let mut back = Foreground::zeroed(Foreground::len(361));
        assert!(back.unpack(&room));
        assert_eq!((back.segments, back.dropped, back.supported), (10, 57, 0x1A3));
        assert_eq!(back.segments(), &foreground.segments()[..10]);
        assert!(back.readings().eq(foreground.readings()));
        let mut whole = [0; 2000];
        let len = foreground.pack(&mut whole).unwrap();
        assert!(back.unpack(&whole[..len]));
        assert_eq!((len, back), (24 + 46 + 128 + 1024, foreground));
    }

    #[test]
    fn contradictory_payloads_are_refused() {
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
    fn lines_payload_round_trips() {
        let mut lines = Lines { count: 2, corners: 1, ..Lines::default() };
        lines.line_array[1] = Line { alpha_rad: -1.0, last: 7, ..Line::default() };
        lines.corner_array[0] = Corner { x_m: 2.0, second_line: 1, ..Corner::default() };
        check_round_trip(&lines, &mut Lines::default(), 12 + 80 + 12);
    }

    #[test]
    fn contradictory_lines_are_refused() {
        let mut lines = [0; 12 + 40 + 12];
        (lines[0], lines[1]) = (1, 1);
        assert!(Lines::room(&lines).is_some());
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
    fn motion_payload_round_trips() {
        let mut motion =
            Motion { x_m: -1.5, dyaw_rad: 0.25, method: 5, refused_steps: 3, ..Motion::default() };
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
    fn tilted_payloads_round_trip() {
        let tilt = Tilt { angle_rad: -0.5, rate_rad_s: 0.25 };
        check_round_trip(&tilt, &mut Tilt::default(), 16);
        assert!(Tilt::default().unpack(bytes_of(&Tilt::default())), "a rate need not be known");
        check_round_trip(&*cloud(), &mut Cloud::zeroed(Cloud::len(3)), 16 + 3 * 16);
        assert!(!Cloud::zeroed(Cloud::len(2)).unpack(cloud().bytes()), "there is too little memory");
        check_round_trip(&obstacles(), &mut Obstacles::default(), 16 + 48);
        check_round_trip(&Obstacles::default(), &mut Obstacles::default(), 16);
    }

    #[test]
    fn tilted_nan_values_and_wrong_counts_are_refused() {
        for bad in [
            Tilt { angle_rad: f64::NAN, rate_rad_s: 0.0 },
            Tilt { angle_rad: 0.0, rate_rad_s: f64::INFINITY },
        ] {
            assert_eq!(Tilt::room(bytes_of(&bad)), None);
        }
        let mut bad = cloud();
        bad.begin(CloudHead { count: 3, ..CloudHead::default() })[2].at[2] = f32::NAN;
        assert_eq!(Cloud::room(bad.bytes()), None);
        let mut many = vec![0; Cloud::len(MAX_BEAMS + 1)];
        many[8..10].copy_from_slice(&(MAX_BEAMS as u16 + 1).to_le_bytes());
        assert_eq!(Cloud::room(&many), None);
        let mut bad = obstacles();
        bad.obstacle_array[0].distance_m = f32::INFINITY;
        assert_eq!(Obstacles::room(bytes_of(&bad)), None);
        let mut many = vec![0; 16 + 65 * size_of::<Obstacle>()];
        many[12] = 65;
        assert_eq!(Obstacles::room(&many), None);
    }

    #[test]
    fn longer_cloud_widens_the_topic_limits() {
        let points = [CloudPoint::default(); 500];
        let mut limits = TopicLimits::default();
        Cloud::widen(&mut limits, Cloud::of(CloudHead::default(), &points).bytes());
        assert_eq!(limits.beams, 500);
        Cloud::widen(&mut limits, cloud().bytes());
        assert_eq!(limits.beams, 500);
    }

    fn two_tracks() -> Tracks {
        let mut tracks = Tracks::default();
        for name in ["front", "kitchen.rear"] {
            tracks.push_sensor(TrackSensor::new(name, &Pose::default()));
        }
        tracks.push(Track { id: 1, x_m: -1.5, sensors: 3, ..Track::default() });
        tracks.push(Track { id: u64::MAX, age_ms: 9, state: 2, ..Track::default() });
        tracks
    }

    #[test]
    fn track_payloads_round_trip() {
        check_round_trip(&two_tracks(), &mut Tracks::default(), 8 + 2 * 80 + 2 * 72);
        check_round_trip(&Tracks::default(), &mut Tracks::default(), 8);
        let event = Event::new(EventKind::Door, 5, Some("hall")).with_door("left", "kitchen", "hall");
        check_round_trip(&event, &mut Event::default(), 112);
    }

    #[test]
    fn contradictory_tracks_are_refused() {
        let mut sound = [0; 8 + 2 * 80 + 2 * 72];
        assert_eq!(two_tracks().pack(&mut sound), Some(sound.len()));
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
