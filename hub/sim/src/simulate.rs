//! The verb `simulate`, which simulates scanners on ptys or TCP servers until it is stopped.
//!
//! Each port has a thread, `PortThread`, which runs scanner and line by their deadlines. The thread adds the effects of
//! the host's port: another rate, no host, a host that does not read, an unplugged adapter. [`Truth`] is the log of the
//! telegrams, in a file or on stdout. It has one line per telegram, and at the end one line per port. The hub never
//! reads it.

use std::fs::File;
use std::io::{self, Write};
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::path::{Path, PathBuf};
use std::sync::Mutex;

use rustix::event::{EventfdFlags, eventfd};
use scanhub_drivers::lms::variant::{Baud, Mode, Variant};
use scanhub_files::output::{self, Target};
use scanhub_recording::{Encoding, Frame, Recording};
use scanhub_schema::{Failure, Family, Kind, MILLIS, Nanos};
use serde_json::json;
use sha2::{Digest, Sha256};

use crate::device::{ChunkKind, Device};
use crate::fault::{Fault, Faults};
use crate::ld::{LdSettings, LdSimulator, recorded_packets};
use crate::line_model::BaudMismatch;
use crate::line_model::{Delivery, LineModel};
use crate::machine::{LmsSimulator, Settings, StartState};
use crate::mount::{Encoder, Report};
use crate::operating::ScanSource;
use crate::options::{Scanner, SimulateOptions, type_name};
use crate::port::SimPort;
use crate::port::{WaitResult, now_ns, wait};
use crate::request_decoder::Arrival;
use crate::room::Room;
use crate::rplidar::{RplidarSettings, RplidarSimulator, RplidarStart};

/// A port that is ready to be opened.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SimulatedPort {
    /// Name with which a hub opens the port: the path of the symlink as the user named it, or `tcp:HOST:PORT` for a TCP
    /// server.
    pub port: PathBuf,
    /// Path of the pty; `None` for a TCP server.
    pub pty: Option<PathBuf>,
}

/// Simulates the scanners of `options` until `stop` is readable, and returns the summary of each port. Calls `on_ready`
/// when all ports exist. The thread of each port calls `on_record` with each telegram that its scanner has sent. The
/// symlinks are removed when this function returns.
pub fn simulate(
    options: &SimulateOptions,
    stop: impl AsFd,
    on_ready: impl FnOnce(&[SimulatedPort]),
    on_record: impl Fn(&Record) + Sync,
) -> Result<Vec<Summary>, Failure> {
    simulate_with(options, stop, on_ready, on_record, |_| None, |_, _| {})
}

/// Simulates like [`simulate()`]. The thread of each port repeatedly calls `event`, which returns the next event for
/// this port, if there is one. `on_report` receives the index of a port and each report of the encoder of its mount.
/// The times of a report are those of the kernel's clock.
pub fn simulate_with(
    options: &SimulateOptions,
    stop: impl AsFd,
    on_ready: impl FnOnce(&[SimulatedPort]),
    on_record: impl Fn(&Record) + Sync,
    event: impl Fn(&Path) -> Option<Event> + Sync,
    on_report: impl Fn(usize, Report) + Sync,
) -> Result<Vec<Summary>, Failure> {
    options.check()?;
    let recording = options.replay.as_ref().filter(|_| options.scanner.is_none());
    // Without `scanner`, the simulated scanners are LMS, so the bytes of a stream file are those of an LMS.
    let recording = recording.map(|path| Recording::open_as(path, Some(Family::Lms))).transpose()?;
    let truth = options.truth.as_deref().map(|path| Truth::create(path, options.force)).transpose()?;
    let on_record = |record: &Record| {
        on_record(record);
        truth.as_ref().map_or(Ok(()), |truth| truth.write(&record.line()))
    };
    let mut ready = Vec::new();
    let mut threads = Vec::new();
    let time = ScaledClock { zero_ns: now_ns(), speed: options.speed };
    for (number, port) in options.ports.iter().enumerate() {
        let seed = options.seed.wrapping_add(number as u64);
        let machine = device(options, recording.as_ref(), number)?;
        let sim_port = SimPort::new(port)?;
        let port = sim_port.found(port);
        ready.push(SimulatedPort { port: port.clone(), pty: sim_port.pty().map(Path::to_owned) });
        let wire = LineModel::new(&options.faults, seed);
        let sim_port = Some(sim_port);
        let encoder = options.world.mount(number % options.world.sensors()).cloned().map(Encoder::new);
        threads.push(PortThread {
            number,
            port,
            sim_port,
            machine,
            line: wire,
            time,
            on_record: &on_record,
            event: &event,
            encoder,
            on_report: &on_report,
            lossless: options.lossless,
            is_open: false,
            fault: None,
            mismatch: BaudMismatch::default(),
            sent: 0,
            unsent: Vec::new(),
        });
    }
    on_ready(&ready);
    let summaries = run(threads, stop.as_fd())?;
    if let Some(truth) = &truth {
        for summary in &summaries {
            truth.write(&summary.line())?;
        }
    }
    Ok(summaries)
}

