//! Steps from an open port to a stream: the search for the baud rate of the line, and the handshake with the scanner.
//!
//! [`RateSearch`] tries each baud rate. A scanner that loses power usually restarts soon, and then sends its boot
//! message at the rate of its last stream. The search therefore stores the rate of the last stream.
//!
//! [`Handshake`] contains the queries in their order, the data that the scanner has reported, and the scan mode that
//! follows from these data. The handshake decides the next step. The session carries out the step and waits for
//! responses.

use scanhub_schema::{MILLIS, Nanos};

use crate::rplidar::packet::PacketFormat;
use crate::rplidar::request::{Health, Info, Request, ResponseType, key};
use crate::rplidar::session::{MAX_DRAIN_TIME, Problem};
use crate::rplidar::{FEATURES, Mode, Model, Motor};
use crate::settings::Settings;

/// Request whose response the session waits for, in the order of the handshake. A query about a mode contains the index
/// of the mode in the scanner's list.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Query {
    Info,
    Health,
    Board,
    ModeCount,
    TypicalMode,
    SampleTime(u8),
    Kind(u8),
    Name(u8),
    /// Request the times per point of a scanner that does not list its modes.
    SampleTimes,
    /// Request the time per point of the chosen mode again, because all stamps depend on this time and responses have
    /// no checksum.
    Confirm(u8),
    /// Start the standard scan.
    StandardScan,
    /// Start the scan mode with this number, whose packets contain several points.
    ExpressScan(u8),
}

impl Query {
    /// Returns the request that sends this query.
    pub(crate) fn request(self) -> Request {
        match self {
            Query::Info => Request::INFO,
            Query::Health => Request::HEALTH,
            Query::Board => Request::accessory_board(),
            Query::ModeCount => Request::configuration(key::COUNT, None),
            Query::TypicalMode => Request::configuration(key::TYPICAL, None),
            Query::SampleTime(mode) | Query::Confirm(mode) => {
                Request::configuration(key::SAMPLE_TIME, Some(mode))
            }
            Query::Kind(mode) => Request::configuration(key::RESPONSE_TYPE, Some(mode)),
            Query::Name(mode) => Request::configuration(key::NAME, Some(mode)),
            Query::SampleTimes => Request::SAMPLE_TIMES,
            Query::StandardScan => Request::SCAN,
            Query::ExpressScan(mode) => Request::express(mode),
        }
    }

    /// Returns the contents of a response with `data`, if the response belongs to this query. If the query has a key,
    /// the response begins with the key.
    fn contents(self, response: ResponseType, data: &[u8]) -> Option<&[u8]> {
        let (expected, key) = match self {
            Query::Info => (ResponseType::Info, None),
            Query::Health => (ResponseType::Health, None),
            Query::Board => (ResponseType::Board, None),
            Query::ModeCount => (ResponseType::Configuration, Some(key::COUNT)),
            Query::TypicalMode => (ResponseType::Configuration, Some(key::TYPICAL)),
            Query::SampleTime(_) | Query::Confirm(_) => (ResponseType::Configuration, Some(key::SAMPLE_TIME)),
            Query::Kind(_) => (ResponseType::Configuration, Some(key::RESPONSE_TYPE)),
            Query::Name(_) => (ResponseType::Configuration, Some(key::NAME)),
            Query::SampleTimes => (ResponseType::SampleTimes, None),
            Query::StandardScan | Query::ExpressScan(_) => return None,
        };
        let data = key.map_or(Some(data), |key| data.strip_prefix(&[key, 0, 0, 0]))?;
        (response == expected).then_some(data)
    }

    /// Returns whether the response is a stream.
    pub(crate) fn is_scan(self) -> bool {
        matches!(self, Query::StandardScan | Query::ExpressScan(_))
    }
}

