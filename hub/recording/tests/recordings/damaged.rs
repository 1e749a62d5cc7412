//! A recording that is cut, flipped, blanked, shortened, without its beginning or doubled anywhere gives every telegram whose bytes are all
//! there, once, in order and bit for bit, and nothing that was never in it.

use std::collections::BTreeMap;
use std::fs;
use std::ops::Range;
use std::path::PathBuf;

use crate::written::{SENSORS, Written};
use fastrand::Rng;
use lms::variant::{Mode, Unit};
use recording::{Encoding, Frame, Recording};
use schema::Flags;
use schema::file::ENCODING;

const MM: Encoding = Encoding { unit: Unit::Mm, mode: Mode(1) };

/// What became of a file: for each byte of the new one, where it was in the old one.
struct Mutation {
    name: String,
    bytes: Vec<u8>,
    /// `None`: it is another byte now.
    origin: Vec<Option<usize>>,
    /// Where what is there twice begins.
    doubled: Option<usize>,
}

impl Mutation {
    fn of(bytes: &[u8], random: &mut Rng) -> Mutation {
        let len = bytes.len();
        let mut mutated = Mutation {
            name: String::new(),
            bytes: bytes.to_vec(),
            origin: (0..len).map(Some).collect(),
            doubled: None,
        };
        let from = random.usize(..len);
        let some = from..(from + random.usize(1..20_000)).min(len);
        match random.u8(..7) {
            0 => {
                mutated.name = format!("cut at {from}");
                mutated.bytes.truncate(from);
                mutated.origin.truncate(from);
            }
            1 => {
                let places: Vec<_> = (0..random.usize(1..=16)).map(|_| random.usize(..len)).collect();
                mutated.name = format!("flips at {places:?}");
                for place in places {
                    mutated.bytes[place] ^= 1 << random.u8(..8);
                    mutated.origin[place] = None;
                }
            }
            2 => {
                let pages = from / 4096 * 4096..(from / 4096 * 4096 + 4096 * random.usize(1..4)).min(len);
                mutated.name = format!("zeroes in {pages:?}");
                for place in pages {
                    mutated.origin[place] = mutated.origin[place].filter(|_| mutated.bytes[place] == 0);
                    mutated.bytes[place] = 0;
                }
            }
            3 => {
                mutated.name = format!("without {some:?}");
                mutated.bytes.drain(some.clone());
                mutated.origin.drain(some);
            }
            4 => {
                let kept = from / 2..(from / 2 + random.usize(1..100_000)).min(len);
                mutated.name = format!("nothing but {kept:?}");
                mutated.bytes = bytes[kept.clone()].to_vec();
                mutated.origin = kept.map(Some).collect();
            }
            5 => {
                mutated.name = format!("without the first {from}");
                mutated.bytes.drain(..from);
                mutated.origin.drain(..from);
            }
            _ => {
                mutated.name = format!("{some:?} twice");
                mutated.doubled = Some(some.start);
                let (again, of_it) = (bytes[some.clone()].to_vec(), mutated.origin[some.clone()].to_vec());
                mutated.bytes.splice(some.end..some.end, again);
                mutated.origin.splice(some.end..some.end, of_it);
            }
        }
        mutated
    }

    /// Where each of the `len` bytes of the old file is in the new one: it may be there twice.
    fn places(&self, len: usize) -> Vec<[Option<usize>; 2]> {
        let mut places = vec![[None; 2]; len];
        for (at, old) in self.origin.iter().enumerate() {
            if let Some(old) = old {
                let [first, second] = &mut places[*old];
                *(if first.is_none() { first } else { second }) = Some(at);
            }
        }
        places
    }

    /// Whether the old bytes from `begin` to `end` are at one of `places`, side by side.
    fn has(&self, places: [Option<usize>; 2], begin: usize, end: usize) -> bool {
        let is_there =
            |at: usize| (begin..end).enumerate().all(|(i, old)| self.origin.get(at + i) == Some(&Some(old)));
        places.into_iter().flatten().any(is_there)
    }
}

/// Where each telegram of `written` begins in its bytes.
fn positions(written: &Written) -> Vec<usize> {
    let mut from = 0;
    let mut positions = Vec::new();
    for known in &written.telegrams {
        let message: Vec<u8> = [schema_bytes(known), known.telegram.clone()].concat();
        let found = written.bytes[from..].windows(message.len()).position(|bytes| bytes == message);
        from += found.expect("a telegram that is in the file") + HEADER;
        positions.push(from);
    }
    positions
}

fn schema_bytes(known: &crate::written::Known) -> Vec<u8> {
    // As the writer has it: numbers, stamps, and the rest.
    let header = known.header;
    let mut bytes = Vec::new();
    for word in [
        header.seq,
        header.topic_seq,
        header.stamp_first_ns,
        header.stamp_last_ns,
        header.wall_ns,
        header.boot,
    ] {
        bytes.extend(word.to_le_bytes());
    }
    bytes.extend([header.sensor, header.quality, header.flags, header.family]);
    bytes.extend(header.period_us.to_le_bytes());
    bytes.extend(header.hub_pid.to_le_bytes());
    bytes.push(header.reasons);
    bytes.extend(header.hub_time);
    bytes
}

/// All telegrams that a recording gives, by sensor; none if it is no recording any more.
fn read(path: &PathBuf) -> Option<(Recording, BTreeMap<String, Vec<Frame>>)> {
    let recording = Recording::open(path).ok()?;
    let of = |sensor: &String| {
        let part = recording.of(sensor).unwrap();
        let frames: Vec<_> = part.telegrams(MM).unwrap().collect();
        assert_eq!(frames.len() as u64, part.contents().telegrams);
        (sensor.clone(), frames)
    };
    let by_sensor = recording.contents().sensors.iter().map(of).collect();
    Some((recording, by_sensor))
}