/// Runs each port in a separate thread. If one thread fails, the other threads end, too.
fn run(threads: Vec<PortThread<'_>>, stop: BorrowedFd<'_>) -> Result<Vec<Summary>, Failure> {
    let failed: OwnedFd = eventfd(0, EventfdFlags::CLOEXEC).map_err(|errno| {
        Failure::new(Kind::ResourceExhausted, format!("cannot create an eventfd: {errno}"), "")
    })?;
    std::thread::scope(|scope| {
        let threads: Vec<_> = threads
            .into_iter()
            .map(|thread| {
                let failed = &failed;
                scope.spawn(move || {
                    let outcome = thread.run([stop, failed.as_fd()]);
                    if outcome.is_err() {
                        let _ = rustix::io::write(failed, &1u64.to_ne_bytes());
                    }
                    outcome
                })
            })
            .collect();
        let join = |thread: std::thread::ScopedJoinHandle<'_, _>| match thread.join() {
            Ok(outcome) => outcome,
            Err(panic) => std::panic::resume_unwind(panic),
        };
        threads.into_iter().map(join).collect()
    })
}

/// Creates the scanner of the port with the index `number`.
fn device(
    options: &SimulateOptions,
    recording: Option<&Recording>,
    number: usize,
) -> Result<Box<dyn Device + Send>, Failure> {
    let room = || Room::of_port(&options.world, options.seed, number as u64);
    let (chunk, boot_ns) = (options.chunk, options.boot.as_nanos() as Nanos);
    let seed = options.seed.wrapping_add(number as u64);
    let sensor = options.sensors.get(number).or(options.sensors.last()).map(String::as_str);
    Ok(match options.scanner {
        None => {
            let chosen = match (recording, sensor) {
                (Some(recording), Some(sensor)) => Some(recording.of(sensor)?),
                (recording, _) => recording.cloned(),
            };
            if let Some(other) = chosen.as_ref().filter(|chosen| !chosen.contents().is_lms()) {
                let message = format!(
                    "{} is not a recording of an LMS, which --family selects",
                    other.path().display()
                );
                let hint = "set --family to the family of the scanner in the recording";
                return Err(Failure::new(Kind::Input, message, hint));
            }
            let (settings, source) = lms(options, chosen.as_ref(), seed, room)?;
            Box::new(LmsSimulator::new(settings, source))
        }
        Some(Scanner::Ld(model)) => {
            let settings = LdSettings { chunk, boot_ns, seed, ..LdSettings::of(model) };
            Box::new(match &options.replay {
                Some(path) => {
                    LdSimulator::repeating(settings, recorded_packets(path, sensor)?, options.looped)
                }
                None => LdSimulator::new(settings, room()),
            })
        }
        Some(Scanner::Rplidar { model, mode }) => {
            let faults = options.faults;
            let settings = RplidarSettings {
                id: if faults.id > 0.0 { faults.id as u8 } else { model.id() },
                typical: mode,
                start: match &options.state {
                    StartState::PowerOn => RplidarStart::PowerOn,
                    StartState::Operating(operating) if operating.streams() => RplidarStart::Streaming,
                    StartState::Operating(_) => RplidarStart::Idle,
                },
                health: (faults.health as u8, u16::from(faults.health > 0.0)),
                keeps_health: faults.stubborn > 0.0,
                quirks: faults.quirks(),
                faults,
                chunk,
                boot_ns,
                seed,
                ..RplidarSettings::of(model)
            };
            Box::new(RplidarSimulator::new(settings, room()))
        }
    })
}

