//! Tests of damaged MCAP files. If a file was truncated or changed anywhere, its intact chunks are read. Reading never
//! returns data that was not in the original file.

use std::io::Write as _;
use std::ops::Range;

use fastrand::Rng;
use scanhub_drivers::lms::variant::{Mode, Unit};
use scanhub_recording::{Damage, Encoding, Recording};
use scanhub_schema::file::Compression;

use tempfile::TempDir;

use crate::folder::file;
use crate::written::{self, SENSOR_NAMES, WrittenRecording, WrittenTelegram};

/// Recording, with the positions of its records.
struct IntactRecording {
    bytes: Vec<u8>,
    telegrams: Vec<WrittenTelegram>,
    /// Position of each chunk, which has [`MESSAGES_PER_CHUNK`] telegrams.
    chunks: Vec<Range<usize>>,
    /// End of the magic bytes, and ends of all records outside chunks.
    ends: Vec<usize>,
}

impl IntactRecording {
    fn new(rounds: u64, compression: Compression) -> IntactRecording {
        let WrittenRecording { bytes, telegrams } = written::recording_with(rounds, 7, compression);
        let (mut chunks, mut ends) = (Vec::new(), vec![MAGIC_LEN]);
        while let Some(&at) = ends.last().filter(|at| **at < bytes.len() - MAGIC_LEN) {
            let end =
                at + RECORD_HEAD_LEN + u64::from_le_bytes(*bytes[at + 1..].first_chunk().unwrap()) as usize;
            if bytes[at] == mcap::records::op::CHUNK {
                chunks.push(at..end);
            }
            ends.push(end);
        }
        assert_eq!(chunks.len() * MESSAGES_PER_CHUNK, telegrams.len());
        IntactRecording { bytes, telegrams, chunks, ends }
    }

    /// Returns the telegrams of the chunks that `is_kept` accepts, one sensor after the other.
    fn telegrams(&self, is_kept: impl Fn(usize) -> bool) -> Vec<WrittenTelegram> {
        let chunks = self.telegrams.chunks(MESSAGES_PER_CHUNK).enumerate();
        let left: Vec<_> =
            chunks.filter(|(number, _)| is_kept(*number)).flat_map(|(_, known)| known).collect();
        let of =
            |sensor| left.iter().filter(move |known| known.sensor == sensor).map(|known| (*known).clone());
        SENSOR_NAMES.into_iter().flat_map(of).collect()
    }

    /// Returns the positions in chunk `number` at which the checksum detects a change: the checksum itself, and the
    /// records.
    fn content(&self, number: usize) -> Vec<usize> {
        let chunk = self.chunks[number].clone();
        let compression = chunk.start + RECORD_HEAD_LEN + 8 + 8 + 8 + 4;
        let records = compression + 4 + usize::from(self.bytes[compression]) + 8;
        let step = (chunk.end - records) / 7;
        [compression - 3].into_iter().chain((records..chunk.end).step_by(step).take(7)).collect()
    }
}

/// Reads the file `bytes`. Returns its telegrams, one sensor after the other, and the reported damage.
fn read(folder: &TempDir, bytes: &[u8]) -> (Vec<WrittenTelegram>, Damage) {
    let recording = Recording::open(file(folder, "damaged.mcap", bytes)).unwrap();
    let contents = recording.contents();
    let of = |sensor: &'static str| {
        let frames = contents.sensors.iter().any(|name| name == sensor).then(|| {
            recording.of(sensor).unwrap().telegrams(Encoding { unit: Unit::Mm, mode: Mode(1) }).unwrap()
        });
        frames.into_iter().flatten().map(move |frame| WrittenTelegram {
            sensor,
            header: frame.header.unwrap(),
            telegram: frame.telegram,
        })
    };
    let known: Vec<_> = SENSOR_NAMES.into_iter().flat_map(of).collect();
    let is_nameless = contents.sensors.iter().any(|name| !SENSOR_NAMES.contains(&&name[..]));
    assert!(is_nameless || known.len() as u64 == contents.telegrams, "{contents:?}");
    (known, contents.damage)
}

