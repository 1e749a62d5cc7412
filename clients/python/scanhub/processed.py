"""What the hub makes of a scan: marks, lines, motion, early warnings, zones, foreground."""

from __future__ import annotations

import ctypes
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from . import layout
from .sample import Copied, Sample, in_mm, view


class Mark(NamedTuple):
    """A reflector: where it is, as angles of a scan are (0 ahead), the sum and the greatest of its intensities, its beams;
    `edge`: a part of it may be outside."""

    angle_deg: float
    range_mm: float
    peak: int
    weight: int
    first_beam: int
    last_beam: int
    edge: bool


class Marks(Sample):
    """The reflectors of a scan."""

    topic = "marks"
    struct = layout.Marks

    @property
    def available(self) -> bool:
        """The sensor's mode tells; without it an empty list says nothing."""
        return not self._fields.flags & 2

    @property
    def overflow(self) -> bool:
        """There were more than fit."""
        return bool(self._fields.flags & 1)

    @property
    def marks(self) -> tuple[Mark, ...]:
        """In the order of their beams: copied."""
        return tuple(
            Mark(m.angle_mdeg / 1000, m.range_dmm / 10, m.peak, m.weight, m.first_beam, m.last_beam, bool(m.edge))
            for m in self._fields.mark_array[: self._fields.count]
        )


class Line(NamedTuple):
    """A straight surface: both ends, x ahead of the robot's centre and y to the left; its normal form x cos alpha + y sin
    alpha = r with standard deviations; its first and last beam, and how many of them have a range."""

    x1_m: float
    y1_m: float
    x2_m: float
    y2_m: float
    r_m: float
    alpha_rad: float
    sd_r_m: float
    sd_alpha_rad: float
    first: int
    last: int
    points: int


class Corner(NamedTuple):
    """Where two lines meet, and their numbers."""

    x_m: float
    y_m: float
    first_line: int
    second_line: int


class Lines(Sample):
    """The straight lines of a scan, in the robot's frame."""

    topic = "lines"
    struct = layout.Lines

    @property
    def overflow(self) -> bool:
        """There are more than are allowed."""
        return bool(self._fields.flags & 1)

    @property
    def readings(self) -> int:
        """Beams of the scan that have a range."""
        return self._fields.readings

    @property
    def on_lines(self) -> int:
        """Of them those that end on a line."""
        return self._fields.on_lines

    @property
    def noise_m(self) -> float:
        """Standard deviation of the ranges in this scan, as its own beams tell it."""
        return self._fields.noise_m

    @property
    def lines(self) -> tuple[Line, ...]:
        """In the order of their beams: copied."""
        return tuple(
            Line(*(getattr(line, name) for name in Line._fields))
            for line in self._fields.line_array[: self._fields.count]
        )

    @property
    def corners(self) -> tuple[Corner, ...]:
        """Where lines meet: copied."""
        return tuple(
            Corner(c.x_m, c.y_m, c.first_line, c.second_line)
            for c in self._fields.corner_array[: self._fields.corners]
        )


class Step(NamedTuple):
    """From one scan to the next, in the robot's frame at the first of them: ahead, to the left, counter-clockwise."""

    dx_m: float
    dy_m: float
    dyaw_rad: float


class Place(NamedTuple):
    """Where the robot is since the start: ahead, to the left, counter-clockwise."""

    x_m: float
    y_m: float
    yaw_rad: float


class Motion(Sample):
    """How the robot moved since the scan before."""

    topic = "motion"
    struct = layout.Motion

    @property
    def method(self) -> str:
        """How that was found: `first` (there is no scan before), `refused` (no step explains the scan), `beams`, `points`,
        `lines` or `both`."""
        return METHODS[self._fields.method] if self._fields.method < len(METHODS) else "refused"

    @property
    def step(self) -> Step | None:
        """The step: copied; None where there is none."""
        f = self._fields
        return None if self.method in ("first", "refused") else Step(f.dx_m, f.dy_m, f.dyaw_rad)

    @property
    def covariance(self) -> NDArray[np.float32] | None:
        """Of the step, 3 x 3: copied."""
        if self.step is None:
            return None
        return np.array(self._fields.covariance, dtype=np.float32).reshape(3, 3)

    @property
    def overlap(self) -> float | None:
        """Share of the readings that lie on the scan before."""
        return None if self.step is None else self._fields.overlap

    @property
    def place(self) -> Place | None:
        """The sum of all steps: copied; None where it is not known. It drifts."""
        f = self._fields
        return None if self.method == "refused" else Place(f.x_m, f.y_m, f.yaw_rad)

    @property
    def pose_covariance(self) -> NDArray[np.float32] | None:
        """Covariance of `place`, 3 x 3: copied; None if `place` is not valid, or if the sender is older and has none."""
        covariance = np.array(self._fields.pose_covariance, dtype=np.float32).reshape(3, 3)
        return covariance if self.valid and (self.method == "first" or covariance.any()) else None

    @property
    def valid(self) -> bool:
        """Whether `place` is known, and no step that it contains was degenerate."""
        return self.method != "refused" and not self._fields.flags & 2

    @property
    def degenerate(self) -> bool:
        """The surroundings leave a direction open, as a corridor does."""
        return bool(self._fields.flags & 1)

    @property
    def breaks(self) -> int:
        """Steps that were refused since the start."""
        return self._fields.breaks


