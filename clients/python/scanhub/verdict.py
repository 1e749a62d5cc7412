"""The robot's verdict: the fold over its sensors' zones, and their early warnings if these are wanted; a sensor that is not
heard counts as unknown."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from . import memory
from .freshness import Freshness, now
from .names import Domain, TopicName, is_remote
from .presence import GRACE
from .processed import Early, Zones
from .sample import Sample
from .subscription import Subscription
from .warned import RANKS, Said, Scan, Warned


@dataclass(frozen=True)
class Robot:
    """What is known of the robot's surroundings at a moment, by value.

    `verdict` is the worst of all sensors: `stop`, `unknown`, `slow`, `clear`; `unknown` as long as there are none, and to
    be taken as `stop`. `worst` is the first sensor with it, `nearest_mm` how far from the robot's centre the nearest of
    all points is, and `nearest_sensor` who sees it. `sensors` has each sensor's own verdict.
    """

    verdict: str = "unknown"
    worst: str | None = None
    nearest_mm: int | None = None
    nearest_sensor: str | None = None
    sensors: dict[str, str] = field(default_factory=dict)


class RobotFollower(Subscription):
    """Iterates over the verdicts of the robot, without end. Made by `scanhub.robot`."""

    def __init__(self, sensors: list[str], places: list[Domain], early: bool) -> None:
        super().__init__([], places, None, None)
        self._early = early
        self._heard: dict[str, Said] = {}
        self._warned: dict[str, Warned] = {}
        self._silent: set[str] = set()
        """Who has not said anything of zones yet, nor was silent for long enough."""
        self._begun = False
        self._nobody = Freshness(now())
        self._is_named = bool(sensors)
        self._is_of_hub: bool | None = None
        self._call_at: float | None = None
        for sensor in sensors:
            self._meet(TopicName(sensor, Zones.topic))

    def __next__(self) -> Robot:
        """Waits until any of the sensors is heard, or any is heard no more; the first time for a word of each."""
        if self._closed:
            raise StopIteration
        while not self._hear():
            self._wait(self._nobody.left(now()) if not self._followers else float("inf"))
        return self._fold()

    def now(self) -> Robot:
        """What is known now; never waits."""
        if not self._closed:
            self._hear()
        return Robot() if self._closed else self._fold()

    def _hear(self) -> bool:
        """Takes all that waits; whether there was anything."""
        # Who always finds something has to see a hub come, too.
        any_heard = self._drain()
        if self._look():
            any_heard = self._drain() or any_heard
        # Last, because it takes longer than all the rest.
        return self._call_the_roll() or any_heard or self._is_nobody_there()

    def _drain(self) -> bool:
        any_heard = False
        while (sample := self._receive()) is not None:
            said = self._said(sample)
            if said is not None:
                self._heard[sample.sensor] = said
                any_heard = True
        return any_heard and self._begun

    def _said(self, sample: Sample) -> Said | None:
        """What is known of a sensor by its sample; nothing if that is no news."""
        scan, warned = Scan(sample.boot, sample.seq), self._warned[sample.sensor]
        if isinstance(sample, Early):
            return warned.warn(Said(sample.verdict, sample.distance_mm), sample.withdrawn, scan)
        assert isinstance(sample, Zones)
        self._silent.discard(sample.sensor)
        self._begun = self._begun or not self._silent
        return warned.hear(Said(sample.verdict, sample.nearest_mm), None if sample.silent else scan)

    def _is_nobody_there(self) -> bool:
        return not self._followers and self._nobody.silence(now())

    def _call_the_roll(self) -> bool:
        """Adds the sensors that there are and that are not followed yet; one that is, stays: that it is missing is to be
        seen. Sensors of other machines give way to a hub that comes, because their zones are around another centre;
        nobody stands in for a hub that goes. True if all that was known was forgotten just now."""
        domain = self._presence.domain
        if self._is_named or domain is None or self._membership is None:
            self._call_at = None
            return False
        if self._is_of_hub is False and self._presence.is_hub:
            self._forget()
            return True
        at = time.monotonic()
        if self._call_at is None:
            self._call_at = at + GRACE / 2
        if at < self._call_at:
            return False
        self._call_at = at + _CALL_EVERY
        of_hub = self._presence.is_hub if self._is_of_hub is None else self._is_of_hub
        for name in memory.topics(domain):
            if name.topic == Zones.topic and is_remote(name.sensor) != of_hub:
                self._is_of_hub = of_hub
                self._meet(name)
        return False

    def _meet(self, name: TopicName) -> None:
        """Follows a sensor that is not followed yet. Of those of other machines that are too many none is: in their place
        stands one that is always unknown."""
        if name.sensor in self._heard:
            return
        if not self._is_named and is_remote(name.sensor) and len(self._heard) >= _MOST_REMOTE:
            self._heard[_OTHERS] = Said("unknown", None)
            return
        self._heard[name.sensor], self._warned[name.sensor] = Said("unknown", None), Warned()
        self._silent.add(name.sensor)
        self._follow(name)
        if self._early:
            self._follow(TopicName(name.sensor, Early.topic))

    def _forget(self) -> None:
        self._leave()
        self._followers, self._turn, self._heard, self._warned, self._silent = [], 0, {}, {}, set()
        self._begun, self._is_of_hub, self._call_at = False, True, None

    def _fold(self) -> Robot:
        sensors = {sensor: said.verdict for sensor, said in self._heard.items()}
        # The first of the worst.
        worst = max(sensors, key=lambda sensor: RANKS[sensors[sensor]], default=None)
        seen = [(said.nearest_mm, sensor) for sensor, said in self._heard.items()]
        nearest = min(((mm, sensor) for mm, sensor in seen if mm is not None), default=(None, None))
        return Robot(sensors[worst] if worst else "unknown", worst, *nearest, sensors)


_MOST_REMOTE = 16
"""As many as a listener publishes at a time. None is forgotten, and whoever can send to its network can announce ever new
ones."""
_OTHERS = "others..."
"""No sensor can have this name."""
_CALL_EVERY = 1.0
"""Seconds: a hub that starts makes its topics one after the other, and nobody shall be overlooked for long."""
