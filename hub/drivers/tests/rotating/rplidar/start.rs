//! The start of a session with a Slamtec scanner, whatever the scanner was doing before.

use scanhub_drivers::Settings;
use scanhub_drivers::line::{Control, Event, Output, Protocol as _, Session as _, State};
use scanhub_drivers::rplidar::packet::Kind;
use scanhub_drivers::rplidar::{Health, Mode, Model, Session, Trouble};
use scanhub_schema::MILLIS;

use super::{Bench, Head, SECOND, answer_of};

pub(crate) fn of(model: Model) -> Settings {
    Settings { model: Some(model.name()), ..Settings::default() }
}

fn is_streaming(bench: &Bench) -> bool {
    bench.session.state() == State::Streaming
}

#[test]
fn every_model_streams_within_three_seconds_whatever_it_was_doing() {
    for model in Model::ALL {
        for settings in [of(model), Settings::default()] {
            for doing in 0..3 {
                let mut head = Head::new(model, 1);
                match doing {
                    1 => head.left_in(head.modes[head.modes.len() - 1].2, 0),
                    2 => head.left_in(Kind::Standard, 0),
                    _ => {}
                }
                let mut bench = Bench::new(settings, head);
                let took = bench.until(3 * SECOND, is_streaming);
                assert_eq!((bench.session.model(), bench.session.trouble()), (Some(model), None));
                assert_eq!(bench.session.beams(), Some(model.beams()), "{model:?}");
                assert!(!bench.head.dtr && bench.log.dtr == [false], "{:?}", bench.log.dtr);
                assert!(took < 2 * SECOND, "{model:?} {doing}: {took}");
            }
        }
    }
}

#[test]
fn every_rate_is_sought() {
    for (model, baud) in
        [(Model::A1, 115_200), (Model::S1, 256_000), (Model::C1, 460_800), (Model::S2, 1_000_000)]
    {
        for doing in [None, Some(Kind::Standard)] {
            let mut head = Head::new(model, 1);
            doing.into_iter().for_each(|kind| head.left_in(kind, 0));
            let mut bench = Bench::new(Settings::default(), head);
            let took = bench.until(3 * SECOND, is_streaming);
            assert_eq!((bench.session.rate(), bench.session.trouble()), (baud, None));
            assert!(took < 2 * SECOND, "{baud}: {took}");
        }
    }
}

#[test]
fn a_stream_that_is_text_at_another_rate_is_no_greeting_again_and_again() {
    for kind in [Kind::Standard, Kind::Dense] {
        let mut head = Head::new(Model::S1, 1);
        head.left_in(kind, 0);
        head.is_text = true;
        let mut bench = Bench::new(Settings::default(), head);
        let took = bench.until(3 * SECOND, is_streaming);
        assert!(took < 2 * SECOND, "{took}");
        assert_eq!(bench.session.account().restarts, 0);
    }
}

#[test]
fn where_the_rate_is_fixed_it_stays() {
    let settings = Settings { fixed_rate: true, ..of(Model::S1) };
    let mut head = Head::new(Model::S1, 1);
    head.is_on = false;
    let mut bench = Bench::new(settings, head);
    bench.run(5 * SECOND);
    assert!(bench.log.bauds.is_empty());
    let told = bench.session.trouble().expect("told");
    assert!(matches!(told, Trouble::NoAnswer { baud: Some(256_000), seconds: 2.. }), "{told}");
    bench.head.is_on = true;
    bench.until(3 * SECOND, is_streaming);
    assert_eq!(bench.session.trouble(), None);
}

#[test]
fn a_stream_that_somebody_left_streams_again_in_half_a_second_at_whatever_rate() {
    for model in Model::ALL {
        let kinds = Head::new(model, 1).modes.into_iter().map(|(.., kind)| kind);
        for kind in kinds {
            // The rate of the first is tried first.
            for first in [Settings::default(), of(model), of(Model::A3), of(Model::C1), of(Model::S3)] {
                let mut head = Head::new(model, 1);
                head.left_in(kind, 0);
                head.line_is_full(4_000);
                let mut bench = Bench::new(first, head);
                bench.until(SECOND / 2, |bench| !bench.log.packets.is_empty());
                bench.until(3 * SECOND, is_streaming);
                assert_eq!(bench.session.rate(), model.baud());
            }
        }
    }
}

