"""Client library for a hub on this machine: reads samples from shared memory, without a copy.

    import scanhub

    for scan in scanhub.subscribe("front/scan"):
        print(scan.seq, scan.ranges_m[180])

`scan.ranges_m` has the ranges in meters, NaN for a beam without a reading. `scan.ranges` is a read-only numpy view of
the hub's memory, in device units and with codes. A subscription waits for a hub that does not run yet, and continues
after a restart of the hub. `scanhub.robot()` returns the verdicts of all sensors, `scanhub.publish("mount/tilt")`
publishes the angles of a mount, and `scanhub.read("walk.mcap")` reads a recording. docs/python.md describes the
package.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import warnings
import weakref
from typing import Any, Callable, Iterable, Tuple, Union

from . import _scanhub
from ._scanhub import (
    Background,
    Cloud,
    Early,
    Event,
    Foreground,
    Lines,
    Marks,
    Motion,
    Obstacles,
    Publication,
    Recording,
    Sample,
    Scan,
    Status,
    Telegram,
    Tilt,
    Tracks,
    Zones,
    __commit__ as __commit__,
    __version__ as __version__,
)
from .errors import (
    Denied,
    Failure,
    Held,
    Impossible,
    Mismatch,
    NoHub,
    NoTopic,
    RecordingWarning,
    Refused,
    Short,
    SilenceWarning,
    Silent,
    Taken,
    Unreadable,
)
from .values import (
    CLASSES,
    Corner,
    Line,
    Mark,
    Obstacle,
    Place,
    Pose,
    Robot,
    Scans,
    Segment,
    Site,
    Step,
    TopicName,
    Track,
    Zone,
)

__all__ = [
    "CLASSES",
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
    "Place",
    "Pose",
    "Publication",
    "Recording",
    "RecordingWarning",
    "Refused",
    "Robot",
    "RobotSubscriber",
    "Sample",
    "Scan",
    "Scans",
    "Segment",
    "Short",
    "Shown",
    "SilenceWarning",
    "Silent",
    "Site",
    "Status",
    "Step",
    "Subscriber",
    "Taken",
    "Telegram",
    "Tilt",
    "TopicName",
    "Track",
    "Tracks",
    "Unreadable",
    "Zone",
    "Zones",
    "background",
    "control",
    "publish",
    "read",
    "robot",
    "sensors",
    "subscribe",
    "topics",
]

def _release_names() -> None:
    """Closes the locks of names under which the parent process publishes. If the child kept these locks open, the names
    would stay taken while the child runs, even if the parent is killed."""
    for descriptor in os.listdir("/proc/self/fd"):
        with contextlib.suppress(OSError):
            _, name = os.path.split(os.readlink(f"/proc/self/fd/{descriptor}"))
            if name.startswith("name.") and name.endswith(".lock"):
                os.close(int(descriptor))


os.register_at_fork(after_in_child=_release_names)

Shown = Background
"""A background model that the hub sends on request."""


async def _next(subscriber: _scanhub.Subscriber | _scanhub.RobotSubscriber) -> Any:
    """Waits for the next item. A canceled task loses no item, because there is no await between receiving an item and
    returning it."""
    loop = asyncio.get_running_loop()
    if subscriber in _waiting:
        raise Failure("another task waits for this object", "make one for each task")
    until = None if subscriber._timeout is None else loop.time() + subscriber._timeout
    while subscriber._is_open:
        descriptor = subscriber._descriptor()
        item = subscriber._poll()
        if item is not None:
            return item
        if until is not None and loop.time() >= until:
            raise subscriber._silence()
        # Without a hub, the descriptor may never become readable. So the wait also ends when the warning about a
        # silence after the start is due.
        due = subscriber._warning_due
        ends = [end for end in (until, None if due is None else loop.time() + due) if end is not None]
        await _readable(subscriber, loop, descriptor, min(ends, default=None))
    raise StopAsyncIteration


_Subscriber = Union[_scanhub.Subscriber, _scanhub.RobotSubscriber]
_Waiting = Tuple[asyncio.AbstractEventLoop, int, Callable[[], None]]
_waiting: weakref.WeakKeyDictionary[_Subscriber, _Waiting] = weakref.WeakKeyDictionary()
"""For each object for which a task waits: the loop of the task, the descriptor that this loop polls, and the function
that ends the wait."""


async def _readable(
    subscriber: _Subscriber, loop: asyncio.AbstractEventLoop, descriptor: int, until: float | None
) -> None:
    ready = loop.create_future()

    def wake() -> None:
        if not ready.done():
            ready.set_result(None)

    _waiting[subscriber] = (loop, descriptor, wake)
    loop.add_reader(descriptor, wake)
    timer = None if until is None else loop.call_at(until, wake)
    try:
        await ready
    finally:
        _end_wait(subscriber)
        if timer is not None:
            timer.cancel()


def _end_wait(subscriber: _Subscriber) -> None:
    """Ends the wait of the task for `subscriber`. Must run in the thread of the task's loop."""
    waiting = _waiting.pop(subscriber, None)
    if waiting is not None:
        loop, descriptor, wake = waiting
        loop.remove_reader(descriptor)
        wake()


