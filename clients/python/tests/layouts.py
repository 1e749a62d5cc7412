"""The structs against the golden layouts and bytes of `schema`: arguments are the directory with them."""

import ctypes
import sys
from pathlib import Path

import numpy as np

from scanhub import layout, model, processed, scan, status

GOLDEN = Path(sys.argv[1])


def golden(name: str) -> bytes:
    return bytes.fromhex((GOLDEN / f"{name}.hex").read_text())


class Chunk:
    """A sample outside of shared memory."""

    def __init__(self, name: str) -> None:
        self.header = layout.Header.from_buffer_copy(golden("header"))
        self._bytes = (ctypes.c_uint8 * len(golden(name))).from_buffer_copy(golden(name))

    def data(self):
        return self._bytes


def offsets_are_golden() -> None:
    said = []
    for line in (GOLDEN / "layouts.txt").read_text().splitlines():
        words = line.split()
        if line[0] != " ":
            struct = getattr(layout, words[0].split(".")[1])
            assert (struct.type_name(), ctypes.sizeof(struct), ctypes.alignment(struct)) == (
                words[0],
                int(words[1]),
                int(words[2]),
            ), line
            said.append((words[0], []))
        else:
            assert getattr(struct, words[0]).offset == int(words[1]), (struct, line)
            said[-1][1].append(words[0])
    assert len(said) == 12
    for name, fields in said:
        struct = getattr(layout, name.split(".")[1])
        assert [field[0] for field in struct._fields_] == fields, name


def headers_say_what_they_are() -> None:
    of = status.Status("front", Chunk("status"))
    assert (of.seq, of.topic_seq, of.stamp_ns, of.stamp_last_ns) == (1, 2, 3, 4)
    assert (of.wall_ns, of.boot) == (0x1122_3344_5566_7788, 0x99AA_BBCC_DDEE_FF00)
    assert (of.quality, of.reasons, of.period_us) == ("suspect", ("neighbour", "header_inside"), 26_640)
    assert of.flags == {"simulated"} and of.hub_time_ns == 256 * 0xFF02B2


def payloads_say_what_they_are() -> None:
    of = scan.Scan("front", Chunk("scan"))
    assert (of.count, of.unit_mm, of.range_bits, of.first_angle_deg, of.step_deg) == (401, 10, 13, -40.0, 0.25)
    assert (of.intensity_bits, list(of.upper[[0, 400]]), list(of.intensities[[0, 400]])) == (3, [7, 6], [7, 6])
    assert (of.ranges[0], of.ranges[400], of.ranges.shape) == (0x1234, 0x1FFF, (401,))
    assert of.codes == [(400, 0)] and np.isnan(of.ranges_m[400]) and of.ranges_m[0] == 46.6
    assert of.angles_rad[400] == np.deg2rad(60)

    of = processed.Marks("front", Chunk("marks"))
    assert (len(of.marks), of.available, of.overflow) == (64, False, True)
    assert of.marks[63] == (-0.002, 0x10203 / 10, 7, 0x405, 0x106, 0x108, True)

    of = processed.Zones("front", Chunk("zones"))
    assert (of.verdict, of.nearest_beam, of.nearest_mm, of.invalid_beams) == ("slow", 0x102, 0x30405, 0x106)
    assert of.provisional and of.zones == ((0, False, 0), (600, True, 0x107))

    of = processed.Foreground("front", Chunk("foreground"))
    assert (of.generation, of.count, of.unit_mm, of.left_out) == (0x10203, 401, 10, 255)
    assert (list(of.beams), list(of.ranges), len(of.segments)) == ([400], [0x1234], 64)
    assert of.segments[63] == (400, 0x105, 60, 70, -2, 8)

    of = model.Background("front", Chunk("background"))
    assert (of.generation, of.taught, of.count, of.unit_mm, of.frozen) == (0x10203, 0x104, 401, 10, True)
    assert list(of.ranges[[0, 1, 400]]) == [0x1234, 0, 0xFFFF]
    assert of.ranges_m[0] == 46.6 and np.isnan(of.ranges_m[1]) and np.isinf(of.ranges_m[400])
    shown = model.Shown("front", golden("background")[:814])
    assert np.array_equal(shown.ranges, of.ranges) and shown.generation == of.generation

    of = status.Status("front", Chunk("status"))
    assert (of.state, of.mode, of.unit_mm, of.baud, of.since_ns) == ("streaming", 1, 1, 500_000, 9)
    assert (of.hz, of.angle_deg, of.step_deg) == (37.538, 180, 0.5)
    assert (of.type, of.port, of.last_error) == ("LMS200-30106", "/dev/ttyUSB0", "none")
    assert of.pose == (0.5, -0.5, 2.0, True)
    named = {name: value for name, value in of.counters.items() if value}
    assert named == {"bytes_read": 3, "rejected_superseded": 4, "line_errors": 5}
    assert (of.damaged, of.lost_on_line) == (0.0, None)


def copies_are_the_same() -> None:
    of = scan.Scan("front", Chunk("scan"), 5, True)
    kept = of.copy()
    assert (kept.sensor, kept.missed, kept.restarted, kept.seq) == ("front", 5, True, 1)
    assert np.array_equal(kept.ranges, of.ranges) and kept.ranges.ctypes.data != of.ranges.ctypes.data


offsets_are_golden()
headers_say_what_they_are()
payloads_say_what_they_are()
copies_are_the_same()
