//! What the wire does to bytes, and whether it says the truth of it.

use scanhub_drivers::lms::variant::Baud;
use scanhub_schema::{MILLIS, Nanos};
use scanhub_sim::ChunkSize;
use scanhub_sim::device::Part;
use scanhub_sim::fault::{Fault, Faults};
use scanhub_sim::machine::{LmsSimulator, Settings, Start};
use scanhub_sim::operating::Operating;
use scanhub_sim::operating::Source;
use scanhub_sim::room::Room;
use scanhub_sim::wire::LineModel;
use scanhub_sim::world::World;

/// A telegram with the bytes that arrived in its time, and the verdict.
struct Told {
    telegram: Vec<u8>,
    arrived: Vec<u8>,
    fault: Option<Fault>,
}

/// Everything that a sensor says within `span` over a wire with `faults`.
fn carried(faults: &str, seed: u64, chunk: ChunkSize, span: Nanos) -> Vec<Told> {
    let settings =
        Settings { baud: Baud::B500000, start: Start::In(Operating::All), chunk, ..Settings::default() };
    let mut machine = LmsSimulator::new(settings, Source::Room(Room::new(&World::Random, 1)));
    let mut wire = LineModel::new(&faults.parse::<Faults>().unwrap(), seed);
    let (mut now, mut arrived, mut fault, mut told) = (0, Vec::new(), None, Vec::new());
    while let Some(at) = wire.poll_timeout(&machine, now).filter(|&at| at <= span) {
        assert!(at > now || now == 0, "no progress at {at}");
        now = at;
        while let Some(carried) = wire.poll_transmit(&mut machine, now) {
            fault = fault.or(carried.fault);
            arrived.extend(carried.bytes);
            if let Some(Part::End(sent)) = carried.part {
                let (arrived, fault) = (std::mem::take(&mut arrived), fault.take());
                told.push(Told { telegram: sent.telegram, arrived, fault });
            }
        }
    }
    told
}

fn contains(bytes: &[u8], part: &[u8]) -> bool {
    bytes.windows(part.len()).any(|window| window == part)
}

#[test]
fn a_telegram_is_called_damaged_exactly_if_it_did_not_arrive_in_one_piece() {
    for (faults, named) in [
        ("", None),
        ("loss=0.001,burst=2", Some(Fault::Loss)),
        ("flip=0.001,flip_bits=4", Some(Fault::Flip)),
        ("insert=0.001,insert_burst=4", Some(Fault::Insert)),
        ("double=0.001", Some(Fault::Double)),
        ("truncate=0.3", Some(Fault::Truncated)),
        ("length=0.3", Some(Fault::Length)),
        ("abort=0.3", Some(Fault::Aborted)),
        ("flood=100,flood_every=0.05", Some(Fault::Flood)),
        ("wall=100,wall_every=0.05", Some(Fault::Wall)),
        ("silence=0.03,silence_every=0.2", Some(Fault::Silence)),
        ("unplug=0.03,unplug_every=0.2", Some(Fault::Unplug)),
        ("power_at=0.51", Some(Fault::Power)),
        ("stall=0.3,stall_every=1,delay=0.01", None),
        ("flood=100,flood_every=0.01,wall=50,wall_every=0.01,inside=0", None),
    ] {
        let told = carried(faults, 3, ChunkSize::Uart, 5_000 * MILLIS);
        let mut damaged = 0;
        for Told { telegram, arrived, fault } in &told {
            assert_eq!(fault.is_none(), contains(arrived, telegram), "{faults}: {fault:?}");
            assert!(fault.is_none() || *fault == named, "{faults}: {fault:?}");
            damaged += usize::from(fault.is_some());
        }
        assert_eq!(damaged > 0, named.is_some(), "{faults}");
        assert!(told.len() - damaged > 10, "{faults}: {damaged} of {}", told.len());
    }
}

#[test]
fn a_seed_damages_the_same_bytes_however_they_are_cut() {
    let faults =
        "loss=0.001,burst=2,flip=0.0005,flip_bits=3,insert=0.0005,double=0.0005,truncate=0.1,length=0.1";
    let cut = |chunk, seed| -> Vec<(Vec<u8>, Option<Fault>)> {
        let told = carried(faults, seed, chunk, 3_000 * MILLIS);
        told.into_iter().map(|told| (told.arrived, told.fault)).collect()
    };
    let (uart, usb) = (cut(ChunkSize::Uart, 7), cut(ChunkSize::Usb, 7));
    assert!(uart.len() > 100 && uart == usb);
    assert!(uart != cut(ChunkSize::Uart, 8));
}

#[test]
fn a_repeated_telegram_has_a_truth_of_its_own() {
    let told = carried("repeat=0.5", 3, ChunkSize::Uart, 3_000 * MILLIS);
    let repeated = told.windows(2).filter(|pair| pair[0].telegram == pair[1].telegram).count();
    assert!((30..80).contains(&repeated), "{repeated} of {}", told.len());
    assert!(told.iter().all(|told| told.fault.is_none() && told.arrived == told.telegram));
}

#[test]
fn what_is_stuck_comes_late_and_in_order() {
    let told = carried("stall=0.5,stall_at=1", 3, ChunkSize::Uart, 3_000 * MILLIS);
    let smooth = carried("", 3, ChunkSize::Uart, 3_000 * MILLIS);
    assert_eq!(told.len(), smooth.len());
    assert!(told.iter().zip(&smooth).all(|(late, smooth)| late.arrived == smooth.telegram));
}
