//! JSON description of the contents of a datagram, as in the list of golden datagrams.

use scanhub_schema::datagram::{Announce, Datagram, DatagramPayload, MTU_SAFE};
use scanhub_schema::{
    Background, Cloud, Code, Early, Event, Family, Foreground, Lines, MAX_BEAMS, Marks, Motion, Obstacle,
    Obstacles, Scan, Status, Tilt, Topic, Tracks, Zones,
};
use serde_json::{Map, Value, json};

pub(crate) fn head(datagram: &Datagram<'_>) -> Value {
    let head = datagram.head;
    json!({
        "topic": head.topic, "flags": head.flags, "hub": id(head.hub), "epoch": head.epoch,
        "sequence": head.sequence, "stamp_ns": head.stamp_ns, "sensor": head.sensor, "part": head.part,
        "parts": head.parts, "family": head.family, "revision": head.revision,
        "counter": head.counter, "payload_len": datagram.payload.len(),
    })
}

pub(crate) fn payload(datagram: &Datagram<'_>) -> Value {
    let payload = datagram.payload;
    match Topic::of_number(datagram.head.topic) {
        None => announce(Announce::unpack(payload).expect("an announcement")),
        Some(Topic::Telegram) => {
            let telegram = datagram.telegram().expect("a telegram");
            let hex = telegram.bytes.iter().map(|byte| format!("{byte:02x}")).collect::<String>();
            json!({ "telegram": hex, "packets": telegram.packets().map(|facts| facts.packets) })
        }
        Some(Topic::Scan) => scan(&unpacked(Scan::zeroed(MTU_SAFE), payload)),
        Some(Topic::Marks) => marks(&unpacked(Box::<Marks>::default(), payload)),
        Some(Topic::Zones) => zones(&unpacked(Box::<Zones>::default(), payload)),
        Some(Topic::Foreground) => foreground(&unpacked(Foreground::of(MAX_BEAMS), payload)),
        Some(Topic::Background) => background(&unpacked(Background::zeroed(MTU_SAFE), payload)),
        Some(Topic::Lines) => lines(&unpacked(Box::<Lines>::default(), payload)),
        Some(Topic::Motion) => motion(&unpacked(Box::<Motion>::default(), payload)),
        Some(Topic::Early) => early(&unpacked(Box::<Early>::default(), payload)),
        Some(Topic::Tracks) => tracks(&unpacked(Box::<Tracks>::default(), payload)),
        Some(Topic::Events) => event(&unpacked(Box::<Event>::default(), payload)),
        Some(Topic::Tilt) => tilt(&unpacked(Box::<Tilt>::default(), payload)),
        Some(Topic::Cloud) => cloud(&unpacked(Cloud::zeroed(MTU_SAFE), payload)),
        Some(Topic::Obstacles) => obstacles(&unpacked(Box::<Obstacles>::default(), payload)),
        Some(Topic::Status) => status(&unpacked(Box::<Status>::default(), payload)),
    }
}

fn unpacked<T: DatagramPayload + ?Sized>(mut value: Box<T>, payload: &[u8]) -> Box<T> {
    assert!(value.unpack(payload));
    value
}

fn id(number: u64) -> String {
    format!("{number:016x}")
}

fn announce(announce: Announce) -> Value {
    let topics = announce.topics().iter().map(
        |topic| json!({ "topic": topic.topic, "group": topic.group, "port": topic.port, "next": topic.next }),
    );
    json!({
        "boot": id(announce.boot), "sensor": announce.sensor(), "type": announce.kind(),
        "topics": topics.collect::<Vec<_>>(),
    })
}

