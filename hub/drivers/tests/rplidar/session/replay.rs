//! A session of a recording, at whose other end nobody is: it hears what another session handed out.

use scanhub_drivers::Settings;
use scanhub_drivers::line::{Event, Output, Protocol as _, RawScan, Session as _};
use scanhub_drivers::rplidar::{Mode, Model, Session, Trouble};
use scanhub_schema::{MILLIS, Nanos};

use crate::session::bench::{Bench, Kept, SECOND};
use crate::session::head::Head;
use crate::session::start::of;
use crate::session::wire::Damage;

/// Turns of a recording: stamp, points a second, beams, and how many points each has.
#[derive(Debug, PartialEq)]
struct Seen {
    first: Nanos,
    points: usize,
    beams: usize,
    incomplete: bool,
}

/// What a session with these `settings` makes of `heard`.
fn replay(settings: Settings, heard: &[Kept]) -> (Session, Vec<Seen>) {
    let settings = Settings { fixed_rate: true, listen_only: true, ..settings };
    let mut session = Session::new(settings, heard[0].first);
    let mut turns = Vec::new();
    for Kept { last, bytes, reasons, .. } in heard {
        session.mark_suspect(*reasons);
        session.spare()[..bytes.len()].copy_from_slice(bytes);
        session.commit(*last, bytes.len());
        loop {
            match session.poll_output() {
                Output::Event(Event::Scan(turn)) => turns.push(seen(&turn)),
                Output::Event(Event::Telegram(_)) => {}
                Output::Rest(_) | Output::Wait { .. } => break,
                output => panic!("{output:?}"),
            }
        }
    }
    (session, turns)
}

fn seen(turn: &RawScan<'_>) -> Seen {
    Seen {
        first: turn.first,
        points: turn.points().len(),
        beams: turn.beams(),
        incomplete: turn.is_incomplete(),
    }
}

const MODES: [(Model, Mode); 7] = [
    (Model::A1, Mode::Standard),
    (Model::A1, Mode::Express),
    (Model::A1, Mode::Sensitivity),
    (Model::A1, Mode::Stability),
    (Model::S1, Mode::DenseBoost),
    (Model::S2, Mode::DenseBoost),
    (Model::S3, Mode::UltraDense),
];

fn recorded(model: Model, mode: Mode, seconds: u64) -> Bench {
    let mut live = Bench::new(Settings { mode: Some(mode.name()), ..of(model) }, Head::new(model, 1));
    live.run(seconds * SECOND);
    live
}

/// What was answered is in the recording: how long a point takes, and what the packets are.
#[test]
fn a_recording_from_the_beginning_has_the_turns_that_were_handed_out() {
    for (model, mode) in MODES {
        let live = recorded(model, mode, 6);
        for settings in [Settings::default(), Settings { mode: Some(mode.name()), ..of(model) }] {
            let (session, turns) = replay(settings, &live.log.heard);
            let per_second = session.points_per_second().expect("told");
            assert_eq!(Some(per_second), live.session.points_per_second(), "{model:?} {mode:?}");
            assert_eq!(session.model(), Some(model));
            // Where the wanted mode is not known, the first quarter of a second may be of another one.
            let missing = if settings.mode.is_some() { 0 } else { 3 };
            assert!(turns.len() + missing >= live.log.turns.len(), "{model:?} {mode:?}: {}", turns.len());
            let behind = live.log.turns.len() - turns.len();
            for (seen, told) in turns.iter().zip(&live.log.turns[behind..]) {
                assert_eq!(seen.incomplete, told.incomplete, "{model:?} {mode:?}");
                // Without the mode it is another grid, which begins elsewhere.
                let off = if settings.mode.is_some() { 0 } else { 2 };
                assert!(seen.points.abs_diff(told.points.len()) <= off, "{model:?} {mode:?}");
                assert!(settings.mode.is_none() || seen.beams == told.beams);
                assert!(
                    seen.first.abs_diff(told.first) < 15 * MILLIS,
                    "{model:?} {mode:?}: {seen:?} {}",
                    told.first
                );
            }
        }
    }
}

