//! Baseline: the simplest tracker, in which each segment is a person and belongs to the nearest track within half a
//! meter.

use scanhub_perception::track::geometry::{Point, distance};
use scanhub_perception::track::{SNAPSHOT_INTERVAL_NS, Site, Snapshot, Track};
use scanhub_schema::Foreground;
use scanhub_schema::TrackState;

struct NearestTrack {
    id: u64,
    position: Point,
    last_seen_ns: u64,
}

pub(crate) struct NearestTracker {
    site: Site,
    known: Vec<NearestTrack>,
    next_id: u64,
    next_ns: u64,
}

impl NearestTracker {
    pub(crate) fn new(site: Site) -> NearestTracker {
        NearestTracker { site, known: Vec::new(), next_id: 1, next_ns: 0 }
    }

    pub(crate) fn take(
        &mut self,
        at_ns: u64,
        sensor: usize,
        foreground: &Foreground,
        samples: &mut Vec<Snapshot>,
    ) {
        let sensor = &self.site.sensors[sensor];
        let (sin, cos) = sensor.yaw_rad.sin_cos();
        for segment in foreground.segments() {
            let (x, y) = (f64::from(segment.x_mm) / 1000.0, f64::from(segment.y_mm) / 1000.0);
            let position = [sensor.position[0] + x * cos - y * sin, sensor.position[1] + x * sin + y * cos];
            let near = self.known.iter_mut().map(|one| (distance(one.position, position), one));
            match near.min_by(|a, b| a.0.total_cmp(&b.0)).filter(|(off, _)| *off < 0.5) {
                Some((_, one)) => (one.position, one.last_seen_ns) = (position, at_ns),
                None => {
                    self.known.push(NearestTrack { id: self.next_id, position, last_seen_ns: at_ns });
                    self.next_id += 1;
                }
            }
        }
        self.known.retain(|one| at_ns.saturating_sub(one.last_seen_ns) < 500_000_000);
        if at_ns >= self.next_ns {
            self.next_ns = at_ns + SNAPSHOT_INTERVAL_NS;
            let tracks = self.known.iter().map(|one| Track {
                id: one.id,
                state: TrackState::Confirmed,
                position: one.position,
                velocity: [0.0, 0.0],
                covariance: [0.0; 3],
                room: None,
                sensors: 0,
                age_s: 0.0,
                score: 1.0,
            });
            samples.push(Snapshot { wall_ns: at_ns, tracks: tracks.collect(), ..Snapshot::default() });
        }
    }
}
