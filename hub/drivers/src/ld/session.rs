//! Session with an LDROBOT scanner, which streams without a request. The session sends nothing. It listens at the
//! model's baud rate. If the model is unknown, it alternates between the two baud rates of the family until packets
//! arrive. It measures the number of points per second. It returns packets as they arrive, and also complete
//! revolutions.

use core::fmt;

use scanhub_schema::{Family, MILLIS, Nanos, line_time};

use crate::ld::packet::{Framer, PACKET_LEN, POINTS_PER_PACKET, Packet, Span};
use crate::ld::point_count::{CountedRevolution, PointCount};
use crate::ld::sequence::{PacketPosition, PacketSequencer, Restarts};
use crate::ld::{FEATURES, Model, describe};
use crate::line::{
    self, Action, ByteCounters, ClosedRevolution, Control, Event, RawScan, ReadScheduler, ReceivedTelegram,
    RevolutionAssembler, RevolutionCounts, RotationRate, SensorClock, SessionStats, State, StreamCounters,
    StreamTiming, Watchdog, family,
};
use crate::settings::Settings;

/// Session with an LDROBOT scanner.
#[derive(Clone, Debug)]
pub struct LdSession {
    settings: Settings,
    framer: Framer,
    reads: ReadScheduler,
    clock: SensorClock,
    /// Index of the first packet of a new sequence among the packets that were returned last, and the clock for the
    /// packets before it. `None` if no sequence started in these packets.
    clock_before: Option<(usize, SensorClock)>,
    sequencer: PacketSequencer,
    revolutions: RevolutionAssembler<MAX_POINTS>,
    /// Speed of the head according to the packet whose points were added last.
    rotation_rate: Option<RotationRate>,
    phase: Phase,
    baud: u32,
    change_baud: bool,
    point_count: PointCount,
    /// Model and number of beams that the session derived from the measured points. A power cycle of the scanner does
    /// not reset them.
    measured: Option<(Model, usize)>,
    /// Start of the stream. If the number of beams is still undecided [`DECISION_TIMEOUT`] later, the session uses a
    /// default.
    undecided_since: Nanos,
    /// Number of beams that fits the recent revolutions better than `measured`, and the time of the scanner's clock
    /// since which this has been so.
    other_beams: Option<(usize, Nanos)>,
    /// Last change of the number of beams, and the time until which the session reports it.
    beams_change: Option<(Problem, Nanos)>,
    /// Number of beams of a scan.
    beams: Option<usize>,
    /// Whether the number of points per second is known for this stream.
    is_rate_known: bool,
    scanner_time: Option<Nanos>,
    /// Returned packets whose points have not been added to revolutions yet.
    current: Option<PendingPackets>,
    now: Nanos,
    problem: Option<Problem>,
    /// Time since which no packet has arrived.
    no_packet_since: Nanos,
    counters: StreamCounters,
    restarts: Restarts,
}

#[derive(Clone, Copy, Debug)]
enum Phase {
    /// No packet has arrived. At `next_at` the session changes to the other baud rate.
    Listening { shown: State, next_at: Nanos },
    /// Packets are arriving.
    Streaming(Watchdog),
    /// A user has paused the session.
    Paused,
}

/// Packets that were returned, and whose points the session is adding to revolutions.
#[derive(Clone, Copy, Debug)]
struct PendingPackets {
    span: Span,
    positions: [PacketPosition; MAX_PACKETS_PER_SAMPLE],
    /// Index of the first packet whose points are not completely processed.
    packet: usize,
    /// Whether the points of the packet at this index were added.
    is_added: bool,
}

impl LdSession {
    /// Creates a session on a port that is open at the baud rate of the model in `settings`, or at the default rate.
    pub fn new(settings: Settings, now: Nanos) -> Self {
        LdSession {
            settings,
            framer: Framer::default(),
            reads: ReadScheduler::new(now),
            clock: SensorClock::new(),
            clock_before: None,
            sequencer: PacketSequencer::new(),
            revolutions: RevolutionAssembler::new(),
            rotation_rate: None,
            point_count: PointCount::default(),
            measured: None,
            undecided_since: now,
            other_beams: None,
            beams_change: None,
            phase: Phase::Listening { shown: State::Probing, next_at: now + LISTEN_TIME },
            baud: Model::of(&settings).map_or(FEATURES.defaults.baud, Model::baud),
            change_baud: false,
            beams: None,
            is_rate_known: false,
            scanner_time: None,
            current: None,
            now,
            problem: None,
            no_packet_since: now,
            counters: StreamCounters::default(),
            restarts: Restarts::default(),
        }
    }

