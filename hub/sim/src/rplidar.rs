//! A simulated RPLIDAR of Slamtec, without I/O. It replies to requests of a host, its motor spins up, and its head
//! measures one point after the other, each at its own time. It sends the points in packets of the requested mode.
//!
//! In a scanner that triangulates, the laser is next to the lens. The angle of a point therefore lags behind the angle
//! of the head by a shift that depends on the range, and points at the edge of a near object are out of angular order.
//! The vendor's decoder of packets of type 0x84 has a formula for the shift. The simulator uses this formula for all
//! modes of a scanner that triangulates. If the formula has no solution, which happens at an edge, the point has no
//! return.
//!
//! The sources of this behavior are the vendor's protocol manual and driver, and published measurements of a real A1M8.
//! The simulator does not reply to a request that none of these sources describes.

mod protocol;

use scanhub_schema::{MILLIS, Nanos};

use crate::device::{Chunk, Device};
use crate::device::{ChunkSize, TxQueue};
use crate::fault::{FaultWindow, Faults};
use crate::machine::ProtocolQuirks;
use crate::request_decoder::Arrival;
use crate::room::Room;
use crate::rotating::{BeamReading, BeamSampler, Rotation, TruePoint, counterclockwise_deg};
use protocol::{Decoder, Motor, Reading, Request};
pub use protocol::{Mode, Model, PacketFormat};

/// Settings of a scanner at the start of a simulation.
#[derive(Clone, Debug)]
pub struct RplidarSettings {
    /// The model.
    pub model: Model,
    /// Number that the scanner reports as its model. The default is the number of `model`.
    pub id: u8,
    /// Index of the mode that the scanner recommends. The default is the mode that `model` recommends.
    pub typical: usize,
    /// Mean revolutions per second. The default depends on `model`.
    pub revolutions_per_second: f64,
    /// Maximum deviation of the speed from its mean, as a share of the mean.
    pub speed_variation: f64,
    /// State at time 0.
    pub start: RplidarStart,
    /// Time from power-on to the boot message.
    pub boot_ns: Nanos,
    /// Health status and code that the scanner reports. With status 2, an error, the scanner does not measure.
    pub health: (u8, u16),
    /// Whether the health status remains after a RESET.
    pub keeps_health: bool,
    /// Deviations from the manual. Deviations that only an LMS has are ignored.
    pub quirks: ProtocolQuirks,
    /// Faults of the simulation. The scanner uses only those that block its head.
    pub faults: Faults,
    /// Number of bytes that the host's hardware delivers at once.
    pub chunk: ChunkSize,
    /// Seed of the variation of the speed, the serial number, the deviations and the faults.
    pub seed: u64,
}

/// State of a scanner at time 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RplidarStart {
    /// The scanner waits for requests. Its motor is on or off as after power-on. If it is on, it is at full speed.
    Idle,
    /// The scanner streams in the mode that it recommends, because an earlier host has not stopped the stream.
    Streaming,
    /// The power is switched on now.
    PowerOn,
}

impl RplidarSettings {
    /// Returns the factory settings of `model`, for a scanner that was switched on long ago.
    pub fn of(model: Model) -> RplidarSettings {
        RplidarSettings {
            model,
            id: model.id(),
            typical: model.typical(),
            revolutions_per_second: model.revolutions_per_second(),
            speed_variation: 0.005,
            start: RplidarStart::Idle,
            boot_ns: 2_000 * MILLIS,
            health: (0, 0),
            keeps_health: false,
            quirks: ProtocolQuirks::default(),
            faults: Faults::default(),
            chunk: ChunkSize::Uart,
            seed: 0,
        }
    }
}

/// A simulated RPLIDAR.
pub struct RplidarSimulator {
    settings: RplidarSettings,
    optics: Optics,
    decoder: Decoder,
    tx_queue: TxQueue,
    random: fastrand::Rng,
    /// Motion of the motor; `None` while it is off or blocked.
    motor: Option<Motion>,
    stream: Option<Stream>,
    health: (u8, u16),
    /// Time at which the scanner sends the boot message; `None` after the start-up.
    boot_at_ns: Option<Nanos>,
    /// Time from which on the scanner receives requests.
    receives_from_ns: Nanos,
    stalls: FaultWindow,
    /// Motion that the motor resumes when the head is free again: `Some(None)` if the motor stays off. `None` while the
    /// head is not blocked.
    held_motion: Option<Option<Motion>>,
    writes: u64,
}