/// Returns the settings of an LMS and the source of its measured values. Each setting is that of the option, or if
/// there is none, that of the recording, or otherwise the factory setting.
fn lms(
    options: &SimulateOptions,
    recording: Option<&Recording>,
    seed: u64,
    room: impl FnOnce() -> Room,
) -> Result<(Settings, ScanSource), Failure> {
    let contents = recording.map(Recording::contents);
    let factory = options.family.factory_variant().unwrap_or(Variant::HALF);
    let variant = options.variant.or(contents.and_then(|c| c.variant)).unwrap_or(factory);
    let unit = options.unit.or(contents.and_then(|c| c.unit)).unwrap_or(options.family.factory_unit());
    let mode = options.mode.or(contents.and_then(|c| c.mode)).unwrap_or(Mode(0x01));
    let settings = Settings {
        address: options.address,
        type_name: type_name(options.family),
        baud: options.baud.or(options.permanent_baud).unwrap_or(Baud::B9600),
        permanent_baud: options.permanent_baud,
        variant,
        unit,
        mode,
        availability: if options.indices { 2 } else { 0 },
        configuration_len: if options.short_configuration { 32 } else { 34 },
        start: options.state.clone(),
        boot_ns: options.boot.as_nanos() as Nanos,
        status: options.status,
        errors: options.errors.clone(),
        pollution_percent: options.pollution,
        quirks: options.faults.quirks(),
        chunk: options.chunk,
        speed: options.speed,
        seed,
    };
    let source = match recording {
        None => ScanSource::Room(room()),
        Some(recording) => {
            let telegrams = scans(recording, Encoding { unit, mode }, options.looped)?;
            ScanSource::Recorded { variant, telegrams }
        }
    };
    Ok((settings, source))
}

/// Returns the scans of `recording`, once or in a loop.
fn scans(
    recording: &Recording,
    encoding: Encoding,
    looped: bool,
) -> Result<Box<dyn Iterator<Item = Vec<u8>> + Send>, Failure> {
    if recording.contents().scans == 0 {
        return Err(Failure::new(
            Kind::Configuration,
            format!("recording {} contains no scan", recording.path().display()),
            "replay one with measured-value telegrams (B0h), or a CARMEN log with scans",
        ));
    }
    let recording = recording.clone();
    let mut telegrams = recording.telegrams(encoding)?;
    Ok(Box::new(std::iter::from_fn(move || {
        if let Some(frame) = telegrams.find(Frame::is_scan) {
            return Some(frame.telegram);
        }
        if !looped {
            return None;
        }
        telegrams = recording.telegrams(encoding).ok()?;
        telegrams.find(Frame::is_scan).map(|frame| frame.telegram)
    })))
}

