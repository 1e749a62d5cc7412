//! Tests of the start of a session with an RPLIDAR that may be in any state.

use scanhub_drivers::Settings;
use scanhub_drivers::line::{Action, Control, Event, Protocol as _, ScannerSession as _, State};
use scanhub_drivers::rplidar::packet::PacketFormat;
use scanhub_drivers::rplidar::{Health, Mode, Model, Problem, RplidarSession};
use scanhub_schema::MILLIS;

use super::{ONE_SECOND, SimulatedScanner, TestBench, descriptor_type};

pub(crate) fn settings_of(model: Model) -> Settings {
    Settings { model: Some(model.name()), ..Settings::default() }
}

fn is_streaming(bench: &TestBench) -> bool {
    bench.session.state() == State::Streaming
}

#[test]
fn every_model_streams_within_2_s_from_any_state() {
    for model in Model::ALL {
        for settings in [settings_of(model), Settings::default()] {
            for doing in 0..3 {
                let mut head = SimulatedScanner::new(model, 1);
                match doing {
                    1 => head.start_before(head.modes[head.modes.len() - 1].2, 0),
                    2 => head.start_before(PacketFormat::Standard, 0),
                    _ => {}
                }
                let mut bench = TestBench::new(settings, head);
                let elapsed = bench.run_until(3 * ONE_SECOND, is_streaming);
                assert_eq!((bench.session.model(), bench.session.problem()), (Some(model), None));
                assert_eq!(bench.session.beams(), Some(model.beams()), "{model:?}");
                assert!(!bench.scanner.dtr && bench.log.dtr == [false], "{:?}", bench.log.dtr);
                assert!(elapsed < 2 * ONE_SECOND, "{model:?} {doing}: {elapsed}");
            }
        }
    }
}

#[test]
fn finds_scanner_at_every_rate() {
    for (model, baud) in
        [(Model::A1, 115_200), (Model::S1, 256_000), (Model::C1, 460_800), (Model::S2, 1_000_000)]
    {
        for doing in [None, Some(PacketFormat::Standard)] {
            let mut head = SimulatedScanner::new(model, 1);
            doing.into_iter().for_each(|kind| head.start_before(kind, 0));
            let mut bench = TestBench::new(Settings::default(), head);
            let elapsed = bench.run_until(3 * ONE_SECOND, is_streaming);
            assert_eq!((bench.session.rate(), bench.session.problem()), (baud, None));
            assert!(elapsed < 2 * ONE_SECOND, "{baud}: {elapsed}");
        }
    }
}

#[test]
fn text_like_stream_is_not_taken_for_a_boot_message() {
    for kind in [PacketFormat::Standard, PacketFormat::Dense] {
        let mut head = SimulatedScanner::new(Model::S1, 1);
        head.start_before(kind, 0);
        head.is_text = true;
        let mut bench = TestBench::new(Settings::default(), head);
        let elapsed = bench.run_until(3 * ONE_SECOND, is_streaming);
        assert!(elapsed < 2 * ONE_SECOND, "{elapsed}");
        assert_eq!(bench.session.stats().restarts, 0);
    }
}

#[test]
fn fixed_rate_is_never_changed() {
    let settings = Settings { fixed_rate: true, ..settings_of(Model::S1) };
    let mut head = SimulatedScanner::new(Model::S1, 1);
    head.is_on = false;
    let mut bench = TestBench::new(settings, head);
    bench.run(5 * ONE_SECOND);
    assert!(bench.log.bauds.is_empty());
    let problem = bench.session.problem().expect("a problem");
    assert!(matches!(problem, Problem::NoResponse { baud: Some(256_000), seconds: 2.. }), "{problem}");
    bench.scanner.is_on = true;
    bench.run_until(3 * ONE_SECOND, is_streaming);
    assert_eq!(bench.session.problem(), None);
}

