//! Tests of RPLIDARs in simulated rooms, in virtual time: responses byte for byte, the effects of requests, and faults.

mod points;
mod session;

use scanhub_schema::{MILLIS, Nanos, line_time};
use scanhub_sim::Arrival;
use scanhub_sim::device::{ChunkKind, Device as _};
use scanhub_sim::fault::Faults;
use scanhub_sim::line_model::LineModel;
use scanhub_sim::room::Room;
use scanhub_sim::rplidar::{Model, PacketFormat, RplidarSettings, RplidarSimulator, RplidarStart};
use scanhub_sim::world::World;

pub(crate) const ONE_SECOND: Nanos = 1_000 * MILLIS;

/// A response or a packet that the scanner sent.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct SentMessage {
    pub(crate) bytes: Vec<u8>,
    pub(crate) is_reply: bool,
    /// Fault that the line applied to it.
    pub(crate) fault: Option<&'static str>,
    pub(crate) at: Nanos,
}

pub(crate) struct Bench {
    pub(crate) unit: RplidarSimulator,
    line_model: LineModel,
    pub(crate) now: Nanos,
    /// Bytes that the host received.
    pub(crate) received: Vec<u8>,
    pub(crate) sent: Vec<SentMessage>,
    fault: Option<&'static str>,
}

impl Bench {
    pub(crate) fn new(settings: RplidarSettings, world: &World, faults: &str) -> Bench {
        let faults: Faults = faults.parse().expect("faults");
        let seed = settings.seed;
        let settings = RplidarSettings { faults, quirks: faults.quirks(), ..settings };
        Bench {
            unit: RplidarSimulator::new(settings, Room::new(world, seed)),
            line_model: LineModel::new(&faults, seed),
            now: 0,
            received: Vec::new(),
            sent: Vec::new(),
            fault: None,
        }
    }

    /// Runs until the time `until`.
    pub(crate) fn run(&mut self, until: Nanos) {
        loop {
            while let Some(carried) = self.line_model.poll_transmit(&mut self.unit, self.now) {
                self.fault = self.fault.or(carried.fault.map(|fault| fault.name()));
                self.received.extend(carried.bytes);
                if let Some(ChunkKind::End(sent)) = carried.part {
                    let (fault, at) = (self.fault.take(), self.now);
                    self.sent.push(SentMessage { bytes: sent.telegram, is_reply: sent.is_reply, fault, at });
                }
            }
            let next = self.line_model.poll_timeout(&self.unit, self.now).filter(|&at| at <= until);
            match next {
                Some(at) => self.now = at.max(self.now),
                None => break,
            }
        }
        self.now = until;
    }

    /// Runs for `span`.
    pub(crate) fn run_for(&mut self, span: Nanos) {
        self.run(self.now + span);
    }

    /// Sends `request` at the rate of the line, and returns the responses that arrive within the next 20 ms.
    pub(crate) fn ask(&mut self, request: &[u8]) -> Vec<Vec<u8>> {
        let before = self.sent.len();
        for &byte in request {
            self.run_for(line_time(1, self.unit.rate()));
            self.line_model.receive(&mut self.unit, byte, Arrival::at(self.now));
        }
        self.run_for(20 * MILLIS);
        self.sent[before..].iter().filter(|sent| sent.is_reply).map(|sent| sent.bytes.clone()).collect()
    }

    /// Requests the value of `key` for mode number `mode`, and returns the responses.
    pub(crate) fn configuration(&mut self, key: u8, mode: u8) -> Vec<Vec<u8>> {
        self.ask(&with_payload(0x84, &[key, 0, 0, 0, mode, 0]))
    }

    /// Returns the packets of the stream in the order in which the scanner sent them.
    pub(crate) fn data(&self) -> Vec<Vec<u8>> {
        self.sent.iter().filter(|sent| !sent.is_reply).map(|sent| sent.bytes.clone()).collect()
    }

    /// Delivers a byte of a request.
    pub(crate) fn send_byte(&mut self, byte: u8) {
        self.line_model.receive(&mut self.unit, byte, Arrival::at(self.now));
    }

    pub(crate) fn cycle_power(&mut self) {
        self.line_model.cycle_power(&mut self.unit, self.now);
    }
}

