"""Subscribes to topics, and prints each sample as `scanhub echo --json` does, and notices. Arguments are domain, root
and topics. Ctrl-C ends the program, which then prints a last line."""

import json
import math
import os
import signal
import sys

import scanhub


def stamp(sample: scanhub.Sample) -> dict:
    line = {
        "class": sample.topic,
        "sensor": sample.sensor,
        "seq": sample.seq,
        "topic_seq": sample.topic_seq,
        "stamp_ns": sample.stamp_ns,
        "wall_ns": sample.wall_ns,
        "boot": f"{sample.boot:016x}",
        "quality": sample.quality,
    }
    if sample.reasons:
        line["reasons"] = list(sample.reasons)
    return line


def flags(sample: scanhub.Sample) -> dict:
    order = ("simulated", "replayed", "stamp_estimated", "remote")
    return {"flags": sorted(sample.flags, key=order.index)} if sample.flags else {}


def telegram(sample: scanhub.Telegram) -> dict:
    if sample.family != "lms":
        line = {"family": sample.family, "kind": "data", "checked": True, "packets": sample.packets}
        assert sample.address is sample.command is sample.length is None
        return {**line, "length": len(sample.data), "data": sample.data.tobytes().hex()}
    fields = ("address", "command", "length")
    return {**{name: getattr(sample, name) for name in fields}, "data": sample.data.tobytes().hex()}


def in_degrees(angle: "float | None") -> "float | None":
    return None if angle is None else round(math.degrees(angle) * 1e6) / 1e6


def scan(sample: scanhub.Scan) -> dict:
    line = {name: getattr(sample, name) for name in ("family", "unit_um", "count", "beam_time_ns")}
    line["first_angle_deg"], line["step_deg"] = in_degrees(sample.first_angle), in_degrees(sample.step)
    line["ranges"] = [int(range) if valid else None for range, valid in zip(sample.ranges, sample.valid)]
    line["codes"] = [[beam, word] for beam, word in sample.codes if word != "not_measured"]
    if sample.intensities is not None:
        line["intensities"] = sample.intensities.tolist()
    if sample.exact_angles is not None:
        pairs = zip(sample.angles, sample.valid)
        line["angles_deg"] = [round(math.degrees(angle), 4) if valid else None for angle, valid in pairs]
        line["collisions"] = sample.collisions
    return {**line, **({"incomplete": True} if sample.incomplete else {})}


def marks(sample: scanhub.Marks) -> dict:
    found = [mark._asdict() for mark in sample.marks]
    return {"available": sample.available, "overflow": sample.overflow, "marks": found}


def lines(sample: scanhub.Lines) -> dict:
    def metres(value: float) -> float:
        # Rounds halves away from 0, as Rust does.
        return math.copysign(math.floor(abs(value) * 1e6 + 0.5), value) / 1e6

    fields = {"readings": sample.readings, "points": sample.on_lines, "noise_m": metres(sample.noise_m)}
    fields["overflow"] = sample.overflow
    found = []
    for line in sample.lines:
        of = {name: metres(getattr(line, name)) for name in ("x1_m", "y1_m", "x2_m", "y2_m", "r_m", "sd_r_m")}
        of.update({name: getattr(line, name) for name in ("first", "last", "points")})
        of["alpha_deg"], of["sd_alpha_deg"] = in_degrees(line.alpha_rad), in_degrees(line.sd_alpha_rad)
        found.append(of)
    corners = [
        {"x_m": metres(at.x_m), "y_m": metres(at.y_m), "first": at.first_line, "second": at.second_line}
        for at in sample.corners
    ]
    return {**fields, "lines": found, "corners": corners}


def motion(sample: scanhub.Motion) -> dict:
    def millionths(value: float | None) -> float | None:
        return None if value is None else math.copysign(math.floor(abs(value) * 1e6 + 0.5), value) / 1e6

    line = {name: getattr(sample, name) for name in ("method", "valid", "degenerate", "refused_steps")}
    step, place = sample.step or (None,) * 3, sample.place or (None,) * 3
    line["dx_m"], line["dy_m"], line["dyaw_deg"] = millionths(step[0]), millionths(step[1]), in_degrees(step[2])
    line["x_m"], line["y_m"], line["yaw_deg"] = millionths(place[0]), millionths(place[1]), in_degrees(place[2])
    line["overlap"] = millionths(sample.overlap)
    for name in ("covariance", "pose_covariance"):
        covariance = getattr(sample, name)
        # The shortest decimal number that rounds to this 32-bit value.
        line[name] = None if covariance is None else [float(str(value)) for value in covariance.flat]
    return line


