//! The topics of one link: numbers the samples, fills them in place, sends them, and wakes the subscribers. Nothing
//! waits for memory. A sample without memory is counted and its number is skipped, so that subscribers notice the gap.

use scanhub_drivers::line::{RawScan, Received};
use schema::limits::history;
use schema::{
    Background, Early, Failure, Family, Flags, Foreground, Header, Lines, MILLIS, Marks, Motion, Nanos,
    Quality, Ring, Scan, Status, Wake, Zones,
};
use shm::{DueRings, Medium, Payload, TopicPublisher};

use crate::early::EarlyMessage;
use crate::pipeline::{Outputs, Pipeline, Relearned};
use crate::surroundings::Surroundings;

/// A topic of a link.
type Publisher<P, S> = PreparedPublisher<P, <S as Surroundings>::Medium<P>>;

/// Publishers of all topics of one sensor. They belong to the thread of its link.
pub(crate) struct Topics<'a, S: Surroundings> {
    around: &'a S,
    telegram: Publisher<[u8], S>,
    scan: Publisher<Scan, S>,
    zones: Publisher<Zones, S>,
    marks: Publisher<Marks, S>,
    lines: Publisher<Lines, S>,
    motion: Publisher<Motion, S>,
    early: Publisher<Early, S>,
    foreground: Publisher<Foreground, S>,
    background: Publisher<Background, S>,
    status: Publisher<Status, S>,
    /// The last scan. Processors read it after its sample was sent.
    decoded: Box<Scan>,
    /// Samples that were sent, but whose subscribers were not woken yet.
    due: DueRings,
    /// Template for the header of the next sample.
    header: Header,
    /// Whether `header.wall_ns` comes from a recording.
    is_recalled: bool,
    last_telegram: LastStamps,
    last_revolution: LastStamps,
    next_seq: u64,
    /// Whether packets have a subscriber, as of `checked_at`.
    has_followers: bool,
    checked_at: Nanos,
}

impl<'a, S: Surroundings> Topics<'a, S> {
    /// Creates the topics of `sensor`, which is number `number` in the configuration. `boot` identifies the run of the hub.
    ///
    /// # Errors
    ///
    /// [`Kind::Short`](schema::Kind::Short) if no memory or descriptors are left.
    pub(crate) fn new(around: &'a S, sensor: &str, number: u8, boot: u64) -> Result<Self, Failure> {
        let header = Header { sensor: number, boot, hub_pid: std::process::id(), ..Header::default() };
        Ok(Topics {
            around,
            telegram: PreparedPublisher::new(around, sensor)?,
            scan: PreparedPublisher::new(around, sensor)?,
            zones: PreparedPublisher::new(around, sensor)?,
            marks: PreparedPublisher::new(around, sensor)?,
            lines: PreparedPublisher::new(around, sensor)?,
            motion: PreparedPublisher::new(around, sensor)?,
            early: PreparedPublisher::new(around, sensor)?,
            foreground: PreparedPublisher::new(around, sensor)?,
            background: PreparedPublisher::new(around, sensor)?,
            status: PreparedPublisher::new(around, sensor)?,
            decoded: Box::default(),
            due: DueRings::default(),
            header,
            is_recalled: false,
            last_telegram: LastStamps::default(),
            last_revolution: LastStamps::default(),
            next_seq: 0,
            has_followers: false,
            checked_at: 0,
        })
    }

    /// Sets the [`Flags`] of all further samples.
    pub(crate) fn set_flags(&mut self, flags: u8) {
        self.header.flags = flags;
    }

    /// Sets the family of the scanner. `None`: it is searched for.
    pub(crate) fn set_family(&mut self, family: Option<Family>) {
        self.header.family = family.map_or(Family::UNKNOWN, |family| family as u8);
    }

    /// Sets the wall clock and the [`Flags`] of samples from a recording, until the next call.
    pub(crate) fn recall(&mut self, wall_ns: u64, flags: u8) {
        (self.header.wall_ns, self.header.flags, self.is_recalled) = (wall_ns, flags, true);
    }

