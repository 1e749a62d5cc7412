"""Topics that are followed through all lives of the hub: sample by sample, with what was missed. The loop of all
clients: look for the hub, open what is there, receive until nothing waits, sleep."""

from __future__ import annotations

import time
from typing import Any, Callable, Iterator

from . import freshness, layout, memory
from .errors import NoHub, Silent
from .freshness import REMOTE
from .model import Background
from .names import Domain, TopicName, service
from .people import Event, Tracks
from .presence import Presence
from .processed import Early, Foreground, Lines, Marks, Motion, Zones, nothing
from .sample import Sample
from .scan import Scan, Telegram
from .status import Status
from .tilted import Cloud, Obstacles, Tilt

KINDS: dict[str, type[Sample]] = {
    kind.topic: kind
    for kind in (
        *(Telegram, Scan, Marks, Zones, Foreground, Background, Status, Lines, Motion, Early),
        *(Tracks, Event, Tilt, Cloud, Obstacles),
    )
}
"""What each topic carries."""


class Subscription(Iterator[Any]):
    """Iterates over the samples of its topics, without end. Made by `scanhub.subscribe`."""

    def __init__(
        self,
        names: list[TopicName],
        places: list[Domain],
        timeout: float | None,
        on_notice: Callable[[str], object] | None,
    ) -> None:
        self._followers = [_follower(name) for name in dict.fromkeys(names)]
        self._turn = 0
        self._presence = Presence(places)
        self._membership: memory.Membership | None = None
        self._is_unsure = False
        """A hub came, and it was not yet seen whether its shared memory has the names that were joined."""
        self._wakeups = memory.Wakeups()
        self._listened: set[str] = set()
        self._opened_at = float("-inf")
        self._closed = False
        self._timeout = timeout
        self._notice = on_notice or (lambda notice: None)

    def __iter__(self) -> Subscription:
        return self

    def __next__(self) -> Any:
        """The next sample, waiting for it; after a silence of `timeout` NoHub or Silent, after which one may go on.

        Mismatch, Denied, Short, Held as they say.
        """
        if self._closed:
            raise StopIteration
        give_up_at = float("inf") if self._timeout is None else time.monotonic() + self._timeout
        while True:
            # What is there comes before the question whether the hub still is: that takes longer than receiving.
            sample = self._receive()
            if sample is None and self._look():
                sample = self._receive()
            if sample is not None:
                return sample
            left = give_up_at - time.monotonic()
            if left <= 0:
                raise self._silence()
            self._wait(left)

    def __enter__(self) -> Subscription:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Leaves the domain. Samples that are kept stay readable."""
        self._closed = True
        self._leave()
        self._membership = None

    @property
    def hub_lives(self) -> bool:
        """There was a hub when it was looked for last: at most a tenth of a second before the last wait ended."""
        return self._presence.domain is not None

    def _receive(self) -> Sample | None:
        """The next sample that waits; the topics take turns."""
        for _ in self._followers:
            follower = self._followers[self._turn]
            self._turn = (self._turn + 1) % len(self._followers)
            sample = follower.receive()
            if sample is not None:
                return sample
        return None

    def _wait(self, longest: float) -> None:
        """Sleeps until there may be something to say, for so many seconds at most."""
        self._wakeups.wait(min(longest, _LONGEST_WAIT, *(follower.left() for follower in self._followers)))

    def _follow(self, name: TopicName) -> None:
        """Follows this one, too."""
        self._followers.append(_follower(name))
        self._opened_at = float("-inf")

    def _look(self) -> bool:
        """Looks for the hub and for topics that are not there yet; whether something new was opened."""
        gone, back = self._presence.look()
        domain = self._presence.domain
        self._is_unsure |= back
        joined = self._membership
        if domain and (joined is None or joined.domain != domain or (self._is_unsure and not joined.is_current())):
            try:
                entered = memory.Membership(domain)
            except NoHub:
                # It is just starting or ending.
                return False
            self._leave()
            self._membership = entered
        self._is_unsure &= domain is None
        if self._membership is None and self._presence.denied:
            raise self._presence.denied
        if gone:
            self._notice("hub_gone")
        if back:
            self._notice("hub_back")
        return self._open(self._membership) if domain and self._membership else False

    def _open(self, membership: memory.Membership) -> bool:
        missing = [follower for follower in self._followers if follower.port is None]
        if not missing or time.monotonic() - self._opened_at < _OPEN_EVERY:
            return False
        self._opened_at = time.monotonic()
        for follower in missing:
            # What wakes comes first, so that nothing is sent unheard between the two.
            if self._listen(membership, follower.name.sensor):
                follower.port = membership.subscribe(follower.name, follower.kind)
        return any(follower.port for follower in missing)

    def _listen(self, membership: memory.Membership, sensor: str) -> bool:
        if sensor not in self._listened:
            listener = membership.listen(service(sensor, "wake"))
            if listener is None:
                return False
            self._wakeups.add(listener)
            self._listened.add(sensor)
        return True

    def _leave(self) -> None:
        for follower in self._followers:
            follower.leave()
        self._wakeups, self._listened = memory.Wakeups(), set()

    def _silence(self) -> Exception:
        if self._presence.domain is None:
            return self._presence.absent()
        names = ", ".join(str(follower.name) for follower in self._followers)
        missing = {str(follower.name) for follower in self._followers if follower.port is None}
        if missing and self._membership:
            there = ", ".join(map(str, memory.topics(self._membership.domain))) or "no topics at all"
            return Silent(f"no {', '.join(sorted(missing))} in {self._timeout} s", f"the hub has {there}")
        sensor = self._followers[0].name.sensor
        return Silent(f"nothing of {names} in {self._timeout} s", f"`scanhub info {sensor}` shows the sensor's state")


class _Follower:
    """One topic, with the account of what was missed."""

    def __init__(self, name: TopicName) -> None:
        self.name = name
        self.kind = KINDS[name.topic]
        self.port: memory.Port | None = None
        self._boot: int | None = None
        self._expected: int | None = None

    def leave(self) -> None:
        self.port = None
        self._expected = None

    def receive(self) -> Sample | None:
        received = self.port and self.port.receive()
        if not received:
            return None
        header = received.header
        restarted = self._boot is not None and self._boot != header.boot
        # A port that outlived its hub got everything of the next one from number 0; a network's numbers go on.
        if restarted and not header.flags & REMOTE and self._expected is not None:
            self._expected = 0
        missed = 0 if self._expected is None else max(header.topic_seq - self._expected, 0)
        self._boot, self._expected = header.boot, header.topic_seq + 1
        return self.kind(self.name.sensor, received, missed, restarted)

    def left(self) -> float:
        """Seconds after which there is something to say even if no sample comes."""
        return float("inf")


class _ZonesFollower(_Follower):
    """The zones of a sensor, never staler than they look: a verdict that is too old becomes `unknown`, once."""

    def __init__(self, name: TopicName) -> None:
        super().__init__(name)
        self._freshness = freshness.Freshness(freshness.now())
        self._last = layout.Header()

    def receive(self) -> Sample | None:
        zones, now = super().receive(), freshness.now()
        if zones is None:
            if not self._freshness.silence(now):
                return None
            silence = nothing(self.name.sensor, self._last)
            silence.silent = True
            return silence
        assert isinstance(zones, Zones)
        self._last = zones.copy_of_header()
        is_fresh = self._freshness.heard(self._last, zones.verdict == "unknown", now)
        return zones if is_fresh else zones.unknown()

    def left(self) -> float:
        return self._freshness.left(freshness.now())


def _follower(name: TopicName) -> _Follower:
    return _ZonesFollower(name) if name.topic == Zones.topic else _Follower(name)


_LONGEST_WAIT = 0.1
"""Seconds: so often the hub is looked for."""
_OPEN_EVERY = 0.05
"""Seconds between two looks for a topic that is not there."""
