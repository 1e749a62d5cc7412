//! `scanhub echo`: samples as text, JSON, CSV or bytes.

use std::io::Write;
use std::sync::atomic::AtomicBool;

use scanhub_client::streams::Sample;
use scanhub_schema::csv::ScanColumns;
use scanhub_schema::{Failure, Header, Kind, Scan, Topic};
use scanhub_shm::Domain;

use crate::follow::{Bounds, Event, Following};
use crate::names::TopicName;
use crate::output::{End, Output, quiet};
use crate::receive_stats::ReceiveStats;
use crate::selection::Selection;
use crate::{json, show, text};

/// What `echo` is asked for.
#[derive(Clone, Debug)]
pub struct EchoOptions {
    /// `SENSOR/TOPIC`, `*/TOPIC` or `SENSOR/*`, at least one; CSV and bytes take exactly one.
    pub topics: Vec<String>,
    /// How samples are written.
    pub format: Format,
    /// When it ends by itself.
    pub bounds: Bounds,
    /// Where the domain may be, see [`Domain::candidates`].
    pub places: Vec<Domain>,
}

/// How samples are written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Format {
    /// A line for people; notices go to `notes`.
    #[default]
    Text,
    /// An object per line, notices and summary too.
    Json,
    /// Columns, scans only; notices and summary go to `notes`.
    Csv(ScanColumns),
    /// The payloads' bytes, one after the other; notices and summary go to `notes`.
    Raw,
}

/// Writes the samples of topics to `out` as they come; what is no sample to `notes` (stderr) if `out` is not JSON.
/// Ends when the bounds are reached, `stop` is set, or nobody reads any more.
///
/// [`Kind::Usage`] if there is no such topic or the format does not go with the topics, [`Kind::NoTopic`] with the sensors
/// that there are,
/// [`Kind::NoHub`] if bounded and there is none at the start, [`Kind::Timeout`], [`Kind::Interrupted`] if bounded and
/// `stop` came first.
pub fn echo(
    options: &EchoOptions,
    out: &mut dyn Write,
    notes: &mut dyn Write,
    stop: &AtomicBool,
) -> Result<(), Failure> {
    let Selection { named, of_all } = Selection::parse(&options.topics)?;
    check(options.format, &named, &of_all)?;
    let mut echo =
        Echo { format: options.format, out: Output::new(out), notes: Output::new(notes), beams: None };
    let mut following = Following::new(&named, &of_all, &options.places, &options.bounds, stop).with_lines();
    let end = echo.run(&mut following);
    quiet(following.finish(end, |name, stats| echo.summary(name, stats)))
}

struct Echo<'a> {
    format: Format,
    out: Output<'a>,
    notes: Output<'a>,
    /// Number of beams in the last line of column names.
    beams: Option<usize>,
}

impl Echo<'_> {
    fn run(&mut self, following: &mut Following<'_>) -> Result<(), End> {
        while let Some(event) = following.next(None)? {
            match event {
                Event::Sample(name, sample, _) => self.sample(&name, &sample)?,
                Event::Notice(names, notice) => {
                    notice.tell(&names, self.format == Format::Json, &mut self.out, &mut self.notes)?;
                }
                _ => {}
            }
        }
        Ok(())
    }

    fn sample(&mut self, name: &TopicName, sample: &Sample) -> Result<(), End> {
        match (self.format, sample) {
            (Format::Text, _) => self.out.line(|line| text::sample(line, name, sample)),
            (Format::Raw, _) => self.out.raw(sample.bytes()),
            (Format::Csv(columns), Sample::Scan(scan)) => self.csv(columns, scan.header(), scan),
            (Format::Csv(_), _) => Ok(()),
            (Format::Json, _) => show::json(sample, &name.sensor, &mut self.out),
        }
    }

    fn summary(&mut self, name: &TopicName, stats: &ReceiveStats) -> Result<(), End> {
        match self.format {
            Format::Json => self.out.json(&json::summary(name, stats)),
            Format::Text => self.out.line(|line| text::summary(line, name, stats)),
            Format::Csv(_) | Format::Raw => self.notes.line(|line| text::summary(line, name, stats)),
        }
    }

    /// A line of columns; the names of the columns first, and again if their number changes.
    fn csv(&mut self, columns: ScanColumns, header: &Header, scan: &Scan) -> Result<(), End> {
        if self.beams != Some(scan.beams()) {
            self.beams = Some(scan.beams());
            self.out.line(|line| columns.names(line, scan.beams()))?;
        }
        self.out.line(|line| columns.row(line, header, scan))
    }
}

fn check(format: Format, named: &[TopicName], of_all: &[Topic]) -> Result<(), Failure> {
    let usage = |what: &str| Err(Failure::new(Kind::Usage, what, "for example `scanhub echo front/scan`"));
    match (format, named) {
        (_, []) if of_all.is_empty() => usage("echo needs a topic"),
        (Format::Csv(_) | Format::Raw, _) if !of_all.is_empty() => {
            usage("--csv and --raw take one topic of one sensor")
        }
        (Format::Csv(_), [one]) if one.topic == Topic::Scan => Ok(()),
        (Format::Csv(_), _) => usage("--csv takes one topic, which must be a scan"),
        (Format::Raw, [_, _, ..]) => usage("--raw takes one topic"),
        (Format::Raw, [one]) if one.is_robot() => usage("--raw takes the topic of a sensor"),
        _ => Ok(()),
    }
}