#[test]
fn one_that_does_not_hear_that_it_shall_stop_is_told_again() {
    for settings in [of(Model::S2), Settings::default()] {
        let mut head = Head::new(Model::S2, 1);
        head.left_in(Kind::Dense, 0);
        head.deaf_to = vec![0x25];
        let mut bench = Bench::new(settings, head);
        bench.until(SECOND, |bench| !bench.log.packets.is_empty());
    }
}

#[test]
fn a_scanner_that_is_not_well_is_booted_once() {
    for model in [Model::A1, Model::S2] {
        let mut head = Head::new(model, 1);
        head.health = (2, 0x8001);
        let mut bench = Bench::new(Settings::default(), head);
        let took = bench.until(3 * SECOND, is_streaming);
        assert_eq!((bench.session.trouble(), bench.session.health()), (None, Some(Health::Good)));
        assert_eq!(bench.head.requests.iter().filter(|request| **request == 0x40).count(), 1, "{took}");
        assert_eq!(bench.session.account().restarts, 0, "the session requested it");
    }
}

#[test]
fn one_that_stays_unwell_is_told_in_words_and_asked_again() {
    let mut head = Head::new(Model::A1, 1);
    (head.health, head.heals) = ((2, 0x8001), false);
    let mut bench = Bench::new(of(Model::A1), head);
    bench.run(9 * SECOND);
    let told = bench.session.trouble();
    assert_eq!(told, Some(Trouble::Unwell(Health::Error(0x8001))));
    assert!(told.expect("told").to_string().contains("8001h"));
    assert_eq!(bench.head.requests.iter().filter(|request| **request == 0x40).count(), 1);
    assert!(!bench.head.is_measuring());
    bench.head.health = (1, 7);
    bench.until(3 * SECOND, is_streaming);
    // It measures, and says that it may not for long.
    let warning = Health::Warning(7);
    assert_eq!(
        (bench.session.trouble(), bench.session.health()),
        (Some(Trouble::Unwell(warning)), Some(warning))
    );
}

#[test]
fn a_motor_obeys_what_its_model_obeys() {
    for (model, request) in [(Model::A1, None), (Model::A2m8, Some(660)), (Model::S2, Some(600))] {
        let mut bench = Bench::new(of(model), Head::new(model, 1));
        bench.until(3 * SECOND, is_streaming);
        assert_eq!((bench.head.motor, bench.head.dtr), (request, false), "{model:?}");
        bench.session.control(Control::Pause, bench.now);
        bench.run(bench.now + SECOND);
        assert_eq!(bench.session.state(), State::Paused);
        assert_eq!((bench.head.motor, bench.head.dtr), (request.map(|_| 0), model == Model::A1), "{model:?}");
        assert!(!bench.head.is_measuring());
        let packets = bench.log.packets.len();
        bench.run(bench.now + SECOND);
        assert_eq!(bench.log.packets.len(), packets);
        bench.session.control(Control::Resume, bench.now);
        bench.until(3 * SECOND, is_streaming);
        assert_eq!((bench.head.motor, bench.head.dtr), (request, false), "{model:?}");
    }
}

#[test]
fn the_motor_rests_when_the_hub_ends() {
    for (model, duty) in [(Model::A1, None), (Model::A2m8, Some(0)), (Model::S2, Some(0))] {
        let mut bench = Bench::new(of(model), Head::new(model, 1));
        bench.until(3 * SECOND, is_streaming);
        assert!(bench.session.end(bench.now));
        bench.run(bench.now + MILLIS);
        assert_eq!((bench.head.motor, bench.head.dtr), (duty, model == Model::A1), "{model:?}");
        assert!(!bench.head.is_measuring() && !bench.session.end(bench.now));
    }
}

#[test]
fn what_it_is_is_told_also_where_something_else_was_expected() {
    let told = |settings, model| {
        let mut bench = Bench::new(settings, Head::new(model, 1));
        bench.until(3 * SECOND, is_streaming);
        let mut kind = String::new();
        bench.session.write_details(&mut kind);
        (kind, bench.session.other_model().map(|model| model.name))
    };
    assert_eq!(told(Settings::default(), Model::A1), (" boost 1.29".to_owned(), None));
    let standard = Settings { mode: Some(Mode::Standard.name()), ..of(Model::A2m8) };
    assert_eq!(told(standard, Model::A2m8), (" standard 1.29".to_owned(), None));
    assert_eq!(told(of(Model::A1), Model::A2m8).1, Some("a2m8"));
    // As long as a status has room for it.
    let longest = Model::ALL.map(|model| model.name().len()).into_iter().max().expect("some");
    let mode = Model::ALL.iter().flat_map(|_| Mode::ALL).map(|mode| mode.name().len()).max().expect("some");
    assert!(longest + 1 + mode + " 1.29".len() <= 24);
}

