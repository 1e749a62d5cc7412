//! Tests of conversions from a recording to a stream file (`.bin`) and back. For every model and mode of the rotating
//! scanners, reading the stream file gives the scans of the recording, at whatever point of the stream the recording
//! starts. A stream file has no stamps, so the tests do not compare stamps.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use scanhub_drivers::line::{Action, Event, Protocol as _, ScannerSession as _};
use scanhub_drivers::{Session, Settings, ld};
use scanhub_recording::convert::{ConversionResult, ConvertOptions, convert};
use scanhub_recording::{Encoding, Form, Recording, VirtualTime};
use scanhub_schema::datagram::DatagramPayload;
use scanhub_schema::file::Writer;
use scanhub_schema::{Failure, Family, Foreground, Header, MILLIS, Nanos, Scan, Status, Topic};
use scanhub_sim::Arrival;
use scanhub_sim::device::Device;
use scanhub_sim::fault::Faults;
use scanhub_sim::ld::{LdSettings, LdSimulator};
use scanhub_sim::line_model::LineModel;
use scanhub_sim::room::Room;
use scanhub_sim::rplidar::{Model, RplidarSettings, RplidarSimulator};
use tempfile::TempDir;

const ONE_SECOND: Nanos = 1_000 * MILLIS;
/// Duration of a recording. It includes the 1.6 s that the motor of an RPLIDAR needs to reach its speed.
const RECORDING_LEN: Nanos = 9 * ONE_SECOND;
/// Start of a recording that lacks the start of the stream.
const LATE_START: Nanos = 4 * ONE_SECOND;
/// Time at which the clock of a session starts that reads a file.
const FILE_CLOCK_START: Nanos = 10 * ONE_SECOND;
/// Length of a packet of one point, in bytes.
const POINT_PACKET_LEN: u64 = 5;
const WALL_NS: u64 = 1_700_000_000_000_000_000;

/// Telegrams, scans and status of a scanner, as a hub publishes them.
struct LiveStream {
    family: Family,
    telegrams: Vec<(Header, Vec<u8>)>,
    scans: Vec<(Nanos, Box<Scan>)>,
    status: Status,
}

impl LiveStream {
    /// Runs a session with `settings` on `device` for [`RECORDING_LEN`].
    fn run_session(device: &mut dyn Device, family: Family, settings: &Settings) -> LiveStream {
        let mut wire = LineModel::new(&Faults::default(), 3);
        let mut session = Session::begin(family, settings, 0);
        let mut live =
            LiveStream { family, telegrams: Vec::new(), scans: Vec::new(), status: Status::default() };
        for now in (0..RECORDING_LEN).step_by(MILLIS as usize) {
            let mut bytes = Vec::new();
            while let Some(carried) = wire.poll_transmit(device, now) {
                bytes.extend(carried.bytes);
            }
            let spare = session.read_buffer();
            let len = bytes.len();
            spare[..len].copy_from_slice(&bytes);
            session.commit(now, len);
            if len == 0 {
                session.handle_timeout(now);
            }
            loop {
                match session.poll_action() {
                    Action::Event(Event::Telegram(received)) => {
                        let header = Header {
                            seq: live.telegrams.len() as u64,
                            topic_seq: live.telegrams.len() as u64,
                            stamp_first_ns: received.first,
                            stamp_last_ns: received.last,
                            wall_ns: WALL_NS + received.first,
                            boot: 77,
                            hub_pid: 1,
                            family: family as u8,
                            reasons: received.reasons,
                            ..Header::default()
                        };
                        live.telegrams.push((header, received.bytes.to_vec()));
                    }
                    Action::Event(Event::Scan(raw)) => {
                        let mut scan = Scan::zeroed(raw.payload_len());
                        raw.write(&mut scan);
                        live.scans.push((raw.first, scan));
                    }
                    Action::Transmit { bytes, .. } => {
                        let bytes = bytes.to_vec();
                        let is_received = session.rate() == device.rate();
                        for byte in bytes.iter().filter(|_| is_received) {
                            wire.receive(device, *byte, Arrival::at(now));
                        }
                        session.handle_transmitted(now);
                    }
                    Action::SetRate(_) | Action::SetDtr(_) => {}
                    Action::SleepUntil(_) | Action::Wait { .. } => break,
                }
            }
        }
        live.status.family = family as u8;
        session.describe(&mut live.status);
        live
    }

