//! What is answered to each request, and what follows from it: streams, the motor, a new start.

use scanhub_schema::MILLIS;
use scanhub_sim::device::Device as _;
use scanhub_sim::rplidar::{Form, Model, RplidarSettings, RplidarStart};
use scanhub_sim::world::World;

use super::bench::{Bench, SECOND, start, with_payload};

fn bench(model: Model) -> Bench {
    Bench::new(RplidarSettings::of(model), &World::Empty, "")
}

/// What a request of one answer is answered with.
fn one(mut replies: Vec<Vec<u8>>) -> Vec<u8> {
    assert_eq!(replies.len(), 1, "{replies:02X?}");
    replies.pop().expect("one")
}

#[test]
fn every_request_is_answered_byte_for_byte() {
    let mut bench = bench(Model::A1);
    let info = one(bench.ask(&[0xA5, 0x50]));
    // Model 18h, firmware 1.29, hardware 5, and sixteen bytes that are another scanner's only with another seed.
    assert_eq!(info[..11], [0xA5, 0x5A, 0x14, 0, 0, 0, 0x04, 0x18, 29, 1, 5]);
    assert_eq!(info.len(), 7 + 20);
    assert_eq!(one(bench.ask(&[0xA5, 0x52])), [0xA5, 0x5A, 3, 0, 0, 0, 0x06, 0, 0, 0]);
    let rates = [508u16.to_le_bytes(), 254u16.to_le_bytes()].concat();
    assert_eq!(one(bench.ask(&[0xA5, 0x59])), [&[0xA5, 0x5A, 4, 0, 0, 0, 0x15], &rates[..]].concat());
    let conf = |key: u8, value: &[u8]| {
        [&[0xA5, 0x5A, 4 + value.len() as u8, 0, 0, 0, 0x20, key, 0, 0, 0], value].concat()
    };
    assert_eq!(one(bench.configuration(0x70, 0)), conf(0x70, &[5, 0]));
    assert_eq!(one(bench.configuration(0x71, 1)), conf(0x71, &(254u32 << 8).to_le_bytes()));
    assert_eq!(one(bench.configuration(0x74, 1)), conf(0x74, &(12u32 << 8).to_le_bytes()));
    assert_eq!(one(bench.configuration(0x75, 2)), conf(0x75, &[0x84]));
    assert_eq!(one(bench.configuration(0x7C, 0)), conf(0x7C, &[3, 0]));
    assert_eq!(one(bench.configuration(0x7F, 4)), conf(0x7F, b"Stability\0"));
    // The vendor's driver sends 32 more bytes behind the key.
    let mut long = vec![0x7F, 0, 0, 0];
    long.extend([0; 32]);
    assert_eq!(one(bench.ask(&with_payload(0x84, &long))), conf(0x7F, b"Standard\0"));
    // A mode and a key that it has not, a command that nobody knows, and STOP are not answered.
    for request in [
        with_payload(0x84, &[0x75, 0, 0, 0, 5, 0]),
        with_payload(0x84, &[0x79, 0, 0, 0]),
        vec![0xA5, 0x33],
        vec![0xA5, 0x25],
        start(7),
    ] {
        assert_eq!(bench.ask(&request), Vec::<Vec<u8>>::new(), "{request:02X?}");
    }
    assert_eq!(bench.unit.eeprom_writes(), 0);
    let set = [0x00, 0xCC, 0x01, 0x00, 1, 2, 3, 4];
    let answer = one(bench.ask(&with_payload(0x85, &set)));
    assert_eq!(answer, [0xA5, 0x5A, 8, 0, 0, 0, 0x21, 0x00, 0xCC, 0x01, 0x00, 0, 0, 0, 0]);
    assert_eq!(bench.unit.eeprom_writes(), 1, "a value that stays was set, and nobody counted it");
}

