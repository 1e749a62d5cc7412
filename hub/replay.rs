//! `scanhub replay`, which runs a hub that plays a recording. A terminal shows a progress line, and its keys control
//! the player.

pub(crate) mod page;
pub(crate) mod progress_line;

use std::io::{IsTerminal, Read, stderr, stdin};
use std::os::fd::AsFd;
use std::os::unix::net::UnixStream;
use std::path::PathBuf;
use std::sync::Arc;
use std::thread::{self, JoinHandle};
use std::time::Duration;

use clap::Args;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::process::getpgrp;
use rustix::termios::{
    LocalModes, OptionalActions, SpecialCodeIndex, Termios, tcgetattr, tcgetpgrp, tcsetattr,
};
use scanhub_daemon::{PlaybackOptions, PlaybackRate, Player, Progress};
use scanhub_schema::{Failure, Family, Kind};
use scanhub_verbs::context::Context;
use scanhub_verbs::duration;
use serde::Serialize;

use crate::cli;
use crate::cli::run::{self, ConfigOptions};
use crate::mounts::RecordedMounts;
use progress_line::ProgressLine;

/// Run a hub that plays a recording instead of reading scanners
#[derive(Args, Debug)]
#[command(after_help = AFTER_HELP)]
pub(crate) struct Replay {
    /// Recording to play: MCAP file, stream file or CARMEN log, plain or gzipped
    file: PathBuf,
    /// Speed relative to the recording, 0.015625 to 64. max: as fast as possible
    #[arg(long, default_value = "1", value_name = "FACTOR|max", value_parser = parse_rate)]
    rate: PlaybackRate,
    /// Restart the recording at its end, until Ctrl-C. At each restart, the hub discards what it has learned
    #[arg(long = "loop", conflicts_with = "hold")]
    is_looped: bool,
    /// Time in the recording at which publishing starts, for example 90s. From the part before, the hub only learns
    #[arg(long, value_name = "DURATION", value_parser = duration::parse)]
    start: Option<Duration>,
    /// Time in the recording at which publishing stops
    #[arg(long, value_name = "DURATION", value_parser = duration::parse)]
    end: Option<Duration>,
    /// Pause before the first telegram, until you press space or run `scanhub control SENSOR resume`
    #[arg(long)]
    paused: bool,
    /// Keep the hub running after the end of the recording, without publishing, until Ctrl-C
    #[arg(long)]
    hold: bool,
    /// Play only this sensor, and no mounts. For a stream file or a log: name of the sensor [default: front]
    #[arg(long, value_name = "NAME")]
    sensor: Option<String>,
    /// Family of the scanner in a stream file: lms, ld or rplidar [default: recognized by its bytes]
    #[arg(long, value_name = "NAME", value_parser = cli::family)]
    family: Option<Family>,
    #[command(flatten)]
    configured: ConfigOptions,
}

impl Replay {
    /// Runs until the recording has been played or the user ends it. Then prints a summary.
    pub(crate) fn run(&self, context: &mut Context) -> Result<(), Failure> {
        let domain = context.domain.of_hub()?;
        let options = scanhub_daemon::Replay {
            file: &self.file,
            sensor: self.sensor.as_deref(),
            family: self.family,
            sources: &self.configured.sources(),
            options: self.play()?,
            holds: self.hold,
        };
        let mut console = None;
        let mut mounts = None;
        let played = scanhub_daemon::replay(&options, &domain, |ready, player| {
            let started = mounts.insert(RecordedMounts::start(player, &domain));
            if started.is_err() {
                return player.end();
            }
            run::print_ready(ready, &domain, context.json);
            if !context.json {
                console = Console::open(player);
            }
        });
        drop(console);
        let played = played?;
        mounts.transpose()?;
        crate::print(&if context.json {
            crate::to_json_line(&ReplaySummary::of(&played))
        } else {
            progress_line::summary(&played)
        })
    }

    /// Returns the options of the player.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Usage`] if the end is not after the start.
    fn play(&self) -> Result<PlaybackOptions, Failure> {
        let start = self.start.unwrap_or_default();
        if let Some(end) = self.end.filter(|end| *end <= start) {
            let message = format!("--end {end:?} is not after --start {start:?}");
            return Err(Failure::new(Kind::Usage, message, "both count from the first telegram"));
        }
        Ok(PlaybackOptions {
            rate: self.rate,
            start_ns: nanos(start),
            end_ns: self.end.map(nanos),
            is_looped: self.is_looped,
            is_paused: self.paused,
        })
    }
}

/// Thread that handles keys and draws the progress line. Dropping it ends the thread.
struct Console {
    /// End of a socket pair. Closing it ends the thread.
    open: Option<UnixStream>,
    thread: Option<JoinHandle<()>>,
}

impl Console {
    /// Starts the thread. Returns `None` if neither standard input nor standard error is a terminal.
    fn open(player: &Arc<Player>) -> Option<Console> {
        if !stdin().is_terminal() && !stderr().is_terminal() {
            return None;
        }
        let (open, closed) = UnixStream::pair().ok()?;
        let player = player.clone();
        let run = move || run_console(&player, &closed);
        let thread = thread::Builder::new().name("keys".into()).spawn(run).ok()?;
        Some(Console { open: Some(open), thread: Some(thread) })
    }
}

impl Drop for Console {
    fn drop(&mut self) {
        self.open = None;
        // The thread has no result, and the log has the message of a panic.
        let _ = self.thread.take().map(JoinHandle::join);
    }
}