#[test]
fn one_answer_may_be_missing() {
    for request in [0x50, 0x52, 0x82, 0x84, 0xFF] {
        let mut head = Head::new(Model::A2m8, 1);
        head.deaf_to = vec![request];
        let mut bench = Bench::new(of(Model::A2m8), head);
        bench.until(3 * SECOND, is_streaming);
        assert_eq!((bench.head.motor, bench.head.kind()), (Some(660), Some(Kind::Ultra)), "{request:02X}");
    }
}

#[test]
fn one_that_does_not_begin_to_measure_is_told_as_long_as_that_is_so() {
    let mut head = Head::new(Model::A1, 1);
    head.deaf_to = vec![0x82; 1_000];
    let mut bench = Bench::new(Settings::default(), head);
    bench.run(3 * SECOND);
    assert_eq!(bench.session.trouble(), Some(Trouble::Refused));
    assert_eq!(bench.session.rate(), 115_200, "it answers at this one");
    bench.head.is_on = false;
    bench.run(8 * SECOND);
    let told = bench.session.trouble();
    assert!(matches!(told, Some(Trouble::NoAnswer { .. })), "{told:?}");
    (bench.head.is_on, bench.head.deaf_to) = (true, Vec::new());
    bench.until(3 * SECOND, is_streaming);
    assert_eq!(bench.session.trouble(), None);
}

#[test]
fn the_motor_rests_while_nobody_follows_if_it_shall() {
    for stop_when_idle in [false, true] {
        let settings = Settings { stop_when_idle, ..of(Model::A1) };
        let mut bench = Bench::new(settings, Head::new(Model::A1, 1));
        bench.until(3 * SECOND, is_streaming);
        bench.session.set_has_subscribers(bench.now, false);
        bench.run(bench.now + 2 * SECOND);
        assert_eq!(bench.session.state(), State::Streaming, "not at once");
        bench.run(bench.now + 5 * SECOND);
        assert_eq!(bench.head.is_measuring(), !stop_when_idle);
        assert_eq!(bench.head.dtr, stop_when_idle);
        bench.session.control(Control::Resume, bench.now);
        assert_eq!(bench.head.is_measuring(), !stop_when_idle);
        bench.session.set_has_subscribers(bench.now, true);
        bench.until(2 * SECOND, is_streaming);
        assert!(!bench.head.dtr);
    }
}

#[test]
fn the_fastest_mode_or_the_wanted_one() {
    let run = |model, mode: Option<Mode>| {
        let mut bench = Bench::new(Settings { mode: mode.map(Mode::name), ..of(model) }, Head::new(model, 1));
        bench.until(3 * SECOND, is_streaming);
        let us = 1e6 / bench.session.points_per_second().expect("known");
        (bench.head.kind().expect("measuring"), us.round(), bench.session.trouble(), bench.session.beams())
    };
    assert_eq!(run(Model::A1, None), (Kind::Ultra, 127.0, None, Some(1_079)));
    assert_eq!(run(Model::A1, Some(Mode::Express)), (Kind::Express, 254.0, None, Some(539)));
    assert_eq!(run(Model::A1, Some(Mode::Standard)), (Kind::Standard, 508.0, None, Some(270)));
    let lacking = Some(Trouble::NoMode(Mode::DenseBoost));
    assert_eq!(run(Model::A1, Some(Mode::DenseBoost)), (Kind::Ultra, 127.0, lacking, Some(1_079)));
    assert_eq!(run(Model::S3, None).0, Kind::UltraDense);
}

#[test]
fn old_firmware_has_two_modes() {
    for (mode, kind) in [(None, Kind::Express), (Some(Mode::Standard), Kind::Standard)] {
        let mut head = Head::new(Model::A1, 1);
        head.is_old = true;
        let mut bench = Bench::new(Settings { mode: mode.map(Mode::name), ..of(Model::A1) }, head);
        bench.until(3 * SECOND, is_streaming);
        assert_eq!(bench.head.kind(), Some(kind));
    }
}

