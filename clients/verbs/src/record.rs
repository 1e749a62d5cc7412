//! `scanhub record`: writes the topics of a hub to MCAP files.
//!
//! The path of a sample, from top to bottom:
//!
//! 1. The topics: `RecordArgs::run` subscribes to the selected topics, and `Recorder::run` receives their samples.
//! 2. The queue (`Queue`) is bounded. A sample for which the queue has no room is dropped, counted and reported, and
//!    becomes part of a `Gap` in the file.
//! 3. The disk thread (`DiskWriter::run`) takes the whole queue ten times a second. Only this thread accesses the disk,
//!    so a slow, full or missing disk does not delay any live topic.
//! 4. The file (`RecordingFile`) builds a chunk from the entries and writes it. `Files` names the files and removes old
//!    files.
//! 5. The report (`Report`) prints the progress of the disk thread and the result.

mod disk;
mod files;
mod queue;
mod recording_file;
mod report;

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{self, ErrorKind, IsTerminal};
use std::os::fd::AsFd;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use clap::Args;
use scanhub_client::clock;
use scanhub_client::streams::Sample;
use scanhub_files::output::Target;
use scanhub_schema::file::Compression;
use scanhub_schema::{Failure, Kind, Topic};
use scanhub_shm::Domain;

use self::disk::{Destination, DiskWriter};
use self::files::{Files, Split};
use self::queue::{Entry, Gap, Queue, WriterEvent, WriterProgress};
use self::recording_file::{FileOptions, Form};
use self::report::{Report, ReportForm};
use crate::context::Context;
use crate::follow::{Event, RunLimits, TopicRun};
use crate::names::{Selection, TopicName};
use crate::output::{ExitReason, LossyWriter, verb_result};
use crate::receive_stats::ReceiveStats;

/// Record topics in MCAP files
#[derive(Args, Clone, Debug)]
#[command(after_help = AFTER_HELP)]
pub struct RecordArgs {
    /// Topics to record: front/telegram, */scan for all sensors, or front/* for all topics of a sensor [default:
    /// telegram, marks, zones, foreground and status of all sensors, tracks and events of trackers, tilt of mounts and
    /// obstacles]
    #[arg(value_name = "SENSOR/TOPIC")]
    topics: Vec<String>,
    /// Record every topic of all sensors
    #[arg(long, conflicts_with = "topics")]
    all: bool,
    /// Write ROS 2 messages only: scans as sensor_msgs/msg/LaserScan, and /tf_static from the poses
    #[arg(long)]
    ros2: bool,
    /// Compression: zstd, lz4 or none
    #[arg(long, value_name = "NAME", default_value = "zstd", value_parser = Compression::parse)]
    compression: Compression,
    /// File to write; - for stdout [default: scanhub-DATE-TIME.mcap]
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// Overwrite an existing file. With --split, keep existing files, continue after their numbers, and let --keep
    /// remove them later
    #[arg(short, long)]
    force: bool,
    /// Size or time after which another file starts, for example 512MiB or 1h. The files are called FILE-0001.mcap,
    /// FILE-0002.mcap ..
    #[arg(long, value_name = "SIZE|DURATION", value_parser = Split::parse)]
    split: Option<Split>,
    /// Keep only the last COUNT files of this run. With --force, files FILE-NNNN.mcap of earlier runs count too
    #[arg(long, value_name = "COUNT", requires = "split", value_parser = clap::value_parser!(u32).range(1..))]
    keep: Option<u32>,
    #[command(flatten)]
    limits: RunLimits,
}

const AFTER_HELP: &str = "\
Examples:
  scanhub record
  scanhub record --ros2 -o ros.mcap --for 10m
  scanhub record --all --split 512MiB --keep 20
  scanhub record -o walk.mcap --split 1h --keep 20 --force

Any MCAP reader opens the files, and `scanhub replay FILE` plays them. Ctrl-C finishes the file. If the disk is full,
record waits for space and continues. It reports the missing samples, which are a gap in the file's sequence numbers.";

