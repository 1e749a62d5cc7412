"""What the hub makes of a scan: marks, zones, foreground."""

from __future__ import annotations

import ctypes
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from . import layout
from .sample import Copied, Sample, view


class Mark(NamedTuple):
    """A reflector: the sum and the greatest of its intensities, its beams; `edge`: a part of it may be outside."""

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
    """Foreground beams that belong together; x ahead of the robot's centre, y to the left."""

    first: int
    last: int
    nearest_mm: int
    width_mm: int
    x_mm: int
    y_mm: int


class Foreground(Sample):
    """What stands in front of the background."""

    topic = "foreground"
    struct = layout.Foreground

    @property
    def generation(self) -> int:
        """Of the background that the scan was compared with."""
        return self._fields.generation

    @property
    def count(self) -> int:
        """Beams of the scan."""
        return min(self._fields.count, layout.BEAMS)

    @property
    def unit_mm(self) -> int:
        """Millimetres per device unit."""
        return self._fields.unit_mm

    @property
    def beams(self) -> NDArray[np.intp]:
        """The beams in the foreground: computed."""
        bits = np.unpackbits(view(self._data, layout.Foreground.bit_array, "u1", 51), bitorder="little")
        return np.flatnonzero(bits[: layout.BEAMS])

    @property
    def ranges(self) -> NDArray[np.uint16]:
        """Of these beams, in their order, device units: a view."""
        return view(self._data, layout.Foreground.range_array, "<u2", self._fields.beams)

    @property
    def segments(self) -> tuple[Segment, ...]:
        """In the order of their beams: copied."""
        unit = self._fields.unit_mm
        return tuple(
            Segment(s.first, s.last, s.nearest * unit, s.width * unit, s.x_mm, s.y_mm)
            for s in self._fields.segment_array[: self._fields.segments]
        )

    @property
    def left_out(self) -> int:
        """Segments that did not fit; 255: or more."""
        return self._fields.left_out


VERDICTS = ("clear", "slow", "stop", "unknown")
_NO_BEAM = 0xFFFF
