//! Maps the scanner's clock to the hub's clock. A packet can be late for many reasons but never early. The smallest
//! delay of the last few seconds therefore holds for every packet in these seconds, even for packets that waited while
//! the host was stopped. The drift between the clocks is estimated too.

use scanhub_schema::{MILLIS, Nanos};

/// Clock of a scanner, with the minimum delays of the last seconds.
#[derive(Clone, Debug)]
pub struct SensorClock {
    /// Minimum delay of each span of time. The newest span is at index `next`, and the oldest span is at the next
    /// index.
    min_delays: [Option<Delay>; SensorClock::SPAN_COUNT],
    next: usize,
    /// Start of the newest span in the scanner's clock, and duration of a span. The first spans are short, so that the
    /// drift is known soon. Later spans are longer, so that the drift is known exactly.
    span_began: Nanos,
    span: Nanos,
    /// Minimum delay of all spans.
    min_delay: Option<Delay>,
    /// Time in nanoseconds that the hub's clock gains on the scanner's clock per nanosecond.
    drift: f64,
    /// Time from which stamps may be wrong relative to earlier stamps, and the maximum error in nanoseconds. `None` if
    /// no error is possible, or once later spans have resolved the uncertainty.
    uncertainty: Option<(Nanos, Nanos)>,
}

/// Offset from the scanner's clock to the hub's clock, observed at `sensor_time`.
#[derive(Clone, Copy, Debug)]
struct Delay {
    sensor_time: Nanos,
    offset: i64,
}

impl Delay {
    /// Returns the offset at the time `at` of the scanner's clock, if the clocks drift by `drift`.
    fn offset_at(self, at: Nanos, drift: f64) -> i64 {
        self.offset + (drift * (at as i64 - self.sensor_time as i64) as f64) as i64
    }
}

impl SensorClock {
    const SPAN_COUNT: usize = 16;

    /// Creates a clock that has not received a time.
    #[expect(clippy::new_without_default, reason = "the start of a stream is not a default value")]
    pub fn new() -> Self {
        SensorClock {
            min_delays: [None; Self::SPAN_COUNT],
            next: 0,
            span_began: 0,
            span: FIRST_SPAN,
            min_delay: None,
            drift: 0.0,
            uncertainty: None,
        }
    }

    /// Records that times of the scanner's clock from `at` on may be wrong by up to `max_error` relative to earlier
    /// times. The caller counted the time before `at` and did not measure it. Delays from before `at` stay in use until
    /// the delays after `at` agree with them within `max_error`.
    pub fn add_uncertainty(&mut self, at: Nanos, max_error: Nanos) {
        if self.min_delay.is_some() {
            self.uncertainty = Some((at, max_error));
            self.begin_span(at);
        }
    }

    /// Records an event that happened at `at` in the scanner's clock, and that arrived no later than `latest` in the
    /// hub's clock.
    pub fn note_arrival(&mut self, at: Nanos, latest: Nanos) {
        let delay = Delay { sensor_time: at, offset: latest as i64 - at as i64 };
        if self.min_delay.is_none() || at.saturating_sub(self.span_began) >= self.span {
            if self.span < MAX_SPAN && self.delays().count() == Self::SPAN_COUNT {
                self.join_pairs();
            }
            self.resolve_uncertainty(at);
            self.begin_span(at);
            self.estimate_drift();
            let drift = self.drift;
            self.min_delay = self.delays().min_by_key(|known| known.offset_at(at, drift));
        }
        let drift = self.drift;
        let is_less =
            |known: Option<Delay>| known.is_none_or(|known| delay.offset < known.offset_at(at, drift));
        if is_less(self.min_delays[self.next]) {
            self.min_delays[self.next] = Some(delay);
        }
        if is_less(self.min_delay) {
            self.min_delay = Some(delay);
        }
    }

    /// Converts the time `at` from the scanner's clock to the hub's clock. Returns `None` before the first event.
    pub fn time(&self, at: Nanos) -> Option<Nanos> {
        let min_delay = self.min_delay?;
        Some(at.saturating_add_signed(min_delay.offset_at(at, self.drift)))
    }

    fn begin_span(&mut self, at: Nanos) {
        self.next = (self.next + 1) % Self::SPAN_COUNT;
        self.min_delays[self.next] = None;
        self.span_began = at;
    }

    /// Handles the end of a span at `at`. Ends an [uncertainty](Self::add_uncertainty) and drops the spans before it,
    /// if the later spans agree with these spans within the maximum error or if there are no such spans.
    fn resolve_uncertainty(&mut self, at: Nanos) {
        let Some((from, max_error)) = self.uncertainty else { return };
        let offset_of = |known: Delay| known.offset_at(at, self.drift);
        let before = self.delays().filter(|known| known.sensor_time < from).map(offset_of).min();
        let since = self.delays().filter(|known| known.sensor_time >= from).map(offset_of).min();
        let is_known = match (before, since) {
            (Some(before), Some(since)) => since - before <= max_error as i64,
            (before, _) => before.is_none(),
        };
        if is_known {
            self.min_delays
                .iter_mut()
                .for_each(|slot| *slot = slot.filter(|known| known.sensor_time >= from));
            self.uncertainty = None;
        }
    }

    /// Joins pairs of spans, which doubles the duration of a span.
    fn join_pairs(&mut self) {
        let mut joined = [None; Self::SPAN_COUNT];
        for (n, delay) in self.delays().enumerate() {
            let slot: &mut Option<Delay> = &mut joined[n / 2];
            let drift = self.drift;
            if slot.is_none_or(|known| delay.offset < known.offset_at(delay.sensor_time, drift)) {
                *slot = Some(delay);
            }
        }
        (self.min_delays, self.next) = (joined, Self::SPAN_COUNT / 2 - 1);
        self.span *= 2;
    }

