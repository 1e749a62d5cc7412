//! The verb `simulate`: sensors on ptys or TCP servers until it is stopped. Builds them from the options, gives each a thread, and writes
//! the truth. Refuses to print and to handle signals: the program does.

use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::path::{Path, PathBuf};

use recording::{Encoding, Frame, Recording};
use rustix::event::{EventfdFlags, eventfd};
use scanhub_drivers::lms::variant::{Baud, Mode, Variant};
use schema::{Failure, Family, Kind, Nanos};

use crate::device::Device;
use crate::ld::{Head, HeadSettings, Packets, recorded};
use crate::line::{Event, Line, Time};
use crate::machine::{Machine, Settings, Start};
use crate::mount::{Encoder, Report};
use crate::operating::Operating;
use crate::options::{Scanner, SimulateOptions, type_name};
use crate::pty::now_ns;
use crate::room::Room;
use crate::rplidar::{Unit, UnitSettings, UnitStart};
use crate::socket::{self, Socket};
use crate::source::Source;
use crate::truth::{Record, Summary, Truth};
use crate::wire::Wire;

/// A port that is ready to be opened.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Ready {
    /// The symlink as the user named it; of a TCP server `tcp:HOST:PORT`, which a hub opens.
    pub port: PathBuf,
    /// The pty behind it, if it is one.
    pub pty: Option<PathBuf>,
}

/// Simulates the sensors of `options` until `stop` is readable, and returns what each port sent. `on_ready` is called once
/// all ports exist, `tell` with each telegram sent, from the port's thread and at its pace. The symlinks are removed when
/// this returns.
pub fn simulate(
    options: &SimulateOptions,
    stop: impl AsFd,
    on_ready: impl FnOnce(&[Ready]),
    tell: impl Fn(&Record) + Sync,
) -> Result<Vec<Summary>, Failure> {
    simulate_with(options, stop, on_ready, tell, |_| None, |_, _| {})
}

/// As [`simulate()`]; `event` is asked again and again, from the thread of each port, what is done to that sensor now, and
/// `say` is called with the number of a port and what the encoder of its mount says, in times of the clock.
pub fn simulate_with(
    options: &SimulateOptions,
    stop: impl AsFd,
    on_ready: impl FnOnce(&[Ready]),
    tell: impl Fn(&Record) + Sync,
    event: impl Fn(&Path) -> Option<Event> + Sync,
    say: impl Fn(usize, Report) + Sync,
) -> Result<Vec<Summary>, Failure> {
    check(options)?;
    let recording = options.replay.as_ref().filter(|_| options.scanner.is_none());
    // The ports are LMS, so the bytes of a stream file are theirs.
    let recording = recording.map(|path| Recording::open_as(path, Some(Family::Lms))).transpose()?;
    let truth = options.truth.as_deref().map(|path| Truth::create(path, options.force)).transpose()?;
    let tell = |record: &Record| {
        tell(record);
        truth.as_ref().map_or(Ok(()), |truth| truth.write(&record.line()))
    };
    let mut ready = Vec::new();
    let mut lines = Vec::new();
    let time = Time { zero_ns: now_ns(), speed: options.speed };
    for (number, port) in options.ports.iter().enumerate() {
        let seed = options.seed.wrapping_add(number as u64);
        let machine = device(options, recording.as_ref(), number)?;
        let socket = Socket::new(port)?;
        let port = socket.found(port);
        ready.push(Ready { port: port.clone(), pty: socket.pty().map(Path::to_owned) });
        let wire = Wire::new(&options.faults, seed);
        let socket = Some(socket);
        let encoder = options.world.mount(number % options.world.sensors()).cloned().map(Encoder::new);
        lines.push(Line {
            number,
            port,
            socket,
            machine,
            wire,
            time,
            tell: &tell,
            event: &event,
            encoder,
            say: &say,
            lossless: options.lossless,
        });
    }
    on_ready(&ready);
    let summaries = run(lines, stop.as_fd())?;
    if let Some(truth) = &truth {
        for summary in &summaries {
            truth.write(&summary.line())?;
        }
    }
    Ok(summaries)
}