    /// Restores the model and the number of beams that an earlier session measured on the same port. Call it before the
    /// first read.
    pub fn restore_model(&mut self, model: Model, beams: usize) {
        self.measured = Some((model, beams));
    }

    /// Returns the model. If several models cannot be distinguished, returns one of them. Returns `None` while the
    /// model is unknown.
    pub fn model(&self) -> Option<Model> {
        Model::of(&self.settings).or(self.measured.map(|(model, _)| model))
    }

    /// Returns the number of beams of a scan. The number in the settings takes precedence over the default of the
    /// configured model, and this default over the measured number.
    fn known_beams(&self) -> Option<usize> {
        let of_model = || Model::of(&self.settings).map(Model::beams);
        let measured = || self.measured.map(|(_, beams)| beams);
        let beams = self.settings.beams.or_else(of_model).or_else(measured)?;
        Some(beams.min(self.settings.max_beams.unwrap_or(usize::MAX)))
    }

    /// Updates the measured model and the measured number of beams with a revolution. The caller does this only if no
    /// model is configured. The first reliable number of points determines the model and the number of beams. Later,
    /// they change only if the number of points has been different for a long time.
    fn update_beams(&mut self, counted: CountedRevolution) {
        let Some((_, beams)) = self.measured else {
            self.measured = counted.is_final().then(|| (counted.model(), counted.beams()));
            return;
        };
        if !counted.is_final() || !counted.differs_from(beams) {
            self.other_beams = None;
            return;
        }
        // If the scanner restarts, its clock restarts at 0. A time from before the restart is then not comparable.
        let is_same = |&(other, since): &(usize, Nanos)| !counted.differs_from(other) && since <= counted.at;
        let known = self.other_beams.filter(is_same);
        let (other, since) = *self.other_beams.insert(known.unwrap_or((counted.beams(), counted.at)));
        if counted.at.saturating_sub(since) < CHANGE_DELAY {
            return;
        }
        (self.measured, self.other_beams) = (Some((counted.model(), other)), None);
        if self.settings.beams.is_none() {
            self.is_rate_known = false;
            let problem = Problem::BeamsChanged { from: beams, to: other };
            self.beams_change = Some((problem, self.now + CHANGE_REPORT_TIME));
        }
    }

    /// Returns the scanner's model if it differs from the configured model. Models with the same number of points per
    /// second cannot be distinguished.
    fn unexpected_model_by_rate(&self) -> Option<Model> {
        let configured = Model::of(&self.settings)?;
        self.model_by_rate().filter(|model| model.points_per_second() != configured.points_per_second())
    }

    /// Returns the model that measures the current number of points per second.
    fn model_by_rate(&self) -> Option<Model> {
        self.sequencer.points_per_second().map(Model::of_point_rate)
    }

    /// Returns the number of points that the scanner measures per second. Returns `None` until enough packets have
    /// arrived.
    pub fn points_per_second(&self) -> Option<f32> {
        self.sequencer.points_per_second()
    }

    /// Returns the counters of the framer.
    pub fn byte_counters(&self) -> &ByteCounters {
        self.framer.buffer.byte_counters()
    }

    /// Returns the counts of revolutions by kind.
    pub fn revolution_counts(&self) -> RevolutionCounts {
        self.revolutions.counts()
    }

