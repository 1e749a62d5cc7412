//! Publishes what a session has received: telegrams and packets as they are, scans, and what the processors compute
//! from them.

use config::{Link, Processing};
use scanhub_drivers::line::{RawScan, Received, Whole};
use schema::{Background, Failure, Flags, Nanos, Pose, Verb, Wake, Zones};

use crate::early::{EarlyMessage, EarlyWarner};
use crate::pipeline::Pipeline;
use crate::surroundings::Surroundings;
use crate::topics::Topics;

/// What a recording knows of a telegram and nobody could ask a line for; by default nothing.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct RecordedContext {
    /// Wall clock of its first byte.
    pub(crate) wall_ns: Option<u64>,
    /// Nominal time to the next scan, if it is not that of the link's rate.
    pub(crate) period_us: Option<u32>,
    /// The time to the next scan is longer than nominal, and known.
    pub(crate) gap_us: u32,
    /// How many times longer than then everything takes.
    pub(crate) stretch: f64,
    /// Of its [`Flags`] that it came from a pty.
    pub(crate) flags: u8,
}

impl RecordedContext {
    /// A period as long as it takes here.
    pub(crate) fn stretched(&self, period_us: u32) -> u32 {
        if self.stretch > 1.0 { (f64::from(period_us) * self.stretch) as u32 } else { period_us }
    }
}

/// What became of a telegram.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Processed {
    /// It was published with a doubt.
    pub(crate) is_suspect: bool,
    /// For how long the verdict on its scan stands; nothing if it has no scan.
    pub(crate) stands_for: Option<Nanos>,
}

/// The results of one link: its topics, the processors that make what is in them, and how long the last verdict stands.
pub(crate) struct LinkOutput<'a, S: Surroundings> {
    link: &'a Link,
    around: &'a S,
    pub(crate) topics: Topics<'a, S>,
    pipeline: Pipeline,
    pub(crate) early: EarlyWarner,
    /// When the last verdict of the zones is too old to stand; `Nanos::MAX` if none stands.
    stale_at: Nanos,
    /// The sensor, as it turned out to be, sees too little of its circles.
    is_blind: bool,
}

impl<'a, S: Surroundings> LinkOutput<'a, S> {
    /// The output of `link` into `topics`; nothing is published yet.
    pub(crate) fn new(link: &'a Link, around: &'a S, topics: Topics<'a, S>) -> Self {
        let pipeline = Pipeline::new(&link.processing, link.max_beams());
        let early = EarlyWarner::new(link.max_beams());
        LinkOutput { link, around, topics, pipeline, early, stale_at: Nanos::MAX, is_blind: false }
    }

    /// Publishes a telegram and the scan that it contains, if that can be read. Values in `recorded` replace those of
    /// the session. A telegram that `is_behind` was buffered for an unknown time.
    pub(crate) fn process_telegram(
        &mut self,
        received: &Received<'_>,
        whole: &Whole<'_>,
        recorded: &RecordedContext,
        is_behind: bool,
    ) -> Processed {
        let nominal = || micros(whole.period);
        let period_us = recorded.period_us.unwrap_or_else(nominal).max(recorded.gap_us);
        let period_us = recorded.stretched(period_us);
        self.recall(recorded);
        // A withdrawal has the sequence number that this telegram gets.
        self.withdraw(Some(whole.number));
        self.topics.telegram(received, period_us);
        let is_suspect = received.reasons != 0;
        let Some(scan) = &whole.scan else { return Processed { is_suspect, stands_for: None } };
        let stands_for = limit(period_us);
        self.publish_scan(scan, stands_for, is_behind);
        Processed { is_suspect, stands_for: Some(stands_for) }
    }

    /// Publishes packets that arrived together.
    pub(crate) fn process_packets(
        &mut self,
        received: &Received<'_>,
        recorded: &RecordedContext,
    ) -> Processed {
        self.recall(recorded);
        self.topics.packets(received);
        Processed { is_suspect: received.reasons != 0, stands_for: None }
    }

    /// Publishes a scan whose packets were published. One that `is_behind` was buffered for an unknown time. Returns
    /// how long the verdict on it stays valid.
    pub(crate) fn process_revolution(
        &mut self,
        scan: &RawScan<'_>,
        recorded: &RecordedContext,
        is_behind: bool,
    ) -> Nanos {
        self.recall(recorded);
        let period_us = recorded.stretched(micros(scan.period));
        if self.has_warned() {
            // The last points may show that what seemed near is the robot's own body.
            self.foresee(Some(scan));
        }
        self.topics.begin_revolution(scan.first, scan.last, scan.reasons, period_us);
        let stands_for = limit(period_us);
        self.publish_scan(scan, stands_for, is_behind);
        stands_for
    }

    /// Returns the number of reads per telegram: 1, unless early warnings have a subscriber.
    pub(crate) fn pieces(&self) -> u8 {
        if self.topics.wants_early() { self.pipeline.pieces() } else { 1 }
    }

    /// Publishes a warning if the `partial` scan gives one and a subscriber wants it. Withdraws a warning of another
    /// scan, and one that no longer holds.
    pub(crate) fn foresee(&mut self, partial: Option<&RawScan<'_>>) {
        self.withdraw(partial.map(|partial| partial.number));
        let Some(partial) = partial.filter(|_| self.topics.wants_early()) else { return };
        let [withdrawn, worse] = self.early.update(partial, &mut self.pipeline.zones, self.topics.next_seq());
        self.publish_withdrawal(withdrawn);
        if let Some(warning) = worse {
            let &RawScan { first, last, reasons, period, .. } = partial;
            self.topics.early(&warning, first, last, reasons, micros(period));
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
            let now = self.around.now();
            self.topics.early(&message, now, now, 0, 0);
        }
    }

