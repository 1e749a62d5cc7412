//! What a link makes of a telegram: the telegram itself, its scan, and what follows from that, into the link's topics.
//! Refuses to know whether it came down a line or was recorded, and when the next one comes.

use config::{Link, Processing};
use scanhub_drivers::lms::reply::Reply;
use scanhub_drivers::lms::session::Received;
use scanhub_drivers::lms::variant::{Mode, Variant};
use scanhub_drivers::{line, scanner};
use schema::{Background, Failure, Family, Flags, Nanos, Pose, Scan, Verb, Wake, Zones};

use crate::early::{Begun, EarlyWarner, Word};
use crate::pipeline::Pipeline;
use crate::process_turn::micros;
use crate::surroundings::Surroundings;
use crate::topics::Topics;

/// What a recording knows of a telegram and nobody could ask a line for; by default nothing.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct RecordedContext {
    /// The mode of a sensor that cannot be asked.
    pub(crate) mode: Option<Mode>,
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
        let pipeline = Pipeline::new(&link.processing, link.beams());
        let early = EarlyWarner::new(link.family(), link.beams());
        LinkOutput { link, around, topics, pipeline, early, stale_at: Nanos::MAX, is_blind: false }
    }

    /// Publishes a telegram and, if it is measured data that can be read, its scan and what is made of it. What `recorded`
    /// knows goes before what the link knows. A telegram that `is_behind` waited in the port for an unknown time.
    pub(crate) fn process(
        &mut self,
        received: &Received<'_>,
        recorded: &RecordedContext,
        is_behind: bool,
    ) -> Processed {
        let measured = match received.message.reply {
            Some(Reply::Measured(measured)) => Some(measured),
            _ => None,
        };
        let mode = received.message.mode.or(recorded.mode).filter(|mode| mode.has_ranges());
        let forbidden =
            measured.zip(mode).is_some_and(|(measured, mode)| scanner::is_forbidden(&measured, mode));
        let reasons = received.reasons | if forbidden { line::suspect::FORBIDDEN_BITS } else { 0 };
        let variant = measured.and_then(|measured| Variant::of_beams(measured.count()));
        let nominal = || scanner::period_us(variant, received.message.baud.rate());
        let period_us = recorded.period_us.unwrap_or_else(nominal).max(recorded.gap_us);
        let period_us = recorded.stretched(period_us);
        self.recall(recorded);
        // The number of what is taken back is the one that this telegram gets.
        self.withdraw(Some(received.message.offset));
        self.topics.telegram(received, reasons, period_us);
        let is_suspect = reasons != 0;
        // Better no range than a wrong one.
        let Some((measured, mode)) = measured.zip(mode) else {
            return Processed { is_suspect, stands_for: None };
        };
        let decode = |scan: &mut Scan| scanner::decode(&measured, mode, scan);
        let stands_for = limit(period_us);
        self.publish_scan(measured.count(), scanner::len(&measured), decode, stands_for, is_behind);
        self.early.confirm(received.message.offset);
        Processed { is_suspect, stands_for: Some(stands_for) }
    }

    /// In how many pieces a telegram of an LMS is read: 1, unless somebody wants to be warned early.
    pub(crate) fn pieces(&self) -> u8 {
        if self.topics.wants_early() { self.pipeline.pieces() } else { 1 }
    }

    /// Publishes what the scan that is arriving tells already, `begun`, if that is a warning and somebody wants it; and takes
    /// back what was said of one that is gone, or of this one where it is not true any more.
    pub(crate) fn foresee(&mut self, begun: Option<&Begun<'_>>) {
        self.withdraw(begun.map(Begun::number));
        let Some(begun) = begun.filter(|_| self.topics.wants_early()) else { return };
        let [withdrawn, worse] = self.early.look(begun, &mut self.pipeline.zones, self.topics.next_seq());
        self.take_back(withdrawn);
        if let Some(word) = worse {
            let (first, last, reasons, period_us) = match begun {
                Begun::Telegram(telegram) => {
                    let variant = Variant::of_beams(telegram.values.count());
                    let period_us = scanner::period_us(variant, telegram.baud.rate());
                    (telegram.first, telegram.last, telegram.reasons, period_us)
                }
                Begun::Turn(turn) => (turn.first, turn.last, turn.reasons, micros(turn.period)),
            };
            self.topics.early(&word, first, last, reasons, period_us);
        }
    }

    /// Whether something was said of a scan that is not complete.
    pub(crate) fn has_warned(&self) -> bool {
        self.early.has_said()
    }

    /// Takes back what was said of another scan than `number`.
    pub(crate) fn withdraw(&mut self, number: Option<u64>) {
        let withdrawn = self.early.withdraw(number);
        self.take_back(withdrawn);
    }

    fn take_back(&mut self, withdrawn: Option<Word>) {
        if let Some(word) = withdrawn {
            let now = self.around.now();
            self.topics.early(&word, now, now, 0, 0);
        }
    }

    /// What comes next was measured when `recorded` says.
    pub(crate) fn recall(&mut self, recorded: &RecordedContext) {
        if let Some(wall_ns) = recorded.wall_ns {
            self.topics.recall(wall_ns, Flags::REPLAYED | recorded.flags);
        }
    }

    /// Publishes the scan of `beams` beams and `len` bytes that `decode` writes, and what is made of it. The verdict on it
    /// stands for `stands_for`; of one that `is_behind`, it is not known.
    pub(crate) fn publish_scan(
        &mut self,
        beams: usize,
        len: usize,
        decode: impl FnOnce(&mut Scan),
        stands_for: Nanos,
        is_behind: bool,
    ) {
        // What waited in the port does not tell how it looks around the robot now.
        self.pipeline.zones.doubt(is_behind);
        if let Some(reason) = self.topics.scan(beams, len, decode, &mut self.pipeline) {
            tracing::warn!("{}: the background is learned again: {reason}", self.link.name);
        }
        let is_blind = self.pipeline.zones.is_blind();
        if std::mem::replace(&mut self.is_blind, is_blind) != is_blind && is_blind {
            tracing::warn!("{}: zones unknown: too few beams see into the largest circle", self.link.name);
        }
        // Telegrams that had to wait for the hub are late, but scans do not stay out.
        self.stale_at = self.around.now().saturating_add(stands_for);
    }

    /// The family of the link's scanner.
    pub(crate) fn family(&self) -> Family {
        self.link.family()
    }

    /// Takes loans for a telegram that will be complete in a moment, so that it need not wait for them.
    pub(crate) fn prepare(&mut self) {
        self.topics.prepare(&self.pipeline);
    }

    /// Lets all that has a memory learn from a telegram that says `reply` and is not published.
    pub(crate) fn learn(&mut self, reply: Option<&Reply<'_>>, mode: Option<Mode>) {
        let Some(mode) = mode.filter(|mode| mode.has_ranges()) else { return };
        if let Some(Reply::Measured(measured)) = reply {
            let decode = |scan: &mut Scan| scanner::decode(measured, mode, scan);
            self.learn_scan(scanner::len(measured), decode);
        }
    }

    /// As [`learn`](Self::learn), from a scan of `len` bytes that `decode` writes.
    pub(crate) fn learn_scan(&mut self, len: usize, decode: impl FnOnce(&mut Scan)) {
        self.topics.learn(len, decode, &mut self.pipeline);
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

/// For how long after a scan the verdict on it stands, if scans come every `period_us`.
pub(crate) fn limit(period_us: u32) -> Nanos {
    if period_us == 0 { NO_PERIOD } else { 2000 * Nanos::from(period_us) + GRACE }
}

/// A verdict stands for two scan periods and so much longer.
const GRACE: Nanos = 20 * schema::MILLIS;
/// The same for scans of no variant, which have no nominal period: two of 361 beams at 38400 baud and the grace.
const NO_PERIOD: Nanos = 480 * schema::MILLIS;
