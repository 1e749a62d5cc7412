"""Values that samples contain, and names of topics: named tuples, each with the units in the names of its fields."""

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
    """Scans of a sensor, a row for each. `ranges` are meters, NaN without a reading, and after the last beam of a scan that has
    fewer beams than another. `stamps` are ns, by the clock of `Scan.stamp_ns`. `angles` are radians: a value for each beam if they
    are the same in all scans, otherwise a row for each scan, like `ranges`."""

    ranges: NDArray[np.float64]
    stamps: NDArray[np.int64]
    angles: NDArray[np.float64]


class Mark(NamedTuple):
    """A reflector: its position, where an angle of 0 is ahead of the sensor; the highest and the sum of its intensities; its
    beams. If `edge` is set, a part of it may be outside of the scan."""

    angle_deg: float
    range_mm: float
    peak: int
    weight: int
    first_beam: int
    last_beam: int
    edge: bool


class Line(NamedTuple):
    """A straight surface with its ends: x ahead of the robot's center, y to the left. The normal form is x cos alpha + y sin
    alpha = r, with standard deviations. `points` is the number of readings from the first to the last beam."""

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
    """Intersection of two lines, with their indexes."""

    x_m: float
    y_m: float
    first_line: int
    second_line: int


class Step(NamedTuple):
    """Motion from one scan to the next, in the robot's frame at the first of them: ahead, to the left, counterclockwise."""

    dx_m: float
    dy_m: float
    dyaw_rad: float


class Place(NamedTuple):
    """Pose of the robot since the start: ahead, to the left, counterclockwise. It drifts."""

    x_m: float
    y_m: float
    yaw_rad: float


class Zone(NamedTuple):
    """A circle around the robot's center, and the number of beams that end inside."""

    radius_mm: int
    violated: bool
    beams: int


class Segment(NamedTuple):
    """Neighboring foreground beams; x ahead of the robot's center, y to the left. It has `support` if it has several beams, or
    if the foreground of the previous scan was near it."""

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
    """A person over time. `state` is `tentative`, `confirmed`, `hidden` or `between_rooms`. Position and speed are in the map of
    the site. `cov` is the covariance of the position: xx, xy and yy in m2. `room` is None outside of all rooms. `sensors` see
    the person. `score` is the probability that it is a person, 0 to 1."""

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
    """An object that the hub's program `tilt` found in one sweep. `x_m`, `y_m` and `z_m` are the mean of its points in the robot's
    frame, `low_m` and `high_m` their minimum and maximum. `distance_m` is that of the nearest point from the robot's center
    over ground. Some points are in front of the background (`foreground`), or in the space that must be free (`near`)."""

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
    """Surroundings of the robot at one moment, by value.

    `verdict` is the worst of all sensors: `stop`, `unknown`, `slow`, `clear`; `unknown` as long as there are no sensors. Treat
    `unknown` as `stop`. `worst` is the first sensor with it, `nearest_mm` the distance of the nearest point from the robot's
    center, and `nearest_sensor` the sensor that sees this point. `sensors` has the verdict of each sensor.
    """

    verdict: str = "unknown"
    worst: str | None = None
    nearest_mm: int | None = None
    nearest_sensor: str | None = None
    sensors: dict[str, str] = field(default_factory=dict)


CLASSES = ("unknown", "background", "foreground", "behind")
"""Classes of points compared with the background, in the order of the numbers in `Cloud.classes`."""
