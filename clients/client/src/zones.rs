//! Subscriber of the zones of one sensor: its verdict, the deadline after which the verdict is `unknown`, and early
//! warnings. The verdict expires in this process, whether the sensor, the hub or the machine has stopped. A program
//! that acts on the verdict needs no timeout of its own.

use std::time::Duration;

use scanhub_schema::{Early, Flags, Header, Verdict, Zones};

use crate::builder::SubscriberBuilder;
use crate::clock::{self, Timestamp};
use crate::error::Error;
use crate::session::Session;
use crate::silence::Silence;
use crate::subscribe::sealed::Sealed;
use crate::subscribe::{ItemSource, Subscribe, Subscriber};
use crate::topic_reader::TopicReader;

/// Subscribes to the zones of `sensor` in the domain that SCANHUB_DOMAIN names. The hub may start later.
///
/// # Examples
///
/// ```no_run
/// use scanhub_client::{Error, Verdict, zones};
///
/// fn main() -> Result<(), Error> {
///     let mut front = zones("front")?;
///     loop {
///         let update = front.next()?;
///         // An unknown verdict counts as a stop.
///         let may_go = matches!(update.zones.verdict(), Verdict::Clear | Verdict::Slow);
///         println!("may go: {may_go}");
///     }
/// }
/// ```
///
/// # Errors
///
/// [`ErrorKind::InvalidInput`](crate::ErrorKind) if a name is invalid.
pub fn zones(sensor: &str) -> Result<ZonesSubscriber, Error> {
    ZonesSubscriber::builder(sensor).open()
}

/// New zones of a sensor, or the report of a silence.
#[derive(Clone, Copy, Debug)]
pub struct ZonesUpdate {
    /// Zones of the sample; [`Zones::unknown`] if it was too old on arrival, and in a silence.
    pub zones: Zones,
    /// Header of the sample; `None` in a silence.
    pub header: Option<Header>,
    /// Number of samples that were sent since the previous update, but not returned.
    pub missed: u64,
    /// Whether the zones are unknown because no recent data arrived, and not because the hub reports it.
    pub stale: bool,
    /// Zones that the hub sent, even if they were too old on arrival. A program may store these zones, but must not act
    /// on them.
    pub as_published: Zones,
}

impl ZonesUpdate {
    /// Returns the update of a silence.
    pub(crate) fn silence() -> ZonesUpdate {
        ZonesUpdate {
            zones: Zones::unknown(),
            header: None,
            missed: 0,
            stale: true,
            as_published: Zones::unknown(),
        }
    }
}

/// Subscriber of the zones of a sensor.
pub type ZonesSubscriber = Subscriber<ZonesUpdate>;

impl Subscriber<ZonesUpdate> {
    /// Waits for the newest sample, or for one `unknown` per silence. Returns `unknown` two scan periods and 40 ms
    /// after the last sample, but for a remote sensor after at least half a second. If no sample arrives at all,
    /// returns `unknown` one second after the start, with or without a hub.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`Subscriber::next`](crate::Subscriber::next). After an error, the zones are unknown, too.
    #[allow(clippy::should_implement_trait)] // There is no end that an iterator would have.
    pub fn next(&mut self) -> Result<ZonesUpdate, Error> {
        self.wait_for_next()
    }
}

impl Sealed for ZonesUpdate {}

impl Subscribe for ZonesUpdate {
    type Sensors<'a> = &'a str;
    type Item = ZonesUpdate;
    type Source = ZonesSource;

    fn source(options: &SubscriberBuilder<ZonesUpdate>) -> ZonesSource {
        ZonesSource::new(options.sensor())
    }
}

impl ItemSource for ZonesSource {
    type Item = ZonesUpdate;

    fn subscribed(&self) -> bool {
        self.subscribed()
    }

    /// Returns the last one of all samples that have arrived. The samples before it count as missed.
    fn receive(&mut self, session: &mut Session) -> Result<Option<ZonesUpdate>, Error> {
        let mut newest: Option<ZonesUpdate> = None;
        while let Some(mut update) = self.receive(session)? {
            update.missed += newest.map_or(0, |passed| passed.missed + u64::from(passed.header.is_some()));
            newest = Some(update);
        }
        Ok(newest)
    }

