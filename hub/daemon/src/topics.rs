//! The topics of one link: numbers every sample, fills it in place, sends it, wakes the consumers. A sample for which
//! there is no memory is counted and its number used up, so that consumers see the gap; nothing ever waits for one.

mod moment;
mod prepared_publisher;

use scanhub_drivers::line::{RawScan, Received};
use schema::ipc::DueRings;
use schema::{
    Background, Early, Failure, Family, Flags, Foreground, Header, Lines, MILLIS, Marks, Motion, Nanos,
    Quality, Ring, Scan, Status, Wake, Zones,
};

use crate::early::Word;
use crate::pipeline::{Outputs, Pipeline, Relearned};
use crate::surroundings::Surroundings;
use moment::{of_moment, wall};
use prepared_publisher::PreparedPublisher;

/// A topic in the surroundings of a link.
type Publisher<P, S> = PreparedPublisher<P, <S as Surroundings>::Medium<P>>;

/// The publishing end of one sensor; stays in its link's thread.
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
    /// The last scan, which is read while others have its sample already.
    decoded: Box<Scan>,
    /// What was sent and not rung for.
    due: DueRings,
    /// What the next sample's header begins with.
    header: Header,
    /// Its wall clock is that of a recording.
    is_recalled: bool,
    next_seq: u64,
    /// Whether anybody follows packets, and when that was asked.
    has_followers: bool,
    asked_at: Nanos,
}

