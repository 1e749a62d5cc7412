//! The path of a scan, from the session to the subscribers of a link.
//!
//! A session returns telegrams with a scan, or packets and then the scan of a revolution.
//! [`LinkOutput::publish_telegram`], [`publish_packets`](LinkOutput::publish_packets) and
//! [`publish_revolution`](LinkOutput::publish_revolution) publish them. All scans then take the same path,
//! `LinkOutput::publish_scan`: decode, send, zones, send, the other processors, send. A doorbell rings as soon as the
//! last of its topics that has a subscriber was sent. Work without a waiting subscriber follows the last ring, such as
//! a background that only learns. Nothing on this path allocates, locks or logs.

use scanhub_config::{Link, Processing};
use scanhub_drivers::line::{RawScan, ReceivedTelegram, TelegramContents};
use scanhub_schema::{
    ArrayFlags, Background, DoorbellWord, Failure, Flags, Foreground, Header, Nanos, Pose, Scan, Verb,
    WakeEvent, Zones,
};

use crate::early::{EarlyMessage, EarlyWarner};
use crate::pipeline::{BackgroundReset, Pipeline, ResultBuffers};
use crate::platform::Platform;
use crate::topics::{Stage, Topics};

/// Time, period and flags that a recording has for a telegram. They replace the values of the session. The default
/// replaces none of them.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct RecordedMetadata {
    /// Wall clock of the first byte.
    pub(crate) wall_ns: Option<u64>,
    /// Nominal time to the next scan, if it differs from the period at the link's rate.
    pub(crate) period_us: Option<u32>,
    /// Time to the next scan if this time is longer than nominal, otherwise 0.
    pub(crate) gap_us: u32,
    /// Factor by which the replay is slower than the recording; 1 or less if the replay is not slower.
    pub(crate) stretch: f64,
    /// Stamp of the scan in the time of the recording, which does not depend on the rate of the replay.
    pub(crate) measured_ns: Option<Nanos>,
    /// [`Flags`] that the recording has for the line, such as the flag of a simulated scanner.
    pub(crate) flags: u8,
}

impl RecordedMetadata {
    /// Returns the time that `period_us` takes in this replay.
    pub(crate) fn stretched(&self, period_us: u32) -> u32 {
        if self.stretch > 1.0 { (f64::from(period_us) * self.stretch) as u32 } else { period_us }
    }
}

/// Result of publishing a telegram, packets or a revolution.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PublishOutcome {
    /// Whether the telegram, packet or revolution was marked as suspect.
    pub(crate) is_suspect: bool,
    /// Time for which the verdict on the published scan is valid; `None` if no scan was published.
    pub(crate) verdict_lifetime: Option<Nanos>,
}

/// Output of one link: its topics, the processors that compute the results in them, and the validity of the last
/// verdict.
pub(crate) struct LinkOutput<'a, S: Platform> {
    link: &'a Link,
    platform: &'a S,
    pub(crate) topics: Topics<'a, S>,
    /// The last scan, in memory of this process. The processors read it after its sample was sent.
    scan: Box<Scan>,
    pipeline: Pipeline,
    early: EarlyWarner,
    /// Time at which the last verdict of the zones becomes stale; `Nanos::MAX` without a valid verdict.
    stale_at: Nanos,
    /// Whether too few beams of the scanner see into the largest zone.
    is_blind: bool,
}

impl<'a, S: Platform> LinkOutput<'a, S> {
    /// Creates the output of `link`, without publishing anything.
    pub(crate) fn new(link: &'a Link, platform: &'a S, topics: Topics<'a, S>) -> Self {
        let beams = link.max_beams();
        LinkOutput {
            link,
            platform,
            topics,
            scan: Scan::zeroed(Scan::len(beams, ArrayFlags::REVOLUTION)),
            pipeline: Pipeline::new(&link.processing, beams),
            early: EarlyWarner::new(beams),
            stale_at: Nanos::MAX,
            is_blind: false,
        }
    }

