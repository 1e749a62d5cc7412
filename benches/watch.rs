//! What does the picture in the terminal cost while two sensors stream, how soon does it show a scan, and what does a line
//! have to carry? `scanhub watch` on terminals of two sizes that the bench reads as fast as they are written. It does not tell
//! what a terminal makes of it.

mod support;

use std::ffi::OsStr;
use std::fs::File;
use std::io::Read;
use std::os::fd::OwnedFd;
use std::os::unix::ffi::OsStrExt;
use std::process::{Command, ExitCode, Stdio};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::Duration;

use rustix::fs::{Mode, OFlags};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{Winsize, tcsetwinsize};
use schema::Scan;
use support::child::Guard;
use support::figures::{self, Figure, Target, percentile};
use support::options::Options;
use support::stage::{PATIENCE, SENSORS, Stage};
use support::work::Work;
use support::{Outcome, clock, consumer};

fn main() -> ExitCode {
    support::main(measure)
}

fn measure(options: &Options) -> Outcome<()> {
    let stage = Stage::new()?;
    let _simulator = stage.simulate(&SENSORS, 500_000)?;
    let hub = stage.hub(&SENSORS)?;
    hub.await_line("ready", PATIENCE)?;
    let span = Duration::from_secs(options.seconds(20));
    let (mut small, mut large) = (Series::default(), Series::default());
    for _ in 0..options.pairs() {
        small.push(&look(&stage, SMALL, span)?, span);
        large.push(&look(&stage, LARGE, span)?, span);
    }
    let figure = |name, unit, hub, target| Figure { name, unit, hub, floor: Vec::new(), target };
    let figures = [
        figure("80 x 30: processor time", "%", small.percent, Target::Most(3.0)),
        figure("80 x 30: bytes on the line", "kB/s", small.kilobytes, Target::Most(100.0)),
        figure("80 x 30: frames", "1/s", small.frames, Target::None),
        figure("80 x 30: scan to screen, median", "ms", small.median_ms, Target::None),
        figure("80 x 30: scan to screen, p99", "ms", small.p99_ms, Target::Most(50.0)),
        figure("200 x 60: processor time", "%", large.percent, Target::Most(3.0)),
        figure("200 x 60: bytes on the line", "kB/s", large.kilobytes, Target::Most(100.0)),
        figure("200 x 60: frames", "1/s", large.frames, Target::None),
        figure("200 x 60: scan to screen, median", "ms", large.median_ms, Target::None),
        figure("200 x 60: scan to screen, p99", "ms", large.p99_ms, Target::Most(50.0)),
    ];
    figures::print("watch", options.json, &figures);
    Ok(())
}

/// One run.
struct Seen {
    busy_ns: u64,
    /// Sorted.
    delays_ms: Vec<f64>,
    frames: usize,
    bytes: usize,
}

/// The figures of all runs, in their order.
#[derive(Default)]
struct Series {
    percent: Vec<f64>,
    kilobytes: Vec<f64>,
    frames: Vec<f64>,
    median_ms: Vec<f64>,
    p99_ms: Vec<f64>,
}

impl Series {
    fn push(&mut self, seen: &Seen, span: Duration) {
        let seconds = span.as_secs_f64();
        self.percent.push(100.0 * seen.busy_ns as f64 / 1e9 / seconds);
        self.kilobytes.push(seen.bytes as f64 / 1e3 / seconds);
        self.frames.push(seen.frames as f64 / seconds);
        self.median_ms.extend(percentile(&seen.delays_ms, 0.5));
        self.p99_ms.extend(percentile(&seen.delays_ms, 0.99));
    }
}

/// A frame: when the last of it was read, in ns of CLOCK_MONOTONIC, and how many bytes it had.
struct Frame {
    until_ns: u64,
    bytes: usize,
}

