//! State of the links that outlives the hub: the background of each sensor, the rate at which its scanner was found,
//! and the scanner that a search found. Without a background, a person who stands in front of a sensor while the hub
//! starts becomes part of the background, and foreground is unknown for seconds.
//!
//! A link hands state over between two scans, through a [`SaveSlot`], and never waits for a disk. [`StateSaver`]
//! decides when to write the state to a [`StateStore`], and a [`StateWriter`] is the thread that runs the saver. Each
//! record of a sensor is a separate text. A record is used only if the sensor still has the same port or, for a
//! background, the same pose. A record that is wrong nevertheless costs only time.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, poll};
use scanhub_config::{Config, Link};
use scanhub_drivers::line::BEAM_RANGE;
pub use scanhub_drivers::line::KnownRate;
use scanhub_drivers::search::Memory;
use scanhub_drivers::{Model, features};
use scanhub_port::{PortSpec, clock};
use scanhub_schema::{Age, Background, BackgroundFile, Failure, Family, Kind, MILLIS, Nanos, Pose, as_json};
use scanhub_shm::StateDirectory;
use serde::{Deserialize, Serialize};

use crate::platform::SavedState;
use crate::process::{EventFd, no_resource};

/// Storage for named texts that outlives the hub.
pub trait StateStore {
    /// Returns the text of `name`, or `None` if it does not exist.
    ///
    /// # Errors
    ///
    /// Returns an error if the text cannot be read, or has more than `max_len` bytes.
    fn read(&self, name: &str, max_len: u64) -> Result<Option<String>, Failure>;

    /// Replaces the text of `name`, as a whole or not at all.
    ///
    /// # Errors
    ///
    /// Returns an error if the text cannot be written; the previous text then stays.
    fn write(&self, name: &str, text: &str) -> Result<(), Failure>;

    /// Removes the text of `name`, if it exists.
    ///
    /// # Errors
    ///
    /// Returns an error if the text cannot be removed.
    fn remove(&self, name: &str) -> Result<(), Failure>;

    /// Returns the location of the text of `name`, for a message.
    fn location(&self, name: &str) -> String;
}

impl StateStore for StateDirectory {
    fn read(&self, name: &str, max_len: u64) -> Result<Option<String>, Failure> {
        self.read(name, max_len)
    }

    fn write(&self, name: &str, text: &str) -> Result<(), Failure> {
        self.write(name, text)
    }

    fn remove(&self, name: &str) -> Result<(), Failure> {
        self.remove(name)
    }

    fn location(&self, name: &str) -> String {
        self.path(name).display().to_string()
    }
}

/// Writer of the state that links have handed over. The saver never waits and reads no clock: the time is an argument,
/// and the deadline of the next write is returned.
pub struct StateSaver<F> {
    store: F,
    queue: Arc<SaveQueue>,
    /// State of the background files, in the order of the slots.
    backgrounds: Vec<BackgroundWrites>,
}

/// State that all links have handed over.
pub struct SaveQueue {
    slots: Vec<LinkSlot>,
    /// Event that is readable when a link has handed something over.
    event: EventFd,
}

/// State of one link.
struct LinkSlot {
    sensor: String,
    /// The newest background that the saver has not taken yet.
    background: Mutex<Option<(Pose, Box<Background>)>>,
    /// Wall clock at which the saved background was written; 0 if no background is saved.
    saved_wall_ns: AtomicU64,
    /// Rate at which the scanner was found last.
    rate: SavedRecord<KnownRate>,
    /// Scanner that the search found last.
    scanner: SavedRecord<KnownScanner>,
}

/// A link's access to its slot.
#[derive(Clone, Copy)]
pub struct SaveSlot<'a> {
    queue: &'a SaveQueue,
    slot: &'a LinkSlot,
}

/// Schedule of the writes to the background file of one link.
#[derive(Default)]
struct BackgroundWrites {
    /// Generation that this hub has written last.
    generation: Option<u32>,
    /// Background that is written at `due`.
    pending: Option<(Pose, Box<Background>)>,
    due: Nanos,
    /// Whether the last failed write was logged.
    is_failure_logged: bool,
}