impl<'a, S: Surroundings> Topics<'a, S> {
    /// Makes the topics of `sensor`, number `number` in the configuration, for the hub's life `boot`.
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
            next_seq: 0,
            has_followers: false,
            asked_at: 0,
        })
    }

    /// What all samples from now on have in common: bits of [`Flags`].
    pub(crate) fn set_flags(&mut self, flags: u8) {
        self.header.flags = flags;
    }

    /// Sets the family of the scanner. `None`: it is searched for.
    pub(crate) fn set_family(&mut self, family: Option<Family>) {
        self.header.family = family.map_or(Family::UNKNOWN, |family| family as u8);
    }

    /// What is published from now on, until the next call, was recorded at `wall_ns`, and has these [`Flags`].
    pub(crate) fn recall(&mut self, wall_ns: u64, flags: u8) {
        (self.header.wall_ns, self.header.flags, self.is_recalled) = (wall_ns, flags, true);
    }

    /// Takes loans for a telegram as long as the last one and for what `pipeline` makes of its scan, which will be there
    /// in a moment.
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

    /// Publishes the telegram and takes its number and stamps for all that follows from it.
    pub(crate) fn telegram(&mut self, received: &Received<'_>, period_us: u32) {
        self.begin_telegram(received, period_us);
        self.telegram.send_bytes(received.bytes, &self.header, &mut self.due);
    }

    /// As [`telegram`](Self::telegram), of packets, of which there are many and which most do not follow: whether anybody does is
    /// asked now and then.
    pub(crate) fn packets(&mut self, received: &Received<'_>) {
        // The period belongs to the scan.
        self.begin_telegram(received, 0);
        if received.last >= self.asked_at + UNASKED {
            self.asked_at = received.last;
            self.has_followers = self.telegram.is_heard();
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
        self.begin_scan(received.first, received.last, received.reasons, period_us);
        self.header.flags |= if received.estimated { Flags::STAMP_ESTIMATED } else { 0 };
    }

    /// Takes over when a scan that the last telegram completed was measured, from its first beam to its last, and why it is
    /// suspect, for all that follows from it.
    pub(crate) fn begin_scan(&mut self, first: Nanos, last: Nanos, reasons: u8, period_us: u32) {
        let now = self.around.now();
        (self.header.stamp_first_ns, self.header.stamp_last_ns) = (first, last);
        if !self.is_recalled {
            self.header.wall_ns = wall(self.around, first, now);
        }
        self.header.set_sent_at(now);
        self.header.period_us = period_us;
        let quality = if reasons == 0 { Quality::Clean } else { Quality::Suspect };
        self.header.quality = quality as u8;
        self.header.reasons = reasons;
        self.header.flags &= !Flags::STAMP_ESTIMATED;
    }

    /// Publishes a scan of the last telegram and its zones, and wakes
    /// those who wait for these; then whatever else `pipeline` makes of it. Marks, lines, motion and foreground that nobody wants are
    /// not made. A background that does not fit the scan starts again; then it is told why.
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

    /// The number of the next telegram.
    pub(crate) fn next_seq(&self) -> u64 {
        self.next_seq
    }

    /// Whether anybody wants to be warned before a scan is complete.
    pub(crate) fn wants_early(&self) -> bool {
        self.early.is_heard()
    }

    /// Publishes `word`, which a part of a scan from `first` to `last` tells, and wakes those who wait for that alone. `reasons`
    /// are why it is suspect already.
    pub(crate) fn early(&mut self, word: &Word, first: Nanos, last: Nanos, reasons: u8, period_us: u32) {
        let now = self.around.now();
        let quality = if reasons == 0 { Quality::Clean } else { Quality::Suspect };
        let mut header = Header {
            seq: word.seq,
            stamp_first_ns: first,
            stamp_last_ns: last,
            wall_ns: wall(self.around, first, now),
            quality: quality as u8,
            reasons,
            period_us,
            flags: self.header.flags & !Flags::STAMP_ESTIMATED,
            ..self.header
        };
        header.set_sent_at(now);
        let mut loan = self.early.loan(0);
        if let Some(payload) = Publisher::<Early, S>::payload_mut(&mut loan) {
            *payload = word.early;
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
        pipeline.examine(scan, Outputs::default());
    }

    /// Publishes that nothing is known of the zones as of `now`, for scans stay out.
    pub(crate) fn stale(&mut self, pipeline: &mut Pipeline, now: u64) {
        let mut loan = self.zones.loan(0);
        pipeline.stale(Publisher::<Zones, S>::payload_mut(&mut loan).unwrap_or(&mut Zones::default()));
        let header = self.of_moment(now);
        self.zones.send(loan, &header, &mut self.due);
    }

    /// Publishes the background as of `now`, if it is one that was not published; whether it was.
    pub(crate) fn background(&mut self, pipeline: &mut Pipeline, now: u64) -> bool {
        let is_news = pipeline.is_news();
        if is_news {
            self.show(pipeline, &self.of_moment(now));
        }
        is_news
    }

    /// Publishes the status as of `now`.
    pub(crate) fn status(&mut self, status: &Status, now: u64) {
        let mut loan = self.status.loan(0);
        if let Some(payload) = Publisher::<Status, S>::payload_mut(&mut loan) {
            *payload = *status;
        }
        let header = self.of_moment(now);
        self.status.send(loan, &header, &mut self.due);
    }

    /// Wakes whoever sleeps and was not woken since a sample came for him; once per telegram, after its last sample.
    pub(crate) fn wake(&mut self, why: Wake) {
        Ring::ALL.into_iter().for_each(|ring| self.ring(ring));
        self.around.tell(why);
    }

    /// Wakes whoever got the packets that were published just now: who follows scans alone sleeps on.
    pub(crate) fn wake_for_packets(&mut self) {
        if self.telegram.has_reached() {
            self.wake(Wake::Telegram);
        }
    }

    /// Wakes who sleeps at the bell, if that is due: a call of the system that nobody needs is not made.
    fn ring(&mut self, ring: Ring) {
        if self.due.take(ring) {
            self.around.ring(ring);
        }
    }

    /// Gives late joiners what they would else get with the next sample.
    pub(crate) fn greet(&self) {
        self.status.connect();
        self.zones.connect();
        self.background.connect();
    }

    /// Whether anybody is attached to anything.
    pub(crate) fn is_heard(&self) -> bool {
        let of_telegrams = self.telegram.is_heard() || self.scan.is_heard() || self.zones.is_heard();
        let of_wanted = self.marks.is_heard() || self.foreground.is_heard() || self.background.is_heard();
        let of_moved = self.lines.is_heard() || self.motion.is_heard();
        of_telegrams || of_wanted || of_moved || self.early.is_heard() || self.status.is_heard()
    }

    /// Samples without memory.
    pub(crate) fn loan_failed(&self) -> u64 {
        let of_scans = self.scan.failed() + self.zones.failed() + self.marks.failed() + self.lines.failed();
        let of_moved = self.motion.failed();
        let of_models = self.foreground.failed() + self.background.failed();
        self.telegram.failed() + of_scans + of_moved + of_models + self.early.failed() + self.status.failed()
    }

    /// Consumers that got nothing although they are attached: their descriptors or ours ran out, and sending says Ok
    /// all the same. Of a topic nothing is known while nothing is sent: of those of telegrams unless they come
    /// (`streaming`), of the background ever.
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

    /// Whether anybody follows what the sensor measures: of the status alone nobody needs a scanner that measures.
    pub(crate) fn is_followed(&self) -> bool {
        let of_scans = self.scan.is_heard() || self.zones.is_heard() || self.marks.is_heard();
        of_scans
            || self.lines.is_heard()
            || self.motion.is_heard()
            || self.early.is_heard()
            || self.telegram.is_heard()
            || self.foreground.is_heard()
            || self.background.is_heard()
    }

    fn of_moment(&self, now: u64) -> Header {
        let wall_ns =
            if self.is_recalled { self.header.wall_ns } else { wall(self.around, now, self.around.now()) };
        of_moment(&self.header, now, wall_ns)
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

/// Memory for a scan of `len` bytes, which is made longer once where it is too short.
fn with_room(scan: &mut Box<Scan>, len: usize) -> &mut Scan {
    Scan::grow(scan, len);
    scan
}

/// Whoever begins to follow packets gets them after so long.
const UNASKED: Nanos = 20 * MILLIS;