def tracks(sample: scanhub.Tracks) -> dict:
    def track(of: scanhub.Track) -> dict:
        line = of._asdict()
        line.update({name: rounded(line[name], 3) for name in ("x_m", "y_m", "vx_m_s", "vy_m_s", "score")})
        return {**line, "cov": [rounded(value, 6) for value in of.cov], "sensors": list(of.sensors)}

    return {"tracks": [track(of) for of in sample.tracks]}


def events(sample: scanhub.Event) -> dict:
    line = {"class": "event", "kind": sample.kind, "id": sample.id, "room": sample.room}
    return line if sample.door is None else {**line, "from": sample.from_room, "to": sample.to_room, "door": sample.door}


def rounded(value: float, digits: int) -> float:
    """Rounds halves away from 0, as Rust does."""
    return math.copysign(math.floor(abs(value) * 10**digits + 0.5), value) / 10**digits


def tilt(sample: scanhub.Tilt) -> dict:
    rate = sample.rate_rad_s
    line = {"angle_deg": rounded(math.degrees(sample.angle_rad), 4)}
    return {**line, "rate_deg_s": None if rate is None else rounded(math.degrees(rate), 4)}


def swept(sample: scanhub.Cloud | scanhub.Obstacles) -> dict:
    return {name: getattr(sample, name) for name in ("sweep", "generation", "complete", "unreliable")}


def cloud(sample: scanhub.Cloud) -> dict:
    line = {**swept(sample), "first": sample.first, "last": sample.last}
    points = [[rounded(float(value), 3) for value in point] for point in sample.points]
    return {**line, "points": points, "beams": sample.beams.tolist(), "classes": sample.classes.tolist()}


def obstacles(sample: scanhub.Obstacles) -> dict:
    def obstacle(of: scanhub.Obstacle) -> dict:
        line = of._asdict()
        line.update({name: rounded(line[name], 3) for name in ("x_m", "y_m", "z_m", "distance_m")})
        line.update({name: [rounded(value, 3) for value in line[name]] for name in ("low_m", "high_m")})
        return line

    line = {**swept(sample), "dropped": sample.dropped}
    return {**line, "obstacles": [obstacle(of) for of in sample.obstacles]}


def zones(sample: scanhub.Zones) -> dict:
    line = {name: getattr(sample, name) for name in ("verdict", "nearest_mm", "nearest_beam", "invalid_beams")}
    line["zones"] = [zone._asdict() for zone in sample.zones]
    line.update({name: True for name in ("provisional", "stale") if getattr(sample, name)})
    return line


def foreground(sample: scanhub.Foreground) -> dict:
    line = {name: getattr(sample, name) for name in ("generation", "unit_mm", "dropped")}
    line["beams"], line["ranges"] = sample.beams.tolist(), sample.ranges.tolist()
    return {**line, "segments": [segment._asdict() for segment in sample.segments]}


def background(sample: scanhub.Background) -> dict:
    line = {name: getattr(sample, name) for name in ("generation", "known_beams", "unit_mm", "count", "frozen")}
    line["first_angle_deg"], line["step_deg"] = in_degrees(sample.first_angle), in_degrees(sample.step)
    line["ranges"] = [None if range in (0, 65535) else int(range) for range in sample.ranges]
    line["far"] = [beam for beam, range in enumerate(sample.ranges) if range == 65535]
    return line


def status(sample: scanhub.Status) -> dict:
    names = ("state", "family", "model", "baud", "mode", "type", "unit_mm", "angle_deg", "step_deg", "hz", "port", "since_ns")
    line = {name: getattr(sample, name) for name in (*names, "counters", "last_error", "damaged", "lost_on_line")}
    return {**line, "pose": sample.pose._asdict()}


def say(line: dict) -> None:
    """Writes a line with one system call that Ctrl-C does not interrupt, so that no partial line is written into a full
    pipe."""
    written = (json.dumps(line) + "\n").encode()
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    assert os.write(sys.stdout.fileno(), written) == len(written)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})


def notice(kind: str) -> None:
    say({"class": "notice", "kind": kind})


domain, root, *topics = sys.argv[1:]
try:
    for sample in scanhub.subscribe(*topics, domain=domain, root=root, on_notice=notice):
        line = {**stamp(sample), **globals()[sample.topic](sample), **flags(sample)}
        extra = {"missed": sample.missed, "restarted": sample.restarted}
        say({**line, "python": extra})
except KeyboardInterrupt:
    say({"class": "end"})