    /// Returns the baud rates at which packets may arrive, in bits per second.
    fn rates(&self) -> &'static [u32] {
        const BOTH: [u32; 2] = [230_400, 921_600];
        let at = usize::from(self.baud == BOTH[1]);
        if self.settings.model.is_some() || self.settings.fixed_rate { &BOTH[at..=at] } else { &BOTH }
    }

    /// Ends the stream and waits for packets. `shown` is the session's state until packets arrive.
    fn listen(&mut self, shown: State) {
        self.phase = Phase::Listening { shown, next_at: self.now + LISTEN_TIME };
        self.no_packet_since = self.now;
        self.sequencer.end();
        self.revolutions.discard();
        self.is_rate_known = false;
        self.current = None;
        self.reads.cancel_wait();
    }

    /// Changes to the other baud rate because no packet arrived at the present one. Updates the duration in the
    /// session's problem.
    fn listen_at_next_rate(&mut self, shown: State) {
        self.phase = Phase::Listening { shown, next_at: self.now + LISTEN_TIME };
        let rates = self.rates();
        if let Some(&next) = rates.iter().find(|&&rate| rate != self.baud) {
            self.baud = next;
            self.change_baud = true;
        }
        let seconds = (self.now.saturating_sub(self.no_packet_since) / (1_000 * MILLIS)) as u32;
        if seconds > 0 {
            let seconds = 1 << seconds.ilog2();
            let baud = (rates.len() == 1).then_some(self.baud);
            self.problem = Some(Problem::NoPackets { baud, seconds });
        }
    }

    /// Handles deadlines after all bytes were framed. Bytes that are not part of a packet do not extend a deadline.
    fn handle_deadlines(&mut self) {
        match self.phase {
            Phase::Listening { shown, next_at } if self.now >= next_at => self.listen_at_next_rate(shown),
            Phase::Streaming(watchdog) if watchdog.is_silent(self.now) => {
                self.counters.note_resync();
                self.problem = Some(Problem::Silence);
                self.listen(State::Silent);
            }
            Phase::Streaming(watchdog) if watchdog.is_revolution_overdue(self.now) => {
                self.problem = self.counters.overdue_problem(
                    self.framer.buffer.byte_counters(),
                    Problem::HeadBlocked,
                    Problem::DamagedRevolutions,
                );
            }
            _ => {}
        }
    }

    /// Returns the packets of `span` with their stamps, and keeps them for
    /// [`advance_revolutions`](Self::advance_revolutions).
    fn receive(&mut self, span: Span) -> ReceivedTelegram<'_> {
        let mut span = span;
        span.reasons |= self.reads.take_suspect(span.offset + (span.packets * PACKET_LEN) as u64);
        let line_rate = (!self.settings.fixed_rate).then_some(self.baud);
        let packet_time = line_time(PACKET_LEN, self.baud);
        let mut positions = [PacketPosition::Outlier; MAX_PACKETS_PER_SAMPLE];
        self.clock_before = None;
        let timing = StreamTiming {
            byte_ns: self.sequencer.packet_ns() / PACKET_LEN as f64,
            packet_len: PACKET_LEN,
            line_rate,
        };
        let mut counted = None;
        let (bytes, _) = self.framer.bytes(span).as_chunks::<PACKET_LEN>();
        for (number, bytes) in bytes.iter().enumerate() {
            let packet = Packet::assume_valid(bytes);
            let position = self.sequencer.locate(&packet);
            counted = self.point_count.note_packet(&packet, position).or(counted);
            self.measured = self.measured.or_else(|| self.point_count.typical_model());
            let end = span.offset + ((number + 1) * PACKET_LEN - 1) as u64;
            if matches!(position, PacketPosition::First { .. }) {
                let arrivals = self.reads.read_log();
                let earliest = arrivals.earliest_after_gap(end, timing);
                let arrival = earliest.map(|earliest| (earliest, arrivals.latest(end, line_rate)));
                self.restarts.note_first(packet.millis(), arrival);
                let before = core::mem::replace(&mut self.clock, SensorClock::new());
                self.clock_before.get_or_insert((number, before));
            }
            if let Some(time) = position.time() {
                self.clock.note_arrival(
                    time,
                    self.reads.read_log().latest(end, line_rate).saturating_sub(packet_time),
                );
            }
            if let PacketPosition::Next { time, .. } = position
                && let Some(measured) = self.clock.time(time)
            {
                self.restarts.note_next(packet.millis(), measured + packet_time);
            }
            positions[number] = position;
        }
        if let Some(counted) = counted.filter(|_| self.settings.model.is_none()) {
            self.update_beams(counted);
            if !self.is_rate_known
                && let Phase::Streaming(watchdog) = &mut self.phase
            {
                watchdog.await_revolution(self.now);
            }
        }
        self.scanner_time = positions[..span.packets].iter().rev().find_map(|place| place.time());
        let stamp =
            |number: usize| positions[number].time().and_then(|time| self.clock_of(number).time(time));
        let first = stamp(0);
        let last_byte = span.offset + (span.packets * PACKET_LEN - 1) as u64;
        let latest = self.reads.read_log().latest(last_byte, line_rate);
        let last = stamp(span.packets - 1).map_or(latest, |at| at + packet_time);
        let at = first.unwrap_or(last.saturating_sub(packet_time * span.packets as u64));
        // The stamp of a repeated packet is its arrival time. The stamp of the next packet comes from the scanner's
        // clock, and may be earlier. `stamp_packet` therefore raises it.
        let last = self.reads.stamp_packet(last.max(at));
        self.current = Some(PendingPackets { span, positions, packet: 0, is_added: false });
        self.counters.note_packets(self.framer.buffer.byte_counters(), span.packets);
        self.continue_stream();
        ReceivedTelegram {
            bytes: self.framer.bytes(span),
            first: at,
            last,
            estimated: first.is_none(),
            reasons: span.reasons,
            count: span.packets,
            is_checked: true,
            is_reply: false,
            contents: None,
        }
    }

    /// Returns the clock that stamps the packet with index `number` among the packets that were returned last.
    fn clock_of(&self, number: usize) -> &SensorClock {
        match &self.clock_before {
            Some((first, clock)) if number < *first => clock,
            _ => &self.clock,
        }
    }

    /// Starts the stream after its first packets, or continues it after later packets.
    fn continue_stream(&mut self) {
        match &mut self.phase {
            Phase::Streaming(watchdog) => {
                watchdog.note_packets(self.now);
                self.counters.continue_stream(self.framer.buffer.byte_counters());
                if self.measured.is_none()
                    && self.now >= self.undecided_since + DECISION_TIMEOUT
                    && let Some(rate) = self.sequencer.points_per_second()
                {
                    let model = Model::of_point_rate(rate);
                    self.measured = Some((model, model.beams()));
                }
            }
            Phase::Listening { .. } => {
                self.problem = None;
                self.undecided_since = self.now;
                self.phase = Phase::Streaming(Watchdog::new(self.now));
                self.counters.begin_stream(self.framer.buffer.byte_counters());
            }
            Phase::Paused => {}
        }
        if !self.is_rate_known
            && self.sequencer.points_per_second().is_some()
            && let Some(beams) = self.known_beams()
        {
            (self.beams, self.is_rate_known) = (Some(beams), true);
            self.revolutions.begin(beams);
        }
    }

    /// Adds the points of the current packets to revolutions until a revolution is complete. Returns that revolution.
    fn advance_revolutions(&mut self) -> Option<ClosedRevolution> {
        while let Some(current) = &mut self.current {
            let (bytes, _) = self.framer.bytes(current.span).as_chunks::<PACKET_LEN>();
            let packet = bytes.get(current.packet).map(Packet::assume_valid);
            let Some(packet) = packet.filter(|_| self.is_rate_known) else {
                self.current = None;
                return None;
            };
            let position = current.positions[current.packet];
            let reasons = if current.packet == 0 { current.span.reasons } else { 0 };
            let step = f64::from(packet.span()) / 100.0 / (POINTS_PER_PACKET - 1) as f64;
            let rotation_rate = RotationRate { step, point_ns: f64::from(self.sequencer.point_ns()) };
            if !current.is_added {
                if let PacketPosition::Next { angle, missing, from, .. } = position
                    && missing > 0
                {
                    // No point between the two angles arrived. The missing points may be in a revolution that has not
                    // started yet.
                    self.revolutions.mark_gap(from + rotation_rate.step, angle - rotation_rate.step);
                    // Use the speed before the gap for the revolution that ends here, because the head may rotate more
                    // slowly now.
                    if let Some(closed) =
                        self.revolutions.close_before(angle, self.rotation_rate.unwrap_or(rotation_rate))
                    {
                        return Some(closed);
                    }
                }
                self.rotation_rate = Some(rotation_rate);
                current.is_added = true;
                add_points(&mut self.revolutions, &packet, position, reasons, rotation_rate);
            }
            if let PacketPosition::First { angle, .. } | PacketPosition::Next { angle, .. } = position
                && let Some(closed) =
                    self.revolutions.close_before(angle + f64::from(packet.span()) / 100.0, rotation_rate)
            {
                return Some(closed);
            }
            if let Some(current) = &mut self.current {
                (current.packet, current.is_added) = (current.packet + 1, false);
            }
        }
        None
    }

    /// Returns a complete revolution as a scan, and updates the state of the session.
    fn complete_revolution(&mut self, revolution: ClosedRevolution) -> RawScan<'_> {
        let first = self.to_scan(revolution).first;
        self.reads.end_revolution(first);
        self.problem = None;
        if let Phase::Streaming(watchdog) = &mut self.phase {
            watchdog.note_revolution(self.now);
        }
        self.counters.await_revolution(self.framer.buffer.byte_counters());
        self.to_scan(revolution)
    }

    /// Converts a revolution to a scan whose stamps are in the hub's clock.
    fn to_scan(&self, revolution: ClosedRevolution) -> RawScan<'_> {
        let packet = self.current.map_or(usize::MAX, |current| current.packet);
        let stamp = |at: Nanos| self.clock_of(packet).time(at).unwrap_or(self.now);
        let stamps = self.reads.revolution_stamps(stamp(revolution.first), stamp(revolution.last));
        let resolution = (self.beams.unwrap_or_default(), self.points_per_second().unwrap_or_default());
        RawScan::revolution(Family::Ld, &revolution, stamps, resolution, self.revolutions.points(&revolution))
    }
}

