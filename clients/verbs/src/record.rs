//! `scanhub record`: what the hub publishes, in MCAP files. The thread that receives never touches the disk, so that a
//! slow, full or missing disk costs no live topic a sample. What is missing in the recording is counted, reported, and
//! visible in the file.

mod disk;
mod files;
mod lock;
mod output_error;
mod part;
mod queue;
mod report;
mod selection;
mod writer_progress;

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{self, ErrorKind, IsTerminal, Write};
use std::os::fd::AsFd;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use scanhub_client::clock;
use scanhub_client::streams::Sample;
use scanhub_files::output::Target;
use scanhub_schema::file::Compression;
use scanhub_schema::{Failure, Header, Kind};
use scanhub_shm::Domain;

use crate::follow::{Bounds, Event, Following};
use crate::lossy_writer::LossyWriter;
use crate::names::TopicName;
use crate::output::{End, quiet};
use crate::receive_stats::ReceiveStats;
use disk::Disk;
use files::Files;
pub use files::Split;
use part::{Form, Style};
use queue::{Entry, Gap, Queue};
use report::Report;
use selection::Selection;
use writer_progress::{News, WriterProgress};

/// What `record` is asked for.
#[derive(Clone, Debug)]
pub struct RecordOptions {
    /// `SENSOR/TOPIC` or `*/TOPIC`; none: what is usual, of all sensors.
    pub topics: Vec<String>,
    /// All topics instead of the usual ones.
    pub everything: bool,
    /// Scans as messages of ROS 2 and where the sensors sit, and nothing else.
    pub ros2: bool,
    /// How its chunks are packed.
    pub compression: Compression,
    /// The file; `-` is stdout, and without one it is named after the time.
    pub file: Option<PathBuf>,
    /// What stands at the file's place is overwritten.
    pub force: bool,
    /// When it goes on in the next file.
    pub split: Option<Split>,
    /// Number of files that are kept; the oldest are removed first. With `force`, files of earlier runs count too.
    pub keep: Option<usize>,
    /// How it tells of itself.
    pub look: RecordLook,
    /// When it ends by itself.
    pub bounds: Bounds,
    /// Where the domain may be, see [`Domain::candidates`].
    pub places: Vec<Domain>,
}

impl RecordOptions {
    /// The file that stands for stdout.
    pub const STDOUT: &str = "-";

    fn is_to_stdout(&self) -> bool {
        self.file.as_deref() == Some(Path::new(Self::STDOUT))
    }
}

/// How a recorder tells of itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RecordLook {
    /// Lines at the begin, at the end and when something happens.
    Lines,
    /// Objects, once a second too.
    Json,
    /// A line that is drawn over itself.
    Terminal,
}

/// Records until the bounds are reached or `stop` is set, and finishes the file; set again meanwhile, the end is not waited
/// for. How far it is goes to `out`, and what is no account to `notes` (stderr) if `out` is not JSON; lines for which there
/// is no room are left out before they delay what is recorded.
///
/// [`Kind::Output`] if there is no file to be had, [`Kind::Failed`] if its end cannot be written, [`Kind::Short`] if either is for
/// lack of room; [`Kind::Usage`] if stdout is no place for
/// it; else as [`echo`](crate::echo()).
pub fn record(
    options: &RecordOptions,
    out: &mut (impl Write + AsFd),
    notes: &mut (impl Write + AsFd),
    stop: &AtomicBool,
) -> Result<(), Failure> {
    let selection = Selection::parse(&options.topics, options.everything, options.ros2)?;
    let queue = Arc::new(Queue::new());
    let disk = match begin(options, &queue) {
        Ok(disk) => disk,
        Err(end) => return quiet(Err(end)),
    };
    let (first, older) = (disk.path(), disk.surplus_older());
    let over = AtomicBool::new(false);
    let terminal = out.as_fd().try_clone_to_owned().ok();
    let (mut out, mut notes) = (LossyWriter::around(out, &over), LossyWriter::around(notes, &over));
    let mut report = Report::new(options.look, &mut out, &mut notes, terminal);
    let begun = report.begin(&first, older);
    let mut recorder = Recorder {
        progress: disk.progress(),
        tracks: Vec::new(),
        queue: queue.clone(),
        pushed: 0,
        left_out: 0,
        gap: None,
        tick_at: Instant::now(),
        report,
        over: &over,
    };
    let writing = thread::Builder::new().name("disk".into()).spawn(move || disk.run());
    let writing = writing
        .map_err(|error| Failure::new(Kind::Short, format!("no thread: {error}"), "see `ulimit -u`"))?;
    let (names, topics) = (selection.names(), selection.topics());
    let mut following = Following::new(&names, &topics, &options.places, &options.bounds, stop).with_lines();
    let end = begun.and_then(|()| {
        let end = recorder.run(&mut following);
        following.finish(end, |name, stats| recorder.summary(name, stats))
    });
    // If the hub or the reader of these lines went away, the recording is kept.
    let stays = recorder.pushed > 0 || !matches!(end, Err(End::Failure(_)));
    let finished = recorder.finish(writing, stays, stop);
    if !stays && !options.is_to_stdout() {
        // A hub or sensor that is not there leaves nothing behind.
        files::discard(&first);
    }
    quiet(end).and(quiet(finished))
}

