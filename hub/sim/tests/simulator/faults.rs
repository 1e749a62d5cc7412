//! Tests of every fault of `simulate` with a real session, in virtual time. The session delivers each intact telegram
//! once, in order and bit for bit. If it delivers a telegram that the scanner did not send, it marks the telegram as
//! suspect. It counts every byte, and sends no request that writes the EEPROM. At the end, the session streams.
//!
//! If a test fails, it prints the flags for `simulate` that create the same scanner on a pty.

use std::collections::HashMap;

use scanhub_drivers::line::ScannerSession as _;
use scanhub_drivers::lms;
use scanhub_drivers::lms::telegram::NAK;
use scanhub_drivers::lms::variant::{Baud, MIRROR_PERIOD};
use scanhub_schema::{MILLIS, Nanos};
use scanhub_sim::fault::Faults;
use scanhub_sim::line_model::LineModel;
use scanhub_sim::machine::{LmsSimulator, ProtocolQuirks, Settings, StartState};
use scanhub_sim::operating::{OperatingMode, ScanSource};
use scanhub_sim::room::Room;

use crate::session::{Bench, ReceivedTelegram, SentTelegram};

/// Runs a scene with `faults` for each of `seeds` seeds, and returns the sum of the results.
fn run_scene(faults: &str, span_ms: u64, seeds: u64) -> SceneResult {
    let all = run_seeds(&FaultScene::new(faults.parse().expect("faults"), span_ms), seeds);
    println!("{faults}: {all:?}");
    assert!(
        is_sound(&all, faults),
        "telegrams were delivered that the scanner did not send: {faults}: {all:?}"
    );
    all
}

fn run_seeds(scene: &FaultScene, seeds: u64) -> SceneResult {
    let mut all = SceneResult::default();
    (1..=seeds).for_each(|seed| all.add(scene.run(seed)));
    all
}

/// Number of seeds with which each scene runs.
const SEED_COUNT: u64 = 100;

macro_rules! scenes {
    ($($name:ident: $faults:literal, $span_ms:literal, $least:expr;)*) => {
        $(
            #[test]
            fn $name() {
                let all = run_scene($faults, $span_ms, SEED_COUNT);
                let least: fn(&SceneResult) -> bool = $least;
                assert!(least(&all), "{} had too little effect: {all:?}", $faults);
            }
        )*

        /// Scenes: the faults, their duration in milliseconds, and a function that checks that they had an effect.
        const SCENES: &[(&str, u64, fn(&SceneResult) -> bool)] = &[$(($faults, $span_ms, $least)),*];
    };
}

#[test]
#[ignore = "takes minutes: each scene with five times as many seeds, for five times as long"]
fn long_fault_scenes_pass_all_checks() {
    for (faults, span_ms, _) in SCENES {
        run_scene(faults, 5 * span_ms, 5 * SEED_COUNT);
    }
}

#[test]
fn every_fault_scene_has_an_effect() {
    let mut healthy: HashMap<(bool, u64), SceneResult> = HashMap::new();
    for &(faults, span_ms, has_effect) in SCENES.iter().filter(|(faults, ..)| !faults.is_empty()) {
        let FaultScene { is_idle, .. } = FaultScene::new(faults.parse().expect("faults"), span_ms);
        let inert = FaultScene { is_idle, ..FaultScene::new(Faults::default(), span_ms) };
        let all = healthy.entry((is_idle, span_ms)).or_insert_with(|| run_seeds(&inert, SEED_COUNT));
        assert!(!has_effect(all), "the same effect without {faults}: {all:?}");
    }
}

/// Returns whether the session delivered only telegrams that the scanner sent. If faults change or insert bytes, it may
/// deliver a few wrong telegrams with a suspect mark. If they flip bits, these telegrams need no mark, because the
/// checksum stays valid for 1.19e-3 of all pairs of flipped bits.
fn is_sound(all: &SceneResult, faults: &str) -> bool {
    let flips = faults.starts_with("flip");
    let changes = ["flip=", "insert=", "double=", "length=", "flood=", "wall="];
    let maximum = if changes.iter().any(|key| faults.contains(key)) { all.faulty / 200 } else { 0 };
    all.wrong <= maximum && (flips || all.unmarked == 0)
}

