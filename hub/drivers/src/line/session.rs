//! Interface between a session with one scanner and its driver. The driver passes bytes and the time. The session
//! returns bytes to send, events and the next deadline. It never waits, reads or writes itself.

use core::fmt;

use crate::line::RawScan;
use crate::line::family::Model;
use scanhub_schema::{Counter, Counters, Nanos, Status};

/// Protocol state machine on an open port. After every call that changes the state, the driver calls
/// [`Protocol::poll_action`] until it returns [`Action::Wait`] or [`Action::SleepUntil`].
pub trait Protocol {
    /// Returns the buffer for the next read. The buffer is never empty after the driver has drained the actions.
    fn read_buffer(&mut self) -> &mut [u8];

    /// Handles a read that returned at `now` and wrote `len` bytes into [`Protocol::read_buffer`].
    fn commit(&mut self, now: Nanos, len: usize);

    /// Handles the deadline of [`Action::Wait`], which passed without a byte.
    fn handle_timeout(&mut self, now: Nanos);

    /// Handles the completed write of the bytes of [`Action::Transmit`] at `now`.
    fn handle_transmitted(&mut self, now: Nanos);

    /// Returns the next action that the driver must carry out.
    fn poll_action(&mut self) -> Action<'_>;

    /// Checks whether `now` is too late for the bytes of [`Action::Transmit`], for example because the program did not
    /// run for a few milliseconds. The driver calls this method immediately before it writes these bytes. If the result
    /// is `true`, the protocol restarts the request, and the driver continues to drain actions without writing the
    /// bytes.
    fn restart_if_late(&mut self, now: Nanos) -> bool {
        let _ = now;
        false
    }

    /// Handles the port's rejection of the baud rate in the last [`Action::SetRate`]. A call before the first action
    /// means that the port rejected the rate at which the driver tried to open it. The protocol then tries other rates,
    /// if it has any.
    fn reject_rate(&mut self, now: Nanos) {
        let _ = now;
    }

    /// Returns whether the protocol has ended. A session never ends.
    fn is_done(&self) -> bool {
        false
    }
}

/// Session with a scanner. It lasts as long as the line is open.
///
/// Methods that only some families support have a default implementation.
pub trait ScannerSession: Protocol {
    /// Reason why a session does not stream as it should. Its `Display` output is part of messages.
    type Problem: Copy + PartialEq + fmt::Display;

    /// Handles a request of a user. Repeating a request has no effect, except that each [`Control::Resync`] restarts
    /// the session. A recording does not support requests.
    fn control(&mut self, control: Control, now: Nanos);

    /// Returns the current state.
    fn state(&self) -> State;

    /// Returns the reason why the session does not stream as it should.
    fn problem(&self) -> Option<Self::Problem>;

    /// Returns the name of the transmissions whose absence is the [`problem`](Self::problem), such as `LMS replies`.
    /// Returns `None` if the session has another problem, or none. Other bytes may be arriving.
    fn missing_transmission(&self) -> Option<&'static str>;

    /// Returns the baud rate at which the session sends and receives, in bits per second.
    fn rate(&self) -> u32;

    /// Returns the counters of the session.
    fn stats(&self) -> SessionStats;

    /// Returns whether [`defer_read`](Self::defer_read) may postpone the next read. If not, the driver need not query
    /// the number of unread bytes.
    fn can_defer_read(&self) -> bool {
        false
    }

    /// Handles a line that has `waiting` unread bytes at `now`. Returns whether the driver should leave these bytes
    /// unread for a while. Unread bytes are not lost if the hub is killed.
    fn defer_read(&mut self, now: Nanos, waiting: usize) -> bool {
        let _ = (now, waiting);
        false
    }

    /// Stores whether the sensor has subscribers at `now`. Without subscribers, some sessions stop the motor.
    fn set_has_subscribers(&mut self, now: Nanos, has_subscribers: bool) {
        let _ = (now, has_subscribers);
    }

    /// Prepares for the end of the session, before the driver closes the line. Returns whether the session still has
    /// bytes to send. If so, the driver drains the actions once more.
    fn end(&mut self, now: Nanos) -> bool {
        let _ = now;
        false
    }

