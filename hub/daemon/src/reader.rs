//! Reader of a recording that needs no hub. The code of a replay computes the samples, and they stay in the memory of
//! this process.
//!
//! A link plays each sensor, as in [`replay`](fn@crate::replay) at maximum rate, so the payloads are equal to those of
//! a replay, bit for bit. The reader never waits and starts no thread. [`RecordingReader::step`] plays the next
//! telegram of the sensor whose telegram ends first, and publishes its samples into a queue. The reader needs memory
//! for these samples, but not for the whole file.

use std::borrow::{Borrow, BorrowMut};
use std::collections::VecDeque;
use std::convert::Infallible;
use std::fmt::Debug;
use std::io;
use std::marker::PhantomData;
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use bytemuck::cast_slice_mut;
use scanhub_config::{Config, Link, Sources};
use scanhub_port::{PortError, PortSpec, ReadBudget, SettingsChange};
use scanhub_recording::Recording;
use scanhub_schema::{DoorbellWord, Failure, Family, Header, Kind, Nanos, Topic, WakeEvent};
use scanhub_shm::{LoanError, Payload, SampleTransport, SendError};
use self_cell::self_cell;

use crate::control::CommandSender;
use crate::link::LinkState;
use crate::platform::{Platform, PortIo, SavedState};
use crate::player::DueTime;
use crate::replay::{
    self, CLOCK_START, Lap, LinkDescription, MAX_STAMP, RecordedSensor, ReplayLink, ReplayTiming,
};
use crate::replay_hub::RecordedSet;

/// Options of a [`RecordingReader`].
#[derive(Clone, Copy, Debug)]
pub struct ReadOptions<'a> {
    /// The recording.
    pub file: &'a Path,
    /// Name of the only sensor to read; `None` for all sensors. If the recording has no sensor names, its sensor gets
    /// this name.
    pub sensor: Option<&'a str>,
    /// Family of the scanners; `None` if the reader recognizes the family from the recording.
    pub family: Option<Family>,
    /// Configuration of the sensors in the recording.
    pub sources: &'a Sources,
    /// Topics to read.
    pub topics: &'a [Topic],
}

/// Reader of a recording.
///
/// Stamps are by the clock of the hub that made the recording. If the recording contains several runs of the hub, all
/// stamps are by the clock of the first run. The stamps of a recording without stamps start at 10 s.
pub struct RecordingReader {
    links: OwnedLinks,
    queue: Arc<SampleQueue>,
    recording: Recording,
}

/// A sample that was computed from a recording.
#[derive(Debug)]
pub struct ReadSample {
    /// Name of the sensor.
    pub sensor: Arc<str>,
    /// Topic of the sample.
    pub topic: Topic,
    /// Header of the sample.
    pub header: Header,
    /// The payload, filled up to whole words with zeros.
    pub words: Vec<u64>,
    /// Number of bytes of the payload.
    pub len: usize,
}

self_cell!(
    struct OwnedLinks {
        owner: Parts,
        #[not_covariant]
        dependent: Links,
    }
);

/// Values that the links borrow.
struct Parts {
    config: Config,
    recorded: Vec<RecordedSensor>,
    platforms: Vec<MemoryPlatform>,
}

type Links<'a> = Vec<ReadLink<'a>>;

impl RecordingReader {
    /// Returns the topics that a link publishes from whole telegrams: all except early warnings, which need parts of
    /// telegrams.
    pub fn topics() -> impl Iterator<Item = Topic> {
        Topic::OF_LINKS.into_iter().filter(|topic| *topic != Topic::Early)
    }

    /// Opens a recording. This reads the file to its end once.
    ///
    /// # Errors
    ///
    /// Returns [`Kind::Input`] if the recording cannot be read, [`Kind::NoTopic`] if the recording does not contain the
    /// sensor or if a topic is not computed from telegrams, and [`Kind::Configuration`] if the recording contradicts
    /// the configuration. Returns [`Kind::ResourceExhausted`] if no descriptors are left.
    pub fn open(options: &ReadOptions<'_>) -> Result<RecordingReader, Failure> {
        for topic in options.topics {
            check(*topic)?;
        }
        let recording = Recording::open_as(options.file, options.family)?;
        let RecordedSet { recording, config, parts, origin, .. } =
            RecordedSet::new(recording, options.sensor, options.sources)?;
        check_family(options.family, &recording, &config, &parts)?;
        let queue = Arc::new(SampleQueue::default());
        let (boot, begin) = origin.and_then(|origin| origin.run).unwrap_or((0, CLOCK_START));
        let begin = begin.min(MAX_STAMP);
        let begin_wall_ns = origin.map_or(begin, |origin| origin.wall_ns);
        let platform = |name: &str| MemoryPlatform {
            sensor: name.into(),
            topics: options.topics.to_vec(),
            queue: queue.clone(),
            begin,
            begin_wall_ns,
            now: AtomicU64::new(begin),
        };
        let platforms = config.links.iter().map(|link| platform(&link.name)).collect();
        let parts = Parts { config, recorded: parts, platforms };
        let links = OwnedLinks::try_new(parts, |parts| links(parts, boot))?;
        Ok(RecordingReader { links, queue, recording })
    }

