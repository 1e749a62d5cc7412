//! What does a pulled plug cost? A pty that plays a streaming sensor is taken away under a running hub and comes back
//! under its name, every other time with another number, twenty times in all: how long until the hub says that the port
//! is absent, how long until a consumer has a telegram again, and what the hub costs meanwhile. It does not tell how long
//! the kernel takes to notice an adapter, nor udev to name it. The same for scanners whose heads turn, and what it takes when
//! their power is gone and back.

#[path = "../support/mod.rs"]
mod support;

mod heads;

use std::ffi::OsStr;
use std::fs;
use std::os::fd::OwnedFd;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::symlink;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle};

use lms::variant::{MIRROR_TURN, Unit};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::{Mode, OFlags, fcntl_setfl, open};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{OptionalActions, tcgetattr, tcsetattr};

use support::figures::{self, Figure, Target};
use support::options::Options;
use support::stage::{PATIENCE, Stage};
use support::work::Work;
use support::{Outcome, clock};

fn main() -> ExitCode {
    support::main(measure)
}

fn measure(options: &Options) -> Outcome<()> {
    let stage = Stage::new()?;
    let name = stage.port("front");
    let mut plug = Plug::at(&name)?;
    let hub = stage.hub(&["front"])?;
    hub.await_line("ready", PATIENCE)?;
    let telegrams = stage.consumer("telegram", "front", &["0"])?;
    let statuses = stage.consumer("status", "front", &[])?;
    telegrams.await_line("telegram", PATIENCE)?;
    let (mut noticed, mut back, mut busy, mut torn) = (Vec::new(), Vec::new(), Vec::new(), 0.0);
    for round in 0..options.count(20) {
        // Another phase of the stream each time.
        clock::rest(clock::now() + (300 + 11 * (round as u64 % 20)) * MILLIS);
        telegrams.lines_so_far();
        statuses.lines_so_far();
        let pulled = plug.pull(&name)?;
        let absent = statuses.await_line("status front absent", PATIENCE)?.number(3)?;
        noticed.push(absent.saturating_sub(pulled) as f64 / 1e6);
        let (before, begun) = (Work::of(hub.guard.pid(), |_| true)?, clock::now());
        // Another phase of the hub's looks, too.
        clock::rest(begun + (1_000 + 37 * (round as u64 % 20)) * MILLIS);
        let work = Work::of(hub.guard.pid(), |_| true)?.since(before);
        busy.push(100.0 * work.busy_ns as f64 / (clock::now() - begun) as f64);
        // What came before the plug was pulled.
        telegrams.lines_so_far();
        let other_number = (round % 2 == 1).then(make_pty).transpose()?;
        plug = Plug::at(&name)?;
        let line = telegrams.await_line("telegram", PATIENCE)?;
        back.push((line.number(2)? - plug.since) as f64 / 1e6);
        torn += f64::from(u8::from(line.words().get(5) != Some(&"true")));
        drop(other_number);
    }
    drop((telegrams, statuses, hub));
    plug.pull(&name)?;
    let figure = |name, unit, hub, target| Figure { name, unit, hub, floor: Vec::new(), target };
    let worst = |values: &[f64]| vec![values.iter().copied().fold(0.0, f64::max)];
    let mut figures = vec![
        figure("unplugged, longest until absent", "ms", worst(&noticed), Target::Most(50.0)),
        figure("unplugged until absent", "ms", noticed, Target::None),
        figure("back, longest until a telegram", "ms", worst(&back), Target::Most(500.0)),
        figure("back until a telegram", "ms", back, Target::None),
        figure("hub while absent, most", "% of a core", worst(&busy), Target::Most(2.0)),
        figure("hub while absent", "% of a core", busy, Target::None),
        figure("torn telegrams", "1", vec![torn], Target::Most(0.0)),
    ];
    drop(stage);
    figures.extend(heads::measure(options)?);
    figures::print("replug", options.json, &figures);
    Ok(())
}

/// A sensor that streams, plugged in under a name.
struct Plug {
    pulled: Arc<AtomicBool>,
    sensor: JoinHandle<OwnedFd>,
    /// When its name was there.
    since: u64,
}

impl Plug {
    fn at(name: &str) -> Outcome<Plug> {
        let (line, pty) = make_pty()?;
        let pulled = Arc::new(AtomicBool::new(false));
        let sensor = thread::spawn({
            let pulled = pulled.clone();
            move || stream(line, &pulled)
        });
        symlink(OsStr::from_bytes(&pty), name)?;
        Ok(Plug { pulled, sensor, since: clock::now() })
    }

    /// Takes it away; returns when.
    fn pull(self, name: &str) -> Outcome<u64> {
        self.pulled.store(true, Ordering::Relaxed);
        let line = self.sensor.join().map_err(|_| "the sensor panicked")?;
        fs::remove_file(name)?;
        let at = clock::now();
        drop(line);
        Ok(at)
    }
}

/// Sends scans as a sensor does, two mirror turns apart and each in two parts, while somebody has the line open.
fn stream(line: OwnedFd, pulled: &AtomicBool) -> OwnedFd {
    let mut at = clock::now();
    let mut heard = [0; 256];
    for number in 0_u16.. {
        let words: [u16; 361] = std::array::from_fn(|beam| 500 + (number % 1000) + beam as u16);
        let scan = lms::measured::encode(0, Unit::Mm, &words, 0x10);
        let (first, second) = scan.bytes().split_at(508);
        for part in [first, second] {
            at += MIRROR_TURN;
            clock::rest(at);
            if pulled.load(Ordering::Relaxed) {
                break;
            }
            while rustix::io::read(&line, &mut heard).is_ok_and(|len| len > 0) {}
            if is_open(&line) {
                let _ = rustix::io::write(&line, part);
            }
        }
        if pulled.load(Ordering::Relaxed) {
            break;
        }
    }
    line
}

fn is_open(line: &OwnedFd) -> bool {
    let mut fds = [PollFd::new(line, PollFlags::IN)];
    let now = Timespec { tv_sec: 0, tv_nsec: 0 };
    poll(&mut fds, Some(&now)).is_ok() && !fds[0].revents().contains(PollFlags::HUP)
}

/// A raw pty and the name of its other end.
fn make_pty() -> Outcome<(OwnedFd, Vec<u8>)> {
    let line = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC)?;
    grantpt(&line)?;
    unlockpt(&line)?;
    let name = ptsname(&line, Vec::new())?;
    fcntl_setfl(&line, OFlags::RDWR | OFlags::NONBLOCK)?;
    // Until it was opened once it does not say that it is closed.
    let other = open(&*name, OFlags::RDWR | OFlags::NOCTTY | OFlags::CLOEXEC, Mode::empty())?;
    let mut termios = tcgetattr(&other)?;
    termios.make_raw();
    tcsetattr(&other, OptionalActions::Now, &termios)?;
    Ok((line, name.into_bytes()))
}

const MILLIS: u64 = 1_000_000;
