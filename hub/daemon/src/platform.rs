//! Platform of a link: clocks, the line to its scanner, topics for its results, and state that outlives the hub.
//!
//! `system.rs` implements these traits for this machine. A simulation implements them in virtual time, with the same
//! hub. The implementations contain no logic of the hub.

use std::io;
use std::path::Path;

use scanhub_port::{PortError, PortSpec, ReadBudget, SettingsChange};
use scanhub_schema::{Background, DoorbellWord, Failure, Nanos, Pose, WakeEvent};
use scanhub_shm::{Payload, SampleTransport};

use crate::control::ControlQueue;
use crate::saved_state::{KnownRate, KnownScanner};

/// Environment of one link.
pub trait Platform {
    /// Open line to a scanner.
    type Port: PortIo;
    /// Transport of the samples of a topic.
    type Transport<P: Payload + ?Sized>: SampleTransport<P>;

    /// Returns CLOCK_MONOTONIC, the clock of every stamp and deadline, in ns.
    fn now(&self) -> Nanos;

    /// Returns the wall clock, in ns since 1970.
    fn wall_ns(&self) -> u64;

    /// Sleeps until `until`. The time is too short to handle anything else in between.
    fn pause(&self, until: Nanos);

    /// Takes the name of the sensor, and creates its doorbell and its event, unless the link has the name already.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::NameHeld`](scanhub_schema::Kind) if another process publishes under this name. The link then
    /// publishes without waking its subscribers, which poll ten times a second.
    fn take_name(&self) -> Result<(), Failure>;

    /// Opens the line at `source` at `baud`. Returns `None` while a connection is being made; call this function again
    /// once [`WaitSource::Opening`] is ready.
    ///
    /// # Errors
    ///
    /// Returns the reason without its circumstances, which [`explain`](Self::explain) adds.
    fn open(&self, source: &PortSpec, baud: u32) -> Option<Result<Self::Port, PortError>>;

    /// Returns the message for `error`, with its circumstances and a remedy.
    fn explain(&self, error: &PortError, source: &PortSpec) -> Failure;

    /// Returns the program that may have changed the settings of the port at `source`, as the end of a message; `None`
    /// if no such program is known.
    fn altering_program(&self, source: &PortSpec) -> Option<String>;

    /// Returns the line at `source` that was kept open for link `name` when the previous hub was killed.
    fn take_kept_port(&self, name: &str, source: &PortSpec, baud: u32) -> Option<Self::Port>;

    /// Keeps `line` of link `name` open even if this hub is killed.
    fn keep_open(&self, name: &str, line: &Self::Port);

    /// Ends the effect of [`keep_open`](Self::keep_open).
    fn release(&self, name: &str);

    /// Creates the topic of `sensor` with payload `P`.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`SharedMemory::new`](scanhub_shm::SharedMemory::new).
    fn transport<P: Payload + ?Sized>(&self, sensor: &str) -> Result<Self::Transport<P>, Failure>;

    /// Returns a number that changes when a subscriber or listener of the link may have attached. The number may miss
    /// subscribers that use other libraries than this project's. `None` if the number is unknown.
    fn attach_count(&self) -> Option<u32>;

    /// Returns whether the event of the link has a listener.
    fn has_listeners(&self) -> bool;

    /// Rings the doorbell at `word` of the link, which wakes the subscribers that sleep on this word.
    fn ring(&self, word: DoorbellWord);

    /// Wakes the subscribers that listen to the event of the link.
    fn notify_event(&self, event: WakeEvent);

    /// Reads the last record that this hub or the previous one has [stored](Self::store_record) for link `name` into
    /// `record`. Returns the length of the record; `None` if no record exists. A record outlives a killed hub, but not
    /// a restart of the machine.
    fn load_record(&self, name: &str, record: &mut [u8]) -> Option<usize>;

    /// Stores the `record` of link `name` for the next hub, without waiting for a disk.
    fn store_record(&self, name: &str, record: &[u8]);

    /// Returns the state that outlives a restart of the machine; `None` if the link saves no such state.
    fn saved_state(&self) -> Option<&dyn SavedState>;
}