    /// Returns the names of the sensors that are read.
    pub fn sensors(&self) -> Vec<&str> {
        self.links.borrow_owner().config.links.iter().map(|link| link.name.as_str()).collect()
    }

    /// Returns messages about the recording: damage, and values that cannot be read.
    pub fn problems(&self) -> Vec<String> {
        let damage = self.recording.contents().damage;
        let damage = (!damage.is_none()).then(|| format!("missing: {damage}"));
        let Parts { config, recorded, .. } = self.links.borrow_owner();
        let of_links = recorded.iter().zip(&config.links).flat_map(|(part, link)| {
            let problem = part.problem(&link.name);
            let problem = (!problem.is_empty()).then(|| format!("{}: {problem}", link.name));
            problem.into_iter().chain(part.losses(&link.name))
        });
        damage.into_iter().chain(of_links).collect()
    }

    /// Returns a failure if the reader has reached the end of a file that became shorter or unreadable after it was
    /// opened. The failure is returned only once.
    pub fn take_shortfall(&mut self) -> Option<Failure> {
        let lacks: Vec<_> = self.links.with_dependent_mut(|parts, links| {
            let of_links = parts.config.links.iter().zip(links);
            let lacks = |(link, read_link): (&Link, &mut ReadLink<'_>)| {
                read_link.shortfall.take().map(|shortfall| format!("{} lacks {shortfall}", link.name))
            };
            of_links.filter_map(lacks).collect()
        });
        if lacks.is_empty() {
            return None;
        }
        let (path, lacks) = (self.recording.path().display(), lacks.join(", "));
        let message = format!("recording {path} became shorter while it was read: {lacks}");
        Some(Failure::new(Kind::Input, message, "read it again when no program writes the file"))
    }

    /// Plays the next telegram, or a few bytes of a stream. Returns false at the end of the recording.
    pub fn step(&mut self) -> bool {
        self.links.with_dependent_mut(|_, links| {
            let next = links.iter_mut().filter_map(|link| Some((link.next_media()?, link)));
            let Some((_, link)) = next.min_by_key(|(media, _)| *media) else { return false };
            link.step();
            true
        })
    }

    /// Returns the oldest sample of the last steps that was not returned yet.
    pub fn pop(&mut self) -> Option<ReadSample> {
        self.queue.0.lock().unwrap_or_else(PoisonError::into_inner).pop_front()
    }
}

/// Iterates over all samples. Plays the next telegram when the queue is empty.
impl Iterator for RecordingReader {
    type Item = ReadSample;

    fn next(&mut self) -> Option<ReadSample> {
        loop {
            if let Some(sample) = self.pop() {
                return Some(sample);
            }
            if !self.step() {
                return None;
            }
        }
    }
}

/// Checks that a replay publishes `topic`.
fn check(topic: Topic) -> Result<(), Failure> {
    if RecordingReader::topics().any(|known| known == topic) {
        return Ok(());
    }
    let names: Vec<_> = RecordingReader::topics().map(Topic::name).collect();
    let message = format!("{} is not computed from a recording", topic.name());
    Err(Failure::new(Kind::NoTopic, message, format!("the topics are {}", names.join(", "))))
}

/// Checks that the scanners are of family `named`, if the caller named one.
fn check_family(
    named: Option<Family>,
    recording: &Recording,
    config: &Config,
    parts: &[RecordedSensor],
) -> Result<(), Failure> {
    let mut of_links = config.links.iter().zip(parts);
    let other = of_links.find(|(_, part)| named.is_some_and(|named| named != part.family()));
    let (Some(named), Some((link, part))) = (named, other) else { return Ok(()) };
    let (path, family) = (recording.path().display(), part.family().name());
    let message = format!(
        "the scanner of {} in recording {path} is of family {family}, and not {}",
        link.name,
        named.name()
    );
    Err(Failure::new(Kind::Configuration, message, format!("leave the family out, or name {family}")))
}

