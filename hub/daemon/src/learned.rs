//! What a hub has learned of its sensors, kept for the next one: their backgrounds, without which whoever stands there
//! while that one starts is background, and for seconds nobody is foreground; the rates at which they were found, and
//! which scanners. Links hand it on between two scans; it is written when it is worth it. Time is an argument. Refuses
//! to know how a background is learned, and how long a disk takes.

mod file;
mod scanner;
mod writer;

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use config::{Config, Link};
use port::Source;
use schema::{Age, Background, Failure, MILLIS, Nanos, Pose};
use shm::StateDirectory;

use crate::process::EventFd;
use crate::surroundings::Learned;
use file::KeptBackground;
pub use scanhub_drivers::line::KnownRate;
use scanner::Kept;
pub use scanner::KnownScanner;
pub(crate) use writer::Writer;

/// Where texts are kept under names between two hubs.
pub trait Files {
    /// Returns what `name` holds; nothing if there is none.
    ///
    /// # Errors
    ///
    /// It cannot be read, or has more than `most` bytes.
    fn read(&self, name: &str, most: u64) -> Result<Option<String>, Failure>;

    /// Replaces what `name` holds by `text`, whole or not at all.
    ///
    /// # Errors
    ///
    /// It cannot be written; what it held is still there.
    fn write(&self, name: &str, text: &str) -> Result<(), Failure>;

    /// Removes `name`, if it is there.
    ///
    /// # Errors
    ///
    /// It stays.
    fn remove(&self, name: &str) -> Result<(), Failure>;

    /// Returns where `name` is, in words.
    fn place(&self, name: &str) -> String;
}

impl Files for StateDirectory {
    fn read(&self, name: &str, most: u64) -> Result<Option<String>, Failure> {
        self.read(name, most)
    }

    fn write(&self, name: &str, text: &str) -> Result<(), Failure> {
        self.write(name, text)
    }

    fn remove(&self, name: &str) -> Result<(), Failure> {
        self.remove(name)
    }

    fn place(&self, name: &str) -> String {
        self.path(name).display().to_string()
    }
}

/// Writes what was handed on into files, when it is due.
pub struct Keeper<F> {
    files: F,
    slots: Arc<Slots>,
    written: Vec<Written>,
}

/// The ways of all sensors to their files.
pub struct Slots {
    slots: Vec<Slot>,
    /// Rings when something was handed on.
    event: EventFd,
}

/// What one link hands on.
struct Slot {
    sensor: String,
    /// The last one that was not taken.
    model: Mutex<Option<(Pose, Box<Background>)>>,
    /// 0 if none is kept.
    kept_wall_ns: AtomicU64,
    /// Rate at which the scanner was found last.
    rate: Kept<KnownRate>,
    /// Scanner that the search found last.
    scanner: Kept<KnownScanner>,
}

/// The slot of one link.
#[derive(Clone, Copy)]
pub struct Handle<'a> {
    slots: &'a Slots,
    slot: &'a Slot,
}

/// What is known of one file of a background.
#[derive(Default)]
struct Written {
    /// The generation that was written last, by this hub.
    generation: Option<u32>,
    /// What is to be written, and not before then.
    waiting: Option<(Pose, Box<Background>)>,
    due: Nanos,
    /// That it cannot be written was said.
    is_told: bool,
}

impl<F: Files> Keeper<F> {
    /// Gives the links of `config` the models to begin with that `files` has for them, and whoever writes theirs there;
    /// nothing if no link learns of a live sensor. `wall_ns` is the time.
    ///
    /// # Errors
    ///
    /// [`Kind::Short`](schema::Kind) if descriptors are.
    pub fn begin(mut config: Config, files: F, wall_ns: u64) -> Result<(Config, Option<Keeper<F>>), Failure> {
        let is_live = |link: &&mut Link| !matches!(link.port, Source::File { .. });
        let slot = |link: &mut Link| Slot {
            sensor: link.name.clone(),
            model: Mutex::default(),
            kept_wall_ns: AtomicU64::new(recall(link, &files, wall_ns)),
            // Only the rate of a tty can be changed.
            rate: Kept::load(&link.name, &files, matches!(link.port, Source::Tty(_))),
            scanner: Kept::load(&link.name, &files, link.family().is_none()),
        };
        let slots: Vec<_> = config.links.iter_mut().filter(is_live).map(slot).collect();
        if slots.is_empty() {
            return Ok((config, None));
        }
        let written = slots.iter().map(|_| Written::default()).collect();
        let slots = Arc::new(Slots { slots, event: EventFd::new()? });
        Ok((config, Some(Keeper { files, slots, written })))
    }