impl RplidarSimulator {
    /// Creates the scanner with `settings` in `room`, at time 0.
    pub fn new(settings: RplidarSettings, room: Room) -> RplidarSimulator {
        let RplidarSettings { model, seed, health, .. } = settings;
        let mut simulator = RplidarSimulator {
            optics: Optics::new(model, room, seed),
            decoder: Decoder::default(),
            tx_queue: TxQueue::new(model.baud(), settings.chunk),
            random: fastrand::Rng::with_seed(!seed),
            motor: None,
            stream: None,
            health,
            boot_at_ns: None,
            receives_from_ns: 0,
            stalls: FaultWindow::stalls(&settings.faults, seed),
            held_motion: None,
            writes: 0,
            settings,
        };
        match simulator.settings.start {
            RplidarStart::PowerOn => {
                simulator.power_cycle(0);
            }
            start => {
                let turns = start == RplidarStart::Streaming || model.motor() != Motor::Pwm;
                simulator.motor = turns.then(|| Motion { steady_ns: 0, ..simulator.motion(0, 1.0) });
                simulator.motor.iter_mut().for_each(|motion| motion.rotation.spin_up_s = 0.0);
                if start == RplidarStart::Streaming {
                    simulator.start_stream(model.modes()[simulator.settings.typical], false, 0);
                }
            }
        }
        simulator
    }

    /// Returns the point with index `point` of the present stream, without noise. Returns `None` if the stream has not
    /// had its first point yet.
    pub fn truth(&mut self, point: u64) -> Option<TruePoint> {
        let (at_ns, head_deg) = self.stream?.time_and_angle(point, self.motor)?;
        Some(self.optics.truth(at_ns, head_deg))
    }

    /// Returns the time of the first point of the present stream, or `None` before the first point.
    pub fn begin_ns(&self) -> Option<Nanos> {
        self.stream?.begin_ns
    }

    /// Returns the mode of the stream, or `None` if there is no stream.
    pub fn mode(&self) -> Option<Mode> {
        Some(self.stream?.mode)
    }

    /// Returns the number of packets of the present stream, including the packet on the line. The next packet begins
    /// with the point after the last point of these packets. Returns `None` if the stream has not had its first point
    /// yet.
    pub fn sent(&self) -> Option<u64> {
        self.begin_ns()?;
        Some(self.stream?.sent())
    }

    /// Returns the mean revolutions per second of the motor, or `None` while it is off.
    pub fn revolutions_per_second(&self) -> Option<f64> {
        Some(self.motor?.rotation.revolutions_per_second)
    }

    /// Changes the speed of a motor that is on. The change takes effect at the next packet of the stream. The caller
    /// has to simulate the inertia of a real head.
    pub fn set_speed(&mut self, revolutions_per_second: f64) {
        let next = self.stream.and_then(|stream| stream.next_ns(self.motor));
        if let (Some(motor), Some(next_ns)) = (&mut self.motor, next) {
            let seconds = next_ns.saturating_sub(motor.since_ns) as f64 / 1e9;
            motor.rotation.set_speed(seconds, revolutions_per_second);
        }
    }

    /// Changes the deviations from the manual from now on.
    pub fn set_quirks(&mut self, quirks: ProtocolQuirks) {
        self.settings.quirks = quirks;
    }

    /// Blocks the head from `now` on for `span`.
    pub fn hold(&mut self, now: Nanos, span: Nanos) {
        self.stalls = FaultWindow::once(now, span);
    }

    /// Changes the health status and code that the scanner reports. Both remain after a RESET if `stubborn` is set. A
    /// status of 2 ends a stream.
    pub fn set_health(&mut self, now: Nanos, health: (u8, u16), stubborn: bool) {
        (self.health, self.settings.keeps_health) = (health, stubborn);
        if health.0 == HEALTH_ERROR {
            self.end_stream(now);
        }
    }