    fn time_left(&self) -> Option<Duration> {
        self.time_left()
    }

    fn why_silent(&mut self, session: &mut Session) -> Silence {
        self.why_silent(session)
    }
}

/// Source of the samples and silences of a sensor's zones, in the caller's session.
pub struct ZonesSource {
    reader: TopicReader<Zones>,
    state: ZonesState,
    /// Early warnings, if the caller has requested them.
    early: Option<Box<(TopicReader<Early>, EarlyState)>>,
}

impl ZonesSource {
    /// Creates a source for the zones of `sensor`.
    pub fn new(sensor: &str) -> ZonesSource {
        ZonesSource { reader: TopicReader::new(sensor), state: ZonesState::new(clock::now()), early: None }
    }

    /// Subscribes to early warnings of `sensor`, too. A warning makes the verdict worse until the zones of its scan
    /// arrive, or until the hub withdraws it.
    pub(crate) fn with_early(self, sensor: &str) -> ZonesSource {
        ZonesSource { early: Some(Box::new((TopicReader::new(sensor), EarlyState::new()))), ..self }
    }

    /// Returns whether this source has subscribed to the topic at least once.
    pub fn subscribed(&self) -> bool {
        self.reader.subscribed()
    }

    /// Returns why no zones arrive, as [`TopicReader::why_silent`] does.
    pub fn why_silent(&mut self, session: &mut Session) -> Silence {
        self.reader.why_silent(session)
    }

    /// Returns whether the first sample has arrived, or its deadline has passed.
    pub fn has_update(&self) -> bool {
        self.state.has_update()
    }

    /// Returns the next sample that has arrived. Returns a silence if there is none and the last sample has just become
    /// too old.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`TopicReader::receive`].
    pub fn receive(&mut self, session: &mut Session) -> Result<Option<ZonesUpdate>, Error> {
        let sample = self.reader.receive(session)?;
        let now = clock::now();
        let update = match sample {
            Some(sample) => Some(self.state.take(sample.header(), &sample, sample.missed, now)),
            None => self.state.silence(now),
        };
        let Some((reader, early_state)) = self.early.as_deref_mut() else { return Ok(update) };
        if let Some(mut update) = update {
            update.zones = early_state.update(&update.zones, update.header.as_ref());
            return Ok(Some(update));
        }
        while let Some(early) = reader.receive(session)? {
            let header = *early.header();
            if let Some(zones) = early_state.warn(&early, &header) {
                return Ok(Some(ZonesUpdate {
                    zones,
                    header: Some(header),
                    missed: 0,
                    stale: false,
                    as_published: zones,
                }));
            }
        }
        Ok(None)
    }

    /// Returns the time after which [`receive`](Self::receive) returns a silence if no sample arrives.
    pub fn time_left(&self) -> Option<Duration> {
        self.state.time_left(clock::now())
    }
}

/// State of one sensor's zones, for programs that do not receive samples through a session. Callers pass the time.
///
/// # Examples
///
/// ```
/// use scanhub_client::clock::Timestamp;
/// use scanhub_client::streams::ZonesState;
/// use scanhub_client::{Header, Robot, Verdict, Zones};
///
/// let at = |ms: u64| Timestamp { monotonic_ns: ms * 1_000_000, boottime_ns: ms * 1_000_000 };
/// let (mut front, mut robot) = (ZonesState::new(at(0)), Robot::default());
/// let position = robot.expect("front");
/// let clear = Zones { verdict: Verdict::Clear as u8, ..Zones::unknown() };
/// let header = Header { stamp_last_ns: 10_000_000, period_us: 26_640, ..Header::default() };
/// robot.update(position, front.take(&header, &clear, 0, at(10)).zones);
/// assert_eq!(robot.verdict(), Verdict::Clear);
/// // Two periods and 40 ms later.
/// if let Some(silence) = front.silence(at(104)) {
///     robot.update(position, silence.zones);
/// }
/// assert_eq!(robot.verdict(), Verdict::Unknown);
/// ```
#[derive(Clone, Debug)]
pub struct ZonesState {
    staleness: StalenessTimer,
    has_update: bool,
}

