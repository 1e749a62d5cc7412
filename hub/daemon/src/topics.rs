//! The topics of one link: numbers the samples, sets their headers, and wakes the subscribers. Nothing waits for
//! memory. If there is no memory for a sample, the sample is counted as dropped and its sequence number is skipped, so
//! that subscribers notice the gap.
//!
//! [`Publishers`] has one publisher for each topic of a link, from the table of topics. `link_output.rs` fills and
//! sends the samples of a scan.

use scanhub_drivers::line::ReceivedTelegram;
use scanhub_schema::limits::history_len;
use scanhub_schema::{
    Background, DoorbellWord, Failure, Family, Flags, Header, MILLIS, Nanos, PublishRate, Quality, Status,
    Topic, WakeEvent, Zones,
};
use scanhub_shm::PendingWakeups;

use crate::early::EarlyMessage;
use crate::platform::Platform;
use crate::publisher::PreparedPublisher;

macro_rules! publishers {
    ($($topic:ident $payload:tt, $name:ident, $($column:tt),*: $about:literal;)*) => {
        /// Publishers of all topics of a link.
        pub(crate) struct Publishers<S: Platform> {
            $(
                #[doc = $about]
                pub(crate) $name: Publisher<scanhub_schema::payload_type!($payload), S>,
            )*
        }

        impl<S: Platform> Publishers<S> {
            fn new(platform: &S, sensor: &str) -> Result<Self, Failure> {
                Ok(Publishers { $($name: PreparedPublisher::new(platform, sensor)?,)* })
            }

            /// Checks which topics have subscribers, and connects new ones.
            fn look(&mut self) {
                $(self.$name.find_subscribers();)*
            }

            /// Gives new subscribers the history of the topics that have a history.
            fn deliver_history(&self) {
                $(if history_len(Topic::$topic) > 0 {
                    self.$name.connect();
                })*
            }

            /// Returns whether any topic for which `counts` returns true had a subscriber at the last check.
            fn has_subscribers(&self, counts: impl Fn(Topic) -> bool) -> bool {
                $(counts(Topic::$topic) && self.$name.has_subscribers())||*
            }

            /// Returns the number of samples that were dropped because there was no memory.
            fn failed(&self) -> u64 {
                0 $(+ self.$name.failed())*
            }

            /// Returns the highest number of attached subscribers that did not get the last sample of a topic, among
            /// the topics for which `counts` returns true.
            fn undelivered(&self, counts: impl Fn(Topic) -> bool) -> usize {
                0usize$(.max(if counts(Topic::$topic) { self.$name.undelivered() } else { 0 }))*
            }
        }
    };
}

scanhub_schema::for_each_topic!(links: publishers);

impl<S: Platform> Publishers<S> {
    /// Prepares the topics that are published with every scan, up to stage `last`.
    fn prepare(&mut self, last: Stage) {
        self.telegram.prepare();
        self.scan.prepare();
        self.zones.prepare();
        if last >= Stage::Results {
            self.marks.prepare();
            self.lines.prepare();
            self.motion.prepare();
            self.foreground.prepare();
        }
    }

    /// Returns the last stage up to the zones whose topics had a subscriber at the last check; `Telegram` if none had
    /// one. The doorbell [`DoorbellWord::First`] rings after this stage.
    fn first_awaited(&self) -> Stage {
        if self.zones.has_subscribers() {
            Stage::Zones
        } else if self.scan.has_subscribers() {
            Stage::Scan
        } else {
            Stage::Telegram
        }
    }

    /// Returns the last stage whose topics had a subscriber at the last check; `Scan` if none had one.
    fn last_awaited(&self) -> Stage {
        if self.foreground.has_subscribers() || self.background.has_subscribers() {
            Stage::Background
        } else if self.marks.has_subscribers()
            || self.lines.has_subscribers()
            || self.motion.has_subscribers()
        {
            Stage::Results
        } else {
            self.first_awaited().max(Stage::Scan)
        }
    }
}

/// Stages of a scan's publication, in their order.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Stage {
    Telegram,
    Scan,
    Zones,
    /// Marks, lines and motion.
    Results,
    /// Foreground and background.
    Background,
}

/// Publisher of one topic.
type Publisher<P, S> = PreparedPublisher<P, <S as Platform>::Transport<P>>;

/// The topics of one sensor. They belong to the thread of its link.
pub(crate) struct Topics<'a, S: Platform> {
    platform: &'a S,
    pub(crate) publishers: Publishers<S>,
    /// Doorbells that have to ring for samples that were sent.
    pub(crate) due: PendingWakeups,
    /// Template for the header of the next sample.
    header: Header,
    /// Whether `header.wall_ns` comes from a recording.
    is_recorded: bool,
    last_telegram: LastStamps,
    last_revolution: LastStamps,
    next_seq: u64,
    /// [`Platform::attach_count`] at the last check for subscribers.
    attach_count: Option<u32>,
    /// Whether the event of the link had a listener at the last check.
    has_listeners: bool,
    /// Stage after which [`DoorbellWord::First`] rings, as of the last check.
    first_awaited: Stage,
    /// Stage after which all doorbells ring and the event is sent, as of the last check.
    last_awaited: Stage,
}