/// Returns a request with a payload: the command, the length of the payload, the payload, and the XOR of all bytes.
pub(crate) fn with_payload(command: u8, payload: &[u8]) -> Vec<u8> {
    let mut bytes = vec![0xA5, command, payload.len() as u8];
    bytes.extend(payload);
    bytes.push(bytes.iter().fold(0, |sum, byte| sum ^ byte));
    bytes
}

/// Returns the request that starts a stream in mode number `mode`.
pub(crate) fn stream_request(mode: usize) -> Vec<u8> {
    match mode {
        0 => vec![0xA5, 0x20],
        _ => with_payload(0x82, &[mode as u8, 0, 0, 0, 0]),
    }
}

fn bench(model: Model) -> Bench {
    Bench::new(RplidarSettings::of(model), &World::Empty, "")
}

/// Returns the response in `replies`, which must contain exactly one.
fn only_reply(mut replies: Vec<Vec<u8>>) -> Vec<u8> {
    assert_eq!(replies.len(), 1, "{replies:02X?}");
    replies.pop().expect("one")
}

#[test]
fn every_request_is_answered_byte_for_byte() {
    let mut bench = bench(Model::A1);
    let info = only_reply(bench.ask(&[0xA5, 0x50]));
    // The response has model 18h, firmware 1.29, hardware 5, and a serial number of sixteen bytes, which depends on the
    // seed.
    assert_eq!(info[..11], [0xA5, 0x5A, 0x14, 0, 0, 0, 0x04, 0x18, 29, 1, 5]);
    assert_eq!(info.len(), 7 + 20);
    assert_eq!(only_reply(bench.ask(&[0xA5, 0x52])), [0xA5, 0x5A, 3, 0, 0, 0, 0x06, 0, 0, 0]);
    let rates = [508u16.to_le_bytes(), 254u16.to_le_bytes()].concat();
    assert_eq!(only_reply(bench.ask(&[0xA5, 0x59])), [&[0xA5, 0x5A, 4, 0, 0, 0, 0x15], &rates[..]].concat());
    let conf = |key: u8, value: &[u8]| {
        [&[0xA5, 0x5A, 4 + value.len() as u8, 0, 0, 0, 0x20, key, 0, 0, 0], value].concat()
    };
    assert_eq!(only_reply(bench.configuration(0x70, 0)), conf(0x70, &[5, 0]));
    assert_eq!(only_reply(bench.configuration(0x71, 1)), conf(0x71, &(254u32 << 8).to_le_bytes()));
    assert_eq!(only_reply(bench.configuration(0x74, 1)), conf(0x74, &(12u32 << 8).to_le_bytes()));
    assert_eq!(only_reply(bench.configuration(0x75, 2)), conf(0x75, &[0x84]));
    assert_eq!(only_reply(bench.configuration(0x7C, 0)), conf(0x7C, &[3, 0]));
    assert_eq!(only_reply(bench.configuration(0x7F, 4)), conf(0x7F, b"Stability\0"));
    // The vendor's driver sends 32 more bytes after the key. The scanner accepts them.
    let mut long = vec![0x7F, 0, 0, 0];
    long.extend([0; 32]);
    assert_eq!(only_reply(bench.ask(&with_payload(0x84, &long))), conf(0x7F, b"Standard\0"));
    // The scanner does not reply to an unknown mode, key or command, nor to STOP.
    for request in [
        with_payload(0x84, &[0x75, 0, 0, 0, 5, 0]),
        with_payload(0x84, &[0x79, 0, 0, 0]),
        vec![0xA5, 0x33],
        vec![0xA5, 0x25],
        stream_request(7),
    ] {
        assert_eq!(bench.ask(&request), Vec::<Vec<u8>>::new(), "{request:02X?}");
    }
    assert_eq!(bench.unit.eeprom_writes(), 0);
    let set = [0x00, 0xCC, 0x01, 0x00, 1, 2, 3, 4];
    let answer = only_reply(bench.ask(&with_payload(0x85, &set)));
    assert_eq!(answer, [0xA5, 0x5A, 8, 0, 0, 0, 0x21, 0x00, 0xCC, 0x01, 0x00, 0, 0, 0, 0]);
    assert_eq!(bench.unit.eeprom_writes(), 1, "a change of a permanent setting was not counted");
}

