//! The simplest that one might do: each segment is a person, and belongs to the nearest one within half a metre.

use scanhub_perception::track::geometry::{Point, distance};
use scanhub_perception::track::{PICTURE_NS, Picture, Site, Track};
use scanhub_schema::Foreground;
use scanhub_schema::TrackState;

struct One {
    id: u64,
    place: Point,
    seen_ns: u64,
}

pub(crate) struct Nearest {
    site: Site,
    all: Vec<One>,
    next_id: u64,
    next_ns: u64,
}

impl Nearest {
    pub(crate) fn new(site: Site) -> Nearest {
        Nearest { site, all: Vec::new(), next_id: 1, next_ns: 0 }
    }

    pub(crate) fn take(
        &mut self,
        at_ns: u64,
        sensor: usize,
        foreground: &Foreground,
        pictures: &mut Vec<Picture>,
    ) {
        let sensor = &self.site.sensors[sensor];
        let (sin, cos) = sensor.yaw_rad.sin_cos();
        for segment in foreground.segments() {
            let (x, y) = (f64::from(segment.x_mm) / 1000.0, f64::from(segment.y_mm) / 1000.0);
            let place = [sensor.place[0] + x * cos - y * sin, sensor.place[1] + x * sin + y * cos];
            let near = self.all.iter_mut().map(|one| (distance(one.place, place), one));
            match near.min_by(|a, b| a.0.total_cmp(&b.0)).filter(|(off, _)| *off < 0.5) {
                Some((_, one)) => (one.place, one.seen_ns) = (place, at_ns),
                None => {
                    self.all.push(One { id: self.next_id, place, seen_ns: at_ns });
                    self.next_id += 1;
                }
            }
        }
        self.all.retain(|one| at_ns.saturating_sub(one.seen_ns) < 500_000_000);
        if at_ns >= self.next_ns {
            self.next_ns = at_ns + PICTURE_NS;
            let tracks = self.all.iter().map(|one| Track {
                id: one.id,
                state: TrackState::Confirmed,
                place: one.place,
                velocity: [0.0, 0.0],
                covariance: [0.0; 3],
                room: None,
                sensors: 0,
                age_s: 0.0,
                score: 1.0,
            });
            pictures.push(Picture { wall_ns: at_ns, tracks: tracks.collect(), ..Picture::default() });
        }
    }
}