/// Step that follows a response or a missing response.
#[derive(Clone, Copy, Debug)]
pub(crate) enum NextStep {
    /// Do nothing, for example because the response was not the expected response.
    Nothing,
    /// Send this query. The scanner has responded to the first query.
    ScannerFound(Query),
    /// Send this query.
    Query(Query),
    /// Restart the scanner, because it reports an error.
    Reset,
    /// Wait, because the scanner reports an error even after a restart.
    Unhealthy(Health),
    /// Start the motor, and then send this query.
    StartMotor(Query),
    /// Start this scan mode.
    Scan(ScanMode),
    /// Start the handshake again, because a response was damaged.
    Restart,
    /// Report that the scanner does not start to measure.
    Refused,
}

/// State of the handshake: the data that the scanner has reported, and the scan mode that follows from these data.
#[derive(Clone, Debug)]
pub(crate) struct Handshake {
    settings: Settings,
    pub(crate) info: Option<Info>,
    pub(crate) health: Option<Health>,
    /// Whether the session has already restarted the scanner because of an error.
    was_reset: bool,
    /// Whether an accessory board controls the motor with a duty cycle.
    has_board: bool,
    pub(crate) modes: ScanModes,
    /// Scan mode in use, if scanhub supports it.
    pub(crate) mode: Option<Mode>,
    /// Configured scan mode, if the scanner cannot use it.
    pub(crate) unavailable_mode: Option<Mode>,
    /// For a recording: index of the mode and key in the last response about a mode.
    last_recorded: (u8, u8),
}

impl Handshake {
    pub(crate) fn new(settings: Settings) -> Handshake {
        Handshake {
            settings,
            info: None,
            health: None,
            was_reset: false,
            has_board: false,
            modes: ScanModes::default(),
            mode: Mode::of(&settings).filter(|_| settings.listen_only),
            unavailable_mode: None,
            last_recorded: (0, 0),
        }
    }

    /// Returns the model that the scanner has reported. Before its report, returns the configured model.
    pub(crate) fn model(&self) -> Option<Model> {
        self.info.and_then(|info| info.model()).or(Model::of(&self.settings))
    }

    /// Handles the descriptor of a stream with packets of format `kind`. If a recording has no configured mode, and
    /// only one reported mode has this format, this mode is the mode of the stream.
    pub(crate) fn stream_begins(&mut self, kind: PacketFormat) {
        if self.settings.listen_only && self.settings.mode.is_none() {
            self.mode = self.modes.single_mode(kind);
        }
    }

    /// Returns the format of packets that may be express or dense packets and whose descriptor is missing. The
    /// configured mode determines the format. If no mode is configured, the result is the format of the model's fastest
    /// mode.
    pub(crate) fn ambiguous_format(&self) -> Option<PacketFormat> {
        match (Mode::of(&self.settings), self.model()) {
            (Some(Mode::DenseBoost), _) => Some(PacketFormat::Dense),
            (Some(_), _) => Some(PacketFormat::Express),
            (None, Some(Model::A1 | Model::A2m8 | Model::A2m12 | Model::A3)) => Some(PacketFormat::Express),
            (None, model) => model.map(|_| PacketFormat::Dense),
        }
    }

    /// Returns the request that starts or stops the motor. Returns `None` if the line DTR controls the motor.
    pub(crate) fn motor_request(&self, is_on: bool) -> Option<Request> {
        match self.motor() {
            Motor::Speed => Some(Request::set_motor_speed(if is_on { MOTOR_SPEED_RPM } else { 0 })),
            Motor::Board if self.has_board => Some(Request::set_motor_pwm(if is_on { MOTOR_PWM } else { 0 })),
            Motor::Board | Motor::Dtr => None,
        }
    }

    fn motor(&self) -> Motor {
        self.info.map_or(Motor::Dtr, |info| info.motor())
    }