    /// Writes the recording of a recorder that attached at `from`: telegrams and a foreground, and also the status if
    /// `has_status` is set.
    fn record(&self, folder: &TempDir, from: Nanos, has_status: bool) -> PathBuf {
        let mut writer = Writer::begin(Vec::new(), "", BTreeMap::new()).unwrap();
        let mut room = vec![0; 32_768];
        let first = self.telegrams.iter().position(|(header, _)| header.stamp_first_ns >= from).unwrap();
        let (header, _) = self.telegrams[first];
        let mut write = |topic, header: &Header, payload: &[u8]| {
            writer.write_sample("front", topic, header, payload).unwrap();
        };
        if has_status {
            let len = self.status.pack(&mut room).unwrap();
            write(Topic::Status, &header, &room[..len]);
        }
        for (header, telegram) in &self.telegrams[first..] {
            write(Topic::Telegram, header, telegram);
        }
        let (header, _) = self.telegrams[self.telegrams.len() - 1];
        let len = Foreground::of(self.scans[0].1.beams()).pack(&mut room).unwrap();
        write(Topic::Foreground, &header, &room[..len]);
        let path = folder.path().join(format!("from-{from}.mcap"));
        std::fs::write(&path, writer.finish().unwrap()).unwrap();
        path
    }
}

fn convert_file(input: &Path, output: &str) -> (PathBuf, ConversionResult) {
    try_convert(input, output).unwrap()
}

fn try_convert(input: &Path, output: &str) -> Result<(PathBuf, ConversionResult), Failure> {
    let output = input.with_file_name(output);
    let options = ConvertOptions {
        input: input.to_owned(),
        output: output.clone(),
        force: true,
        ..ConvertOptions::default()
    };
    let converted = convert(&options, &AtomicBool::new(false), |_, _| {})?;
    Ok((output, converted))
}

/// Reads the scans of a recording, as a replay does.
fn scans_of(path: &Path) -> Vec<Box<Scan>> {
    let recording = Recording::open(path).unwrap();
    let family = recording.family().expect("known");
    let settings = recording.session_settings().unwrap();
    let mut session: Option<VirtualTime<Session>> = None;
    let mut scans = Vec::new();
    for frame in recording.telegrams(Encoding::default()).unwrap() {
        let at = frame
            .header
            .map_or(FILE_CLOCK_START + frame.scanner_ns.unwrap_or(0), |header| header.stamp_last_ns);
        let session =
            session.get_or_insert_with(|| VirtualTime::new(Session::begin(family, &settings, at), at));
        session.take(at, &frame.telegram, |event| {
            if let Event::Scan(raw) = event {
                let mut scan = Scan::zeroed(raw.payload_len());
                raw.write(&mut scan);
                scans.push(scan);
            }
        });
    }
    scans
}

fn is_same(a: &Scan, b: &Scan) -> bool {
    let angles = |scan: &Scan| (0..scan.beams()).map(|beam| scan.angle(beam)).collect::<Vec<f64>>();
    let is_near = |(a, b): (&f64, &f64)| (a - b).abs() < 1e-5 || a.is_nan() && b.is_nan();
    (a.beams(), a.flags, a.family, a.collisions) == (b.beams(), b.flags, b.family, b.collisions)
        && a.ranges() == b.ranges()
        && a.intensities() == b.intensities()
        && angles(a).iter().zip(&angles(b)).all(is_near)
}