    /// What the links share with it.
    pub fn slots(&self) -> Arc<Slots> {
        self.slots.clone()
    }

    /// Writes what is due at `now`: the first model of a generation at once, later ones once a minute; if this is the
    /// `last` time, all. When something is due again; `Nanos::MAX` if nothing waits.
    pub fn turn(&mut self, now: Nanos, wall_ns: u64, is_last: bool) -> Nanos {
        let mut until = Nanos::MAX;
        for (slot, file) in self.slots.slots.iter().zip(&mut self.written) {
            slot.rate.write(&slot.sensor, &self.files);
            slot.scanner.write(&slot.sensor, &self.files);
            file.waiting = held(&slot.model).take().or(file.waiting.take());
            let Some((pose, model)) = &file.waiting else { continue };
            if !is_last && file.generation == Some(model.generation) && now < file.due {
                until = until.min(file.due);
                continue;
            }
            if let Err(failure) = slot.write_model(&self.files, *pose, model, wall_ns)
                && !std::mem::replace(&mut file.is_told, true)
            {
                tracing::warn!("{}: {}; {}", slot.sensor, failure.message, failure.hint);
            }
            (file.generation, file.due) = (Some(model.generation), now + INTERVAL);
            file.waiting = None;
        }
        until
    }
}

impl Slots {
    /// That of `sensor`.
    pub fn of(&self, sensor: &str) -> Option<Handle<'_>> {
        let slot = self.slots.iter().find(|slot| slot.sensor == sensor)?;
        Some(Handle { slots: self, slot })
    }
}

impl Learned for Handle<'_> {
    fn keep_background(&self, pose: Pose, model: Box<Background>) {
        *held(&self.slot.model) = Some((pose, model));
        self.slots.event.signal();
    }

    fn kept_wall_ns(&self) -> Option<u64> {
        Some(self.slot.kept_wall_ns.load(Ordering::Relaxed)).filter(|&wall_ns| wall_ns != 0)
    }

    fn rate(&self, port: &str) -> Option<KnownRate> {
        self.slot.rate.of(port)
    }

    fn scanner(&self, port: &str) -> Option<KnownScanner> {
        self.slot.scanner.of(port)
    }

    fn keep_scanner(&self, port: &str, scanner: KnownScanner) {
        if self.slot.scanner.keep(port, scanner) {
            self.slots.event.signal();
        }
    }

    fn keep_rate(&self, port: &str, rate: KnownRate) {
        if self.slot.rate.keep(port, rate) {
            self.slots.event.signal();
        }
    }
}

impl Slot {
    /// Makes the file say `model`. One that knows nothing has no file: what was known before is not true any more.
    fn write_model(
        &self,
        files: &impl Files,
        pose: Pose,
        model: &Background,
        wall_ns: u64,
    ) -> Result<(), Failure> {
        let file = background_of(&self.sensor);
        if model.taught == 0 {
            // A hub that did not begin with it has something to say of it once its own was forgotten.
            let was_kept = self.kept_wall_ns.swap(0, Ordering::Relaxed) != 0;
            let is_forgotten = was_kept || model.generation > 0;
            return if is_forgotten { files.remove(&file) } else { Ok(()) };
        }
        let text = KeptBackground { model: model.boxed(), pose, wall_ns }.text(&self.sensor)?;
        files.write(&file, &text)?;
        self.kept_wall_ns.store(wall_ns, Ordering::Relaxed);
        Ok(())
    }
}

/// Lets `link` begin with what is kept for it, if it fits and nothing else was said; when that was written, else 0.
fn recall(link: &mut Link, files: &impl Files, now_wall_ns: u64) -> u64 {
    let name = &link.name;
    let background = &mut link.processing.background;
    if !background.is_kept || !background.is_handed_on || background.start_is_said {
        return 0;
    }
    let file = background_of(name);
    let text = match files.read(&file, LONGEST) {
        Ok(Some(text)) => text,
        Ok(None) => return 0,
        Err(failure) => {
            tracing::warn!("{name}: the background starts empty: {}; {}", failure.message, failure.hint);
            return 0;
        }
    };
    match KeptBackground::read(&text, &files.place(&file), link) {
        Ok(KeptBackground { model, wall_ns, .. }) => {
            let age = Age(Duration::from_nanos(now_wall_ns.saturating_sub(wall_ns)));
            let (taught, count) = (model.taught, model.count);
            tracing::info!(
                "{}: starts with the background saved {age} ago, {taught} of {count} beams known",
                link.name
            );
            link.processing.background.model = Some(model);
            wall_ns
        }
        Err(why) => {
            tracing::warn!("{name}: the background starts empty: {why}");
            0
        }
    }
}

