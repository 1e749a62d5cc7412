//! `scanhub web --replay`, which runs a hub that plays a recording in a private domain, and serves its picture. Viewers
//! control the player. The hub and the server end together.

use std::io::Write;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, mpsc};
use std::thread;

use scanhub_config::Sources;
use scanhub_daemon::{PlaybackOptions, PlaybackRate, Player};
use scanhub_schema::{Failure, Kind};
use scanhub_verbs::context::Context;
use scanhub_viewer::WebArgs;
use scanhub_viewer::server::player::{Playback, PlayerCommand, Progress};

use crate::private_domain::PrivateDomain;

/// Serves the picture of a hub, or with `--replay` the picture of a recording.
pub(crate) fn run(web: &WebArgs, context: &mut Context) -> Result<(), Failure> {
    let (locations, stop) = (context.domain.locations()?, context.signals.stop()?);
    match &web.replay {
        Some(file) => show(web, file, context.json, &mut context.out, &stop),
        None => web.run(&locations, context.json, None, &mut context.out, &stop),
    }
}

/// Plays `file` and serves its picture until `stop` is set. The end of the hub also sets `stop`.
fn show(
    web: &WebArgs,
    file: &Path,
    json: bool,
    out: &mut dyn Write,
    stop: &Arc<AtomicBool>,
) -> Result<(), Failure> {
    web.check()?;
    let domain = PrivateDomain::new("web")?;
    let sources = Sources { files: Sources::system(), ..Sources::default() };
    let replay = scanhub_daemon::Replay {
        file,
        sensor: None,
        family: None,
        sources: &sources,
        options: PlaybackOptions { is_looped: web.is_looped, ..PlaybackOptions::default() },
        // Viewers keep the last picture until the user ends the verb.
        holds: true,
    };
    thread::scope(|scope| {
        let (ready, is_ready) = mpsc::channel();
        let (replay, domain) = (&replay, &domain);
        let hub = thread::Builder::new().name("hub".into()).spawn_scoped(scope, move || {
            // The page ends with the hub, even if the hub panics.
            let _over = SetOnDrop(stop);
            scanhub_daemon::replay(replay, domain, |_, player| {
                let _ = ready.send(PlayerControls(player.clone()));
            })
        });
        let hub =
            hub.map_err(|error| Failure::new(Kind::ResourceExhausted, format!("no thread: {error}"), ""))?;
        let mut shown = Ok(());
        if let Ok(keys) = is_ready.recv() {
            shown = web.run(std::slice::from_ref(domain), json, Some(&keys), out, stop);
            keys.0.end();
        }
        match hub.join() {
            Ok(played) => played.and(shown),
            // The panic has printed its reason.
            Err(_) => Err(Failure::new(Kind::Failed, "the hub of the recording ended", "start it again")),
        }
    })
}

/// Player that viewers control.
struct PlayerControls(Arc<Player>);

impl Playback for PlayerControls {
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

/// Guard that sets `stop` when it is dropped.
struct SetOnDrop<'a>(&'a AtomicBool);

impl Drop for SetOnDrop<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}