    /// Restores the identity that the previous session saved a moment ago. If the scanner still streams, the session
    /// can return scans at once. Call it before the first read.
    fn restore_identity(&mut self, identity: Identity) {
        let _ = identity;
    }

    /// Returns the identity for the next session. Returns `None` if the scanner does not stream, if it has not reported
    /// its complete identity, or if every packet contains the identity.
    fn identity(&self) -> Option<Identity> {
        None
    }

    /// Sets the baud rate that the search tries first. `known` is the [rate](Self::known_rate) at which the last search
    /// found the scanner. Call it before the first read.
    fn hint_rate(&mut self, known: KnownRate) {
        let _ = known;
    }

    /// Starts a session after a search has found the scanner at `rate`, in bits per second. The port is open at this
    /// rate. Call it before the first read, and after [`hint_rate`](Self::hint_rate).
    fn set_start_rate(&mut self, rate: u32, now: Nanos) {
        let _ = (rate, now);
    }

    /// Restores the model and the number of beams that an earlier session measured on the same port. The session
    /// ignores them if the scanner streams at a baud rate that this model does not have. Call it before the first read,
    /// and after [`set_start_rate`](Self::set_start_rate).
    fn restore_beams(&mut self, model: Model, beams: usize) {
        let _ = (model, beams);
    }

    /// Returns the baud rate at which the search found the scanner, for the next search. Returns `None` if there was no
    /// search.
    fn known_rate(&self) -> Option<KnownRate> {
        None
    }

    /// Sets the number of reads per telegram. With more reads, [`partial_scan`](Self::partial_scan) returns values
    /// earlier. If `count` is 0 or 1, the session reads a telegram when it is complete.
    fn set_partial_reads(&mut self, count: u8) {
        let _ = count;
    }

    /// Returns the scan that is arriving, with the values received so far. Call it after
    /// [`poll_action`](Protocol::poll_action) has returned a wait. Returns `None` between scans, and while the session
    /// does not know the meaning of the values.
    fn partial_scan(&self) -> Option<RawScan<'_>>;

    /// Returns the model. If several models cannot be distinguished, returns one of them. Returns `None` while the
    /// model is unknown, and for a family without models.
    fn model(&self) -> Option<Model> {
        None
    }

    /// Returns the number of beams of a scan. Returns `None` while the model is unknown, and for a family whose
    /// telegrams contain the number of beams.
    fn beams(&self) -> Option<usize> {
        None
    }

    /// Returns the scanner's model if it differs from the model in the settings. If several models cannot be
    /// distinguished, returns one of them.
    fn unexpected_model(&self) -> Option<Model> {
        None
    }

    /// Returns the unit of ranges that the scanner reported, in millimeters. Returns `None` for a family with a fixed
    /// unit.
    fn unit_mm(&self) -> Option<u8> {
        None
    }

    /// Returns the most important fact that the user should know about the scanner although scans arrive.
    fn notice(&self) -> Option<Notice> {
        None
    }