/// What a thread that panicked held is whole: each is replaced at once.
fn held<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

fn background_of(sensor: &str) -> String {
    format!("{sensor}.background.json")
}

/// Between two writes of a generation: what a hub that is killed had learned since is learned again.
const INTERVAL: Nanos = 60_000 * MILLIS;
/// Far more bytes than a model has as text.
const LONGEST: u64 = 1 << 20;

#[cfg(test)]
mod tests {
    use super::*;
    use config::Sources;

    #[test]
    fn the_rate_is_known_of_this_link_at_this_port() {
        let root = tempfile::tempdir().unwrap();
        let state = StateDirectory::at(root.path().join("state"));
        let port = "/dev/serial/by-id/usb-FTDI 1";
        let begin = |link: &str| {
            let sources = Sources { links: vec![link.to_owned()], ..Sources::default() };
            let config = Config::load(&sources).expect("a configuration");
            Keeper::begin(config, state.clone(), 0).expect("descriptors").1.expect("a live link")
        };
        let known = |name: &str, port: &str| {
            let keeper = begin(&format!("{name}={port}"));
            keeper.slots().of(name).and_then(|slot| slot.rate(port))
        };
        assert_eq!(known("front", port), None, "the first one");
        for (baud, silent_switches) in [(9_600, 0), (38_400, 2), (500_000, 0)] {
            let rate = KnownRate { baud, silent_switches };
            let mut keeper = begin(&format!("front={port}"));
            let slots = keeper.slots();
            slots.of("front").expect("a slot").keep_rate(port, rate);
            assert_eq!(keeper.turn(1, 1, true), Nanos::MAX);
            assert_eq!(known("front", port), Some(rate));
            assert_eq!((known("rear", port), known("front", "/dev/ttyUSB0")), (None, None));
        }
        // What cannot be believed is as good as nothing.
        state.write("front.rate", &"9".repeat(10_000)).unwrap();
        assert_eq!(known("front", port), None);
    }

    #[test]
    fn a_scanner_is_known_of_this_link_at_this_port() {
        let root = tempfile::tempdir().unwrap();
        let state = StateDirectory::at(root.path().join("state"));
        let begin = |link: &str| {
            let sources = Sources { links: vec![link.to_owned()], ..Sources::default() };
            let config = Config::load(&sources).expect("a configuration");
            Keeper::begin(config, state.clone(), 0).expect("descriptors").1.expect("a live link")
        };
        let memory = scanhub_drivers::search::Memory {
            family: schema::Family::Ld,
            stream_rate: 921_600,
            reply_rate: 921_600,
        };
        let scanner = KnownScanner { memory, model: Some("stl27l".to_owned()), beams: Some(2_160) };
        let mut keeper = begin("front=/dev/x,family=auto");
        keeper.slots().of("front").expect("a slot").keep_scanner("/dev/x", scanner.clone());
        keeper.turn(1, 1, true);
        for (link, port, expected) in [
            ("front=/dev/x,family=auto", "/dev/x", Some(&scanner)),
            ("front=/dev/y,family=auto", "/dev/y", None),
            ("rear=/dev/x,family=auto", "/dev/x", None),
            ("front=/dev/x,family=ld", "/dev/x", None),
        ] {
            let name = &link[..link.find('=').expect("a link")];
            let known = begin(link).slots().of(name).and_then(|slot| slot.scanner(port));
            assert_eq!(known.as_ref(), expected, "{link}");
        }
    }

    #[test]
    fn a_recording_is_learned_of_by_nobody() {
        let sources = Sources { links: vec!["front=file:x".into()], ..Sources::default() };
        let config = Config::load(&sources).expect("a configuration");
        let (_, keeper) = Keeper::begin(config, StateDirectory::at("/nowhere"), 0).expect("descriptors");
        assert!(keeper.is_none());
    }
}
