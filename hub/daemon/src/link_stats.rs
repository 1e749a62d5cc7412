//! What a link reports of itself: the state of a session and the hub's own counts as the payload of topic `status`.

use config::Link;
use scanhub_drivers::line::Session as _;
use scanhub_drivers::lms;
use scanhub_drivers::lms::header::Reject;
use scanhub_drivers::lms::reply::Reply;
use scanhub_drivers::lms::telegram::Telegram;
use scanhub_drivers::lms::variant::{Mode, Variant};
use schema::{Counter, Counters, MIN_RATE_SPAN, Nanos, Pose, State, Status};

use crate::driver::Driver;
use crate::process_telegram::Processed;
use crate::recent::{LineHealth, Recent};

/// The link's statistics, across all sessions on its port.
pub(crate) struct LinkStats {
    status: Status,
    /// The measuring mode while no reply has told it, as configured.
    mode: Option<Mode>,
    /// Counters of the sessions that ended.
    past: Counters,
    /// What the line took away lately.
    recent: Recent,
    /// As of the last status.
    health: LineHealth,
    /// Counters as they were when the rate was last computed.
    measured_at: Option<(Nanos, u64)>,
    /// Scans published.
    scans: u64,
    /// Times that the thread woke up.
    pub(crate) wakeups: u64,
    /// Telegrams that were suspect.
    suspect: u64,
    pub(crate) reconnects: u64,
    /// Errors that the line's driver counted.
    pub(crate) line_errors: u64,
}

impl LinkStats {
    pub(crate) fn new(link: &Link, now: Nanos) -> Self {
        let mut status = Status { since_ns: now, pose: link.processing.pose, ..Status::default() };
        status.family = link.family() as u8;
        status.set_port(&link.port.name());
        LinkStats {
            status,
            mode: link.mode,
            past: Counters::default(),
            recent: Recent::new(),
            health: LineHealth::default(),
            measured_at: None,
            scans: 0,
            wakeups: 0,
            suspect: 0,
            reconnects: 0,
            line_errors: 0,
        }
    }

    /// Takes over the state and the trouble of the moment; returns whether either is new.
    pub(crate) fn update(&mut self, state: State, error: &str, now: Nanos) -> bool {
        let before = (self.status.state, self.status.last_error_text);
        if self.status.state != state as u8 {
            self.status.state = state as u8;
            self.status.since_ns = now;
            self.status.rate_mhz = 0;
            self.measured_at = None;
        }
        self.status.set_last_error(error);
        before != (self.status.state, self.status.last_error_text)
    }

    /// The status with everything that `session`, if there is one, knows.
    pub(crate) fn status(&mut self, session: Option<&Driver>, loan_failed: u64, now: Nanos) -> &Status {
        let mut counters = self.past;
        match session {
            Some(session) => {
                add(&mut counters, session);
                self.describe(session);
            }
            None => self.status.baud = 0,
        }
        counters[Counter::Suspect] = self.suspect;
        counters[Counter::Reconnects] = self.reconnects;
        counters[Counter::Wakeups] = self.wakeups;
        counters[Counter::LoanFailed] = loan_failed;
        counters[Counter::LineErrors] = self.line_errors;
        self.health = self.recent.gauge(now, &mut counters);
        self.status.counters = counters;
        let (since, scans) = *self.measured_at.get_or_insert((now, self.scans));
        if u128::from(now.saturating_sub(since)) >= MIN_RATE_SPAN.as_nanos() {
            self.status.rate_mhz = ((self.scans - scans) * 1_000_000_000_000 / (now - since)) as u32;
        }
        if now > since + RATE_WINDOW {
            self.measured_at = Some((now, self.scans));
        }
        &self.status
    }

    /// A telegram was published.
    pub(crate) fn note(&mut self, processed: Processed) {
        self.suspect += u64::from(processed.is_suspect);
        self.scans += u64::from(processed.stands_for.is_some());
    }