    /// Takes loans for a telegram that is about to arrive, if it is as long as the last one, and for the results of
    /// `pipeline`.
    pub(crate) fn prepare(&mut self, pipeline: &Pipeline) {
        self.telegram.prepare();
        self.scan.prepare();
        self.zones.prepare();
        self.marks.prepare();
        self.lines.prepare();
        self.motion.prepare();
        if pipeline.keeps_background() {
            self.foreground.prepare();
        }
        if pipeline.shows_every_scan() {
            self.background.prepare();
        }
    }

    /// Publishes a telegram. Later samples have its number and its stamps, until the next telegram.
    pub(crate) fn telegram(&mut self, received: &Received<'_>, period_us: u32) {
        self.begin_telegram(received, period_us);
        self.telegram.send_bytes(received.bytes, &self.header, &mut self.due);
    }

    /// Does the same as [`telegram`](Self::telegram) for packets. There are many, and few programs subscribe to them,
    /// so the hub checks for subscribers only every 20 ms.
    pub(crate) fn packets(&mut self, received: &Received<'_>) {
        // A packet has no period, only its scan has.
        self.begin_telegram(received, 0);
        if received.last >= self.checked_at + CHECK_INTERVAL {
            self.checked_at = received.last;
            self.has_followers = self.telegram.has_subscribers();
        }
        if self.has_followers {
            self.telegram.send_bytes(received.bytes, &self.header, &mut self.due);
        } else {
            self.telegram.skip();
        }
    }

    fn begin_telegram(&mut self, received: &Received<'_>, period_us: u32) {
        self.header.seq = self.next_seq;
        self.next_seq += 1;
        self.begin(received.first, received.last, received.reasons, period_us);
        let is_moved = self.last_telegram.order(&mut self.header);
        self.header.flags |= if received.estimated || is_moved { Flags::STAMP_ESTIMATED } else { 0 };
    }

    /// Sets the stamps, the period, and the [`Reasons`](schema::Reasons) for a revolution that the last packet completed.
    /// `first` and `last` are the times of its first and last beam.
    pub(crate) fn begin_revolution(&mut self, first: Nanos, last: Nanos, reasons: u8, period_us: u32) {
        self.begin(first, last, reasons, period_us);
        let is_moved = self.last_revolution.order(&mut self.header);
        self.header.flags |= if is_moved { Flags::STAMP_ESTIMATED } else { 0 };
    }

    fn begin(&mut self, first: Nanos, last: Nanos, reasons: u8, period_us: u32) {
        let now = self.around.now();
        (self.header.stamp_first_ns, self.header.stamp_last_ns) = (first, last);
        if !self.is_recalled {
            self.header.wall_ns = wall_clock(self.around, first, now);
        }
        self.header.set_sent_at(now);
        self.header.period_us = period_us;
        let quality = if reasons == 0 { Quality::Clean } else { Quality::Suspect };
        self.header.quality = quality as u8;
        self.header.reasons = reasons;
        self.header.flags &= !Flags::STAMP_ESTIMATED;
    }

    /// Publishes a scan of the last telegram with its zones, and wakes their subscribers. Then publishes the other
    /// results of `pipeline`. Marks, lines, motion and foreground without a subscriber are not computed. Returns a
    /// reason if the background starts again, because it does not fit the scan.
    pub(crate) fn scan(&mut self, raw: &RawScan<'_>, pipeline: &mut Pipeline) -> Option<Relearned> {
        let len = raw.payload_len();
        let (mut scan, mut zones) = (self.scan.loan(len), self.zones.loan(0));
        let decoded = with_room(&mut self.decoded, len);
        raw.write(decoded);
        if let Some(sample) = Publisher::<Scan, S>::payload_mut(&mut scan) {
            sample.copy_from(decoded.bytes());
        }
        pipeline.watch(decoded, Publisher::<Zones, S>::payload_mut(&mut zones));
        self.header.set_sent_at(self.around.now());
        let header = self.header;
        self.scan.send(scan, &header, &mut self.due);
        self.zones.send(zones, &header, &mut self.due);
        self.ring(Ring::First);
        let (mut marks, mut lines) = (self.marks.loan(0), self.lines.loan(0));
        let mut motion = self.motion.loan(0);
        let mut foreground =
            pipeline.keeps_background().then(|| self.foreground.loan(Foreground::len(raw.beams())));
        let relearned = pipeline.examine(
            &self.decoded,
            header.stamp_first_ns,
            raw.period,
            Outputs {
                marks: Publisher::<Marks, S>::payload_mut(&mut marks),
                lines: Publisher::<Lines, S>::payload_mut(&mut lines),
                motion: Publisher::<Motion, S>::payload_mut(&mut motion),
                foreground: foreground.as_mut().and_then(Publisher::<Foreground, S>::payload_mut),
            },
        );
        self.marks.send(marks, &header, &mut self.due);
        self.lines.send(lines, &header, &mut self.due);
        self.motion.send(motion, &header, &mut self.due);
        if let Some(foreground) = foreground {
            self.foreground.send(foreground, &header, &mut self.due);
        }
        if pipeline.shows_every_scan() || pipeline.is_news() {
            self.show(pipeline, &header);
        }
        relearned
    }

