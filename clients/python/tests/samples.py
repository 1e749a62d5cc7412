"""Checks samples that are made from the golden files of `schema`. The argument is the directory of these files."""

import sys
from pathlib import Path

import numpy as np
import scanhub

GOLDEN = Path(sys.argv[1])
BYTES = dict(line.split() for line in (GOLDEN / "bytes.txt").read_text().splitlines())


def golden(name: str) -> bytes:
    return bytes.fromhex(BYTES[name])


def sample(topic: str, name: str, cut: "int | None" = None):
    """Returns a sample with the header and the payload of golden files, restored like a pickled sample."""
    state = (5, True, False)
    return scanhub._scanhub._restore("front", topic, golden("header"), golden(name)[:cut], state)


def headers_say_what_they_are() -> None:
    of = sample("status", "status")
    assert (of.seq, of.topic_seq, of.stamp_ns, of.stamp_last_ns) == (1, 2, 3, 4)
    assert (of.wall_ns, of.boot) == (0x1122_3344_5566_7788, 0x99AA_BBCC_DDEE_FF00)
    assert (of.quality, of.reasons, of.period_us) == ("suspect", ("neighbour", "header_inside"), 26_640)
    assert of.flags == {"simulated"} and of.hub_time_ns == 256 * 0xFF02B2


