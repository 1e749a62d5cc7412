//! A scanner of Slamtec, without a line and without a clock: it answers what a host asks, its motor gets up to speed, and
//! its head measures point by point, each at its own time, which leave in packets of the mode that was asked for.
//!
//! The sources of what it does are the vendor's protocol manual and driver, and what others measured of a real A1M8. Where
//! these are silent it keeps silent too: what it does not know is not answered.

mod answers;
mod models;
mod optics;
mod packets;
mod requests;
mod settings;
mod stream;

use schema::{MILLIS, Nanos};

use crate::device::{Chunk, Device};
use crate::fault::Window;
use crate::outlet::Outlet;
use crate::request_decoder::{Arrival, Dropped};
use crate::room::Room;
use crate::settings::Habits;
use crate::turning::{Rotation, TruePoint};

use models::Motor;
use optics::Optics;
use requests::{Decoder, Request};
use stream::{Motion, Stream};

pub use models::{Form, Mode, Model};
pub use settings::{UnitSettings, UnitStart};

/// The scanner.
pub struct Unit {
    settings: UnitSettings,
    optics: Optics,
    decoder: Decoder,
    outlet: Outlet,
    random: fastrand::Rng,
    /// Nothing while it rests.
    motor: Option<Motion>,
    stream: Option<Stream>,
    health: (u8, u16),
    /// When the banner leaves, while it starts.
    boots_ns: Option<Nanos>,
    /// From when on it hears.
    hears_ns: Nanos,
    stalls: Window,
    /// What the motor did when something held it.
    held: Option<Option<Motion>>,
    writes: u64,
}

impl Unit {
    /// The scanner that `settings` describe, at time 0, in `room`.
    pub fn new(settings: UnitSettings, room: Room) -> Unit {
        let UnitSettings { model, seed, health, .. } = settings;
        let mut unit = Unit {
            optics: Optics::new(model, room, seed),
            decoder: Decoder::default(),
            outlet: Outlet::new(model.baud(), settings.chunk),
            random: fastrand::Rng::with_seed(!seed),
            motor: None,
            stream: None,
            health,
            boots_ns: None,
            hears_ns: 0,
            stalls: Window::held(&settings.faults, seed),
            held: None,
            writes: 0,
            settings,
        };
        match unit.settings.start {
            UnitStart::PowerOn => {
                unit.power_cycle(0);
            }
            start => {
                let turns = start == UnitStart::Streaming || model.motor() != Motor::Pwm;
                unit.motor = turns.then(|| Motion { steady_ns: 0, ..unit.motion(0, 1.0) });
                unit.motor.iter_mut().for_each(|motion| motion.rotation.spin_up_s = 0.0);
                if start == UnitStart::Streaming {
                    unit.measure(model.modes()[unit.settings.typical], false, 0);
                }
            }
        }
        unit
    }

    /// Point number `point` of the stream as it is now, without noise; nothing where none began.
    pub fn truth(&mut self, point: u64) -> Option<TruePoint> {
        let (at_ns, head_deg) = self.stream?.place(point, self.motor)?;
        Some(self.optics.truth(at_ns, head_deg))
    }

    /// When the first point of the stream as it is now was measured; nothing where none began.
    pub fn begin_ns(&self) -> Option<Nanos> {
        self.stream?.begin_ns
    }

    /// The mode in which it streams, if it does.
    pub fn mode(&self) -> Option<Mode> {
        Some(self.stream?.mode)
    }

    /// Packets of the stream as it is now that were begun; nothing where none began. The next one begins with the point
    /// behind theirs.
    pub fn sent(&self) -> Option<u64> {
        self.begin_ns()?;
        Some(self.stream?.sent())
    }

    /// Turns that its motor makes in a second, wander aside; nothing while it rests.
    pub fn turns_per_second(&self) -> Option<f64> {
        Some(self.motor?.rotation.turns_per_second)
    }

    /// Makes a motor that turns turn so many times in a second from the next packet of its stream on. The inertia of a real
    /// head is the caller's.
    pub fn set_speed(&mut self, turns_per_second: f64) {
        let next = self.stream.and_then(|stream| stream.next_ns(self.motor));
        if let (Some(motor), Some(next_ns)) = (&mut self.motor, next) {
            let seconds = next_ns.saturating_sub(motor.since_ns) as f64 / 1e9;
            motor.rotation.set_speed(seconds, turns_per_second);
        }
    }

    /// From now on it deviates from the manual like this.
    pub fn set_habits(&mut self, habits: Habits) {
        self.settings.habits = habits;
    }

    /// Something holds its head from `now` on for `span`.
    pub fn hold(&mut self, now: Nanos, span: Nanos) {
        self.stalls = Window::once(now, span);
    }

