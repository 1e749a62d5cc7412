//! Recordings of the hub: each sensor's telegrams come out as they went in, with what the hub knew of them.

use std::fs;
use std::path::PathBuf;

use crate::written::{Known, SENSORS};
use lms::variant::{Mode, Unit, Variant};
use recording::{Encoding, Form, Recording};
use schema::file::Compression;

const MM: Encoding = Encoding { unit: Unit::Mm, mode: Mode(1) };

/// A file of this test run that is gone with it.
struct File(PathBuf);

impl File {
    fn new(name: &str, bytes: &[u8]) -> File {
        let path = std::env::temp_dir().join(format!("scanhub-mcap-{}-{name}", std::process::id()));
        fs::write(&path, bytes).unwrap();
        File(path)
    }
}

impl Drop for File {
    fn drop(&mut self) {
        let _ = fs::remove_file(&self.0);
    }
}

/// The telegrams of `sensor` as `recording` gives them.
fn read(recording: &Recording, sensor: &'static str) -> Vec<Known> {
    let frames = recording.of(sensor).unwrap().telegrams(MM).unwrap();
    frames
        .map(|frame| {
            let header = frame.header.unwrap();
            assert_eq!(frame.wall_ns, Some(header.wall_ns));
            Known { sensor, header, telegram: frame.telegram }
        })
        .collect()
}

#[test]
fn each_sensor_has_its_telegrams() {
    let written = crate::written::recording(20, 1);
    let file = File::new("whole", &written.bytes);
    let recording = Recording::open(&file.0).unwrap();
    let contents = recording.contents();
    assert_eq!((contents.form, contents.telegrams, contents.scans), (Form::Mcap, 40, 36));
    assert_eq!(contents.sensors, SENSORS);
    let [first, .., last] = &written.telegrams[..] else { panic!("no telegrams") };
    assert_eq!(contents.span, Some((first.header.wall_ns, last.header.wall_ns)));
    assert!(contents.damage.is_none(), "{}", contents.damage);
    for sensor in SENSORS {
        let of_sensor: Vec<_> = written.telegrams.iter().filter(|known| known.sensor == sensor).collect();
        assert!(read(&recording, sensor).iter().eq(of_sensor));
        let part = recording.of(sensor).unwrap();
        assert_eq!((part.contents().telegrams, part.contents().sensors.len()), (20, 1));
        let told = (part.contents().variant, part.contents().unit, part.contents().mode);
        let full = Variant::of_beams(181);
        assert_eq!(told, (full, Some(Unit::Mm), Some(Mode(4))));
    }
}

#[test]
fn a_sensor_has_to_be_chosen_of_several() {
    let file = File::new("choice", &crate::written::recording(4, 2).bytes);
    let recording = Recording::open(&file.0).unwrap();
    let refused = [(recording.telegrams(MM).err().unwrap(), 2), (recording.of("left").unwrap_err(), 3)];
    for (failure, code) in refused {
        assert_eq!(failure.kind.exit_code(), code);
        assert_eq!(failure.hint, "choose one: front, rear");
    }
}

/// A recorder that was killed leaves whole chunks.
#[test]
fn what_was_written_before_a_kill_is_there() {
    let written = crate::written::recording(20, 3);
    let file = File::new("killed", &written.bytes[..written.bytes.len() / 2]);
    let recording = Recording::open(&file.0).unwrap();
    assert!(recording.contents().damage.is_cut);
    let rear = read(&recording, "rear");
    assert!(rear.len() >= 8, "{}", rear.len());
    assert!(rear.iter().eq(written.telegrams.iter().filter(|known| known.sensor == "rear").take(rear.len())));
}

/// The recorder died before the first chunk was whole, or the disk lost it: names are lost, telegrams are not.
#[test]
fn sensors_without_their_names_are_called_by_their_numbers() {
    let written = crate::written::recording(4, 4);
    let name = b"front/telegram";
    let mut bytes = written.bytes[..written.bytes.len() / 2].to_vec();
    let places: Vec<_> = (0..bytes.len())
        .filter(|&at| bytes[at..].starts_with(b"front/") || bytes[at..].starts_with(b"rear/"))
        .collect();
    assert!(bytes.windows(name.len()).any(|window| window == name));
    places.into_iter().for_each(|at| bytes[at] = b'?');
    let file = File::new("nameless", &bytes);
    let recording = Recording::open(&file.0).unwrap();
    assert_eq!(recording.contents().sensors, ["sensor0", "sensor1"]);
    assert_eq!(
        recording.of("sensor1").unwrap().telegrams(MM).unwrap().next().unwrap().telegram,
        written.telegrams[1].telegram
    );
}