    /// Returns the number of the next telegram.
    pub(crate) fn next_seq(&self) -> u64 {
        self.next_seq
    }

    /// Returns whether `early` has a subscriber.
    pub(crate) fn wants_early(&self) -> bool {
        self.early.has_subscribers()
    }

    /// Publishes an early warning and wakes its subscribers. `first` and `last` are the times of the measured part of
    /// the scan. `reasons` are the [`Reasons`](schema::Reasons) so far.
    pub(crate) fn early(
        &mut self,
        message: &EarlyMessage,
        first: Nanos,
        last: Nanos,
        reasons: u8,
        period_us: u32,
    ) {
        let now = self.around.now();
        let quality = if reasons == 0 { Quality::Clean } else { Quality::Suspect };
        let mut header = Header {
            seq: message.seq,
            stamp_first_ns: first,
            stamp_last_ns: last,
            wall_ns: wall_clock(self.around, first, now),
            quality: quality as u8,
            reasons,
            period_us,
            flags: self.header.flags & !Flags::STAMP_ESTIMATED,
            ..self.header
        };
        header.set_sent_at(now);
        let mut loan = self.early.loan(0);
        if let Some(payload) = Publisher::<Early, S>::payload_mut(&mut loan) {
            *payload = message.early;
        }
        self.early.send(loan, &header, &mut self.due);
        if self.due.take(Ring::Early) {
            self.around.ring(Ring::Early);
            self.around.tell(Wake::Early);
        }
    }

    /// Updates `pipeline` from a scan that is not published.
    pub(crate) fn learn(&mut self, raw: &RawScan<'_>, pipeline: &mut Pipeline) {
        let scan = with_room(&mut self.decoded, raw.payload_len());
        raw.write(scan);
        pipeline.watch(scan, None);
        pipeline.examine(scan, raw.first, raw.period, Outputs::default());
    }

    /// Publishes that the zones are unknown as of `now`, because no scans arrive.
    pub(crate) fn stale(&mut self, pipeline: &mut Pipeline, now: u64) {
        let mut loan = self.zones.loan(0);
        pipeline.stale(Publisher::<Zones, S>::payload_mut(&mut loan).unwrap_or(&mut Zones::default()));
        let header = self.header_at(now);
        self.zones.send(loan, &header, &mut self.due);
    }

    /// Publishes the background as of `now` if it is new. Returns whether it was published.
    pub(crate) fn background(&mut self, pipeline: &mut Pipeline, now: u64) -> bool {
        let is_news = pipeline.is_news();
        if is_news {
            self.show(pipeline, &self.header_at(now));
        }
        is_news
    }

    /// Publishes the status as of `now`.
    pub(crate) fn status(&mut self, status: &Status, now: u64) {
        let mut loan = self.status.loan(0);
        if let Some(payload) = Publisher::<Status, S>::payload_mut(&mut loan) {
            *payload = *status;
        }
        let header = self.header_at(now);
        self.status.send(loan, &header, &mut self.due);
    }

    /// Wakes the subscribers that have received samples since they were last woken. Called once per telegram, after its
    /// last sample.
    pub(crate) fn wake(&mut self, why: Wake) {
        Ring::ALL.into_iter().for_each(|ring| self.ring(ring));
        self.around.tell(why);
    }

    /// Wakes the subscribers of the packets that were just published. Subscribers of scans alone are not woken.
    pub(crate) fn wake_for_packets(&mut self) {
        if self.telegram.has_reached() {
            self.wake(Wake::Telegram);
        }
    }