#[test]
fn restarts_abandoned_stream_within_500ms() {
    for model in Model::ALL {
        let kinds = SimulatedScanner::new(model, 1).modes.into_iter().map(|(.., kind)| kind);
        for kind in kinds {
            // The search tries the rate of the settings first.
            for first in [
                Settings::default(),
                settings_of(model),
                settings_of(Model::A3),
                settings_of(Model::C1),
                settings_of(Model::S3),
            ] {
                let mut head = SimulatedScanner::new(model, 1);
                head.start_before(kind, 0);
                head.fill_line(4_000);
                let mut bench = TestBench::new(first, head);
                bench.run_until(ONE_SECOND / 2, |bench| !bench.log.packets.is_empty());
                bench.run_until(3 * ONE_SECOND, is_streaming);
                assert_eq!(bench.session.rate(), model.baud());
            }
        }
    }
}

#[test]
fn repeats_an_ignored_stop_request() {
    for settings in [settings_of(Model::S2), Settings::default()] {
        let mut head = SimulatedScanner::new(Model::S2, 1);
        head.start_before(PacketFormat::Dense, 0);
        head.ignored_requests = vec![0x25];
        let mut bench = TestBench::new(settings, head);
        bench.run_until(ONE_SECOND, |bench| !bench.log.packets.is_empty());
    }
}

#[test]
fn unhealthy_scanner_is_reset_once() {
    for model in [Model::A1, Model::S2] {
        let mut head = SimulatedScanner::new(model, 1);
        head.health = (2, 0x8001);
        let mut bench = TestBench::new(Settings::default(), head);
        let elapsed = bench.run_until(3 * ONE_SECOND, is_streaming);
        assert_eq!((bench.session.problem(), bench.session.health()), (None, Some(Health::Good)));
        assert_eq!(bench.scanner.requests.iter().filter(|request| **request == 0x40).count(), 1, "{elapsed}");
        assert_eq!(bench.session.stats().restarts, 0, "the session requested it");
    }
}

#[test]
fn reports_health_error_and_retries_until_it_clears() {
    let mut head = SimulatedScanner::new(Model::A1, 1);
    (head.health, head.clears_on_reboot) = ((2, 0x8001), false);
    let mut bench = TestBench::new(settings_of(Model::A1), head);
    bench.run(9 * ONE_SECOND);
    let problem = bench.session.problem();
    assert_eq!(problem, Some(Problem::Unhealthy(Health::Error(0x8001))));
    assert!(problem.expect("a problem").to_string().contains("8001h"));
    assert_eq!(bench.scanner.requests.iter().filter(|request| **request == 0x40).count(), 1);
    assert!(!bench.scanner.is_measuring());
    bench.scanner.health = (1, 7);
    bench.run_until(3 * ONE_SECOND, is_streaming);
    // The scanner measures, and reports a warning that it may stop soon.
    let warning = Health::Warning(7);
    assert_eq!(
        (bench.session.problem(), bench.session.health()),
        (Some(Problem::Unhealthy(warning)), Some(warning))
    );
}

#[test]
fn pause_and_resume_control_the_motor_by_model() {
    for (model, request) in [(Model::A1, None), (Model::A2m8, Some(660)), (Model::S2, Some(600))] {
        let mut bench = TestBench::new(settings_of(model), SimulatedScanner::new(model, 1));
        bench.run_until(3 * ONE_SECOND, is_streaming);
        assert_eq!((bench.scanner.motor, bench.scanner.dtr), (request, false), "{model:?}");
        bench.session.control(Control::Pause, bench.now);
        bench.run(bench.now + ONE_SECOND);
        assert_eq!(bench.session.state(), State::Paused);
        assert_eq!(
            (bench.scanner.motor, bench.scanner.dtr),
            (request.map(|_| 0), model == Model::A1),
            "{model:?}"
        );
        assert!(!bench.scanner.is_measuring());
        let packets = bench.log.packets.len();
        bench.run(bench.now + ONE_SECOND);
        assert_eq!(bench.log.packets.len(), packets);
        bench.session.control(Control::Resume, bench.now);
        bench.run_until(3 * ONE_SECOND, is_streaming);
        assert_eq!((bench.scanner.motor, bench.scanner.dtr), (request, false), "{model:?}");
    }
}