/// Topics that are recorded by default: telegrams, from which all others can be computed again, and the most important
/// results.
const DEFAULT_TOPICS: [Topic; 9] = [
    Topic::Telegram,
    Topic::Marks,
    Topic::Zones,
    Topic::Foreground,
    Topic::Status,
    Topic::Tracks,
    Topic::Events,
    Topic::Tilt,
    Topic::Obstacles,
];

/// Interval at which the receiving thread polls the progress of the disk thread.
const POLL_INTERVAL: Duration = Duration::from_millis(50);

/// Hint for a file without an end.
const REPAIR: &str = "the data in the file can be read; `scanhub convert` adds an index";

impl RecordArgs {
    /// Returns whether the recording goes to stdout. Nothing else is then written to stdout.
    pub fn is_to_stdout(&self) -> bool {
        self.output.as_deref() == Some(Path::new("-"))
    }

    /// Records until the limits are reached or a signal arrives, and then finishes the file. Another signal while the
    /// file is being finished ends the run at once. Progress goes to stdout, or to stderr if the recording goes to
    /// stdout. Notices go to stderr without `--json`. If the reader of the lines is slow, lines are dropped, so that
    /// they do not delay the recording.
    ///
    /// # Errors
    ///
    /// - [`Kind::Usage`] if the topics cannot be recorded, or not to stdout.
    /// - [`Kind::Output`] if no file can be created, and [`Kind::Failed`] if its end cannot be written. If space is
    ///   short, the kind is [`Kind::ResourceExhausted`] in both cases.
    /// - The errors of [`echo`](crate::echo::EchoArgs::run).
    pub fn run(&self, context: &mut Context) -> Result<(), Failure> {
        // Any signal that ends the run must finish the file.
        let (locations, stop) = (context.domain.locations()?, context.signals.any_stop()?);
        let stderr = self.is_to_stdout().then(|| context.notes.try_clone()).transpose();
        let mut stderr = stderr.map_err(no_stderr)?;
        let (names, topics) = selection(&self.topics, self.all, self.ros2)?;
        let queue = Arc::new(Queue::new());
        let disk = self.create_file(&locations, &queue)?;
        let (file, surplus) = (disk.path(), disk.surplus_older());

        let out = stderr.as_mut().unwrap_or(&mut context.out);
        let form = ReportForm::of(context.json, out.is_terminal());
        let terminal = out.as_fd().try_clone_to_owned().ok();
        let is_over = AtomicBool::new(false);
        let mut out = LossyWriter::new(out, &is_over);
        let mut notes = LossyWriter::new(&mut context.notes, &is_over);
        let mut report = Report::new(form, &mut out, &mut notes, terminal);
        let started = report.begin(&file, surplus);

        let mut recorder = Recorder::start(queue, disk, report, &is_over)?;
        let mut following = TopicRun::new(&names, &topics, &locations, &self.limits, &stop).with_lines();
        let end = started.and_then(|()| {
            let end = recorder.run(&mut following);
            following.finish(end, |name, stats| recorder.summary(name, stats))
        });

        // Keep the recording even if the hub exited or the reader of the lines closed them.
        let is_kept = recorder.pushed > 0 || !matches!(end, Err(ExitReason::Failure(_)));
        let finished = recorder.finish(is_kept, &stop);
        if !is_kept && !self.is_to_stdout() {
            // A run without a hub or sensor leaves no file.
            files::discard(&file);
        }
        verb_result(end).and(verb_result(finished))
    }