fn links(parts: &Parts, boot: u64) -> Result<Links<'_>, Failure> {
    let Parts { config, recorded, platforms } = parts;
    let (_, queues) = CommandSender::new(config.links.iter().map(|link| link.name.as_str()))?;
    let mut links = Vec::with_capacity(queues.len());
    for (number, ((link, queue), (recorded, platform))) in
        config.links.iter().zip(queues).zip(recorded.iter().zip(platforms)).enumerate()
    {
        let mut core = LinkState::new(link, number as u8, boot, platform, queue)?;
        replay::begin(&mut core);
        let mut replay = ReplayLink::new(core, recorded, ImmediateTiming);
        replay.set_begin(recorded);
        let lap = Lap::new(&replay, recorded)?;
        links.push(ReadLink { replay, phase: Phase::Playing(lap), shortfall: None });
    }
    Ok(links)
}

/// Link of one sensor.
struct ReadLink<'a> {
    replay: ReplayLink<'a, MemoryPlatform, ImmediateTiming>,
    phase: Phase<'a>,
    /// Data that the file contained when it was opened, and lacked at the end of the reading.
    shortfall: Option<String>,
}

enum Phase<'a> {
    Playing(Lap<'a>),
    /// The recording has ended. The last verdict becomes stale at this media time.
    Expiring(Nanos),
    Over,
}

impl ReadLink<'_> {
    /// Returns the media time of the next step; `None` at the end.
    fn next_media(&self) -> Option<Nanos> {
        match &self.phase {
            // When the lap has no further telegram, the next step ends it.
            Phase::Playing(lap) => Some(lap.next_media().unwrap_or(0)),
            Phase::Expiring(media) => Some(*media),
            Phase::Over => None,
        }
    }

    fn step(&mut self) {
        let platform = self.replay.link.platform;
        match &mut self.phase {
            Phase::Playing(lap) if lap.next_media().is_some() => drop(lap.step(&mut self.replay)),
            Phase::Playing(lap) => {
                lap.end(&mut self.replay);
                self.shortfall = lap.shortfall();
                let stale_at = self.replay.link.output.stale_at();
                self.phase = match stale_at {
                    Nanos::MAX => Phase::Over,
                    _ => Phase::Expiring(stale_at.saturating_sub(platform.begin)),
                };
            }
            Phase::Expiring(media) => {
                let now = platform.advance(*media);
                self.replay.link.output.expire_verdict(now, Nanos::MAX);
                self.phase = Phase::Over;
            }
            Phase::Over => {}
        }
    }
}

/// Timing in which every telegram is due at once, and gets its recorded time.
struct ImmediateTiming;

impl ReplayTiming<MemoryPlatform> for ImmediateTiming {
    fn range(&self) -> (Nanos, Option<Nanos>) {
        (0, None)
    }

    fn wait_until_due(
        &mut self,
        link: &mut LinkState<'_, MemoryPlatform>,
        media: Nanos,
        _: LinkDescription<'_>,
    ) -> Option<DueTime> {
        Some(DueTime::at_once(link.platform.advance(media)))
    }

    fn continue_skipping(&mut self, _: &mut LinkState<'_, MemoryPlatform>, _: &str) -> bool {
        true
    }

    fn note_played(&mut self, _: Nanos) {}
}

/// Samples that were published and not taken.
#[derive(Default)]
struct SampleQueue(Mutex<VecDeque<ReadSample>>);

/// Platform of a link whose topics are in the memory of this process, and whose clock is that of the recording.
struct MemoryPlatform {
    sensor: Arc<str>,
    /// Topics that have a subscriber.
    topics: Vec<Topic>,
    queue: Arc<SampleQueue>,
    /// CLOCK_MONOTONIC and the wall clock at media time 0, in ns.
    begin: Nanos,
    begin_wall_ns: u64,
    now: AtomicU64,
}

impl MemoryPlatform {
    /// Sets the clock to media time `media`, unless the clock is already later. Returns the time of the clock.
    fn advance(&self, media: Nanos) -> Nanos {
        let now = self.begin.saturating_add(media).min(MAX_STAMP).max(self.now());
        self.now.store(now, Ordering::Relaxed);
        now
    }
}

