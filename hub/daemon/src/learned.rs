//! What a hub has learned of the backgrounds of its sensors, kept for the next one: without it whoever stands there while that
//! one starts is background, and for seconds nobody is foreground. Links hand their models on between two scans; a thread
//! that may wait for a disk writes them. Refuses to know how a background is learned.

mod file;

use std::io;
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use config::{Config, Link};
use lms::{MILLIS, Nanos};
use port::{Source, clock};
use rustix::event::{PollFd, PollFlags, poll};
use schema::{Age, Background, Failure, Kind, Pose, StateDirectory};

use crate::event_fd::EventFd;
use crate::preflight::no_resource;
use file::Learned;

/// The thread that writes; ends when this is dropped, after what was handed on until then.
pub(crate) struct Keeper {
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

struct Shared {
    state: StateDirectory,
    slots: Vec<Slot>,
    event: Arc<EventFd>,
    is_over: AtomicBool,
}

/// The way of one sensor's models to their file.
pub(crate) struct Slot {
    sensor: String,
    /// The last one that was not taken.
    model: Mutex<Option<(Pose, Background)>>,
    /// 0 if none is kept.
    kept_wall_ns: AtomicU64,
    event: Arc<EventFd>,
}

/// Gives the links of `config` the models to begin with that `state` has for them, and whoever writes theirs there.
///
/// [`Kind::Short`](schema::Kind) if descriptors are, or threads.
pub(crate) fn begin(
    mut config: Config,
    state: Option<&StateDirectory>,
) -> Result<(Config, Option<Keeper>), Failure> {
    let is_live = |link: &&mut Link| !matches!(link.port, Source::File { .. });
    let Some(state) = state else { return Ok((config, None)) };
    let event = Arc::new(EventFd::new()?);
    let mut slots = Vec::new();
    for link in config.links.iter_mut().filter(is_live) {
        let kept_wall_ns = AtomicU64::new(recall(link, state));
        slots.push(Slot {
            sensor: link.name.clone(),
            model: Mutex::default(),
            kept_wall_ns,
            event: event.clone(),
        });
    }
    if slots.is_empty() {
        return Ok((config, None));
    }
    let shared = Arc::new(Shared { state: state.clone(), slots, event, is_over: AtomicBool::new(false) });
    let body = shared.clone();
    let thread = thread::Builder::new().name(THREAD.into()).spawn(move || body.write());
    let thread = thread.map_err(|error| no_resource("a thread", &error))?;
    Ok((config, Some(Keeper { shared, thread: Some(thread) })))
}

/// Lets `link` begin with what is kept for it, if it fits and nothing else was said; when that was written, else 0.
fn recall(link: &mut Link, state: &StateDirectory) -> u64 {
    let name = &link.name;
    let background = &mut link.processing.background;
    if !background.is_kept || !background.is_handed_on || background.start_is_said {
        return 0;
    }
    let file = file_of(name);
    let place = state.path(&file).display().to_string();
    let text = match state.read(&file, LONGEST) {
        Ok(Some(text)) => text,
        Ok(None) => return 0,
        Err(failure) => {
            tracing::warn!("{name}: the background starts empty: {}; {}", failure.message, failure.hint);
            return 0;
        }
    };
    match Learned::read(&text, &place, link) {
        Ok(Learned { model, wall_ns, .. }) => {
            let now = clock::now();
            let age = Age(Duration::from_nanos(clock::wall(now, now).saturating_sub(wall_ns)));
            let Background { taught, count, .. } = model;
            tracing::info!(
                "{}: starts with the background saved {age} ago, {taught} of {count} beams known",
                link.name
            );
            link.processing.background.model = Some(Box::new(model));
            wall_ns
        }
        Err(why) => {
            tracing::warn!("{name}: the background starts empty: {why}");
            0
        }
    }
}

impl Keeper {
    /// The way of the models of `sensor`.
    pub(crate) fn slot(&self, sensor: &str) -> Option<&Slot> {
        self.shared.slots.iter().find(|slot| slot.sensor == sensor)
    }
}

impl Drop for Keeper {
    fn drop(&mut self) {
        self.shared.is_over.store(true, Ordering::Relaxed);
        self.shared.event.signal();
        // One that panicked has said so.
        let _ = self.thread.take().map(JoinHandle::join);
    }
}

impl Slot {
    /// Lets `model` be written, of a sensor that sits at `pose`. Waits for nothing but a copy of it.
    pub(crate) fn put(&self, pose: Pose, model: Background) {
        *self.model.lock().unwrap_or_else(PoisonError::into_inner) = Some((pose, model));
        self.event.signal();
    }

