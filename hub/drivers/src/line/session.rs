//! The session with one scanner as its driver sees it: bytes and the time go in; bytes to send, events and the next
//! deadline come out. A session never waits, reads or writes itself.

use core::fmt;

use crate::line::RawScan;
use crate::line::family::Model;
use scanhub_schema::{Counter, Counters, Nanos, Status};

/// A protocol state machine on an open port. After every call that changes it, drain [`Protocol::poll_action`] until it
/// returns [`Action::Wait`] or [`Action::SleepUntil`].
pub trait Protocol {
    /// Returns the buffer of the next read. It is never empty after the outputs were drained.
    fn read_buffer(&mut self) -> &mut [u8];

    /// Handles a read that returned at `now` with `len` bytes in [`Protocol::read_buffer`].
    fn commit(&mut self, now: Nanos, len: usize);

    /// Handles a deadline that has passed without a byte.
    fn handle_timeout(&mut self, now: Nanos);

    /// Handles that the bytes of [`Action::Transmit`] were written at `now`.
    fn handle_transmitted(&mut self, now: Nanos);

    /// Returns the next action that the protocol requests.
    fn poll_action(&mut self) -> Action<'_>;

    /// Call it at `now`, immediately before the bytes of [`Action::Transmit`] are written. Returns whether it is too
    /// late for them, as on a machine that did not run the program for a few milliseconds. Then do not write them, and
    /// continue draining: the request starts over.
    fn restart_if_late(&mut self, now: Nanos) -> bool {
        let _ = now;
        false
    }

    /// Handles at `now` that the port cannot have the rate of the last [`Action::SetRate`], or, before the first
    /// output, the rate at which it should be open. A protocol that can try other rates leaves this one out.
    fn reject_rate(&mut self, now: Nanos) {
        let _ = now;
    }

    /// Returns whether it has come to its end. A session never does.
    fn is_done(&self) -> bool {
        false
    }
}

/// A session with a scanner that lasts as long as the line is open.
///
/// The methods with a body are for what only some families have.
pub trait ScannerSession: Protocol {
    /// Reason why a session does not stream as it should, as text when displayed.
    type Problem: Copy + PartialEq + fmt::Display;

    /// Handles a request of a user. A repeated request changes nothing, but each [`Control::Resync`] counts. A
    /// recording cannot be controlled.
    fn control(&mut self, control: Control, now: Nanos);

    /// Returns the state.
    fn state(&self) -> State;

    /// Returns why the session does not stream as it should.
    fn problem(&self) -> Option<Self::Problem>;

    /// Returns the name of the transmissions that the session misses, such as `LMS replies`, while its
    /// [`problem`](Self::problem) is that none of them arrive. Other bytes may arrive meanwhile.
    fn missing_transmission(&self) -> Option<&'static str>;

    /// Returns the rate at which the session receives and sends, in bits per second.
    fn rate(&self) -> u32;

    /// Returns the counters.
    fn stats(&self) -> SessionStats;

    /// Returns whether [`defer_read`](Self::defer_read) may postpone the next read, so that counting the waiting bytes
    /// pays off.
    fn can_defer_read(&self) -> bool {
        false
    }

    /// Handles that the line has `waiting` unread bytes at `now`. Returns whether they may stay there for a while: if
    /// the host is killed, unread bytes are not lost.
    fn defer_read(&mut self, now: Nanos, waiting: usize) -> bool {
        let _ = (now, waiting);
        false
    }

    /// Stores at `now` whether the sensor has subscribers. A scanner may stop its motor while there are none.
    fn set_has_subscribers(&mut self, now: Nanos, has_subscribers: bool) {
        let _ = (now, has_subscribers);
    }

    /// Handles that the line is closed in a moment, without a successor. Returns whether there are bytes to send
    /// before; then drain the session once more.
    fn end(&mut self, now: Nanos) -> bool {
        let _ = now;
        false
    }

    /// Restores the identity that the previous session saved a moment ago. Scans are available at once if the scanner
    /// still streams as it did then. Call it before the first read.
    fn restore_identity(&mut self, identity: Identity) {
        let _ = identity;
    }