    /// A whole telegram of a recording was taken, which says `reply`; `mode` is the one by which its values are split, if
    /// it has any.
    pub(crate) fn recall(&mut self, telegram: Telegram<'_>, reply: Option<&Reply<'_>>, mode: Option<Mode>) {
        let len = telegram.bytes().len() as u64;
        self.past[Counter::BytesRead] += len;
        self.past[Counter::BytesInTelegrams] += len;
        self.past[Counter::Telegrams] += 1;
        self.status.mode = mode.map_or(Status::MODE_UNKNOWN, |mode| mode.0);
        match reply {
            Some(Reply::Measured(measured)) => {
                self.status.unit_mm = measured.unit().mm();
                if let Some(variant) = Variant::of_beams(measured.count()) {
                    self.status.angle_deg = variant.angle_deg;
                    self.status.resolution_cdeg = variant.resolution_cdeg;
                }
            }
            Some(Reply::Type(name)) => self.status.set_sensor_type(&String::from_utf8_lossy(name)),
            _ => {}
        }
    }

    /// The sensor sits elsewhere, or so it is said now.
    pub(crate) fn set_pose(&mut self, pose: Pose) {
        self.status.pose = pose;
    }

    /// The status as it was last.
    pub(crate) fn last(&self) -> &Status {
        &self.status
    }

    /// Returns the state of the line in the ten seconds before the last status.
    pub(crate) fn health(&self) -> LineHealth {
        self.health
    }

    /// Whether telegrams come.
    pub(crate) fn is_streaming(&self) -> bool {
        self.status.state == State::Streaming as u8
    }

    /// The session is over: its counters stay.
    pub(crate) fn close(&mut self, session: &Driver) {
        self.describe(session);
        add(&mut self.past, session);
        self.past[Counter::BytesDiscarded] += session.account().buffered;
        self.past[Counter::BytesBuffered] = 0;
    }

    fn describe(&mut self, driver: &Driver) {
        let known_rate = matches!(self.status.state(), Some(State::Streaming | State::Starting));
        self.status.baud = if known_rate { driver.rate() } else { 0 };
        if let Some(kind) = driver.kind() {
            self.status.set_sensor_type(&kind);
        }
        if let Some((_, beams)) = driver.model() {
            self.status.unit_mm = 1;
            self.status.angle_deg = 360;
            self.status.resolution_cdeg = (36_000.0 / beams as f64).round() as u16;
        }
        let Some(sensor) = driver.lms().map(lms::Session::sensor) else { return };
        self.status.mode = sensor.mode.or(self.mode).map_or(Status::MODE_UNKNOWN, |mode| mode.0);
        self.status.unit_mm = sensor.unit.map_or(0, |unit| unit.mm());
        let Variant { angle_deg, resolution_cdeg } =
            sensor.variant.unwrap_or(Variant { angle_deg: 0, resolution_cdeg: 0 });
        self.status.angle_deg = angle_deg;
        self.status.resolution_cdeg = resolution_cdeg;
        self.status.set_sensor_type(&String::from_utf8_lossy(sensor.kind()));
    }
}

fn add(counters: &mut Counters, driver: &Driver) {
    let account = driver.account();
    counters[Counter::BytesRead] += account.read;
    counters[Counter::BytesInTelegrams] += account.in_telegrams;
    counters[Counter::BytesAcknowledge] += account.acknowledge;
    counters[Counter::BytesDiscarded] += account.discarded;
    counters[Counter::BytesBuffered] = account.buffered;
    counters[Counter::Telegrams] += account.telegrams;
    counters[Counter::Resyncs] += account.resyncs;
    counters[Counter::ScannerRestarts] += account.restarts;
    counters[Counter::BytesDamaged] += account.damaged;
    counters[Counter::DueOnLine] += account.due;
    counters[Counter::LostOnLine] += account.lost;
    counters[Counter::LostInRestart] += u64::from(account.began_with_a_cut);
    counters[Counter::RejectedCrc] += account.rejected_checksum;
    let Some(session) = driver.lms() else { return };
    let tally = session.tally();
    counters[Counter::Aborted] += tally.aborted;
    for (reject, counter) in REJECTS {
        counters[counter] += tally.rejected[reject as usize];
    }
}

/// But for the checksum, which every family has.
const REJECTS: [(Reject, Counter); Reject::COUNT - 1] = [
    (Reject::Address, Counter::RejectedAddress),
    (Reject::Length, Counter::RejectedLength),
    (Reject::Command, Counter::RejectedCommand),
    (Reject::Count, Counter::RejectedCount),
    (Reject::Vetoed, Counter::RejectedVetoed),
    (Reject::Superseded, Counter::RejectedSuperseded),
];

/// The rate is that of the last seconds.
const RATE_WINDOW: Nanos = 5_000_000_000;