    /// From now on it reports this status and code, also after a RESET if it is `stubborn`. A status of 2 ends a stream.
    pub fn set_health(&mut self, now: Nanos, health: (u8, u16), stubborn: bool) {
        (self.health, self.settings.stubborn) = (health, stubborn);
        if health.0 == ERROR {
            self.end_stream(now);
        }
    }

    /// A motor that begins at `now`, at this share of its usual speed.
    fn motion(&self, now: Nanos, share: f64) -> Motion {
        let UnitSettings { turns_per_second, wander, seed, .. } = self.settings;
        let turns_per_second = turns_per_second * share;
        let rotation = Rotation::new(turns_per_second, wander, SPIN_UP_S, seed);
        Motion { since_ns: now, steady_ns: now + STEADY_NS, rotation }
    }

    /// The motor does `motion` from now on. What it measures begins anew.
    fn turn(&mut self, motion: Option<Motion>) {
        self.motor = motion;
        if let Some(stream) = self.stream.filter(|stream| !stream.forced) {
            self.measure(stream.mode, false, stream.asked_ns);
        }
    }

    /// Streams in `mode`, as was asked for at `asked_ns`, as soon as the motor is steady.
    fn measure(&mut self, mode: Mode, forced: bool, asked_ns: Nanos) {
        self.stream = Some(Stream::new(self.settings.model, mode, forced, asked_ns, self.motor));
    }

    fn end_stream(&mut self, now: Nanos) {
        if self.stream.take().is_some() {
            self.outlet.forget_data(now);
        }
    }

    /// It starts anew; the banner leaves after `span`.
    fn restart(&mut self, now: Nanos, span: Nanos) -> bool {
        let broken = self.outlet.break_off(now);
        self.stream = None;
        self.decoder.forget();
        self.boots_ns = Some(now + span);
        self.hears_ns = Nanos::MAX;
        if !self.settings.stubborn {
            self.health = (0, 0);
        }
        broken
    }

    /// What has happened by `now` is done.
    fn advance(&mut self, now: Nanos) {
        if self.boots_ns.is_some_and(|at| at <= now) {
            let at_ns = self.boots_ns.take().unwrap_or(now);
            self.outlet.send(answers::banner(self.settings.model), at_ns, true);
            self.hears_ns = self.outlet.free_ns() + HEARS_NS;
        }
        match (self.stalls.holds(now), self.held) {
            (true, None) => {
                self.held = Some(self.motor);
                self.turn(None);
            }
            (false, Some(before)) => {
                self.held = None;
                let usual = self.settings.turns_per_second;
                let again = before.map(|before| self.motion(now, before.rotation.turns_per_second / usual));
                self.turn(again);
            }
            _ => {}
        }
        if self.outlet.next_ns().is_none()
            && let Some(stream) = &mut self.stream
            && let Some(at_ns) = stream.due_ns(self.motor).filter(|&at| at <= now)
            && let Some(packet) = stream.packet(self.motor, &mut self.optics)
        {
            self.outlet.send(packet, at_ns, false);
        }
    }

    fn reply(&mut self, telegram: Vec<u8>, now: Nanos) {
        let Habits { late_reply_ns, doubles, .. } = self.settings.habits;
        let copies = if self.random.f64() < doubles { 2 } else { 1 };
        for _ in 0..copies {
            self.outlet.send(telegram.clone(), now + ANSWER_NS + late_reply_ns, true);
        }
    }

    /// Does what a host asked for at `now`.
    fn obey(&mut self, request: Request, now: Nanos) {
        let is_motor_s = matches!(request, Request::Pwm(_) | Request::Rpm(_) | Request::Board);
        if !is_motor_s {
            // By the manual any request ends a stream.
            self.end_stream(now);
        }
        let (model, typical) = (self.settings.model, self.settings.typical);
        match request {
            Request::Stop => {}
            Request::Reset => {
                self.restart(now, RESTART_NS);
            }
            Request::Scan => self.begin(0, false, now),
            Request::Force => self.begin(0, true, now),
            // Number 0 is the first express mode to hosts that know no other.
            Request::Express(0) => {
                let first = model.modes().iter().position(|mode| mode.form == Form::Express);
                self.begin(first.unwrap_or(1), false, now);
            }
            Request::Express(number) => self.begin(usize::from(number), false, now),
            Request::Info => self.reply(answers::info(model, self.settings.seed), now),
            Request::Health => {
                let (status, code) = if self.held.is_some() { (ERROR, HELD) } else { self.health };
                self.reply(answers::health(status, code), now);
            }
            Request::SampleRate => self.reply(answers::sample_rate(model), now),
            Request::Configuration { key, mode } => {
                if let Some(answer) = answers::configuration(model, typical, key, mode) {
                    self.reply(answer, now);
                }
            }
            Request::SetConfiguration(key) => {
                self.writes += 1;
                self.reply(answers::is_set(key), now);
            }
            Request::Pwm(duty) if model.motor() == Motor::Pwm => {
                self.steer(f64::from(duty) / f64::from(answers::PWM), now);
            }
            Request::Rpm(rpm) if model.motor() == Motor::Rpm => {
                self.steer(f64::from(rpm) / (60.0 * model.turns_per_second()), now);
            }
            Request::Pwm(_) | Request::Rpm(_) => {}
            Request::Board => {
                if model.motor() != Motor::Rpm {
                    self.reply(answers::board(model.motor() == Motor::Pwm), now);
                }
            }
        }
    }