    /// Takes loans for the samples of a telegram that will be complete in a moment. Publishing the telegram then does
    /// not have to wait for memory.
    pub(crate) fn prepare(&mut self) {
        self.topics.prepare();
        if self.pipeline.publishes_every_scan() {
            self.topics.publishers.background.prepare();
        }
    }

    /// Publishes a telegram and the scan that it contains, if it can be decoded. Then wakes the subscribers. Values in
    /// `recorded` replace those of the session. If it `is_backlogged`, the telegram was buffered for an unknown time.
    pub(crate) fn publish_telegram(
        &mut self,
        received: &ReceivedTelegram<'_>,
        whole: &TelegramContents<'_>,
        recorded: &RecordedMetadata,
        is_backlogged: bool,
    ) -> PublishOutcome {
        let period_us = recorded.period_us.unwrap_or_else(|| micros(whole.period)).max(recorded.gap_us);
        let period_us = recorded.stretched(period_us);
        self.set_recorded_time(recorded);
        // A withdrawal has the sequence number that this telegram gets.
        self.withdraw(Some(whole.number));
        self.topics.publish_telegram(received, period_us);
        self.topics.end_stage(Stage::Telegram);
        let measured_ns = recorded.measured_ns;
        let publish = |scan| self.publish_scan(scan, measured_ns, period_us, is_backlogged);
        let verdict_lifetime = whole.scan.as_ref().map(publish);
        if verdict_lifetime.is_none() {
            self.topics.wake(WakeEvent::Telegram);
        }
        PublishOutcome { is_suspect: received.reasons != 0, verdict_lifetime }
    }

    /// Publishes packets that arrived together, and wakes their subscribers.
    pub(crate) fn publish_packets(
        &mut self,
        received: &ReceivedTelegram<'_>,
        recorded: &RecordedMetadata,
    ) -> PublishOutcome {
        self.set_recorded_time(recorded);
        // A packet has no period, only its scan has.
        self.topics.publish_telegram(received, 0);
        self.topics.wake_for_packets();
        PublishOutcome { is_suspect: received.reasons != 0, verdict_lifetime: None }
    }

    /// Publishes the scan of a revolution, whose packets were published, and wakes the subscribers. If it
    /// `is_backlogged`, the revolution was buffered for an unknown time. Returns how long the verdict on it is valid.
    pub(crate) fn publish_revolution(
        &mut self,
        scan: &RawScan<'_>,
        recorded: &RecordedMetadata,
        is_backlogged: bool,
    ) -> Nanos {
        let period_us = recorded.stretched(micros(scan.period));
        self.set_recorded_time(recorded);
        if self.early.has_warned() {
            // The last points may show that the near object belongs to the robot itself.
            self.update_early_warning(Some(scan));
        }
        self.topics.begin_revolution(scan.first, scan.last, scan.reasons, period_us);
        self.publish_scan(scan, recorded.measured_ns, period_us, is_backlogged)
    }