#[test]
fn descriptor_starts_a_stream_and_any_request_ends_it() {
    for model in Model::ALL {
        for (number, mode) in model.modes().iter().enumerate() {
            let mut bench = bench(model);
            bench.ask(&with_payload(0xF0, &660u16.to_le_bytes()));
            bench.run_for(2 * ONE_SECOND);
            let descriptor = only_reply(bench.ask(&stream_request(number)));
            let [low, high] = (mode.form.packet_len() as u16).to_le_bytes();
            assert_eq!(descriptor, [0xA5, 0x5A, low, high, 0, 0x40, mode.form.response_type()]);
            bench.run_for(ONE_SECOND / 2);
            let packets = bench.data();
            assert!(
                packets.iter().all(|packet| packet.len() == mode.form.packet_len()) && packets.len() > 10
            );
            if mode.form != PacketFormat::Standard {
                // Only the first packet of a stream has the flag of a new stream.
                let at = if mode.form == PacketFormat::UltraDense { 9 } else { 3 };
                let begins: Vec<_> = packets.iter().map(|packet| packet[at] & 0x80 != 0).collect();
                assert!(begins[0] && begins[1..].iter().all(|begins| !begins), "{mode:?}");
            }
            for request in [vec![0xA5, 0x25], vec![0xA5, 0x50], vec![0xA5, 0x52]] {
                bench.ask(&stream_request(number));
                bench.run_for(ONE_SECOND / 5);
                assert!(bench.unit.streams());
                bench.ask(&request);
                let sent = bench.sent.len();
                bench.run_for(ONE_SECOND);
                assert_eq!((bench.sent.len(), bench.unit.streams()), (sent, false), "{request:02X?}");
            }
        }
    }
}

#[test]
fn motor_control_depends_on_the_model() {
    let pwm = |duty: u16| with_payload(0xF0, &duty.to_le_bytes());
    let rpm = |rpm: u16| with_payload(0xA8, &rpm.to_le_bytes());
    let board = with_payload(0xFF, &[0; 4]);
    let answer = |steers| [0xA5, 0x5A, 4, 0, 0, 0, 0xFF, steers, 0, 0, 0];
    for (model, turns, stop, go) in [
        (Model::A1, true, vec![], vec![]),
        (Model::A3, false, pwm(0), pwm(660)),
        (Model::S1, true, rpm(0), rpm(600)),
    ] {
        let mut bench = bench(model);
        let board = bench.ask(&board);
        match model {
            Model::S1 => assert!(board.is_empty()),
            _ => assert_eq!(only_reply(board), answer(u8::from(model == Model::A3))),
        }
        let flows = |bench: &mut Bench| {
            let sent = bench.sent.len();
            bench.run_for(ONE_SECOND);
            bench.sent.len() > sent
        };
        // The descriptor arrives at once. Points arrive when the motor has reached its speed.
        assert_eq!(bench.ask(&stream_request(1)).len(), 1);
        assert_eq!(flows(&mut bench), turns, "{model:?}");
        if stop.is_empty() {
            continue;
        }
        bench.ask(&go);
        bench.run_for(ONE_SECOND);
        assert!(flows(&mut bench), "{model:?}");
        bench.ask(&stop);
        assert!(!flows(&mut bench), "{model:?}");
        // After FORCE, the scanner does not wait for the motor. The motor is off, so all points have the same
        // direction.
        bench.ask(&[0xA5, 0x21]);
        assert!(flows(&mut bench), "{model:?}");
        let angles: Vec<f64> =
            (0..100).map(|k| bench.unit.truth(k).expect("it streams").clockwise_deg).collect();
        assert!(angles.iter().all(|angle| *angle == angles[0]));
    }
}