impl<F: StateStore> StateSaver<F> {
    /// Loads the saved state of the links of `config` from `store`: puts saved backgrounds into the configuration, and
    /// returns the saver for the links' new state. There is no saver if all links play recordings. `wall_ns` is the
    /// current time.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::ResourceExhausted`] if no descriptors are left.
    pub fn load(
        mut config: Config,
        store: F,
        wall_ns: u64,
    ) -> Result<(Config, Option<StateSaver<F>>), Failure> {
        let is_live = |link: &&mut Link| !matches!(link.port, PortSpec::File { .. });
        let slot = |link: &mut Link| LinkSlot {
            sensor: link.name.clone(),
            background: Mutex::default(),
            saved_wall_ns: AtomicU64::new(load_background(link, &store, wall_ns)),
            // Only a tty has a rate that the hub can change.
            rate: SavedRecord::load(&link.name, &store, matches!(link.port, PortSpec::Tty(_))),
            scanner: SavedRecord::load(&link.name, &store, link.family().is_none()),
        };
        let slots: Vec<_> = config.links.iter_mut().filter(is_live).map(slot).collect();
        if slots.is_empty() {
            return Ok((config, None));
        }
        let backgrounds = slots.iter().map(|_| BackgroundWrites::default()).collect();
        let queue = Arc::new(SaveQueue { slots, event: EventFd::new()? });
        Ok((config, Some(StateSaver { store, queue, backgrounds })))
    }

    /// Returns the queue that the links share with the saver.
    pub fn queue(&self) -> Arc<SaveQueue> {
        self.queue.clone()
    }

    /// Writes the state that is due at `now`: the first background of a generation at once, later ones once a minute,
    /// and everything at the end of the hub (`is_last`). Returns the time of the next write; `Nanos::MAX` if nothing
    /// waits.
    pub fn flush_due(&mut self, now: Nanos, wall_ns: u64, is_last: bool) -> Nanos {
        let mut next = Nanos::MAX;
        for (slot, writes) in self.queue.slots.iter().zip(&mut self.backgrounds) {
            slot.rate.write(&slot.sensor, &self.store);
            slot.scanner.write(&slot.sensor, &self.store);
            writes.pending = lock(&slot.background).take().or(writes.pending.take());
            let Some((pose, model)) = &writes.pending else { continue };
            if !is_last && writes.generation == Some(model.generation) && now < writes.due {
                next = next.min(writes.due);
                continue;
            }
            if let Err(failure) = slot.write_background(&self.store, *pose, model, wall_ns)
                && !std::mem::replace(&mut writes.is_failure_logged, true)
            {
                tracing::warn!("{}: {}; {}", slot.sensor, failure.message, failure.hint);
            }
            (writes.generation, writes.due) = (Some(model.generation), now + WRITE_INTERVAL);
            writes.pending = None;
        }
        next
    }
}

impl SaveQueue {
    /// Returns the slot of `sensor`.
    pub fn slot(&self, sensor: &str) -> Option<SaveSlot<'_>> {
        let slot = self.slots.iter().find(|slot| slot.sensor == sensor)?;
        Some(SaveSlot { queue: self, slot })
    }
}

impl SavedState for SaveSlot<'_> {
    fn save_background(&self, pose: Pose, model: Box<Background>) {
        *lock(&self.slot.background) = Some((pose, model));
        self.queue.event.signal();
    }

    fn saved_wall_ns(&self) -> Option<u64> {
        Some(self.slot.saved_wall_ns.load(Ordering::Relaxed)).filter(|&wall_ns| wall_ns != 0)
    }

    fn rate(&self, port: &str) -> Option<KnownRate> {
        self.slot.rate.for_port(port)
    }

    fn scanner(&self, port: &str) -> Option<KnownScanner> {
        self.slot.scanner.for_port(port)
    }

    fn save_scanner(&self, port: &str, scanner: KnownScanner) {
        if self.slot.scanner.replace(port, scanner) {
            self.queue.event.signal();
        }
    }

    fn save_rate(&self, port: &str, rate: KnownRate) {
        if self.slot.rate.replace(port, rate) {
            self.queue.event.signal();
        }
    }
}