#[test]
fn motor_stops_when_the_session_ends() {
    for (model, duty) in [(Model::A1, None), (Model::A2m8, Some(0)), (Model::S2, Some(0))] {
        let mut bench = TestBench::new(settings_of(model), SimulatedScanner::new(model, 1));
        bench.run_until(3 * ONE_SECOND, is_streaming);
        assert!(bench.session.end(bench.now));
        bench.run(bench.now + MILLIS);
        assert_eq!((bench.scanner.motor, bench.scanner.dtr), (duty, model == Model::A1), "{model:?}");
        assert!(!bench.scanner.is_measuring() && !bench.session.end(bench.now));
    }
}

#[test]
fn reports_mode_firmware_and_unexpected_model() {
    let details_and_unexpected_model = |settings, model| {
        let mut bench = TestBench::new(settings, SimulatedScanner::new(model, 1));
        bench.run_until(3 * ONE_SECOND, is_streaming);
        let mut kind = String::new();
        bench.session.write_details(&mut kind);
        (kind, bench.session.unexpected_model().map(|model| model.name))
    };
    assert_eq!(
        details_and_unexpected_model(Settings::default(), Model::A1),
        (" boost 1.29".to_owned(), None)
    );
    let standard = Settings { mode: Some(Mode::Standard.name()), ..settings_of(Model::A2m8) };
    assert_eq!(details_and_unexpected_model(standard, Model::A2m8), (" standard 1.29".to_owned(), None));
    assert_eq!(details_and_unexpected_model(settings_of(Model::A1), Model::A2m8).1, Some("a2m8"));
    // The longest text must fit into a status.
    let longest = Model::ALL.map(|model| model.name().len()).into_iter().max().expect("some");
    let mode = Model::ALL.iter().flat_map(|_| Mode::ALL).map(|mode| mode.name().len()).max().expect("some");
    assert!(longest + 1 + mode + " 1.29".len() <= 24);
}

#[test]
fn starts_although_one_reply_is_missing() {
    for request in [0x50, 0x52, 0x82, 0x84, 0xFF] {
        let mut head = SimulatedScanner::new(Model::A2m8, 1);
        head.ignored_requests = vec![request];
        let mut bench = TestBench::new(settings_of(Model::A2m8), head);
        bench.run_until(3 * ONE_SECOND, is_streaming);
        assert_eq!(
            (bench.scanner.motor, bench.scanner.kind()),
            (Some(660), Some(PacketFormat::Ultra)),
            "{request:02X}"
        );
    }
}

#[test]
fn reports_refused_start_until_it_is_resolved() {
    let mut head = SimulatedScanner::new(Model::A1, 1);
    head.ignored_requests = vec![0x82; 1_000];
    let mut bench = TestBench::new(Settings::default(), head);
    bench.run(3 * ONE_SECOND);
    assert_eq!(bench.session.problem(), Some(Problem::Refused));
    assert_eq!(bench.session.rate(), 115_200, "it answers at this one");
    bench.scanner.is_on = false;
    bench.run(8 * ONE_SECOND);
    let problem = bench.session.problem();
    assert!(matches!(problem, Some(Problem::NoResponse { .. })), "{problem:?}");
    (bench.scanner.is_on, bench.scanner.ignored_requests) = (true, Vec::new());
    bench.run_until(3 * ONE_SECOND, is_streaming);
    assert_eq!(bench.session.problem(), None);
}

#[test]
fn idle_motor_stops_only_if_configured() {
    for stop_when_idle in [false, true] {
        let settings = Settings { stop_when_idle, ..settings_of(Model::A1) };
        let mut bench = TestBench::new(settings, SimulatedScanner::new(Model::A1, 1));
        bench.run_until(3 * ONE_SECOND, is_streaming);
        bench.session.set_has_subscribers(bench.now, false);
        bench.run(bench.now + 2 * ONE_SECOND);
        assert_eq!(bench.session.state(), State::Streaming, "not at once");
        bench.run(bench.now + 5 * ONE_SECOND);
        assert_eq!(bench.scanner.is_measuring(), !stop_when_idle);
        assert_eq!(bench.scanner.dtr, stop_when_idle);
        bench.session.control(Control::Resume, bench.now);
        assert_eq!(bench.scanner.is_measuring(), !stop_when_idle);
        bench.session.set_has_subscribers(bench.now, true);
        bench.run_until(2 * ONE_SECOND, is_streaming);
        assert!(!bench.scanner.dtr);
    }
}