#[test]
fn one_that_begins_in_the_midst_has_turns_soon() {
    for (model, mode) in MODES {
        let live = recorded(model, mode, 8);
        let from = live.log.heard.iter().position(|kept| kept.first > 3 * SECOND).expect("some");
        let (session, turns) =
            replay(Settings { mode: Some(mode.name()), ..of(model) }, &live.log.heard[from..]);
        let first = turns.first().expect("some").first;
        assert!(first < 3 * SECOND + SECOND * 6 / 10, "{model:?} {mode:?}: {first}");
        let is =
            session.points_per_second().expect("measured") / live.session.points_per_second().expect("told");
        assert!((is - 1.0).abs() < 0.005, "{model:?} {mode:?}: {is}");
        assert!(turns.iter().all(|seen| !seen.incomplete), "{model:?} {mode:?}");
        let worst = off(&live, &turns).into_iter().max().expect("some");
        assert!(worst < 2 * MILLIS, "{model:?} {mode:?}: {worst}");
        assert!(session.account().lost == 0);
    }
}

/// By how much the stamp of each of `turns` is off the one that was handed out.
fn off(live: &Bench, turns: &[Seen]) -> Vec<Nanos> {
    let off = |seen: &Seen| live.log.turns.iter().map(|told| told.first.abs_diff(seen.first)).min();
    turns.iter().map(|seen| off(seen).expect("some")).collect()
}

/// What was damaged is not in a recording: only the marks of what came behind it tell that it is missing.
#[test]
fn one_that_begins_in_the_midst_of_a_line_that_damages_bytes_is_dated_right() {
    for (model, mode) in MODES {
        let settings = Settings { mode: Some(mode.name()), ..of(model) };
        let mut all = Vec::new();
        for seed in 0..20 {
            let mut live = Bench::new(settings, Head::new(model, seed));
            live.head.damage = Damage { lost: 0.000_5, ..Damage::default() };
            live.run(8 * SECOND);
            let from = live.log.heard.iter().position(|kept| kept.first > 3 * SECOND).expect("some");
            let (_, turns) = replay(settings, &live.log.heard[from..]);
            all.extend(off(&live, &turns));
        }
        all.sort_unstable();
        let (most, worst) = (all[all.len() * 98 / 100], all[all.len() - 1]);
        // Points without a checksum are lost without a mark.
        let bound = if mode == Mode::Standard { 15 } else { 10 };
        assert!(most < 5 * MILLIS && worst < bound * MILLIS, "{model:?} {mode:?}: {most} {worst}");
    }
}

/// While a busy machine stands still, packets wait in its driver. Then their stamps are late and close together, and have little to
/// do with the time that a point takes.
#[test]
fn packets_that_waited_do_not_change_the_time_per_point() {
    for (model, mode) in MODES {
        let settings = Settings { mode: Some(mode.name()), ..of(model) };
        let live = recorded(model, mode, 12);
        let from = live.log.heard.iter().position(|kept| kept.first > 2 * SECOND).expect("some");
        let steady = &live.log.heard[from..];
        let mut stalled = steady.to_vec();
        let mut free = 0;
        for kept in &mut stalled {
            let into = kept.last % (300 * MILLIS);
            // The hub takes a tenth of a millisecond for each of those that waited.
            let at = if into < 40 * MILLIS { kept.last - into + 40 * MILLIS } else { kept.last };
            free = at.max(free + MILLIS / 10);
            kept.last = free;
        }
        let points = |heard: &[Kept]| replay(settings, heard).1.iter().map(|seen| seen.points).collect();
        let [expected, found]: [Vec<usize>; 2] = [points(steady), points(&stalled)];
        assert!(expected.len() > 50 && found == expected, "{model:?} {mode:?}: {expected:?} {found:?}");
    }
}

/// Ranges of the one kind are nonsense as those of the other one.
#[test]
fn packets_that_may_be_of_two_kinds_are_refused_in_words() {
    let live = recorded(Model::S1, Mode::DenseBoost, 4);
    let from = live.log.heard.iter().position(|kept| kept.first > 2 * SECOND).expect("some");
    let (session, turns) = replay(Settings::default(), &live.log.heard[from..]);
    assert_eq!((session.trouble(), turns.len()), (Some(Trouble::Alike), 0));
    assert!(Trouble::Alike.to_string().contains("model or the mode"));
    let (session, turns) = replay(of(Model::S1), &live.log.heard[from..]);
    assert_eq!(session.trouble(), None);
    assert!(turns.len() > 10);
}