/// The first file.
fn begin(options: &RecordOptions, queue: &Arc<Queue>) -> Result<Disk, End> {
    let wall_ns = clock::wall_ns();
    let usual = files::usual_name(wall_ns);
    let path = options.file.as_deref().unwrap_or(&usual);
    let failed = |error: io::Error| output_error::failed(path, options.split.is_some(), &error);
    let files = match options.is_to_stdout() {
        true if options.split.is_some() => {
            return Err(Failure::new(Kind::Usage, "stdout cannot be split", "leave --split out").into());
        }
        true if io::stdout().is_terminal() => {
            let hint = "for example `scanhub record -o - | ssh host 'cat > walk.mcap'`";
            return Err(Failure::new(Kind::Usage, "a recording cannot be written to a terminal", hint).into());
        }
        true => Err(File::from(io::stdout().as_fd().try_clone_to_owned().map_err(failed)?)),
        false => {
            let target = Target::open(path)?;
            // A split run adds numbers to the name.
            if options.split.is_none() {
                target.check(options.force)?;
            }
            let run = wall_ns.to_string();
            Ok(Files::new(path, options.split.is_some(), options.force, options.keep, &run))
        }
    };
    let form = if options.ros2 { Form::Ros2 } else { Form::Hub };
    let style = Style { form, compression: options.compression };
    let begun = Disk::begin(queue.clone(), files, options.split, style, facts(options, wall_ns));
    begun.map_err(|error| match error.kind() {
        ErrorKind::BrokenPipe => output_error::reader_gone(0).into(),
        _ => failed(error).into(),
    })
}

/// What the recording says of itself.
fn facts(options: &RecordOptions, wall_ns: u64) -> BTreeMap<String, String> {
    let host = fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
    let domain = options.places.first().map(Domain::name).unwrap_or_default();
    let facts = [
        ("domain", domain),
        ("host", host.trim()),
        ("version", env!("CARGO_PKG_VERSION")),
        ("started", &files::iso(wall_ns)),
        ("started_ns", &wall_ns.to_string()),
    ];
    facts.map(|(key, value)| (key.to_owned(), value.to_owned())).into()
}

/// A sample that is kept for the next file.
struct Kept {
    came_at: Instant,
    header: Header,
    payload: Vec<u8>,
}

struct Recorder<'a> {
    queue: Arc<Queue>,
    progress: Arc<WriterProgress>,
    tracks: Vec<TopicName>,
    /// Samples handed to the writing thread.
    pushed: u64,
    /// Samples for which there was no room.
    left_out: u64,
    gap: Option<Gap>,
    tick_at: Instant,
    report: Report<'a>,
    /// Nothing is received any more: now readers of lines may be waited for.
    over: &'a AtomicBool,
}