/// Handles keys and draws the progress line until the other end of `closed` is closed.
fn run_console(player: &Player, closed: &UnixStream) {
    let mut keys = RawKeyboard::take_over();
    let mut line = stderr().is_terminal().then(ProgressLine::default);
    let mut drawn_at = None;
    loop {
        let progress = player.progress();
        if drawn_at.is_none_or(|at| progress.now_ns >= at + REDRAW_INTERVAL_NS) {
            drawn_at = Some(progress.now_ns);
            line.iter_mut().for_each(|line| line.draw(&progress));
        }
        let input = stdin();
        let mut fds = vec![PollFd::new(closed, PollFlags::IN)];
        if keys.is_some() {
            fds.push(PollFd::from_borrowed_fd(input.as_fd(), PollFlags::IN));
        }
        let _ = poll(&mut fds, Some(&REDRAW_INTERVAL));
        if !fds[0].revents().is_empty() {
            return;
        }
        if fds.get(1).is_some_and(|fd| !fd.revents().is_empty()) {
            let mut pressed = [0; 64];
            match input.lock().read(&mut pressed) {
                Ok(len @ 1..) => handle_keys(player, &pressed[..len]),
                // The terminal was closed, so no key could end a player that runs in a loop.
                _ => {
                    keys = None;
                    player.end();
                }
            }
        }
    }
}

/// Handles pressed keys.
fn handle_keys(player: &Player, mut pressed: &[u8]) {
    while let [key, rest @ ..] = pressed {
        pressed = rest;
        match key {
            b' ' => player.toggle(),
            b'.' => player.step(),
            b'+' | b'=' => player.speed_up(),
            b'-' => player.slow_down(),
            b'q' => player.end(),
            b'\x1b' => {
                // Special keys are sequences of several bytes (ECMA-48).
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

/// Terminal without echo and line buffering, for single keys. Dropping it restores the terminal.
struct RawKeyboard {
    saved: Termios,
}

impl RawKeyboard {
    /// Changes the mode of the terminal. Returns `None` if standard input is not a terminal, or if this process runs in
    /// the background.
    fn take_over() -> Option<RawKeyboard> {
        let keyboard = stdin();
        if !keyboard.is_terminal() || tcgetpgrp(&keyboard).ok()? != getpgrp() {
            return None;
        }
        let saved = tcgetattr(&keyboard).ok()?;
        let mut ours = saved.clone();
        // Ctrl-C stays a signal. Ctrl-Z and Ctrl-\ would leave the terminal in this mode.
        ours.local_modes -= LocalModes::ICANON | LocalModes::ECHO;
        ours.special_codes[SpecialCodeIndex::VSUSP] = DISABLED_CHARACTER;
        ours.special_codes[SpecialCodeIndex::VQUIT] = DISABLED_CHARACTER;
        ours.special_codes[SpecialCodeIndex::VMIN] = 1;
        ours.special_codes[SpecialCodeIndex::VTIME] = 0;
        tcsetattr(&keyboard, OptionalActions::Now, &ours).ok()?;
        Some(RawKeyboard { saved })
    }
}

impl Drop for RawKeyboard {
    fn drop(&mut self) {
        // This fails if the terminal was closed, and then there is nothing to restore.
        let _ = tcsetattr(stdin(), OptionalActions::Now, &self.saved);
    }
}

fn nanos(duration: Duration) -> u64 {
    u64::try_from(duration.as_nanos()).unwrap_or(u64::MAX)
}

fn parse_rate(text: &str) -> Result<PlaybackRate, String> {
    if text == "max" {
        return Ok(PlaybackRate::Max);
    }
    let rate =
        text.parse().ok().filter(|rate| (PlaybackRate::MIN_FACTOR..=PlaybackRate::MAX_FACTOR).contains(rate));
    rate.map(PlaybackRate::Times).ok_or_else(|| {
        format!("a number from {} to {}, or max", PlaybackRate::MIN_FACTOR, PlaybackRate::MAX_FACTOR)
    })
}

/// JSON line of class `replayed`.
#[derive(Serialize)]
struct ReplaySummary {
    class: &'static str,
    telegrams: u64,
    laps: u32,
    position_s: f64,
    took_s: f64,
    paused_s: f64,
}

impl ReplaySummary {
    fn of(played: &Progress) -> ReplaySummary {
        let Progress { telegrams, lap: laps, position_ns, took_ns, paused_ns, .. } = *played;
        let [position_s, took_s, paused_s] = [position_ns, took_ns, paused_ns].map(|ns| ns as f64 / 1e9);
        ReplaySummary { class: "replayed", telegrams, laps, position_s, took_s, paused_s }
    }
}

/// Minimum interval between two progress lines.
const REDRAW_INTERVAL_NS: u64 = 200_000_000;
const REDRAW_INTERVAL: Timespec = Timespec { tv_sec: 0, tv_nsec: REDRAW_INTERVAL_NS as i64 };
/// Value of a special character that no key produces (`_POSIX_VDISABLE`).
const DISABLED_CHARACTER: u8 = 0;

/// Keys of the player, for the end of the help.
const AFTER_HELP: &str = "\
Examples:
  scanhub replay walk.mcap
  scanhub replay walk.mcap --rate max --set 'zones.radii=[1.2,0.7]'
  scanhub replay walk.mcap --start 1m --end 90s --loop --paused

Keys:
  space         pause, and continue
  . or right    play the next telegram of any sensor, and pause
  + and -       twice as fast, half as fast
  q             quit";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parses_replay_rates() {
        assert_eq!(
            (parse_rate("max"), parse_rate("0.5")),
            (Ok(PlaybackRate::Max), Ok(PlaybackRate::Times(0.5)))
        );
        for wrong in ["0", "-1", "65", "nan", "inf", "fast", ""] {
            assert!(
                parse_rate(wrong).is_err_and(|error| error.contains("0.015625 to 64, or max")),
                "{wrong}"
            );
        }
    }
}
