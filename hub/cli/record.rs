//! `scanhub record` on the command line.

use std::io::{IsTerminal, stderr, stdout};
use std::path::{Path, PathBuf};

use clap::Args;
use scanhub_schema::Failure;
use scanhub_schema::file::Compression;
use scanhub_verbs::{RecordLook, RecordOptions, Split};

use super::{Everywhere, Limits};

#[derive(Args, Debug)]
pub(crate) struct Record {
    /// Topics to record: front/telegram, */scan for all sensors, or front/* for all topics [default: telegram, marks,
    /// zones, foreground and status of all sensors, tracks and events of trackers, tilt and obstacles of mounts]
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
    /// Overwrite an existing file; with --split, continue after the existing numbers, and let --keep remove older files
    #[arg(short, long)]
    force: bool,
    /// Start another file after this size or time: 512MiB, 1h; the files are called FILE-0001.mcap ..
    #[arg(long, value_name = "SIZE|DURATION", value_parser = Split::parse)]
    split: Option<Split>,
    /// Keep only the last COUNT files of this run; with --force, files FILE-NNNN.mcap of earlier runs count too
    #[arg(long, value_name = "COUNT", requires = "split", value_parser = clap::value_parser!(u32).range(1..))]
    keep: Option<u32>,
    #[command(flatten)]
    limits: Limits,
}

impl Record {
    /// Stdout carries the recording and nothing else.
    pub(crate) fn is_to_stdout(&self) -> bool {
        self.output.as_deref() == Some(Path::new(RecordOptions::STDOUT))
    }

    pub(crate) fn options(&self, everywhere: &Everywhere) -> Result<RecordOptions, Failure> {
        let is_terminal = if self.is_to_stdout() { stderr().is_terminal() } else { stdout().is_terminal() };
        Ok(RecordOptions {
            topics: self.topics.clone(),
            everything: self.all,
            ros2: self.ros2,
            compression: self.compression,
            file: self.output.clone(),
            force: self.force,
            split: self.split,
            keep: self.keep.map(|keep| keep as usize),
            look: match (everywhere.json, is_terminal) {
                (true, _) => RecordLook::Json,
                (false, true) => RecordLook::Terminal,
                (false, false) => RecordLook::Lines,
            },
            bounds: self.limits.bounds(),
            places: everywhere.places()?,
        })
    }
}

/// How the files are read, for the end of the help.
pub(crate) const READING: &str = "\
The files are MCAP: any MCAP reader opens them, `scanhub replay FILE` plays them. Ctrl-C finishes the file. On a full
disk it waits and continues; it reports what is missing, which is a gap in the file's numbers.";