    /// Handles a response with the contents `data`, while the session waits for the response to `query`. The response
    /// may belong to an earlier query. `baud` is the baud rate of the line, in bits per second.
    pub(crate) fn handle_response(
        &mut self,
        query: Option<Query>,
        response: ResponseType,
        data: &[u8],
        baud: u32,
    ) -> NextStep {
        if response == ResponseType::Info {
            self.info = Info::parse(data);
        }
        let query = match query {
            Some(query) => query,
            None if self.settings.listen_only => self.infer_query(response, data),
            None => return NextStep::Nothing,
        };
        let Some(data) = query.contents(response, data) else { return NextStep::Nothing };
        match query {
            Query::Info => return NextStep::ScannerFound(Query::Health),
            Query::Health => return self.handle_health(Health::parse(data)),
            Query::Board => {
                self.has_board = number(data) & 1 == 1;
                return NextStep::StartMotor(Query::ModeCount);
            }
            Query::ModeCount => {
                self.modes.begin(number(data) as usize);
                return NextStep::Query(Query::TypicalMode);
            }
            Query::TypicalMode => self.modes.set_recommended(number(data) as u8),
            Query::SampleTime(mode) => {
                self.modes
                    .change_mode(mode, |mode| mode.sample_us = Some(sample_us(data)).filter(|us| *us > 0.0));
            }
            Query::Kind(mode) => {
                self.modes.change_mode(mode, |mode| mode.kind = PacketFormat::of(number(data) as u8))
            }
            Query::Name(mode) => {
                self.modes.change_mode(mode, |mode| mode.mode = Mode::from_device_name(data))
            }
            Query::Confirm(mode) => {
                let is_same = self.modes.nth(mode).and_then(|mode| mode.sample_us) == Some(sample_us(data));
                return if is_same { self.start(baud) } else { NextStep::Restart };
            }
            Query::SampleTimes => {
                let us = number(data);
                self.modes = ScanModes::without_list(us as u16, (us >> 16) as u16);
                return self.start(baud);
            }
            Query::StandardScan | Query::ExpressScan(_) => return NextStep::Nothing,
        }
        self.after(query, baud)
    }

    /// Continues the handshake without the response to `query`, which is not [`Query::Info`].
    pub(crate) fn handle_no_response(&mut self, query: Query, baud: u32) -> NextStep {
        match query {
            Query::Board => NextStep::StartMotor(Query::ModeCount),
            // The scanner responds, but does not support this request. Assume that its health is good.
            Query::Health => self.after_health(),
            Query::ModeCount => NextStep::Query(Query::SampleTimes),
            Query::SampleTimes => {
                self.modes = ScanModes::without_list(0, 0);
                self.start(baud)
            }
            Query::Confirm(_) => self.start(baud),
            Query::StandardScan | Query::ExpressScan(_) => NextStep::Refused,
            query => self.after(query, baud),
        }
    }

    /// Returns the step after `query`, which is one of the queries about the list of modes.
    fn after(&mut self, query: Query, baud: u32) -> NextStep {
        let next = match query {
            Query::SampleTime(mode) => Query::Kind(mode),
            Query::Kind(mode) => Query::Name(mode),
            Query::Name(mode) => Query::SampleTime(mode + 1),
            _ => Query::SampleTime(0),
        };
        match next {
            Query::SampleTime(mode) if usize::from(mode) >= self.modes.count => self.confirm(baud),
            next => NextStep::Query(next),
        }
    }

    /// Handles the health that the scanner has reported.
    fn handle_health(&mut self, health: Option<Health>) -> NextStep {
        self.health = health;
        match health {
            _ if self.settings.listen_only => NextStep::Nothing,
            Some(Health::Error(_)) if !self.was_reset => {
                self.was_reset = true;
                NextStep::Reset
            }
            Some(health @ Health::Error(_)) => NextStep::Unhealthy(health),
            _ => {
                self.was_reset = false;
                self.after_health()
            }
        }
    }

    fn after_health(&self) -> NextStep {
        if self.motor() == Motor::Board {
            NextStep::Query(Query::Board)
        } else {
            NextStep::StartMotor(Query::ModeCount)
        }
    }

    /// Returns the query that confirms the time per point of the chosen scan mode. Starts the mode if the time is
    /// unknown.
    fn confirm(&mut self, baud: u32) -> NextStep {
        if self.settings.listen_only {
            return NextStep::Nothing;
        }
        let mode = self.choose_mode(baud);
        if mode.sample_us.is_some() { NextStep::Query(Query::Confirm(mode.id)) } else { self.start(baud) }
    }

    /// Starts the chosen scan mode.
    fn start(&mut self, baud: u32) -> NextStep {
        if self.settings.listen_only {
            return NextStep::Nothing;
        }
        let mode = self.choose_mode(baud);
        self.mode = mode.mode;
        NextStep::Scan(mode)
    }