/// A scanner on its line, and the thread that runs them.
struct PortThread<'a> {
    /// Index of the port.
    pub(crate) number: usize,
    /// Name of the port: as the user gave it, or the address of a server.
    pub(crate) port: PathBuf,
    /// The port that a host opens; `None` while the adapter is unplugged.
    sim_port: Option<SimPort>,
    pub(crate) machine: Box<dyn Device + Send>,
    pub(crate) line: LineModel,
    pub(crate) time: ScaledClock,
    /// Receives each telegram that was sent.
    pub(crate) on_record: &'a (dyn Fn(&Record) -> Result<(), Failure> + Sync),
    /// Returns the next event for this port.
    pub(crate) event: &'a (dyn Fn(&Path) -> Option<Event> + Sync),
    /// Encoder of the scanner's mount, if it has one.
    pub(crate) encoder: Option<Encoder>,
    /// Receives the reports of the encoder, with times of the kernel's clock.
    on_report: &'a (dyn Fn(usize, Report) + Sync),
    /// Whether bytes wait while the host's buffer is full. Otherwise the bytes are lost, as in a UART that no program
    /// reads.
    pub(crate) lossless: bool,
    /// Whether a host has the port open.
    is_open: bool,
    /// First fault of the current telegram.
    fault: Option<Fault>,
    /// Receiver that is used while the rate of the host's port differs from the rate of the line.
    mismatch: BaudMismatch,
    /// Number of telegrams that were sent.
    sent: u64,
    /// Bytes that wait for room in the host's buffer. Bytes wait only on a lossless line.
    unsent: Vec<u8>,
}

/// An event that a test causes while a scanner runs.
#[derive(Clone, Debug)]
pub enum Event {
    /// The power goes off and on.
    PowerCycle,
    /// The host's adapter is unplugged for this time in nanoseconds. Afterwards, the port is another terminal with the
    /// same name.
    Unplug(Nanos),
    /// The line has these faults from now on, with random numbers of this seed. The times in the faults are counted
    /// from now.
    Faults(Box<Faults>, u64),
}

/// Clock of the scanner. It starts at 0, and is `speed` times as fast as the kernel's clock.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ScaledClock {
    zero_ns: Nanos,
    pub(crate) speed: f64,
}

impl ScaledClock {
    fn of_machine(self, clock_ns: Nanos) -> Nanos {
        (clock_ns.saturating_sub(self.zero_ns) as f64 * self.speed) as Nanos
    }

    fn of_clock(self, machine_ns: Nanos) -> Nanos {
        // Add a nanosecond, because the conversion rounds down. At the returned time, the scanner's clock must have
        // reached `machine_ns`.
        self.zero_ns + (machine_ns as f64 / self.speed) as Nanos + 1
    }
}