impl LinkSlot {
    /// Writes `model` into the background file. A model without a known beam removes the file, because the saved model
    /// is then outdated.
    fn write_background(
        &self,
        store: &impl StateStore,
        pose: Pose,
        model: &Background,
        wall_ns: u64,
    ) -> Result<(), Failure> {
        let file = background_file(&self.sensor);
        if model.known_beams == 0 {
            // A hub that did not start with the saved model removes it only after a reset of its own model.
            let was_saved = self.saved_wall_ns.swap(0, Ordering::Relaxed) != 0;
            let is_outdated = was_saved || model.generation > 0;
            return if is_outdated { store.remove(&file) } else { Ok(()) };
        }
        store.write(&file, &background_text(&self.sensor, pose, model, wall_ns)?)?;
        self.saved_wall_ns.store(wall_ns, Ordering::Relaxed);
        Ok(())
    }
}

/// Thread that writes the state of the links. Dropping it ends the thread, after it has written everything.
pub(crate) struct StateWriter {
    queue: Arc<SaveQueue>,
    is_ending: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl StateWriter {
    /// Starts the thread for `saver`.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::ResourceExhausted`] if no thread can be started.
    pub(crate) fn start(mut saver: StateSaver<StateDirectory>) -> Result<StateWriter, Failure> {
        let (queue, is_ending) = (saver.queue(), Arc::new(AtomicBool::new(false)));
        let (thread_queue, thread_is_ending) = (queue.clone(), is_ending.clone());
        let body = move || {
            loop {
                thread_queue.event.clear();
                let is_last = thread_is_ending.load(Ordering::Relaxed);
                let now = clock::now();
                let next = saver.flush_due(now, clock::to_wall_ns(now, now), is_last);
                if is_last {
                    return;
                }
                let span = (next < Nanos::MAX).then(|| clock::poll_timeout(now, next));
                // The queue is checked after every wait, whatever has ended it.
                let _ = poll(&mut [PollFd::new(&thread_queue.event, PollFlags::IN)], span.as_ref());
            }
        };
        let thread = thread::Builder::new().name(THREAD_NAME.into()).spawn(body);
        let thread = thread.map_err(|error| no_resource("a thread", &error))?;
        Ok(StateWriter { queue, is_ending, thread: Some(thread) })
    }

    /// Returns the queue that the links share with the thread.
    pub(crate) fn queue(&self) -> &SaveQueue {
        &self.queue
    }
}

impl Drop for StateWriter {
    fn drop(&mut self) {
        self.is_ending.store(true, Ordering::Relaxed);
        self.queue.event.signal();
        // A thread that panicked has already printed why.
        let _ = self.thread.take().map(JoinHandle::join);
    }
}

/// Scanner that was found at a port.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct KnownScanner {
    /// Family of the scanner, and its baud rates.
    pub memory: Memory,
    /// Name of the model in lower case, if the scanner has reported it.
    pub model: Option<String>,
    /// Number of beams of its scans, if the session has measured it.
    pub beams: Option<usize>,
}

impl KnownScanner {
    /// Returns the model and the number of beams, if both are known.
    pub(crate) fn beams_of_model(&self) -> Option<(Model, usize)> {
        let models = features(self.memory.family).models;
        let model = models.iter().find(|model| self.model.as_deref() == Some(model.name))?;
        Some((*model, self.beams.filter(|beams| BEAM_RANGE.contains(beams))?))
    }
}

/// Record about the scanner at a port. The text of the record is a line of words without spaces, which ends with the
/// name of the port.
///
/// After power-on, a scanner has the same rate each time, so a search that starts at the saved rate avoids the timeouts
/// of the other rates.
trait PortRecord: Clone + PartialEq {
    /// Extension of the file's name.
    const EXTENSION: &'static str;
    /// Number of words before the name of the port.
    const FIELD_COUNT: usize;

    /// Returns the words, separated by spaces.
    fn fields(&self) -> String;

    /// Parses the words. Returns `None` if a word is damaged.
    fn parse(fields: &[&str]) -> Option<Self>;
}

impl PortRecord for KnownScanner {
    const EXTENSION: &'static str = "scanner";
    const FIELD_COUNT: usize = 5;

    fn fields(&self) -> String {
        let KnownScanner { memory: Memory { family, stream_rate, reply_rate }, model, beams } = self;
        let model = model.as_deref().filter(|model| !model.contains(char::is_whitespace));
        let (model, beams) = (model.unwrap_or(UNKNOWN), beams.map(|beams| beams.to_string()));
        let beams = beams.as_deref().unwrap_or(UNKNOWN);
        format!("{} {model} {stream_rate} {reply_rate} {beams}", family.name())
    }