// Each line has a name, faults, their duration in milliseconds, and their minimum effect.
scenes! {
    nothing: "", 300, |all| all.intact > 600;
    bytes_lost: "loss=0.00135,burst=1.89", 320, |all| all.faulty > 120;
    long_bursts_lost: "loss=0.02,burst=200", 320, |all| all.faulty > 30;
    bits_flipped: "flip=0.0003", 320, |all| all.faulty > 60 && all.unmarked == 0;
    many_bits_flipped: "flip=0.002", 320, |all| all.faulty > 180;
    runs_of_bits_flipped: "flip=0.0005,flip_bits=9", 320, |all| all.faulty > 120;
    bytes_inserted: "insert=0.0005,insert_burst=3", 320, |all| all.faulty > 120;
    bytes_doubled: "double=0.001", 320, |all| all.faulty > 120;
    telegrams_repeated: "repeat=0.3", 320, |all| all.effects.copies > 80;
    telegrams_truncated: "truncate=0.3", 320, |all| all.faulty > 120;
    lengths_changed: "length=0.3", 320, |all| all.faulty > 120;
    scans_broken_off: "abort=0.3", 320, |all| all.faulty > 120;
    floods: "flood=500,flood_every=0.05", 320, |all| all.faulty > 90;
    walls: "wall=300,wall_every=0.05", 320, |all| all.faulty > 90;
    walls_between_telegrams: "wall=1000,wall_every=0.03,inside=0", 320, |all| all.intact > 700 && all.effects.foreign > 500_000;
    silence: "silence=0.05,silence_at=0.1,silence_every=0.15", 320, |all| all.faulty > 120;
    long_silence: "silence=1.05,silence_at=0.1", 1200, |all| all.resyncs >= 100;
    a_stuck_line: "stall=0.2,stall_at=0.1", 400, |all| all.intact > 1000 && all.effects.unaligned_scans >= 100;
    late_pieces: "delay=0.02", 320, |all| all.intact > 700 && all.effects.unaligned_scans > 50;
    power_cycles: "power_every=0.2", 300, |all| all.faulty > 20 && all.resyncs >= 100;
    unplugged: "unplug=0.2,unplug_at=0.1,unplug_every=1", 400, |all| all.faulty > 500;
    all_at_once: "loss=0.0005,burst=3,flip=0.0001,insert=0.0001,double=0.0001,truncate=0.02,length=0.02,\
        abort=0.02,repeat=0.02,flood=300,flood_every=0.2,wall=300,wall_every=0.2,delay=0.002", 400,
        |all| all.faulty > 300;
    requests_overlooked: "overlook=0.3", 650, |all| all.effects.unacknowledged > 60 && all.recovery_ms < 4_000;
    requests_refused_by_nak: "nak=0.3", 650, |all| all.effects.naks > 60 && all.recovery_ms < 4_000;
    acknowledgements_at_the_limit: "late_ack=0.052", 900, |all| all.effects.late_acknowledgements >= 300;
    acknowledgements_late: "late_ack=0.1", 900, |all| all.effects.late_acknowledgements >= 300;
    replies_late: "late=0.4", 2200, |all| all.effects.late_replies > 200;
    replies_twice: "twice=0.5", 650, |all| all.effects.extra_replies > 30;
    modes_changed_slowly: "late_mode=2.9", 3600, |all| all.effects.late_replies >= 100 && all.recovery_ms < 1_000;
    a_command_refused: "refuse=0x3A", 800, |all| all.effects.refused >= 100;
    nobody_answers: "mute=1", 300, |all| all.effects.unacknowledged >= 100 && all.recovery_ms > 100;
}

/// A scene: faults, their duration, and the state of the scanner at the start.
struct FaultScene {
    faults: Faults,
    span_ms: u64,
    /// Whether the scanner is idle at the start. Otherwise it streams.
    is_idle: bool,
}

/// Result of one run of a scene, or the sum of several results.
#[derive(Debug, Default)]
struct SceneResult {
    /// Number of telegrams that arrived as sent while the session streamed. The session delivered all of them.
    intact: usize,
    /// Number of telegrams that did not arrive as sent.
    faulty: usize,
    /// Number of delivered telegrams that the scanner did not send.
    wrong: usize,
    /// Number of these telegrams that had no suspect mark.
    unmarked: usize,
    resyncs: u64,
    /// Longest time from the end of the faults until the session streams.
    recovery_ms: u64,
    effects: Effects,
}

impl SceneResult {
    fn add(&mut self, other: SceneResult) {
        self.effects.add(&other.effects);
        self.intact += other.intact;
        self.faulty += other.faulty;
        self.wrong += other.wrong;
        self.unmarked += other.unmarked;
        self.resyncs += other.resyncs;
        self.recovery_ms = self.recovery_ms.max(other.recovery_ms);
    }
}

impl FaultScene {
    /// Creates a scene. A scanner with protocol quirks is idle at the start, because quirks affect the replies to
    /// requests.
    fn new(faults: Faults, span_ms: u64) -> FaultScene {
        FaultScene { faults, span_ms, is_idle: faults.quirks() != ProtocolQuirks::default() }
    }

