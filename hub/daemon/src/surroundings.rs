//! What a link asks of its surroundings: the time, a line to its sensor, topics for its results, files that outlive it.
//! Nothing here decides anything: `system.rs` is this machine, and a simulation brings another one, so
//! that the same hub runs in made-up time. Refuses to know what is read and published.

use std::io;
use std::path::Path;

use port::{Allowance, Alteration, PortError, Source};
use schema::{Background, Failure, Nanos, Pose, Ring, Wake};
use shm::{Medium, Payload};

use crate::control::ControlQueue;
use crate::saved_state::{KnownRate, KnownScanner};

/// What one link has around it.
pub trait Surroundings {
    /// An open line to a sensor.
    type Line: Line;
    /// What carries the samples of a topic.
    type Medium<P: Payload + ?Sized>: Medium<P>;

    /// Returns CLOCK_MONOTONIC, the clock of every stamp and deadline, in ns.
    fn now(&self) -> Nanos;

    /// Returns the wall clock, in ns since 1970.
    fn wall_ns(&self) -> u64;

    /// Sleeps until `until`, too short a time to watch anything meanwhile.
    fn pause(&self, until: Nanos);

    /// Takes the name of the sensor, and creates its doorbell and its event, unless the link has the name already.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::NameHeld`](schema::Kind) if another process publishes under it. The link then publishes without
    /// waking its subscribers, which poll ten times a second.
    fn take_name(&self) -> Result<(), Failure>;

    /// Opens the line at `source` at `baud`; nothing while that takes time: then to be asked again once
    /// [`On::Opening`] is ready.
    ///
    /// # Errors
    ///
    /// The reason in a word, without its circumstances.
    fn open(&self, source: &Source, baud: u32) -> Option<Result<Self::Line, PortError>>;

    /// Returns `error` in words, with its circumstances and a remedy.
    fn explain(&self, error: &PortError, source: &Source) -> Failure;

    /// Returns the program that may have changed the settings of the port at `source`, as the end of a message; `None` if
    /// none is known.
    fn altering_program(&self, source: &Source) -> Option<String>;

    /// Returns the line at `source` that was kept open for link `name` while the hub before this one was killed.
    fn take_kept(&self, name: &str, source: &Source, baud: u32) -> Option<Self::Line>;

    /// Has `line` of link `name` kept open if this hub is killed.
    fn keep(&self, name: &str, line: &Self::Line);

    /// Ends what [`keep`](Self::keep) began.
    fn release(&self, name: &str);

    /// Makes the topic of `sensor` that carries `P`.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`SharedMemory::new`](shm::SharedMemory::new).
    fn medium<P: Payload + ?Sized>(&self, sensor: &str) -> Result<Self::Medium<P>, Failure>;

    /// Wakes the consumers that sleep at the link's bell for topics of `ring`.
    fn ring(&self, ring: Ring);

    /// Wakes the consumers that listen to the link's event.
    fn tell(&self, why: Wake);

    /// Reads into `record` what [`remember`](Self::remember) was last told of link `name`, by this hub or the one before it;
    /// returns its length, nothing if there is none. It outlives a killed hub, and not the machine.
    fn recall(&self, name: &str, record: &mut [u8]) -> Option<usize>;

    /// Has `record` of link `name` outlive this hub. Waits for no disk.
    fn remember(&self, name: &str, record: &[u8]);

    /// Returns what outlives the machine's power; nothing where that is not wanted.
    fn learned(&self) -> Option<&dyn Learned>;
}

/// Where a link hands on what it has learned, for the next hub. Waits for no disk.
pub trait Learned {
    /// The background of a sensor that sits at the pose.
    fn keep_background(&self, pose: Pose, model: Box<Background>);

    /// Returns when the background was written that the next hub would begin with, in ns since 1970; nothing if there is none.
    fn kept_wall_ns(&self) -> Option<u64>;

    /// Returns the rate at which the scanner at `port` was found the last time that it had to be searched for.
    fn rate(&self, port: &str) -> Option<KnownRate>;

    /// Returns the scanner that a search found at `port` the last time.
    fn scanner(&self, port: &str) -> Option<KnownScanner>;

    /// Saves the `scanner` that a search found at `port`.
    fn keep_scanner(&self, port: &str, scanner: KnownScanner);

    /// Saves the `rate` at which the scanner at `port` was found.
    fn keep_rate(&self, port: &str, rate: KnownRate);
}

/// An open line; nothing here waits.
pub trait Line {
    /// Reads what there is into `buffer`: returns 0 if there is nothing.
    ///
    /// # Errors
    ///
    /// The line is gone.
    fn read(&self, buffer: &mut [u8]) -> io::Result<usize>;

    /// Writes `bytes`. A full line drops what it has no room for, as a cable would.
    ///
    /// # Errors
    ///
    /// The line is gone.
    fn write(&self, bytes: &[u8]) -> io::Result<()>;

    /// Changes the rate, and discards what arrived at the old one. Returns why this rate is not possible.
    ///
    /// # Errors
    ///
    /// The line is gone.
    fn set_baud(&self, baud: u32) -> io::Result<Option<io::Error>>;

    /// Returns the settings that another process has made since the hub's; `None` if they are unchanged.
    ///
    /// # Errors
    ///
    /// Returns an error if the line is lost.
    fn altered(&self) -> io::Result<Option<Alteration>>;

    /// Makes the hub's settings again, at `baud`, and discards what arrived with others.
    ///
    /// # Errors
    ///
    /// Returns an error if the line is lost, or if it cannot have these settings any more.
    fn restore(&self, baud: u32) -> io::Result<()>;

    /// Asserts DTR of a serial port, or clears it; a line without one ignores it.
    ///
    /// # Errors
    ///
    /// The line is gone.
    fn set_dtr(&self, on: bool) -> io::Result<()>;

    /// Returns how many bytes there are to read; nothing if asking is not worth it.
    fn waiting(&self) -> Option<usize>;

    /// Returns how much may be read of it: nothing of a serial line, of which all may.
    fn allowance(&self, baud: u32) -> Option<Allowance>;

    /// Returns the errors that the driver counted since the last call.
    fn line_errors(&self) -> u64;

    /// Returns the device that the port's name resolved to; `None` if it has none, such as a serial server.
    fn device(&self) -> Option<&Path>;

    /// Returns whether another program simulates the sensor.
    fn is_simulated(&self) -> bool;
}

/// What a link waits for.
pub struct Wait<'a, L> {
    /// The requests of users, which may come before the time is up.
    pub requests: &'a ControlQueue,
    /// What may be ready before the time is up, besides them and the hub's end.
    pub on: On<'a, L>,
    /// When the time is up.
    pub until: Nanos,
}

/// What may be ready.
#[derive(Debug)]
pub enum On<'a, L> {
    /// Nothing.
    Nothing,
    /// The line that is being opened.
    Opening,
    /// Bytes on this line, or that it is gone.
    Bytes(&'a L),
    /// That this line is gone: bytes are left alone.
    Loss(&'a L),
}

/// Why a wait is over.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Woken {
    /// The hub shall end.
    Stop,
    /// A user wants something.
    Request,
    /// What was waited for is ready.
    Ready,
    /// The time is up.
    Timeout,
}
