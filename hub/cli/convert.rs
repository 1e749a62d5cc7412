//! `scanhub convert`: its arguments, and the report of the result.

use std::io::{IsTerminal, Write, stderr};
use std::path::{Path, PathBuf};

use clap::Args;
use scanhub_recording::convert::{self, ConversionResult, ConvertOptions};
use scanhub_recording::{Damage, Form, UnreadLines};
use scanhub_schema::file::Compression;
use scanhub_schema::{Failure, Family};
use scanhub_sim::options;
use scanhub_verbs::context::Context;
use serde::Serialize;

use crate::{print, print_error, to_json_line};

/// Convert a recording to another format, or repair a damaged one
#[derive(Args, Debug)]
#[command(after_help = AFTER_HELP)]
pub(crate) struct Convert {
    /// Recording to read, even a damaged one: MCAP file, stream file or CARMEN log, plain or gzipped
    #[arg(value_name = "IN")]
    input: PathBuf,
    /// Output file. Its ending selects the format: .mcap, .bin (stream file), .log (CARMEN) or .csv (a row per scan or
    /// mark). All but .mcap can have .gz after it. -: a stream file on stdout
    #[arg(value_name = "OUT")]
    output: PathBuf,
    /// Convert only this sensor. For a stream file or a log: name of the sensor [default: front]
    #[arg(long, value_name = "NAME")]
    sensor: Option<String>,
    /// Family of the scanner in a stream file: lms, ld or rplidar [default: recognized by its bytes]
    #[arg(long, value_name = "NAME", value_parser = super::family)]
    family: Option<Family>,
    /// Write an MCAP file of ROS 2 messages only: scans as sensor_msgs/msg/LaserScan, and /tf_static from the poses
    #[arg(long)]
    ros2: bool,
    /// With --ros2: also write each scan as sensor_msgs/msg/PointCloud2, for viewers that cannot show LaserScan, such
    /// as rerun
    #[arg(long)]
    points: bool,
    /// With --ros2 or .csv: measuring mode of a recording that does not contain it, such as 0x01
    #[arg(long)]
    mode: Option<String>,
    /// With .csv: topic to write, SENSOR/scan or SENSOR/marks [default: the scans]
    #[arg(long, value_name = "SENSOR/TOPIC")]
    topic: Option<String>,
    /// With .csv: write ranges in meters
    #[arg(long)]
    meters: bool,
    /// With .csv: add the columns intensity_0 .. after the ranges
    #[arg(long)]
    intensities: bool,
    /// Compression of an MCAP file: zstd, lz4 or none [default: zstd]
    #[arg(long, value_name = "NAME", value_parser = Compression::parse)]
    compression: Option<Compression>,
    /// Overwrite an existing file
    #[arg(short, long)]
    force: bool,
}

impl Convert {
    /// Converts until the end of the recording or a signal.
    pub(crate) fn run(&self, context: &mut Context) -> Result<(), Failure> {
        let (json, stop) = (context.json, context.signals.stop()?);
        let options = ConvertOptions {
            input: self.input.clone(),
            output: self.output.clone(),
            sensor: self.sensor.clone(),
            family: self.family,
            force: self.force,
            ros2: self.ros2,
            points: self.points,
            compression: self.compression,
            mode: self.mode.as_deref().map(options::parse_mode).transpose()?,
            topic: self.topic.clone(),
            meters: self.meters,
            intensities: self.intensities,
        };
        let is_watched = stderr().is_terminal() && !json;
        let progress = |done: u64, all: u64| {
            if is_watched {
                let _ = write!(stderr(), "\r{done} of {all} telegrams");
            }
        };
        let outcome = convert::convert(&options, &stop, progress);
        if is_watched {
            let _ = write!(stderr(), "\r\x1b[K");
        }
        let converted = outcome?;
        if converted.is_closed {
            return Ok(());
        }
        let is_stdout_taken = self.output == Path::new("-");
        match (json, is_stdout_taken) {
            (true, false) => return print(&to_json_line(&ConvertedLine::of(self, &converted))),
            (true, true) => print_error(&to_json_line(&ConvertedLine::of(self, &converted))),
            (false, _) => print_error(&self.summary(&converted)),
        }
        Ok(())
    }

