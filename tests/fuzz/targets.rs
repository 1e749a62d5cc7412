//! Fuzz targets: one function for each input from outside that the hub and its clients read. The fuzzer calls the
//! functions with generated input. `tests/it/fuzzed.rs` calls them with the corpus and with seeded noise. The functions
//! check only invariants, not expected outputs.

mod lan;
mod processors;
mod recording;
mod scans;
mod surroundings;

use scanhub_drivers::line::Control;
use scanhub_drivers::line::{Action, Event, Protocol as _, ScannerSession as _};
use scanhub_drivers::lms;
use scanhub_drivers::lms::LmsSession;
use scanhub_drivers::lms::Settings;
use scanhub_drivers::lms::command::Request;
use scanhub_drivers::lms::explain::explain;
use scanhub_drivers::lms::framer::{Framer, FramerCounters, FramerEvent, SUFFIX_HOLD_TIME, VETO_HOLD_TIME};
use scanhub_drivers::lms::header::ExpectedHeaders;
use scanhub_drivers::lms::measured::MeasuredValues;
use scanhub_drivers::lms::reply::Reply;
use scanhub_drivers::lms::telegram::{FRAME_LEN, MAX_LENGTH, STX, Telegram, Writer};
use scanhub_drivers::lms::variant::{Baud, Variant};
use scanhub_lms_configure::eeprom::EepromWrite;
use scanhub_schema::{MILLIS, Nanos};