#[test]
fn accepts_requests_only_after_the_boot_message() {
    let mut bench = bench(Model::A1);
    bench.ask(&stream_request(1));
    bench.run_for(ONE_SECOND);
    let requested_at = bench.now;
    assert!(bench.ask(&[0xA5, 0x40]).is_empty());
    // The scanner boots, so it does not respond.
    assert!(bench.ask(&[0xA5, 0x50]).is_empty());
    bench.run_for(ONE_SECOND);
    let boot_message = bench.sent.last().expect("a boot message").clone();
    assert!(boot_message.is_reply && boot_message.bytes.len() == 64 && boot_message.bytes.is_ascii());
    let text = String::from_utf8(boot_message.bytes).expect("ascii");
    assert!(text.starts_with("RP LIDAR System.\r\nFirmware Ver 1.29, HW Ver 5\r\n"), "{text}");
    let elapsed = boot_message.at - requested_at;
    assert!((671 * MILLIS..680 * MILLIS).contains(&elapsed), "{elapsed}");
    assert!(!bench.unit.streams());
    assert_eq!(only_reply(bench.ask(&[0xA5, 0x50])).len(), 27);
    let settings = RplidarSettings { start: RplidarStart::PowerOn, ..RplidarSettings::of(Model::A1) };
    let mut bench = Bench::new(settings, &World::Empty, "");
    assert!(bench.ask(&[0xA5, 0x50]).is_empty());
    bench.run(3 * ONE_SECOND);
    assert_eq!(only_reply(bench.ask(&[0xA5, 0x50])).len(), 27);
    assert!(bench.sent[0].bytes.len() == 64 && bench.sent[0].at > 2 * ONE_SECOND);
}

/// Returns a bench with a scanner that streams in mode number `mode` from the start.
fn streaming(model: Model, mode: usize, faults: &str) -> Bench {
    let settings = RplidarSettings {
        typical: mode,
        start: RplidarStart::Streaming,
        seed: 3,
        ..RplidarSettings::of(model)
    };
    Bench::new(settings, &World::Wall640, faults)
}

#[test]
fn records_the_line_fault_of_each_packet() {
    for (faults, name) in [
        ("loss=0.002,burst=2", "loss"),
        ("flip=0.002", "flip"),
        ("insert=0.002", "insert"),
        ("double=0.002", "double"),
        ("truncate=0.05", "truncated"),
        ("length=0.05", "length"),
        ("abort=0.05", "aborted"),
        ("flood=200,flood_every=0.3", "flood"),
        ("wall=200,wall_every=0.3", "wall"),
        ("silence=0.5,silence_at=1", "silence"),
        ("unplug=0.5,unplug_at=1", "unplug"),
        ("power_at=1", "power"),
    ] {
        let mut bench = streaming(Model::A1, 1, faults);
        bench.run(6 * ONE_SECOND);
        let hit = bench.sent.iter().filter(|sent| sent.fault == Some(name)).count();
        assert!(hit > 0, "{faults}");
        // Every packet without a fault is in the received bytes, whole and in order.
        let mut rest = &bench.received[..];
        for sent in bench.sent.iter().filter(|sent| sent.fault.is_none()) {
            let at = rest.windows(sent.bytes.len()).position(|window| window == sent.bytes);
            rest = &rest[at.unwrap_or_else(|| panic!("{faults}: an intact packet is missing"))..]
                [sent.bytes.len()..];
        }
    }
}

#[test]
fn stall_delays_bytes_without_loss() {
    let mut smooth = streaming(Model::S1, 2, "");
    let mut stalled = streaming(Model::S1, 2, "stall=0.5,stall_at=1");
    for bench in [&mut smooth, &mut stalled] {
        bench.run(3 * ONE_SECOND);
    }
    assert_eq!(smooth.data(), stalled.data());
    let held = |bench: &Bench| bench.sent.windows(2).map(|pair| pair[1].at - pair[0].at).max();
    assert!(held(&smooth) < Some(ONE_SECOND / 50) && held(&stalled) > Some(ONE_SECOND * 48 / 100));
}

#[test]
fn brown_out_sends_boot_message_during_a_stream() {
    let mut bench = streaming(Model::A1, 3, "brownout_at=1");
    bench.run(4 * ONE_SECOND);
    let boot_message = bench.sent.iter().position(|sent| sent.is_reply).expect("a boot message");
    assert!(
        boot_message > 50 && boot_message + 1 == bench.sent.len(),
        "the scanner sends nothing after that"
    );
    assert!(bench.sent[boot_message].bytes.starts_with(b"RP LIDAR"));
    // The motor has run all the time, so points follow soon.
    assert_eq!(bench.ask(&stream_request(3)).len(), 1);
    let sent = bench.sent.len();
    bench.run_for(ONE_SECOND);
    assert!(bench.sent.len() > sent + 50);
}