    /// Returns the configured scan mode. If no mode is configured, or if the scanner or the line does not support the
    /// configured mode, returns the fastest mode.
    fn choose_mode(&mut self, baud: u32) -> ScanMode {
        let baud = (!self.settings.fixed_rate).then_some(baud);
        let requested = Mode::of(&self.settings);
        let usable = requested.and_then(|mode| self.modes.find_mode(mode, baud));
        self.unavailable_mode = requested.filter(|_| usable.is_none());
        let fastest = || self.modes.fastest(baud).or_else(|| self.modes.fastest(None));
        usable.or_else(fastest).unwrap_or_default()
    }

    /// Infers to which query a response in a recording belongs. A program requests the modes in the order of the list,
    /// and the keys of each mode in ascending order.
    fn infer_query(&mut self, response: ResponseType, data: &[u8]) -> Query {
        let key = match response {
            ResponseType::Info => return Query::Info,
            ResponseType::Health => return Query::Health,
            ResponseType::Board => return Query::Board,
            ResponseType::SampleTimes => return Query::SampleTimes,
            ResponseType::Configuration => data.first().copied().unwrap_or(key::COUNT),
        };
        let (mode, before) = self.last_recorded;
        let mode = if key > before { mode } else { mode + 1 };
        match key {
            key::COUNT => self.last_recorded = (0, 0),
            key::SAMPLE_TIME | key::RESPONSE_TYPE | key::NAME => self.last_recorded = (mode, key),
            _ => {}
        }
        match key {
            key::SAMPLE_TIME => Query::SampleTime(mode),
            key::RESPONSE_TYPE => Query::Kind(mode),
            key::NAME => Query::Name(mode),
            key::TYPICAL => Query::TypicalMode,
            _ => Query::ModeCount,
        }
    }
}

/// Scan mode as the scanner describes it.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct ScanMode {
    /// Number of the mode in the request that starts it.
    id: u8,
    /// Time from one point to the next, in microseconds.
    pub(crate) sample_us: Option<f32>,
    kind: Option<PacketFormat>,
    mode: Option<Mode>,
}

impl ScanMode {
    /// Returns the query that starts the mode.
    pub(crate) fn query(&self) -> Query {
        if self.kind.is_none_or(|kind| kind == PacketFormat::Standard) {
            Query::StandardScan
        } else {
            Query::ExpressScan(self.id)
        }
    }
}

/// List of the scan modes of a scanner.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct ScanModes {
    list: [ScanMode; ScanModes::MAX],
    count: usize,
    typical: Option<u8>,
}

impl ScanModes {
    const MAX: usize = 12;

    /// Starts a list of `count` modes.
    fn begin(&mut self, count: usize) {
        *self = ScanModes { count: count.min(ScanModes::MAX), ..ScanModes::default() };
        (0..).zip(&mut self.list).for_each(|(id, mode)| mode.id = id);
    }

    fn nth(&self, index: u8) -> Option<&ScanMode> {
        self.list[..self.count].get(usize::from(index))
    }

    /// Changes the mode at `index` of the list.
    fn change_mode(&mut self, index: u8, set: impl Fn(&mut ScanMode)) {
        self.list[..self.count].get_mut(usize::from(index)).into_iter().for_each(set);
    }

    /// Stores the number of the mode that the manufacturer recommends.
    fn set_recommended(&mut self, id: u8) {
        self.typical = Some(id);
    }

    /// Returns the two modes that every scanner has, for a scanner that does not list its modes. The times per point
    /// are in microseconds. A value of 0 means that the time is unknown.
    fn without_list(standard_us: u16, express_us: u16) -> ScanModes {
        let mode_of = |us: u16, kind, mode| ScanMode {
            id: 0,
            sample_us: (us > 0).then_some(f32::from(us)),
            kind: Some(kind),
            mode: Some(mode),
        };
        let mut modes = ScanModes::default();
        modes.list[0] = mode_of(standard_us, PacketFormat::Standard, Mode::Standard);
        modes.list[1] = mode_of(express_us, PacketFormat::Express, Mode::Express);
        modes.count = if express_us > 0 { 2 } else { 1 };
        modes
    }

