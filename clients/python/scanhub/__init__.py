"""What a scanhub publishes, for programs in Python: samples in shared memory, without a copy.

    import scanhub

    for scan in scanhub.subscribe("front/scan"):
        print(scan.seq, scan.ranges_m[180])

`scan.ranges_m` has metres, NaN where there is no reading; `scan.ranges` is a numpy view of the hub's memory that cannot be
written, in device units and with codes. A hub that is not there is waited for, one that restarts too. `scanhub.robot()`
follows the verdict over all sensors, `scanhub.publish("mount/tilt")` publishes the angles of a mount. docs/python.md has the
rest.
"""

from __future__ import annotations

import os
from typing import Callable

from . import memory
from .control import background, control
from .errors import Denied, Failure, Held, Impossible, Mismatch, NoHub, NoTopic, Refused, Short, Silent, Taken
from .lock import is_held
from .model import Background, Shown
from .names import Domain, TopicName, candidates, check_sensor, home, is_remote, parse
from .people import Event, Site, Track, Tracks
from .presence import find
from .processed import Corner, Early, Foreground, Line, Lines, Mark, Marks, Motion, Segment, Zone, Zones
from .publication import Publication
from .sample import Sample
from .scan import Scan, Telegram
from .status import Pose, Status
from .subscription import Subscription
from .tilted import Cloud, Obstacle, Obstacles, Tilt
from .verdict import Robot, RobotFollower

__version__ = "0.1.0"

__all__ = [
    "Background",
    "Cloud",
    "Corner",
    "Denied",
    "Early",
    "Event",
    "Failure",
    "Foreground",
    "Held",
    "Impossible",
    "Line",
    "Lines",
    "Mark",
    "Marks",
    "Mismatch",
    "Motion",
    "NoHub",
    "NoTopic",
    "Obstacle",
    "Obstacles",
    "Pose",
    "Publication",
    "Refused",
    "Robot",
    "RobotFollower",
    "Sample",
    "Scan",
    "Segment",
    "Short",
    "Shown",
    "Silent",
    "Site",
    "Status",
    "Subscription",
    "Taken",
    "Telegram",
    "Tilt",
    "TopicName",
    "Track",
    "Tracks",
    "Zone",
    "Zones",
    "background",
    "control",
    "publish",
    "robot",
    "sensors",
    "subscribe",
    "topics",
]


def subscribe(
    *topics: str,
    domain: str | None = None,
    root: str | os.PathLike[str] | None = None,
    timeout: float | None = None,
    on_notice: Callable[[str], object] | None = None,
) -> Subscription:
    """Follows `topics`, each `SENSOR/TOPIC` as in `front/scan`, in `domain` (None: the value of SCANHUB_DOMAIN, else
    `scanhub`), which is looked for below the directory `root` (None: in all places where a hub may put it).

    Iterate over the result; the iteration does not end. With `timeout`, a silence of that many seconds raises NoHub or
    Silent.
    `on_notice` is called with `hub_gone` and `hub_back`. Raises NoTopic or Impossible at once if a name is invalid.
    """
    if not topics:
        raise NoTopic("no topic is named", "write SENSOR/TOPIC, as front/scan")
    return Subscription([parse(topic) for topic in topics], candidates(domain, root), timeout, on_notice)


def robot(
    *sensors: str, domain: str | None = None, root: str | os.PathLike[str] | None = None, early: bool = False
) -> RobotFollower:
    """Follows the verdict over the zones of `sensors`. Without names: all sensors of the hub; in a domain without a hub
    the sensors of other machines that are published there. With `early` it becomes worse before a scan (a telegram or a
    turn) is complete, and goes back if the warning is withdrawn.

    Iterate over the result, which does not end, or call `now()` in a loop of your own. The verdict becomes `unknown` by
    itself when no recent data arrived, with a hub or without one. Raises Impossible at once if a name is invalid.
    """
    for sensor in sensors:
        check_sensor(sensor)
    return RobotFollower(list(sensors), candidates(domain, root), early)


def publish(
    topic: str, *, domain: str | None = None, root: str | os.PathLike[str] | None = None
) -> Publication:
    """Publishes the angles of a mount as `topic`, `NAME/tilt` as in `mount/tilt`, in the first live place of `domain`, or
    where a hub would be: there need not be one. The name has no dot, and no sensor of the hub has it.

    Raises Taken if another process publishes as NAME, a program or the hub; Impossible if the name or the topic is
    invalid; Denied, Short, Mismatch, Failure as they say.
    """
    name = parse(topic)
    if name.topic != Tilt.topic:
        raise Impossible(f"Python does not publish {name.topic}", f"{Tilt.topic}, as in mount/tilt; Rust publishes all")
    if is_remote(name.sensor):
        raise Impossible(f"{name.sensor} is no name of a mount", "one without a dot, for example mount")
    live = next((place for place in candidates(domain, root) if _lives(place)), None)
    return Publication(name, live or home(domain, root))


def _lives(place: Domain) -> bool:
    """One that cannot be looked at counts as none, as in Rust."""
    try:
        return is_held(place)
    except (Denied, OSError):
        return False


def topics(*, domain: str | None = None, root: str | os.PathLike[str] | None = None) -> list[TopicName]:
    """The topics of the running hub, sorted. Raises NoHub after half a second."""
    return memory.topics(find(candidates(domain, root)))


def sensors(*, domain: str | None = None, root: str | os.PathLike[str] | None = None) -> list[str]:
    """The sensors of the running hub, sorted. Raises NoHub after half a second."""
    return sorted({topic.sensor for topic in topics(domain=domain, root=root)})