#[test]
fn points_after_a_power_cycle_need_a_running_motor() {
    let mut bench = streaming(Model::A1, 1, "");
    bench.run(ONE_SECOND);
    bench.cycle_power();
    // The scanner boots for two seconds, and accepts requests immediately afterwards. Its motor has run since power-on.
    bench.run(3 * ONE_SECOND + ONE_SECOND / 10);
    assert_eq!(bench.ask(&stream_request(1)).len(), 1);
    let before = bench.data().len();
    bench.run_for(ONE_SECOND);
    assert!(bench.data().len() > before);
    let mut bench = streaming(Model::A3, 1, "");
    bench.run(ONE_SECOND);
    bench.cycle_power();
    bench.run(4 * ONE_SECOND);
    bench.ask(&stream_request(1));
    let before = bench.data().len();
    bench.run_for(5 * ONE_SECOND);
    assert_eq!(bench.data().len(), before, "this motor was not started");
    assert_eq!(bench.unit.eeprom_writes(), 0);
}

#[test]
fn health_error_ends_stream_and_some_survive_reset() {
    for stubborn in [false, true] {
        let mut bench = streaming(Model::A2m8, 2, "");
        bench.run(ONE_SECOND);
        bench.unit.set_health(bench.now, (2, 0x8001), stubborn);
        let sent = bench.sent.len();
        bench.run_for(ONE_SECOND);
        assert!(bench.sent.len() <= sent + 1);
        let health = |bench: &mut Bench| bench.ask(&[0xA5, 0x52])[0][7..].to_vec();
        assert_eq!(health(&mut bench), [2, 0x01, 0x80]);
        assert!(bench.ask(&stream_request(2)).is_empty(), "it measures despite its error");
        bench.ask(&[0xA5, 0x40]);
        bench.run_for(ONE_SECOND);
        let (status, answers) = if stubborn { (2, 0) } else { (0, 1) };
        assert_eq!(health(&mut bench)[0], status);
        assert_eq!(bench.ask(&stream_request(2)).len(), answers);
    }
    let mut warned = RplidarSettings::of(Model::A1);
    warned.health = (1, 7);
    let mut bench = Bench::new(warned, &World::Empty, "");
    assert_eq!(bench.ask(&[0xA5, 0x52])[0][7..], [1, 7, 0]);
    assert_eq!(bench.ask(&stream_request(1)).len(), 1, "a warning is not an error");
}

#[test]
fn held_head_sends_no_points_and_spins_up_again() {
    let mut bench = streaming(Model::A1, 1, "hold=1,hold_at=2");
    bench.run(8 * ONE_SECOND);
    let gaps: Vec<_> =
        bench.sent.windows(2).filter(|pair| pair[1].at - pair[0].at > ONE_SECOND / 10).collect();
    assert_eq!(gaps.len(), 1);
    let (last, first) = (gaps[0][0].at, gaps[0][1].at);
    assert!(last < 2 * ONE_SECOND + ONE_SECOND / 20, "{last}");
    // The head is blocked from second 2 to second 3, and then needs 1.6 s to reach its speed.
    assert!((46 * ONE_SECOND / 10..47 * ONE_SECOND / 10).contains(&first), "{first}");
    let mut bench = streaming(Model::A1, 1, "hold=5,hold_at=1");
    bench.run(2 * ONE_SECOND);
    assert_eq!(bench.ask(&[0xA5, 0x52])[0][7], 2, "it does not report that its head is blocked");
}

#[test]
fn reply_quirks_change_the_number_of_replies() {
    let replies_with = |faults: &str| {
        let mut bench = Bench::new(RplidarSettings::of(Model::A1), &World::Empty, faults);
        (0..100).map(|_| bench.ask(&[0xA5, 0x52]).len()).sum::<usize>()
    };
    assert_eq!(
        (replies_with(""), replies_with("mute=1"), replies_with("twice=1"), replies_with("late=0.1")),
        (100, 0, 200, 95)
    );
    let some = replies_with("overlook=0.5");
    assert!((30..70).contains(&some), "{some}");
}