    /// Rings the doorbell `ring` if samples were sent since the last time, to save the system call otherwise.
    fn ring(&mut self, ring: Ring) {
        if self.due.take(ring) {
            self.around.ring(ring);
        }
    }

    /// Gives new subscribers the history that they would otherwise get with the next sample.
    pub(crate) fn greet(&self) {
        self.status.connect();
        self.zones.connect();
        self.background.connect();
    }

    /// Returns whether any topic has a subscriber.
    pub(crate) fn has_subscribers(&self) -> bool {
        let of_telegrams =
            self.telegram.has_subscribers() || self.scan.has_subscribers() || self.zones.has_subscribers();
        let of_wanted = self.marks.has_subscribers()
            || self.foreground.has_subscribers()
            || self.background.has_subscribers();
        let of_moved = self.lines.has_subscribers() || self.motion.has_subscribers();
        of_telegrams || of_wanted || of_moved || self.early.has_subscribers() || self.status.has_subscribers()
    }

    /// Returns the number of samples that were dropped because there was no memory.
    pub(crate) fn loan_failed(&self) -> u64 {
        let of_scans = self.scan.failed() + self.zones.failed() + self.marks.failed() + self.lines.failed();
        let of_moved = self.motion.failed();
        let of_models = self.foreground.failed() + self.background.failed();
        self.telegram.failed() + of_scans + of_moved + of_models + self.early.failed() + self.status.failed()
    }

    /// Returns the number of subscribers that are attached but did not get the last sample, because their descriptors
    /// or those of the hub ran out. (Sending succeeds nevertheless.) The topics of telegrams count only while telegrams
    /// arrive (`streaming`). The background never counts, because it is seldom sent.
    pub(crate) fn unreached(&self, streaming: bool) -> usize {
        if !streaming {
            return self.status.missed_out();
        }
        let of_telegrams =
            self.telegram.missed_out().max(self.scan.missed_out()).max(self.zones.missed_out());
        let of_wanted =
            self.marks.missed_out().max(self.lines.missed_out()).max(self.foreground.missed_out());
        let of_moved = self.motion.missed_out();
        of_telegrams.max(of_wanted).max(of_moved).max(self.status.missed_out())
    }

    /// Returns whether any topic other than `status` has a subscriber. Otherwise the scanner may stop.
    pub(crate) fn is_followed(&self) -> bool {
        let of_scans =
            self.scan.has_subscribers() || self.zones.has_subscribers() || self.marks.has_subscribers();
        of_scans
            || self.lines.has_subscribers()
            || self.motion.has_subscribers()
            || self.early.has_subscribers()
            || self.telegram.has_subscribers()
            || self.foreground.has_subscribers()
            || self.background.has_subscribers()
    }

    /// Returns the header of a sample that is published at `now` without a telegram.
    fn header_at(&self, now: u64) -> Header {
        let wall_ns = if self.is_recalled {
            self.header.wall_ns
        } else {
            wall_clock(self.around, now, self.around.now())
        };
        header_without_telegram(&self.header, now, wall_ns)
    }

    fn show(&mut self, pipeline: &mut Pipeline, header: &Header) {
        let len = pipeline.model_len();
        let mut loan = self.background.loan(len);
        match Publisher::<Background, S>::payload_mut(&mut loan) {
            Some(model) => pipeline.show(model),
            None => pipeline.show(&mut Background::zeroed(len)),
        }
        self.background.send(loan, header, &mut self.due);
    }
}

/// Publisher of one topic, which takes a loan before the sample arrives.
///
/// A topic without a history is not sent while it has no subscriber, and its number is skipped. Sending visits the
/// slots of all possible subscribers, and after a pause none of them is in the processor's cache.
struct PreparedPublisher<P: Payload + ?Sized, M: Medium<P>> {
    topic: TopicPublisher<P, M>,
    /// Subscribers that got the last sample.
    reached: usize,
    /// Loan for the next sample, with the length of the last one.
    prepared: Option<M::Loan>,
    last_len: usize,
}