class Early(Sample):
    """A warning by a scan that was not complete, a telegram or a turn. The first zones with its number or a greater one
    confirm it, or it is withdrawn."""

    topic = "early"
    struct = layout.Early

    @property
    def verdict(self) -> str:
        """`slow` or `stop`."""
        return VERDICTS[min(self._fields.verdict, 3)]

    @property
    def withdrawn(self) -> bool:
        """What was said under this number does not hold."""
        return bool(self._fields.flags & 1)

    @property
    def beam(self) -> int:
        """The beam of the nearest point so far."""
        return self._fields.beam

    @property
    def distance_mm(self) -> int:
        """That point's distance from the robot's centre."""
        return self._fields.distance_mm

    @property
    def bytes_seen(self) -> int:
        """Bytes of the telegram that had arrived; 0 of a turn."""
        return self._fields.bytes_seen

    @property
    def beams_seen(self) -> int:
        """Beams of the scan that had arrived."""
        return self._fields.beams_seen


class Zone(NamedTuple):
    """A circle around the robot's centre, and how many beams met something inside."""

    radius_mm: int
    violated: bool
    beams: int


class Zones(Sample):
    """What is near the robot, by one sensor.

    `stale`: nothing was heard that is new enough, be it that sensor, hub or machine stood still. Then nothing is known,
    and the numbers and stamps are those of the last sample, 0 before the first.
    """

    topic = "zones"
    struct = layout.Zones
    stale = False
    silent = False
    """Stale, because no sample came at all, and not because one was too old when it came."""

    def unknown(self) -> Zones:
        """The same as a silence: nothing is known."""
        return nothing(self.sensor, self._header, self.missed, self.restarted)

    @property
    def verdict(self) -> str:
        """`clear`, `slow`, `stop` or `unknown`, which is to be taken as `stop`."""
        return VERDICTS[min(self._fields.verdict, 3)]

    @property
    def nearest_beam(self) -> int | None:
        """The beam whose point is nearest to the robot's centre."""
        return None if self._fields.nearest_beam == _NO_BEAM else self._fields.nearest_beam

    @property
    def nearest_mm(self) -> int | None:
        """That point's distance from the centre."""
        return None if self._fields.nearest_beam == _NO_BEAM else self._fields.nearest_mm

    @property
    def zones(self) -> tuple[Zone, ...]:
        """The circles, the largest first: copied."""
        return tuple(Zone(z.radius_mm, z.violated == 1, z.beams) for z in self._fields.zone_array[: self._fields.count])

    @property
    def invalid_beams(self) -> int:
        """Beams that see into the largest circle, without a reading."""
        return self._fields.invalid_beams

    @property
    def provisional(self) -> bool:
        """Fewer scans were seen than a violation takes."""
        return bool(self._fields.flags & 1)


def nothing(sensor: str, header: layout.Header, missed: int = 0, restarted: bool = False) -> Zones:
    """Nothing was heard since the sample with `header`."""
    fields = layout.Zones(verdict=3, nearest_beam=_NO_BEAM, nearest_mm=0xFFFFFFFF)
    data = (ctypes.c_uint8 * ctypes.sizeof(fields)).from_buffer_copy(fields)
    zones = Zones(sensor, Copied(header, data), missed, restarted)
    zones.stale = True
    return zones


class Segment(NamedTuple):
    """Foreground beams that belong together; x ahead of the robot's centre, y to the left. It has `support` if it has
    several beams, or the foreground of the scan before was near it."""

    first: int
    last: int
    nearest_mm: int
    width_mm: int
    x_mm: int
    y_mm: int
    support: bool


class Foreground(Sample):
    """What stands in front of the background."""

    topic = "foreground"
    struct = layout.ForegroundHead
    element = layout.ForegroundWord

    @property
    def generation(self) -> int:
        """Of the background that the scan was compared with."""
        return self._fields.generation

    @property
    def count(self) -> int:
        """Beams of the scan."""
        count = self._fields.count
        return count if _BITS + 2 * (-(-count // 16)) + 2 * count <= len(self._data) else 0

    @property
    def unit_mm(self) -> float:
        """Millimetres per device unit."""
        return in_mm(self._fields.unit_um)

    @property
    def beams(self) -> NDArray[np.intp]:
        """The beams in the foreground: computed."""
        count = self.count
        bits = np.unpackbits(view(self._data, "u1", _BITS, -(-count // 8)), bitorder="little")
        return np.flatnonzero(bits[:count])

    @property
    def ranges(self) -> NDArray[np.uint16]:
        """Of these beams, in their order, device units: a view."""
        count = self.count
        return view(self._data, "<u2", _BITS + 2 * (-(-count // 16)), min(self._fields.beams, count))

    @property
    def segments(self) -> tuple[Segment, ...]:
        """In the order of their beams: copied."""
        unit_um, supported = self._fields.unit_um, self._fields.supported
        places = (layout.Segment * 64).from_buffer(self._data, _HEAD) if len(self._data) >= _BITS else ()
        return tuple(
            Segment(
                s.first,
                s.last,
                s.nearest * unit_um // 1000,
                s.width * unit_um // 1000,
                s.x_mm,
                s.y_mm,
                bool(supported >> i & 1),
            )
            for i, s in enumerate(places[: self._fields.segments])
        )

    @property
    def left_out(self) -> int:
        """Segments that did not fit."""
        return self._fields.left_out


METHODS = ("first", "refused", "beams", "points", "lines", "both")
VERDICTS = ("clear", "slow", "stop", "unknown")
_NO_BEAM = 0xFFFF
_HEAD = ctypes.sizeof(layout.ForegroundHead)
_BITS = _HEAD + ctypes.sizeof(layout.Segment * 64)
"""Where the bits of the beams begin."""
