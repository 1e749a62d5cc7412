"""The background of a sensor: the range of each beam when nobody is there."""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import layout
from .sample import Sample, in_mm, view


class Model:
    """The learned ranges, with beams, angles and unit of the scans that they were learned from."""

    sensor: str
    _data: Any
    _fields: Any

    @property
    def generation(self) -> int:
        """One more after each reset, load, and change of the scan's beams, angles or unit."""
        return self._fields.generation

    @property
    def taught(self) -> int:
        """Beams whose background is known."""
        return self._fields.taught

    @property
    def count(self) -> int:
        """Beams; 0 before the first scan."""
        return self.ranges.size

    @property
    def unit_mm(self) -> float:
        """Millimetres per device unit."""
        return in_mm(self._fields.unit_um)

    @property
    def frozen(self) -> bool:
        """Nothing is learned until it is thawed."""
        return bool(self._fields.flags & 1)

    @property
    def ranges(self) -> NDArray[np.uint16]:
        """Device units, 0 not known, 65535 beyond what the sensor measures: a view."""
        return view(self._data, "<u2", _HEAD, self._fields.count)

    @property
    def ranges_m(self) -> NDArray[np.float64]:
        """Metres, NaN where it is not known, infinite beyond what the sensor measures: computed, a copy."""
        ranges = self.ranges
        metres = np.where(ranges == _UNTAUGHT, np.nan, ranges * (self._fields.unit_um / 1e6))
        return np.where(ranges == _FAR, np.inf, metres)

    @property
    def first_angle(self) -> float | None:
        """Where beam 0 looks, radians, as in a scan; None before the first scan."""
        return self._fields.first_angle if self._fields.step else None

    @property
    def step(self) -> float | None:
        """From one beam to the next; None before the first scan."""
        return self._fields.step or None

    @property
    def angles(self) -> NDArray[np.float64] | None:
        """Where each beam looks: computed; None before the first scan."""
        step = self._fields.step
        return self._fields.first_angle + np.arange(self.count) * step if step else None


class Background(Model, Sample):
    """A model as a sample of its topic."""

    topic = "background"
    struct = layout.BackgroundHead
    element = layout.BackgroundWord


class Shown(Model):
    """A model as the hub answers it on request: in memory of its own."""

    def __init__(self, sensor: str, packed: bytes) -> None:
        self.sensor = sensor
        self._data = (ctypes.c_uint8 * max(len(packed), _HEAD)).from_buffer_copy(packed.ljust(_HEAD, b"\0"))
        self._fields = layout.BackgroundHead.from_buffer(self._data)

    def __repr__(self) -> str:
        return f"<background of {self.sensor}, generation {self.generation}: {self.taught} of {self.count} beams>"


_UNTAUGHT, _FAR = 0, 0xFFFF
_HEAD = ctypes.sizeof(layout.BackgroundHead)