/// Checks that the file at `path` has the scans of `live` that began after `from`. If the recording starts in the
/// middle of the stream, the first scan may be missing.
fn check(name: &str, live: &LiveStream, from: Nanos, path: &Path) {
    let expected: Vec<_> = live.scans.iter().filter(|(first, _)| *first >= from).collect();
    let read = scans_of(path);
    // If the file contains the time per point, its first scan may be earlier than that of the live session, which had
    // to measure this time first.
    let earlier = (0..read.len().min(2)).find(|&number| is_same(&expected[0].1, &read[number])).unwrap_or(0);
    let read = &read[earlier..];
    let first = read.first().unwrap_or_else(|| panic!("{name}: no scan"));
    let begin = expected.iter().position(|(_, scan)| is_same(scan, first));
    let beams = (first.beams(), expected[0].1.beams());
    let begin = begin.unwrap_or_else(|| panic!("{name}: a different scan, {beams:?} beams"));
    assert!(begin <= usize::from(from > 0), "{name}: the first {begin} scans are missing");
    for (number, (read, (_, live))) in read.iter().zip(&expected[begin..]).enumerate() {
        assert!(is_same(read, live), "{name}: scan {number} differs");
    }
    assert_eq!(begin + read.len(), expected.len(), "{name}: {begin} and {}", read.len());
    assert!(read.len() > 20, "{name}: {}", read.len());
}

/// Checks that a stream file has the scans of `live`, at whatever point of the stream the recording starts.
fn check_stream_files(name: &str, live: &LiveStream) {
    let folder = TempDir::new().unwrap();
    for from in [0, LATE_START] {
        let name = format!("{name} from {} s", from / ONE_SECOND);
        let recorded = live.record(&folder, from, true);
        let recording = Recording::open(&recorded).unwrap();
        let (stream, result) = convert_file(&recorded, "a.bin");
        assert_eq!(result.telegrams, recording.contents().telegrams, "{name}");
        let read = Recording::open(&stream).unwrap();
        assert_eq!((read.contents().form, read.family()), (Form::Telegrams, Some(live.family)), "{name}");
        // In a format without a checksum, a packet is accepted only if another packet follows. The last packet
        // therefore counts as damage.
        assert!(read.contents().damage.bytes <= POINT_PACKET_LEN, "{name}: {}", read.contents().damage);
        // Compare only rate and number of beams, because several models of LDROBOT share both and cannot be told apart.
        let model = |recording: &Recording| recording.model().unwrap().map(|model| (model.baud, model.beams));
        assert_eq!(model(&read), model(&recording), "{name}");
        let scanner_ns = read.contents().scanner_ns.expect("a clock of the scanner");
        let expected = RECORDING_LEN
            - live
                .telegrams
                .iter()
                .map(|(header, _)| header.stamp_first_ns)
                .find(|first| *first >= from.max(live.scans[0].0))
                .unwrap();
        assert!(scanner_ns.abs_diff(expected) < ONE_SECOND, "{name}: {scanner_ns} {expected}");
        check(&name, live, from, &stream);
        // Convert the stream file to a recording, which has packets with stamps, and this recording to a stream file.
        let (again, _) = convert_file(&stream, "b.mcap");
        check(&format!("{name}, in MCAP"), live, from, &again);
        let (twice, _) = convert_file(&again, "c.bin");
        let [bytes, twice] = [stream, twice].map(|path| std::fs::read(path).unwrap());
        let missing = bytes.len() - twice.len();
        assert!(
            bytes.starts_with(&twice) && missing as u64 <= POINT_PACKET_LEN,
            "{name}: {missing} bytes are missing"
        );
    }
}

fn room() -> Room {
    Room::new(&"room".parse().expect("a world"), 1)
}

#[test]
fn rplidar_stream_files_have_the_same_scans() {
    for model in Model::ALL {
        let fastest = Settings { is_found: true, ..Settings::default() };
        let modes = model.modes().iter().map(|mode| {
            let mode = scanhub_drivers::rplidar::Mode::from_name(mode.name).expect("known").name();
            (mode, Settings { model: Some(model.name()), mode: Some(mode), ..Settings::default() })
        });
        for (mode, settings) in modes.chain([("the fastest mode", fastest)]) {
            let mut unit = RplidarSimulator::new(RplidarSettings::of(model), room());
            let live = LiveStream::run_session(&mut unit, Family::Rplidar, &settings);
            check_stream_files(&format!("{} {mode}", model.name()), &live);
        }
    }
}