    /// Publishes a scan and the results that are computed from it, and wakes the subscribers. The subscribers of a
    /// stage are woken before the results of the next stage are computed. A result without a subscriber is computed
    /// only if the state of a processor depends on it. The processors use `measured_ns` in place of the scan's stamp,
    /// if it is given. Returns how long the verdict is valid.
    fn publish_scan(
        &mut self,
        raw: &RawScan<'_>,
        measured_ns: Option<Nanos>,
        period_us: u32,
        is_backlogged: bool,
    ) -> Nanos {
        let LinkOutput { topics, pipeline, scan, .. } = self;

        // Decode and send the scan. The sample is a copy, because the processors read the scan after the sample was
        // sent.
        let len = raw.payload_len();
        let mut scan_sample = topics.publishers.scan.loan(len);
        decode(raw, scan);
        if let Some(sample) = scan_sample.payload_mut() {
            sample.copy_from(scan.bytes());
        }
        let header = topics.header();
        topics.publishers.scan.send(scan_sample, &header, &mut topics.due);
        topics.end_stage(Stage::Scan);

        // Zones.
        let mut zones = topics.publishers.zones.loan(0);
        // A backlogged scan does not show the current surroundings of the robot.
        pipeline.zones.set_backlogged(is_backlogged);
        pipeline.check_zones(scan, zones.payload_mut());
        topics.publishers.zones.send(zones, &header, &mut topics.due);
        topics.end_stage(Stage::Zones);
        // A subscriber that attached during this scan may have received the zones, and must then be woken.
        topics.ring(DoorbellWord::First);

        // Marks, lines and motion.
        let measured_ns = measured_ns.unwrap_or(header.stamp_first_ns);
        if topics.is_awaited(Stage::Results) {
            self.publish_results(raw, measured_ns, &header);
        } else {
            pipeline.process(scan, measured_ns, raw.period, ResultBuffers::default());
            topics.publishers.marks.skip();
            topics.publishers.lines.skip();
            topics.publishers.motion.skip();
        }

        // Foreground and background.
        self.update_background(&header);
        self.topics.end_stage(Stage::Background);
        // Topic `background` has a history, so a subscriber that attached during this scan may have received a sample,
        // and must then be woken.
        if self.topics.is_ring_due() {
            self.topics.wake(WakeEvent::Telegram);
        }
        self.note_published(raw, period_us)
    }

    /// Computes and sends marks, lines and motion of the scan, which `raw` contains and which was measured at
    /// `measured_ns`.
    #[inline(never)]
    fn publish_results(&mut self, raw: &RawScan<'_>, measured_ns: Nanos, header: &Header) {
        let LinkOutput { topics, pipeline, scan, .. } = self;
        let mut marks = topics.publishers.marks.loan(0);
        let mut lines = topics.publishers.lines.loan(0);
        let mut motion = topics.publishers.motion.loan(0);
        let results = ResultBuffers {
            marks: marks.payload_mut(),
            lines: lines.payload_mut(),
            motion: motion.payload_mut(),
        };
        pipeline.process(scan, measured_ns, raw.period, results);
        topics.publishers.marks.send(marks, header, &mut topics.due);
        topics.publishers.lines.send(lines, header, &mut topics.due);
        topics.publishers.motion.send(motion, header, &mut topics.due);
        topics.end_stage(Stage::Results);
    }

    /// Updates the background from the scan, and sends foreground and background.
    fn update_background(&mut self, header: &Header) {
        if !self.pipeline.has_background() {
            return;
        }
        let reset = if self.topics.is_awaited(Stage::Background) {
            self.publish_foreground(header)
        } else {
            self.topics.publishers.foreground.skip();
            self.pipeline.learn(&self.scan, None)
        };
        if self.pipeline.publishes_every_scan() || self.pipeline.is_background_due() {
            self.send_background(header);
        }
        if let Some(reason) = reset {
            log_reset(&self.link.name, reason);
        }
    }

    /// Updates the background from the scan, and sends the foreground. Returns the reason if the background must be
    /// learned again.
    #[inline(never)]
    fn publish_foreground(&mut self, header: &Header) -> Option<BackgroundReset> {
        let LinkOutput { topics, pipeline, scan, .. } = self;
        let mut foreground = topics.publishers.foreground.loan(Foreground::len(scan.beams()));
        let reset = pipeline.learn(scan, foreground.payload_mut());
        topics.publishers.foreground.send(foreground, header, &mut topics.due);
        reset
    }

    /// Updates the state that depends on the last scan. Returns how long the verdict on it is valid.
    fn note_published(&mut self, raw: &RawScan<'_>, period_us: u32) -> Nanos {
        let is_blind = self.pipeline.zones.is_blind();
        if is_blind && !self.is_blind {
            log_blind(&self.link.name);
        }
        self.is_blind = is_blind;
        // The validity of the verdict begins now and not at the scan's stamp: telegrams that had to wait for the hub
        // are late, but scans do arrive.
        let lifetime = verdict_lifetime(period_us);
        self.stale_at = self.platform.now().saturating_add(lifetime);
        self.early.confirm(raw.number);
        lifetime
    }