    /// Returns the name of a missing setting without which the session cannot read this recording.
    fn missing_setting(&self) -> Option<&'static str> {
        None
    }

    /// Returns the model as text for a status: its name, or its number if scanhub does not support the model. Returns
    /// `None` if the scanner has reported neither.
    fn model_text(&self) -> Option<String> {
        self.model().map(|model| model.name.to_uppercase())
    }

    /// Returns the responses that a stream file needs before the packets of this session. The packets do not contain
    /// the model, the kind of packets, or the time per point. Returns an empty vector if the family does not need these
    /// responses, or if the session received them together with the packets.
    ///
    /// Used for a recording. `reported` is the scanner's type in a status of the recording. `beams` is the number of
    /// beams of a scan, if the recording has scans.
    fn stream_responses(&self, reported: &str, beams: Option<usize>) -> Vec<u8> {
        let _ = (reported, beams);
        Vec::new()
    }

    /// Writes the scan mode and the firmware version of the scanner, in short form.
    fn write_details(&self, text: &mut dyn fmt::Write) {
        let _ = text;
    }

    /// Returns the identity and the health that the scanner reported. Returns `None` until the scanner has reported
    /// both, and for a family whose scanners do not report them.
    fn device_info(&self) -> Option<DeviceInfo> {
        None
    }

    /// Returns the time of the scanner's clock at which the last returned packet was measured. The zero of this clock
    /// is arbitrary, and the clock restarts with the scanner. Returns `None` for a scanner without a clock.
    fn scanner_time(&self) -> Option<Nanos> {
        None
    }

    /// Marks the next returned packets as suspect for `reasons`, bits of [`crate::line::suspect`]. Used for a
    /// recording, because a recording contains the packets but not the damaged bytes between them.
    fn mark_suspect(&mut self, reasons: u8) {
        let _ = reasons;
    }

    /// Reads a complete telegram of a recording, for a family whose telegrams can be read without the bytes around
    /// them. The stamps of the result are 0. Writes what the telegram reports about the scanner into `status`.
    ///
    /// `is_readable` states whether the hub that made the recording had all settings that are necessary to interpret
    /// the values.
    ///
    /// Returns `None` for other families, and if the bytes are not a telegram.
    fn read_recorded<'a>(
        &mut self,
        telegram: &'a [u8],
        is_readable: bool,
        status: Option<&mut Status>,
    ) -> Option<ReceivedTelegram<'a>> {
        let _ = (telegram, is_readable, status);
        None
    }

    /// Writes the scanner's type, beams and units into `status`, as far as they are known.
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

    /// Adds the counters of this session to `counters`, which contains the counters of earlier sessions.
    fn add_counters(&self, counters: &mut Counters) {
        self.stats().add_to(counters);
    }
}

/// Action that a protocol requests. The driver carries out the actions in the order of their return.
#[derive(Debug)]
pub enum Action<'a> {
    /// Set the baud rate of the port, in bits per second, and discard received bytes. If the port does not support the
    /// rate, call [`Protocol::reject_rate`]. Then continue draining.
    SetRate(u32),
    /// Set the line DTR of a serial port to asserted or not asserted. Other ports do not have this line. Then continue
    /// draining.
    SetDtr(bool),
    /// Write these bytes, then call [`Protocol::handle_transmitted`]. Do nothing else between the write and this call,
    /// because the bytes of a request may have to arrive without pauses. The action contains a single byte if the
    /// scanner requires gaps between bytes.
    Transmit {
        /// The bytes.
        bytes: &'a [u8],
        /// Earliest time for the write.
        not_before: Nanos,
    },
    /// Publish this event.
    Event(Event<'a>),
    /// Do not read before this time. Either no transmission can be complete earlier, or a later read returns more
    /// bytes.
    SleepUntil(Nanos),
    /// Read when the port has bytes. If a read at the deadline returns no bytes, call [`Protocol::handle_timeout`].
    Wait {
        /// The deadline. [`Nanos::MAX`] means that there is none.
        until: Nanos,
    },
}

/// Event of a session: received bytes, or a scan assembled from them.
#[derive(Clone, Copy, Debug)]
pub enum Event<'a> {
    /// A telegram, or packets that arrived together. The packets have no other bytes between them and cover at most 10
    /// ms. Every packet is part of exactly one event, and events are in the order of arrival.
    Telegram(ReceivedTelegram<'a>),
    /// A complete revolution of a rotating scanner. It follows the events with its packets.
    Scan(RawScan<'a>),
}

/// A telegram, or packets that arrived together, with their stamps.
#[derive(Clone, Copy, Debug)]
pub struct ReceivedTelegram<'a> {
    /// The bytes, which are in the session's buffer.
    pub bytes: &'a [u8],
    /// Time at which the first byte arrived.
    pub first: Nanos,
    /// Time at which the last byte arrived.
    pub last: Nanos,
    /// Whether `first` is an estimate, for example because all bytes arrived in one read.
    pub estimated: bool,
    /// Reasons why the bytes are suspect: bits of [`crate::line::suspect`]; 0 means clean.
    pub reasons: u8,
    /// Number of packets; 1 for a telegram.
    pub count: usize,
    /// Whether every packet has a checksum and the checksum was right.
    pub is_checked: bool,
    /// Whether the bytes are the reply to a request and contain no measured data.
    pub is_reply: bool,
    /// Contents of a telegram that is a complete scan or reply. `None` for packets, because only several packets form a
    /// scan.
    pub contents: Option<TelegramContents<'a>>,
}