impl<'a, S: Platform> Topics<'a, S> {
    /// Creates the topics of `sensor`, which is number `number` in the configuration. `boot` identifies the run of the
    /// hub.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::ResourceExhausted`](scanhub_schema::Kind::ResourceExhausted) if no memory or descriptors are
    /// left.
    pub(crate) fn new(platform: &'a S, sensor: &str, number: u8, boot: u64) -> Result<Self, Failure> {
        let header = Header { sensor: number, boot, hub_pid: std::process::id(), ..Header::default() };
        Ok(Topics {
            platform,
            publishers: Publishers::new(platform, sensor)?,
            due: PendingWakeups::default(),
            header,
            is_recorded: false,
            last_telegram: LastStamps::default(),
            last_revolution: LastStamps::default(),
            next_seq: 0,
            attach_count: None,
            has_listeners: false,
            first_awaited: Stage::Telegram,
            last_awaited: Stage::Scan,
        })
    }

    /// Sets the [`Flags`] of all further samples.
    pub(crate) fn set_flags(&mut self, flags: u8) {
        self.header.flags = flags;
    }

    /// Sets the family of the scanner. `None` means that the hub is searching for the scanner.
    pub(crate) fn set_family(&mut self, family: Option<Family>) {
        self.header.family = family.map_or(Family::UNKNOWN, |family| family as u8);
    }

    /// Sets the wall clock and the [`Flags`] of samples from a recording, until the next call.
    pub(crate) fn set_recorded_time(&mut self, wall_ns: u64, flags: u8) {
        (self.header.wall_ns, self.header.flags, self.is_recorded) = (wall_ns, flags, true);
    }

    /// Searches for subscribers if any may have attached since the last check. Called when a header is created, before
    /// its samples are loaned and sent, so that a new subscriber gets the next sample. Without a new subscriber, this
    /// function reads only one word of memory for all topics.
    fn find_new_subscribers(&mut self) {
        let attached = self.platform.attach_count();
        if attached.is_none() || attached != self.attach_count {
            self.attach_count = attached;
            self.find_subscribers();
        }
    }

    /// Searches for the subscribers of all topics and the listeners of the event. Only this function finds subscribers
    /// that another library than this project's has attached.
    #[cold]
    pub(crate) fn find_subscribers(&mut self) {
        self.publishers.look();
        self.has_listeners = self.platform.has_listeners();
        self.first_awaited = self.publishers.first_awaited();
        self.last_awaited = self.publishers.last_awaited();
    }

    /// Takes loans for a telegram that is about to arrive and for the results of its scan. The loan for the telegram
    /// can be used only if the telegram is as long as the last one. Connects new subscribers now instead of while the
    /// telegram waits.
    pub(crate) fn prepare(&mut self) {
        self.find_new_subscribers();
        self.publishers.prepare(self.last_awaited);
    }

    /// Returns whether a topic of `stage` or of a later one had a subscriber at the last check.
    pub(crate) fn is_awaited(&self, stage: Stage) -> bool {
        self.last_awaited >= stage
    }

    /// Wakes the subscribers whose samples were all sent when `stage` ends.
    pub(crate) fn end_stage(&mut self, stage: Stage) {
        if stage == self.last_awaited {
            self.wake(WakeEvent::Telegram);
        } else if stage == self.first_awaited {
            self.ring(DoorbellWord::First);
        }
    }

    /// Publishes a telegram, or packets, for which `period_us` is 0. Later samples have the sequence number and the
    /// stamps of this telegram, until the next one is published.
    pub(crate) fn publish_telegram(&mut self, received: &ReceivedTelegram<'_>, period_us: u32) {
        self.begin_telegram(received, period_us);
        self.publishers.telegram.send_bytes(received.bytes, &self.header, &mut self.due);
    }

    fn begin_telegram(&mut self, received: &ReceivedTelegram<'_>, period_us: u32) {
        self.header.seq = self.next_seq;
        self.next_seq += 1;
        self.begin(received.first, received.last, received.reasons, period_us);
        let is_moved = self.last_telegram.make_increasing(&mut self.header);
        self.header.flags |= if received.estimated || is_moved { Flags::STAMP_ESTIMATED } else { 0 };
    }