impl ZonesState {
    /// Creates the state of a sensor, whose first sample is expected from `now` on.
    pub fn new(now: Timestamp) -> ZonesState {
        ZonesState { staleness: StalenessTimer::new(now), has_update: false }
    }

    /// Handles a sample that arrived at `now`, and returns the update. `missed` is the number of samples before it that
    /// were not received.
    pub fn take(&mut self, header: &Header, zones: &Zones, missed: u64, now: Timestamp) -> ZonesUpdate {
        self.has_update = true;
        let fresh = self.staleness.update(header, zones.verdict(), now);
        let known = if fresh { *zones } else { Zones::unknown() };
        ZonesUpdate { zones: known, header: Some(*header), missed, stale: !fresh, as_published: *zones }
    }

    /// Returns a silence if the last sample has become too old: once, until the next sample arrives.
    pub fn silence(&mut self, now: Timestamp) -> Option<ZonesUpdate> {
        let silence = self.staleness.silence(now).then(ZonesUpdate::silence);
        self.has_update |= silence.is_some();
        silence
    }

    /// Returns whether the first sample has arrived, or its deadline has passed.
    pub fn has_update(&self) -> bool {
        self.has_update
    }

    /// Returns the time until the deadline. `None` if it has passed, so that only a sample can change anything.
    pub fn time_left(&self, now: Timestamp) -> Option<Duration> {
        self.staleness.time_left(now)
    }
}

/// Timer with the deadline of one sensor's verdict. Callers pass the time.
#[derive(Clone, Debug)]
pub struct StalenessTimer {
    until: Timestamp,
    /// Whether this silence was reported, so that the verdict is already unknown.
    is_reported: bool,
}

/// Time that passes after the last scan, in addition to two periods, until the hub publishes `unknown`
/// (`docs/topics.md`), in ns.
const HUB_STALE_AFTER_NS: u64 = 20_000_000;

/// Additional time that a client waits, in ns. A running hub then reports the silence first, so that each silence has
/// only one `unknown`.
const CLIENT_MARGIN_NS: u64 = 20_000_000;

/// Time after which a sample without a period is too old, in ns. It is longer than two periods of scans at half degrees
/// and 38400 baud, which are 0.4 s. It is also the minimum for samples from another machine, because networks delay
/// data. Wireless networks do so by a tenth of a second.
const DEFAULT_STALE_AFTER_NS: u64 = 500_000_000;

/// Time within which the first sample must arrive, in ns. A running hub sends the history to new subscribers within a
/// tenth of a second, and a starting hub needs longer.
const FIRST_SAMPLE_TIMEOUT_NS: u64 = 1_000_000_000;

impl StalenessTimer {
    /// Creates the deadline of a sensor, whose first sample is expected from `now` on.
    pub fn new(now: Timestamp) -> StalenessTimer {
        StalenessTimer { until: add_ns(now, FIRST_SAMPLE_TIMEOUT_NS), is_reported: false }
    }

    /// Handles a sample with `header` and `verdict` that arrived at `now`. Returns whether its verdict is valid. The
    /// deadline runs from the stamp or from the arrival, whichever is earlier, so a stamp in the future does not extend
    /// the deadline. The verdict `unknown` is valid at any age.
    pub fn update(&mut self, header: &Header, verdict: Verdict, now: Timestamp) -> bool {
        let limit_ns = match header.period_us {
            0 => DEFAULT_STALE_AFTER_NS,
            period_us => 2000 * u64::from(period_us) + HUB_STALE_AFTER_NS + CLIENT_MARGIN_NS,
        };
        let is_remote = header.flags & Flags::REMOTE != 0;
        let limit_ns = if is_remote { limit_ns.max(DEFAULT_STALE_AFTER_NS) } else { limit_ns };
        let silent_at = add_ns(now, limit_ns);
        let stale_at_ns = header.stamp_last_ns.saturating_add(limit_ns);
        self.until = Timestamp { monotonic_ns: silent_at.monotonic_ns.min(stale_at_ns), ..silent_at };
        let is_unknown = verdict == Verdict::Unknown;
        let fresh = now.monotonic_ns < self.until.monotonic_ns;
        self.is_reported = is_unknown || !fresh;
        is_unknown || fresh
    }