    /// Returns the motion of a motor that starts at `now`. Its speed is `share` of the usual speed.
    fn motion(&self, now: Nanos, share: f64) -> Motion {
        let RplidarSettings { revolutions_per_second, speed_variation: wander, seed, .. } = self.settings;
        let revolutions_per_second = revolutions_per_second * share;
        let rotation = Rotation::new(revolutions_per_second, wander, SPIN_UP_TIME_S, seed);
        Motion { since_ns: now, steady_ns: now + SETTLE_TIME_NS, rotation }
    }

    /// Changes the motion of the motor. The present stream restarts, because it waits for a steady speed, unless it
    /// measures at any speed.
    fn set_motion(&mut self, motion: Option<Motion>) {
        self.motor = motion;
        if let Some(stream) = self.stream.filter(|stream| !stream.forced) {
            self.start_stream(stream.mode, false, stream.requested_ns);
        }
    }

    /// Starts a stream in `mode` that was requested at `requested_ns`. Points follow as soon as the speed of the motor
    /// is steady.
    fn start_stream(&mut self, mode: Mode, forced: bool, requested_ns: Nanos) {
        self.stream = Some(Stream::new(self.settings.model, mode, forced, requested_ns, self.motor));
    }

    fn end_stream(&mut self, now: Nanos) {
        if self.stream.take().is_some() {
            self.tx_queue.drop_data(now);
        }
    }

    /// Restarts the scanner, which sends the boot message after `span`. Returns whether a packet was aborted.
    fn restart(&mut self, now: Nanos, span: Nanos) -> bool {
        let broken = self.tx_queue.abort(now);
        self.stream = None;
        self.decoder.forget();
        self.boot_at_ns = Some(now + span);
        self.receives_from_ns = Nanos::MAX;
        if !self.settings.keeps_health {
            self.health = (0, 0);
        }
        broken
    }

    /// Carries out everything that is due by `now`.
    fn advance(&mut self, now: Nanos) {
        if self.boot_at_ns.is_some_and(|at| at <= now) {
            let at_ns = self.boot_at_ns.take().unwrap_or(now);
            self.tx_queue.send(protocol::boot_message(self.settings.model, self.settings.id), at_ns, true);
            self.receives_from_ns = self.tx_queue.free_ns() + BOOT_TO_REQUEST_NS;
        }
        match (self.stalls.is_active(now), self.held_motion) {
            (true, None) => {
                self.held_motion = Some(self.motor);
                self.set_motion(None);
            }
            (false, Some(previous)) => {
                self.held_motion = None;
                let usual = self.settings.revolutions_per_second;
                let motion = previous
                    .map(|previous| self.motion(now, previous.rotation.revolutions_per_second / usual));
                self.set_motion(motion);
            }
            _ => {}
        }
        if self.tx_queue.next_ns().is_none()
            && let Some(stream) = &mut self.stream
            && let Some(at_ns) = stream.due_ns(self.motor).filter(|&at| at <= now)
            && let Some(packet) = stream.packet(self.motor, &mut self.optics)
        {
            self.tx_queue.send(packet, at_ns, false);
        }
    }

    fn reply(&mut self, telegram: Vec<u8>, now: Nanos) {
        let ProtocolQuirks { late_reply_ns, doubled_share: doubles, .. } = self.settings.quirks;
        let copies = if self.random.f64() < doubles { 2 } else { 1 };
        for _ in 0..copies {
            self.tx_queue.send(telegram.clone(), now + RESPONSE_DELAY_NS + late_reply_ns, true);
        }
    }