#[test]
fn uses_configured_mode_or_else_the_fastest() {
    let run = |model, mode: Option<Mode>| {
        let mut bench = TestBench::new(
            Settings { mode: mode.map(Mode::name), ..settings_of(model) },
            SimulatedScanner::new(model, 1),
        );
        bench.run_until(3 * ONE_SECOND, is_streaming);
        let us = 1e6 / bench.session.points_per_second().expect("known");
        (bench.scanner.kind().expect("measuring"), us.round(), bench.session.problem(), bench.session.beams())
    };
    assert_eq!(run(Model::A1, None), (PacketFormat::Ultra, 127.0, None, Some(1_079)));
    assert_eq!(run(Model::A1, Some(Mode::Express)), (PacketFormat::Express, 254.0, None, Some(539)));
    assert_eq!(run(Model::A1, Some(Mode::Standard)), (PacketFormat::Standard, 508.0, None, Some(270)));
    let lacking = Some(Problem::ModeUnavailable(Mode::DenseBoost));
    assert_eq!(run(Model::A1, Some(Mode::DenseBoost)), (PacketFormat::Ultra, 127.0, lacking, Some(1_079)));
    assert_eq!(run(Model::S3, None).0, PacketFormat::UltraDense);
}

#[test]
fn old_firmware_has_two_modes() {
    for (mode, kind) in [(None, PacketFormat::Express), (Some(Mode::Standard), PacketFormat::Standard)] {
        let mut head = SimulatedScanner::new(Model::A1, 1);
        head.is_old = true;
        let mut bench =
            TestBench::new(Settings { mode: mode.map(Mode::name), ..settings_of(Model::A1) }, head);
        bench.run_until(3 * ONE_SECOND, is_streaming);
        assert_eq!(bench.scanner.kind(), Some(kind));
    }
}

#[test]
fn discovered_scanner_has_the_beams_it_reports() {
    let found = Settings { max_beams: Some(3_240), is_found: true, ..Settings::default() };
    let family = Settings { max_beams: Some(2_048), ..Settings::default() };
    let beams = |model, is_old, settings| {
        let mut head = SimulatedScanner::new(model, 1);
        head.is_old = is_old;
        let mut bench = TestBench::new(settings, head);
        bench.run_until(3 * ONE_SECOND, is_streaming);
        bench.scanner.boot(bench.now);
        bench.run(bench.now + 3 * ONE_SECOND);
        let beams = bench.session.beams().expect("known");
        assert!(
            bench.log.revolutions.len() > 5
                && bench.log.revolutions.iter().all(|revolution| revolution.beams == beams)
        );
        beams
    };
    for model in Model::ALL {
        assert_eq!(beams(model, false, found), model.beams(), "{model:?}");
        assert_eq!(beams(model, false, family), model.beams().min(2_048), "{model:?}");
    }
    assert_eq!(beams(Model::A1, true, found), 539, "one point in 254 us, 7.3 revolutions per second");
    assert_eq!(beams(Model::A1, true, Settings { model: Some("a1"), ..found }), 1_079);
    assert_eq!(beams(Model::A1, true, Settings { beams: Some(360), ..found }), 360);
    assert_eq!(beams(Model::A1, true, family), 1_079);
}

#[test]
fn session_recovers_from_a_second_without_data() {
    let mut bench = TestBench::new(settings_of(Model::A1), SimulatedScanner::new(Model::A1, 1));
    bench.run(3 * ONE_SECOND);
    bench.scanner.is_on = false;
    bench.run(3 * ONE_SECOND + 1_050 * MILLIS);
    assert_eq!((bench.session.state(), bench.session.problem()), (State::Silent, Some(Problem::Silence)));
    bench.run(6 * ONE_SECOND);
    assert!(matches!(bench.session.problem(), Some(Problem::NoResponse { baud: None, .. })));
    bench.scanner.is_on = true;
    bench.scanner.boot(bench.now);
    bench.run_until(4 * ONE_SECOND, is_streaming);
    assert_eq!((bench.session.problem(), bench.session.stats().resyncs), (None, 1));
    assert_eq!(bench.session.stats().lost, 0, "silence is no loss on the line");
}

