//! How a scanner fails, and what the line does to its packets: each fault, with what the truth says of it.

use scanhub_sim::device::Device as _;
use scanhub_sim::rplidar::{Model, RplidarSettings, RplidarStart};
use scanhub_sim::world::World;

use super::bench::{Bench, SECOND, start};

/// A scanner that streams in its mode number `typical` from the start.
fn streaming(model: Model, typical: usize, faults: &str) -> Bench {
    let settings =
        RplidarSettings { typical, start: RplidarStart::Streaming, seed: 3, ..RplidarSettings::of(model) };
    Bench::new(settings, &World::Wall640, faults)
}

#[test]
fn what_the_line_does_to_a_packet_is_told_of_it() {
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
        bench.run(6 * SECOND);
        let hit = bench.sent.iter().filter(|sent| sent.fault == Some(name)).count();
        assert!(hit > 0, "{faults}");
        // What is said to be intact is on the line, whole and in order.
        let mut rest = &bench.line[..];
        for sent in bench.sent.iter().filter(|sent| sent.fault.is_none()) {
            let at = rest.windows(sent.bytes.len()).position(|window| window == sent.bytes);
            rest = &rest[at.unwrap_or_else(|| panic!("{faults}: an intact packet is not there"))..]
                [sent.bytes.len()..];
        }
    }
}

#[test]
fn a_stall_delays_and_loses_nothing() {
    let mut smooth = streaming(Model::S1, 2, "");
    let mut stalled = streaming(Model::S1, 2, "stall=0.5,stall_at=1");
    for bench in [&mut smooth, &mut stalled] {
        bench.run(3 * SECOND);
    }
    assert_eq!(smooth.data(), stalled.data());
    let held = |bench: &Bench| bench.sent.windows(2).map(|pair| pair[1].at - pair[0].at).max();
    assert!(held(&smooth) < Some(SECOND / 50) && held(&stalled) > Some(SECOND * 48 / 100));
}

#[test]
fn a_brown_out_puts_the_banner_in_the_midst_of_a_stream() {
    let mut bench = streaming(Model::A1, 3, "brownout_at=1");
    bench.run(4 * SECOND);
    let banner = bench.sent.iter().position(|sent| sent.is_reply).expect("a banner");
    assert!(banner > 50 && banner + 1 == bench.sent.len(), "it stays silent behind it");
    assert!(bench.sent[banner].bytes.starts_with(b"RP LIDAR"));
    // The motor has its power all the while.
    assert_eq!(bench.ask(&start(3)).len(), 1);
    let sent = bench.sent.len();
    bench.pass(SECOND);
    assert!(bench.sent.len() > sent + 50);
}

#[test]
fn after_a_power_cycle_the_motor_gets_up_to_speed_before_there_are_points() {
    let mut bench = streaming(Model::A1, 1, "");
    bench.run(SECOND);
    bench.cycle_power();
    // Two seconds of start-up; then it hears at once, and the motor turns since the power came.
    bench.run(3 * SECOND + SECOND / 10);
    assert_eq!(bench.ask(&start(1)).len(), 1);
    let before = bench.data().len();
    bench.pass(SECOND);
    assert!(bench.data().len() > before);
    let mut bench = streaming(Model::A3, 1, "");
    bench.run(SECOND);
    bench.cycle_power();
    bench.run(4 * SECOND);
    bench.ask(&start(1));
    let before = bench.data().len();
    bench.pass(5 * SECOND);
    assert_eq!(bench.data().len(), before, "nobody told this motor to turn");
    assert_eq!(bench.unit.eeprom_writes(), 0);
}

#[test]
fn an_error_ends_the_stream_and_only_some_go_away_with_a_reset() {
    for stubborn in [false, true] {
        let mut bench = streaming(Model::A2m8, 2, "");
        bench.run(SECOND);
        bench.unit.set_health(bench.now, (2, 0x8001), stubborn);
        let sent = bench.sent.len();
        bench.pass(SECOND);
        assert!(bench.sent.len() <= sent + 1);
        let health = |bench: &mut Bench| bench.ask(&[0xA5, 0x52])[0][7..].to_vec();
        assert_eq!(health(&mut bench), [2, 0x01, 0x80]);
        assert!(bench.ask(&start(2)).is_empty(), "it measures in spite of its error");
        bench.ask(&[0xA5, 0x40]);
        bench.pass(SECOND);
        let (status, answers) = if stubborn { (2, 0) } else { (0, 1) };
        assert_eq!(health(&mut bench)[0], status);
        assert_eq!(bench.ask(&start(2)).len(), answers);
    }
    let mut warned = RplidarSettings::of(Model::A1);
    warned.health = (1, 7);
    let mut bench = Bench::new(warned, &World::Empty, "");
    assert_eq!(bench.ask(&[0xA5, 0x52])[0][7..], [1, 7, 0]);
    assert_eq!(bench.ask(&start(1)).len(), 1, "a warning is no error");
}

#[test]
fn a_head_that_is_held_measures_nothing_and_gets_up_to_speed_again() {
    let mut bench = streaming(Model::A1, 1, "hold=1,hold_at=2");
    bench.run(8 * SECOND);
    let gaps: Vec<_> = bench.sent.windows(2).filter(|pair| pair[1].at - pair[0].at > SECOND / 10).collect();
    assert_eq!(gaps.len(), 1);
    let (last, first) = (gaps[0][0].at, gaps[0][1].at);
    assert!(last < 2 * SECOND + SECOND / 20, "{last}");
    // A second of standstill and 1.6 of getting up to speed.
    assert!((46 * SECOND / 10..47 * SECOND / 10).contains(&first), "{first}");
    let mut bench = streaming(Model::A1, 1, "hold=5,hold_at=1");
    bench.run(2 * SECOND);
    assert_eq!(bench.ask(&[0xA5, 0x52])[0][7], 2, "it does not say that its head is held");
}

#[test]
fn bad_habits_of_answering() {
    let asked = |faults: &str| {
        let mut bench = Bench::new(RplidarSettings::of(Model::A1), &World::Empty, faults);
        (0..100).map(|_| bench.ask(&[0xA5, 0x52]).len()).sum::<usize>()
    };
    assert_eq!((asked(""), asked("mute=1"), asked("twice=1"), asked("late=0.1")), (100, 0, 200, 95));
    let some = asked("overlook=0.5");
    assert!((30..70).contains(&some), "{some}");
}
