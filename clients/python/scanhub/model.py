"""The background of a sensor: the range of each beam when nobody is there."""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import layout
from .sample import Sample, view
from .scan import angles_rad


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
        return min(self._fields.count, layout.BEAMS)

    @property
    def unit_mm(self) -> int:
        """Millimetres per device unit."""
        return self._fields.unit_mm

    @property
    def frozen(self) -> bool:
        """Nothing is learned until it is thawed."""
        return bool(self._fields.flags & 1)

    @property
    def ranges(self) -> NDArray[np.uint16]:
        """Device units, 0 not known, 65535 beyond what the sensor measures: a view."""
        return view(self._data, layout.Background.range_array, "<u2", self.count)

    @property
    def ranges_m(self) -> NDArray[np.float64]:
        """Metres, NaN where it is not known, infinite beyond what the sensor measures: computed, a copy."""
        ranges = self.ranges
        metres = np.where(ranges == _UNTAUGHT, np.nan, ranges * (self.unit_mm / 1000))
        return np.where(ranges == _FAR, np.inf, metres)

    @property
    def first_angle_deg(self) -> float | None:
        """The angle of beam 0; None if no scan has this many beams."""
        return _VARIANTS[self.count][0] / 1000 if self.count in _VARIANTS else None

    @property
    def step_deg(self) -> float | None:
        """The angle between two beams; None if no scan has this many beams."""
        return _VARIANTS[self.count][1] / 1000 if self.count in _VARIANTS else None

    @property
    def angles_rad(self) -> NDArray[np.float64] | None:
        """The angle of each beam, as in a scan: computed; None if no scan has this many beams."""
        first_mdeg, step_mdeg = _VARIANTS.get(self.count, (0, 0))
        return angles_rad(first_mdeg, step_mdeg, self.count) if step_mdeg else None


class Background(Model, Sample):
    """A model as a sample of its topic."""

    topic = "background"
    struct = layout.Background


class Shown(Model):
    """A model as the hub answers it on request: in memory of its own."""

    def __init__(self, sensor: str, packed: bytes) -> None:
        self.sensor = sensor
        size = ctypes.sizeof(layout.Background)
        self._data = (ctypes.c_uint8 * size).from_buffer_copy(packed[:size].ljust(size, b"\0"))
        self._fields = layout.Background.from_buffer(self._data)

    def __repr__(self) -> str:
        return f"<background of {self.sensor}, generation {self.generation}: {self.taught} of {self.count} beams>"


_UNTAUGHT, _FAR = 0, 0xFFFF
_VARIANTS = {181: (0, 1000), 361: (0, 500), 101: (40_000, 1000), 201: (40_000, 500), 401: (40_000, 250)}
"""First angle and step of each variant of the sensor, in 1/1000 degree, by its beams."""
