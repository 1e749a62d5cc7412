//! `scanhub replay` on the command line: what it takes.

use std::path::PathBuf;
use std::time::Duration;

use clap::Args;
use scanhub_daemon::{PlaybackOptions, PlaybackRate};
use scanhub_schema::{Failure, Family, Kind};
use scanhub_verbs::duration;

use super::Configured;

#[derive(Args, Debug)]
pub(crate) struct Replay {
    /// Recording to play: MCAP file, telegram stream or CARMEN log, plain or gzipped
    pub(crate) file: PathBuf,
    /// Speed relative to the recording, 0.015625 to 64, or max: as fast as it can be read
    #[arg(long, default_value = "1", value_name = "FACTOR|max", value_parser = pace)]
    rate: PlaybackRate,
    /// Start again at the end, until Ctrl-C; each lap forgets what was learned
    #[arg(long = "loop", conflicts_with = "hold")]
    is_looped: bool,
    /// Start publishing here, for example 90s; the part before it is only learned from
    #[arg(long, value_name = "DURATION", value_parser = duration::parse)]
    start: Option<Duration>,
    /// Stop publishing here
    #[arg(long, value_name = "DURATION", value_parser = duration::parse)]
    end: Option<Duration>,
    /// Wait before the first telegram, until a key or `scanhub control SENSOR resume`
    #[arg(long)]
    paused: bool,
    /// Stay at the end, without publishing, until Ctrl-C
    #[arg(long)]
    pub(crate) hold: bool,
    /// Play only this sensor, and no mounts; for a stream or a log, the name that it gets [default: front]
    #[arg(long, value_name = "NAME")]
    pub(crate) sensor: Option<String>,
    /// Family of a telegram stream: lms, ld or rplidar [default: recognized by its bytes]
    #[arg(long, value_name = "NAME", value_parser = super::family)]
    pub(crate) family: Option<Family>,
    #[command(flatten)]
    pub(crate) configured: Configured,
}

impl Replay {
    /// The options of the player.
    ///
    /// [`Kind::Usage`] if it ends before it starts.
    pub(crate) fn play(&self) -> Result<PlaybackOptions, Failure> {
        let start = self.start.unwrap_or_default();
        if let Some(end) = self.end.filter(|end| *end <= start) {
            let message = format!("--end {end:?} is not after --start {start:?}");
            return Err(Failure::new(Kind::Usage, message, "both count from the first telegram"));
        }
        Ok(PlaybackOptions {
            rate: self.rate,
            start_ns: nanos(start),
            end_ns: self.end.map(nanos),
            is_looped: self.is_looped,
            is_paused: self.paused,
        })
    }
}

fn nanos(duration: Duration) -> u64 {
    u64::try_from(duration.as_nanos()).unwrap_or(u64::MAX)
}

fn pace(text: &str) -> Result<PlaybackRate, String> {
    if text == "max" {
        return Ok(PlaybackRate::Max);
    }
    let rate =
        text.parse().ok().filter(|rate| (PlaybackRate::SLOWEST..=PlaybackRate::FASTEST).contains(rate));
    rate.map(PlaybackRate::Times).ok_or_else(|| {
        format!("a number from {} to {}, or max", PlaybackRate::SLOWEST, PlaybackRate::FASTEST)
    })
}

/// The keys, for the end of the help.
pub(crate) const KEYS: &str = "\
Keys:
  space         pause, and continue
  . or right    play one telegram, of the sensor that has the next one, and pause
  + and -       twice as fast, half as fast
  q             quit";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rates() {
        assert_eq!((pace("max"), pace("0.5")), (Ok(PlaybackRate::Max), Ok(PlaybackRate::Times(0.5))));
        for wrong in ["0", "-1", "65", "nan", "inf", "fast", ""] {
            assert!(pace(wrong).is_err_and(|error| error.contains("0.015625 to 64, or max")), "{wrong}");
        }
    }
}