#[test]
fn truncated_file_is_read_to_last_complete_chunk() {
    let folder = TempDir::new().unwrap();
    for compression in [Compression::None, Compression::Zstd] {
        let whole = IntactRecording::new(12, compression);
        let len = whole.bytes.len();
        let is_near_end = |at: usize| whole.ends.iter().any(|end| end.abs_diff(at) <= 2);
        for cut in (MAGIC_LEN..len).filter(|at| at % 499 == 0 || is_near_end(*at)) {
            let (telegrams, damage) = read(&folder, &whole.bytes[..cut]);
            let expected = whole.telegrams(|number| whole.chunks[number].end <= cut);
            assert!(telegrams == expected, "{compression:?}, cut at {cut}: {} telegrams", telegrams.len());
            let used = whole.ends.iter().rfind(|end| **end <= cut).unwrap();
            let bytes = (cut - used) as u64;
            assert_eq!(damage, Damage { bytes, is_truncated: true, ..Damage::default() }, "cut at {cut}");
        }
        assert_eq!(read(&folder, &whole.bytes), (whole.telegrams(|_| true), Damage::default()));
    }
}

#[test]
fn flipped_byte_costs_one_chunk() {
    let folder = TempDir::new().unwrap();
    for compression in [Compression::None, Compression::Lz4, Compression::Zstd] {
        let whole = IntactRecording::new(20, compression);
        for (number, chunk) in whole.chunks.iter().enumerate() {
            for at in whole.content(number) {
                let mut bytes = whole.bytes.clone();
                bytes[at] = !bytes[at];
                let name = format!("{compression:?}, byte {at} of chunk {number}");
                let (telegrams, damage) = read(&folder, &bytes);
                assert!(telegrams == whole.telegrams(|other| other != number), "{name}: {damage}");
                // Sequence numbers show missing telegrams only between other telegrams.
                let is_inside = (1..whole.chunks.len() - 1).contains(&number);
                let expected = Damage {
                    telegrams: if is_inside { MESSAGES_PER_CHUNK as u64 } else { 0 },
                    bytes: chunk.len() as u64,
                    chunks: 1,
                    is_damaged: true,
                    ..Damage::default()
                };
                assert_eq!(damage, expected, "{name}");
            }
        }
    }
}

#[test]
fn chunk_with_another_opcode_costs_one_chunk() {
    let folder = TempDir::new().unwrap();
    let whole = IntactRecording::new(20, Compression::Zstd);
    // The opcode of a footer, and an opcode that the format reserves.
    for opcode in [0x02, 0x16] {
        for (number, chunk) in whole.chunks.iter().enumerate() {
            let mut bytes = whole.bytes.clone();
            bytes[chunk.start] = opcode;
            let (telegrams, damage) = read(&folder, &bytes);
            let name = format!("opcode {opcode} at chunk {number}: {damage}");
            assert!(telegrams == whole.telegrams(|other| other != number), "{name}");
            assert!(damage.bytes == chunk.len() as u64 && damage.is_damaged, "{name}");
        }
    }
}

#[test]
fn resumes_at_next_chunk_after_impossible_length() {
    let folder = TempDir::new().unwrap();
    for compression in [Compression::None, Compression::Zstd] {
        let whole = IntactRecording::new(20, compression);
        let last = 1 + 7;
        for (number, chunk) in whole.chunks.iter().enumerate() {
            let next = whole.chunks.get(number + 1).map_or(whole.bytes.len(), |next| next.start);
            // There are three kinds of damage, at two positions each. The length of the chunk contradicts its fields.
            // The length of the next record leads beyond the end of the file. An opcode is 0, which no record has.
            for (start, at, is_chunk) in [
                (chunk.start, chunk.start + 1, true),
                (chunk.start, chunk.start + last, true),
                (chunk.end, chunk.end + last, false),
                (chunk.end, chunk.end + 3, false),
                (chunk.start, chunk.start, true),
                (chunk.end, chunk.end, false),
            ] {
                let mut bytes = whole.bytes.clone();
                bytes[at] = if at == start { 0 } else { bytes[at] ^ 0x40 };
                let (telegrams, damage) = read(&folder, &bytes);
                let left = |other| !is_chunk || other != number;
                assert!(telegrams == whole.telegrams(left), "{compression:?}, byte {at}: {damage}");
                assert_eq!((damage.bytes, damage.is_damaged), ((next - start) as u64, true), "byte {at}");
            }
        }
    }
}