    fn parse(fields: &[&str]) -> Option<KnownScanner> {
        let &[family, model, stream_rate, reply_rate, beams] = fields else { return None };
        let (stream_rate, reply_rate) = (stream_rate.parse().ok()?, reply_rate.parse().ok()?);
        let beams = if beams == UNKNOWN { None } else { Some(beams.parse().ok()?) };
        let memory = Memory { family: Family::parse(family)?, stream_rate, reply_rate };
        Some(KnownScanner { memory, model: (model != UNKNOWN).then(|| model.to_owned()), beams })
    }
}

impl PortRecord for KnownRate {
    const EXTENSION: &'static str = "rate";
    const FIELD_COUNT: usize = 1;

    fn fields(&self) -> String {
        match self.silent_switches {
            0 => self.baud.to_string(),
            count => format!("{}{SILENT_SWITCHES_KEY}{count}", self.baud),
        }
    }

    fn parse(fields: &[&str]) -> Option<KnownRate> {
        let &[rate] = fields else { return None };
        let (baud, silent_switches) = rate.split_once(SILENT_SWITCHES_KEY).unwrap_or((rate, "0"));
        Some(KnownRate { baud: baud.parse().ok()?, silent_switches: silent_switches.parse().ok()? })
    }
}

/// A record, which a link replaces and the writer's thread saves.
struct SavedRecord<K>(Mutex<RecordState<K>>);

struct RecordState<K> {
    /// The record and the port that it belongs to.
    record: Option<(K, String)>,
    /// Whether the record must be written.
    is_new: bool,
}

impl<K: PortRecord> SavedRecord<K> {
    /// Reads the record of `sensor` from `store`, if the link uses it.
    fn load(sensor: &str, store: &impl StateStore, is_used: bool) -> SavedRecord<K> {
        let text = is_used.then(|| store.read(&record_file::<K>(sensor), MAX_RECORD_LEN));
        let text = text.transpose().unwrap_or_else(|failure| {
            tracing::warn!("{sensor}: {}; {}", failure.message, failure.hint);
            None
        });
        let record = text.flatten().as_deref().and_then(parse_record);
        SavedRecord(Mutex::new(RecordState { record, is_new: false }))
    }

    /// Returns the record, if it belongs to `port`.
    fn for_port(&self, port: &str) -> Option<K> {
        let RecordState { record: known, .. } = &*lock(&self.0);
        known.as_ref().filter(|(_, of)| of == port).map(|(known, _)| known.clone())
    }

    /// Replaces the record. Returns whether the previous record was different.
    fn replace(&self, port: &str, record: K) -> bool {
        let record = Some((record, port.to_owned()));
        let mut state = lock(&self.0);
        let is_new = state.record != record;
        if is_new {
            *state = RecordState { record, is_new };
        }
        is_new
    }

    /// Writes the record of `sensor` if it has changed since it was last written. The lock is released first, so that a
    /// link need not wait for the disk.
    fn write(&self, sensor: &str, store: &impl StateStore) {
        let text = {
            let mut state = lock(&self.0);
            let is_new = std::mem::take(&mut state.is_new);
            state.record.as_ref().filter(|_| is_new).map(|(known, port)| record_text(known, port))
        };
        if let Some(text) = text
            && let Err(failure) = store.write(&record_file::<K>(sensor), &text)
        {
            tracing::warn!("{sensor}: {}; {}", failure.message, failure.hint);
        }
    }
}

/// Returns the line for the record of the scanner at `port`.
fn record_text<K: PortRecord>(record: &K, port: &str) -> String {
    format!("{} {port}\n", record.fields())
}

/// Returns the record and the port in `text`. Returns `None` if `text` is damaged.
fn parse_record<K: PortRecord>(text: &str) -> Option<(K, String)> {
    let fields: Vec<_> = text.strip_suffix('\n')?.splitn(K::FIELD_COUNT + 1, ' ').collect();
    let (port, known) = fields.split_last().filter(|_| fields.iter().all(|word| !word.is_empty()))?;
    Some((K::parse(known)?, (*port).to_owned()))
}

fn record_file<K: PortRecord>(sensor: &str) -> String {
    format!("{sensor}.{}", K::EXTENSION)
}