fn scan(scan: &Scan) -> Value {
    let each = |value: &dyn Fn(usize) -> Value| (0..scan.beams()).map(value).collect::<Vec<_>>();
    json!({
        "family": Family::of_number(scan.family).map(Family::name), "unit_um": scan.unit_um, "count": scan.count,
        "first_angle": scan.first_angle, "step": scan.step, "spacing": scan.spacing, "beam_time_ns": scan.beam_time_ns, "valid_to": scan.valid_to,
        "no_return": scan.no_return, "beyond": scan.beyond, "collisions": scan.collisions,
        "incomplete": scan.is_incomplete(), "intensity_bits": scan.intensity_bits,
        "ranges": scan.ranges(), "codes": each(&|i| scan.code(i).map(Code::name).into()),
        "times_ns": each(&|i| scan.beam_ns(i).into()),
        // JSON has no NaN.
        "angles": scan.exact_angles().iter().map(|&exact| Some(exact).filter(|exact| !exact.is_nan())).collect::<Vec<_>>(),
        "intensities": scan.intensities().iter().collect::<Vec<_>>(), "upper": scan.upper(),
    })
}

fn marks(marks: &Marks) -> Value {
    let list = marks.marks().iter().map(|mark| {
        json!({
            "angle_mdeg": mark.angle_mdeg, "range_dmm": mark.range_dmm, "weight": mark.weight,
            "peak": mark.peak, "edge": mark.edge, "first_beam": mark.first_beam, "last_beam": mark.last_beam,
        })
    });
    json!({
        "overflow": marks.is_overflow(), "unavailable": !marks.is_available(),
        "marks": list.collect::<Vec<_>>(),
    })
}

fn lines(lines: &Lines) -> Value {
    let list = lines.lines().iter().map(|line| {
        json!({
            "x1_m": line.x1_m, "y1_m": line.y1_m, "x2_m": line.x2_m, "y2_m": line.y2_m, "r_m": line.r_m,
            "alpha_rad": line.alpha_rad, "sd_r_m": line.sd_r_m, "sd_alpha_rad": line.sd_alpha_rad,
            "first": line.first, "last": line.last, "points": line.points,
        })
    });
    let corners = lines.corners().iter().map(|corner| {
        json!({ "x_m": corner.x_m, "y_m": corner.y_m, "first_line": corner.first_line, "second_line": corner.second_line })
    });
    json!({
        "overflow": lines.is_overflow(), "readings": lines.readings, "on_lines": lines.on_lines,
        "noise_m": lines.noise_m, "lines": list.collect::<Vec<_>>(), "corners": corners.collect::<Vec<_>>(),
    })
}

fn motion(motion: &Motion) -> Value {
    json!({
        "x_m": motion.x_m, "y_m": motion.y_m, "yaw_rad": motion.yaw_rad, "dx_m": motion.dx_m, "dy_m": motion.dy_m,
        "dyaw_rad": motion.dyaw_rad, "covariance": motion.covariance, "overlap": motion.overlap,
        "method": motion.method().name(), "valid": motion.has_valid_pose(), "degenerate": motion.is_degenerate(), "refused_steps": motion.refused_steps,
        "pose_covariance": motion.pose_covariance,
    })
}

fn early(early: &Early) -> Value {
    json!({
        "verdict": early.verdict().name(), "withdrawn": early.is_withdrawn(), "beam": early.beam,
        "distance_mm": early.distance_mm, "bytes_seen": early.bytes_seen, "beams_seen": early.beams_seen,
    })
}

fn tracks(tracks: &Tracks) -> Value {
    let list = tracks.tracks().iter().map(|track| {
        json!({
            "id": track.id, "x_m": track.x_m, "y_m": track.y_m, "vx_m_s": track.vx_m_s, "vy_m_s": track.vy_m_s,
            "covariance": track.covariance, "score": track.score, "age_ms": track.age_ms, "sensors": track.sensors,
            "room": track.room_name().unwrap_or_default(), "state": track.state().name(),
        })
    });
    let sites = tracks.sensors().iter().map(|sensor| {
        json!({
            "name": sensor.name(), "site_x_m": sensor.x_m, "site_y_m": sensor.y_m, "yaw_rad": sensor.yaw_rad,
            "upside_down": sensor.upside_down == 1,
        })
    });
    json!({ "sites": sites.collect::<Vec<_>>(), "tracks": list.collect::<Vec<_>>() })
}

fn event(event: &Event) -> Value {
    let (door, from, to) = event.door().unwrap_or_default();
    json!({
        "kind": event.kind().map(|kind| kind.name()), "id": event.id, "room": event.room_name().unwrap_or_default(),
        "door": door, "from": from, "to": to,
    })
}

