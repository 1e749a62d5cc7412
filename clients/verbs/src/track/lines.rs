//! The lines of `track`: who is where, what happened, who went through doors. Refuses to know how they are found.

use std::io::{self, Write};

use ::track::{Counts, Event, Kind, Picture, Site, Track};
use serde::Serialize;

/// Class `tracks`.
pub(super) fn tracks(site: &Site, sensor: &str, seq: u64, picture: &Picture) -> impl Serialize {
    #[derive(Serialize)]
    struct Line {
        class: &'static str,
        sensor: String,
        seq: u64,
        wall_ns: u64,
        tracks: Vec<One>,
    }
    let tracks = picture.tracks.iter().map(|track| one(site, track)).collect();
    Line { class: "tracks", sensor: sensor.to_owned(), seq, wall_ns: picture.wall_ns, tracks }
}

#[derive(Serialize)]
struct One {
    id: u64,
    state: &'static str,
    x_m: f64,
    y_m: f64,
    vx_m_s: f64,
    vy_m_s: f64,
    cov: [f64; 3],
    room: Option<String>,
    sensors: Vec<String>,
    age_s: f64,
    score: f64,
}

fn one(site: &Site, track: &Track) -> One {
    let thousandths = |value: f64| (1000.0 * value).round() / 1000.0;
    let sensors = site.sensors.iter().enumerate().filter(|(i, _)| track.sensors >> i & 1 == 1);
    One {
        id: track.id,
        state: track.state.name(),
        x_m: thousandths(track.place[0]),
        y_m: thousandths(track.place[1]),
        vx_m_s: thousandths(track.velocity[0]),
        vy_m_s: thousandths(track.velocity[1]),
        cov: track.covariance.map(|value| (1e6 * value).round() / 1e6),
        room: track.room.map(|room| site.rooms[room].name.clone()),
        sensors: sensors.map(|(_, sensor)| sensor.name.clone()).collect(),
        age_s: thousandths(track.age_s),
        score: thousandths(track.score),
    }
}

/// Class `event`.
pub(super) fn event<'a>(site: &'a Site, sensor: &'a str, event: &Event) -> impl Serialize + 'a {
    #[derive(Serialize)]
    struct Line<'a> {
        class: &'static str,
        sensor: &'a str,
        wall_ns: u64,
        kind: &'static str,
        id: u64,
        room: Option<&'a str>,
        #[serde(skip_serializing_if = "Option::is_none")]
        from: Option<&'a str>,
        #[serde(skip_serializing_if = "Option::is_none")]
        to: Option<&'a str>,
        #[serde(skip_serializing_if = "Option::is_none")]
        door: Option<&'a str>,
    }
    let (kind, way) = match event.kind {
        Kind::Appeared => ("appeared", None),
        Kind::Left => ("left", None),
        Kind::Door { door, from, to } => ("door", Some((door, from, to))),
    };
    Line {
        class: "event",
        sensor,
        wall_ns: event.wall_ns,
        kind,
        id: event.id,
        room: event.room.map(|room| site.rooms[room].name.as_str()),
        from: way.map(|(_, from, _)| site.room_name(from)),
        to: way.map(|(.., to)| site.room_name(to)),
        door: way.map(|(door, ..)| site.doors[door].name.as_str()),
    }
}

/// Class `count`.
pub(super) fn count<'a>(
    sensor: &'a str,
    door: &'a str,
    passed: [u64; 2],
    wall_ns: u64,
) -> impl Serialize + 'a {
    #[derive(Serialize)]
    struct Line<'a> {
        class: &'static str,
        sensor: &'a str,
        wall_ns: u64,
        #[serde(flatten)]
        door: Passed<'a>,
    }
    Line { class: "count", sensor, wall_ns, door: Passed::of((door, passed)) }
}

#[derive(Serialize)]
struct Passed<'a> {
    door: &'a str,
    /// From the room that `from` names to that which `to` names.
    forth: u64,
    back: u64,
}

impl<'a> Passed<'a> {
    fn of((door, [forth, back]): (&'a str, [u64; 2])) -> Passed<'a> {
        Passed { door, forth, back }
    }
}

/// What a run came to, beside its doors.
pub(super) struct Sum {
    pub(super) pictures: u64,
    pub(super) appeared: u64,
    pub(super) counts: Counts,
    pub(super) missed: u64,
}

/// Class `summary`.
pub(super) fn summary<'a>(sensor: &'a str, sum: &Sum, doors: &[(&'a str, [u64; 2])]) -> impl Serialize + 'a {
    #[derive(Serialize)]
    struct Line<'a> {
        class: &'static str,
        sensor: &'a str,
        pictures: u64,
        appeared: u64,
        doors: Vec<Passed<'a>>,
        scans: u64,
        late: u64,
        jumped: u64,
        unfit: u64,
        missed: u64,
    }
    let Counts { scans, late, jumped, unfit } = sum.counts;
    Line {
        class: "summary",
        sensor,
        pictures: sum.pictures,
        appeared: sum.appeared,
        doors: doors.iter().map(|&door| Passed::of(door)).collect(),
        scans,
        late,
        jumped,
        unfit,
        missed: sum.missed,
    }
}

pub(super) fn event_text(line: &mut Vec<u8>, site: &Site, event: &Event) -> io::Result<()> {
    let room = site.room_name(event.room);
    match event.kind {
        Kind::Appeared => write!(line, "{} appeared in {room}", event.id),
        Kind::Left => write!(line, "{} left, last in {room}", event.id),
        Kind::Door { door, from, to } => {
            let (from, to) = (site.room_name(from), site.room_name(to));
            write!(line, "{} went from {from} to {to} through {}", event.id, site.doors[door].name)
        }
    }
}

pub(super) fn count_text(line: &mut Vec<u8>, door: &str, [forth, back]: [u64; 2]) -> io::Result<()> {
    write!(line, "{door}: {forth} forth, {back} back")
}

pub(super) fn summary_text(line: &mut Vec<u8>, sum: &Sum, doors: &[(&str, [u64; 2])]) -> io::Result<()> {
    let Counts { scans, late, jumped, unfit } = sum.counts;
    write!(line, "{} people appeared in {scans} scans", sum.appeared)?;
    for (name, passed) in doors {
        write!(line, "; ")?;
        count_text(line, name, *passed)?;
    }
    write!(line, "; left out: {late} late, {jumped} jumped, {unfit} unfit, {} missed", sum.missed)
}
