//! Tests that the bytes of a stream are sufficient to recognize the scanner's family. The tests cover every simulated
//! scanner in every mode, streams that start at any byte, and lines that lose bytes.

use scanhub_drivers::lms::variant::{Baud, Variant};
use scanhub_drivers::recognize::{EXAMINED_BYTES, family_of};
use scanhub_schema::{Family, MILLIS, Nanos};
use scanhub_sim::device::Device;
use scanhub_sim::fault::Faults;
use scanhub_sim::ld::{LdSettings, LdSimulator};
use scanhub_sim::line_model::LineModel;
use scanhub_sim::machine::{LmsSimulator, Settings, StartState};
use scanhub_sim::operating::OperatingMode;
use scanhub_sim::operating::ScanSource;
use scanhub_sim::room::Room;
use scanhub_sim::rplidar::{self, RplidarSettings, RplidarSimulator, RplidarStart};

/// Returns the first `len` bytes that arrive from `device`. After 30 s, returns fewer bytes.
fn first_bytes(device: &mut dyn Device, faults: &str, len: usize) -> Vec<u8> {
    let mut wire = LineModel::new(&faults.parse::<Faults>().expect("faults"), 3);
    let (mut now, mut bytes): (Nanos, _) = (0, Vec::new());
    while now < 30_000 * MILLIS && bytes.len() < len {
        while let Some(carried) = wire.poll_transmit(device, now) {
            bytes.extend(carried.bytes);
        }
        let Some(next) = wire.poll_timeout(device, now) else { break };
        now = now.max(next);
    }
    bytes.truncate(len);
    bytes
}

fn room() -> Room {
    Room::new(&"room".parse().expect("a world"), 1)
}

/// Returns every streaming scanner with its family and a name.
fn scanners() -> Vec<(Family, String, Box<dyn Device>)> {
    let mut scanners: Vec<(Family, String, Box<dyn Device>)> = Vec::new();
    let modes =
        [OperatingMode::All, OperatingMode::Partial, OperatingMode::Means(10), OperatingMode::Range(31, 91)];
    for (number, operating) in modes.into_iter().enumerate() {
        for variant in Variant::ALL {
            let start = StartState::Operating(operating.clone());
            let settings = Settings { baud: Baud::B500000, variant, start, ..Settings::default() };
            let name = format!("lms, mode {number}, {variant:?}");
            scanners.push((
                Family::Lms,
                name,
                Box::new(LmsSimulator::new(settings, ScanSource::Room(room()))),
            ));
        }
    }
    for model in scanhub_drivers::ld::Model::ALL {
        let head = LdSimulator::new(LdSettings::of(model), room());
        scanners.push((Family::Ld, model.name().to_owned(), Box::new(head)));
    }
    for model in rplidar::Model::ALL {
        for typical in 0..model.modes().len() {
            let settings =
                RplidarSettings { start: RplidarStart::Streaming, typical, ..RplidarSettings::of(model) };
            let name = format!("{}, mode {typical}", model.name());
            scanners.push((Family::Rplidar, name, Box::new(RplidarSimulator::new(settings, room()))));
        }
    }
    scanners
}

#[test]
fn recognizes_every_family_in_every_mode() {
    for (family, name, mut scanner) in scanners() {
        let bytes = first_bytes(&mut *scanner, "", EXAMINED_BYTES + 1_000);
        assert!(bytes.len() > 5_000, "{name}: {} bytes", bytes.len());
        for begin in [0, 1, 20, 977] {
            assert_eq!(family_of(&bytes[begin..]), Some(family), "{name} from byte {begin}");
        }
        assert_eq!(family_of(&bytes[..5_000]), Some(family), "{name}, few bytes");
    }
}

#[test]
fn recognizes_every_family_on_a_lossy_line() {
    for (family, name, mut scanner) in scanners() {
        let bytes = first_bytes(&mut *scanner, "loss=0.00135,burst=1.89", EXAMINED_BYTES);
        assert_eq!(family_of(&bytes), Some(family), "{name}");
    }
}