    /// Returns the identity for the next session. `None` if the scanner does not stream, has not reported all of it, or
    /// reports it in every packet.
    fn identity(&self) -> Option<Identity> {
        None
    }

    /// Sets the rate that the search for the scanner tries first: the one at which it was [found](Self::known_rate) the
    /// last time. Call it before the first read.
    fn hint_rate(&mut self, known: KnownRate) {
        let _ = known;
    }

    /// Handles that a search has found the scanner at `rate`, in bits per second, at which the port is open. Call it
    /// before the first read, and after [`hint_rate`](Self::hint_rate).
    fn begin_at(&mut self, rate: u32, now: Nanos) {
        let _ = (rate, now);
    }

    /// Restores the model and the number of beams that an earlier session on the same port has measured. They are
    /// ignored if the scanner streams at a rate that this model does not have. Call it before the first read, and after
    /// [`begin_at`](Self::begin_at).
    fn restore_beams(&mut self, model: Model, beams: usize) {
        let _ = (model, beams);
    }

    /// Returns the rate at which the search found the scanner, for the next search. `None` if there was no search.
    fn known_rate(&self) -> Option<KnownRate> {
        None
    }

    /// Sets the number of reads per telegram, so that [`partial_scan`](Self::partial_scan) returns more values each
    /// time. With 0 and 1, a telegram is read when it is complete.
    fn set_partial_reads(&mut self, count: u8) {
        let _ = count;
    }

    /// Returns the scan that is arriving, with the values so far. Call it when [`poll_action`](Protocol::poll_action)
    /// has returned a wait. `None` between scans, and while the meaning of values is not known.
    fn partial_scan(&self) -> Option<RawScan<'_>>;

    /// Returns the model, once it is known. Of models that cannot be distinguished, it is one. `None` for a family
    /// without models.
    fn model(&self) -> Option<Model> {
        None
    }

    /// Returns the number of beams of a scan, once the model is known. `None` for a family whose telegrams report it.
    fn beams(&self) -> Option<usize> {
        None
    }

    /// Returns the model if it is not the one of the settings. Of models that cannot be distinguished, it is one.
    fn unexpected_model(&self) -> Option<Model> {
        None
    }

    /// Returns the unit of ranges in mm that the scanner reported, if it can be changed.
    fn unit_mm(&self) -> Option<u8> {
        None
    }

    /// Returns the most important fact about the scanner that its owner should know although scans arrive.
    fn notice(&self) -> Option<Notice> {
        None
    }

    /// Returns the name of a setting that a recording needs before it can be read, as text.
    fn missing_setting(&self) -> Option<&'static str> {
        None
    }

    /// Returns the name of the model as a status shows it, or its number if scanhub does not know the model. `None` if the
    /// scanner has reported neither.
    fn model_text(&self) -> Option<String> {
        self.model().map(|model| model.name.to_uppercase())
    }

    /// Returns the responses that a stream file needs before the packets of this session, because the packets do not contain
    /// the model, the kind of packets, or the time per point. Empty if the session has received them with the packets, or if
    /// the family does not need them. Used for a recording. `reported` is the type of the scanner in a status of the
    /// recording, and `beams` the number of beams of its scans, if the recording has them.
    fn stream_responses(&self, reported: &str, beams: Option<usize>) -> Vec<u8> {
        let _ = (reported, beams);
        Vec::new()
    }

    /// Writes the scan mode and the firmware version of the scanner, in short form.
    fn write_details(&self, text: &mut dyn fmt::Write) {
        let _ = text;
    }

    /// Returns the identity and the health that the scanner reported. `None` before it has reported both, and always
    /// for a family without such requests.
    fn device_info(&self) -> Option<DeviceInfo> {
        None
    }

    /// Returns the time at which the last returned packet was measured, by the scanner's own clock, if it has one. Its
    /// zero is arbitrary. The clock restarts with the scanner.
    fn scanner_time(&self) -> Option<Nanos> {
        None
    }

    /// Adds `reasons`, bits of [`crate::line::suspect`], to the packets that are returned next. Used for a recording,
    /// which does not contain the damaged bytes beside a packet.
    fn mark_suspect(&mut self, reasons: u8) {
        let _ = reasons;
    }

    /// Reads a whole telegram of a recording, for a family whose telegrams need no bytes before or after them. Its
    /// stamps are 0. Returns `None` for other families, and if it is not a telegram.
    ///
    /// `is_readable` is whether the recording hub knew the meaning of its values. Writes what the telegram reports into
    /// `status`.
    fn read_recorded<'a>(
        &mut self,
        telegram: &'a [u8],
        is_readable: bool,
        status: Option<&mut Status>,
    ) -> Option<ReceivedTelegram<'a>> {
        let _ = (telegram, is_readable, status);
        None
    }

    /// Writes what is known of the scanner into `status`.
    fn describe(&self, status: &mut Status) {
        if let Some(mut text) = self.model_text() {
            self.write_details(&mut text);
            status.set_sensor_type(&text);
            if let Some(beams) = self.beams() {
                status.unit_mm = 1;
                status.angle_deg = 360;
                status.resolution_cdeg = (36_000.0 / beams as f64).round() as u16;
            }
        }
    }

    /// Adds the counters of this session to `counters`, which are those of earlier ones.
    fn add_counters(&self, counters: &mut Counters) {
        self.stats().add_to(counters);
    }
}