    /// Returns whether the verdict has become too old: `true` once, until the next sample.
    pub fn silence(&mut self, now: Timestamp) -> bool {
        let over = now.monotonic_ns >= self.until.monotonic_ns || now.boottime_ns >= self.until.boottime_ns;
        if self.is_reported || !over {
            return false;
        }
        self.is_reported = true;
        true
    }

    /// Returns the time until the deadline. `None` if it has passed, so that only a sample can change anything.
    pub fn time_left(&self, now: Timestamp) -> Option<Duration> {
        let left_ns = self.until.monotonic_ns.saturating_sub(now.monotonic_ns);
        let awake_ns = self.until.boottime_ns.saturating_sub(now.boottime_ns);
        (!self.is_reported).then(|| Duration::from_nanos(left_ns.min(awake_ns)))
    }
}

fn add_ns(time: Timestamp, by_ns: u64) -> Timestamp {
    Timestamp {
        monotonic_ns: time.monotonic_ns.saturating_add(by_ns),
        boottime_ns: time.boottime_ns.saturating_add(by_ns),
    }
}

/// Zones of one sensor, combined with the early warning of the scan after them. A warning makes the verdict worse until
/// the zones of the same scan arrive, or until the hub withdraws it. A warning never makes the verdict better.
#[derive(Clone, Debug)]
struct EarlyState {
    zones: Zones,
    /// `boot` and `seq` of the last scan whose zones are known.
    scan: Option<(u64, u64)>,
    /// Valid warning, with `boot` and `seq` of its scan.
    warning: Option<((u64, u64), Early)>,
}

impl EarlyState {
    fn new() -> EarlyState {
        EarlyState { zones: Zones::unknown(), scan: None, warning: None }
    }

    /// Handles the zones of a scan, or a silence, which has no header. Returns the zones, combined with the warning of
    /// a later scan.
    fn update(&mut self, zones: &Zones, header: Option<&Header>) -> Zones {
        self.zones = *zones;
        let Some(header) = header else {
            self.warning = None;
            return *zones;
        };
        self.scan = Some((header.boot, header.seq));
        self.warning = self.warning.filter(|((boot, seq), _)| *boot == header.boot && *seq > header.seq);
        self.warning.map_or(*zones, |(_, early)| self.with_warning(&early))
    }

    /// Returns the zones combined with the warning `early`, or `None` if the zones of the warning's scan have already
    /// arrived.
    fn warn(&mut self, early: &Early, header: &Header) -> Option<Zones> {
        if self.scan.is_some_and(|(boot, seq)| boot == header.boot && header.seq <= seq) {
            return None;
        }
        if early.is_withdrawn() {
            self.warning = None;
            return Some(self.zones);
        }
        self.warning = Some(((header.boot, header.seq), *early));
        Some(self.with_warning(early))
    }

    fn with_warning(&self, early: &Early) -> Zones {
        let mut zones = Zones { verdict: self.zones.verdict().worse(warning(early)) as u8, ..self.zones };
        if self.zones.nearest().is_none_or(|(_, known_mm)| early.distance_mm < known_mm) {
            (zones.nearest_beam, zones.nearest_mm) = (early.beam, early.distance_mm);
        }
        zones
    }
}