impl PortThread<'_> {
    /// Runs until one of `stops` is readable.
    pub(crate) fn run(mut self, stops: [BorrowedFd<'_>; 2]) -> Result<Summary, Failure> {
        let mut buffer = [0; 64];
        // Last time by the kernel's clock at which the host had written nothing.
        let mut quiet_ns = now_ns();
        loop {
            let read_ns = now_ns();
            let count = self.read_host(&mut buffer)?;
            let now_ns = now_ns();
            self.limit_lag(now_ns);
            let machine_ns = self.time.of_machine(now_ns);
            while let Some(event) = (self.event)(&self.port) {
                self.handle_event(event, machine_ns);
            }
            while let Some(report) = self.encoder.as_mut().and_then(|encoder| encoder.poll(machine_ns)) {
                let [stamp_ns, arrives_ns] =
                    [report.stamp_ns, report.arrival_ns].map(|at| self.time.of_clock(at));
                let rate_rad_s = report.rate_rad_s * self.time.speed;
                (self.on_report)(
                    self.number,
                    Report { stamp_ns, arrival_ns: arrives_ns, rate_rad_s, ..report },
                );
            }
            while let Some(delivery) = self.line.poll_transmit(&mut *self.machine, machine_ns) {
                self.deliver(delivery)?;
            }
            if self.wait_for_room(stops)? == WaitResult::Stop {
                return Ok(self.summary());
            }
            if count > 0 && self.is_tuned() {
                let arrival = Arrival {
                    not_before: self.time.of_machine(quiet_ns.saturating_sub(PTY_DELAY_NS)),
                    not_after: self.time.of_machine(now_ns),
                };
                for &byte in &buffer[..count] {
                    self.line.receive(&mut *self.machine, byte, arrival);
                    if let Some(dropped) = self.machine.take_dropped() {
                        tracing::warn!("{}: {dropped}", self.port.display());
                    }
                }
            }
            if count == 0 {
                quiet_ns = read_ns;
            }
            if self.line.is_plugged() != self.sim_port.is_some() {
                self.sim_port = None;
                self.is_open = false;
                self.sim_port = self.line.is_plugged().then(|| SimPort::new(&self.port)).transpose()?;
            }
            let due = self.line.poll_timeout(&*self.machine, machine_ns);
            let due = due.into_iter().chain(self.encoder.as_ref().map(Encoder::poll_timeout)).min();
            let due_ns = due.map_or(Nanos::MAX, |at| self.time.of_clock(at));
            let poll_ns = if self.sim_port.is_some() { now_ns + POLL_INTERVAL_NS } else { Nanos::MAX };
            let watched = self.sim_port.as_ref().and_then(|sim_port| sim_port.wait_fd(self.is_open));
            if wait(stops, watched, due_ns.min(poll_ns)) == WaitResult::Stop {
                return Ok(self.summary());
            }
        }
    }

    fn summary(self) -> Summary {
        Summary { eeprom_writes: self.machine.eeprom_writes(), port: self.port, sent: self.sent }
    }

    /// Waits until the bytes in `unsent` fit into the host's buffer, or until the host has closed its side. The clock
    /// of the scanner stops during the wait.
    fn wait_for_room(&mut self, stops: [BorrowedFd<'_>; 2]) -> Result<WaitResult, Failure> {
        let begun_ns = now_ns();
        while !self.unsent.is_empty() {
            let Some(sim_port) = self.sim_port.as_mut().filter(|_| self.is_open) else { break };
            let written = sim_port.write(&self.unsent)?;
            self.unsent.drain(..written);
            if self.unsent.is_empty() {
                break;
            }
            if wait(stops, None, now_ns() + ROOM_CHECK_INTERVAL_NS) == WaitResult::Stop {
                return Ok(WaitResult::Stop);
            }
            self.is_open = sim_port.is_open(true);
        }
        self.unsent.clear();
        self.time.zero_ns += now_ns() - begun_ns;
        Ok(WaitResult::Line)
    }

    /// Carries out an event.
    fn handle_event(&mut self, event: Event, machine_ns: Nanos) {
        match event {
            Event::PowerCycle => self.line.cycle_power(&mut *self.machine, machine_ns),
            Event::Unplug(span_ns) => self.line.unplug(machine_ns, span_ns),
            Event::Faults(mut faults, seed) => {
                let now_s = machine_ns as f64 / 1e9;
                let times = [&mut faults.silence_at, &mut faults.stall_at, &mut faults.power_at];
                times.into_iter().filter(|at| **at > 0.0).for_each(|at| *at += now_s);
                self.line.set_faults(&faults, seed);
            }
        }
    }

    /// Checks whether a host has the port open, and reads the bytes that it has written.
    fn read_host(&mut self, buffer: &mut [u8]) -> Result<usize, Failure> {
        let Some(sim_port) = &mut self.sim_port else { return Ok(0) };
        self.is_open = sim_port.is_open(self.is_open);
        sim_port.read(buffer)
    }

    /// Returns whether the host's port has the rate of the scanner.
    fn is_tuned(&self) -> bool {
        let rate = self.sim_port.as_ref().and_then(SimPort::rate);
        rate.is_none_or(|rate| same_rate(rate, self.machine.rate()))
    }

    /// Sets the clock of the scanner back if this thread is late by more than [`MAX_LAG_NS`]. Otherwise the line would
    /// deliver more bytes at once than it can carry.
    fn limit_lag(&mut self, now_ns: Nanos) {
        let machine_ns = self.time.of_machine(now_ns);
        let Some(due_ns) = self.line.poll_timeout(&*self.machine, machine_ns) else { return };
        let latest_ns = self.time.of_clock(due_ns + MAX_LAG_NS);
        self.time.zero_ns += now_ns.saturating_sub(latest_ns);
    }

    /// Writes bytes to the host. If a telegram ends with these bytes, reports the telegram.
    fn deliver(&mut self, delivery: Delivery) -> Result<(), Failure> {
        let is_telegram = delivery.is_telegram();
        let Delivery { mut bytes, rate, idle_after, part, mut fault } = delivery;
        match self.sim_port.as_mut().filter(|_| self.is_open) {
            Some(sim_port) => {
                let rates = (rate, sim_port.rate().unwrap_or(rate));
                if same_rate(rates.1, rates.0) {
                    self.mismatch.reset();
                } else {
                    fault = fault.or(Some(Fault::Baud));
                    bytes = self.mismatch.receive(rates, &bytes, idle_after);
                }
                if self.lossless {
                    self.unsent.append(&mut bytes);
                    let written = sim_port.write(&self.unsent)?;
                    self.unsent.drain(..written);
                } else if sim_port.write(&bytes)? < bytes.len() {
                    fault = fault.or(Some(Fault::Overrun));
                }
            }
            None => fault = fault.or(Some(Fault::Unread)),
        }
        // Read the clock before computing the hash. The hash takes longer than a host needs to wake for the last byte.
        let sent_ns = now_ns();
        if is_telegram {
            self.fault = self.fault.or(fault);
        }
        if let Some(ChunkKind::End(sent)) = part {
            (self.on_record)(&Record {
                port: self.port.clone(),
                index: self.sent,
                is_reply: sent.is_reply,
                length: sent.telegram.len(),
                sha256: Record::hash(&sent.telegram),
                sent_ns,
                fault: self.fault.take(),
            })?;
            self.sent += 1;
        }
        Ok(())
    }
}

/// Returns whether a UART at `a` bits per second can read bytes that were sent at `b` bits per second. The rates may
/// differ by 3 %.
fn same_rate(a: u32, b: u32) -> bool {
    u64::from(a.abs_diff(b)) * 100 <= 3 * u64::from(b)
}

/// A telegram that a scanner sent.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Record {
    /// Name of the port.
    pub port: PathBuf,
    /// Index of the telegram on this port. Data and replies are counted together.
    pub index: u64,
    /// Whether the telegram is a reply. Otherwise it is data of the stream.
    pub is_reply: bool,
    /// Length of the intact telegram in bytes.
    pub length: usize,
    /// SHA-256 of the intact telegram.
    pub sha256: [u8; 32],
    /// CLOCK_MONOTONIC after the last byte of the telegram was written, in nanoseconds.
    pub sent_ns: u64,
    /// First fault that damaged the telegram; `None` if it arrived intact.
    pub fault: Option<Fault>,
}