#[test]
fn one_without_its_beginning_is_known_by_its_end_or_its_messages() {
    let written = crate::written::recording(40, 3);
    let (len, end) = (written.bytes.len(), written.bytes.len() - 4000);
    let blank = [&[0; 4096], &written.bytes[4096..]].concat();
    let middle = written.bytes[len / 3..len / 2].to_vec();
    for (name, bytes, sensors, telegrams) in [
        ("rest", written.bytes[len / 3..].to_vec(), ["front", "rear"], 40..72),
        ("end", written.bytes[end..].to_vec(), ["front", "rear"], 0..8),
        ("blank", blank, ["front", "rear"], 60..81),
        ("middle", middle.clone(), ["sensor0", "sensor1"], 8..24),
    ] {
        let file = File::new(name, &bytes);
        let recording = Recording::open(&file.0).unwrap();
        let contents = recording.contents();
        assert_eq!(
            (contents.form, &contents.sensors[..]),
            (Form::Mcap, &sensors.map(String::from)[..]),
            "{name}"
        );
        assert!(
            telegrams.contains(&contents.telegrams) && contents.damage.is_headless,
            "{name}: {contents:?}"
        );
        assert!(contents.damage.to_string().contains("the beginning of the file"), "{}", contents.damage);
    }
    // Its telegrams alone are a stream, also with something that is no message before each.
    let telegrams = |before: &[u8]| {
        written.telegrams.iter().flat_map(|known| [before, &known.telegram].concat()).collect::<Vec<u8>>()
    };
    for before in [&[][..], &[5; 95], &[0; 95]] {
        let file = File::new("stream", &telegrams(before));
        let contents = Recording::open(&file.0).unwrap().contents().clone();
        assert_eq!((contents.form, contents.telegrams), (Form::Telegrams, 80));
    }
}

/// Nothing but luck finds a telegram in a packed chunk whose checksum is wrong; all else is found, and what is lost is said.
#[test]
fn a_packed_chunk_that_is_harmed_is_lost_alone() {
    for (name, compression) in [("lz4", Compression::Lz4), ("zstd", Compression::Zstd)] {
        let written = crate::written::packed(20, 13, compression);
        assert!(written.bytes.len() < crate::written::recording(20, 13).bytes.len() * 9 / 10, "{name} packs");
        let path = std::env::temp_dir().join(format!("scanhub-packed-{name}-{}", std::process::id()));
        let telegrams = |bytes: &[u8]| {
            std::fs::write(&path, bytes).unwrap();
            let recording = Recording::open(&path).unwrap();
            let of = |sensor: &str| recording.of(sensor).unwrap().telegrams(MM).unwrap().collect::<Vec<_>>();
            let found: Vec<_> =
                crate::written::SENSORS.into_iter().flat_map(of).map(|frame| frame.telegram).collect();
            (found, recording.contents().damage)
        };
        let (whole, damage) = telegrams(&written.bytes);
        assert!(damage.is_none() && whole.len() == 40, "{name}: {damage}");
        // A chunk has four telegrams of each of two sensors.
        let summary = mcap::Summary::read(&written.bytes).unwrap().unwrap();
        let chunk = &summary.chunk_indexes[2];
        for part in 2..18 {
            let mut harmed = written.bytes.clone();
            harmed[(chunk.chunk_start_offset + chunk.chunk_length * part / 20) as usize] ^= 0x10;
            let (left, damage) = telegrams(&harmed);
            let name = format!("{name}, {part}/20");
            // Values that nothing could pack stand there as they are: by luck a telegram is found all the same.
            assert!((32..40).contains(&left.len()) && damage.chunks == 1, "{name}: {}, {damage}", left.len());
            assert!(damage.telegrams + damage.estimated > 0, "{name}: {damage}");
            let lost = whole.iter().filter(|telegram| !left.contains(telegram)).count();
            assert!(lost <= 8 && left.iter().all(|telegram| whole.contains(telegram)), "{name}: {lost} lost");
        }
        std::fs::remove_file(&path).unwrap();
    }
}