#[test]
fn ldrobot_stream_files_have_the_same_scans() {
    for model in ld::Model::ALL {
        for settings in [Settings::default(), Settings { model: Some(model.name()), ..Settings::default() }] {
            let mut head = LdSimulator::new(LdSettings::of(model), room());
            let live = LiveStream::run_session(&mut head, Family::Ld, &settings);
            check_stream_files(model.name(), &live);
        }
    }
}

/// The packets of an RPLIDAR alone do not determine the model or the time per point. The conversion takes both from the
/// responses at the start of a stream, or from the topic `status`.
#[test]
fn refuses_stream_file_without_status_and_responses() {
    for model in Model::ALL {
        let name = model.name();
        let fastest = Settings { is_found: true, ..Settings::default() };
        let live = LiveStream::run_session(
            &mut RplidarSimulator::new(RplidarSettings::of(model), room()),
            Family::Rplidar,
            &fastest,
        );
        let folder = TempDir::new().unwrap();
        let recorded = live.record(&folder, LATE_START, false);
        let failure = try_convert(&recorded, "a.bin").expect_err(name);
        assert_eq!(failure.kind.exit_code(), 66, "{name}: {failure}");
        assert!(failure.hint.contains("NAME/status"), "{name}: {failure}");
        assert!(!folder.path().join("a.bin").exists(), "{name}");
        let recorded = live.record(&folder, 0, false);
        let (stream, _) = convert_file(&recorded, "a.bin");
        check(name, &live, 0, &stream);
    }
}

/// A stream file without the responses of the scanner can be read, because the reader finds the packets. If the packets
/// may have two formats, the reader needs the model or the mode to form scans.
#[test]
fn ambiguous_stream_requires_model_or_mode() {
    let folder = TempDir::new().unwrap();
    let settings = Settings { model: Some("s1"), ..Settings::default() };
    let live = LiveStream::run_session(
        &mut RplidarSimulator::new(RplidarSettings::of(Model::S1), room()),
        Family::Rplidar,
        &settings,
    );
    let packets = live.telegrams.iter().filter(|(header, _)| header.stamp_first_ns >= LATE_START);
    let bytes: Vec<u8> = packets.flat_map(|(_, bytes)| bytes.clone()).collect();
    let path = folder.path().join("old.bin");
    std::fs::write(&path, &bytes).unwrap();
    let recording = Recording::open(&path).unwrap();
    assert_eq!((recording.contents().telegrams > 100, recording.contents().damage.bytes), (true, 0));
    let failure = recording.session_settings().unwrap_err();
    assert!(failure.hint.contains("link.NAME.model or mode is set"), "{failure}");
    let frames: Vec<_> = recording.telegrams(Encoding::default()).unwrap().collect();
    assert!(frames.iter().flat_map(|frame| &frame.telegram).eq(&bytes));
    let in_mode = |settings: Settings| {
        let settings = Settings { fixed_rate: true, listen_only: true, ..settings };
        let mut session =
            VirtualTime::new(Session::begin(Family::Rplidar, &settings, FILE_CLOCK_START), FILE_CLOCK_START);
        let mut beams = Vec::new();
        for frame in &frames {
            session.take(FILE_CLOCK_START + frame.scanner_ns.unwrap_or(0), &frame.telegram, |event| {
                if let Event::Scan(scan) = event {
                    beams.push(scan.beams());
                }
            });
        }
        beams
    };
    assert!(in_mode(Settings::default()).is_empty());
    for named in [settings, Settings { mode: Some("denseboost"), ..Settings::default() }] {
        let beams = in_mode(named);
        assert!(beams.len() > 20 && beams.iter().all(|beams| beams.abs_diff(920) < 20), "{beams:?}");
    }
    // The file is copied unchanged.
    let (copy, _) = convert_file(&path, "copy.bin");
    assert!(std::fs::read(copy).unwrap() == bytes);
}