impl Recorder<'_> {
    /// A sample for which there is no room: from here on all are left out, until there is room again for many.
    fn leave_out(&mut self, name: &TopicName) -> Result<(), End> {
        self.left_out += 1;
        let is_first = self.gap.is_none();
        let now_ns = clock::wall_ns();
        let gap =
            self.gap.get_or_insert_with(|| Gap { from_ns: now_ns, to_ns: now_ns, left_out: Vec::new() });
        match gap.left_out.iter_mut().find(|(other, _)| other == name) {
            Some((_, count)) => *count += 1,
            None => gap.left_out.push((name.clone(), 1)),
        }
        if is_first { self.report.gap_begins() } else { Ok(()) }
    }

    /// The gap is over: it is put down in the file, and told.
    fn end_gap(&mut self) -> Result<(), End> {
        let Some(mut gap) = self.gap.take() else { return Ok(()) };
        gap.to_ns = clock::wall_ns();
        let told = self.report.gap_ends(&gap);
        self.queue.note(Entry::Gap(gap));
        told
    }

    fn look(&mut self) -> Result<(), End> {
        let stats = self.progress.look();
        for news in stats.news.iter() {
            if *news == News::ReaderGone {
                return Err(output_error::reader_gone(stats.samples).into());
            }
            self.report.disk(news)?;
        }
        self.report.progress(&stats, self.left_out)
    }

    /// Waits until all of it is written, and says what came of it, if it `stays`. A second wish to stop ends that, too.
    fn finish(
        mut self,
        writing: JoinHandle<io::Result<()>>,
        stays: bool,
        stop: &AtomicBool,
    ) -> Result<(), End> {
        self.over.store(true, Ordering::Relaxed);
        stop.store(false, Ordering::Relaxed);
        let told = self.end_gap();
        self.queue.end();
        let mut second = SecondStop::default();
        while !writing.is_finished() {
            if second.poll(stop.swap(false, Ordering::Relaxed)) {
                let what = "the disk had not stored the end of the recording when a second signal came";
                return Err(Failure::new(Kind::Failed, what, REPAIR).into());
            }
            thread::sleep(LOOK_EVERY);
        }
        let written = writing.join().unwrap_or_else(|_| Err(io::Error::other("the writing thread panicked")));
        let stats = self.progress.look();
        if let Err(error) = written {
            if error.kind() == ErrorKind::BrokenPipe {
                return Err(output_error::reader_gone(stats.samples).into());
            }
            let missing = self.pushed - stats.samples;
            let what =
                format!("the end of the recording cannot be written: {error}; {missing} samples are missing");
            return Err(Failure::new(output_error::kind(&error), what, REPAIR).into());
        }
        told.and_then(|()| stats.news.iter().try_for_each(|news| self.report.disk(news)))?;
        if stays { self.report.end(&stats, self.left_out) } else { Ok(()) }
    }

    fn run(&mut self, following: &mut Following<'_>) -> Result<(), End> {
        while let Some(event) = following.next(None)? {
            match event {
                Event::Begun(name) => {
                    self.queue.note(Entry::Track(TopicName::clone(&name)));
                    self.tracks.push(TopicName::clone(&name));
                }
                Event::Sample(name, sample, _) => self.sample(&name, &sample)?,
                Event::Notice(names, notice) => self.report.hub(&names, notice)?,
                Event::Tick(now) if now >= self.tick_at => {
                    self.tick_at = now + LOOK_EVERY;
                    self.look()?;
                }
                _ => {}
            }
        }
        Ok(())
    }

    fn sample(&mut self, name: &TopicName, sample: &Sample) -> Result<(), End> {
        let Some(header) = sample.header() else { return Ok(()) };
        if self.gap.is_some() {
            if !self.queue.is_roomy() {
                return self.leave_out(name);
            }
            self.end_gap()?;
        }
        let Some(track) = self.tracks.iter().position(|track| track == name) else { return Ok(()) };
        if !self.queue.push(track, header, sample.bytes().len(), |room| sample.pack_said(room)) {
            return self.leave_out(name);
        }
        self.pushed += 1;
        Ok(())
    }

    fn summary(&mut self, name: &TopicName, stats: &ReceiveStats) -> Result<(), End> {
        self.over.store(true, Ordering::Relaxed);
        self.report.topic(name, stats)
    }
}

/// Distinguishes a second request to stop from the signals that belong to the first one. A shell that loses its terminal
/// sends another SIGHUP than the terminal, and both may arrive after SIGINT. They come within a second, but a busy machine
/// may not run this process for that long. Therefore polls are counted, and not time.
#[derive(Default)]
struct SecondStop {
    polls: u32,
}

impl SecondStop {
    /// Polls that take the signals of one request.
    const SAME_REQUEST: u32 = 20;

    /// Counts a poll. Returns whether a signal since the last poll is a second request to stop.
    fn poll(&mut self, is_signaled: bool) -> bool {
        self.polls += 1;
        is_signaled && self.polls > Self::SAME_REQUEST
    }
}

/// So often it is looked what the writing thread says.
const LOOK_EVERY: Duration = Duration::from_millis(50);
/// What can be done with a file that has no end.
const REPAIR: &str = "what is in the file can be read; `scanhub convert` gives it an index";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_second_request_to_stop_comes_later_than_the_signals_of_the_first() {
        let mut second = SecondStop::default();
        // A signal at every poll, however long each of them takes.
        assert!((0..SecondStop::SAME_REQUEST).all(|_| !second.poll(true)));
        assert!(!second.poll(false));
        assert!(second.poll(true));
        assert!(LOOK_EVERY * SecondStop::SAME_REQUEST >= Duration::from_secs(1));
    }
}