    /// Carries out a request that arrived at `now`.
    fn handle_request(&mut self, request: Request, now: Nanos) {
        let is_motor_s = matches!(request, Request::Pwm(_) | Request::Rpm(_) | Request::Board);
        if !is_motor_s {
            // By the manual, every request that is not for the motor ends a stream.
            self.end_stream(now);
        }
        let (model, typical) = (self.settings.model, self.settings.typical);
        match request {
            Request::Stop => {}
            Request::Reset => {
                self.restart(now, RESTART_NS);
            }
            Request::Scan => self.start_mode(0, false, now),
            Request::Force => self.start_mode(0, true, now),
            // Number 0 selects the first express mode. Hosts that support no other express mode send this number.
            Request::Express(0) => {
                let first = model.modes().iter().position(|mode| mode.form == PacketFormat::Express);
                self.start_mode(first.unwrap_or(1), false, now);
            }
            Request::Express(number) => self.start_mode(usize::from(number), false, now),
            Request::Info => self.reply(protocol::info(model, self.settings.id, self.settings.seed), now),
            Request::Health => {
                let (status, code) =
                    if self.held_motion.is_some() { (HEALTH_ERROR, HELD_CODE) } else { self.health };
                self.reply(protocol::health(status, code), now);
            }
            Request::SampleRate => self.reply(protocol::sample_rate(model), now),
            Request::Configuration { key, mode } => {
                if let Some(answer) = protocol::configuration(model, typical, key, mode) {
                    self.reply(answer, now);
                }
            }
            Request::SetConfiguration(key) => {
                self.writes += 1;
                self.reply(protocol::configuration_stored(key), now);
            }
            Request::Pwm(duty) if model.motor() == Motor::Pwm => {
                self.set_speed_share(f64::from(duty) / f64::from(protocol::DEFAULT_PWM), now);
            }
            Request::Rpm(rpm) if model.motor() == Motor::Rpm => {
                self.set_speed_share(f64::from(rpm) / (60.0 * model.revolutions_per_second()), now);
            }
            Request::Pwm(_) | Request::Rpm(_) => {}
            Request::Board => {
                if model.motor() != Motor::Rpm {
                    self.reply(protocol::accessory_board(model.motor() == Motor::Pwm), now);
                }
            }
        }
    }

    /// Starts a stream in mode `number`, if the model has this mode and the health status is not an error.
    fn start_mode(&mut self, number: usize, forced: bool, now: Nanos) {
        let Some(&mode) = self.settings.model.modes().get(number) else { return };
        if self.health.0 == HEALTH_ERROR {
            return;
        }
        self.reply(protocol::stream_descriptor(&mode), now);
        self.start_stream(mode, forced, self.tx_queue.free_ns());
    }

    /// Sets the speed of the motor to `share` of its usual speed; 0 stops the motor.
    fn set_speed_share(&mut self, share: f64, now: Nanos) {
        let motion = (share > 0.0).then(|| self.motion(now, share));
        let speed = |motion: Motion| motion.rotation.revolutions_per_second;
        let motor = self.held_motion.unwrap_or(self.motor);
        if motion.map(speed) == motor.map(speed) {
            return;
        }
        match &mut self.held_motion {
            Some(held) => *held = motion,
            None => self.set_motion(motion),
        }
    }
}

impl Device for RplidarSimulator {
    fn poll_transmit(&mut self, now: Nanos) -> Option<Chunk> {
        self.advance(now);
        self.tx_queue.take(now)
    }

    fn poll_timeout(&self) -> Option<Nanos> {
        let data_ns = self.tx_queue.next_ns().or_else(|| self.stream?.due_ns(self.motor));
        // While the head is blocked, the next change is the end of the block. Otherwise it is the start of the next
        // block.
        let held_ns = self.stalls.next_ns(if self.held_motion.is_some() { 0 } else { Nanos::MAX });
        let times = [data_ns, self.boot_at_ns, Some(held_ns)];
        times.into_iter().flatten().filter(|&at| at < Nanos::MAX).min()
    }

    fn receive(&mut self, byte: u8, arrival: Arrival) {
        let now = arrival.not_after;
        if now < self.receives_from_ns {
            return;
        }
        let Some(request) = self.decoder.receive(byte) else { return };
        let ProtocolQuirks { is_mute: mute, overlooked_share: overlooks, .. } = self.settings.quirks;
        let is_overlooked = self.random.f64() < overlooks;
        if !mute && !is_overlooked {
            self.handle_request(request, now);
        }
    }