/// Contents of a telegram that is a complete scan or reply.
#[derive(Clone, Copy, Debug)]
pub struct TelegramContents<'a> {
    /// Serial [number](RawScan::number) of the telegram. The partial scan of the same telegram had the same number.
    /// After this telegram, the session never completes an earlier partial scan with another number.
    pub number: u64,
    /// Number of beams with measured data; 0 for a reply.
    pub beams: usize,
    /// Nominal time to the next telegram of a stream, in nanoseconds. 0 if the time is unknown, and for a reply.
    pub period: Nanos,
    /// The scan. `None` for a reply, and while the session does not know the meaning of the values.
    pub scan: Option<RawScan<'a>>,
}

/// Baud rate at which a search found a scanner, for the next search.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct KnownRate {
    /// Baud rate in bits per second.
    pub baud: u32,
    /// Number of most recent consecutive switches to 500,000 baud after which the line was silent. After two such
    /// switches, the session assumes that the line cannot carry this rate.
    pub silent_switches: u8,
}

/// Identity of a streaming scanner, in a format that only the scanner's family can read.
pub type Identity = [u8; 32];

/// Identity and health that a scanner reported on request, as text.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DeviceInfo {
    /// Model, firmware and serial number, as text.
    pub identity: String,
    /// Health as text. Empty if the scanner did not report it.
    pub health: String,
    /// Health as a value.
    pub condition: HealthStatus,
}

/// Health that a scanner reports.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HealthStatus {
    /// The scanner has not reported its health.
    Unknown,
    /// The scanner works.
    Good,
    /// The scanner measures, but may fail soon.
    Warning,
    /// The scanner has failed and does not measure.
    Error,
}

/// Fact that the user should know about a scanner although scans arrive.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Notice {
    /// Text of the message.
    pub text: &'static str,
    /// Whether the reported fact can make scans wrong.
    pub is_fault: bool,
}

/// State of a session.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum State {
    /// The session listens for a stream, or searches for the baud rate.
    Probing,
    /// The session changes the baud rate.
    Switching,
    /// The session changes settings and starts the stream, or examines a stream that is already running.
    Starting,
    /// Measured data arrives.
    Streaming,
    /// Measured data has stopped arriving.
    Silent,
    /// A user has paused the session, or the sensor has no subscribers.
    Paused,
}

/// Request of a user to a running session.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Control {
    /// Stop the stream. Then send nothing and expect no bytes.
    Pause,
    /// End the pause and start like a new session.
    Resume,
    /// Restart the session in any state. This also ends a pause.
    Resync,
}

/// Counters of a session. All of them except `buffered` only increase. In bytes, `read == in_telegrams + acknowledge +
/// discarded + buffered` always holds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SessionStats {
    /// Bytes read.
    pub read: u64,
    /// Bytes of returned telegrams and packets.
    pub in_telegrams: u64,
    /// Bytes that are single acknowledgments.
    pub acknowledge: u64,
    /// Bytes that are not part of a telegram, a packet or an acknowledgment.
    pub discarded: u64,
    /// Bytes that are still in the session's buffer.
    pub buffered: u64,
    /// Intact telegrams or packets.
    pub telegrams: u64,
    /// Transmissions that were due after the first transmission of each stream.
    pub due: u64,
    /// Transmissions that were due but did not arrive.
    pub lost: u64,
    /// Bytes of a stream that are not part of a telegram or packet.
    pub damaged: u64,
    /// Transmissions with a wrong checksum.
    pub rejected_checksum: u64,
    /// Number of restarts of the session.
    pub resyncs: u64,
    /// Restarts of the scanner that the session did not request. The first boot message does not count.
    pub restarts: u64,
    /// Whether the first transmission followed the rest of another transmission, which was on the line when the port
    /// was opened.
    pub first_frame_truncated: bool,
}

impl SessionStats {
    /// Adds these counters to `counters`, which contains the counters of earlier sessions.
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