#[test]
fn a_scanner_that_a_search_has_found_has_the_beams_that_it_reports() {
    let found = Settings { max_beams: Some(3_240), is_found: true, ..Settings::default() };
    let family = Settings { max_beams: Some(2_048), ..Settings::default() };
    let beams = |model, is_old, settings| {
        let mut head = Head::new(model, 1);
        head.is_old = is_old;
        let mut bench = Bench::new(settings, head);
        bench.until(3 * SECOND, is_streaming);
        bench.head.boot(bench.now);
        bench.run(bench.now + 3 * SECOND);
        let beams = bench.session.beams().expect("known");
        assert!(bench.log.turns.len() > 5 && bench.log.turns.iter().all(|turn| turn.beams == beams));
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
fn a_second_without_data_begins_again() {
    let mut bench = Bench::new(of(Model::A1), Head::new(Model::A1, 1));
    bench.run(3 * SECOND);
    bench.head.is_on = false;
    bench.run(3 * SECOND + 1_050 * MILLIS);
    assert_eq!((bench.session.state(), bench.session.trouble()), (State::Silent, Some(Trouble::Silence)));
    bench.run(6 * SECOND);
    assert!(matches!(bench.session.trouble(), Some(Trouble::NoAnswer { baud: None, .. })));
    bench.head.is_on = true;
    bench.head.boot(bench.now);
    bench.until(4 * SECOND, is_streaming);
    assert_eq!((bench.session.trouble(), bench.session.account().resyncs), (None, 1));
    assert_eq!(bench.session.account().lost, 0, "silence is no loss on the line");
}

/// Returns a bench with a scanner that has announced its stream and spins up.
fn spinning_up(model: Model) -> Bench {
    let mut bench = Bench::new(Settings::default(), Head { spin_up: SECOND, ..Head::new(model, 1) });
    bench.until(SECOND, |bench| bench.head.is_measuring());
    bench.run(bench.now + 20 * MILLIS);
    assert!(bench.session.model() == Some(model) && bench.log.packets.is_empty());
    bench
}

#[test]
fn identifies_a_scanner_that_streams_during_the_spin_up() {
    // Packets of another kind, and packets of the same kind with another time per point.
    for (before, model) in [(Model::S1, Model::A3), (Model::A3, Model::S1), (Model::A1, Model::A2m8)] {
        let mut bench = spinning_up(before);
        bench.run(bench.now + 500 * MILLIS);
        let mut head = Head { spin_up: 300 * MILLIS, ..Head::new(model, 1) };
        let request = [0xA5, 0x82, 5, head.typical, 0, 0, 0, 0, 0xA5 ^ 0x82 ^ 5 ^ head.typical];
        request.into_iter().for_each(|byte| head.write(byte, model.baud(), bench.now));
        bench.head = head;
        bench.until(3 * SECOND, is_streaming);
        assert_eq!((bench.session.model(), bench.session.account().resyncs), (Some(model), 1), "{before:?}");
        bench.run(bench.now + 3 * SECOND);
        let (worst, wrong) = bench.judge(&bench.log.turns);
        assert!(
            bench.log.turns.len() > 20 && worst < 2 * MILLIS && wrong == 0,
            "{before:?}: {worst} {wrong}"
        );
    }
}

#[test]
fn accepts_a_stream_that_is_announced_twice() {
    let mut bench = spinning_up(Model::A1);
    let kind = bench.head.kind().expect("measuring");
    bench.head.answer(answer_of(kind), 0x40, &[kind.bytes() as u8], bench.now + 70 * MILLIS);
    bench.until(3 * SECOND, is_streaming);
    assert_eq!(bench.session.account().resyncs, 0);
}

#[test]
fn a_scanner_that_starts_with_the_session_has_not_restarted() {
    for model in [Model::A1, Model::S2] {
        for settings in [of(model), Settings::default()] {
            let mut head = Head::new(model, 1);
            head.boot(0);
            let mut bench = Bench::new(settings, head);
            bench.until(4 * SECOND, is_streaming);
            assert_eq!(bench.session.account().restarts, 0, "{model:?}");
        }
    }
}

#[test]
fn a_cable_that_is_plugged_in_again_is_not_a_restart() {
    let mut bench = Bench::new(of(Model::A1), Head::new(Model::A1, 1));
    bench.run(3 * SECOND);
    bench.head.is_on = false;
    bench.run(6 * SECOND);
    bench.head.is_on = true;
    bench.until(4 * SECOND, is_streaming);
    assert_eq!(bench.session.account().restarts, 0);
}

#[test]
fn a_greeting_in_the_midst_of_a_stream_begins_again_at_once() {
    for model in [Model::A1, Model::A3, Model::S2, Model::S3] {
        for mode in [None, Some(Mode::Standard)] {
            let mut bench =
                Bench::new(Settings { mode: mode.map(Mode::name), ..of(model) }, Head::new(model, 1));
            bench.run(3 * SECOND);
            bench.head.boot(bench.now);
            let took = bench.until(1_500 * MILLIS, |bench| bench.session.account().resyncs > 0);
            assert!((671 * MILLIS..700 * MILLIS).contains(&took), "{model:?} {mode:?}: {took}");
            bench.until(SECOND, is_streaming);
            assert_eq!((bench.session.account().resyncs, bench.session.trouble()), (1, None));
            assert_eq!(bench.session.account().restarts, 1, "{model:?} {mode:?}");
        }
    }
}

#[test]
fn a_greeting_after_other_bytes_is_a_restart() {
    // A supply that dips sends other bytes first, some of them text.
    let junk = [vec![0x00; 1], vec![0xFF, 0x00, 0x80], vec![0xA5; 300], vec![b'x'; 45], vec![0xF0; 2_000]];
    for (model, junk) in
        [Model::A1, Model::S2].into_iter().flat_map(|model| junk.each_ref().map(|it| (model, it)))
    {
        let mut bench = Bench::new(of(model), Head::new(model, 1));
        bench.run(3 * SECOND);
        bench.head.junk.clone_from(junk);
        bench.head.boot(bench.now);
        bench.until(4 * SECOND, |bench| bench.session.account().restarts > 0);
        bench.until(4 * SECOND, is_streaming);
        assert_eq!(bench.session.account().restarts, 1, "{model:?} after {} bytes", junk.len());
    }
}

#[test]
fn ranges_that_are_text_are_no_greeting() {
    // A single point counts if another one follows it.
    for (mode, lost) in [(Mode::Standard, 65), (Mode::DenseBoost, 60)] {
        let mut bench =
            Bench::new(Settings { mode: Some(mode.name()), ..of(Model::S2) }, Head::new(Model::S2, 1));
        bench.run(3 * SECOND);
        for _ in 0..20 {
            bench.head.leave_text(bench.now);
            bench.run(bench.now + 33 * MILLIS);
        }
        let account = bench.session.account();
        assert_eq!((account.resyncs, account.damaged), (0, 20 * lost), "{mode:?}");
        assert_eq!(account.restarts, 0, "{mode:?}");
    }
}

#[test]
fn nothing_is_said_that_a_scanner_keeps() {
    for model in Model::ALL {
        let mut bench = Bench::new(Settings::default(), Head::new(model, 1));
        bench.run(3 * SECOND);
        bench.session.control(Control::Resync, bench.now);
        bench.run(6 * SECOND);
        let known = [0x25, 0x20, 0x50, 0x52, 0x82, 0x84, 0xA8, 0xF0, 0xFF];
        assert!(
            bench.head.requests.iter().all(|request| known.contains(request)),
            "{:02X?}",
            bench.head.requests
        );
    }
}

#[test]
fn a_recording_is_read_and_nothing_is_said() {
    for (model, mode) in
        [(Model::A1, Mode::Express), (Model::S2, Mode::DenseBoost), (Model::A1, Mode::Standard)]
    {
        let mut live = Bench::new(Settings { mode: Some(mode.name()), ..of(model) }, Head::new(model, 1));
        live.run(4 * SECOND);
        let bytes = live.log.packets.concat();
        let settings = Settings { mode: Some(mode.name()), fixed_rate: true, listen_only: true, ..of(model) };
        let mut session = Session::new(settings, 0);
        let per_second = bytes.len() / 3;
        let (mut now, mut turns) = (0, 0);
        for piece in bytes.chunks(per_second / 100) {
            now += 10 * MILLIS;
            let mut rest = piece;
            while !rest.is_empty() {
                let len = rest.len().min(session.spare().len());
                session.spare()[..len].copy_from_slice(&rest[..len]);
                session.commit(now, len);
                rest = &rest[len..];
                loop {
                    match session.poll_output() {
                        Output::Event(Event::Scan(_)) => turns += 1,
                        Output::Event(_) => {}
                        Output::Rest(_) | Output::Wait { .. } => break,
                        output => panic!("{output:?}"),
                    }
                }
            }
        }
        assert!(turns > 8, "{model:?} {mode:?}: {turns}");
        assert_eq!(session.account().discarded, 0);
    }
}