    /// What comes next was measured when `recorded` says.
    pub(crate) fn recall(&mut self, recorded: &RecordedContext) {
        if let Some(wall_ns) = recorded.wall_ns {
            self.topics.recall(wall_ns, Flags::REPLAYED | recorded.flags);
        }
    }

    /// Publishes `scan` and what the processors compute from it. The verdict stays valid for `stands_for`; that on a
    /// scan that `is_behind` is not known.
    fn publish_scan(&mut self, scan: &RawScan<'_>, stands_for: Nanos, is_behind: bool) {
        // What waited in the port does not tell how it looks around the robot now.
        self.pipeline.zones.doubt(is_behind);
        if let Some(reason) = self.topics.scan(scan, &mut self.pipeline) {
            tracing::warn!("{}: the background is learned again: {reason}", self.link.name);
        }
        let is_blind = self.pipeline.zones.is_blind();
        if std::mem::replace(&mut self.is_blind, is_blind) != is_blind && is_blind {
            tracing::warn!("{}: zones unknown: too few beams see into the largest circle", self.link.name);
        }
        // Telegrams that had to wait for the hub are late, but scans do not stay out.
        self.stale_at = self.around.now().saturating_add(stands_for);
        self.early.confirm(scan.number);
    }

    /// Takes loans for a telegram that will be complete in a moment, so that it need not wait for them.
    pub(crate) fn prepare(&mut self) {
        self.topics.prepare(&self.pipeline);
    }

    /// Updates what is learned from a scan that is not published.
    pub(crate) fn learn(&mut self, scan: &RawScan<'_>) {
        self.topics.learn(scan, &mut self.pipeline);
    }

    /// As [`learn`](Self::learn), of a time without scans.
    pub(crate) fn learn_silence(&mut self) {
        self.withdraw(None);
        self.pipeline.stale(&mut Zones::default());
    }

    /// Publishes what is known before the first scan: nothing but the model to begin with.
    pub(crate) fn publish_start(&mut self, now: Nanos) {
        self.topics.stale(&mut self.pipeline, now);
        self.topics.background(&mut self.pipeline, now);
    }

    /// Publishes that nothing is known of the zones as of `now`, and wakes the consumers.
    pub(crate) fn publish_stale(&mut self, now: Nanos) {
        // Scans in a row are counted anew: what is arriving may not be enough.
        self.withdraw(None);
        self.topics.stale(&mut self.pipeline, now);
        self.topics.wake(Wake::Status);
    }

    /// Publishes the background as of `now` if it is news, and wakes the consumers.
    pub(crate) fn publish_background(&mut self, now: Nanos) {
        if self.topics.background(&mut self.pipeline, now) {
            self.topics.wake(Wake::Status);
        }
    }

    /// When the last verdict is too old to stand; `Nanos::MAX` if none stands.
    pub(crate) fn stale_at(&self) -> Nanos {
        self.stale_at
    }

    /// Lets the last verdict stand until `until`, whatever the period of its scan says.
    pub(crate) fn stand_until(&mut self, until: Nanos) {
        self.stale_at = until;
    }

    /// Publishes that scans stay out if that is so at `now`, and due before `until`.
    pub(crate) fn expire(&mut self, now: Nanos, until: Nanos) {
        if now >= self.stale_at && self.stale_at < until {
            self.stale_at = Nanos::MAX;
            self.publish_stale(now);
        }
    }

    /// Forgets all that was learned, as at the hub's start; that the zones are unknown stands until `until`.
    pub(crate) fn restart(&mut self, now: Nanos, until: Nanos) {
        self.forget();
        self.stale_at = until;
        self.publish_start(now);
        self.topics.wake(Wake::Status);
    }

    /// As [`restart`](Self::restart), without a word to consumers.
    pub(crate) fn forget(&mut self) {
        self.pipeline.reset();
    }

    /// Goes on as `processing` says from the next scan on. Where none come, the topics say at once how it is now.
    pub(crate) fn change(&mut self, processing: &Processing, now: Nanos) {
        self.withdraw(None);
        self.pipeline.change(processing);
        if self.stale_at == Nanos::MAX {
            self.topics.stale(&mut self.pipeline, now);
        }
        self.topics.background(&mut self.pipeline, now);
        self.topics.wake(Wake::Status);
    }

    /// Does what a user asks of the background; the model, for [`Verb::Show`].
    ///
    /// # Errors
    ///
    /// As [`Pipeline::handle`].
    pub(crate) fn handle(
        &mut self,
        verb: Verb,
        model: &Background,
    ) -> Result<Option<Box<Background>>, Failure> {
        self.pipeline.handle(&self.link.name, verb, model)
    }

    /// The model for the next hub, if that is news; if this is the `last` time, whatever there is.
    pub(crate) fn hand_on(&mut self, last: bool) -> Option<(Pose, Box<Background>)> {
        self.pipeline.hand_on(last)
    }
}

/// Returns a period in microseconds.
pub(crate) fn micros(period: Nanos) -> u32 {
    u32::try_from(period / schema::MICROS).unwrap_or(u32::MAX)
}

/// For how long after a scan the verdict on it stands, if scans come every `period_us`.
pub(crate) fn limit(period_us: u32) -> Nanos {
    if period_us == 0 { NO_PERIOD } else { 2000 * Nanos::from(period_us) + GRACE }
}

/// A verdict stands for two scan periods and so much longer.
const GRACE: Nanos = 20 * schema::MILLIS;
/// The same for scans of no variant, which have no nominal period: two of 361 beams at 38400 baud and the grace.
const NO_PERIOD: Nanos = 480 * schema::MILLIS;