    fn power_cycle(&mut self, now: Nanos) -> bool {
        let broken = self.restart(now, self.settings.boot_ns);
        let turns = self.settings.model.motor() != Motor::Pwm;
        let motion = turns.then(|| self.motion(now, 1.0));
        match &mut self.held_motion {
            Some(held) => *held = motion,
            None => self.motor = motion,
        }
        broken
    }

    /// Restarts the scanner while its motor continues. For the host, the boot message arrives during a stream.
    fn brown_out(&mut self, now: Nanos) -> bool {
        self.restart(now, RESTART_NS)
    }

    fn abort(&mut self, now: Nanos) {
        self.tx_queue.abort(now);
    }

    fn rate(&self) -> u32 {
        self.tx_queue.rate()
    }

    fn streams(&self) -> bool {
        self.stream.is_some_and(|stream| stream.begin_ns.is_some())
    }

    fn telegram_len(&self) -> Option<usize> {
        Some(self.stream?.mode.form.packet_len())
    }

    fn eeprom_writes(&self) -> u64 {
        self.writes
    }
}

/// Motion of a motor that is on.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Motion {
    since_ns: Nanos,
    /// Time from which on the speed is steady enough to measure.
    steady_ns: Nanos,
    rotation: Rotation,
}

/// A stream of points in one mode. It determines the time and the head angle of each point, and the time at which a
/// packet has all its points.
#[derive(Clone, Copy, Debug)]
struct Stream {
    mode: Mode,
    /// Whether the scanner measures at any speed of the motor.
    forced: bool,
    /// Time of the request.
    requested_ns: Nanos,
    /// Time of the first point, which may be in the future; `None` while the motor is off.
    begin_ns: Option<Nanos>,
    /// Time from one point to the next.
    sample_ns: f64,
    /// Number of packets since the first point.
    sent: u64,
}

impl Stream {
    /// Creates a stream of `model` in `mode` that was requested at `requested_ns`. The stream starts as soon as the
    /// speed of `motor` is steady, or at once if it is `forced`.
    fn new(model: Model, mode: Mode, forced: bool, requested_ns: Nanos, motor: Option<Motion>) -> Stream {
        let steady_ns = if forced { Some(0) } else { motor.map(|motion| motion.steady_ns) };
        let begin_ns = steady_ns.map(|steady_ns| steady_ns.max(requested_ns));
        let sample_ns = 1e3 * mode.sample_us * model.clock_ratio();
        Stream { mode, forced, requested_ns, begin_ns, sample_ns, sent: 0 }
    }

    /// Returns the time of the point with index `point`, and the clockwise angle of the head from its zero at this
    /// time, in degrees.
    fn time_and_angle(&self, point: u64, motor: Option<Motion>) -> Option<(Nanos, f64)> {
        let at_ns = self.begin_ns? + (point as f64 * self.sample_ns) as Nanos;
        let turns = motor.map_or(0.0, |motion| {
            motion.rotation.revolutions(at_ns.saturating_sub(motion.since_ns) as f64 / 1e9)
        });
        Some((at_ns, turns.fract() * 360.0))
    }

    /// Returns the number of packets, including the packet on the line.
    fn sent(&self) -> u64 {
        self.sent
    }

    /// Returns the time of the first point of the next packet.
    fn next_ns(&self, motor: Option<Motion>) -> Option<Nanos> {
        self.time_and_angle(self.sent * self.mode.form.points() as u64, motor).map(|(at_ns, _)| at_ns)
    }

    /// Returns the time at which the next packet has all its points.
    fn due_ns(&self, motor: Option<Motion>) -> Option<Nanos> {
        let points = self.mode.form.points() as u64 * (self.sent + 1);
        // The last ranges of such a packet are sent as differences from the first range of the next packet, so the
        // packet must wait for that range.
        let last = if self.mode.form == PacketFormat::Ultra { points } else { points - 1 };
        self.time_and_angle(last, motor).map(|(at_ns, _)| at_ns)
    }