def payloads_say_what_they_are() -> None:
    of = sample("scan", "scan")
    assert (of.family, of.count, of.unit_um, of.beam_time_ns, of.collisions) == ("lms", 401, 10_000, 9250, 0)
    assert (of.first_angle, of.step, of.incomplete) == (np.deg2rad(-50), np.deg2rad(0.25), False)
    assert (of.intensity_bits, list(of.upper[[0, 400]]), list(of.intensities[[0, 400]])) == (3, [7, 6], [7, 6])
    assert (of.ranges[0], of.ranges[400], of.ranges.shape) == (0x1234, 0x1FFF, (401,))
    assert of.codes == [(400, "no_return")] and np.isnan(of.ranges_m[400]) and of.ranges_m[0] == 46.6
    assert np.isclose(of.angles[400], np.deg2rad(50), atol=1e-12) and of.exact_angles is None
    # The beams come from four revolutions. Beam 400 belongs to the first revolution, and beam 3 to the last one. The
    # stamp is 3.
    assert (of.times_ns[400], of.times_ns[3]) == (3 - 3 * 13_320_000, 3 - 397 * 9250)

    of = sample("scan", "scan_turn")
    assert (of.family, of.count, of.unit_um, of.beam_time_ns, of.collisions) == ("ld", 5, 250, 0x1020304, 0x506)
    assert (of.first_angle, of.step, of.spacing, of.incomplete) == (-0.25, -1.5, 0.75, True)
    assert of.ranges_m[:2].tolist() == [1.165, 0xFFEF / 4000] and np.isnan(of.ranges_m[2:]).all()
    assert of.codes == [(2, "no_return"), (3, "not_measured"), (4, "beyond")]
    assert of.angles.tolist() == [-0.125, -1.5, -3.25, -0.25 - 3 * 1.5, -6.5]
    assert np.isnan(of.exact_angles[3]) and of.exact_angles.dtype == np.float32
    assert (of.intensities.tolist(), of.intensities.dtype, of.upper) == ([0xABC, 1, 0, 0, 0xFFF], np.uint16, None)
    assert of.times_ns[4] == 3 - 2 + 4 * 0x1020304

    of = sample("marks", "marks")
    assert (len(of.marks), of.available, of.overflow) == (64, False, True)
    assert of.marks[63] == (-0.002, 0x10203 / 10, 7, 0x405, 0x106, 0x108, True)

    of = sample("lines", "lines")
    assert (len(of.lines), len(of.corners), of.overflow) == (64, 64, True)
    assert (of.readings, of.on_lines, of.noise_m) == (0x102, 0x304, 1)
    assert of.lines[63] == (1, -1, 2, -2, 0.5, -0.5, 0.25, 4, 0x506, 0x708, 0x90A)
    assert of.corners[63] == (1, -1, 62, 63)

    of = sample("motion", "motion")
    assert (of.method, of.valid, of.degenerate, of.refused_steps, of.overlap) == ("both", True, True, 0x102, 0.75)
    assert of.step == (0.25, -0.125, -0.0625) and of.place == (1, -2, 0.5)
    assert of.covariance.tolist() == [[1 / 64, 2 / 64, 3 / 64], [4 / 64, 5 / 64, 6 / 64], [7 / 64, 8 / 64, 9 / 64]]

    assert of.pose_covariance.tolist() == [[-n / 32 for n in row] for row in ((1, 2, 3), (4, 5, 6), (7, 8, 9))]

    of = sample("early", "early")
    assert (of.verdict, of.withdrawn, of.beam, of.distance_mm) == ("stop", True, 0x102, 0x3040506)
    assert (of.bytes_seen, of.beams_seen) == (0x708, 0x90A)

    of = sample("tracks", "tracks")
    assert (len(of.tracks), len(of.sites), of.sites[0].name) == (64, 32, "")
    assert of.sites[31] == ("kitchen.rear", 1, -1, 0.5, True)
    assert of.tracks[63] == (
        0x1020304_05060708,
        "between_rooms",
        *(1, -1, 2, -2),
        (0.5, -0.5, 0.25),
        "hall",
        ("", "kitchen.rear"),
        0x0A0B0C0D / 1000,
        4,
    )
    assert (of.tracks[0].room, of.tracks[0].state) == (None, "tentative")

    of = sample("events", "event")
    assert (of.kind, of.id, of.room, of.door) == ("door", 0x1020304_05060708, "kitchen", "left")
    assert (of.from_room, of.to_room) == ("hall", "kitchen")

    of = sample("tilt", "tilt")
    assert (of.angle_rad, of.rate_rad_s) == (-0.5, 2)

    of = sample("cloud", "cloud")
    assert (of.sweep, of.generation, of.count) == (0x1020304, 0x5060708, 2)
    assert of.first and of.last and of.complete and of.unreliable
    assert of.points.tolist() == [[0, 0, 0], [1, -1, 0.5]] and of.points.dtype == np.float32
    assert (of.beams.tolist(), of.classes.tolist()) == ([0, 0x102], [0, 3])
    assert scanhub.CLASSES[of.classes[1]] == "behind" and not of.points.flags.writeable and not of.points.flags.owndata

    of = sample("obstacles", "obstacles")
    assert (of.sweep, of.generation, of.dropped) == (0x1020304, 0x5060708, 0x90A0B0C)
    assert (of.complete, of.unreliable, len(of.obstacles)) == (True, True, 64)
    assert of.obstacles[63] == (1, -1, 0.5, (0.5, -2, 0.25), (2, -0.5, 4), 0.5, 0xD0E0F10, True, True)
    assert of.obstacles[0] == (0, 0, 0, (0, 0, 0), (0, 0, 0), 0, 0, False, False)

    of = sample("zones", "zones")
    assert (of.verdict, of.nearest_beam, of.nearest_mm, of.invalid_beams) == ("slow", 0x102, 0x30405, 0x106)
    assert of.provisional and of.zones == ((0, False, 0), (600, True, 0x107))

    of = sample("foreground", "foreground")
    assert (of.generation, of.count, of.unit_mm, of.dropped) == (0x10203, 401, 10, 0x104)
    assert (list(of.beams), list(of.ranges), len(of.segments)) == ([400], [0x1234], 64)
    assert of.segments[63] == (400, 0x105, 60, 70, -2, 8, True)
    assert [i for i, segment in enumerate(of.segments) if segment.support] == [1, 2, 9, 63]

    of = sample("background", "background")
    assert (of.generation, of.known_beams, of.count, of.unit_mm, of.frozen) == (0x10203, 0x104, 401, 10, True)
    assert list(of.ranges[[0, 1, 400]]) == [0x1234, 0, 0xFFFF]
    assert of.ranges_m[0] == 46.6 and np.isnan(of.ranges_m[1]) and np.isinf(of.ranges_m[400])
    assert (of.first_angle, of.step, of.angles[400]) == (-0.25, -1.5, -0.25 - 400 * 1.5)

    of = sample("status", "status")
    assert (of.state, of.mode, of.unit_mm, of.baud, of.since_ns) == ("streaming", 1, 1, 500_000, 9)
    assert (of.family, of.model) == ("ld", "lms200-30106")
    assert (of.hz, of.angle_deg, of.step_deg) == (37.538, 180, 0.5)
    assert (of.type, of.port, of.last_error) == ("LMS200-30106", "/dev/ttyUSB0", "none")
    assert of.pose == (0.5, -0.5, 2.0, True)
    named = {name: value for name, value in of.counters.items() if value}
    assert named == {"bytes_read": 3, "rejected_superseded": 4, "line_errors": 5}
    assert (of.damaged, of.lost_on_line) == (0.0, None)


def a_payload_that_is_cut_short_has_fewer_beams() -> None:
    for topic, name in (("scan", "scan_turn"), ("foreground", "foreground"), ("background", "background")):
        for size in (64, 72):
            of = sample(topic, name, size)
            assert of.ranges.size <= (size - 32) // 2, (topic, size)
    for size, count in ((16, 0), (40, 1)):
        assert sample("cloud", "cloud", size).points.shape == (count, 3)
    for topic in ("scan", "foreground", "background", "cloud", "marks", "status"):
        try:
            sample(topic, topic, 8)
        except ValueError:
            continue
        raise AssertionError(f"{topic} has no head")


def copies_are_the_same() -> None:
    of = sample("scan", "scan")
    kept = of.copy()
    assert (kept.sensor, kept.missed, kept.restarted, kept.seq) == ("front", 5, True, 1)
    assert np.array_equal(kept.ranges, of.ranges) and kept.ranges.ctypes.data != of.ranges.ctypes.data


headers_say_what_they_are()
payloads_say_what_they_are()
a_payload_that_is_cut_short_has_fewer_beams()
copies_are_the_same()