impl line::Protocol for LdSession {
    fn read_buffer(&mut self) -> &mut [u8] {
        let spare = self.framer.buffer.read_buffer();
        self.reads.set_buffer_len(spare.len());
        spare
    }

    fn commit(&mut self, now: Nanos, len: usize) {
        self.now = now;
        self.reads.note_read(now, len, line::ScannerSession::state(self) == State::Streaming);
        if len > 0 {
            self.framer.buffer.commit(len);
        }
    }

    fn handle_timeout(&mut self, now: Nanos) {
        self.now = now;
        self.framer.buffer.release(now.saturating_sub(self.reads.last_byte()));
    }

    fn handle_transmitted(&mut self, now: Nanos) {
        self.now = now;
    }

    fn poll_action(&mut self) -> Action<'_> {
        if let Some(closed) = self.advance_revolutions() {
            return Action::Event(Event::Scan(self.complete_revolution(closed)));
        }
        while let Some(span) = self.framer.advance(max_packets_per_sample(self.baud)) {
            if !matches!(self.phase, Phase::Paused) {
                return Action::Event(Event::Telegram(self.receive(span)));
            }
        }
        self.handle_deadlines();
        if core::mem::take(&mut self.change_baud) {
            self.framer.clear();
            return Action::SetRate(self.baud);
        }
        let until = match self.phase {
            Phase::Listening { next_at, .. } => next_at,
            Phase::Streaming(watchdog) => watchdog.silent_at(),
            Phase::Paused => Nanos::MAX,
        };
        self.reads.wait_action(self.now, until, self.framer.buffer.hold_time())
    }
}