    /// Updates the processors from a scan that is not published. `measured_ns` is its stamp in the time of the
    /// recording.
    pub(crate) fn learn(&mut self, raw: &RawScan<'_>, measured_ns: Nanos) {
        decode(raw, &mut self.scan);
        self.pipeline.check_zones(&self.scan, None);
        self.pipeline.process(&self.scan, measured_ns, raw.period, ResultBuffers::default());
        self.pipeline.learn(&self.scan, None);
    }

    /// Withdraws an early warning, and resets the state of the zones that depends on consecutive scans, after a silence
    /// that was not published.
    pub(crate) fn note_silence(&mut self) {
        self.withdraw(None);
        self.pipeline.mark_zones_unknown(&mut Zones::default());
    }

    /// Returns the number of reads per telegram: 1, unless early warnings have a subscriber.
    pub(crate) fn reads_per_telegram(&self) -> u8 {
        if self.topics.has_early_subscribers() { self.pipeline.reads_per_telegram() } else { 1 }
    }

    /// Publishes a warning if the `partial` scan gives one and warnings have a subscriber. Withdraws a warning of
    /// another scan, and a warning that no longer holds.
    pub(crate) fn update_early_warning(&mut self, partial: Option<&RawScan<'_>>) {
        self.withdraw(partial.map(|partial| partial.number));
        let Some(partial) = partial.filter(|_| self.topics.has_early_subscribers()) else { return };
        let [withdrawn, worse] = self.early.update(partial, &mut self.pipeline.zones, self.topics.next_seq());
        self.publish_withdrawal(withdrawn);
        if let Some(warning) = worse {
            let &RawScan { first, last, reasons, period, .. } = partial;
            self.topics.publish_early(&warning, first, last, reasons, micros(period));
        }
    }

    /// Returns whether a warning was published for a scan that is not complete yet.
    pub(crate) fn has_warned(&self) -> bool {
        self.early.has_warned()
    }

    /// Withdraws the warning of any scan but `number`.
    pub(crate) fn withdraw(&mut self, number: Option<u64>) {
        let withdrawn = self.early.withdraw(number);
        self.publish_withdrawal(withdrawn);
    }

    fn publish_withdrawal(&mut self, withdrawn: Option<EarlyMessage>) {
        if let Some(message) = withdrawn {
            let now = self.platform.now();
            self.topics.publish_early(&message, now, now, 0, 0);
        }
    }

    /// Sets the time and flags of the next samples to those of the recording.
    fn set_recorded_time(&mut self, recorded: &RecordedMetadata) {
        if let Some(wall_ns) = recorded.wall_ns {
            self.topics.set_recorded_time(wall_ns, Flags::REPLAYED | recorded.flags);
        }
    }

    /// Publishes the state before the first scan: unknown zones, and the background if one was loaded.
    pub(crate) fn publish_start(&mut self, now: Nanos) {
        self.send_unknown_zones(now);
        self.send_changed_background(now);
    }

    /// Publishes as of `now` that the zones are unknown, because no scans arrive, and wakes the subscribers.
    pub(crate) fn publish_stale(&mut self, now: Nanos) {
        self.withdraw(None);
        self.send_unknown_zones(now);
        self.topics.wake(WakeEvent::Status);
    }

    /// Publishes the background as of `now` if it has changed, and wakes the subscribers.
    pub(crate) fn publish_background(&mut self, now: Nanos) {
        if self.send_changed_background(now) {
            self.topics.wake(WakeEvent::Status);
        }
    }

    /// Returns the time at which the last verdict becomes stale; `Nanos::MAX` without a valid verdict.
    pub(crate) fn stale_at(&self) -> Nanos {
        self.stale_at
    }

    /// Keeps the last verdict valid until `until`, regardless of the scan period.
    pub(crate) fn extend_verdict(&mut self, until: Nanos) {
        self.stale_at = until;
    }