def _close(subscriber: _Subscriber, close: Callable[[], None]) -> None:
    """Calls `close` after the descriptor of `subscriber` is removed from the loop of the waiting task. Only the thread
    of the loop may remove it: if another thread closes the object, the thread of the loop calls `close` later."""
    waiting = _waiting.get(subscriber)
    if waiting is not None:
        try:
            is_in_loop = asyncio.get_running_loop() is waiting[0]
        except RuntimeError:
            is_in_loop = False
        if not is_in_loop and not waiting[0].is_closed():
            waiting[0].call_soon_threadsafe(_close, subscriber, close)
            return
        _end_wait(subscriber)
    close()


class Subscriber(_scanhub.Subscriber):
    """Subscription to topics, made by `scanhub.subscribe`. Iterate over its samples with `for` or with `async for`. The
    iteration ends only if the subscription is closed."""

    def __aiter__(self) -> Subscriber:
        return self

    async def __anext__(self) -> Any:
        return await _next(self)

    def close(self) -> None:
        """Leaves the domain. Samples that the program keeps stay readable."""
        _close(self, super().close)

    def __enter__(self) -> Subscriber:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class RobotSubscriber(_scanhub.RobotSubscriber):
    """Subscription to the verdict of a robot, made by `scanhub.robot`. Iterate over the verdicts with `for` or with
    `async for`. The iteration ends only if the subscription is closed."""

    def __aiter__(self) -> RobotSubscriber:
        return self

    async def __anext__(self) -> Robot:
        verdict: Robot = await _next(self)
        return verdict

    def close(self) -> None:
        """Leaves the domain."""
        _close(self, super().close)

    def __enter__(self) -> RobotSubscriber:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def subscribe(
    *topics: str,
    domain: str | None = None,
    root: str | os.PathLike[str] | None = None,
    timeout: float | None = None,
    on_notice: Callable[[str], object] | None = None,
) -> Subscriber:
    """Subscribes to `topics`, each in the form `SENSOR/TOPIC`, such as `front/scan`. The hub's domain is `domain`
    (None: the value of SCANHUB_DOMAIN, or `scanhub`), below the directory `root` (None: all locations in which a hub
    may be).

    Iterate over the result. With `timeout`, a silence of this number of seconds raises NoHub or Silent. `on_notice` is
    called with `hub_gone` when the hub ends, and with `hub_back` when a hub runs again. Raises NoTopic or Impossible if
    a name is invalid.
    """
    return Subscriber(topics, domain, root, timeout, on_notice)


def robot(
    *sensors: str, domain: str | None = None, root: str | os.PathLike[str] | None = None, early: bool = False
) -> RobotSubscriber:
    """Subscribes to the verdict over the zones of `sensors`. Without names, it is the verdict over all sensors of the
    hub, or, in a domain without a hub, over all remote sensors that are published there. With `early`, an early warning
    makes the verdict worse before a scan is complete, and a withdrawn warning makes it better again.

    Iterate over the result, or call `now()` in a loop of your own. The verdict becomes `unknown` if no recent data
    arrives. Raises Impossible if a name is invalid.
    """
    return RobotSubscriber(sensors, domain, root, early)