impl Platform for MemoryPlatform {
    type Port = Infallible;
    type Transport<P: Payload + ?Sized> = MemoryTopic<P>;

    fn now(&self) -> Nanos {
        self.now.load(Ordering::Relaxed)
    }

    fn wall_ns(&self) -> u64 {
        self.begin_wall_ns.saturating_add(self.now() - self.begin)
    }

    fn pause(&self, _: Nanos) {}

    fn take_name(&self) -> Result<(), Failure> {
        Ok(())
    }

    fn open(&self, _: &PortSpec, _: u32) -> Option<Result<Infallible, PortError>> {
        None
    }

    fn explain(&self, error: &PortError, source: &PortSpec) -> Failure {
        error.explain(source)
    }

    fn altering_program(&self, _: &PortSpec) -> Option<String> {
        None
    }

    fn take_kept_port(&self, _: &str, _: &PortSpec, _: u32) -> Option<Infallible> {
        None
    }

    fn keep_open(&self, _: &str, _: &Infallible) {}

    fn release(&self, _: &str) {}

    fn transport<P: Payload + ?Sized>(&self, _: &str) -> Result<MemoryTopic<P>, Failure> {
        let queue = self.topics.contains(&P::TOPIC).then(|| self.queue.clone());
        Ok(MemoryTopic { sensor: self.sensor.clone(), queue, payload: PhantomData })
    }

    fn attach_count(&self) -> Option<u32> {
        // The subscribers never change.
        Some(0)
    }

    fn has_listeners(&self) -> bool {
        false
    }

    fn ring(&self, _: DoorbellWord) {}

    fn notify_event(&self, _: WakeEvent) {}

    fn load_record(&self, _: &str, _: &mut [u8]) -> Option<usize> {
        None
    }

    fn store_record(&self, _: &str, _: &[u8]) {}

    fn saved_state(&self) -> Option<&dyn SavedState> {
        None
    }
}

/// A topic in the memory of this process.
struct MemoryTopic<P: ?Sized> {
    sensor: Arc<str>,
    /// Queue of the only subscriber; `None` without a subscriber.
    queue: Option<Arc<SampleQueue>>,
    payload: PhantomData<fn(&P)>,
}

impl<P: Payload + ?Sized> SampleTransport<P> for MemoryTopic<P> {
    type Loan = P::Owned;

    fn subscribers(&self) -> usize {
        usize::from(self.queue.is_some())
    }

    fn connect(&self) -> Result<(), impl Debug + use<P>> {
        Ok::<(), Infallible>(())
    }

    fn loan(&self, len: usize) -> Result<P::Owned, LoanError> {
        Ok(P::owned(len))
    }

    fn payload_mut(loan: &mut P::Owned) -> &mut P {
        loan.borrow_mut()
    }

    fn send(&self, loan: P::Owned, header: &Header) -> Result<usize, SendError> {
        if let Some(queue) = &self.queue {
            let payload: &P = loan.borrow();
            let bytes = payload.bytes();
            let (mut words, len) = (vec![0; bytes.len().div_ceil(8)], bytes.len());
            cast_slice_mut(&mut words)[..len].copy_from_slice(bytes);
            let (sensor, header) = (self.sensor.clone(), *header);
            let sample = ReadSample { sensor, topic: P::TOPIC, header, words, len };
            queue.0.lock().unwrap_or_else(PoisonError::into_inner).push_back(sample);
        }
        Ok(self.subscribers())
    }
}

/// A recording has no line.
impl PortIo for Infallible {
    fn read(&self, _: &mut [u8]) -> io::Result<usize> {
        match *self {}
    }

    fn write(&self, _: &[u8]) -> io::Result<()> {
        match *self {}
    }

    fn set_baud(&self, _: u32) -> io::Result<Option<io::Error>> {
        match *self {}
    }

    fn alteration(&self) -> io::Result<Option<SettingsChange>> {
        match *self {}
    }

    fn restore(&self, _: u32) -> io::Result<()> {
        match *self {}
    }

    fn set_dtr(&self, _: bool) -> io::Result<()> {
        match *self {}
    }

    fn buffered_len(&self) -> Option<usize> {
        match *self {}
    }

    fn read_budget(&self, _: u32) -> Option<ReadBudget> {
        match *self {}
    }

    fn line_errors(&self) -> u64 {
        match *self {}
    }