/// Returns a test bench whose scanner has announced its stream. The scanner's motor is not yet at its speed.
fn spinning_up(model: Model) -> TestBench {
    let mut bench = TestBench::new(
        Settings::default(),
        SimulatedScanner { spin_up: ONE_SECOND, ..SimulatedScanner::new(model, 1) },
    );
    bench.run_until(ONE_SECOND, |bench| bench.scanner.is_measuring());
    bench.run(bench.now + 20 * MILLIS);
    assert!(bench.session.model() == Some(model) && bench.log.packets.is_empty());
    bench
}

#[test]
fn identifies_a_scanner_streaming_during_spin_up() {
    // The earlier packets have another format, or the same format with another time per point.
    for (before, model) in [(Model::S1, Model::A3), (Model::A3, Model::S1), (Model::A1, Model::A2m8)] {
        let mut bench = spinning_up(before);
        bench.run(bench.now + 500 * MILLIS);
        let mut head = SimulatedScanner { spin_up: 300 * MILLIS, ..SimulatedScanner::new(model, 1) };
        let request = [0xA5, 0x82, 5, head.typical, 0, 0, 0, 0, 0xA5 ^ 0x82 ^ 5 ^ head.typical];
        request.into_iter().for_each(|byte| head.write(byte, model.baud(), bench.now));
        bench.scanner = head;
        bench.run_until(3 * ONE_SECOND, is_streaming);
        assert_eq!((bench.session.model(), bench.session.stats().resyncs), (Some(model), 1), "{before:?}");
        bench.run(bench.now + 3 * ONE_SECOND);
        let (worst, wrong) = bench.check_revolutions(&bench.log.revolutions);
        assert!(
            bench.log.revolutions.len() > 20 && worst < 2 * MILLIS && wrong == 0,
            "{before:?}: {worst} {wrong}"
        );
    }
}

#[test]
fn accepts_a_repeated_stream_descriptor() {
    let mut bench = spinning_up(Model::A1);
    let kind = bench.scanner.kind().expect("measuring");
    bench.scanner.reply(descriptor_type(kind), 0x40, &[kind.byte_len() as u8], bench.now + 70 * MILLIS);
    bench.run_until(3 * ONE_SECOND, is_streaming);
    assert_eq!(bench.session.stats().resyncs, 0);
}

#[test]
fn power_on_with_the_session_is_not_a_restart() {
    for model in [Model::A1, Model::S2] {
        for settings in [settings_of(model), Settings::default()] {
            let mut head = SimulatedScanner::new(model, 1);
            head.boot(0);
            let mut bench = TestBench::new(settings, head);
            bench.run_until(4 * ONE_SECOND, is_streaming);
            assert_eq!(bench.session.stats().restarts, 0, "{model:?}");
        }
    }
}

#[test]
fn replugged_cable_is_not_a_restart() {
    let mut bench = TestBench::new(settings_of(Model::A1), SimulatedScanner::new(Model::A1, 1));
    bench.run(3 * ONE_SECOND);
    bench.scanner.is_on = false;
    bench.run(6 * ONE_SECOND);
    bench.scanner.is_on = true;
    bench.run_until(4 * ONE_SECOND, is_streaming);
    assert_eq!(bench.session.stats().restarts, 0);
}

#[test]
fn boot_message_during_a_stream_restarts_at_once() {
    for model in [Model::A1, Model::A3, Model::S2, Model::S3] {
        for mode in [None, Some(Mode::Standard)] {
            let mut bench = TestBench::new(
                Settings { mode: mode.map(Mode::name), ..settings_of(model) },
                SimulatedScanner::new(model, 1),
            );
            bench.run(3 * ONE_SECOND);
            bench.scanner.boot(bench.now);
            let elapsed = bench.run_until(1_500 * MILLIS, |bench| bench.session.stats().resyncs > 0);
            assert!((671 * MILLIS..700 * MILLIS).contains(&elapsed), "{model:?} {mode:?}: {elapsed}");
            bench.run_until(ONE_SECOND, is_streaming);
            assert_eq!((bench.session.stats().resyncs, bench.session.problem()), (1, None));
            assert_eq!(bench.session.stats().restarts, 1, "{model:?} {mode:?}");
        }
    }
}

