"""Mounts, and what is seen in three dimensions from them: angles, points, obstacles."""

from __future__ import annotations

import ctypes
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from . import layout
from .sample import Sample, view

CLASSES = ("unknown", "background", "foreground", "behind")
"""What a point is beside the background, in the order of the numbers in `Cloud.classes`."""


class Tilt(Sample):
    """The angle of a mount at `stamp_ns`."""

    topic = "tilt"
    struct = layout.Tilt

    @property
    def angle_rad(self) -> float:
        """Right-handed around the mount's axis."""
        return self._fields.angle_rad

    @property
    def rate_rad_s(self) -> float | None:
        """How fast it grows; None: not known."""
        rate = self._fields.rate_rad_s
        return rate if math.isfinite(rate) else None


class _Swept(Sample):
    """What is made of a sweep: the way of a mount from turn to turn."""

    @property
    def sweep(self) -> int:
        """Number of the sweep, from 0."""
        return self._fields.sweep

    @property
    def generation(self) -> int:
        """Number of the background: one more each time that it was forgotten."""
        return self._fields.generation

    @property
    def complete(self) -> bool:
        """The sweep went from one turn to the next, and no angle was missing."""
        return bool(self._fields.flags & 4)

    @property
    def doubted(self) -> bool:
        """Its angles contradict the background: nothing is known of what stands there."""
        return bool(self._fields.flags & 8)


class Cloud(_Swept):
    """The points of one scan. The samples of a sweep come one behind the other, from `first` to `last`."""

    topic = "cloud"
    struct = layout.CloudHead
    element = layout.CloudWord

    @property
    def first(self) -> bool:
        """The first sample of its sweep."""
        return bool(self._fields.flags & 1)

    @property
    def last(self) -> bool:
        """The last sample of its sweep."""
        return bool(self._fields.flags & 2)

    @property
    def count(self) -> int:
        """Points."""
        return self._points.size

    @property
    def points(self) -> NDArray[np.float32]:
        """A row for each: x, y, z in the robot's frame, metres ahead, to the left, above the floor: a view."""
        return self._points["at"]

    @property
    def beams(self) -> NDArray[np.uint16]:
        """Of each the number of its beam in the scan: a view."""
        return self._points["beam"]

    @property
    def classes(self) -> NDArray[np.uint8]:
        """Of each what it is beside the background: its number in `CLASSES`, greater ones are `unknown`: a view."""
        return self._points["class"]

    @property
    def _points(self) -> NDArray[np.void]:
        return view(self._data, _POINT, ctypes.sizeof(layout.CloudHead), self._fields.count)


class Obstacle(NamedTuple):
    """The mean of its points in the robot's frame; their least and greatest coordinates; how far the nearest one is from the
    robot's centre over ground; how many there are; whether some are before the background, or in the space that is to be
    free."""

    x_m: float
    y_m: float
    z_m: float
    low_m: tuple[float, float, float]
    high_m: tuple[float, float, float]
    distance_m: float
    points: int
    foreground: bool
    near: bool


class Obstacles(_Swept):
    """What one sweep has found. If it is `doubted`, nothing is known of what stands there."""

    topic = "obstacles"
    struct = layout.Obstacles

    @property
    def left_out(self) -> int:
        """Obstacles that did not fit."""
        return self._fields.left_out

    @property
    def obstacles(self) -> tuple[Obstacle, ...]:
        """The nearest first: copied."""
        fields = self._fields

        def obstacle(of: layout.Obstacle) -> Obstacle:
            low, high = tuple(of.low), tuple(of.high)
            flags = bool(of.flags & 1), bool(of.flags & 2)
            return Obstacle(*of.middle, low, high, of.distance_m, of.points, *flags)

        return tuple(obstacle(of) for of in fields.obstacle_array[: fields.count])


_POINT = np.dtype([("at", "<f4", 3), ("beam", "<u2"), ("class", "u1"), ("reserved", "u1")])