#[test]
fn flipped_opcode_bit_costs_at_most_one_chunk() {
    let folder = TempDir::new().unwrap();
    let whole = IntactRecording::new(20, Compression::Lz4);
    // The last end is the end of the footer.
    for (index, start) in whole.ends.iter().enumerate().take(whole.ends.len() - 1) {
        for bit in 0..8 {
            let mut bytes = whole.bytes.clone();
            bytes[*start] ^= 1 << bit;
            let (telegrams, damage) = read(&folder, &bytes);
            let name = format!("bit {bit} of record {index}, opcode {}: {damage}", whole.bytes[*start]);
            let hit = whole.chunks.iter().position(|chunk| chunk.start == *start);
            assert!(telegrams == whole.telegrams(|number| Some(number) != hit), "{name}");
            assert!(damage.is_damaged, "{name}");
            assert!(hit.is_none() || damage.bytes > 0, "{name}");
        }
    }
}

#[test]
fn duplicated_chunk_is_read_once() {
    let folder = TempDir::new().unwrap();
    for compression in [Compression::None, Compression::Zstd] {
        let whole = IntactRecording::new(20, compression);
        // Repeat one chunk at another position, and a block of three chunks with all records between them.
        let (first, block) = (whole.chunks[0].clone(), whole.chunks[1].start..whole.chunks[3].end);
        for (copied, at, repeats) in [(first, whole.chunks[2].end, 1), (block, whole.chunks[3].end, 3)] {
            let mut bytes = whole.bytes.clone();
            let again = bytes[copied].to_vec();
            bytes.splice(at..at, again);
            let (telegrams, damage) = read(&folder, &bytes);
            assert!(telegrams == whole.telegrams(|_| true), "{compression:?}: {damage}");
            assert_eq!(damage, Damage { repeats, is_damaged: true, ..Damage::default() });
            let words = if repeats == 1 {
                "1 chunk that the file has twice"
            } else {
                "3 chunks that the file has twice"
            };
            assert_eq!(damage.to_string(), words);
        }
    }
}