    /// Creates the first file, or uses stdout. Returns the disk thread that writes the samples of `queue` there.
    fn create_file(&self, locations: &[Domain], queue: &Arc<Queue>) -> Result<DiskWriter, Failure> {
        let wall_ns = clock::wall_ns();
        let default = files::default_name(wall_ns);
        let path = self.output.as_deref().unwrap_or(&default);
        let destination = match self.is_to_stdout() {
            true => Destination::Stream(self.stdout()?),
            false => Destination::Files(self.files(path, wall_ns)?),
        };
        let form = if self.ros2 { Form::Ros2 } else { Form::Hub };
        let options = FileOptions { form, compression: self.compression };
        let disk = DiskWriter::begin(
            queue.clone(),
            destination,
            self.split,
            options,
            description(locations, wall_ns),
        );
        disk.map_err(|error| match error.kind() {
            ErrorKind::BrokenPipe => reader_closed(0),
            _ => no_file(path, self.split.is_some(), &error),
        })
    }

    /// Returns the files of a run that starts at `wall_ns`. The names of the files derive from `path`.
    fn files(&self, path: &Path, wall_ns: u64) -> Result<Files, Failure> {
        let target = Target::open(path)?;
        // With --split, the names have numbers, so `path` itself is not written.
        let is_split = self.split.is_some();
        if !is_split {
            target.check(self.force)?;
        }
        let keep = self.keep.map(|keep| keep as usize);
        Ok(Files::new(path, is_split, self.force, keep, &wall_ns.to_string()))
    }

    /// Returns stdout as a file, if a recording may be written to stdout.
    fn stdout(&self) -> Result<File, Failure> {
        if self.split.is_some() {
            return Err(Failure::new(Kind::Usage, "stdout cannot be split", "leave --split out"));
        }
        if io::stdout().is_terminal() {
            let hint = "for example `scanhub record -o - | ssh host 'cat > walk.mcap'`";
            return Err(Failure::new(Kind::Usage, "a recording cannot be written to a terminal", hint));
        }
        let stdout = io::stdout().as_fd().try_clone_to_owned();
        stdout.map(File::from).map_err(|error| no_file(Path::new("-"), false, &error))
    }
}

/// Returns the topics in `texts`, as topics of named sensors and topics of all sensors. Without `texts`, returns the
/// default topics, or all topics if `everything` is set. With `ros2`, returns scans, and statuses for the poses of the
/// sensors.
///
/// # Errors
///
/// [`Kind::Usage`] if a topic does not exist, no hub publishes it, or ROS has no message for it.
fn selection(
    texts: &[String],
    everything: bool,
    ros2: bool,
) -> Result<(Vec<TopicName>, Vec<Topic>), Failure> {
    let mut chosen = Selection::parse(texts)?;
    if texts.is_empty() {
        chosen.of_all = match (everything, ros2) {
            (true, true) => return Err(no_message("--all")),
            (false, true) => vec![Topic::Scan],
            (true, false) => Topic::ALL.to_vec(),
            (false, false) => DEFAULT_TOPICS.to_vec(),
        };
    }
    if let Some(robot) = chosen.named.iter().find(|name| name.is_robot()) {
        let hint = "`*/zones` records the zones of each sensor";
        return Err(Failure::new(Kind::Usage, format!("{robot} is computed by the subscriber"), hint));
    }
    if ros2 {
        let named = chosen.named.iter().map(|name| name.topic);
        if let Some(other) = named.chain(chosen.of_all.iter().copied()).find(|&topic| topic != Topic::Scan) {
            return Err(no_message(&format!("topic {}", other.name())));
        }
        let status = |name: &TopicName| TopicName { topic: Topic::Status, ..name.clone() };
        let statuses: Vec<_> = chosen.named.iter().map(status).collect();
        chosen.named.extend(statuses);
        chosen.of_all.extend(chosen.of_all.first().map(|_| Topic::Status));
    }
    let mut names: Vec<TopicName> = Vec::new();
    for name in chosen.named {
        if !names.contains(&name) {
            names.push(name);
        }
    }
    Ok((names, Topic::ALL.into_iter().filter(|topic| chosen.of_all.contains(topic)).collect()))
}

fn no_message(what: &str) -> Failure {
    let message = format!("--ros2 records only ROS messages, and {what} is not one: only scans are");
    let hint = "record without --ros2, and convert later: `scanhub convert IN.mcap OUT.mcap --ros2`";
    Failure::new(Kind::Usage, message, hint)
}