/// Runs each line in a thread of its own; if one fails, the others end too.
fn run(lines: Vec<Line<'_>>, stop: BorrowedFd<'_>) -> Result<Vec<Summary>, Failure> {
    let failed: OwnedFd = eventfd(0, EventfdFlags::CLOEXEC)
        .map_err(|errno| Failure::new(Kind::Short, format!("cannot make an eventfd: {errno}"), ""))?;
    std::thread::scope(|scope| {
        let threads: Vec<_> = lines
            .into_iter()
            .map(|line| {
                let failed = &failed;
                scope.spawn(move || {
                    let outcome = line.run([stop, failed.as_fd()]);
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

/// The sensor of the port with this number.
fn device(
    options: &SimulateOptions,
    recording: Option<&Recording>,
    number: usize,
) -> Result<Box<dyn Device + Send>, Failure> {
    let room = || Room::of_port(&options.world, options.seed, number as u64);
    let (chunk, boot_ns) = (options.chunk, options.boot.as_nanos() as Nanos);
    let seed = options.seed.wrapping_add(number as u64);
    Ok(match options.scanner {
        None => {
            let chosen = chosen(options, recording, number)?;
            if let Some(other) = chosen.as_ref().filter(|chosen| !chosen.contents().is_lms()) {
                let message = format!("{} is not of an LMS, which is simulated", other.path().display());
                let hint = "--family says of which scanner it is";
                return Err(Failure::new(Kind::Input, message, hint));
            }
            let (settings, source) = sensor(options, chosen.as_ref(), number)?;
            Box::new(Machine::new(settings, source))
        }
        Some(Scanner::Ld(model)) => {
            let sensor = options.sensors.get(number).or(options.sensors.last()).map(String::as_str);
            let packets = match &options.replay {
                Some(path) => Packets::Recorded { packets: recorded(path, sensor)?, looped: options.looped },
                None => Packets::Room(Box::new(room())),
            };
            Box::new(Head::new(HeadSettings { chunk, boot_ns, seed, ..HeadSettings::of(model) }, packets))
        }
        Some(Scanner::Rplidar { model, mode }) => {
            let faults = options.faults;
            let settings = UnitSettings {
                id: if faults.id > 0.0 { faults.id as u8 } else { model.id() },
                typical: mode,
                start: match &options.state {
                    Start::PowerOn => UnitStart::PowerOn,
                    Start::In(operating) if operating.streams() => UnitStart::Streaming,
                    Start::In(_) => UnitStart::Idle,
                },
                health: (faults.health as u8, u16::from(faults.health > 0.0)),
                stubborn: faults.stubborn > 0.0,
                habits: faults.habits(),
                faults,
                chunk,
                boot_ns,
                seed,
                ..UnitSettings::of(model)
            };
            Box::new(Unit::new(settings, room()))
        }
    })
}

/// The recording that the port with this number plays: of several sensors the one that was named for it.
fn chosen(
    options: &SimulateOptions,
    recording: Option<&Recording>,
    number: usize,
) -> Result<Option<Recording>, Failure> {
    let sensor = options.sensors.get(number).or(options.sensors.last());
    let chosen =
        recording.map(|recording| sensor.map_or(Ok(recording.clone()), |sensor| recording.of(sensor)));
    chosen.transpose()
}

/// A sensor as the flags, else the recording, else the factory have it, and what it sends.
fn sensor(
    options: &SimulateOptions,
    recording: Option<&Recording>,
    number: usize,
) -> Result<(Settings, Source), Failure> {
    let seed = options.seed.wrapping_add(number as u64);
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
        habits: options.faults.habits(),
        chunk: options.chunk,
        speed: options.speed,
        seed,
    };
    let source = match recording {
        None => Source::Room(Room::of_port(&options.world, options.seed, number as u64)),
        Some(recording) => {
            let telegrams = scans(recording, Encoding { unit, mode }, options.looped)?;
            Source::Recorded { variant, telegrams }
        }
    };
    Ok((settings, source))
}

/// The scans of `recording`, once or again and again.
fn scans(
    recording: &Recording,
    encoding: Encoding,
    looped: bool,
) -> Result<Box<dyn Iterator<Item = Vec<u8>> + Send>, Failure> {
    if recording.contents().scans == 0 {
        return Err(Failure::new(
            Kind::Configuration,
            format!("recording {} holds no scan", recording.path().display()),
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

fn check(options: &SimulateOptions) -> Result<(), Failure> {
    let wrong = |message: String, hint: &str| Err(Failure::new(Kind::Configuration, message, hint));
    if options.ports.is_empty() {
        return wrong("no port to simulate".into(), "name one with --port PATH or --tcp HOST:PORT");
    }
    for (number, port) in options.ports.iter().enumerate() {
        let is_any = socket::server(port).is_some_and(|address| address.ends_with(":0"));
        if options.ports[..number].contains(port) && !is_any {
            return wrong(
                format!("port {} is named twice", port.display()),
                "each sensor needs its own path",
            );
        }
    }
    if !(0.01..=100.0).contains(&options.speed) {
        return wrong(format!("speed {} is out of range", options.speed), "a number from 0.01 to 100");
    }
    if options.address > 127 {
        return wrong(format!("address {} is out of range", options.address), "a number from 0 to 127");
    }
    if options.pollution > 100 {
        return wrong(format!("pollution {} is out of range", options.pollution), "percent, 0 to 100");
    }
    if let Some(scanner) = options.scanner {
        let talks = matches!(scanner, Scanner::Rplidar { .. });
        let states = [Start::In(Operating::OnRequest), Start::In(Operating::All), Start::PowerOn];
        let lms = [
            ("baud", options.baud.is_some() || options.permanent_baud.is_some()),
            ("variant", options.variant.is_some()),
            ("unit", options.unit.is_some()),
            ("mode by number", options.mode.is_some()),
            ("state", options.state != states[0] && !(talks && states.contains(&options.state))),
            ("sensor", !options.sensors.is_empty() && talks),
            ("type", options.family != SimulateOptions::default().family),
            ("address", options.address != 0),
            ("pollution", options.pollution != 100),
            ("status byte", options.status != SimulateOptions::default().status),
            ("error", !options.errors.is_empty()),
            ("indices", options.indices || options.short_configuration),
            ("recording", options.replay.is_some() && talks),
        ];
        if let Some((name, _)) = lms.into_iter().find(|(_, is_said)| *is_said) {
            let message = format!("a scanner {} has no {name} to choose", scanner.name());
            let hint = match name {
                "state" if talks => "use idle, streaming or starting, or --family lms",
                _ => "leave it out, or use --family lms",
            };
            return wrong(message, hint);
        }
    }
    if let (Some(variant), family) = (options.variant, options.family)
        && let Some(reason) = family.refuses_variant(variant)
    {
        let Variant { angle_deg, resolution_cdeg } = variant;
        let message =
            format!("an {} cannot scan {angle_deg}/{}", family.name(), f64::from(resolution_cdeg) / 100.0);
        return wrong(message, reason);
    }
    let tells_all = |start: &Start| match start {
        Start::In(operating) => *operating == Operating::All || !operating.streams(),
        Start::PowerOn => true,
    };
    if options.replay.is_some() && !tells_all(&options.state) {
        return wrong(
            "a recording is sent in whole scans only".into(),
            "leave --state out, or use idle, streaming, installation or starting",
        );
    }
    if !options.sensors.is_empty() && options.replay.is_none() {
        return wrong("--sensor without a recording".into(), "name one with --replay FILE");
    }
    if options.sensors.len() > 1 && options.sensors.len() != options.ports.len() {
        let message = format!("{} sensors for {} ports", options.sensors.len(), options.ports.len());
        return wrong(message, "name one --sensor for all ports, or one for each");
    }
    if options.looped && options.replay.is_none() {
        return wrong("--loop without a recording".into(), "name one with --replay FILE");
    }
    Ok(())
}
