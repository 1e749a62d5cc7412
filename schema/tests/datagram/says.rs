//! What a datagram says, in the words of the list of golden datagrams.

use schema::datagram::{Announce, Datagram, Packed, telegram};
use schema::{Background, Foreground, Marks, Scan, Status, Topic, Zones};
use serde_json::{Map, Value, json};

pub(crate) fn head(datagram: &Datagram<'_>) -> Value {
    let head = datagram.head;
    json!({
        "topic": head.topic, "flags": head.flags, "hub": id(head.hub), "epoch": head.epoch,
        "sequence": head.sequence, "stamp_ns": head.stamp_ns, "sensor": head.sensor, "revision": head.revision,
        "counter": head.counter, "payload_len": datagram.payload.len(),
    })
}

pub(crate) fn payload(datagram: &Datagram<'_>) -> Value {
    let payload = datagram.payload;
    match Topic::of_number(datagram.head.topic) {
        None => announce(Announce::unpack(payload).expect("an announcement")),
        Some(Topic::Telegram) => {
            let bytes = telegram(payload).expect("a telegram").0;
            json!({ "telegram": bytes.iter().map(|byte| format!("{byte:02x}")).collect::<String>() })
        }
        Some(Topic::Scan) => scan(&unpacked(Scan::default(), payload)),
        Some(Topic::Marks) => marks(&unpacked(Marks::default(), payload)),
        Some(Topic::Zones) => zones(&unpacked(Zones::unknown(), payload)),
        Some(Topic::Foreground) => foreground(&unpacked(Foreground::default(), payload)),
        Some(Topic::Background) => background(&unpacked(Background::default(), payload)),
        Some(Topic::Status) => status(&unpacked(Status::default(), payload)),
    }
}

fn unpacked<T: Packed>(mut value: T, payload: &[u8]) -> T {
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
    // A scan without upper bits comes back with upper bits of 0.
    let upper = if scan.upper().iter().all(|&upper| upper == 0) { &[] } else { scan.upper() };
    json!({
        "count": scan.count, "unit_mm": scan.unit_mm, "range_bits": scan.range_bits,
        "first_angle_mdeg": scan.first_angle_mdeg, "step_mdeg": scan.step_mdeg,
        "intensity_bits": scan.intensity_bits, "ranges": scan.ranges(), "upper": upper,
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
    let segments = foreground.segments().iter().map(|segment| {
        json!({
            "first": segment.first, "last": segment.last, "nearest": segment.nearest, "width": segment.width,
            "x_mm": segment.x_mm, "y_mm": segment.y_mm,
        })
    });
    json!({
        "generation": foreground.generation, "count": foreground.count, "unit_mm": foreground.unit_mm,
        "left_out": foreground.left_out,
        "beams": foreground.readings().map(|(beam, _)| beam).collect::<Vec<_>>(),
        "ranges": foreground.ranges(), "segments": segments.collect::<Vec<_>>(),
    })
}

fn background(model: &Background) -> Value {
    json!({
        "generation": model.generation, "taught": model.taught, "count": model.count,
        "unit_mm": model.unit_mm, "frozen": model.is_frozen(), "ranges": model.ranges(),
    })
}

fn status(status: &Status) -> Value {
    let counters: Map<String, Value> =
        status.counters.named().map(|(name, count)| (name.to_owned(), count.into())).collect();
    let pose = status.pose;
    json!({
        "state": status.state().map(|state| state.name()), "mode": status.mode, "unit_mm": status.unit_mm,
        "baud": status.baud, "since_ns": status.since_ns, "rate_mhz": status.rate_mhz,
        "angle_deg": status.angle_deg, "resolution_cdeg": status.resolution_cdeg,
        "type": status.sensor_type(), "port": status.port(), "last_error": status.last_error(),
        "counters": counters,
        "pose": {
            "x_m": pose.x_m, "y_m": pose.y_m, "yaw_rad": pose.yaw_rad, "upside_down": pose.upside_down == 1,
        },
    })
}
