//! `scanhub web --replay`: a hub of this process alone whose sensors are a recording, and the picture of it, with the
//! keys of the player. Both end together.

use std::io::Write;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, mpsc};
use std::thread;

use scanhub_config::Sources;
use scanhub_daemon::{PlaybackOptions, PlaybackRate, Player};
use scanhub_schema::{Failure, Kind};
use scanhub_viewer::WebArgs;
use scanhub_viewer::server::player::{Playback, PlayerCommand, Progress};

use crate::cli::Everywhere;
use crate::own_domain::OwnDomain;

/// Serves the picture of a hub, or with `--replay` that of a recording.
pub(crate) fn run(
    web: &WebArgs,
    everywhere: &Everywhere,
    out: &mut dyn Write,
    stop: &Arc<AtomicBool>,
) -> Result<(), Failure> {
    match &web.replay {
        Some(file) => show(web, file, everywhere, out, stop),
        None => web.run(&everywhere.places()?, everywhere.json, None, out, stop),
    }
}

/// Shows `file` until `stop` is set. The end of its hub sets `stop`, too.
fn show(
    web: &WebArgs,
    file: &Path,
    everywhere: &Everywhere,
    out: &mut dyn Write,
    stop: &Arc<AtomicBool>,
) -> Result<(), Failure> {
    everywhere.places()?;
    web.check()?;
    let domain = OwnDomain::new("web")?;
    let sources = Sources { files: Sources::system(), ..Sources::default() };
    let replay = scanhub_daemon::Replay {
        file,
        sensor: None,
        family: None,
        sources: &sources,
        play: PlaybackOptions { is_looped: web.is_looped, ..PlaybackOptions::default() },
        // What was seen last stands until whoever looks has seen enough.
        holds: true,
    };
    thread::scope(|scope| {
        let (ready, is_ready) = mpsc::channel();
        let (replay, domain) = (&replay, &domain);
        let hub = thread::Builder::new().name("hub".into()).spawn_scoped(scope, move || {
            // Whichever way it ends, the page ends, too.
            let _over = Over(stop);
            scanhub_daemon::replay(replay, domain, |_, player| {
                let _ = ready.send(Keys(player.clone()));
            })
        });
        let hub = hub.map_err(|error| Failure::new(Kind::Short, format!("no thread: {error}"), ""))?;
        let mut shown = Ok(());
        if let Ok(keys) = is_ready.recv() {
            shown = web.run(std::slice::from_ref(domain), everywhere.json, Some(&keys), out, stop);
            keys.0.end();
        }
        match hub.join() {
            Ok(played) => played.and(shown),
            // It has said why.
            Err(_) => Err(Failure::new(Kind::Failed, "the hub of the recording ended", "start it again")),
        }
    })
}

/// The player, as viewers have it.
struct Keys(Arc<Player>);

impl Playback for Keys {
    fn command(&self, command: PlayerCommand) {
        match command {
            PlayerCommand::Toggle => self.0.toggle(),
            PlayerCommand::Step => self.0.step(),
            PlayerCommand::Faster => self.0.speed_up(),
            PlayerCommand::Slower => self.0.slow_down(),
        }
    }

    fn progress(&self) -> Progress {
        let progress = self.0.progress();
        let seconds = |ns: u64| ns as f64 / 1e9;
        Progress {
            position_s: seconds(progress.position_ns),
            length_s: progress.length_ns.map(seconds),
            rate: match progress.rate {
                PlaybackRate::Times(rate) => Some(rate),
                PlaybackRate::Max => None,
            },
            paused: progress.is_paused,
            over: progress.is_over,
            lap: progress.lap,
            telegrams: progress.telegrams,
        }
    }
}

/// Ends what waits for `stop`.
struct Over<'a>(&'a AtomicBool);

impl Drop for Over<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}