impl Record {
    /// Returns the SHA-256 of `telegram`.
    pub fn hash(telegram: &[u8]) -> [u8; 32] {
        Sha256::digest(telegram).into()
    }

    /// Returns the line of JSON for the truth file, without the line end. The keys have the documented order.
    pub fn line(&self) -> String {
        let port = json!(self.port.to_string_lossy());
        let kind = if self.is_reply { "reply" } else { "data" };
        let sha256 = self.sha256.map(|byte| format!("{byte:02x}")).concat();
        let fault = json!(self.fault.map(Fault::name));
        let Record { index, length, sent_ns, .. } = self;
        format!(
            r#"{{"class":"truth","port":{port},"index":{index},"kind":"{kind}","length":{length},"sha256":"{sha256}","sent_ns":{sent_ns},"fault":{fault}}}"#
        )
    }
}

/// Totals of a port.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Summary {
    /// Name of the port.
    pub port: PathBuf,
    /// Number of telegrams that were sent, including those with a fault.
    pub sent: u64,
    /// Number of requests to write the EEPROM of the scanner, executed or refused.
    pub eeprom_writes: u64,
}

impl Summary {
    /// Returns the line of JSON for the truth file, without the line end.
    pub fn line(&self) -> String {
        let port = json!(self.port.to_string_lossy());
        let Summary { sent, eeprom_writes, .. } = self;
        format!(r#"{{"class":"simulated","port":{port},"sent":{sent},"eeprom_writes":{eeprom_writes}}}"#)
    }
}

/// The truth file, to which the threads of all ports write. Each line is written at once.
#[derive(Debug)]
pub struct Truth {
    path: PathBuf,
    /// The file; `None` for stdout.
    file: Option<Mutex<File>>,
}

impl Truth {
    /// Creates the file at `path`. Replaces an existing file if `force` is set. The path `-` selects stdout.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`Target::create_new`].
    pub fn create(path: &Path, force: bool) -> Result<Self, Failure> {
        let is_stdout = path == Path::new("-");
        let file =
            if is_stdout { None } else { Some(Target::open(path)?.create_new(force, output::PUBLIC_MODE)?) };
        Ok(Truth { path: path.to_owned(), file: file.map(Mutex::new) })
    }