def publish(
    topic: str, *, domain: str | None = None, root: str | os.PathLike[str] | None = None
) -> Publication:
    """Publishes the angles of a mount as `topic`, which has the form `NAME/tilt`, such as `mount/tilt`. NAME must not
    contain a dot. No hub is needed.

    Raises Taken if another process (a program or the hub) publishes under NAME, and Impossible if the name or the topic
    is invalid. May also raise Denied, Short, Mismatch or Failure.
    """
    return Publication(topic, domain, root)


def read(
    file: str | os.PathLike[str],
    *,
    topics: str | Iterable[str] = "scan",
    sensor: str | None = None,
    config: str | os.PathLike[str] | None = None,
    family: str | None = None,
    set: str | Iterable[str] = (),
    system_config: bool = True,
) -> Recording:
    """Reads `topics` of a recording: an MCAP file, a CARMEN log or a stream of telegrams. No hub is needed. The samples
    are the same as those of `scanhub replay --rate max`, with the settings in the file `config` and the settings in
    `set`, such as `set=["link.front.mode=1"]`. With `system_config=False`, the files in /etc/scanhub are not read.

    Iterate over the result, or call its `to_numpy()`. `sensor` selects one of several sensors, or names the sensor of a
    recording without names. `family` is the family of the scanner that sent a stream (None: recognized by the bytes).
    Warns with RecordingWarning if data is missing in the file. Raises Unreadable, NoTopic, or, for a wrong
    configuration, Impossible. If the file became shorter in the meantime, the iteration raises Unreadable at its end.
    """
    names = (topics,) if isinstance(topics, str) else tuple(topics)
    settings = (set,) if isinstance(set, str) else tuple(set)
    recording = Recording(file, names, sensor, config, family, settings, system_config)
    for problem in recording._problems:
        warnings.warn(f"{os.fspath(file)}: {problem}", RecordingWarning, stacklevel=2)
    return recording


def topics(*, domain: str | None = None, root: str | os.PathLike[str] | None = None) -> list[TopicName]:
    """Returns the topics of the running hub, sorted. Raises NoHub if no hub was found within half a second."""
    return sorted(TopicName(*name) for name in _scanhub._topics(domain, root))


def sensors(*, domain: str | None = None, root: str | os.PathLike[str] | None = None) -> list[str]:
    """Returns the sensors of the running hub, sorted. Raises NoHub if no hub was found within half a second."""
    return sorted({topic.sensor for topic in topics(domain=domain, root=root)})


def background(
    sensor: str, order: str = "show", *, domain: str | None = None, root: str | os.PathLike[str] | None = None
) -> Background:
    """Sends `order` to the hub, which is `show`, `reset` (learn again), `freeze` or `thaw`, and then returns the
    background model of `sensor`. Raises Refused if the hub refuses the order, and NoTopic if the hub does not have the
    sensor. May also raise NoHub, Silent or Short."""
    _check_order(order, ("show", "reset", "freeze", "thaw"))
    if order != "show":
        _scanhub._request(sensor, order, domain, root)
    model = _scanhub._request(sensor, "show", domain, root)
    if model is None:
        raise Failure("the hub's reply has no model", "hub and client have different versions")
    return model


def control(
    sensor: str, order: str, *, domain: str | None = None, root: str | os.PathLike[str] | None = None
) -> None:
    """Sends `order` to the hub: `pause` or `resume` the sensor, or restart the session of its link (`resync`). Raises
    the same errors as `background`."""
    _check_order(order, ("pause", "resume", "resync"))
    _scanhub._request(sensor, order, domain, root)


def _check_order(order: str, orders: tuple[str, ...]) -> None:
    if order not in orders:
        raise Impossible(f"unknown order {order!r}", f"the orders are {', '.join(orders)}")