#[test]
fn unchunked_telegram_is_checked_by_own_checksum() {
    let folder = TempDir::new().unwrap();
    let whole = IntactRecording::new(8, Compression::None);
    let telegrams = whole.telegrams(|_| true);
    // Write the records of the chunks directly into the file, and set the checksums of the sections to 0.
    let (mut bytes, mut at) = (whole.bytes[..MAGIC_LEN].to_vec(), MAGIC_LEN);
    let mut messages = Vec::new();
    for end in &whole.ends[1..] {
        let record = at..*end;
        at = *end;
        match whole.bytes[record.start] {
            mcap::records::op::CHUNK => {
                let mut from = record.start + RECORD_HEAD_LEN + 8 + 8 + 8 + 4 + 4 + 8;
                while from < record.end {
                    let len = u64::from_le_bytes(*whole.bytes[from + 1..].first_chunk().unwrap()) as usize;
                    let next = from + RECORD_HEAD_LEN + len;
                    if whole.bytes[from] == mcap::records::op::MESSAGE {
                        messages.push(bytes.len()..bytes.len() + next - from);
                    }
                    bytes.extend_from_slice(&whole.bytes[from..next]);
                    from = next;
                }
            }
            mcap::records::op::DATA_END | mcap::records::op::FOOTER => {
                bytes.extend_from_slice(&whole.bytes[record]);
                let len = bytes.len();
                bytes[len - 4..].fill(0);
            }
            _ => bytes.extend_from_slice(&whole.bytes[record]),
        }
    }
    bytes.extend_from_slice(&whole.bytes[at..]);
    assert_eq!(read(&folder, &bytes), (telegrams.clone(), Damage::default()));
    for known in &telegrams {
        let is_in = |range: &&Range<usize>| bytes[(*range).clone()].ends_with(&known.telegram);
        let hits: Vec<_> = messages.iter().filter(is_in).cloned().collect();
        // The same reply is sent repeatedly, and only the headers differ.
        for hit in &hits {
            for at in [hit.end - 1, hit.end - known.telegram.len() / 2, hit.end - known.telegram.len()] {
                let mut changed = bytes.clone();
                changed[at] ^= 0x04;
                let (read, damage) = read(&folder, &changed);
                assert_eq!(read.len() + 1, telegrams.len(), "byte {at}: {damage}");
                assert!(read.iter().all(|read| telegrams.contains(read)), "byte {at}: {damage}");
                assert!(damage.bytes == hit.len() as u64 && damage.is_damaged, "byte {at}: {damage}");
            }
        }
        assert!(!hits.is_empty());
    }
    // After an impossible length, reading continues at the next message of the hub.
    let hit = messages[telegrams.len()].clone();
    bytes[hit.start + 1 + 7] ^= 0x40;
    let (read, damage) = read(&folder, &bytes);
    assert!(read.len() + 1 >= telegrams.len() && damage.is_damaged, "{} telegrams, {damage}", read.len());
}

#[test]
fn refuses_too_large_chunk_but_not_a_wrong_length() {
    let folder = TempDir::new().unwrap();
    // Zeros compress well, so the chunk is short until it is unpacked.
    let mut writer =
        scanhub_schema::file::Writer::begin_compressed(Vec::new(), "", Compression::Zstd, Default::default())
            .unwrap();
    let channel = scanhub_schema::file::ForeignChannel {
        topic: "/map",
        encoding: "raw",
        schema: ("map", "bytes", "text"),
        metadata: &[],
    };
    let map = writer.add_channel(&channel).unwrap();
    for round in 0..9 {
        writer.write_message(map, round, u64::from(round), &vec![0; 1 << 20]).unwrap();
    }
    writer.close_chunk().unwrap();
    let failure = Recording::open(file(&folder, "long.mcap", &writer.finish().unwrap())).unwrap_err();
    assert!(
        failure.message.ends_with("it has a chunk of 9 MB; at most 8 MB are read at a time"),
        "{failure}"
    );
    assert!(failure.hint.contains("mcap filter"), "{failure}");

    let whole = IntactRecording::new(20, Compression::Zstd);
    for (number, chunk) in whole.chunks.iter().enumerate() {
        for at in [2, 3, 5, 7] {
            let mut bytes = whole.bytes.clone();
            bytes[chunk.start + RECORD_HEAD_LEN + 8 + 8 + at] ^= 0x80;
            let (telegrams, damage) = read(&folder, &bytes);
            assert!(telegrams == whole.telegrams(|other| other != number), "{at}: {damage}");
            assert_eq!(damage.chunks, 1, "{at}: {damage}");
        }
    }
}