    fn device(&self) -> Option<&Path> {
        match *self {}
    }

    fn is_simulated(&self) -> bool {
        match *self {}
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;
    use std::fs::File;

    use scanhub_drivers::lms;
    use scanhub_drivers::lms::variant::{Mode, Unit};
    use scanhub_schema::MILLIS;
    use scanhub_schema::file::Writer;
    use tempfile::TempDir;

    use super::*;

    /// Times of the first and the last byte of a telegram, in ms.
    type Times = (u64, u64);

    fn read(file: &Path, topics: &[Topic]) -> Result<RecordingReader, Failure> {
        let sources = Sources::default();
        RecordingReader::open(&ReadOptions { file, sensor: None, family: None, sources: &sources, topics })
    }

    /// Writes a log of scans at `times`, in s.
    fn write_log(file: &Path, times: &[f64]) {
        let ranges = " 1.0".repeat(180);
        let line = |time| format!("FLASER 180{ranges} 0 0 0 0 0 0 {time} host {time}\n");
        std::fs::write(file, times.iter().map(line).collect::<String>()).unwrap();
    }

    /// Writes a recording of sensors, each with the times of its scans. The first telegram of each sensor reports its
    /// measuring mode.
    fn write_mcap(file: &Path, sensors: &[(&str, Vec<Times>)]) {
        let mut writer = Writer::begin(File::create(file).unwrap(), "", BTreeMap::new()).unwrap();
        let mode = lms::reply::configuration_reply(0, Mode(1), Unit::Mm, 0x10);
        let scan = lms::measured::encode(0, Unit::Mm, &[1000; 181], 0x10);
        for (number, (name, scans)) in sensors.iter().enumerate() {
            for (seq, (first_ms, last_ms)) in scans.iter().enumerate() {
                let mut header = Header {
                    seq: seq as u64,
                    topic_seq: seq as u64,
                    stamp_first_ns: first_ms.saturating_mul(MILLIS),
                    stamp_last_ns: last_ms.saturating_mul(MILLIS),
                    wall_ns: first_ms.saturating_add(1_000_000).saturating_mul(MILLIS),
                    boot: 7,
                    sensor: number as u8,
                    period_us: 40_000,
                    ..Header::default()
                };
                header.set_sent_at(last_ms.saturating_mul(MILLIS).saturating_add(100_000));
                let telegram = if seq == 0 { &mode } else { &scan };
                writer.write_sample(name, Topic::Telegram, &header, telegram.bytes()).unwrap();
                if seq % 100 == 99 {
                    writer.close_chunk().unwrap();
                }
            }
        }
        writer.finish().unwrap();
    }

    #[test]
    fn samples_with_maximum_stamps_are_read() {
        let folder = TempDir::new().unwrap();
        let file = folder.path().join("a");
        write_log(&file, &[5.0, 4.0, 1e18, 2.0]);
        let topics: Vec<_> = RecordingReader::topics().collect();
        let count = |topic| read(&file, &topics).unwrap().filter(|sample| sample.topic == topic).count();
        assert_eq!(count(Topic::Scan), 4);
        let last_ms = u64::MAX / MILLIS;
        for begin_ms in [i64::MAX as u64 / MILLIS - 50, last_ms - 20, last_ms] {
            let scans = (0..6).map(|at| begin_ms.saturating_add(at * 9)).map(|at| (at, at)).collect();
            write_mcap(&file, &[("front", scans)]);
            assert_eq!(count(Topic::Scan), 5, "{begin_ms}");
        }
    }

    /// Returns for each sample its sensor, whether it is the verdict of a silent sensor, and its last stamp in ms.
    fn order(file: &Path) -> Vec<(Arc<str>, bool, u64)> {
        let samples = read(file, &[Topic::Scan, Topic::Zones]).unwrap();
        let of = |sample: ReadSample| {
            let is_verdict = sample.topic == Topic::Zones;
            (sample.sensor, is_verdict, sample.header.stamp_last_ns / MILLIS)
        };
        let samples = samples.map(of);
        // The verdict on a scan has the stamps of that scan.
        let mut last = BTreeMap::new();
        samples.filter(|(sensor, _, at)| last.insert(sensor.clone(), *at) != Some(*at)).collect()
    }

    #[test]
    fn samples_are_sorted_by_last_byte() {
        let folder = TempDir::new().unwrap();
        let file = folder.path().join("a.mcap");
        // A telegram of `slow` takes 190 ms, and a telegram of `fast` 3 ms.
        let slow = (0..20).map(|at| (1_000 + at * 200, 1_190 + at * 200)).collect();
        let fast = (0..100).map(|at| (1_003 + at * 40, 1_006 + at * 40)).collect();
        write_mcap(&file, &[("slow", slow), ("fast", fast)]);
        let order = order(&file);
        let ends: Vec<_> = order.iter().map(|(_, _, at)| *at).collect();
        assert!(ends.is_sorted(), "{order:?}");
        assert!(ends.len() >= 118, "{order:?}");
    }

    #[test]
    fn stale_verdict_is_sorted_by_expiry_time() {
        let folder = TempDir::new().unwrap();
        let file = folder.path().join("a.mcap");
        let every = |times: std::ops::Range<u64>| times.step_by(40).map(|at| (at, at + 14));
        let front = every(1_000..2_000).chain(every(6_000..7_000)).collect();
        write_mcap(&file, &[("front", front), ("rear", every(1_005..7_500).collect())]);
        let order = order(&file);
        let ends: Vec<_> = order.iter().map(|(_, _, at)| *at).collect();
        assert!(ends.is_sorted(), "{order:?}");
        let is_stale = |(sensor, is_verdict, _): &&(Arc<str>, bool, u64)| &**sensor == "front" && *is_verdict;
        let stale: Vec<_> = order.iter().filter(is_stale).map(|(_, _, at)| *at).collect();
        assert!(matches!(stale[..], [_, 1_980..2_500, 6_980..7_500]), "{stale:?}");
    }

    #[test]
    fn file_truncated_while_reading_is_an_error() {
        let folder = TempDir::new().unwrap();
        let (log, mcap) = (folder.path().join("a.log"), folder.path().join("a.mcap"));
        write_log(&log, &(0..500).map(f64::from).collect::<Vec<_>>());
        write_mcap(&mcap, &[("front", (0..3_000).map(|at| (at * 40, at * 40 + 14)).collect())]);
        let telegram = lms::measured::encode(0, Unit::Mm, &[1000; 181], 0x10);
        let stream = folder.path().join("a.bin");
        std::fs::write(&stream, telegram.bytes().repeat(2_000)).unwrap();
        for (file, unit) in [(log, "telegrams"), (mcap, "telegrams"), (stream, "bytes")] {
            let mut whole = read(&file, &[Topic::Telegram]).unwrap();
            let count = whole.by_ref().count();
            assert!(whole.take_shortfall().is_none());
            let mut cut = read(&file, &[Topic::Telegram]).unwrap();
            cut.next().unwrap();
            let len = std::fs::metadata(&file).unwrap().len();
            File::options().write(true).open(&file).unwrap().set_len(len / 2).unwrap();
            assert!(cut.by_ref().count() < count - 1, "{unit}");
            let failure = cut.take_shortfall().unwrap();
            assert_eq!(failure.kind, Kind::Input);
            assert!(failure.message.ends_with(unit), "{failure}");
            assert!(cut.take_shortfall().is_none());
        }
    }

    #[test]
    fn reports_unencodable_ranges_as_a_problem() {
        let folder = TempDir::new().unwrap();
        let file = folder.path().join("a.log");
        std::fs::write(&file, format!("FLASER 180{} 0 0 0 0 0 0 1 host 1\n", " 900.0".repeat(180))).unwrap();
        let problems = read(&file, &[Topic::Scan]).unwrap().problems();
        assert!(matches!(&problems[..], [only] if only.contains("180 ranges are too long")), "{problems:?}");
    }

    #[test]
    fn mismatched_family_is_refused() {
        let folder = TempDir::new().unwrap();
        let file = folder.path().join("a.bin");
        let telegram = lms::measured::encode(0, Unit::Mm, &[1000; 181], 0x10);
        std::fs::write(&file, telegram.bytes().repeat(20)).unwrap();
        let sources = Sources::default();
        let open = |family| {
            let topics = &[Topic::Scan];
            let options = ReadOptions { file: &file, sensor: None, family, sources: &sources, topics };
            RecordingReader::open(&options)
        };
        assert_eq!(open(Some(Family::Lms)).unwrap().count(), 20);
        let failure = open(Some(Family::Ld)).err().unwrap();
        assert_eq!(failure.kind, Kind::Configuration);
        assert!(failure.message.contains("family lms, and not ld"), "{failure}");
    }
}