    /// Returns the next packet, with points that `optics` measures.
    fn packet(&mut self, motor: Option<Motion>, optics: &mut Optics) -> Option<Vec<u8>> {
        let Mode { form, reach_m, .. } = self.mode;
        let clock_us = (self.due_ns(motor)? / 1_000) as u32;
        let first = self.sent * form.points() as u64;
        let mut readings = Vec::with_capacity(form.points() + 1);
        for point in first..=first + form.points() as u64 {
            let (at_ns, head_deg) = self.time_and_angle(point, motor)?;
            let before = point.checked_sub(1).and_then(|point| self.time_and_angle(point, motor));
            let begins_turn = before.is_some_and(|(_, before_deg)| before_deg > head_deg);
            let is_needed = form == PacketFormat::Ultra || readings.len() < form.points();
            let reading =
                if is_needed { optics.measure(at_ns, head_deg, reach_m) } else { Reading::default() };
            readings.push(Reading { begins_revolution: begins_turn, ..reading });
        }
        let next = readings.pop()?;
        let is_first = self.sent == 0;
        self.sent += 1;
        Some(match form {
            PacketFormat::Standard => protocol::standard(&readings[0]),
            PacketFormat::Express => protocol::express(is_first, &readings),
            PacketFormat::Ultra => protocol::ultra(is_first, &readings, &next),
            PacketFormat::Dense => protocol::dense(is_first, &readings),
            PacketFormat::UltraDense => protocol::ultra_dense(is_first, clock_us, &readings),
        })
    }
}

/// Optics of a head in a room. They determine for each point which position the laser hits, and whether and how
/// strongly the surface at this position reflects.
struct Optics {
    model: Model,
    beams: BeamSampler,
    seed: u64,
}

impl Optics {
    pub(crate) fn new(model: Model, room: Room, seed: u64) -> Optics {
        Optics { model, beams: BeamSampler::new(room), seed }
    }

    /// Returns the point at `at_ns` with the head at `head_deg`, without noise.
    pub(crate) fn truth(&mut self, at_ns: Nanos, head_deg: f64) -> TruePoint {
        let (clockwise_deg, beam) = self.hit(at_ns, head_deg);
        TruePoint { at_ns, clockwise_deg, range_mm: beam.and_then(|beam| beam.exact_mm) }
    }

    /// Returns the reading at `at_ns` with the head at `head_deg`, in a mode with a maximum range of `reach_m` meters.
    pub(crate) fn measure(&mut self, at_ns: Nanos, head_deg: f64, reach_m: f64) -> Reading {
        let (clockwise_deg, beam) = self.hit(at_ns, head_deg);
        let shift_deg = self.shift_without_return_deg(at_ns);
        let no_return =
            Reading { head_deg, clockwise_deg: (head_deg - shift_deg + 360.0) % 360.0, ..Reading::default() };
        let Some(beam) = beam.filter(|beam| self.has_return(at_ns, clockwise_deg, beam)) else {
            return no_return;
        };
        let is_in_reach = |mm: &f64| self.model.reach_mm().contains(mm) && *mm <= 1e3 * reach_m;
        let Some(range_mm) = beam.range_mm.filter(is_in_reach) else { return no_return };
        // Type 0x81 has only the upper six bits of the quality. The quality of a return must not become 0 there.
        let quality = beam.intensity.max(4);
        Reading { clockwise_deg, range_mm: range_mm.round() as u16, quality, ..no_return }
    }

    /// Returns the clockwise angle of the point that the laser hits, in degrees from the head's zero, and the reading
    /// at this point. The reading is `None` if the formula of the shift has no solution.
    fn hit(&mut self, at_ns: Nanos, head_deg: f64) -> (f64, Option<BeamReading>) {
        let mut measure = |clockwise_deg: f64| self.beams.measure(at_ns, counterclockwise_deg(clockwise_deg));
        if !self.model.triangulates() {
            return (head_deg, Some(measure(head_deg)));
        }
        let angle_behind = |range_mm: Option<f64>| (head_deg - shift_deg(range_mm) + 360.0) % 360.0;
        let mut clockwise_deg = angle_behind(Some(START_RANGE_MM));
        for _ in 0..MAX_ITERATIONS {
            let beam = measure(clockwise_deg);
            let hit_deg = angle_behind(beam.exact_mm);
            if hit_deg == clockwise_deg {
                return (clockwise_deg, Some(beam));
            }
            clockwise_deg = hit_deg;
        }
        (angle_behind(None), None)
    }