/// A target with its name.
pub type Target = (&'static str, fn(&[u8]));

/// All targets. The corpus of a target is `corpus/NAME.txt`.
pub const TARGETS: [Target; 8] = [
    ("framer", framer),
    ("replies", replies),
    ("session", session),
    ("configuration", configuration),
    ("processors", processors),
    ("surroundings", surroundings),
    ("lan", lan),
    ("recording", recording),
];

/// Passes any bytes to the framer, in pieces. Checks that each telegram that the framer delivers is at the reported
/// position and has a valid checksum. Telegrams must arrive in order, and every byte must be counted.
///
/// The first byte of the input selects the headers that the framer expects, and the second byte is the size of the
/// pieces.
pub fn framer(data: &[u8]) {
    let [expects, piece, bytes @ ..] = data else { return };
    // A session copies the header of a stream from a telegram that it received, so the header's length is valid.
    let head = bytes.first_chunk().filter(|head: &&[u8; 7]| head[3] < 3);
    let expect = match (expects & 3, head) {
        (1, Some(&header)) => ExpectedHeaders::Stream { header, reply: None },
        (2, Some(&header)) => ExpectedHeaders::Stream { header, reply: Some(expects | 0x80) },
        _ => ExpectedHeaders::Anything,
    };
    let mut framer = Framer::default();
    framer.expect(expect);
    framer.expect_acknowledge(expects & 4 != 0);
    let mut looked_at = 0;
    let mut rest = bytes;
    while !rest.is_empty() {
        let spare = framer.read_buffer();
        let len = rest.len().min(spare.len()).min(usize::from(*piece) + 1);
        assert!(len > 0, "no room although everything was polled");
        spare[..len].copy_from_slice(&rest[..len]);
        framer.commit(len);
        rest = &rest[len..];
        drain(&mut framer, bytes, &mut looked_at);
    }
    framer.release(SUFFIX_HOLD_TIME);
    drain(&mut framer, bytes, &mut looked_at);
    framer.release(VETO_HOLD_TIME);
    drain(&mut framer, bytes, &mut looked_at);
}

fn drain(framer: &mut Framer, bytes: &[u8], checked_len: &mut usize) {
    while let Some(found) = framer.poll() {
        let FramerEvent::Telegram(framed) = found else { continue };
        let telegram = framed.telegram.bytes();
        assert!(Telegram::check(telegram).is_some());
        let ahead = &bytes[*checked_len..];
        let at = ahead.windows(telegram.len()).position(|window| window == telegram);
        let at = at.expect("a telegram that was not sent, or is out of order");
        *checked_len += at + telegram.len();
    }
    let FramerCounters { read, in_telegrams, acknowledge, discarded, .. } = *framer.counters();
    assert_eq!(read, in_telegrams + acknowledge + discarded + framer.buffered() as u64);
}

/// Decodes any data in a telegram with a valid checksum, both as a request and as a reply. If decoding succeeds, checks
/// that the result can be encoded again.
pub fn replies(data: &[u8]) {
    let [address, command, rest @ ..] = data else { return };
    let rest = &rest[..rest.len().min(MAX_LENGTH - 1)];
    let encoded = Writer::new(*address, *command).slice(rest).finish();
    let telegram = Telegram::check(encoded.bytes()).expect("as it was written");
    let _ = telegram.status();
    if let Some(request) = Request::decode(telegram) {
        assert_eq!(request.encode(*address).bytes(), encoded.bytes(), "{request:?}");
    }
    if let Some(write) = EepromWrite::decode(telegram) {
        assert!(lms::command::EEPROM_WRITES.contains(command), "{write:?}");
        let again = write.encode(*address).expect("a decoded write can be encoded");
        assert_eq!(again.bytes(), encoded.bytes(), "{write:?}");
    }
    if let Some(measured) = MeasuredValues::decode(telegram) {
        assert_eq!(measured.words().len(), measured.count());
        assert!((1..=401).contains(&measured.count()));
    }
    if let (Some(reply), Some(status)) = (Reply::decode(telegram), telegram.status()) {
        let again =
            reply.encode(*address, status).map(|again| Reply::decode(again.telegram()) == Some(reply));
        assert_ne!(again, Some(false), "{reply:?}");
    }
    // The explained fields must cover the whole telegram without gaps.
    let mut end = 0;
    explain(telegram, None, &mut |field| {
        assert_eq!(field.offset, end, "{}", field.name);
        end += field.bytes.len();
    });
    assert_eq!(end, encoded.bytes().len());
}

/// Runs an LMS session with any sequence of events: received bytes, elapsed time, and transmitted or pending bytes. The
/// input has two bytes of settings, followed by a program of two-byte instructions.
pub fn session(data: &[u8]) {
    let [variant, baud, program @ ..] = data else { return };
    let settings = Settings {
        variant: Variant::ALL[usize::from(*variant) % Variant::ALL.len()],
        baud: Baud::ALL[usize::from(*baud) % Baud::ALL.len()],
        listen_only: variant & 0xC0 == 0xC0,
        fixed_rate: variant & 0x20 != 0,
        keep_baud: variant & 0x10 != 0,
        mode: None,
    };
    let mut now: Nanos = 1_000 * MILLIS;
    let mut session = LmsSession::new(settings, now);
    let mut read = 0;
    let mut request_bytes = Vec::new();
    let mut rest = program;
    while let [what, much, after @ ..] = rest {
        rest = after;
        let mut until = Nanos::MAX;
        loop {
            match session.poll_action() {
                Action::Transmit { bytes, not_before } if what & 0x80 == 0 => {
                    now = now.max(not_before);
                    request_bytes.extend(bytes);
                    session.handle_transmitted(now);
                }
                Action::Transmit { .. } => break,
                Action::SetDtr(_) => panic!("an LMS does not use DTR"),
                Action::SetRate(baud) => assert!(baud == settings.baud.rate() || !settings.fixed_rate),
                Action::Event(Event::Scan(_)) => panic!("a telegram is a scan"),
                Action::Event(Event::Telegram(received)) => {
                    assert!(Telegram::check(received.bytes).is_some());
                    assert!(received.first <= received.last && received.last <= now);
                }
                Action::SleepUntil(at) | Action::Wait { until: at, .. } => {
                    until = at;
                    break;
                }
            }
        }
        let tally = session.framer_counters();
        let known = tally.in_telegrams + tally.acknowledge + tally.discarded + session.stats().buffered;
        assert_eq!((tally.read, known), (read, read), "bytes vanished");
        match what & 3 {
            // Receive bytes, which are part of the program.
            0 => {
                let spare = session.read_buffer();
                let len = rest.len().min(usize::from(*much)).min(spare.len());
                spare[..len].copy_from_slice(&rest[..len]);
                rest = &rest[len..];
                read += len as u64;
                session.commit(now, len);
            }
            // Advance the time, perhaps by less than the session wants to wait.
            1 => {
                now += Nanos::from(*much) * MILLIS / 8;
                session.commit(now, 0);
                session.handle_timeout(now);
            }
            // Advance the time to the session's deadline.
            2 if until != Nanos::MAX => {
                now = now.max(until);
                session.handle_timeout(now);
            }
            3 if what & 0x40 != 0 => {
                const CONTROLS: [Control; 3] = [Control::Pause, Control::Resume, Control::Resync];
                session.control(CONTROLS[usize::from(*much) % CONTROLS.len()], now);
            }
            // Receive a reply with a valid checksum. The data of the reply are part of the program.
            _ => {
                let len = rest.len().min(usize::from(*much)).min(120);
                let (reply, after) = rest.split_at(len);
                rest = after;
                let [command, reply @ ..] = reply else { continue };
                let telegram = Writer::new(0x80, command | 0x80).slice(reply).byte(0x10).finish();
                let spare = session.read_buffer();
                let len = telegram.bytes().len().min(spare.len());
                spare[..len].copy_from_slice(&telegram.bytes()[..len]);
                read += len as u64;
                session.commit(now, len);
            }
        }
    }
    assert!(request_bytes.is_empty() || !settings.listen_only, "a session that only listens sent bytes");
    assert_harmless(&request_bytes);
}

/// Checks that no request that writes the EEPROM starts at any position in `request_bytes`.
fn assert_harmless(request_bytes: &[u8]) {
    for at in 0..request_bytes.len() {
        let [STX, _, low, high, command, ..] = request_bytes[at..] else { continue };
        let len = usize::from(u16::from_le_bytes([low, high])) + FRAME_LEN;
        let telegram = request_bytes.get(at..at + len).and_then(Telegram::check);
        let is_write = telegram.is_some() && lms::command::EEPROM_WRITES.contains(&command);
        assert!(!is_write, "{command:02X}h was sent");
    }
}

/// Loads any text as flags and as a configuration file. The configuration must be accepted, or refused with a remedy.
///
/// The text is split at zero bytes. The first part is the file. The other parts are values of `--set` and `--link`,
/// alternating.
pub fn configuration(data: &[u8]) {
    use scanhub_config::{Config, Sources};
    let text = String::from_utf8_lossy(data);
    let mut pieces = text.split('\0');
    let path = tempfile::NamedTempFile::new().expect("a temporary file").into_temp_path();
    std::fs::write(&path, pieces.next().unwrap_or_default()).expect("a writable directory");
    let (mut set, mut links) = (Vec::new(), Vec::new());
    for (number, piece) in pieces.enumerate() {
        if number % 2 == 0 { &mut set } else { &mut links }.push(piece.to_owned());
    }
    match Config::load(&Sources { files: vec![path.to_path_buf()], set, links }) {
        Ok(config) => assert!(!config.links.is_empty()),
        Err(failure) => {
            assert_eq!(failure.kind.exit_code(), 78, "{failure}");
            assert!(!failure.message.is_empty());
        }
    }
}

/// Passes any scans with any settings through all processors.
pub fn processors(data: &[u8]) {
    processors::processors(data);
}

/// Passes any scans through the processors that track the robot's motion: line features, motion, and the background of
/// a moving robot.
pub fn surroundings(data: &[u8]) {
    surroundings::surroundings(data);
}

/// Passes any datagrams through all checks and the receiver's counters.
pub fn lan(data: &[u8]) {
    lan::lan(data);
}

/// Opens any bytes as a recording.
pub fn recording(data: &[u8]) {
    recording::recording(data);
}