    /// When the one was written that the next hub would begin with, in nanoseconds since 1970.
    pub(crate) fn kept_wall_ns(&self) -> Option<u64> {
        Some(self.kept_wall_ns.load(Ordering::Relaxed)).filter(|&wall_ns| wall_ns != 0)
    }

    fn take(&self) -> Option<(Pose, Background)> {
        self.model.lock().unwrap_or_else(PoisonError::into_inner).take()
    }
}

/// What is known of one file.
#[derive(Default)]
struct Written {
    /// The generation that was written last, by this hub.
    generation: Option<u32>,
    /// What is to be written, and not before then.
    waiting: Option<(Pose, Background)>,
    due: Nanos,
    /// That it cannot be written was said.
    is_told: bool,
}

impl Shared {
    /// Writes what comes until it is over: the first model of a generation at once, later ones every [`INTERVAL`].
    fn write(&self) {
        let mut files: Vec<Written> = self.slots.iter().map(|_| Written::default()).collect();
        loop {
            self.event.clear();
            let is_over = self.is_over.load(Ordering::Relaxed);
            let now = clock::now();
            let mut until = Nanos::MAX;
            for (slot, file) in self.slots.iter().zip(&mut files) {
                file.waiting = slot.take().or(file.waiting.take());
                let Some((pose, model)) = &file.waiting else { continue };
                if !is_over && file.generation == Some(model.generation) && now < file.due {
                    until = until.min(file.due);
                    continue;
                }
                if let Err(failure) = self.put(slot, *pose, model)
                    && !std::mem::replace(&mut file.is_told, true)
                {
                    tracing::warn!("{}: {}; {}", slot.sensor, failure.message, failure.hint);
                }
                (file.generation, file.due) = (Some(model.generation), now + INTERVAL);
                file.waiting = None;
            }
            if is_over {
                return;
            }
            let span = (until != Nanos::MAX).then(|| clock::span(now, until));
            // Whatever ends the wait, it is looked what there is.
            let _ = poll(&mut [PollFd::new(&*self.event, PollFlags::IN)], span.as_ref());
        }
    }

    /// Makes the file of `slot` say `model`. One that knows nothing has no file: what was known before is not true any more.
    fn put(&self, slot: &Slot, pose: Pose, model: &Background) -> Result<(), Failure> {
        let file = file_of(&slot.sensor);
        if model.taught == 0 {
            // A hub that did not begin with it has something to say of it once its own was forgotten.
            let was_kept = slot.kept_wall_ns.swap(0, Ordering::Relaxed) != 0;
            let is_forgotten = was_kept || model.generation > 0;
            return if is_forgotten { remove(&self.state.path(&file)) } else { Ok(()) };
        }
        let now = clock::now();
        let wall_ns = clock::wall(now, now);
        let text = Learned { model: *model, pose, wall_ns }.text(&slot.sensor)?;
        self.state.write(&file, &text)?;
        slot.kept_wall_ns.store(wall_ns, Ordering::Relaxed);
        Ok(())
    }
}

/// Removes the file at `path`, if there is one.
fn remove(path: &Path) -> Result<(), Failure> {
    match std::fs::remove_file(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => {
            let message = format!("{}: an old background file stays: {error}", path.display());
            Err(Failure::new(Kind::Failed, message, "remove the file"))
        }
        _ => Ok(()),
    }
}

fn file_of(sensor: &str) -> String {
    format!("{sensor}.background.json")
}

/// The writing thread's name.
const THREAD: &str = "learned";
/// Between two writes of a generation: what a hub that is killed had learned since is learned again.
const INTERVAL: Nanos = 60_000 * MILLIS;
/// Far more bytes than a model has as text.
const LONGEST: u64 = 1 << 20;
