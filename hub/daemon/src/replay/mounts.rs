//! Mounts of a recording: their angles, played at the media time of their stamps. Another program publishes them, because a
//! hub has no topic for them.

use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

use port::clock;
use recording::{Frame, MountRecord, Recording};
use schema::{Header, Nanos, Tilt};

use super::recorded::{Origin, Timeline};
use crate::player::{Player, Turn};

/// A mount whose angles are in a recording.
#[derive(Clone, Debug)]
pub struct RecordedMount {
    /// Name in the recording.
    recorded: String,
    name: String,
    recording: Recording,
    /// Start of the media time.
    origin: Origin,
}

/// An angle whose turn it is.
#[derive(Clone, Copy, Debug)]
pub struct RecordedAngle {
    /// CLOCK_MONOTONIC for which it stands now, in ns.
    pub stamp_ns: u64,
    /// Header of the sample in the recording.
    pub header: Header,
    /// The recorded angle.
    pub tilt: Tilt,
}

impl RecordedMount {
    /// Returns the mount with the name `recorded` in `recording`, which is published as `name`.
    pub(crate) fn new(recorded: &str, name: String, recording: &Recording, origin: Origin) -> RecordedMount {
        RecordedMount { recorded: recorded.to_owned(), name, recording: recording.clone(), origin }
    }

    /// Returns the name under which its angles are published.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Passes each angle to `publish` when it is due, lap by lap, until `stop` is set.
    pub fn play(&self, player: &Player, stop: &AtomicBool, mut publish: impl FnMut(RecordedAngle)) {
        let play = player.play();
        while !stop.load(Ordering::Relaxed) {
            let lap = player.lap();
            let is_current = || player.lap() == lap && !stop.load(Ordering::Relaxed);
            let records = match self.recording.angles(&self.recorded) {
                Ok(records) => records,
                Err(failure) => return tracing::warn!("{}: {}", self.name, failure.message),
            };
            let mut timeline = Timeline::new(Some(self.origin));
            for record in records {
                let (header, tilt) = match record {
                    MountRecord::Angle(header, tilt) => (header, tilt),
                    MountRecord::Telegram(header) => {
                        let frame =
                            Frame { header: Some(header), wall_ns: Some(header.wall_ns), ..Frame::default() };
                        timeline.media(&frame);
                        continue;
                    }
                };
                let media = timeline.media_beside(&header);
                let Some(media) = media.filter(|media| *media >= play.start_ns) else { continue };
                if play.end_ns.is_some_and(|end_ns| media >= end_ns) {
                    break;
                }
                match wait(player, media, &is_current) {
                    Turn::Now(due) => publish(RecordedAngle { stamp_ns: due.at, header, tilt }),
                    Turn::Skipped => {}
                    _ => break,
                }
            }
            while is_current() {
                thread::sleep(POLL);
            }
        }
    }
}

/// Waits until something of `media` is due or skipped, or until the lap ends: [`Turn::Over`].
fn wait(player: &Player, media: Nanos, is_current: &impl Fn() -> bool) -> Turn {
    while is_current() {
        let now = clock::now();
        match player.due(media, now) {
            turn @ (Turn::Now(_) | Turn::Skipped) => return turn,
            Turn::At(at) => thread::sleep(Duration::from_nanos(at.saturating_sub(now)).min(POLL)),
            _ => thread::sleep(POLL),
        }
    }
    Turn::Over
}

/// Interval of the checks whether the player was paused, or has ended.
const POLL: Duration = Duration::from_millis(5);