#[test]
fn every_mode_begins_with_its_descriptor_and_any_request_ends_it() {
    for model in Model::ALL {
        for (number, mode) in model.modes().iter().enumerate() {
            let mut bench = bench(model);
            bench.ask(&with_payload(0xF0, &660u16.to_le_bytes()));
            bench.pass(2 * SECOND);
            let descriptor = one(bench.ask(&start(number)));
            let [low, high] = (mode.form.packet_len() as u16).to_le_bytes();
            assert_eq!(descriptor, [0xA5, 0x5A, low, high, 0, 0x40, mode.form.answer()]);
            bench.pass(SECOND / 2);
            let packets = bench.data();
            assert!(
                packets.iter().all(|packet| packet.len() == mode.form.packet_len()) && packets.len() > 10
            );
            if mode.form != Form::Standard {
                // Only the first of a stream has the flag of a beginning.
                let at = if mode.form == Form::UltraDense { 9 } else { 3 };
                let begins: Vec<_> = packets.iter().map(|packet| packet[at] & 0x80 != 0).collect();
                assert!(begins[0] && begins[1..].iter().all(|begins| !begins), "{mode:?}");
            }
            for request in [vec![0xA5, 0x25], vec![0xA5, 0x50], vec![0xA5, 0x52]] {
                bench.ask(&start(number));
                bench.pass(SECOND / 5);
                assert!(bench.unit.streams());
                bench.ask(&request);
                let sent = bench.sent.len();
                bench.pass(SECOND);
                assert_eq!((bench.sent.len(), bench.unit.streams()), (sent, false), "{request:02X?}");
            }
        }
    }
}

#[test]
fn a_motor_is_steered_as_its_model_wants() {
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
            _ => assert_eq!(one(board), answer(u8::from(model == Model::A3))),
        }
        let flows = |bench: &mut Bench| {
            let sent = bench.sent.len();
            bench.pass(SECOND);
            bench.sent.len() > sent
        };
        // The descriptor comes at once, points when the motor is at speed.
        assert_eq!(bench.ask(&start(1)).len(), 1);
        assert_eq!(flows(&mut bench), turns, "{model:?}");
        if stop.is_empty() {
            continue;
        }
        bench.ask(&go);
        bench.pass(SECOND);
        assert!(flows(&mut bench), "{model:?}");
        bench.ask(&stop);
        assert!(!flows(&mut bench), "{model:?}");
        // FORCE does not wait for the motor: every point is of the same direction.
        bench.ask(&[0xA5, 0x21]);
        assert!(flows(&mut bench), "{model:?}");
        let angles: Vec<f64> =
            (0..100).map(|k| bench.unit.truth(k).expect("it streams").clockwise_deg).collect();
        assert!(angles.iter().all(|angle| *angle == angles[0]));
    }
}

#[test]
fn after_a_reset_comes_the_banner_and_then_it_hears() {
    let mut bench = bench(Model::A1);
    bench.ask(&start(1));
    bench.pass(SECOND);
    let asked = bench.now;
    assert!(bench.ask(&[0xA5, 0x40]).is_empty());
    // It is busy with itself.
    assert!(bench.ask(&[0xA5, 0x50]).is_empty());
    bench.pass(SECOND);
    let banner = bench.sent.last().expect("a banner").clone();
    assert!(banner.is_reply && banner.bytes.len() == 64 && banner.bytes.is_ascii());
    let text = String::from_utf8(banner.bytes).expect("ascii");
    assert!(text.starts_with("RP LIDAR System.\r\nFirmware Ver 1.29, HW Ver 5\r\n"), "{text}");
    let took = banner.at - asked;
    assert!((671 * MILLIS..680 * MILLIS).contains(&took), "{took}");
    assert!(!bench.unit.streams());
    assert_eq!(one(bench.ask(&[0xA5, 0x50])).len(), 27);
    let settings = RplidarSettings { start: RplidarStart::PowerOn, ..RplidarSettings::of(Model::A1) };
    let mut bench = Bench::new(settings, &World::Empty, "");
    assert!(bench.ask(&[0xA5, 0x50]).is_empty());
    bench.run(3 * SECOND);
    assert_eq!(one(bench.ask(&[0xA5, 0x50])).len(), 27);
    assert!(bench.sent[0].bytes.len() == 64 && bench.sent[0].at > 2 * SECOND);
}