impl line::ScannerSession for LdSession {
    type Problem = Problem;

    fn control(&mut self, control: Control, now: Nanos) {
        self.now = now;
        match (control, self.phase) {
            (Control::Pause, _) => {
                self.listen(State::Paused);
                self.phase = Phase::Paused;
            }
            (Control::Resume, Phase::Paused) => self.listen(State::Probing),
            (Control::Resume, _) => {}
            (Control::Resync, _) => {
                self.counters.note_resync();
                self.problem = None;
                self.listen(State::Probing);
            }
        }
    }

    fn state(&self) -> State {
        match self.phase {
            Phase::Listening { shown, .. } => shown,
            Phase::Streaming(watchdog) => watchdog.state(),
            Phase::Paused => State::Paused,
        }
    }

    fn problem(&self) -> Option<Problem> {
        let change = self.beams_change.filter(|&(_, until)| self.now < until).map(|(problem, _)| problem);
        self.problem.or(change).filter(|_| !matches!(self.phase, Phase::Paused))
    }

    fn missing_transmission(&self) -> Option<&'static str> {
        matches!(self.problem(), Some(Problem::NoPackets { .. })).then_some("LDROBOT packets")
    }

    fn rate(&self) -> u32 {
        self.baud
    }

    fn stats(&self) -> SessionStats {
        let (tally, buffered) = (self.framer.buffer.byte_counters(), self.framer.buffer.open_bytes().len());
        let stats = self.counters.stats(tally, buffered, self.sequencer.received_and_lost());
        SessionStats { restarts: self.restarts.count, ..stats }
    }

    fn set_start_rate(&mut self, rate: u32, _: Nanos) {
        self.baud = rate;
    }

    fn restore_beams(&mut self, model: family::Model, beams: usize) {
        let model = Model::from_name(model.name);
        if let Some(model) = model.filter(|model| self.settings.fixed_rate || model.baud() == self.baud) {
            self.restore_model(model, beams);
        }
    }

    fn model(&self) -> Option<family::Model> {
        self.model().map(describe)
    }

    fn beams(&self) -> Option<usize> {
        self.beams
    }

    fn partial_scan(&self) -> Option<RawScan<'_>> {
        self.revolutions.partial_revolution(self.rotation_rate?).map(|revolution| self.to_scan(revolution))
    }

    fn unexpected_model(&self) -> Option<family::Model> {
        self.unexpected_model_by_rate().map(describe)
    }

    fn scanner_time(&self) -> Option<Nanos> {
        self.scanner_time
    }

    fn mark_suspect(&mut self, reasons: u8) {
        self.reads.mark_suspect(reasons);
    }
}