impl<P: Payload + ?Sized, M: Medium<P>> PreparedPublisher<P, M> {
    /// Opens the topic of `sensor`.
    fn new(around: &impl Surroundings<Medium<P> = M>, sensor: &str) -> Result<Self, Failure> {
        let topic = TopicPublisher::over(around.medium::<P>(sensor)?);
        Ok(PreparedPublisher { topic, reached: 0, prepared: None, last_len: 0 })
    }

    /// Takes a loan for the sample that is about to arrive, and connects new subscribers.
    fn prepare(&mut self) {
        if self.prepared.is_none() && self.is_wanted() {
            self.prepared = self.topic.loan(self.last_len).ok();
        }
        // Connects now instead of while the telegram waits. It also brings the slots into the cache.
        self.connect();
    }

    /// Takes a loan for the next sample. `len` is its size in bytes if the payload has no fixed size.
    fn loan(&mut self, len: usize) -> Loan<M::Loan> {
        if !self.is_wanted() {
            return Loan::Unwanted;
        }
        if self.last_len != len {
            self.last_len = len;
            self.prepared = None;
        }
        self.prepared.take().or_else(|| self.topic.loan(len).ok()).map_or(Loan::Lacking, Loan::Taken)
    }

    /// Returns the payload of `loan`, if there is memory for it.
    fn payload_mut(loan: &mut Loan<M::Loan>) -> Option<&mut P> {
        match loan {
            Loan::Taken(loan) => Some(M::payload_mut(loan)),
            Loan::Lacking | Loan::Unwanted => None,
        }
    }

    /// Sends a sample from [`loan`](Self::loan), and notes in `due` which doorbell has to ring.
    fn send(&mut self, loan: Loan<M::Loan>, header: &Header, due: &mut DueRings) {
        match loan {
            Loan::Taken(loan) => {
                // The topic counts a failure.
                if let Ok(reached) = self.topic.send_loan(loan, header) {
                    self.reached = reached;
                    due.note(P::TOPIC, reached);
                }
            }
            Loan::Lacking => self.topic.fail(),
            Loan::Unwanted => self.skip(),
        }
    }

    /// Skips the number of a sample that is not sent, because the topic has no subscriber.
    fn skip(&mut self) {
        self.topic.skip(1);
        self.reached = 0;
    }

    /// Returns the number of samples that were dropped because there was no memory.
    fn failed(&self) -> u64 {
        self.topic.failed()
    }

    /// Returns whether samples are sent: the topic has a subscriber, or a history for later ones.
    fn is_wanted(&self) -> bool {
        history(P::TOPIC) > 0 || self.has_subscribers()
    }

    /// Returns whether the topic has a subscriber.
    fn has_subscribers(&self) -> bool {
        self.topic.subscribers() > 0
    }

    /// Returns whether a subscriber got the last sample.
    fn has_reached(&self) -> bool {
        self.reached > 0
    }

    /// Returns the number of attached subscribers that did not get the last sample.
    fn missed_out(&self) -> usize {
        let has_begun = self.topic.next_number() > 0;
        if has_begun { self.topic.subscribers().saturating_sub(self.reached) } else { 0 }
    }

    /// Connects new subscribers, and gives them the history of the topic.
    fn connect(&self) {
        if let Err(error) = self.topic.connect() {
            tracing::debug!(?error, "a subscriber could not be connected");
        }
    }
}

impl<M: Medium<[u8]>> PreparedPublisher<[u8], M> {
    /// Publishes `bytes` if the topic has a subscriber.
    fn send_bytes(&mut self, bytes: &[u8], header: &Header, due: &mut DueRings) {
        let mut loan = self.loan(bytes.len());
        if let Some(payload) = Self::payload_mut(&mut loan) {
            payload.copy_from_slice(bytes);
        }
        self.send(loan, header, due);
    }
}

/// Loan of a sample.
enum Loan<L> {
    /// Memory that the sample is written into.
    Taken(L),
    /// There is no memory for the sample.
    Lacking,
    /// The topic has no subscriber.
    Unwanted,
}

/// The stamps of the last telegram or revolution. On a busy machine, several telegrams may be read at once, so that their
/// computed stamps are equal, but a stamp identifies a scan in ROS.
#[derive(Default)]
struct LastStamps {
    first_ns: u64,
    wall_ns: u64,
}

