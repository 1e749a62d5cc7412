//! One run: a sensor that streams, a wire with faults, a session; then a while without faults, and the account.

use scanhub_drivers::line::Session as _;
use scanhub_drivers::lms::variant::Baud;
use scanhub_schema::{MILLIS, Nanos};
use scanhub_sim::fault::Faults;
use scanhub_sim::machine::{LmsSimulator, ProtocolQuirks, Settings, Start};
use scanhub_sim::operating::Operating;
use scanhub_sim::operating::Source;
use scanhub_sim::room::Room;
use scanhub_sim::wire::LineModel;

use super::alignment::align;
use super::effect::Effects;
use crate::session::bench::{Bench, Sent};

/// What goes wrong, and for how long.
pub(crate) struct Scene {
    pub(crate) faults: Faults,
    pub(crate) span_ms: u64,
    /// Whether the sensor is idle first, else it streams.
    pub(crate) is_idle: bool,
}

/// What came of it.
#[derive(Debug, Default)]
pub(crate) struct Verdict {
    /// Telegrams that arrived as sent while the session streamed: all of them were delivered.
    pub(crate) intact: usize,
    /// Telegrams that did not arrive as sent.
    pub(crate) faulty: usize,
    /// Telegrams delivered that nobody sent, and those of them that are not marked suspect.
    pub(crate) wrong: usize,
    pub(crate) unmarked: usize,
    pub(crate) resyncs: u64,
    /// Longest time from the end of the faults to a stream.
    pub(crate) back_ms: u64,
    pub(crate) effects: Effects,
}

impl Verdict {
    pub(crate) fn add(&mut self, other: Verdict) {
        self.effects.add(&other.effects);
        self.intact += other.intact;
        self.faulty += other.faulty;
        self.wrong += other.wrong;
        self.unmarked += other.unmarked;
        self.resyncs += other.resyncs;
        self.back_ms = self.back_ms.max(other.back_ms);
    }
}

impl Scene {
    /// Creates a scene. Protocol quirks affect replies to requests, so a scanner that has them is idle.
    pub(crate) fn new(faults: Faults, span_ms: u64) -> Scene {
        Scene { faults, span_ms, is_idle: faults.quirks() != ProtocolQuirks::default() }
    }

    pub(crate) fn run(&self, seed: u64) -> Verdict {
        let quirks = self.faults.quirks();
        let start = Start::In(if self.is_idle { Operating::OnRequest } else { Operating::All });
        let baud = Baud::B500000;
        let boot_ns = 200 * MILLIS;
        let settings = Settings { baud, start, boot_ns, quirks, seed, ..Settings::default() };
        let world = world(seed).parse().expect("a world with this name");
        let mut bench = Bench::new(LmsSimulator::new(settings, Source::Room(Room::new(&world, seed))), 0);
        bench.wire = LineModel::new(&self.faults, seed);
        bench.run(self.span_ms * MILLIS);
        bench.wire.set_faults(&Faults::default(), 0);
        bench.machine.set_quirks(ProtocolQuirks::default());
        let healed = bench.now;
        let streams = |bench: &Bench| bench.is_streaming() && !bench.received_scans(healed).is_empty();
        let back = bench.until(&self.name(seed), LONGEST, streams);
        // What was held back by damage is out after some whole ones, and the last one after a pause.
        bench.run(80 * MILLIS);
        bench.to_host = Box::new(|_, _| Vec::new());
        bench.run(40 * MILLIS);
        let verdict = self.account(&bench, seed);
        let has_power = self.faults.power_at + self.faults.power_every == 0.0;
        assert!(!has_power || bench.session.account().restarts == 0, "{}", self.name(seed));
        let effects = Effects::of(&bench);
        Verdict { effects, resyncs: bench.session.account().resyncs, back_ms: back / MILLIS, ..verdict }
    }

    /// Holds what was delivered against what was sent.
    fn account(&self, bench: &Bench, seed: u64) -> Verdict {
        let is_due = |sent: &Sent| sent.streamed && !sent.damaged;
        let account = align(&bench.sent, &bench.received, is_due);
        let name = self.name(seed);
        if let Some(lost) = account.lost.first() {
            let Sent { at, is_reply, .. } = lost;
            let (command, count) = (lost.telegram[4], account.lost.len());
            panic!("{name}: {count} lost, first {command:02X} sent {at} reply {is_reply}: {bench}");
        }
        let unmarked: Vec<_> = account.wrong.iter().filter(|wrong| wrong.reasons == 0).collect();
        if let Some(wrong) = unmarked.first() {
            let (command, at) = (wrong.telegram[4], wrong.at);
            println!("{name}: nobody sent {command:02X} received {at}, and it is not marked: {bench}");
        }
        Verdict {
            intact: bench.sent.iter().filter(|sent| is_due(sent)).count(),
            faulty: bench.sent.iter().filter(|sent| sent.fault.is_some()).count(),
            wrong: account.wrong.len(),
            unmarked: unmarked.len(),
            ..Verdict::default()
        }
    }

    fn name(&self, seed: u64) -> String {
        let state = if self.is_idle { "idle" } else { "streaming" };
        let (world, faults) = (world(seed), self.faults);
        format!("--baud 500000 --boot 200ms --state {state} --world {world} --seed {seed} --fault {faults}")
    }
}

/// What the sensor sees: each seed something else.
fn world(seed: u64) -> &'static str {
    const WORLDS: [&str; 5] = ["room", "bare", "empty", "wall640", "random"];
    WORLDS[seed as usize % WORLDS.len()]
}

/// A session that has to look for its sensor finds it within so long.
const LONGEST: Nanos = 10_000 * MILLIS;