    /// Returns the shift that the scanner reports for a point without a return, in degrees. A real A1 reports 12 % of
    /// its points out of angular order, and the first point of a revolution anywhere from 351 to 359.5 degrees. The
    /// rule by which it selects this shift is unknown, so the shift is random.
    fn shift_without_return_deg(&self, at_ns: Nanos) -> f64 {
        if !self.model.triangulates() {
            return 0.0;
        }
        let mut random = fastrand::Rng::with_seed(!self.seed ^ at_ns);
        if random.f64() < STRAY_SHARE { 2.0 + 7.0 * random.f64() } else { shift_deg(None) }
    }

    /// Returns whether the echo is strong enough for a return. Indoors, scanners that triangulate lose most points,
    /// because many surfaces are dark, far or oblique. The darkness is drawn for each [`PATCH_DEG`] of direction.
    fn has_return(&self, at_ns: Nanos, clockwise_deg: f64, beam: &BeamReading) -> bool {
        if !self.model.triangulates() {
            return true;
        }
        let patch = (clockwise_deg / PATCH_DEG) as u64;
        let dark = fastrand::Rng::with_seed(self.seed ^ patch.wrapping_mul(0x9E37_79B9_7F4A_7C15)).f64();
        let noise = fastrand::Rng::with_seed(self.seed ^ at_ns).f64();
        beam.signal * (0.75 + 0.5 * noise) > MIN_SIGNAL * MAX_DARKNESS.powf(dark)
    }
}

/// Returns the angle by which a point at `range_mm` lags behind the head, in degrees. The formula has the steps of the
/// vendor's decoder: 8 degrees - (k / 1024 + k^3 / 6442450944) radians, where k is the integer part of 98361 / (4
/// range). Below 50 mm and without a return, the angle is 7.5 degrees.
fn shift_deg(range_mm: Option<f64>) -> f64 {
    match range_mm {
        Some(range_mm) if range_mm >= 50.0 => {
            let k = (98_361.0 / (4.0 * range_mm.round())).floor();
            8.0 - (k / 1_024.0 + k.powi(3) / 6_442_450_944.0).to_degrees()
        }
        _ => 7.5,
    }
}

/// Health status of a scanner that does not measure.
const HEALTH_ERROR: u8 = 2;
/// Health code while the head is blocked. It is invented, because the vendor does not publish the codes.
const HELD_CODE: u16 = 0x0001;
/// Time from RESET to the boot message, as measured on a real A1.
const RESTART_NS: Nanos = 671 * MILLIS;
/// Time from the boot message to the first request that the scanner receives, as measured on a real A1.
const BOOT_TO_REQUEST_NS: Nanos = 4 * MILLIS;
/// Time from a request to its response.
const RESPONSE_DELAY_NS: Nanos = MILLIS;
/// Time constant of the motor's spin-up, in seconds.
const SPIN_UP_TIME_S: f64 = 0.4;
/// Time from the start of the motor until its speed is steady enough to measure.
const SETTLE_TIME_NS: Nanos = 1_600 * MILLIS;
/// Share of the points without a return whose reported angle is random, from 2 to 9 degrees behind the head.
const STRAY_SHARE: f64 = 0.27;
/// Assumed range with which the iteration for the angle of a point starts, in millimeters.
const START_RANGE_MM: f64 = 3_000.0;
/// Maximum number of steps of the iteration for the angle of a point.
const MAX_ITERATIONS: usize = 6;
/// Angle within which all surfaces are equally dark, in degrees.
const PATCH_DEG: f64 = 2.0;
/// Minimum signal for a return from the brightest surfaces, relative to a white surface at 1 m. The darkest surfaces
/// need a signal that is [`MAX_DARKNESS`] times as strong. With these values, 61 to 84 % of the points indoors are
/// invalid, as on a real A1.
const MIN_SIGNAL: f64 = 0.003;
/// Ratio of the signals that the darkest and the brightest surfaces need.
const MAX_DARKNESS: f64 = 20_000.0;
