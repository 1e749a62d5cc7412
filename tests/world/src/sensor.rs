//! A simulated sensor and the line to a port, in the order of time: what a host writes goes in, what arrives comes out. Refuses
//! to know what a port does with it.

use sim::device::Device as _;
use std::collections::VecDeque;
use std::sync::Arc;

use lms::command::Request;
use lms::variant::{Baud, Mode, Unit, Variant};
use lms::{MICROS, Nanos, line_time};
use sim::Arrival;
use sim::fault::Faults;
use sim::machine::{Habits, Machine, Settings, Start};
use sim::operating::Operating;
use sim::room::Room;
use sim::series::{Changes, Series};
use sim::source::Source;
use sim::wire::{Carried, Wire};
use sim::world::World as Scene;

/// A sensor at the end of its line.
pub(crate) struct Sensor {
    machine: Machine,
    wire: Wire,
    settings: Settings,
    series: Arc<Series>,
    changes: Changes,
    /// Bytes of the host on their way: when they are through, and their rate.
    outgoing: VecDeque<(Nanos, u8, u32)>,
    now: Nanos,
    /// Requests to write the EEPROM that sensors heard which are not there any more.
    eeprom_writes: u64,
}

impl Sensor {
    /// The sensor of `settings`, whose view of `series` changes as `changes` say.
    pub(crate) fn new(settings: Settings, series: Arc<Series>, changes: Changes) -> Sensor {
        let room = Room::of_series(series.clone(), changes.clone());
        Sensor {
            machine: Machine::new(settings.clone(), Source::Room(room)),
            wire: Wire::new(&Faults::default(), 0),
            settings,
            series,
            changes,
            outgoing: VecDeque::new(),
            now: 0,
            eeprom_writes: 0,
        }
    }

    /// When something may come next.
    pub(crate) fn next_ns(&self) -> Option<Nanos> {
        let heard = self.outgoing.front().map(|(at, ..)| *at);
        self.wire.poll_timeout(&self.machine, self.now).into_iter().chain(heard).min()
    }

    /// Lets the time be `to`, unless it is later already; what arrives meanwhile goes to `arrives`.
    pub(crate) fn advance(&mut self, to: Nanos, mut arrives: impl FnMut(Nanos, Carried)) {
        while let Some(at) = self.next_ns().filter(|&at| at <= to) {
            self.now = self.now.max(at);
            while let Some(carried) = self.wire.poll_transmit(&mut self.machine, self.now) {
                arrives(self.now, carried);
            }
            while self.outgoing.front().is_some_and(|(at, ..)| *at <= self.now)
                && let Some((at, byte, rate)) = self.outgoing.pop_front()
            {
                // At another rate it hears something else, which is no request.
                if self.machine.baud().rate() == rate {
                    self.wire.receive(&mut self.machine, byte, Arrival::at(at));
                }
            }
        }
        self.now = self.now.max(to);
    }

    /// A host writes `byte` at `now`, at `rate`.
    pub(crate) fn write(&mut self, now: Nanos, byte: u8, rate: u32) {
        let free = self.outgoing.back().map_or(now, |(at, ..)| now.max(*at));
        self.outgoing.push_back((free + line_time(1, rate), byte, rate));
    }

    /// The cable is pulled out: what is on its way does not arrive.
    pub(crate) fn cut(&mut self) {
        self.outgoing.clear();
    }

    /// Its power goes off and on.
    pub(crate) fn power_cycle(&mut self) {
        self.machine.power_cycle(self.now);
    }

    /// Another one is there instead, at `baud`; it streams if somebody made it.
    pub(crate) fn exchange(&mut self, baud: Baud, streams: bool) {
        self.eeprom_writes += self.machine.eeprom_writes();
        let seed = self.settings.seed.wrapping_add(1);
        let start = Start::In(Operating::OnRequest);
        let settings = Settings { baud, seed, start, ..self.settings.clone() };
        let room = Room::of_series(self.series.clone(), self.changes.clone());
        self.machine = Machine::new(settings.clone(), Source::Room(room));
        self.settings = settings;
        if streams {
            let mut at = self.now;
            for &byte in Request::Stream.encode(0).bytes() {
                at += line_time(1, baud.rate()) + 60 * MICROS;
                self.outgoing.push_back((at, byte, baud.rate()));
            }
        }
    }

    /// The line has these faults from now on.
    pub(crate) fn set_faults(&mut self, faults: &Faults, seed: u64) {
        self.wire.set_faults(faults, seed);
    }

    /// It behaves like this from now on.
    pub(crate) fn set_habits(&mut self, habits: Habits) {
        self.machine.set_habits(habits);
    }

    /// Requests heard that would write the EEPROM.
    pub(crate) fn eeprom_writes(&self) -> u64 {
        self.eeprom_writes + self.machine.eeprom_writes()
    }
}

/// What sensors of `variant` see in all worlds: a room without anything near, the same with a post 0.8 m ahead, and with one
/// 0.4 m ahead. Measured once for all worlds.
pub(crate) fn series(variant: Variant) -> Series {
    let rooms = [None, Some(800), Some(400)].map(|ahead_mm: Option<u32>| {
        let post =
            ahead_mm.map_or(String::new(), |mm| format!("[[thing]]\nradius_mm = 100\npose = [0, {mm}]\n"));
        let scene = Scene::of_toml("world", &format!("{WALLS}{post}")).expect("a scene");
        Room::new(&scene, 1)
    });
    Series::new(rooms.to_vec(), SCANS, variant, Unit::Mm, Mode(1))
}

/// So many different scans of each room: enough that no model of it stands still.
const SCANS: usize = 12;

/// Four walls, and noise as a real sensor has it, but no codes: what is near is seen by every scan.
const WALLS: &str = "
[noise]
tail = 0
errors = 0
weak = false
dazzle = false

[[thing]]
line = [[3400, -500], [3400, 5600], [-4100, 5600], [-4100, -500]]

[[thing]]
radius_mm = 50
pose = [2900, 4800]
surface = \"reflector\"
";