/// Where it is said which channel has the telegrams of `sensor`: at its first one, and in the index.
fn channels(written: &Written, sensor: &str) -> Vec<Range<usize>> {
    let name = format!("{sensor}/telegram");
    let named = |&at: &usize| written.bytes[at..].starts_with(name.as_bytes());
    let end = name.len() + 4 + ENCODING.len() + 4;
    (0..written.bytes.len()).filter(named).map(|at| at - CHANNEL..at + end).collect()
}

#[test]
fn every_intact_telegram_is_found() {
    let written = crate::written::recording(100, 7);
    let positions = positions(&written);
    let channels = SENSORS.map(|sensor| (sensor, channels(&written, sensor)));
    let summary = mcap::Summary::read(&written.bytes).unwrap().unwrap();
    let chunk = |index: &mcap::records::ChunkIndex| {
        let begin = index.chunk_start_offset as usize;
        begin..begin + index.chunk_length as usize
    };
    let chunks: Vec<_> = summary.chunk_indexes.iter().map(chunk).collect();
    let path = std::env::temp_dir().join(format!("scanhub-damaged-{}", std::process::id()));
    let (mut intact, mut estimated, mut unreadable, mut bare) = (0, 0, 0, 0);
    for seed in 0..MUTATIONS {
        let mutation = Mutation::of(&written.bytes, &mut Rng::with_seed(seed));
        let name = format!("seed {seed}, {}", mutation.name);
        fs::write(&path, &mutation.bytes).unwrap();
        let places = mutation.places(written.bytes.len());
        let is_there = |at: usize, len: usize| mutation.has(places[at], at, at + len);
        let mut known = written.telegrams.iter().zip(&positions);
        let is_any_left = known.any(|(known, &at)| is_there(at, known.telegram.len()));
        let Some((recording, by_sensor)) = read(&path) else {
            assert!(!is_any_left, "{name}: no recording any more");
            unreadable += 1;
            continue;
        };
        if recording.contents().form != recording::Form::Mcap {
            // Nothing but telegrams without what was before them: they are a stream.
            let is_whole = |at: usize, len: usize| at >= BEFORE && is_there(at - BEFORE, BEFORE + len);
            let mut known = written.telegrams.iter().zip(&positions);
            assert!(!known.any(|(known, &at)| is_whole(at, known.telegram.len())), "{name}");
            bare += 1;
            continue;
        }
        let is_any_there = |parts: &[Range<usize>]| parts.iter().any(|part| is_there(part.start, part.len()));
        // Other channels of the sensor have its name, and only a chunk that is whole says that they have its number.
        let is_chunk_there = is_any_there(&chunks);
        let told = channels.each_ref().map(|(sensor, its)| (*sensor, is_chunk_there || is_any_there(its)));
        let is_told = |sensor: &str| told.contains(&(sensor, true));
        let mut left = by_sensor;
        for (known, at) in written.telegrams.iter().zip(&positions) {
            // Cut from all but three bytes of its header, a second one cannot be told from another that is alike.
            if mutation.doubled.is_some_and(|begin| (at - 3..=*at).contains(&begin)) {
                let is_guess = |frame: &Frame| frame.header.unwrap().flags & Flags::STAMP_ESTIMATED != 0;
                left.values_mut().for_each(|frames| {
                    frames.retain(|frame| frame.telegram != known.telegram || !is_guess(frame));
                });
            }
        }
        for (known, &at) in written.telegrams.iter().zip(&positions) {
            if !is_there(at, known.telegram.len()) {
                continue;
            }
            intact += 1;
            let message = at - BEFORE;
            let is_message_whole = mutation.has(places[message], message, at + known.telegram.len());
            // In the order of the file: what stands before it in its list was there before.
            let is_named = recording.contents().sensors.iter().any(|sensor| sensor == known.sensor)
                && is_told(known.sensor);
            let number = format!("sensor{}", known.header.sensor);
            let called = if is_named { known.sensor } else { &number };
            let (own, others): (Vec<_>, Vec<_>) = left.iter_mut().partition(|(sensor, _)| *sensor == called);
            let taken = own.into_iter().chain(others).find_map(|(sensor, frames)| {
                let place = frames.iter().position(|frame| frame.telegram == known.telegram)?;
                (place == 0 || sensor == called).then(|| (sensor.clone(), place, frames.remove(place)))
            });
            let Some((sensor, place, frame)) = taken else {
                panic!("{name}: the telegram at {at} is missing")
            };
            assert_eq!(place, 0, "{name}: the telegram at {at} is not in order");
            if is_message_whole {
                assert_eq!((&sensor[..], frame.header), (called, Some(known.header)), "{name}, {at}");
            } else {
                estimated += u64::from(frame.header.unwrap().flags & Flags::STAMP_ESTIMATED != 0);
            }
        }
        for (sensor, frames) in left {
            assert_eq!(frames, [], "{name}: {sensor} has what it should not");
        }
    }
    let _ = fs::remove_file(&path);
    println!(
        "{intact} intact telegrams, {estimated} of them with a harmed header; {unreadable} no recording, {bare} a stream"
    );
    assert!(intact > MUTATIONS * 70 && unreadable < MUTATIONS / 20);
}

const MUTATIONS: u64 = 1_000;
/// Opcode, length, numbers of channel and schema, and length of the name.
const CHANNEL: usize = 1 + 8 + 2 + 2 + 4;
/// Opcode, length, channel, sequence and times.
const MESSAGE: usize = 1 + 8 + 2 + 4 + 8 + 8;
const HEADER: usize = 64;
const BEFORE: usize = MESSAGE + HEADER;