    /// Sets the stamps, the period, and the [`Reasons`](scanhub_schema::Reasons) for a revolution that the last packet
    /// completed. `first` and `last` are the times of its first and last beam.
    pub(crate) fn begin_revolution(&mut self, first: Nanos, last: Nanos, reasons: u8, period_us: u32) {
        self.begin(first, last, reasons, period_us);
        let is_moved = self.last_revolution.make_increasing(&mut self.header);
        self.header.flags |= if is_moved { Flags::STAMP_ESTIMATED } else { 0 };
    }

    fn begin(&mut self, first: Nanos, last: Nanos, reasons: u8, period_us: u32) {
        self.find_new_subscribers();
        let now = self.platform.now();
        (self.header.stamp_first_ns, self.header.stamp_last_ns) = (first, last);
        if !self.is_recorded {
            self.header.wall_ns = wall_clock(self.platform, first, now);
        }
        self.header.set_sent_at(now);
        self.header.period_us = period_us;
        let quality = if reasons == 0 { Quality::Clean } else { Quality::Suspect };
        self.header.quality = quality as u8;
        self.header.reasons = reasons;
        self.header.flags &= !Flags::STAMP_ESTIMATED;
    }

    /// Returns the header for the samples of the last telegram or revolution, which are sent now.
    pub(crate) fn header(&mut self) -> Header {
        self.header.set_sent_at(self.platform.now());
        self.header
    }

    /// Returns the sequence number of the next telegram.
    pub(crate) fn next_seq(&self) -> u64 {
        self.next_seq
    }

    /// Publishes an early warning and wakes its subscribers. `first` and `last` are the times of the measured part of
    /// the scan. `reasons` are the [`Reasons`](scanhub_schema::Reasons) so far.
    pub(crate) fn publish_early(
        &mut self,
        message: &EarlyMessage,
        first: Nanos,
        last: Nanos,
        reasons: u8,
        period_us: u32,
    ) {
        let now = self.platform.now();
        let quality = if reasons == 0 { Quality::Clean } else { Quality::Suspect };
        let mut header = Header {
            seq: message.seq,
            stamp_first_ns: first,
            stamp_last_ns: last,
            wall_ns: wall_clock(self.platform, first, now),
            quality: quality as u8,
            reasons,
            period_us,
            ..self.header_at(now)
        };
        header.set_sent_at(now);
        let mut early = self.publishers.early.loan(0);
        if let Some(payload) = early.payload_mut() {
            *payload = message.early;
        }
        self.publishers.early.send(early, &header, &mut self.due);
        if self.due.take_due(DoorbellWord::Early) {
            self.platform.ring(DoorbellWord::Early);
            self.notify_event(WakeEvent::Early);
        }
    }

    /// Sends zones as of `now`, without a scan. `write` fills in the zones, and is called even if there is no memory
    /// for the sample.
    pub(crate) fn send_zones(&mut self, now: u64, write: impl FnOnce(&mut Zones)) {
        let header = self.header_at(now);
        let mut zones = self.publishers.zones.loan(0);
        write(zones.payload_mut().unwrap_or(&mut Zones::default()));
        self.publishers.zones.send(zones, &header, &mut self.due);
    }

    /// Sends a background of `len` bytes. `write` fills in the background, and is called even if there is no memory for
    /// the sample.
    pub(crate) fn send_background(
        &mut self,
        header: &Header,
        len: usize,
        write: impl FnOnce(&mut Background),
    ) {
        let mut background = self.publishers.background.loan(len);
        match background.payload_mut() {
            Some(payload) => write(payload),
            None => write(&mut Background::zeroed(len)),
        }
        self.publishers.background.send(background, header, &mut self.due);
    }

    /// Publishes the status as of `now`.
    pub(crate) fn publish_status(&mut self, status: &Status, now: u64) {
        let header = self.header_at(now);
        let mut sample = self.publishers.status.loan(0);
        if let Some(payload) = sample.payload_mut() {
            *payload = *status;
        }
        self.publishers.status.send(sample, &header, &mut self.due);
    }

    /// Wakes the subscribers that have received samples since they were last woken. Called once per telegram, after its
    /// last sample.
    pub(crate) fn wake(&mut self, event: WakeEvent) {
        for ring in DoorbellWord::ALL {
            self.ring(ring);
        }
        self.notify_event(event);
    }

    fn notify_event(&self, event: WakeEvent) {
        // A listener may have attached since the last check, with a subscriber that the last sample reached.
        if self.has_listeners || self.platform.attach_count() != self.attach_count {
            self.platform.notify_event(event);
        }
    }

    /// Wakes the subscribers of the packets that were just published. Subscribers of scans alone are not woken.
    pub(crate) fn wake_for_packets(&mut self) {
        if self.publishers.telegram.has_reached() {
            self.wake(WakeEvent::Telegram);
        }
    }

    /// Rings the doorbell at `word` if samples for it were sent since it last rang. Otherwise, makes no system call.
    pub(crate) fn ring(&mut self, word: DoorbellWord) {
        if self.due.take_due(word) {
            self.platform.ring(word);
        }
    }