#[test]
fn sensors_with_lost_names_are_numbered() {
    let folder = TempDir::new().unwrap();
    let whole = IntactRecording::new(20, Compression::Zstd);
    // Only the first chunk and the index name the sensors.
    let mut bytes = whole.bytes[..whole.chunks[3].end].to_vec();
    bytes[whole.content(0)[1]] ^= 0x10;
    let recording = Recording::open(file(&folder, "damaged.mcap", &bytes)).unwrap();
    assert_eq!(recording.contents().sensors, ["sensor0", "sensor1"]);
    assert_eq!(recording.contents().telegrams, 3 * MESSAGES_PER_CHUNK as u64);
    let rear = recording.of("sensor1").unwrap();
    let frames = rear.telegrams(Encoding { unit: Unit::Mm, mode: Mode(1) }).unwrap();
    let expected = whole.telegrams(|number| (1..4).contains(&number));
    let expected = expected.iter().filter(|known| known.sensor == "rear").map(|known| &known.telegram);
    assert!(frames.map(|frame| frame.telegram).eq(expected.cloned()));
}

#[test]
fn damaged_file_yields_only_original_telegrams() {
    let folder = TempDir::new().unwrap();
    for seed in 0..300 {
        let mut random = Rng::with_seed(seed);
        let whole =
            IntactRecording::new(12, if seed % 2 == 0 { Compression::None } else { Compression::Lz4 });
        let len = whole.bytes.len();
        let (mut bytes, from) = (whole.bytes.clone(), random.usize(MAGIC_LEN..len));
        let some = from..(from + random.usize(1..5_000)).min(len);
        let first = match random.u8(..4) {
            0 => {
                let places: Vec<_> =
                    (0..random.usize(1..=16)).map(|_| random.usize(MAGIC_LEN..len)).collect();
                places.iter().for_each(|at| bytes[*at] ^= 1 << random.u8(..8));
                *places.iter().min().unwrap()
            }
            1 => {
                bytes[some].fill(0);
                from
            }
            2 => {
                bytes.drain(some);
                from
            }
            _ => {
                let again = bytes[some.clone()].to_vec();
                bytes.splice(some.end..some.end, again);
                some.end
            }
        };
        let (telegrams, damage) = read(&folder, &bytes);
        let is_same = |one: &WrittenTelegram, other: &WrittenTelegram| {
            one.header == other.header && one.telegram == other.telegram
        };
        for read in &telegrams {
            assert!(whole.telegrams.iter().any(|known| is_same(read, known)), "seed {seed}: {read:?}");
        }
        for known in whole.telegrams(|number| whole.chunks[number].end <= first) {
            assert!(telegrams.contains(&known), "seed {seed}, first change at {first}: {damage}");
        }
    }
}

#[test]
fn file_without_a_beginning_is_refused() {
    let folder = TempDir::new().unwrap();
    let bytes = &IntactRecording::new(20, Compression::None).bytes;
    for begin in [1, MAGIC_LEN, bytes.len() / 3] {
        let failure = Recording::open(file(&folder, "rest.mcap", &bytes[begin..])).unwrap_err();
        assert!(failure.message.ends_with("is the end of an MCAP file, without its beginning"), "{failure}");
        assert_eq!(failure.kind.exit_code(), 66);
    }
    // A part from the middle of a file. It contains messages, or a chunk that cannot be read.
    let packed = IntactRecording::new(20, Compression::Zstd);
    let middle =
        |whole: &IntactRecording| whole.bytes[whole.chunks[1].start + 40..whole.chunks[3].end].to_vec();
    for bytes in
        [middle(&IntactRecording::new(20, Compression::None)), middle(&packed), gzip(&middle(&packed))]
    {
        let failure = Recording::open(file(&folder, "middle.bin", &bytes)).unwrap_err();
        assert!(failure.message.ends_with("is a piece of an MCAP file, without its beginning"), "{failure}");
        assert!(failure.hint.contains("whole file"), "{failure}");
    }
}

fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::default());
    encoder.write_all(bytes).unwrap();
    encoder.finish().unwrap()
}

/// Number of telegrams in a chunk: four of each sensor.
const MESSAGES_PER_CHUNK: usize = 8;
const MAGIC_LEN: usize = mcap::MAGIC.len();
/// Length of the opcode and the length field of a record, in bytes.
const RECORD_HEAD_LEN: usize = 1 + 8;