    fn summary(&self, converted: &ConversionResult) -> String {
        let ConversionResult {
            telegrams,
            scans,
            marks,
            dropped,
            unread,
            duration_ns: took_ns,
            encoding,
            damage,
            ..
        } = converted;
        let what = match marks {
            Some(marks) => format!("{marks} marks in {scans} scans"),
            None => format!("{telegrams} telegrams, {scans} scans"),
        };
        let mut words = format!("{}: {what}", self.output.display());
        if let Some(seconds) = took_ns.map(seconds) {
            words += &format!(", {seconds:.3} s");
        }
        if let Some(encoding) = encoding {
            words += &format!("; the log was read as {encoding}");
        }
        if *dropped > 0 {
            let (plural, what) =
                if *dropped == 1 { ("", "a complete scan") } else { ("s", "complete scans") };
            words += &format!("; {dropped} telegram{plural} dropped (not {what})");
        }
        if *unread != UnreadLines::default() {
            words += &format!("; dropped from the log: {unread}");
        }
        if !damage.is_none() {
            words += &format!("; missing in {}: {damage}", self.input.display());
        }
        words
    }
}

/// JSON line that reports the conversion. The order of the keys is part of the format.
#[derive(Serialize)]
struct ConvertedLine<'a> {
    class: &'static str,
    input: &'a Path,
    output: &'a Path,
    from: &'static str,
    to: &'static str,
    sensors: &'a [String],
    telegrams: u64,
    scans: u64,
    dropped: u64,
    seconds: Option<f64>,
    missing: Missing,
    marks: Option<u64>,
    log_dropped: Option<LogDropped>,
}

/// Data of a log that is not in the output.
#[derive(Serialize)]
struct LogDropped {
    poses: u64,
    odometry: u64,
    remissions: u64,
    lines: u64,
}

/// Data that was missing in the recording.
#[derive(Serialize)]
struct Missing {
    telegrams: u64,
    bytes: u64,
    chunks: u64,
    /// Always 0: telegrams outside intact chunks, whose stamps had to be estimated, are not read.
    stamps: u64,
    /// Always false: a file without its beginning is refused.
    begin: bool,
    end: bool,
    checksum: bool,
}

impl<'a> ConvertedLine<'a> {
    fn of(convert: &'a Convert, converted: &'a ConversionResult) -> Self {
        let UnreadLines { poses, odometry, remissions, lines } = converted.unread;
        let is_log = converted.forms.0 == Form::Carmen;
        let Damage { telegrams, bytes, chunks, repeats, is_truncated: is_cut, is_damaged: is_harmed } =
            converted.damage;
        ConvertedLine {
            class: "converted",
            input: &convert.input,
            output: &convert.output,
            from: convert::form_name(converted.forms.0),
            to: converted.forms.1.name(),
            sensors: &converted.sensors,
            telegrams: converted.telegrams,
            scans: converted.scans,
            dropped: converted.dropped,
            seconds: converted.duration_ns.map(seconds),
            missing: Missing {
                telegrams,
                bytes,
                chunks: chunks + repeats,
                stamps: 0,
                begin: false,
                end: is_cut,
                checksum: is_harmed,
            },
            marks: converted.marks,
            log_dropped: is_log.then_some(LogDropped { poses, odometry, remissions, lines }),
        }
    }
}

fn seconds(ns: u64) -> f64 {
    ns as f64 / 1e9
}

/// Instructions for repairing a recording, for the end of the help.
const AFTER_HELP: &str = "\
Examples:
  scanhub convert killed.mcap whole.mcap
  scanhub convert robot.mcap front.log.gz --sensor front
  scanhub convert room.log.gz room.mcap
  scanhub convert walk.mcap ros.mcap --ros2
  scanhub convert walk.mcap points.mcap --ros2 --points
  scanhub convert robot.mcap front.csv --sensor front --meters
  scanhub convert robot.mcap marks.csv --topic front/marks

MCAP to MCAP copies everything and writes a new index. A cut or damaged file becomes a complete file with all
messages that can be read. The exit code is 0 even if the input was damaged, as long as the output is complete.";
