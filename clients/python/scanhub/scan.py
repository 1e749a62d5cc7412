"""Telegrams and scans: what the sensor sent."""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import layout
from .sample import Sample, view


class Telegram(Sample):
    """What a scanner sent: of an LMS a telegram, replies too; of other families whole packets that arrived together."""

    topic = "telegram"
    struct = element = ctypes.c_uint8

    @property
    def family(self) -> str | None:
        """What the sensor speaks, such as `lms`; None if it is not known here."""
        return named_family(self._header.family)

    @property
    def data(self) -> NDArray[np.uint8]:
        """Its bytes, of an LMS STX to CRC: a view."""
        return np.frombuffer(memoryview(self._data).toreadonly(), np.uint8)

    @property
    def packets(self) -> int | None:
        """How many packets they are; None of an LMS, and where it is not known here."""
        length = _PACKET.get(self.family)
        return len(self.data) // length if length else None

    @property
    def address(self) -> int | None:
        """Of the sender, 80h added; None of other families than LMS."""
        return int(self.data[1]) if self.family == "lms" else None

    @property
    def length(self) -> int | None:
        """From command to status, as the telegram says; None of other families than LMS."""
        return int(self.data[2]) | int(self.data[3]) << 8 if self.family == "lms" else None

    @property
    def command(self) -> int | None:
        """What it is: B0h measured values; None of other families than LMS."""
        return int(self.data[4]) if self.family == "lms" else None


class Scan(Sample):
    """One turn of a scanner: beams in the order of their measuring. Angles are in radians: 0 is the sensor's own ahead,
    counter-clockwise positive seen from above."""

    topic = "scan"
    struct = layout.ScanHead
    element = layout.ScanWord

    @property
    def family(self) -> str | None:
        """What the sensor speaks, such as `lms`; None if it is not known here."""
        return named_family(self._fields.family)

    @property
    def count(self) -> int:
        """Beams: the same number in all scans of a sensor and its settings."""
        room = max(len(self._data) - _HEAD, 0) // _width(self._fields.contents | _RANGES)
        return min(self._fields.count, room)

    @property
    def unit_um(self) -> int:
        """Micrometres per device unit."""
        return self._fields.unit_um

    @property
    def first_angle(self) -> float:
        """Where beam 0 looks."""
        return self._fields.first_angle

    @property
    def step(self) -> float:
        """From one beam to the next; negative for a scanner that turns clockwise."""
        return self._fields.step

    @property
    def spacing(self) -> float:
        """Between two points that the sensor itself measures: not that of the grid that they are put on."""
        return self._fields.spacing

    @property
    def beam_time_ns(self) -> int:
        """Time from one beam to the next."""
        return self._fields.beam_time_ns

    @property
    def intensity_bits(self) -> int:
        """Bits of an intensity; 0: there are none."""
        return self._fields.intensity_bits

    @property
    def collapsed(self) -> int:
        """Points that found their beam taken by a nearer one."""
        return self._fields.collapsed

    @property
    def incomplete(self) -> bool:
        """Packets of the turn are missing: what was in them is not measured."""
        return bool(self._fields.flags & 1)

    @property
    def ranges_m(self) -> NDArray[np.float64]:
        """Metres, NaN where there is no reading, whatever the reason: computed, a copy."""
        return np.where(self.valid, self.ranges * (self.unit_um / 1e6), np.nan)

    @property
    def angles(self) -> NDArray[np.float64]:
        """Where each beam looks, exact where the sensor says so: computed, a copy."""
        grid, exact = self.first_angle + np.arange(self.count) * self.step, self.exact_angles
        return grid if exact is None else np.where(np.isnan(exact), grid, exact)

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Whether each beam has a reading: computed."""
        return self.ranges <= self._fields.valid_to

    @property
    def codes(self) -> list[tuple[int, str]]:
        """Beam and reason of all without a reading: `not_measured`, `no_return`, `beyond` the range limit, `too_near`,
        `too_bright`, `weak`, `overflow`, `error`."""
        ranges = self.ranges
        beams = np.flatnonzero(ranges > self._fields.valid_to)
        return [(int(beam), self._code(int(ranges[beam]))) for beam in beams]

    @property
    def times_ns(self) -> NDArray[np.int64]:
        """When each beam was measured, CLOCK_MONOTONIC: computed. Stamps are of bytes on the wire, which is later."""
        beams, fields = np.arange(self.count), self._fields
        turn = beams % max(fields.turns, 1)
        return self.stamp_ns + fields.first_beam_ns + beams * fields.beam_time_ns + turn * fields.turn_ns

    @property
    def ranges(self) -> NDArray[np.uint16]:
        """Device units with codes, which are no ranges: a view. `ranges_m` is what to calculate with."""
        return self._array("<u2", _ANGLES)

    @property
    def exact_angles(self) -> NDArray[np.float32] | None:
        """Of a scanner whose points fall where they like, NaN where nothing was measured: a view; None of all others."""
        return self._array("<f4", 0) if self._fields.contents & _ANGLES else None

    @property
    def intensities(self) -> NDArray[np.uint8] | NDArray[np.uint16] | None:
        """Of each beam, one or two bytes: a view; None if the sensor does not send them."""
        if not self._fields.intensity_bits:
            return None
        return self._array("<u2", _ANGLES | _RANGES) if self._fields.contents & _WIDE else self.upper

    @property
    def upper(self) -> NDArray[np.uint8] | None:
        """The byte beside each range, intensities or field bits: a view; None if the sensor does not send them."""
        return self._array("u1", _ANGLES | _RANGES | _WIDE) if self._fields.contents & _UPPER else None

    def _array(self, kind: str, before: int) -> NDArray[Any]:
        """The array behind those of `before`."""
        count = self.count
        offset = _HEAD + count * _width(before & (self._fields.contents | _RANGES))
        return view(self._data, kind, offset, count)

    def _code(self, value: int) -> str:
        if value != _NOT_MEASURED and self.family == "lms":
            return _OF_LMS.get(self._fields.no_return - value, "overflow")
        return _CODES[min(_NOT_MEASURED - value, len(_CODES) - 1)]


def named_family(number: int) -> str | None:
    return FAMILIES[number] if number < len(FAMILIES) else None


def _width(contents: int) -> int:
    """Bytes of a beam in these arrays."""
    return sum(size for bit, size in _SIZES.items() if contents & bit)


FAMILIES = ("lms", "ld", "rplidar")
"""By their numbers."""
_PACKET = {"ld": 47}
"""Bytes of a packet, of families that send packets."""
_HEAD = ctypes.sizeof(layout.ScanHead)
_UPPER, _WIDE, _ANGLES, _RANGES = 1, 2, 4, 0x80
_SIZES = {_UPPER: 1, _WIDE: 2, _ANGLES: 4, _RANGES: 2}
"""Arrays beside the ranges, which are always there, and the bytes of a beam in each."""
_NOT_MEASURED = 0xFFFF
_CODES = ("not_measured", "no_return", "beyond", "too_near", "too_bright", "weak", "overflow", "error")
"""From the greatest value down, in all families but the LMS."""
_OF_LMS = {0: "no_return", 1: "too_bright", 4: "weak", 5: "error", 8: "beyond"}
"""From the greatest value of its measuring mode down."""
