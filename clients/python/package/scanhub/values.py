"""Values that samples contain, and names of topics. They are named tuples, and the names of the fields contain the
units."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


class TopicName(NamedTuple):
    """Topic of a sensor. Its text is `SENSOR/TOPIC`."""

    sensor: str
    topic: str

    def __str__(self) -> str:
        return f"{self.sensor}/{self.topic}"


class Scans(NamedTuple):
    """Scans of a sensor. `ranges` has a row for each scan, in meters. A range is NaN for a beam without a reading, and
    after the last beam of a scan that has fewer beams than the longest scan. `stamps` are in ns, on the clock of
    `Scan.stamp_ns`. `angles` are in radians. If the angles are the same in all scans, there is one value for each beam,
    and otherwise a row for each scan."""

    ranges: NDArray[np.float64]
    stamps: NDArray[np.int64]
    angles: NDArray[np.float64]


class Mark(NamedTuple):
    """A reflector. An angle of 0 is ahead of the sensor. `peak` is the highest intensity of its beams, and `weight` the
    sum of the intensities. If `edge` is set, a part of the reflector may be outside of the scan."""

    angle_deg: float
    range_mm: float
    peak: int
    weight: int
    first_beam: int
    last_beam: int
    edge: bool


class Line(NamedTuple):
    """A straight surface and the positions of its ends: x ahead of the robot's center, y to the left. The normal form
    of the line is x cos alpha + y sin alpha = r; `r` and `alpha` have standard deviations. `points` is the number of
    readings from the first to the last beam."""

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
    """Intersection of two lines, with the indexes of these lines."""

    x_m: float
    y_m: float
    first_line: int
    second_line: int


class Step(NamedTuple):
    """Motion from one scan to the next, in the robot's frame at the first of these scans: ahead, to the left,
    counterclockwise."""

    dx_m: float
    dy_m: float
    dyaw_rad: float


class Place(NamedTuple):
    """Pose of the robot relative to its pose at the start: ahead, to the left, counterclockwise. The pose drifts,
    because it is the sum of all steps."""

    x_m: float
    y_m: float
    yaw_rad: float


class Zone(NamedTuple):
    """A circle around the robot's center, and the number of beams that end inside this circle."""

    radius_mm: int
    violated: bool
    beams: int


class Segment(NamedTuple):
    """Neighboring foreground beams; x ahead of the robot's center, y to the left. `support` is set if the segment has
    several beams, or if the foreground of the previous scan was near the segment."""

    first: int
    last: int
    nearest_mm: int
    width_mm: int
    x_mm: int
    y_mm: int
    support: bool


class Pose(NamedTuple):
    """Pose of a sensor: x ahead of the robot's center, y to the left, yaw counterclockwise from ahead."""

    x_m: float
    y_m: float
    yaw_rad: float
    upside_down: bool


class Track(NamedTuple):
    """A person over time. `state` is `tentative`, `confirmed`, `hidden` or `between_rooms`. Position and velocity are
    in the map of the site. `cov` is the covariance of the position: xx, xy and yy in m2. `room` is None outside of all
    rooms. `sensors` has the names of the sensors that see the person. `score` is the probability that the track is a
    person, from 0 to 1."""

    id: int
    state: str
    x_m: float
    y_m: float
    vx_m_s: float
    vy_m_s: float
    cov: tuple[float, float, float]
    room: str | None
    sensors: tuple[str, ...]
    age_s: float
    score: float


class Site(NamedTuple):
    """Pose of a sensor in the map, with yaw counterclockwise from x."""

    name: str
    x_m: float
    y_m: float
    yaw_rad: float
    upside_down: bool


class Obstacle(NamedTuple):
    """An object that `scanhub tilt` found in one sweep. `x_m`, `y_m` and `z_m` are the mean of its points in the
    robot's frame, and `low_m` and `high_m` are the lowest and highest coordinates of the points. `distance_m` is the
    horizontal distance of the nearest point from the robot's center. `foreground` is set if some points are in front of
    the background, and `near` if some points are in the space that must be free."""

    x_m: float
    y_m: float
    z_m: float
    low_m: tuple[float, float, float]
    high_m: tuple[float, float, float]
    distance_m: float
    points: int
    foreground: bool
    near: bool


@dataclass(frozen=True)
class Robot:
    """Verdict of a robot at one moment, as a copy.

    `verdict` is the worst verdict of all sensors. From worst to best, the verdicts are `stop`, `unknown`, `slow` and
    `clear`. It is `unknown` as long as there are no sensors. Treat `unknown` as `stop`. `worst` is the first sensor
    with this verdict. `nearest_mm` is the distance of the nearest point from the robot's center, and `nearest_sensor`
    the sensor that sees this point. `sensors` has the verdict of each sensor.
    """

    verdict: str = "unknown"
    worst: str | None = None
    nearest_mm: int | None = None
    nearest_sensor: str | None = None
    sensors: dict[str, str] = field(default_factory=dict)


CLASSES = ("unknown", "background", "foreground", "behind")
"""Classes of points compared with the background, in the order of the numbers in `Cloud.classes`."""