    /// Returns the scanner's mode that corresponds to `mode`, if a line of `baud` bits per second can carry it. `baud`
    /// is `None` for a port without a baud rate, which can carry every mode.
    fn find_mode(&self, mode: Mode, baud: Option<u32>) -> Option<ScanMode> {
        let kind = match mode {
            Mode::Standard => Some(PacketFormat::Standard),
            Mode::Express => Some(PacketFormat::Express),
            Mode::DenseBoost => Some(PacketFormat::Dense),
            Mode::UltraDense => Some(PacketFormat::UltraDense),
            Mode::Boost | Mode::Sensitivity | Mode::Stability => None,
        };
        let mode_with_name = self.possible_modes(baud).find(|candidate| candidate.mode == Some(mode));
        mode_with_name
            .or_else(|| self.possible_modes(baud).find(|offered| kind.is_some() && offered.kind == kind))
    }

    /// Returns the fastest mode that the line can carry. Among equally fast modes, prefers a mode with a checksum, and
    /// then the recommended mode.
    fn fastest(&self, baud: Option<u32>) -> Option<ScanMode> {
        self.possible_modes(baud).min_by(|a, b| {
            let of = |mode: &ScanMode| mode.sample_us.unwrap_or(f32::MAX);
            let rank = |mode: &ScanMode| {
                let is_checked = mode.kind.is_some_and(PacketFormat::is_checked);
                (!is_checked, self.typical != Some(mode.id))
            };
            of(a).total_cmp(&of(b)).then(rank(a).cmp(&rank(b)))
        })
    }

    /// Returns the time per point for packets of format `kind`, in microseconds. If `mode` has packets of this format,
    /// returns the time of `mode`. Otherwise, returns the time of the fastest mode with packets of this format.
    pub(crate) fn sample_us(&self, kind: PacketFormat, mode: Option<Mode>) -> Option<f32> {
        let of_kind = || self.of_kind(kind);
        let in_mode = of_kind().filter(|(named, _)| mode.is_some() && *named == mode).map(|(_, us)| us);
        in_mode.reduce(f32::min).or_else(|| of_kind().map(|(_, us)| us).reduce(f32::min))
    }

    /// Returns the reported time per point that is nearest to `us`, in microseconds, among the modes with packets of
    /// format `kind`.
    pub(crate) fn nearest_us(&self, kind: PacketFormat, us: f32) -> Option<f32> {
        self.of_kind(kind)
            .map(|(_, reported)| reported)
            .min_by(|a, b| (a - us).abs().total_cmp(&(b - us).abs()))
    }

    /// Returns the mode with packets of format `kind`, if only one mode has this format and scanhub supports this mode.
    fn single_mode(&self, kind: PacketFormat) -> Option<Mode> {
        let mut modes = self.list[..self.count].iter().filter(|mode| mode.kind == Some(kind));
        let single = modes.next().filter(|_| modes.next().is_none());
        single.and_then(|mode| mode.mode)
    }

    /// Returns whether all reported modes with packets of format `kind` have the same time per point, so that the
    /// format determines the time.
    pub(crate) fn is_unambiguous(&self, kind: PacketFormat) -> bool {
        let mut times = self.of_kind(kind).map(|(_, us)| us);
        let first = times.next();
        times.all(|us| Some(us) == first)
    }

    /// Returns whether `mode` is a reported mode with packets of format `kind` and with the time per point that is
    /// nearest to `us`.
    pub(crate) fn has(&self, mode: Mode, kind: PacketFormat, us: f32) -> bool {
        let nearest = self.nearest_us(kind, us);
        self.of_kind(kind).any(|(named, us)| named == Some(mode) && Some(us) == nearest)
    }

    fn of_kind(&self, kind: PacketFormat) -> impl Iterator<Item = (Option<Mode>, f32)> {
        let all = self.list[..self.count].iter().filter(move |mode| mode.kind == Some(kind));
        all.filter_map(|mode| Some((mode.mode, mode.sample_us?)))
    }