impl LastStamps {
    /// Moves the stamps of `header` if they are not later than the last ones: to the last one plus 1 ns. Stamps of a
    /// replay are not changed. Returns whether a stamp was moved.
    fn order(&mut self, header: &mut Header) -> bool {
        if header.flags & Flags::REPLAYED != 0 {
            return false;
        }
        let (first_ns, wall_ns) = (header.stamp_first_ns, header.wall_ns);
        header.stamp_first_ns = later(first_ns, self.first_ns);
        header.stamp_last_ns = header.stamp_last_ns.max(header.stamp_first_ns);
        header.wall_ns = later(wall_ns, self.wall_ns);
        (self.first_ns, self.wall_ns) = (header.stamp_first_ns, header.wall_ns);
        (self.first_ns, self.wall_ns) != (first_ns, wall_ns)
    }
}

/// Returns `stamp`, or `last` plus 1 ns if that is later. A clock that was set back by more than [`MAX_REVERSAL`] is
/// accepted.
fn later(stamp: u64, last: u64) -> u64 {
    if last.saturating_sub(stamp) > MAX_REVERSAL { stamp } else { stamp.max(last + 1) }
}

/// Largest time by which a stamp may be earlier than the last one and still count as its successor.
const MAX_REVERSAL: Nanos = 100 * MILLIS;

/// Converts `stamp` to nanoseconds since 1970. `now` is the current time of the clock of `around`.
fn wall_clock(around: &impl Surroundings, stamp: Nanos, now: Nanos) -> u64 {
    around.wall_ns().saturating_sub(now.saturating_sub(stamp))
}

/// Returns the header of a sample that is published at `now` without a telegram. It has the number of the last
/// telegram.
fn header_without_telegram(last: &Header, now: u64, wall_ns: u64) -> Header {
    Header {
        stamp_first_ns: now,
        stamp_last_ns: now,
        wall_ns,
        quality: Quality::Clean as u8,
        reasons: 0,
        flags: last.flags & !Flags::STAMP_ESTIMATED,
        hub_time: [0; 3],
        ..*last
    }
}

/// Returns `scan` with room for `len` bytes. It is reallocated once if it is too short.
fn with_room(scan: &mut Box<Scan>, len: usize) -> &mut Scan {
    Scan::grow(scan, len);
    scan
}

/// Interval between checks for subscribers of packets. A new subscriber gets its first packet after this time at the
/// latest.
const CHECK_INTERVAL: Nanos = 20 * MILLIS;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stamps_ascend_unless_the_clock_was_set() {
        let mut last = LastStamps::default();
        let mut order = |first: u64, wall: u64| {
            let mut header =
                Header { stamp_first_ns: first, stamp_last_ns: first, wall_ns: wall, ..Header::default() };
            let is_moved = last.order(&mut header);
            (header.stamp_first_ns, header.stamp_last_ns, header.wall_ns, is_moved)
        };
        let wall = 1_000 * MILLIS;
        assert_eq!(order(50, wall), (50, 50, wall, false));
        assert_eq!(order(50, wall), (51, 51, wall + 1, true));
        assert_eq!(order(50, wall), (52, 52, wall + 2, true), "a burst of three");
        assert_eq!(
            order(90, wall - 5),
            (90, 90, wall + 3, true),
            "the two clocks were read at different times"
        );
        assert_eq!(order(91, wall + 40), (91, 91, wall + 40, false));
        let set_back = wall - MAX_REVERSAL;
        assert_eq!(order(92, set_back), (92, 92, set_back, false), "the wall clock was set");
    }

    #[test]
    fn a_sample_without_a_telegram_does_not_inherit_its_doubts() {
        let flags = Flags::SIMULATED | Flags::STAMP_ESTIMATED;
        let last = Header {
            seq: 7,
            period_us: 26_640,
            quality: 1,
            reasons: 4,
            flags,
            hub_time: [9; 3],
            ..Header::default()
        };
        let header = header_without_telegram(&last, 5, 6);
        assert_eq!((header.quality, header.reasons, header.flags), (0, 0, Flags::SIMULATED));
        assert_eq!(header.hub_time_ns(), None);
        assert_eq!(
            (header.seq, header.period_us, header.stamp_first_ns, header.stamp_last_ns, header.wall_ns),
            (7, 26_640, 5, 5, 6)
        );
    }
}