/// Returns the description of the run that the recording contains.
fn description(locations: &[Domain], wall_ns: u64) -> BTreeMap<String, String> {
    let host = fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
    let domain = locations.first().map(Domain::name).unwrap_or_default();
    let fields = [
        ("domain", domain),
        ("host", host.trim()),
        ("version", env!("CARGO_PKG_VERSION")),
        ("started", &files::iso(wall_ns)),
        ("started_ns", &wall_ns.to_string()),
    ];
    fields.map(|(key, value)| (key.to_owned(), value.to_owned())).into()
}

/// Receiving side of a run. It adds samples to the queue, and reports the events of the disk thread.
struct Recorder<'a> {
    queue: Arc<Queue>,
    writer_thread: JoinHandle<io::Result<()>>,
    progress: Arc<WriterProgress>,
    /// Topics of the recording. The index of a topic is its track number in the queue.
    tracks: Vec<TopicName>,
    /// Number of samples that were added to the queue.
    pushed: u64,
    /// Number of samples for which the queue had no room.
    dropped: u64,
    gap: Option<Gap>,
    tick_at: Instant,
    report: Report<'a>,
    /// Set at the end of the run. The run may then wait for the readers of its lines.
    is_over: &'a AtomicBool,
}

impl<'a> Recorder<'a> {
    /// Starts the disk thread.
    fn start(
        queue: Arc<Queue>,
        disk: DiskWriter,
        report: Report<'a>,
        is_over: &'a AtomicBool,
    ) -> Result<Recorder<'a>, Failure> {
        let progress = disk.progress();
        let writing = thread::Builder::new().name("disk".into()).spawn(move || disk.run());
        let writing = writing.map_err(|error| {
            Failure::new(Kind::ResourceExhausted, format!("no thread: {error}"), "see `ulimit -u`")
        })?;
        Ok(Recorder {
            queue,
            writer_thread: writing,
            progress,
            tracks: Vec::new(),
            pushed: 0,
            dropped: 0,
            gap: None,
            tick_at: Instant::now(),
            report,
            is_over,
        })
    }

    /// Adds samples to the queue until the run ends.
    fn run(&mut self, following: &mut TopicRun<'_>) -> Result<(), ExitReason> {
        while let Some(event) = following.next(None)? {
            match event {
                Event::Added(name) => {
                    self.queue.note(Entry::Track(TopicName::clone(&name)));
                    self.tracks.push(TopicName::clone(&name));
                }
                Event::Sample(name, sample, _) => self.sample(&name, &sample)?,
                Event::Notice(names, notice) => self.report.hub(&names, notice)?,
                Event::Tick(now) if now >= self.tick_at => {
                    self.tick_at = now + POLL_INTERVAL;
                    self.report_progress()?;
                }
                _ => {}
            }
        }
        Ok(())
    }

    /// Adds `sample` to the queue. During a gap, it drops samples until half of the queue is free.
    fn sample(&mut self, name: &TopicName, sample: &Sample) -> Result<(), ExitReason> {
        let Some(header) = sample.header() else { return Ok(()) };
        if self.gap.is_some() {
            if !self.queue.is_roomy() {
                return self.drop_sample(name);
            }
            self.end_gap()?;
        }
        let Some(track) = self.tracks.iter().position(|track| track == name) else { return Ok(()) };
        if !self.queue.push(track, header, sample.bytes().len(), |room| sample.pack_as_published(room)) {
            return self.drop_sample(name);
        }
        self.pushed += 1;
        Ok(())
    }

    /// Drops a sample for which the queue has no room. The first dropped sample starts a gap, which lasts until half of
    /// the queue is free.
    fn drop_sample(&mut self, name: &TopicName) -> Result<(), ExitReason> {
        self.dropped += 1;
        let is_first = self.gap.is_none();
        let now_ns = clock::wall_ns();
        let gap = self.gap.get_or_insert_with(|| Gap { from_ns: now_ns, to_ns: now_ns, dropped: Vec::new() });
        match gap.dropped.iter_mut().find(|(other, _)| other == name) {
            Some((_, count)) => *count += 1,
            None => gap.dropped.push((name.clone(), 1)),
        }
        if is_first { self.report.gap_begins() } else { Ok(()) }
    }

    /// Ends the gap, and adds it to the file.
    fn end_gap(&mut self) -> Result<(), ExitReason> {
        let Some(mut gap) = self.gap.take() else { return Ok(()) };
        gap.to_ns = clock::wall_ns();
        let reported = self.report.gap_ends(&gap);
        self.queue.note(Entry::Gap(gap));
        reported
    }

    /// Reports progress and events of the disk thread.
    fn report_progress(&mut self) -> Result<(), ExitReason> {
        let stats = self.progress.take_stats();
        for event in stats.events.iter() {
            if *event == WriterEvent::ReaderClosed {
                return Err(reader_closed(stats.samples).into());
            }
            self.report.disk(event)?;
        }
        self.report.progress(&stats, self.dropped)
    }

    /// Reports the counters of a topic at the end of the run.
    fn summary(&mut self, name: &TopicName, stats: &ReceiveStats) -> Result<(), ExitReason> {
        self.is_over.store(true, Ordering::Relaxed);
        self.report.topic(name, stats)
    }

    /// Waits until everything is written, and reports the result if the recording `is_kept`. A second request to stop
    /// ends the wait.
    fn finish(mut self, is_kept: bool, stop: &AtomicBool) -> Result<(), ExitReason> {
        self.is_over.store(true, Ordering::Relaxed);
        stop.store(false, Ordering::Relaxed);
        let reported = self.end_gap();
        self.queue.end();
        let mut second = SecondStop::default();
        while !self.writer_thread.is_finished() {
            if second.poll(stop.swap(false, Ordering::Relaxed)) {
                let what = "a second signal arrived before the disk had stored the end of the recording";
                return Err(Failure::new(Kind::Failed, what, REPAIR).into());
            }
            thread::sleep(POLL_INTERVAL);
        }
        let written = self.writer_thread.join();
        let written = written.unwrap_or_else(|_| Err(io::Error::other("the writing thread panicked")));
        let stats = self.progress.take_stats();
        if let Err(error) = written {
            if error.kind() == ErrorKind::BrokenPipe {
                return Err(reader_closed(stats.samples).into());
            }
            let missing = self.pushed - stats.samples;
            let what =
                format!("the end of the recording cannot be written: {error}; {missing} samples are missing");
            return Err(Failure::new(kind(&error), what, REPAIR).into());
        }
        reported.and_then(|()| stats.events.iter().try_for_each(|event| self.report.disk(event)))?;
        if is_kept { self.report.end(&stats, self.dropped) } else { Ok(()) }
    }
}