/// Action that a protocol requests, in the order in which it is to be carried out.
#[derive(Debug)]
pub enum Action<'a> {
    /// Set the port to this rate, in bits per second, and discard what it had received. If the port cannot have this
    /// rate, call [`Protocol::reject_rate`]. Then continue draining.
    SetRate(u32),
    /// Assert the line DTR of a serial port, or clear it; other ports have none. Then continue draining.
    SetDtr(bool),
    /// Write these bytes, not before the time given, then call [`Protocol::handle_transmitted`]. Do nothing else meanwhile,
    /// because a request may have to arrive without pauses. It is one byte at a time where the scanner requires gaps
    /// between bytes.
    Transmit {
        /// The bytes.
        bytes: &'a [u8],
        /// Earliest time to write them.
        not_before: Nanos,
    },
    /// Something arrived.
    Event(Event<'a>),
    /// Do not read before this time: nothing can be complete earlier, or it can wait.
    SleepUntil(Nanos),
    /// Read when the port has bytes; at the deadline, if a read finds none, call [`Protocol::handle_timeout`].
    Wait {
        /// The deadline; [`Nanos::MAX`] is none.
        until: Nanos,
    },
}

/// Event of a session: received bytes, or a scan made from them.
#[derive(Clone, Copy, Debug)]
pub enum Event<'a> {
    /// A telegram, or packets that arrived together, at most 10 ms of them, without other bytes between them. Each
    /// packet is in one of these events, in the order of arrival.
    Telegram(ReceivedTelegram<'a>),
    /// A complete revolution of a rotating scanner, after its packets.
    Scan(RawScan<'a>),
}

/// A telegram, or packets that arrived together, with their stamps.
#[derive(Clone, Copy, Debug)]
pub struct ReceivedTelegram<'a> {
    /// The bytes, in the session's buffer.
    pub bytes: &'a [u8],
    /// Time at which the first byte arrived.
    pub first: Nanos,
    /// Time at which the last byte arrived.
    pub last: Nanos,
    /// Whether `first` is an estimate from bytes that arrived in one read.
    pub estimated: bool,
    /// Reasons for suspicion: bits of [`crate::line::suspect`]; 0 is clean.
    pub reasons: u8,
    /// Number of packets; 1 for a telegram.
    pub count: usize,
    /// Whether each packet has a checksum, and it was right.
    pub is_checked: bool,
    /// Whether it is the response to a request, without measured data.
    pub is_reply: bool,
    /// Contents of a telegram that is a scan or a reply by itself. `None` for packets, which are parts of a scan.
    pub contents: Option<TelegramContents<'a>>,
}

/// Contents of a telegram that is a scan or a reply by itself.
#[derive(Clone, Copy, Debug)]
pub struct TelegramContents<'a> {
    /// [Number](RawScan::number) that the telegram had as a partial scan. Any other partial scan has come to nothing.
    pub number: u64,
    /// Number of beams of measured data; 0 for a reply.
    pub beams: usize,
    /// Nominal time to the next telegram of a stream; 0 if it is not known, and for a reply.
    pub period: Nanos,
    /// The scan. `None` for a reply, and while the meaning of values is not known.
    pub scan: Option<RawScan<'a>>,
}