    /// Returns the modes whose packets scanhub can decode and the line can carry.
    fn possible_modes(&self, baud: Option<u32>) -> impl Iterator<Item = ScanMode> {
        self.list[..self.count].iter().copied().filter(move |mode| {
            let Some((kind, baud)) = mode.kind.zip(baud) else { return mode.kind.is_some() };
            let packets_per_second = 1e6 / (mode.sample_us.unwrap_or(1e6) * kind.points() as f32);
            packets_per_second * kind.byte_len() as f32 * 10.0 <= baud as f32
        })
    }
}

/// Decodes a little-endian number of up to four bytes.
fn number(data: &[u8]) -> u32 {
    data.iter().take(4).rev().fold(0, |number, byte| number << 8 | u32::from(*byte))
}

/// Decodes a time per point, in microseconds.
fn sample_us(data: &[u8]) -> f32 {
    number(data) as f32 / 256.0
}

/// Speed of the motor that the session requests, in revolutions per minute. This speed is the manufacturer's default
/// for an S1.
const MOTOR_SPEED_RPM: u16 = 600;
/// Duty cycle of the motor that the session requests, out of 1,023. This duty cycle is the manufacturer's default for
/// an A2.
const MOTOR_PWM: u16 = 660;

/// Baud rate of the line, and the state of the search for this rate.
#[derive(Clone, Copy, Debug)]
pub(crate) struct RateSearch {
    pub(crate) baud: u32,
    /// Whether the search cannot change the baud rate, because the port has a fixed rate or the session cannot send.
    is_fixed: bool,
    /// Whether the port must still be set to the baud rate.
    pub(crate) needs_change: bool,
    /// Time since which no response has arrived, and the number of bytes read until this time.
    no_response_since: Option<(Nanos, u64)>,
    /// Baud rate of the last stream. `None` after a boot message, or after the session has restarted the scanner.
    stream_rate: Option<u32>,
}

impl RateSearch {
    /// Creates a search on a port that is open at the baud rate of the configured model, or at the default rate.
    pub(crate) fn new(settings: &Settings) -> RateSearch {
        RateSearch {
            baud: Model::of(settings).map_or(FEATURES.defaults.baud, Model::baud),
            is_fixed: settings.fixed_rate || settings.listen_only,
            needs_change: false,
            no_response_since: None,
            stream_rate: None,
        }
    }

    /// Starts at `baud`. The port is open at this rate.
    pub(crate) fn set_start_rate(&mut self, baud: u32) {
        self.baud = baud;
    }

    /// Returns the baud rate if the session must still set the port to it.
    pub(crate) fn take_change(&mut self) -> Option<u32> {
        core::mem::take(&mut self.needs_change).then_some(self.baud)
    }

    /// Ends the search, because the scanner has responded.
    pub(crate) fn end(&mut self) {
        self.no_response_since = None;
    }

    /// Changes to the next baud rate, because no response has arrived. `read` is the number of bytes read so far.
    /// Returns the time since which no response has arrived.
    pub(crate) fn advance(&mut self, now: Nanos, read: u64) -> Nanos {
        let (since, read_before) = *self.no_response_since.get_or_insert((now, read));
        // Stay at the rate of the last stream for some time, in order to receive the boot message.
        let may_boot =
            self.stream_rate == Some(self.baud) && read == read_before && now < since + BOOT_TIMEOUT;
        if let Some(baud) = self.next_rate().filter(|_| !may_boot) {
            self.baud = baud;
            self.needs_change = true;
        }
        since
    }

    /// Returns whether the search has just started. At the start of a search, bytes that arrive after the stop request
    /// show that the scanner uses another baud rate, because the request would have stopped the scanner at the current
    /// rate. The session then tries the next rate without a query. Later, it sends queries even if bytes arrive,
    /// because the line may never be quiet.
    pub(crate) fn is_quick(&self, now: Nanos) -> bool {
        self.no_response_since.is_none_or(|(since, _)| now < since + QUICK_SEARCH_TIME)
            && self.next_rate().is_some()
    }