#[test]
fn boot_message_after_other_bytes_is_a_restart() {
    // A dip of the supply makes the scanner send other bytes first. Some of these bytes are text.
    let junk = [vec![0x00; 1], vec![0xFF, 0x00, 0x80], vec![0xA5; 300], vec![b'x'; 45], vec![0xF0; 2_000]];
    for (model, junk) in
        [Model::A1, Model::S2].into_iter().flat_map(|model| junk.each_ref().map(|it| (model, it)))
    {
        let mut bench = TestBench::new(settings_of(model), SimulatedScanner::new(model, 1));
        bench.run(3 * ONE_SECOND);
        bench.scanner.junk.clone_from(junk);
        bench.scanner.boot(bench.now);
        bench.run_until(4 * ONE_SECOND, |bench| bench.session.stats().restarts > 0);
        bench.run_until(4 * ONE_SECOND, is_streaming);
        assert_eq!(bench.session.stats().restarts, 1, "{model:?} after {} bytes", junk.len());
    }
}

#[test]
fn text_like_ranges_are_no_boot_message() {
    // The framer accepts a packet of one point only if another point follows it, so it also discards the 5 bytes of the
    // point before the text.
    for (mode, lost) in [(Mode::Standard, 65), (Mode::DenseBoost, 60)] {
        let mut bench = TestBench::new(
            Settings { mode: Some(mode.name()), ..settings_of(Model::S2) },
            SimulatedScanner::new(Model::S2, 1),
        );
        bench.run(3 * ONE_SECOND);
        for _ in 0..20 {
            bench.scanner.send_rest_as_text(bench.now);
            bench.run(bench.now + 33 * MILLIS);
        }
        let stats = bench.session.stats();
        assert_eq!((stats.resyncs, stats.damaged), (0, 20 * lost), "{mode:?}");
        assert_eq!(stats.restarts, 0, "{mode:?}");
    }
}

#[test]
fn sends_only_requests_without_permanent_effect() {
    for model in Model::ALL {
        let mut bench = TestBench::new(Settings::default(), SimulatedScanner::new(model, 1));
        bench.run(3 * ONE_SECOND);
        bench.session.control(Control::Resync, bench.now);
        bench.run(6 * ONE_SECOND);
        let known = [0x25, 0x20, 0x50, 0x52, 0x82, 0x84, 0xA8, 0xF0, 0xFF];
        assert!(
            bench.scanner.requests.iter().all(|request| known.contains(request)),
            "{:02X?}",
            bench.scanner.requests
        );
    }
}

#[test]
fn reads_recording_without_sending_requests() {
    for (model, mode) in
        [(Model::A1, Mode::Express), (Model::S2, Mode::DenseBoost), (Model::A1, Mode::Standard)]
    {
        let mut live = TestBench::new(
            Settings { mode: Some(mode.name()), ..settings_of(model) },
            SimulatedScanner::new(model, 1),
        );
        live.run(4 * ONE_SECOND);
        let bytes = live.log.packets.concat();
        let settings =
            Settings { mode: Some(mode.name()), fixed_rate: true, listen_only: true, ..settings_of(model) };
        let mut session = RplidarSession::new(settings, 0);
        let per_second = bytes.len() / 3;
        let (mut now, mut count) = (0, 0);
        for piece in bytes.chunks(per_second / 100) {
            now += 10 * MILLIS;
            let mut rest = piece;
            while !rest.is_empty() {
                let len = rest.len().min(session.read_buffer().len());
                session.read_buffer()[..len].copy_from_slice(&rest[..len]);
                session.commit(now, len);
                rest = &rest[len..];
                loop {
                    match session.poll_action() {
                        Action::Event(Event::Scan(_)) => count += 1,
                        Action::Event(_) => {}
                        Action::SleepUntil(_) | Action::Wait { .. } => break,
                        output => panic!("{output:?}"),
                    }
                }
            }
        }
        assert!(count > 8, "{model:?} {mode:?}: {count}");
        assert_eq!(session.stats().discarded, 0);
    }
}