    fn run(&self, seed: u64) -> SceneResult {
        let quirks = self.faults.quirks();
        let start =
            StartState::Operating(if self.is_idle { OperatingMode::OnRequest } else { OperatingMode::All });
        let baud = Baud::B500000;
        let boot_ns = 200 * MILLIS;
        let settings = Settings { baud, start, boot_ns, quirks, seed, ..Settings::default() };
        let world = world(seed).parse().expect("a world with this name");
        let mut bench = Bench::new(LmsSimulator::new(settings, ScanSource::Room(Room::new(&world, seed))), 0);
        bench.line = LineModel::new(&self.faults, seed);
        bench.run(self.span_ms * MILLIS);
        bench.line.set_faults(&Faults::default(), 0);
        bench.machine.set_quirks(ProtocolQuirks::default());
        let healed = bench.now;
        let streams = |bench: &Bench| bench.is_streaming() && !bench.received_scans(healed).is_empty();
        let back = bench.run_until(&self.name(seed), SEARCH_TIMEOUT, streams);
        // After damage, the session holds telegrams back until some intact telegrams have followed. It releases the
        // last telegram after a pause.
        bench.run(80 * MILLIS);
        bench.to_host = Box::new(|_, _| Vec::new());
        bench.run(40 * MILLIS);
        let verdict = self.compare(&bench, seed);
        let has_power = self.faults.power_at + self.faults.power_every == 0.0;
        assert!(!has_power || bench.session.stats().restarts == 0, "{}", self.name(seed));
        let effects = Effects::of(&bench);
        SceneResult { effects, resyncs: bench.session.stats().resyncs, recovery_ms: back / MILLIS, ..verdict }
    }

    /// Compares the telegrams that the session delivered with those that the scanner sent.
    fn compare(&self, bench: &Bench, seed: u64) -> SceneResult {
        let is_due = |sent: &SentTelegram| sent.was_streaming && !sent.damaged;
        let unmatched = align(&bench.sent, &bench.received, is_due);
        let name = self.name(seed);
        if let Some(lost) = unmatched.lost.first() {
            let SentTelegram { at, is_reply, .. } = lost;
            let (command, count) = (lost.telegram[4], unmatched.lost.len());
            panic!("{name}: {count} lost, first {command:02X} sent {at} reply {is_reply}: {bench}");
        }
        let unmarked: Vec<_> = unmatched.unsent.iter().filter(|wrong| wrong.reasons == 0).collect();
        if let Some(wrong) = unmarked.first() {
            let (command, at) = (wrong.telegram[4], wrong.at);
            println!("{name}: {command:02X} received {at} was not sent, and is not marked: {bench}");
        }
        SceneResult {
            intact: bench.sent.iter().filter(|sent| is_due(sent)).count(),
            faulty: bench.sent.iter().filter(|sent| sent.fault.is_some()).count(),
            wrong: unmatched.unsent.len(),
            unmarked: unmarked.len(),
            ..SceneResult::default()
        }
    }

    fn name(&self, seed: u64) -> String {
        let state = if self.is_idle { "idle" } else { "streaming" };
        let (world, faults) = (world(seed), self.faults);
        format!("--baud 500000 --boot 200ms --state {state} --world {world} --seed {seed} --fault {faults}")
    }
}

/// Returns the world of the scanner, which differs by seed.
fn world(seed: u64) -> &'static str {
    const WORLDS: [&str; 5] = ["room", "bare", "empty", "wall640", "random"];
    WORLDS[seed as usize % WORLDS.len()]
}

/// Maximum time until a session that searches for its scanner streams.
const SEARCH_TIMEOUT: Nanos = 10_000 * MILLIS;

/// Number of occurrences of each effect.
#[derive(Debug, Default)]
struct Effects {
    /// Requests that reached the scanner, but that it did not acknowledge.
    unacknowledged: usize,
    naks: usize,
    /// Replies after an ACK, except the first reply after each ACK.
    extra_replies: usize,
    /// Replies 92h.
    refused: usize,
    /// Acknowledgements that were later than usual.
    late_acknowledgements: usize,
    /// Replies that were later than usual.
    late_replies: usize,
    /// Scans that did not arrive a whole number of scan periods after the previous scan.
    unaligned_scans: usize,
    /// Telegrams that arrived twice.
    copies: usize,
    /// Bytes that arrived between telegrams, although the scanner did not send them.
    foreign: usize,
}

