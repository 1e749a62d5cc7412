//! The player of `scanhub replay`: starts the hub whose sensors are a recording, and gives whoever sits at a terminal its
//! keys and a line that says how far it is.

pub(crate) mod line;
pub(crate) mod page;
mod terminal;

use std::io::{IsTerminal, Read, stderr, stdin};
use std::os::fd::AsFd;
use std::os::unix::net::UnixStream;
use std::sync::Arc;
use std::thread::{self, JoinHandle};

use daemon::{Player, Progress};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use schema::Failure;
use serde::Serialize;

use crate::cli::{Everywhere, Replay};
use line::Line;
use terminal::Keys;

/// Runs until everything was played, or somebody ends it; then says how far it came.
pub(crate) fn replay(replay: &Replay, everywhere: &Everywhere) -> Result<(), Failure> {
    let domain = everywhere.hub_domain()?;
    let options = daemon::Replay {
        file: &replay.file,
        sensor: replay.sensor.as_deref(),
        family: replay.family,
        sources: &replay.configured.sources(),
        play: replay.play()?,
        holds: replay.hold,
    };
    let mut console = None;
    let played = daemon::replay(&options, &domain, |ready, player| {
        crate::say_ready(ready, &domain, everywhere.json);
        if !everywhere.json {
            console = Console::open(player);
        }
    });
    drop(console);
    let played = played?;
    crate::say(&if everywhere.json { crate::line(&Replayed::of(&played)) } else { line::summary(&played) });
    Ok(())
}

/// A person at a terminal, as long as the hub runs.
struct Console {
    /// Closed, it tells the thread to end.
    open: Option<UnixStream>,
    thread: Option<JoinHandle<()>>,
}

impl Console {
    /// Nothing if there is neither somebody to press keys nor somebody to read.
    fn open(player: &Arc<Player>) -> Option<Console> {
        if !stdin().is_terminal() && !stderr().is_terminal() {
            return None;
        }
        let (open, closed) = UnixStream::pair().ok()?;
        let player = player.clone();
        let attend = move || attend(&player, &closed);
        let thread = thread::Builder::new().name("keys".into()).spawn(attend).ok()?;
        Some(Console { open: Some(open), thread: Some(thread) })
    }
}

impl Drop for Console {
    fn drop(&mut self) {
        self.open = None;
        // It has nothing to say, also if it panicked.
        let _ = self.thread.take().map(JoinHandle::join);
    }
}

/// Takes keys and draws the line until `closed` is.
fn attend(player: &Player, closed: &UnixStream) {
    let mut keys = Keys::take_over();
    let mut line = stderr().is_terminal().then(Line::default);
    let mut drawn_at = None;
    loop {
        let progress = player.progress();
        if drawn_at.is_none_or(|at| progress.now_ns >= at + REDRAW_NS) {
            drawn_at = Some(progress.now_ns);
            line.iter_mut().for_each(|line| line.draw(&progress));
        }
        let input = stdin();
        let mut fds = vec![PollFd::new(closed, PollFlags::IN)];
        if keys.is_some() {
            fds.push(PollFd::from_borrowed_fd(input.as_fd(), PollFlags::IN));
        }
        let _ = poll(&mut fds, Some(&REDRAW));
        if !fds[0].revents().is_empty() {
            return;
        }
        if fds.get(1).is_some_and(|fd| !fd.revents().is_empty()) {
            let mut pressed = [0; 64];
            match input.lock().read(&mut pressed) {
                Ok(len @ 1..) => obey(player, &pressed[..len]),
                // The terminal is gone, and with it whoever could end a player that goes on for ever.
                _ => {
                    keys = None;
                    player.end();
                }
            }
        }
    }
}

fn obey(player: &Player, mut pressed: &[u8]) {
    while let [key, rest @ ..] = pressed {
        pressed = rest;
        match key {
            b' ' => player.toggle(),
            b'.' => player.step(),
            b'+' | b'=' => player.speed_up(),
            b'-' => player.slow_down(),
            b'q' => player.end(),
            b'\x1b' => {
                // Keys that are no letters come as several bytes (ECMA-48); with the last of them they end.
                if let [b'[' | b'O', b'C', ..] = rest {
                    player.step();
                }
                if let [b'[' | b'O', rest @ ..] = rest {
                    let end = rest.iter().position(|byte| (0x40..0x7F).contains(byte));
                    pressed = &rest[end.map_or(rest.len(), |end| end + 1)..];
                }
            }
            _ => {}
        }
    }
}

/// Class `replayed`.
#[derive(Serialize)]
struct Replayed {
    class: &'static str,
    telegrams: u64,
    laps: u32,
    position_s: f64,
    took_s: f64,
    paused_s: f64,
}

impl Replayed {
    fn of(played: &Progress) -> Replayed {
        let Progress { telegrams, lap: laps, position_ns, took_ns, paused_ns, .. } = *played;
        let [position_s, took_s, paused_s] = [position_ns, took_ns, paused_ns].map(|ns| ns as f64 / 1e9);
        Replayed { class: "replayed", telegrams, laps, position_s, took_s, paused_s }
    }
}

/// The line is drawn five times a second at the most.
const REDRAW_NS: u64 = 200_000_000;
const REDRAW: Timespec = Timespec { tv_sec: 0, tv_nsec: REDRAW_NS as i64 };