fn tilt(tilt: &Tilt) -> Value {
    json!({ "angle_rad": tilt.angle_rad, "rate_rad_s": tilt.rate_rad_s() })
}

fn cloud(cloud: &Cloud) -> Value {
    let list = cloud.points().iter().map(|point| {
        let [x_m, y_m, z_m] = point.at;
        json!({ "x_m": x_m, "y_m": y_m, "z_m": z_m, "beam": point.beam, "class": point.class().name() })
    });
    json!({
        "sweep": cloud.sweep, "generation": cloud.generation, "first": cloud.has(Cloud::FIRST),
        "last": cloud.has(Cloud::LAST), "complete": cloud.has(Cloud::COMPLETE),
        "unreliable": cloud.has(Cloud::UNRELIABLE), "points": list.collect::<Vec<_>>(),
    })
}

fn obstacles(found: &Obstacles) -> Value {
    let list = found.obstacles().iter().map(|one| {
        let [x_m, y_m, z_m] = one.middle;
        json!({
            "x_m": x_m, "y_m": y_m, "z_m": z_m, "low_m": one.low, "high_m": one.high,
            "distance_m": one.distance_m, "points": one.points,
            "foreground": one.has(Obstacle::FOREGROUND), "near": one.has(Obstacle::NEAR),
        })
    });
    json!({
        "sweep": found.sweep, "generation": found.generation, "complete": found.has(Obstacles::COMPLETE),
        "unreliable": found.has(Obstacles::UNRELIABLE), "dropped": found.dropped,
        "obstacles": list.collect::<Vec<_>>(),
    })
}

fn zones(zones: &Zones) -> Value {
    let list = zones.zones().iter().map(
        |zone| json!({ "radius_mm": zone.radius_mm, "beams": zone.beams, "violated": zone.violated == 1 }),
    );
    json!({
        "verdict": zones.verdict().name(),
        "nearest_beam": zones.nearest().map(|(beam, _)| beam),
        "nearest_mm": zones.nearest().map(|(_, distance_mm)| distance_mm),
        "invalid_beams": zones.invalid_beams,
        "provisional": zones.flags & Zones::PROVISIONAL != 0,
        "zones": list.collect::<Vec<_>>(),
    })
}

fn foreground(foreground: &Foreground) -> Value {
    let segments = foreground.segments().iter().enumerate().map(|(i, segment)| {
        json!({
            "first": segment.first, "last": segment.last, "nearest": segment.nearest, "width": segment.width,
            "x_mm": segment.x_mm, "y_mm": segment.y_mm, "support": foreground.has_support(i),
        })
    });
    json!({
        "generation": foreground.generation, "count": foreground.count, "unit_um": foreground.unit_um,
        "dropped": foreground.dropped,
        "beams": foreground.readings().map(|(beam, _)| beam).collect::<Vec<_>>(),
        "ranges": foreground.ranges(), "segments": segments.collect::<Vec<_>>(),
    })
}

fn background(model: &Background) -> Value {
    json!({
        "generation": model.generation, "known_beams": model.known_beams, "count": model.count,
        "unit_um": model.unit_um, "first_angle": model.first_angle, "step": model.step, "frozen": model.is_frozen(), "ranges": model.ranges(),
    })
}

fn status(status: &Status) -> Value {
    let counters: Map<String, Value> =
        status.counters.named_values().map(|(name, count)| (name.to_owned(), count.into())).collect();
    let pose = status.pose;
    json!({
        "state": status.state().map(|state| state.name()), "mode": status.mode, "unit_mm": status.unit_mm,
        "family": status.family().map(|family| family.name()),
        "baud": status.baud, "since_ns": status.since_ns, "rate_mhz": status.rate_mhz,
        "angle_deg": status.angle_deg, "resolution_cdeg": status.resolution_cdeg,
        "type": status.sensor_type(), "port": status.port(), "last_error": status.last_error(),
        "counters": counters,
        "pose": {
            "x_m": pose.x_m, "y_m": pose.y_m, "yaw_rad": pose.yaw_rad, "upside_down": pose.upside_down == 1,
        },
    })
}