    /// Publishes that the zones are unknown if the last verdict has become stale by `now`, and before `until`.
    pub(crate) fn expire_verdict(&mut self, now: Nanos, until: Nanos) {
        if now >= self.stale_at && self.stale_at < until {
            self.stale_at = Nanos::MAX;
            self.publish_stale(now);
        }
    }

    /// Resets the processors, as at the start of the hub, and publishes their state. The unknown verdict is valid until
    /// `until`.
    pub(crate) fn restart(&mut self, now: Nanos, until: Nanos) {
        self.reset();
        self.stale_at = until;
        self.publish_start(now);
        self.topics.wake(WakeEvent::Status);
    }

    /// Resets the processors without publishing anything.
    pub(crate) fn reset(&mut self) {
        self.pipeline.reset();
    }

    /// Applies `processing` from the next scan on. Publishes the new state at once if no scans arrive.
    pub(crate) fn change(&mut self, processing: &Processing, now: Nanos) {
        self.withdraw(None);
        self.pipeline.change(processing);
        if self.stale_at == Nanos::MAX {
            self.send_unknown_zones(now);
        }
        self.send_changed_background(now);
        self.topics.wake(WakeEvent::Status);
    }

    /// Handles a user's request for the background. Returns the model for [`Verb::Show`].
    ///
    /// # Errors
    ///
    /// Returns the errors of [`Pipeline::handle`].
    pub(crate) fn handle(
        &mut self,
        verb: Verb,
        model: &Background,
    ) -> Result<Option<Box<Background>>, Failure> {
        self.pipeline.handle(&self.link.name, verb, model)
    }

    /// Returns the background for the next hub if it must be saved. At the end of the hub (`is_last`), one new scan is
    /// enough.
    pub(crate) fn take_background_to_save(&mut self, is_last: bool) -> Option<(Pose, Box<Background>)> {
        self.pipeline.take_background_to_save(is_last)
    }

    fn send_unknown_zones(&mut self, now: Nanos) {
        let pipeline = &mut self.pipeline;
        self.topics.send_zones(now, |zones| pipeline.mark_zones_unknown(zones));
    }

    /// Sends the background as of `now` if it has changed. Returns whether it has.
    fn send_changed_background(&mut self, now: Nanos) -> bool {
        let is_due = self.pipeline.is_background_due();
        if is_due {
            let header = self.topics.header_at(now);
            self.send_background(&header);
        }
        is_due
    }

    #[inline(never)]
    fn send_background(&mut self, header: &Header) {
        let (len, pipeline) = (self.pipeline.background_len(), &mut self.pipeline);
        self.topics.send_background(header, len, |background| pipeline.write_background(background));
    }
}

#[cold]
fn log_reset(link: &str, reason: BackgroundReset) {
    tracing::warn!("{link}: the background is learned again: {reason}");
}

#[cold]
fn log_blind(link: &str) {
    tracing::warn!("{link}: zones unknown: too few beams with a reading cross the largest zone");
}

/// Writes `raw` into `scan`, which is reallocated once if it is too short.
fn decode(raw: &RawScan<'_>, scan: &mut Box<Scan>) {
    Scan::grow(scan, raw.payload_len());
    raw.write(scan);
}

/// Returns a period in microseconds.
pub(crate) fn micros(period: Nanos) -> u32 {
    u32::try_from(period / scanhub_schema::MICROS).unwrap_or(u32::MAX)
}

/// Returns how long after a scan the verdict on it is valid, if scans arrive every `period_us`.
pub(crate) fn verdict_lifetime(period_us: u32) -> Nanos {
    if period_us == 0 { UNKNOWN_PERIOD_LIFETIME } else { 2000 * Nanos::from(period_us) + LIFETIME_MARGIN }
}

/// A verdict is valid for two scan periods and this time.
const LIFETIME_MARGIN: Nanos = 20 * scanhub_schema::MILLIS;
/// Validity of a verdict without a known scan period: two LMS scans of 361 beams at 38,400 baud, and
/// [`LIFETIME_MARGIN`].
const UNKNOWN_PERIOD_LIFETIME: Nanos = 480 * scanhub_schema::MILLIS;