/// Rate at which a scanner was found, for the next search.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct KnownRate {
    /// The rate in bits per second.
    pub baud: u32,
    /// Number of the last switches to 500,000 baud that were followed by silence. After two of them, the line counts as
    /// one that cannot carry that rate.
    pub silent_switches: u8,
}

/// Identity of a scanner that streams, in a form that only its family reads.
pub type Identity = [u8; 32];

/// Identity and health that a scanner reported on request, as text.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DeviceInfo {
    /// Firmware and numbers.
    pub identity: String,
    /// Health; empty if it was not reported.
    pub health: String,
    /// The same as a verdict.
    pub condition: HealthStatus,
}

/// Health that a scanner reports.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HealthStatus {
    /// Not reported.
    Unknown,
    /// The scanner works.
    Good,
    /// The scanner measures, but may fail soon.
    Warning,
    /// The scanner does not measure.
    Error,
}

/// A fact about a scanner that its owner should know although scans arrive.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Notice {
    /// The message.
    pub text: &'static str,
    /// Whether scans may be wrong because of it.
    pub is_fault: bool,
}

/// State of a session.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum State {
    /// Listening for a stream, or searching for the rate.
    Probing,
    /// Changing the rate.
    Switching,
    /// Changing settings and starting the stream, or identifying it.
    Starting,
    /// Measured data arrive.
    Streaming,
    /// Measured data have stopped arriving.
    Silent,
    /// A user paused the session, or there are no subscribers.
    Paused,
}

/// Request of a user to a running session.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Control {
    /// Stop the stream, then send nothing and expect nothing.
    Pause,
    /// End the pause: begin as a new session does.
    Resume,
    /// Restart the session, whatever the state is. It ends a pause, too.
    Resync,
}

/// Counters of a session. All of them except `buffered` only increase. Always
/// `read == in_telegrams + acknowledge + discarded + buffered`, in bytes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SessionStats {
    /// Bytes read.
    pub read: u64,
    /// Bytes of telegrams and packets that were returned.
    pub in_telegrams: u64,
    /// Bytes of single acknowledgements.
    pub acknowledge: u64,
    /// Bytes outside telegrams and packets.
    pub discarded: u64,
    /// Bytes that are not assigned yet.
    pub buffered: u64,
    /// Intact telegrams or packets.
    pub telegrams: u64,
    /// Transmissions that a streaming scanner must have sent since the first one of each stream.
    pub due: u64,
    /// Those of them that did not arrive.
    pub lost: u64,
    /// Bytes of streams outside telegrams and packets.
    pub damaged: u64,
    /// Transmissions with a wrong checksum.
    pub rejected_checksum: u64,
    /// Number of times that the session restarted.
    pub resyncs: u64,
    /// Restarts of the scanner that the session did not request. First contact is not one.
    pub restarts: u64,
    /// Whether the first transmission came after a fragment of one, which was in flight when the port was opened.
    pub first_frame_truncated: bool,
}

impl SessionStats {
    /// Adds these counters to those of earlier sessions.
    pub fn add_to(&self, counters: &mut Counters) {
        counters[Counter::BytesRead] += self.read;
        counters[Counter::BytesInTelegrams] += self.in_telegrams;
        counters[Counter::BytesAcknowledge] += self.acknowledge;
        counters[Counter::BytesDiscarded] += self.discarded;
        counters[Counter::BytesBuffered] = self.buffered;
        counters[Counter::Telegrams] += self.telegrams;
        counters[Counter::Resyncs] += self.resyncs;
        counters[Counter::ScannerRestarts] += self.restarts;
        counters[Counter::BytesDamaged] += self.damaged;
        counters[Counter::DueOnLine] += self.due;
        counters[Counter::LostOnLine] += self.lost;
        counters[Counter::LostInRestart] += u64::from(self.first_frame_truncated);
        counters[Counter::RejectedCrc] += self.rejected_checksum;
    }
}
