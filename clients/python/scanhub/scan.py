"""Telegrams and scans: what the sensor sent."""

from __future__ import annotations

import ctypes

import numpy as np
from numpy.typing import NDArray

from . import layout
from .sample import Sample, view


class Telegram(Sample):
    """A telegram, replies too."""

    topic = "telegram"
    struct = ctypes.c_uint8

    @property
    def data(self) -> NDArray[np.uint8]:
        """Its bytes, STX to CRC: a view."""
        return np.frombuffer(memoryview(self._data).toreadonly(), np.uint8)

    @property
    def address(self) -> int:
        """Of the sender, 80h added."""
        return int(self.data[1])

    @property
    def length(self) -> int:
        """From command to status, as the telegram says."""
        return int(self.data[2]) | int(self.data[3]) << 8

    @property
    def command(self) -> int:
        """What it is: B0h measured values."""
        return int(self.data[4])


class Scan(Sample):
    """Ranges as the sensor sent them. Beam i looks to `first_angle_deg + i * step_deg`, counter-clockwise seen from
    above, 0 right and 90 degrees ahead."""

    topic = "scan"
    struct = layout.Scan

    @property
    def count(self) -> int:
        """Beams, at most 401."""
        return min(self._fields.count, layout.BEAMS)

    @property
    def unit_mm(self) -> int:
        """Millimetres per device unit: 1, 10 or 100."""
        return self._fields.unit_mm

    @property
    def range_bits(self) -> int:
        """Bits of a range; its nine greatest values are codes."""
        return self._fields.range_bits

    @property
    def first_angle_deg(self) -> float:
        """Where beam 0 looks."""
        return self._fields.first_angle_mdeg / 1000

    @property
    def step_deg(self) -> float:
        """Between two beams."""
        return self._fields.step_mdeg / 1000

    @property
    def intensity_bits(self) -> int:
        """Bits of intensity among the upper ones; 0: they are field bits."""
        return self._fields.intensity_bits

    @property
    def ranges(self) -> NDArray[np.uint16]:
        """Device units with codes: a view."""
        return view(self._data, layout.Scan.range_array, "<u2", self._fields.count)

    @property
    def upper(self) -> NDArray[np.uint8]:
        """The bits above each range: a view; empty if the mode does not send them."""
        return view(self._data, layout.Scan.upper_array, "u1", self._fields.count if self._fields.contents & 1 else 0)

    @property
    def intensities(self) -> NDArray[np.uint8]:
        """Of each beam: a view; empty if the mode has no reflector bits."""
        upper = self.upper
        return upper if self._fields.intensity_bits else upper[:0]

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Whether each beam has a reading: computed."""
        return self.ranges < self._first_code

    @property
    def codes(self) -> list[tuple[int, int]]:
        """Beam and code of all without a reading: 0 nothing came back, 1 dazzled, 2 overflow, 8 beyond the range."""
        ranges = self.ranges
        beams = np.flatnonzero(ranges >= self._first_code)
        greatest = self._first_code + 8
        # What is beyond all codes overflowed.
        return [(int(beam), 2 if ranges[beam] > greatest else greatest - int(ranges[beam])) for beam in beams]

    @property
    def ranges_m(self) -> NDArray[np.float64]:
        """Metres, NaN where there is no reading: computed, a copy."""
        return np.where(self.valid, self.ranges * (self.unit_mm / 1000), np.nan)

    @property
    def angles_rad(self) -> NDArray[np.float64]:
        """Where each beam looks: computed."""
        return angles_rad(self._fields.first_angle_mdeg, self._fields.step_mdeg, self.count)

    @property
    def beam_times_ns(self) -> NDArray[np.int64]:
        """When each beam was measured, CLOCK_MONOTONIC: computed. Stamps are of bytes on the wire, which is later."""
        beams, step = np.arange(self.count), self._fields.step_mdeg
        turns = max(1000 // max(step, 1), 1)
        later = (turns - 1 - beams % turns) * _TURN_NS
        return self.stamp_ns - later - (self.count - 1 - beams) * step * _TURN_NS // 360_000

    @property
    def _first_code(self) -> int:
        return (1 << min(self._fields.range_bits, 16)) - 9


def angles_rad(first_mdeg: int, step_mdeg: int, count: int) -> NDArray[np.float64]:
    """Where `count` beams look that begin at `first_mdeg`, both in 1/1000 degree."""
    return np.deg2rad((first_mdeg + np.arange(count) * step_mdeg) / 1000)


_TURN_NS = 13_320_000
"""One turn of the mirror."""