/// Watches on a terminal of `size` for `span`.
fn look(stage: &Stage, size: (u16, u16), span: Duration) -> Outcome<Seen> {
    let (keys, screen) = terminal(size)?;
    let end = || -> Outcome<Stdio> { Ok(Stdio::from(screen.try_clone()?)) };
    // A session of its own, whose terminal that is.
    let mut command = Command::new("setsid");
    command.args(["-c", env!("CARGO_BIN_EXE_scanhub"), "watch", "--domain", stage.domain.name()]);
    command.env("TERM", "xterm").env("SCANHUB_END_WITH_PARENT", "1");
    let watch = Guard::new(command.stdin(end()?).stdout(end()?).stderr(end()?).spawn()?);
    drop((command, screen));
    let frames = Arc::new(Mutex::new(Vec::new()));
    let to = frames.clone();
    thread::spawn(move || read(keys, &to));
    let mut scans = consumer::subscribe::<Scan>(stage.domain.name(), SENSORS[0])?.timeout(PATIENCE);
    let begin = clock::now() + SETTLING.as_nanos() as u64;
    while clock::now() < begin {
        scans.next()?.ok_or("no scan")?;
    }
    let before = Work::of(watch.pid(), |_| true)?;
    let (mut sent, from, to) = (Vec::new(), clock::now(), clock::now() + span.as_nanos() as u64);
    while clock::now() < to {
        sent.push(scans.next()?.ok_or("no scan")?.header().stamp_last_ns);
    }
    let work = Work::of(watch.pid(), |_| true)?.since(before);
    // The last scans are shown, too.
    thread::sleep(SETTLING / 4);
    drop(watch);
    let frames = frames.lock().map_err(|_| "the reader panicked")?;
    let shown = |stamp_ns: &u64| {
        let frame = frames.iter().find(|frame| frame.until_ns > *stamp_ns)?;
        Some((frame.until_ns - stamp_ns) as f64 / 1e6)
    };
    let mut delays_ms: Vec<f64> = sent.iter().filter_map(shown).collect();
    delays_ms.sort_by(f64::total_cmp);
    let within = || frames.iter().filter(|frame| (from..to).contains(&frame.until_ns));
    let (count, bytes) = (within().count(), within().map(|frame| frame.bytes).sum());
    Ok(Seen { busy_ns: work.busy_ns, delays_ms, frames: count, bytes })
}

/// Reads frames until the terminal is closed. A frame that is longer than what is read at once comes in pieces.
fn read(mut terminal: File, frames: &Mutex<Vec<Frame>>) {
    let mut piece = [0; 65536];
    while let Ok(bytes @ 1..) = terminal.read(&mut piece) {
        let now = clock::now();
        let Ok(mut frames) = frames.lock() else { return };
        match frames.last_mut() {
            Some(frame) if now - frame.until_ns < APART_NS => {
                (frame.until_ns, frame.bytes) = (now, frame.bytes + bytes);
            }
            _ => frames.push(Frame { until_ns: now, bytes }),
        }
    }
}

/// The two sides of a terminal of `size`, columns and rows.
fn terminal((columns, rows): (u16, u16)) -> Outcome<(File, OwnedFd)> {
    let keys = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC)?;
    grantpt(&keys)?;
    unlockpt(&keys)?;
    let name = ptsname(&keys, Vec::new())?;
    let flags = OFlags::RDWR | OFlags::NOCTTY | OFlags::CLOEXEC;
    let screen = rustix::fs::open(OsStr::from_bytes(name.as_bytes()), flags, Mode::empty())?;
    tcsetwinsize(&screen, Winsize { ws_col: columns, ws_row: rows, ws_xpixel: 0, ws_ypixel: 0 })?;
    Ok((keys.into(), screen))
}

/// A usual window, and a large one.
const SMALL: (u16, u16) = (80, 30);
const LARGE: (u16, u16) = (200, 60);
/// Until the sensors stream and the picture has its place.
const SETTLING: Duration = Duration::from_secs(4);
/// Frames are at least 45 ms apart.
const APART_NS: u64 = 10_000_000;