    /// Begins to stream in mode `number`, if it has one and is not in error.
    fn begin(&mut self, number: usize, forced: bool, now: Nanos) {
        let Some(&mode) = self.settings.model.modes().get(number) else { return };
        if self.health.0 == ERROR {
            return;
        }
        self.reply(answers::stream(&mode), now);
        self.measure(mode, forced, self.outlet.free_ns());
    }

    /// The motor turns at this share of its usual speed.
    fn steer(&mut self, share: f64, now: Nanos) {
        let wanted = (share > 0.0).then(|| self.motion(now, share));
        let speed = |motion: Motion| motion.rotation.turns_per_second;
        let motor = self.held.unwrap_or(self.motor);
        if wanted.map(speed) == motor.map(speed) {
            return;
        }
        match &mut self.held {
            Some(held) => *held = wanted,
            None => self.turn(wanted),
        }
    }
}

impl Device for Unit {
    fn poll_transmit(&mut self, now: Nanos) -> Option<Chunk> {
        self.advance(now);
        self.outlet.take(now)
    }

    fn poll_timeout(&self) -> Option<Nanos> {
        let data_ns = self.outlet.next_ns().or_else(|| self.stream?.due_ns(self.motor));
        // While it is held its end is still ahead.
        let held_ns = self.stalls.next_ns(if self.held.is_some() { 0 } else { Nanos::MAX });
        let times = [data_ns, self.boots_ns, Some(held_ns)];
        times.into_iter().flatten().filter(|&at| at < Nanos::MAX).min()
    }

    fn receive(&mut self, byte: u8, arrival: Arrival) {
        let now = arrival.not_after;
        if now < self.hears_ns {
            return;
        }
        let Some(request) = self.decoder.hear(byte) else { return };
        let Habits { mute, overlooks, .. } = self.settings.habits;
        let is_overlooked = self.random.f64() < overlooks;
        if !mute && !is_overlooked {
            self.obey(request, now);
        }
    }

    fn power_cycle(&mut self, now: Nanos) -> bool {
        let broken = self.restart(now, self.settings.boot_ns);
        let turns = self.settings.model.motor() != Motor::Pwm;
        let motion = turns.then(|| self.motion(now, 1.0));
        match &mut self.held {
            Some(held) => *held = motion,
            None => self.motor = motion,
        }
        broken
    }

    /// Restarts the scanner while its motor continues. The banner then stands in the middle of a stream.
    fn brown_out(&mut self, now: Nanos) -> bool {
        self.restart(now, RESTART_NS)
    }

    fn break_off(&mut self, now: Nanos) {
        self.outlet.break_off(now);
    }

    fn rate(&self) -> u32 {
        self.outlet.rate()
    }

    fn streams(&self) -> bool {
        self.stream.is_some_and(|stream| stream.begin_ns.is_some())
    }

    fn telegram_len(&self) -> Option<usize> {
        Some(self.stream?.mode.form.packet_len())
    }

    fn take_dropped(&mut self) -> Option<Dropped> {
        None
    }

    fn eeprom_writes(&self) -> u64 {
        self.writes
    }
}

/// A status of the health: it does not measure.
const ERROR: u8 = 2;
/// The code that it reports while something holds its head. Invented: the real ones are not published.
const HELD: u16 = 0x0001;
/// From RESET to the banner, and from the banner to the first request that it hears: measured of a real A1.
const RESTART_NS: Nanos = 671 * MILLIS;
const HEARS_NS: Nanos = 4 * MILLIS;
/// From a request to its answer.
const ANSWER_NS: Nanos = MILLIS;
/// How a motor gets up to speed: its time constant, and when it is near enough to measure.
const SPIN_UP_S: f64 = 0.4;
const STEADY_NS: Nanos = 1_600 * MILLIS;