/// Returns the verdict of a warning. Any verdict except `slow` and `stop` is ignored, such as that of a later version.
fn warning(early: &Early) -> Verdict {
    match early.verdict() {
        warning @ (Verdict::Slow | Verdict::Stop) => warning,
        Verdict::Clear | Verdict::Unknown => Verdict::Clear,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000_000;

    /// Returns the time `ms` after the start of the machine, which was never suspended.
    fn at(ms: u64) -> Timestamp {
        Timestamp { monotonic_ns: ms * MS, boottime_ns: ms * MS }
    }

    fn header(stamp_ms: u64, period_us: u32) -> Header {
        Header { stamp_last_ns: stamp_ms * MS, period_us, ..Header::default() }
    }

    /// Period of scans at half degrees. The limit is two periods and 2 x 20 ms: 93.28 ms.
    const PERIOD_US: u32 = 26_640;

    #[test]
    fn silence_is_reported_once() {
        let mut freshness = StalenessTimer::new(at(0));
        freshness.update(&header(100, PERIOD_US), Verdict::Clear, at(100));
        assert_eq!(freshness.time_left(at(100)), Some(Duration::from_micros(93_280)));
        assert!(!freshness.silence(at(193)));
        assert!(freshness.silence(at(194)) && !freshness.silence(at(195)) && !freshness.silence(at(90_000)));
        assert_eq!(freshness.time_left(at(195)), None);
        freshness.update(&header(200, PERIOD_US), Verdict::Stop, at(200));
        assert!(!freshness.silence(at(293)) && freshness.silence(at(294)));
    }

    #[test]
    fn silence_is_unknown_once_and_unknown_never_expires() {
        let mut freshness = StalenessTimer::new(at(50));
        assert_eq!(freshness.time_left(at(50)), Some(Duration::from_secs(1)));
        assert!(!freshness.silence(at(1049)) && freshness.silence(at(1050)) && !freshness.silence(at(9000)));
        // The hub itself publishes the silence.
        assert!(freshness.update(&header(2000, PERIOD_US), Verdict::Unknown, at(2000)));
        assert_eq!((freshness.silence(at(9000)), freshness.time_left(at(2000))), (false, None));
        assert!(freshness.update(&header(2000, PERIOD_US), Verdict::Unknown, at(60_000)), "to a late joiner");
    }

    #[test]
    fn verdict_that_arrives_stale_is_not_accepted() {
        let mut freshness = StalenessTimer::new(at(0));
        assert!(freshness.update(&header(100, PERIOD_US), Verdict::Clear, at(180)));
        assert!(!freshness.silence(at(193)) && freshness.silence(at(194)));
        assert!(!freshness.update(&header(100, PERIOD_US), Verdict::Clear, at(500)), "too old when it came");
        assert!(!freshness.silence(at(9000)), "which says enough");
        assert!(freshness.update(&header(99_999, PERIOD_US), Verdict::Clear, at(600)));
        assert!(!freshness.silence(at(693)) && freshness.silence(at(694)), "a stamp in the future");
    }

    #[test]
    fn time_of_suspension_makes_a_verdict_stale() {
        let mut freshness = StalenessTimer::new(at(0));
        freshness.update(&header(100, PERIOD_US), Verdict::Clear, at(100));
        let resumed = Timestamp { boottime_ns: 3_600_000 * MS, ..at(110) };
        assert_eq!(freshness.time_left(resumed), Some(Duration::ZERO));
        assert!(freshness.silence(resumed));
    }

    #[test]
    fn remote_verdict_is_valid_for_at_least_500_ms() {
        let mut freshness = StalenessTimer::new(at(0));
        for (period_us, limit_ms) in [(0, 500), (PERIOD_US, 500), (230_000, 500), (1_000_000, 2040)] {
            let remote = Header { flags: Flags::REMOTE, ..header(100, period_us) };
            freshness.update(&remote, Verdict::Clear, at(100));
            assert_eq!(freshness.time_left(at(100)), Some(Duration::from_millis(limit_ms)), "{period_us}");
        }
    }

    #[test]
    fn invalid_header_times_do_not_overflow() {
        let mut freshness = StalenessTimer::new(at(0));
        freshness.update(&header(100, 0), Verdict::Clear, at(100));
        assert!(!freshness.silence(at(599)) && freshness.silence(at(600)));
        let end = Header { stamp_last_ns: u64::MAX, period_us: u32::MAX, ..Header::default() };
        let last = Timestamp { monotonic_ns: u64::MAX, boottime_ns: u64::MAX };
        assert!(!freshness.update(&end, Verdict::Clear, last));
    }

    fn zones(verdict: u8) -> Zones {
        Zones { verdict, ..Zones::unknown() }
    }

    const STOP: Early =
        Early { verdict: 2, flags: 0, beam: 40, distance_mm: 500, bytes_seen: 240, beams_seen: 116 };

    /// Vectors that the tests of the Python package also use.
    const VECTORS: &str = include_str!("../../../tests/vectors/early.txt");

    fn scan_header(scan: &str) -> Header {
        let (boot, seq) = scan.split_once(':').expect("LIFE:NUMBER");
        Header {
            boot: boot.parse().expect("a boot ID"),
            seq: seq.parse().expect("a number"),
            ..Header::default()
        }
    }

    fn verdict_text(zones: &Zones) -> String {
        let nearest = zones.nearest().map_or("-".to_owned(), |(_, mm)| mm.to_string());
        format!("{} {nearest}", zones.verdict() as u8)
    }

    #[test]
    fn warnings_and_verdicts_match_the_vectors() {
        let (mut warned, mut steps) = (EarlyState::new(), 0);
        let lines = VECTORS.lines().zip(1..).filter(|(line, _)| !line.is_empty() && !line.starts_with('#'));
        for (line, number) in lines {
            let (step, known) = line.split_once(" => ").unwrap_or((line, ""));
            let words: Vec<&str> = step.split(' ').collect();
            let verdict = |word: &str| word.parse().expect("a verdict");
            let result = match words[..] {
                ["begin"] => {
                    warned = EarlyState::new();
                    continue;
                }
                ["zones", scan, word, nearest] => {
                    let mut zones = zones(verdict(word));
                    if let Ok(mm) = nearest.parse() {
                        (zones.nearest_beam, zones.nearest_mm) = (7, mm);
                    }
                    Some(warned.update(&zones, Some(&scan_header(scan))))
                }
                ["silence"] => Some(warned.update(&Zones::unknown(), None)),
                ["early", scan, word, mm] => {
                    let distance_mm = mm.parse().expect("a distance");
                    warned.warn(&Early { verdict: verdict(word), distance_mm, ..STOP }, &scan_header(scan))
                }
                ["withdrawn", scan] => {
                    warned.warn(&Early { flags: Early::WITHDRAWN, ..STOP }, &scan_header(scan))
                }
                _ => panic!("line {number}: {line}"),
            };
            assert_eq!(
                result.as_ref().map_or("old".to_owned(), verdict_text),
                known,
                "line {number}: {line}"
            );
            steps += 1;
        }
        assert!(steps > 40, "{steps}");
    }

    #[test]
    fn nearest_beam_and_range_are_of_the_nearest_point() {
        let mut warned = EarlyState::new();
        warned.update(&zones(0), Some(&scan_header("1:7")));
        let stop = warned.warn(&STOP, &scan_header("1:8")).expect("a warning");
        assert_eq!((stop.verdict(), stop.nearest()), (Verdict::Stop, Some((40, 500))));
        let near = Zones { nearest_beam: 3, nearest_mm: 400, ..zones(0) };
        assert_eq!(warned.update(&near, Some(&scan_header("1:7"))).nearest(), Some((3, 400)));
    }

    #[test]
    fn warning_never_improves_the_verdict() {
        let mut warned = EarlyState::new();
        let slow = Early { verdict: Verdict::Slow as u8, ..STOP };
        for verdict in Verdict::ALL {
            warned.update(&zones(verdict as u8), None);
            for early in [slow, STOP, Early { verdict: 9, ..STOP }, Early { verdict: 0, ..STOP }] {
                let now =
                    warned.warn(&early, &scan_header("1:1")).expect("nothing is known of the scan").verdict();
                assert_eq!(now.worse(verdict), now, "{verdict:?} and {early:?}");
            }
        }
    }
}
