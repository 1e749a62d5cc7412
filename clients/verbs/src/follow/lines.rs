//! The serial lines of the followed sensors: their statuses, in addition to the requested topics. These are not
//! samples of the run: they count for no bound, and it is no failure if there are none.

use scanhub_client::streams::{Follower, Sample};
use scanhub_schema::Status;

use super::{Run, Sink};
use crate::line::{Line, Loss};
use crate::output::End;

/// One sensor's line.
pub(super) struct LineTrack {
    sensor: String,
    /// Nothing once its statuses cannot be had.
    source: Option<Follower<Status>>,
    line: Line,
}

impl Run<'_> {
    /// Watches the lines of all sensors that are followed by now.
    pub(super) fn watch_lines(&mut self) {
        if self.lined == self.tracks.len() {
            return;
        }
        self.lined = self.tracks.len();
        for track in &self.tracks {
            if !track.name.is_robot() {
                watch(&mut self.lines, &track.name.sensor);
            }
        }
    }

    /// Receives the statuses that wait.
    pub(super) fn take_lines(&mut self, sink: &mut dyn Sink) -> Result<(), End> {
        for LineTrack { sensor, source, line } in &mut self.lines {
            while let Some(follower) = source {
                match follower.receive(&mut self.session) {
                    Ok(None) => break,
                    Ok(Some(status)) => {
                        line.note(status.header().boot, &status.counters);
                        sink.line(sensor, &status)?;
                    }
                    Err(_) => *source = None,
                }
            }
        }
        Ok(())
    }

    /// What the line of `sensor` took away in the run.
    pub(super) fn loss(&self, sensor: &str) -> Loss {
        let line = self.lines.iter().find(|line| line.sensor == sensor);
        line.map(|line| line.line.loss()).unwrap_or_default()
    }
}

/// Watches the lines of the sensors that a verdict over several is made of.
pub(super) fn watch_parts(lines: &mut Vec<LineTrack>, sample: &Sample) {
    if let Sample::Robot(heard) = sample
        && heard.robot.sensors().count() != lines.len()
    {
        heard.robot.sensors().for_each(|(sensor, _)| watch(lines, sensor));
    }
}

fn watch(lines: &mut Vec<LineTrack>, sensor: &str) {
    if lines.iter().all(|line| line.sensor != sensor) {
        let source = Some(Follower::new(sensor));
        lines.push(LineTrack { sensor: sensor.to_owned(), source, line: Line::default() });
    }
}