/// Reason why a session does not stream as it should.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Problem {
    /// No packet arrives.
    NoPackets {
        /// The only baud rate at which the session listened. `None` if the session listened at both rates of the
        /// family.
        baud: Option<u32>,
        /// Time without a packet in seconds, rounded down to 1, 2, 4, ..
        seconds: u32,
    },
    /// No packet arrived for one second.
    Silence,
    /// Packets arrive, but the head does not rotate.
    HeadBlocked,
    /// No revolution is complete, because the line damages bytes.
    DamagedRevolutions,
    /// The number of points per revolution has changed, so the number of beams has changed too.
    BeamsChanged {
        /// Previous number of beams.
        from: usize,
        /// Present number of beams.
        to: usize,
    },
}

impl fmt::Display for Problem {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Problem::NoPackets { baud, seconds } => {
                f.write_str("no packets at ")?;
                match baud {
                    Some(baud) => write!(f, "{baud}")?,
                    None => f.write_str("230400 and 921600")?,
                }
                write!(f, " baud for {seconds} s: power, cable, other port?")
            }
            Problem::Silence => f.write_str("no packet for one second"),
            Problem::HeadBlocked => {
                f.write_str("packets arrive, but the head does not rotate: is it blocked?")
            }
            Problem::DamagedRevolutions => f.write_str(
                "packets arrive, but no revolution is complete, because bytes are damaged on the line: check the \
                 cable, its ground and termination, and the adapter",
            ),
            Problem::BeamsChanged { from, to } => {
                write!(
                    f,
                    "scans have {to} beams instead of {from}, because the scanner measures {to} points per revolution"
                )
            }
        }
    }
}

/// Adds the points of `packet`, which is at `position` of the sequence, to `revolutions`.
fn add_points(
    revolutions: &mut RevolutionAssembler<MAX_POINTS>,
    packet: &Packet<'_>,
    position: PacketPosition,
    reasons: u8,
    rate: RotationRate,
) {
    let (last, angle) = match position {
        PacketPosition::Repeated => return,
        PacketPosition::Outlier => return revolutions.mark_incomplete(),
        PacketPosition::First { time, angle } => {
            revolutions.discard();
            (time, angle)
        }
        PacketPosition::Next { time, angle, .. } => (time, angle),
    };
    for i in 0..POINTS_PER_PACKET {
        let point = packet.point(i);
        let time = last as f64 - rate.point_ns * (POINTS_PER_PACKET - 1 - i) as f64;
        revolutions.add_point(
            angle + rate.step * i as f64,
            time,
            point.range,
            point.intensity,
            reasons,
            rate,
        );
    }
}

/// Returns the maximum number of packets in one event. This number of packets arrives within 10 ms at `baud`.
const fn max_packets_per_sample(baud: u32) -> usize {
    if baud > 500_000 { MAX_PACKETS_PER_SAMPLE } else { 3 }
}

/// Maximum number of points in a revolution. An STL27L measures fewer points per revolution, even at five revolutions
/// per second.
const MAX_POINTS: usize = 4_400;
/// Time for which the session listens at one baud rate. A stream has a packet at least every 3 ms.
const LISTEN_TIME: Nanos = 300 * MILLIS;
/// Time from the start of a stream after which the session no longer waits for a reliable measurement. It then uses the
/// default number of beams of the model that fits the number of points per second. Some scanners need this timeout,
/// because their speed is never constant or their sequence has a gap in every revolution.
const DECISION_TIMEOUT: Nanos = 10_000 * MILLIS;
/// Time for which the number of points per revolution must be different before the number of beams changes.
const CHANGE_DELAY: Nanos = 10_000 * MILLIS;
/// Time for which the session reports a change of the number of beams.
const CHANGE_REPORT_TIME: Nanos = 60_000 * MILLIS;
/// Maximum number of packets in one event, for every baud rate. An STL27L sends a packet every 0.56 ms, so 17 packets
/// cover 10 ms.
pub(crate) const MAX_PACKETS_PER_SAMPLE: usize = 17;