/// Saved state of a link, for the next hub. No function waits for a disk.
pub trait SavedState {
    /// Saves the background of a sensor at `pose`.
    fn save_background(&self, pose: Pose, model: Box<Background>);

    /// Returns the time at which the background for the next hub was written, in ns since 1970; `None` if no background
    /// was written.
    fn saved_wall_ns(&self) -> Option<u64>;

    /// Returns the rate at which the last search found the scanner at `port`.
    fn rate(&self, port: &str) -> Option<KnownRate>;

    /// Returns the scanner that the last search found at `port`.
    fn scanner(&self, port: &str) -> Option<KnownScanner>;

    /// Saves the `scanner` that a search found at `port`.
    fn save_scanner(&self, port: &str, scanner: KnownScanner);

    /// Saves the `rate` at which the scanner at `port` was found.
    fn save_rate(&self, port: &str, rate: KnownRate);
}

/// Open line. No function waits.
pub trait PortIo {
    /// Reads the available bytes into `buffer`. Returns their number.
    ///
    /// # Errors
    ///
    /// Returns an error if the line is lost.
    fn read(&self, buffer: &mut [u8]) -> io::Result<usize>;

    /// Writes `bytes`. A full line drops bytes, as a cable would.
    ///
    /// # Errors
    ///
    /// Returns an error if the line is lost.
    fn write(&self, bytes: &[u8]) -> io::Result<()>;

    /// Changes the rate, and discards the bytes that arrived at the old one. Returns the reason if the port rejects
    /// the rate.
    ///
    /// # Errors
    ///
    /// Returns an error if the line is lost.
    fn set_baud(&self, baud: u32) -> io::Result<Option<io::Error>>;

    /// Returns the change if another process has changed the settings since the hub set them; `None` if they are
    /// unchanged.
    ///
    /// # Errors
    ///
    /// Returns an error if the line is lost.
    fn alteration(&self) -> io::Result<Option<SettingsChange>>;

    /// Restores the hub's settings, at `baud`, and discards the bytes that arrived with other settings.
    ///
    /// # Errors
    ///
    /// Returns an error if the line is lost, or if the line does not accept these settings any more.
    fn restore(&self, baud: u32) -> io::Result<()>;

    /// Sets DTR of a serial port. Other lines ignore it.
    ///
    /// # Errors
    ///
    /// Returns an error if the line is lost.
    fn set_dtr(&self, on: bool) -> io::Result<()>;

    /// Returns the number of bytes in the tty's input buffer; `None` for a network port.
    fn buffered_len(&self) -> Option<usize>;

    /// Returns the read budget of a network port for a line of `baud`; `None` for a tty, which is never throttled.
    fn read_budget(&self, baud: u32) -> Option<ReadBudget>;

    /// Returns the errors that the driver counted since the last call.
    fn line_errors(&self) -> u64;

    /// Returns the device that the port's name resolved to; `None` if the port has no device, such as a serial server.
    fn device(&self) -> Option<&Path>;

    /// Returns whether another program simulates the scanner.
    fn is_simulated(&self) -> bool;
}

/// Wait of a link. The end of the hub also ends the wait.
pub struct Wait<'a, L> {
    /// Requests of users. One of them ends the wait.
    pub requests: &'a ControlQueue,
    /// Source that ends the wait when it is ready.
    pub source: WaitSource<'a, L>,
    /// Time at which the wait ends at the latest.
    pub until: Nanos,
}

/// Source that may end a wait.
#[derive(Debug)]
pub enum WaitSource<'a, L> {
    /// No source.
    Nothing,
    /// The connection that is being made.
    Opening,
    /// Bytes on this line, or its loss.
    Bytes(&'a L),
    /// The loss of this line. Bytes are left unread.
    Loss(&'a L),
}

/// Reason why a wait ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WakeReason {
    /// The hub must end.
    Stop,
    /// A user has sent a request.
    Request,
    /// The source is ready.
    Ready,
    /// The deadline has passed.
    Timeout,
}