    /// Returns the problem that no response has arrived since `since`, if this is at least one second ago.
    pub(crate) fn no_response_problem(&self, since: Nanos, now: Nanos) -> Option<Problem> {
        let seconds = (now.saturating_sub(since) / (1_000 * MILLIS)) as u32;
        let baud = self.next_rate().is_none().then_some(self.baud);
        (seconds > 0).then(|| Problem::NoResponse { baud, seconds: 1 << seconds.ilog2() })
    }

    /// Stores the current baud rate as the rate of the last stream.
    pub(crate) fn note_stream(&mut self) {
        self.stream_rate = Some(self.baud);
    }

    /// Deletes the stored rate of the last stream if it is the current baud rate. Returns whether it was the current
    /// baud rate.
    pub(crate) fn take_stream(&mut self) -> bool {
        self.stream_rate.take_if(|baud| *baud == self.baud).is_some()
    }

    /// Deletes the stored rate of the last stream.
    pub(crate) fn forget_stream(&mut self) {
        self.stream_rate = None;
    }

    /// Returns the baud rate that the search tries next. Returns `None` if the rate is fixed.
    fn next_rate(&self) -> Option<u32> {
        const RATES: [u32; 4] = [115_200, 256_000, 460_800, 1_000_000];
        let at = RATES.iter().position(|rate| *rate == self.baud)?;
        (!self.is_fixed).then(|| RATES[(at + 1) % RATES.len()])
    }
}

/// Maximum time from power-on to the boot message.
const BOOT_TIMEOUT: Nanos = 3_000 * MILLIS;
/// Time in which the search tries all baud rates twice if bytes arrive at each rate. One try is not sufficient, because
/// a stop request can be lost.
const QUICK_SEARCH_TIME: Nanos = 8 * MAX_DRAIN_TIME;

#[cfg(test)]
mod tests {
    use super::*;

    /// Modes of a real A1M8.
    fn a1() -> ScanModes {
        let mut listed = ScanModes::default();
        listed.begin(5);
        let modes = [
            (Mode::Standard, 508.0, PacketFormat::Standard),
            (Mode::Express, 254.0, PacketFormat::Express),
            (Mode::Boost, 127.0, PacketFormat::Ultra),
            (Mode::Sensitivity, 127.0, PacketFormat::Ultra),
            (Mode::Stability, 201.0, PacketFormat::Ultra),
        ];
        for (place, (mode, us, kind)) in (0..).zip(modes) {
            listed.change_mode(place, |listed| {
                (listed.mode, listed.sample_us, listed.kind) = (Some(mode), Some(us), Some(kind));
            });
        }
        listed.set_recommended(3);
        listed
    }

    #[test]
    fn prefers_fastest_mode_that_the_line_carries() {
        assert_eq!(a1().fastest(Some(115_200)).map(|mode| mode.id), Some(3));
        assert_eq!(a1().fastest(Some(100_000)).map(|mode| mode.id), Some(4), "6,840 bytes a second");
        assert_eq!(a1().fastest(Some(57_600)).map(|mode| mode.id), None);
        assert_eq!(a1().fastest(None).map(|mode| mode.id), Some(3));
        assert_eq!(
            ScanModes::without_list(500, 250).fastest(Some(115_200)).and_then(|mode| mode.kind),
            Some(PacketFormat::Express)
        );
        assert_eq!(
            ScanModes::without_list(500, 0).fastest(Some(115_200)).and_then(|mode| mode.kind),
            Some(PacketFormat::Standard)
        );
    }

    #[test]
    fn finds_mode_by_name_or_kind() {
        assert_eq!(a1().find_mode(Mode::Boost, None).map(|mode| mode.id), Some(2));
        assert_eq!(a1().find_mode(Mode::DenseBoost, None).map(|mode| mode.id), None);
        let mut nameless = a1();
        (0..5).for_each(|n| nameless.change_mode(n, |mode| mode.mode = None));
        assert_eq!(nameless.find_mode(Mode::Express, None).map(|mode| mode.id), Some(1));
        assert_eq!(nameless.find_mode(Mode::Boost, None).map(|mode| mode.id), None);
    }
}