    /// Returns whether a sample was sent whose doorbell has not rung yet.
    pub(crate) fn is_ring_due(&self) -> bool {
        self.due != PendingWakeups::default()
    }

    /// Searches for subscribers, and gives new ones the history that they would otherwise get with the next sample.
    #[cold]
    pub(crate) fn deliver_history(&mut self) {
        self.find_subscribers();
        self.publishers.deliver_history();
    }

    /// Searches for subscribers, and returns whether any topic has one.
    pub(crate) fn has_subscribers(&mut self) -> bool {
        self.find_subscribers();
        self.publishers.has_subscribers(|_| true)
    }

    /// Searches for subscribers, and returns whether any topic other than `status` has one. Otherwise, the scanner may
    /// stop.
    pub(crate) fn has_data_subscribers(&mut self) -> bool {
        self.find_subscribers();
        self.publishers.has_subscribers(|topic| topic != Topic::Status)
    }

    /// Returns whether `early` had a subscriber at the last check.
    pub(crate) fn has_early_subscribers(&self) -> bool {
        self.publishers.early.has_subscribers()
    }

    /// Returns the number of samples that were dropped because there was no memory.
    pub(crate) fn loan_failed(&self) -> u64 {
        self.publishers.failed()
    }

    /// Returns the number of subscribers that were attached at the last check but did not get the last sample, because
    /// their descriptors or those of the hub ran out. (Sending succeeds nevertheless.) The topics of scans count only
    /// while scans arrive (`streaming`). Topics that are published only after a change never count: they are seldom
    /// published, so their last sample may be older than the subscriber.
    pub(crate) fn starved_subscribers(&self, streaming: bool) -> usize {
        self.publishers.undelivered(|topic| match topic.spec().publish_rate {
            PublishRate::Scan => streaming,
            PublishRate::Second => true,
            PublishRate::Change => false,
        })
    }

    /// Returns the header of a sample that is published at `now` without a telegram. Called before its loan is taken,
    /// because it searches for new subscribers.
    pub(crate) fn header_at(&mut self, now: u64) -> Header {
        self.find_new_subscribers();
        let wall_ns = if self.is_recorded {
            self.header.wall_ns
        } else {
            wall_clock(self.platform, now, self.platform.now())
        };
        header_without_telegram(&self.header, now, wall_ns)
    }
}

/// The stamps of the last telegram or revolution. On a busy machine, several telegrams may be read at once, so that
/// their computed stamps are equal. They must differ, because in ROS a stamp identifies a scan.
#[derive(Default)]
struct LastStamps {
    first_ns: u64,
    wall_ns: u64,
}

impl LastStamps {
    /// Moves each stamp of `header` that is not later than the last one, to the last one plus 1 ns. Stamps of a replay
    /// are not changed. Returns whether a stamp was moved.
    fn make_increasing(&mut self, header: &mut Header) -> bool {
        if header.flags & Flags::REPLAYED != 0 {
            return false;
        }
        let (first_ns, wall_ns) = (header.stamp_first_ns, header.wall_ns);
        header.stamp_first_ns = make_later(first_ns, self.first_ns);
        header.stamp_last_ns = header.stamp_last_ns.max(header.stamp_first_ns);
        header.wall_ns = make_later(wall_ns, self.wall_ns);
        (self.first_ns, self.wall_ns) = (header.stamp_first_ns, header.wall_ns);
        (self.first_ns, self.wall_ns) != (first_ns, wall_ns)
    }
}

/// Returns `stamp`, or `last` plus 1 ns if that is later. A clock that was set back by more than [`MAX_REVERSAL`] is
/// accepted.
fn make_later(stamp: u64, last: u64) -> u64 {
    if last.saturating_sub(stamp) > MAX_REVERSAL { stamp } else { stamp.max(last + 1) }
}

/// Largest time by which a stamp may be earlier than the last one and still count as its successor.
const MAX_REVERSAL: Nanos = 100 * MILLIS;

/// Converts `stamp` to nanoseconds since 1970. `now` is the current time of the clock of `platform`.
fn wall_clock(platform: &impl Platform, stamp: Nanos, now: Nanos) -> u64 {
    platform.wall_ns().saturating_sub(now.saturating_sub(stamp))
}

/// Returns the header of a sample that is published at `now` without a telegram. The header has the sequence number of
/// the last telegram.
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stamps_ascend_unless_the_clock_was_set() {
        let mut last = LastStamps::default();
        let mut order = |first: u64, wall: u64| {
            let mut header =
                Header { stamp_first_ns: first, stamp_last_ns: first, wall_ns: wall, ..Header::default() };
            let is_moved = last.make_increasing(&mut header);
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
    fn sample_without_telegram_does_not_inherit_quality() {
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