/// Text of a saved background: the same as in a file of `scanhub background SENSOR save`, and in addition the pose of
/// the sensor and the time.
#[derive(Serialize)]
struct BackgroundText<M> {
    #[serde(flatten)]
    model: M,
    #[serde(flatten)]
    context: BackgroundContext,
}

#[derive(Deserialize, Serialize)]
struct BackgroundContext {
    pose: PoseText,
    wall_ns: u64,
}

#[derive(Deserialize, Serialize)]
struct PoseText {
    x: f64,
    y: f64,
    yaw: f64,
    upside_down: bool,
}

/// Puts the saved background of `link` into its settings, if the background fits the link and the configuration does
/// not set how the background starts. Returns the time at which the background was written, in ns since 1970; 0 if no
/// background is used.
fn load_background(link: &mut Link, store: &impl StateStore, now_wall_ns: u64) -> u64 {
    let name = &link.name;
    let background = &mut link.processing.background;
    if !background.is_enabled || !background.is_saved || background.is_start_set {
        return 0;
    }
    let file = background_file(name);
    let text = match store.read(&file, MAX_BACKGROUND_LEN) {
        Ok(Some(text)) => text,
        Ok(None) => return 0,
        Err(failure) => {
            tracing::warn!("{name}: the background starts empty: {}; {}", failure.message, failure.hint);
            return 0;
        }
    };
    match read_background(&text, &store.location(&file), link) {
        Ok((model, wall_ns)) => {
            let age = Age(Duration::from_nanos(now_wall_ns.saturating_sub(wall_ns)));
            let (known_beams, count) = (model.known_beams, model.count);
            tracing::info!(
                "{}: starts with the background saved {age} ago, {known_beams} of {count} beams known",
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

/// Returns the line for the background of `sensor`.
fn background_text(sensor: &str, pose: Pose, model: &Background, wall_ns: u64) -> Result<String, Failure> {
    let Pose { x_m: x, y_m: y, yaw_rad: yaw, upside_down, .. } = pose;
    let pose = PoseText { x, y, yaw, upside_down: upside_down != 0 };
    let text = BackgroundText { model: as_json(sensor, model), context: BackgroundContext { pose, wall_ns } };
    let written = serde_json::to_string(&text);
    written.map(|text| text + "\n").map_err(|error| {
        Failure::new(
            Kind::Failed,
            format!("the background of {sensor} cannot be written as JSON: {error}"),
            "",
        )
    })
}

/// Returns the background in `text`, which was read from `location`, and the time at which it was written.
///
/// # Errors
///
/// Returns the reason if `text` is damaged, or if `link` cannot start with this background.
fn read_background(text: &str, location: &str, link: &Link) -> Result<(Box<Background>, u64), String> {
    let BackgroundFile { sensor, model, .. } =
        BackgroundFile::parse(text.as_bytes(), location).map_err(|failure| failure.message)?;
    let BackgroundContext { pose, wall_ns } = serde_json::from_str(text)
        .map_err(|error| format!("{location} does not contain its time: {error}"))?;
    if sensor != link.name {
        return Err(format!("{location} is the background of {sensor}"));
    }
    if let Err(expected) = link.check_background(&model) {
        let (count, unit_mm) = (model.count, model.unit_um / 1000);
        return Err(format!(
            "{location} has {count} beams in units of {unit_mm} mm, the link is configured for {expected}"
        ));
    }
    let Pose { x_m, y_m, yaw_rad, upside_down, .. } = link.processing.pose;
    let is_near = |saved: f64, configured: f64| (saved - configured).abs() < POSE_TOLERANCE;
    let is_at_pose = is_near(pose.x, x_m) && is_near(pose.y, y_m) && is_near(pose.yaw, yaw_rad);
    if !is_at_pose || pose.upside_down != (upside_down != 0) {
        return Err(format!("{location} belongs to another pose: the sensor was moved"));
    }
    Ok((model, wall_ns))
}

fn background_file(sensor: &str) -> String {
    format!("{sensor}.background.json")
}

/// Locks `mutex`. Each value is replaced as a whole, so it is valid even if a thread panicked while it held the lock.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Name of the writer's thread.
const THREAD_NAME: &str = "learned";
/// Interval of the writes of a background. A hub that is killed loses at most the changes of this time.
const WRITE_INTERVAL: Nanos = 60_000 * MILLIS;
/// Maximum length of a background's text in bytes; the text of a real background is much shorter.
const MAX_BACKGROUND_LEN: u64 = 1 << 20;
/// Maximum length of a record's text in bytes: words, and a port, which is at most as long as a path.
const MAX_RECORD_LEN: u64 = 8_192;
/// Tolerance of a pose in meters and radians: far more than a number loses when it is written as text.
const POSE_TOLERANCE: f64 = 1e-9;
/// Word in a record for a model, or a number of beams, that is not known.
const UNKNOWN: &str = "-";
/// Key in a record, before the number of switches of the rate that were followed by silence.
const SILENT_SWITCHES_KEY: &str = ",silent=";

#[cfg(test)]
mod tests {
    use super::*;
    use scanhub_config::Sources;
    use scanhub_schema::BackgroundHead;

    const PORT: &str = "/dev/serial/by-id/usb-FTDI 1";

    fn saver(link: &str, state: &StateDirectory) -> StateSaver<StateDirectory> {
        let sources = Sources { links: vec![link.to_owned()], ..Sources::default() };
        let config = Config::load(&sources).expect("a configuration");
        StateSaver::load(config, state.clone(), 0).expect("descriptors").1.expect("a live link")
    }

    #[test]
    fn saved_rate_applies_only_to_same_link_and_port() {
        let root = tempfile::tempdir().unwrap();
        let state = StateDirectory::at(root.path().join("state"));
        let known = |name: &str, port: &str| {
            let saver = saver(&format!("{name}={port}"), &state);
            saver.queue().slot(name).and_then(|slot| slot.rate(port))
        };
        assert_eq!(known("front", PORT), None, "the first one");
        for (baud, silent_switches) in [(9_600, 0), (38_400, 2), (500_000, 0)] {
            let rate = KnownRate { baud, silent_switches };
            let mut saver = saver(&format!("front={PORT}"), &state);
            saver.queue().slot("front").expect("a slot").save_rate(PORT, rate);
            assert_eq!(saver.flush_due(1, 1, true), Nanos::MAX);
            assert_eq!(known("front", PORT), Some(rate));
            assert_eq!((known("rear", PORT), known("front", "/dev/ttyUSB0")), (None, None));
        }
        // A text that is too long is ignored.
        state.write("front.rate", &"9".repeat(10_000)).unwrap();
        assert_eq!(known("front", PORT), None);
    }

    #[test]
    fn saved_scanner_applies_only_to_same_link_and_port() {
        let root = tempfile::tempdir().unwrap();
        let state = StateDirectory::at(root.path().join("state"));
        let memory = Memory { family: Family::Ld, stream_rate: 921_600, reply_rate: 921_600 };
        let scanner = KnownScanner { memory, model: Some("stl27l".to_owned()), beams: Some(2_160) };
        let mut first = saver("front=/dev/x,family=auto", &state);
        first.queue().slot("front").expect("a slot").save_scanner("/dev/x", scanner.clone());
        first.flush_due(1, 1, true);
        for (link, port, expected) in [
            ("front=/dev/x,family=auto", "/dev/x", Some(&scanner)),
            ("front=/dev/y,family=auto", "/dev/y", None),
            ("rear=/dev/x,family=auto", "/dev/x", None),
            ("front=/dev/x,family=ld", "/dev/x", None),
        ] {
            let name = &link[..link.find('=').expect("a link")];
            let known = saver(link, &state).queue().slot(name).and_then(|slot| slot.scanner(port));
            assert_eq!(known.as_ref(), expected, "{link}");
        }
    }

    #[test]
    fn recording_has_no_saved_state() {
        let sources = Sources { links: vec!["front=file:x".into()], ..Sources::default() };
        let config = Config::load(&sources).expect("a configuration");
        let (_, saver) = StateSaver::load(config, StateDirectory::at("/nowhere"), 0).expect("descriptors");
        assert!(saver.is_none());
    }

    /// Checks that the text of `known` is `line` with the port, and that no incomplete text is accepted.
    fn check<K: PortRecord + std::fmt::Debug>(known: &K, line: &str) {
        let text = record_text(known, PORT);
        assert_eq!(text, format!("{line} {PORT}\n"));
        assert_eq!(parse_record(&text), Some((known.clone(), PORT.to_owned())));
        for len in 0..text.len() {
            assert_eq!(parse_record::<K>(&text[..len]), None, "cut after {len} bytes");
        }
    }

    #[test]
    fn records_round_trip_and_damaged_ones_are_rejected() {
        let memory = Memory { family: Family::Lms, stream_rate: 500_000, reply_rate: 9_600 };
        let scanner = KnownScanner { memory, model: Some("lms291".to_owned()), beams: None };
        check(&scanner, "lms lms291 500000 9600 -");
        check(&KnownScanner { model: None, beams: Some(450), ..scanner.clone() }, "lms - 500000 9600 450");
        let spaced = KnownScanner { model: Some("a b".to_owned()), ..scanner };
        assert!(record_text(&spaced, PORT).starts_with("lms - 500000 "));
        for (silent_switches, line) in [(0, "38400"), (2, "38400,silent=2")] {
            check(&KnownRate { baud: 38_400, silent_switches }, line);
        }
        for damaged in ["sick - 1 2 - /x\n", "ld - x 2 - /x\n", "ld - 1 2 - \n", "ld  1 2 - /x\n"] {
            assert_eq!(parse_record::<KnownScanner>(damaged), None, "{damaged:?}");
        }
        for damaged in ["", "9600\n", "x /dev/x\n", " /dev/x\n", "\n\n", "9600,silent= /x\n"] {
            assert_eq!(parse_record::<KnownRate>(damaged), None, "{damaged:?}");
        }
    }

    fn link(set: &[&str]) -> Link {
        let set = set.iter().map(|flag| (*flag).to_owned()).collect();
        let sources = Sources { files: Vec::new(), links: vec!["front=/dev/x".into()], set };
        Config::load(&sources).unwrap().links.remove(0)
    }

    fn background() -> Box<Background> {
        let head = BackgroundHead {
            first_angle: -90_f64.to_radians(),
            step: 0.5_f64.to_radians(),
            generation: 3,
            unit_um: 1000,
            known_beams: 2,
            ..BackgroundHead::default()
        };
        let mut model = Background::of(head, &[0; 361]);
        model.ranges_mut()[..2].copy_from_slice(&[4000, Background::FAR]);
        model
    }

    const WALL_NS: u64 = 1_790_000_000_123_456_789;

    #[test]
    fn background_round_trips_for_same_sensor_and_pose() {
        let set =
            ["link.front.pose.x=0.1", "link.front.pose.yaw=-1.5708", "link.front.pose.upside_down=true"];
        let own = link(&set);
        let model = background();
        let text = background_text("front", own.processing.pose, &model, WALL_NS).unwrap();
        assert_eq!(read_background(&text, "f", &own), Ok((model, WALL_NS)));
        let saved = BackgroundFile::parse(text.as_bytes(), "f").unwrap();
        assert_eq!((saved.sensor.as_str(), saved.model.known_beams), ("front", 2), "a user can load it");
        for (change, why) in [
            ("link.front.pose.x=0.101", "another pose"),
            ("link.front.pose.yaw=1.5708", "another pose"),
            ("link.front.pose.upside_down=false", "another pose"),
            ("link.front.resolution=1", "the link is configured for 181 beams in units of 1 mm"),
            ("link.front.unit=cm", "the link is configured for 361 beams in units of 10 mm"),
        ] {
            let other = link(&[&set[..], &[change]].concat());
            let refusal = read_background(&text, "f", &other).unwrap_err();
            assert!(refusal.contains(why), "{change}: {refusal}");
        }
    }

    #[test]
    fn damaged_background_is_refused() {
        let own = link(&[]);
        let text = background_text("front", own.processing.pose, &background(), WALL_NS).unwrap();
        for (from, to) in [
            ("\"front\"", "\"rear\""),
            ("\"wall_ns\"", "\"wall\""),
            ("\"known_beams\":2", "\"known_beams\":3"),
            ("\"yaw\":0.0", "\"yaw\":null"),
        ] {
            assert!(text.contains(from), "{from}");
            assert!(read_background(&text.replacen(from, to, 1), "f", &own).is_err(), "{from}");
        }
        assert!((0..text.len() - 1).all(|length| read_background(&text[..length], "f", &own).is_err()));
    }
}