/// Distinguishes a second request to stop from further signals of the first request. If a terminal closes, the terminal
/// and the shell each send a SIGHUP, and both may arrive after SIGINT. All signals of one request arrive within a
/// second. But on a busy machine, this process may not run during that second, so polls are counted instead of time.
#[derive(Default)]
struct SecondStop {
    polls: u32,
}

impl SecondStop {
    /// Number of polls after the first signal during which further signals belong to the first request.
    const POLLS_PER_REQUEST: u32 = 20;

    /// Counts a poll. Returns whether a signal since the last poll is a second request to stop.
    fn poll(&mut self, is_signaled: bool) -> bool {
        self.polls += 1;
        is_signaled && self.polls > Self::POLLS_PER_REQUEST
    }
}

/// Returns the kind of failure for a write error. The kind is a temporary one if the disk or a quota is full.
fn kind(error: &io::Error) -> Kind {
    match error.kind() {
        ErrorKind::StorageFull | ErrorKind::QuotaExceeded | ErrorKind::FileTooLarge => {
            Kind::ResourceExhausted
        }
        _ => Kind::Failed,
    }
}

/// Returns the failure for a file that cannot be created at `path`.
fn no_file(path: &Path, is_split: bool, error: &io::Error) -> Failure {
    let hint = match error.kind() {
        ErrorKind::AlreadyExists if is_split => {
            "--force continues after the last number; -o FILE names others"
        }
        ErrorKind::AlreadyExists => "--force overwrites it; -o FILE names another",
        ErrorKind::InvalidInput => "name another file: -o FILE",
        ErrorKind::ResourceBusy => "stop it first, or name another file: -o FILE",
        ErrorKind::StorageFull | ErrorKind::QuotaExceeded => {
            "free some space, or name another location: -o FILE"
        }
        ErrorKind::FileTooLarge => "raise the limit: `ulimit -f unlimited`, for a service LimitFSIZE",
        _ => "the directory must exist and be writable; -o FILE names another location",
    };
    let kind = match kind(error) {
        Kind::Failed => Kind::Output,
        other => other,
    };
    Failure::new(kind, format!("cannot record into {}: {error}", path.display()), hint)
}