    fn delays(&self) -> impl Iterator<Item = Delay> {
        let (newer, older) = self.min_delays.split_at(self.next + 1);
        older.iter().chain(newer).copied().flatten()
    }

    /// Estimates the drift as the median slope over pairs of an older and a newer span. Ignores spans in which the host
    /// was stopped.
    fn estimate_drift(&mut self) {
        if self.uncertainty.is_some() {
            return;
        }
        let Some(min) = self.delays().min_by_key(|known| known.offset) else { return };
        let was_host_running = |known: &Delay| {
            let max_offset = MAX_DRIFT * known.sensor_time.abs_diff(min.sensor_time) as f64;
            ((known.offset - min.offset) as f64) < max_offset + MAX_JITTER_NS
        };
        let count = self.delays().filter(was_host_running).count();
        if count < MIN_SPANS {
            return;
        }
        let mut slopes = [0.0; (Self::SPAN_COUNT / 2) * Self::SPAN_COUNT.div_ceil(2)];
        let mut len = 0;
        for older in self.delays().filter(was_host_running).take(count / 2) {
            for newer in self.delays().filter(was_host_running).skip(count / 2) {
                let span = newer.sensor_time.saturating_sub(older.sensor_time).max(1);
                slopes[len] = (newer.offset - older.offset) as f64 / span as f64;
                len += 1;
            }
        }
        let slopes = &mut slopes[..len];
        slopes.sort_unstable_by(f64::total_cmp);
        self.drift = slopes[len / 2].clamp(-MAX_DRIFT, MAX_DRIFT);
    }
}

/// Maximum duration of a span. The first spans take `FIRST_SPAN`.
const MAX_SPAN: Nanos = 500 * MILLIS;
const FIRST_SPAN: Nanos = MAX_SPAN / 8;
/// Minimum number of spans for an estimate of the drift.
const MIN_SPANS: usize = 6;
/// Maximum drift, as a ratio. Every oscillator is more precise than this limit, even without a crystal.
const MAX_DRIFT: f64 = 0.02;
/// Maximum delay of a packet while the host runs, in nanoseconds.
const MAX_JITTER_NS: f64 = 4e6;

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the maximum error in microseconds after the first `from` seconds. The scanner's clock is slow by the
    /// ratio `drift`. The scanner sends a packet every 2 ms with a delay of at least 100 us. The host stops for `stall`
    /// seconds in every `every` seconds.
    fn worst_us(drift: f64, stall: f64, every: f64, from: f64) -> f64 {
        let mut clock = SensorClock::new();
        let mut random = fastrand::Rng::with_seed(7);
        let mut worst = 0.0f64;
        for n in 0..10_000u64 {
            let hub_s = n as f64 * 0.002;
            let sensor_s = hub_s * (1.0 - drift);
            let late_s = 0.000_1 + random.f64() * 0.003;
            let phase = hub_s % every;
            let stopped = if hub_s > 1.0 && phase < stall { stall - phase } else { 0.0 };
            let nanos = |s: f64| ((s + 1_000.0) * 1e9) as Nanos;
            clock.note_arrival(nanos(sensor_s), nanos(hub_s + late_s.max(stopped)));
            let mapped = clock.time(nanos(sensor_s)).expect("tied");
            if hub_s > from {
                worst = worst.max((mapped as f64 - nanos(hub_s) as f64).abs() / 1e3);
            }
        }
        worst
    }

    #[test]
    fn late_packets_do_not_shift_the_clock() {
        assert!(worst_us(0.0, 0.0, 1.0, 0.5) < 500.0);
        assert!(worst_us(0.0, 0.5, 3.0, 0.5) < 500.0);
        assert!(worst_us(0.0, 0.9, 5.0, 0.5) < 500.0);
    }

    #[test]
    fn miscounted_times_do_not_change_the_drift() {
        let mut clock = SensorClock::new();
        let (mut counted, mut wrong) = (0, 0);
        for n in 0..40_000u64 {
            let hub = 1_000_000_000_000 + n * MILLIS;
            // In one half second of every two seconds, all packets arrive late. After this half second, packets are
            // missing, and the caller counts one too few of them.
            let phase = n % 2_000;
            if n > 4_000 && phase == 1_250 {
                counted += MILLIS;
                clock.add_uncertainty(hub - counted, 3 * MILLIS);
            }
            let waits = if n > 4_000 && (1_000..1_500).contains(&phase) { 1_500 - phase } else { 0 };
            clock.note_arrival(hub - counted, hub + waits * MILLIS);
            let off = clock.time(hub - counted).expect("tied").abs_diff(hub);
            assert!(off <= 1_100_000, "{n}: {off}");
            wrong += u64::from(off > 100_000);
        }
        assert!(wrong < 18 * 800, "{wrong} of 40,000");
    }

    #[test]
    fn clock_follows_drift() {
        for drift in [-0.01, -0.000_5, 0.000_5, 0.01] {
            let worst = worst_us(drift, 0.0, 1.0, 4.0);
            assert!(worst < 1_000.0, "{drift}: {worst}");
            let worst = worst_us(drift, 0.5, 5.0, 4.0);
            assert!(worst < 1_500.0, "{drift}: {worst} with stalls");
        }
        assert!(worst_us(0.000_5, 0.5, 4.0, 0.5) < 2_500.0);
    }
}