    /// Appends `line`.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Failed`] if the line cannot be written.
    pub fn write(&self, line: &str) -> Result<(), Failure> {
        let line = format!("{line}\n");
        let written = match &self.file {
            // If a thread panicked while it held the lock, it has written its whole line or nothing. In both cases, the
            // next line is intact, so ignore that the lock is poisoned.
            Some(file) => {
                file.lock().unwrap_or_else(std::sync::PoisonError::into_inner).write_all(line.as_bytes())
            }
            None => {
                let mut stdout = io::stdout().lock();
                stdout.write_all(line.as_bytes()).and_then(|()| stdout.flush())
            }
        };
        written.map_err(|error| failure(&self.path, &error))
    }
}

fn failure(path: &Path, error: &io::Error) -> Failure {
    let what = format!("cannot write the truth to {}: {error}", path.display());
    Failure::new(Kind::Failed, what, "free space on the disk, and keep the reader of stdout running")
}

/// Maximum time by which the thread of a port may be late, by the scanner's clock. In this time, an LMS sends 5 kB at
/// its highest rate, a quarter of the buffer of a pty.
const MAX_LAG_NS: Nanos = 100 * MILLIS;
/// Maximum time from a host's write to a pty until the simulator can read the byte. It is not 0, because a worker
/// thread of the kernel transfers the byte.
const PTY_DELAY_NS: Nanos = 2 * MILLIS;
/// Interval at which a lossless line checks for room in the host's buffer.
const ROOM_CHECK_INTERVAL_NS: Nanos = MILLIS;
/// Interval between polls of the port. The port must be polled, because no event reports that a host has opened it. The
/// interval also limits the uncertainty of the time at which a byte arrived. At 9600, the rate with which every host
/// starts, the interval is so short that a strict scanner detects every request that was written without gaps.
const POLL_INTERVAL_NS: Nanos = 4 * MILLIS;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn truth_and_summary_lines_follow_the_contract() {
        let record = Record {
            port: "/tmp/a".into(),
            index: 3,
            is_reply: false,
            length: 3,
            sha256: Record::hash(b"abc"),
            sent_ns: 12_345_678_901_234,
            fault: None,
        };
        let value: serde_json::Value = serde_json::from_str(&record.line()).unwrap();
        assert_eq!(
            value,
            json!({
                "class": "truth", "port": "/tmp/a", "index": 3, "kind": "data", "length": 3,
                "sha256": "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad",
                "sent_ns": 12_345_678_901_234u64, "fault": null,
            })
        );
        let reply = Record { is_reply: true, fault: Some(Fault::Unread), ..record }.line();
        assert!(reply.contains(r#""kind":"reply""#) && reply.contains(r#""fault":"unread""#));
        let summary = Summary { port: "/tmp/a".into(), sent: 7, eeprom_writes: 0 }.line();
        assert!(summary.contains(r#""class":"simulated""#) && summary.contains(r#""sent":7"#));
    }
}