fn no_stderr(error: io::Error) -> Failure {
    Failure::new(Kind::Failed, format!("no stderr: {error}"), "")
}

/// Returns the failure for a reader that has closed stdout after `samples` samples. The reader has an incomplete
/// recording.
fn reader_closed(samples: u64) -> Failure {
    let what = format!("the reader of the recording has exited: it has at most {samples} samples");
    let hint = "see why the program or the connection behind the pipe ended; `scanhub convert` writes a copy with an index";
    Failure::new(Kind::Failed, what, hint)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn second_stop_request_differs_from_repeated_signals() {
        let mut second = SecondStop::default();
        // A signal at every poll belongs to the first request, however long the polls take.
        assert!((0..SecondStop::POLLS_PER_REQUEST).all(|_| !second.poll(true)));
        assert!(!second.poll(false));
        assert!(second.poll(true));
        assert!(POLL_INTERVAL * SecondStop::POLLS_PER_REQUEST >= Duration::from_secs(1));
    }

    fn selected(texts: &[&str], everything: bool, ros2: bool) -> Result<(Vec<String>, Vec<Topic>), Failure> {
        let (names, topics) =
            selection(&texts.iter().map(|&text| text.to_owned()).collect::<Vec<_>>(), everything, ros2)?;
        Ok((names.iter().map(TopicName::to_string).collect(), topics))
    }

    #[test]
    fn selects_default_named_and_all_topics() {
        assert_eq!(selected(&[], false, false).unwrap().1, DEFAULT_TOPICS);
        assert_eq!(selected(&[], true, false).unwrap().1, Topic::ALL);
        let some = selected(&["front/scan", "*/status", "front/scan"], false, false).unwrap();
        assert_eq!(some, (vec!["front/scan".into()], vec![Topic::Status]));
    }

    #[test]
    fn selects_scans_and_poses_for_ros() {
        let ours = [Topic::Scan, Topic::Status];
        assert_eq!(selected(&[], false, true).unwrap().1, ours);
        assert_eq!(selected(&["*/scan"], false, true).unwrap().1, ours);
        let front = selected(&["front/scan"], false, true).unwrap();
        assert_eq!(front, (vec!["front/scan".into(), "front/status".into()], vec![]));
        for (texts, everything) in [(&[][..], true), (&["front/zones"], false), (&["*/telegram"], false)] {
            let failure = selected(texts, everything, true).unwrap_err();
            assert_eq!(failure.kind, Kind::Usage, "{texts:?}");
            assert!(failure.hint.contains("convert"), "{failure}");
        }
    }

    #[test]
    fn refuses_topics_that_do_not_exist() {
        let kind = |text| selected(&[text], false, false).map(drop).map_err(|failure| failure.kind);
        for bad in ["front", "*/scam", "front/scam", "robot/scan", "*", "robot/zones", "Front/scan"] {
            assert_eq!(kind(bad), Err(Kind::Usage), "{bad}");
        }
        assert_eq!(kind("front/*"), Ok(()));
    }
}
