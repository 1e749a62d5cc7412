//! `scanhub echo`: prints samples as text, JSON, CSV or bytes.

use clap::Args;
use scanhub_client::streams::Sample;
use scanhub_schema::csv::ScanColumns;
use scanhub_schema::{Failure, Header, Kind, Scan, Topic};

use crate::context::Context;
use crate::follow::{Event, RunLimits, TopicRun};
use crate::names::{Selection, TopicName};
use crate::output::{ExitReason, Output, verb_result};
use crate::receive_stats::ReceiveStats;
use crate::{json, show, text};

/// Print samples as they arrive
#[derive(Args, Clone, Debug, Default)]
#[command(after_help = EXAMPLES)]
pub struct EchoArgs {
    /// Topics to print: front/scan, */scan for all sensors, or front/* for all topics of a sensor. robot/zones is the
    /// combined verdict of all sensors
    #[arg(required = true, value_name = "SENSOR/TOPIC")]
    pub topics: Vec<String>,
    /// Print comma-separated values
    #[arg(long, conflicts_with_all = ["json", "raw"])]
    pub csv: bool,
    /// With --csv: print ranges in meters
    #[arg(long, requires = "csv", conflicts_with_all = ["json", "raw"])]
    pub meters: bool,
    /// With --csv: add the columns intensity_0 .. after the ranges
    #[arg(long, requires = "csv", conflicts_with_all = ["json", "raw"])]
    pub intensities: bool,
    /// Print raw bytes: the telegrams of topic telegram, or the payloads of any other topic
    #[arg(long, conflicts_with = "json")]
    pub raw: bool,
    /// Limits of the run.
    #[command(flatten)]
    pub limits: RunLimits,
}

const EXAMPLES: &str = "\
Examples:
  scanhub echo front/scan
  scanhub echo front/zones --json -n 10
  scanhub echo front/scan --csv > scans.csv";

impl EchoArgs {
    /// Writes the samples of topics to stdout as they arrive. Notices go to stderr without `--json`. Ends at the
    /// limits, by a signal, or when the reader closes stdout.
    ///
    /// # Errors
    ///
    /// - [`Kind::Usage`] if a topic does not exist, or the format does not suit the topics.
    /// - [`Kind::NoTopic`] if a sensor does not exist; the message lists the sensors.
    /// - [`Kind::NoHub`] if the run is bounded and no hub runs at its start.
    /// - [`Kind::Timeout`] if no sample arrives in time, or fewer than `-n` within `--for`.
    /// - [`Kind::Interrupted`] if a signal stops a bounded run before its end.
    pub fn run(&self, context: &mut Context) -> Result<(), Failure> {
        let (locations, stop) = (context.domain.locations()?, context.signals.stop()?);
        let Selection { named, of_all } = Selection::parse(&self.topics)?;
        let format = match (context.json, self.csv, self.raw) {
            (true, ..) => Format::Json,
            (_, true, _) => Format::Csv(ScanColumns { meters: self.meters, intensities: self.intensities }),
            (_, _, true) => Format::Raw,
            _ => Format::Text,
        };
        check(format, &named, &of_all)?;
        let mut echo = Echo {
            format,
            out: Output::new(&mut context.out),
            notes: Output::new(&mut context.notes),
            beams: None,
        };
        let mut following = TopicRun::new(&named, &of_all, &locations, &self.limits, &stop).with_lines();
        let end = echo.run(&mut following);
        verb_result(following.finish(end, |name, stats| echo.summary(name, stats)))
    }
}

/// Format of the samples.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Format {
    /// Lines of text; notices go to `notes`.
    Text,
    /// JSON lines, also for notices and summary.
    Json,
    /// Comma-separated values, for scans only; notices and summary go to `notes`.
    Csv(ScanColumns),
    /// Bytes of the payloads without separators; notices and summary go to `notes`.
    Raw,
}

struct Echo<'a> {
    format: Format,
    out: Output<'a>,
    notes: Output<'a>,
    /// Number of beams when the column names were last written.
    beams: Option<usize>,
}

impl Echo<'_> {
    fn run(&mut self, following: &mut TopicRun<'_>) -> Result<(), ExitReason> {
        while let Some(event) = following.next(None)? {
            match event {
                Event::Sample(name, sample, _) => self.sample(&name, &sample)?,
                Event::Notice(names, notice) => {
                    notice.report(&names, self.format == Format::Json, &mut self.out, &mut self.notes)?;
                }
                _ => {}
            }
        }
        Ok(())
    }

    fn sample(&mut self, name: &TopicName, sample: &Sample) -> Result<(), ExitReason> {
        match (self.format, sample) {
            (Format::Text, _) => self.out.line(|line| text::sample(line, name, sample)),
            (Format::Raw, _) => self.out.raw(sample.bytes()),
            (Format::Csv(columns), Sample::Scan(scan)) => self.csv(columns, scan.header(), scan),
            (Format::Csv(_), _) => Ok(()),
            (Format::Json, _) => show::json(sample, &name.sensor, &mut self.out),
        }
    }

    fn summary(&mut self, name: &TopicName, stats: &ReceiveStats) -> Result<(), ExitReason> {
        match self.format {
            Format::Json => self.out.json(&json::summary(name, stats)),
            Format::Text => self.out.line(|line| text::summary(line, name, stats)),
            Format::Csv(_) | Format::Raw => self.notes.line(|line| text::summary(line, name, stats)),
        }
    }

    /// Writes a line of values. Writes the column names before the first line, and again when the number of beams
    /// changes.
    fn csv(&mut self, columns: ScanColumns, header: &Header, scan: &Scan) -> Result<(), ExitReason> {
        if self.beams != Some(scan.beams()) {
            self.beams = Some(scan.beams());
            self.out.line(|line| columns.write_header(line, scan.beams()))?;
        }
        self.out.line(|line| columns.write_row(line, header, scan))
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