impl Effects {
    /// Counts the effects in `bench`.
    fn of(bench: &Bench) -> Effects {
        let Bench { request_times, acknowledged, sent, foreign, .. } = bench;
        let naks = acknowledged.iter().filter(|(_, byte)| *byte == NAK).count();
        let replies: Vec<&SentTelegram> = sent.iter().filter(|sent| sent.is_reply).collect();
        let acks: Vec<Nanos> =
            acknowledged.iter().filter(|(_, byte)| *byte != NAK).map(|(at, _)| *at).collect();
        let mut effects = Effects {
            unacknowledged: request_times.len().saturating_sub(acknowledged.len()),
            naks,
            extra_replies: replies.len().saturating_sub(acks.len()),
            refused: replies.iter().filter(|sent| sent.telegram[4] == lms::reply::REFUSED).count(),
            late_acknowledgements: acks
                .iter()
                .filter(|&&at| at > last_before(request_times, at) + 40 * MILLIS)
                .count(),
            late_replies: replies
                .iter()
                .filter(|sent| sent.at > last_before(&acks, sent.at) + 250 * MILLIS)
                .count(),
            foreign: *foreign,
            ..Effects::default()
        };
        for pair in sent.windows(2).filter(|pair| pair.iter().all(|sent| !sent.is_reply && !sent.aborted)) {
            let gap = pair[1].at - pair[0].at;
            effects.copies += usize::from(gap == 0 && pair[0].telegram == pair[1].telegram);
            effects.unaligned_scans +=
                usize::from(gap == 0 || (gap + MILLIS) % (2 * MIRROR_PERIOD) > 2 * MILLIS);
        }
        effects
    }

    fn add(&mut self, other: &Effects) {
        self.unacknowledged += other.unacknowledged;
        self.naks += other.naks;
        self.extra_replies += other.extra_replies;
        self.refused += other.refused;
        self.late_acknowledgements += other.late_acknowledgements;
        self.late_replies += other.late_replies;
        self.unaligned_scans += other.unaligned_scans;
        self.copies += other.copies;
        self.foreign += other.foreign;
    }
}

/// Returns the last of `times` that is not after `at`, or `at` itself if there is none.
fn last_before(times: &[Nanos], at: Nanos) -> Nanos {
    times.iter().rev().copied().find(|&time| time <= at).unwrap_or(at)
}

/// Telegrams for which [`align`] found no partner.
struct Unmatched<'a> {
    /// Telegrams that the scanner sent and that are due, but that the session did not deliver.
    lost: Vec<&'a SentTelegram>,
    /// Telegrams that the session delivered, but that the scanner did not send.
    unsent: Vec<&'a ReceivedTelegram>,
}

/// Pairs equal telegrams in `received` and `sent`, in order, so that as few telegrams as possible have no partner.
/// A telegram in `sent` needs a partner only if `is_due` returns true for it.
fn align<'a>(
    sent: &'a [SentTelegram],
    received: &'a [ReceivedTelegram],
    is_due: impl Fn(&SentTelegram) -> bool,
) -> Unmatched<'a> {
    let same = |s: usize, r: usize| sent[s].telegram == received[r].telegram;
    // best[s][r] is for the telegrams from `s` and `r` on: the minimum numbers of lost telegrams and wrong telegrams.
    let mut best = vec![vec![(0, 0); received.len() + 1]; sent.len() + 1];
    for s in (0..=sent.len()).rev() {
        for r in (0..=received.len()).rev() {
            let pass_sent = (s < sent.len()).then(|| {
                let (lost, wrong) = best[s + 1][r];
                (lost + usize::from(is_due(&sent[s])), wrong)
            });
            let pass_received = (r < received.len()).then(|| (best[s][r + 1].0, best[s][r + 1].1 + 1));
            let pair =
                (pass_sent.is_some() && pass_received.is_some() && same(s, r)).then(|| best[s + 1][r + 1]);
            best[s][r] = [pair, pass_sent, pass_received].into_iter().flatten().min().unwrap_or_default();
        }
    }
    let (mut s, mut r) = (0, 0);
    let mut unmatched = Unmatched { lost: Vec::new(), unsent: Vec::new() };
    while s < sent.len() || r < received.len() {
        let both = s < sent.len() && r < received.len();
        if both && same(s, r) && best[s][r] == best[s + 1][r + 1] {
            (s, r) = (s + 1, r + 1);
        } else if r < received.len() && best[s][r] == (best[s][r + 1].0, best[s][r + 1].1 + 1) {
            unmatched.unsent.push(&received[r]);
            r += 1;
        } else {
            unmatched.lost.extend(is_due(&sent[s]).then_some(&sent[s]));
            s += 1;
        }
    }
    unmatched
}
