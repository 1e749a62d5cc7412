"""A topic that this program publishes: consumers in every language follow it by its name, see what they missed, and are
woken, as with a hub's own. A name has one publisher: its lock says that it lives."""

from __future__ import annotations

import contextlib
import operator
import os
import time
import traceback
import weakref

from . import layout, memory, prefix, trouble
from .errors import Failure, Impossible
from .lock import NameLock, holder, is_held, making, name_held
from .names import LINKS, Domain, TopicName
from .outlet import Outlet
from .tilted import Tilt


class Publication:
    """The angles of a mount. Made by `scanhub.publish`; it ends with `close`, with `with`, or with the program."""

    def __init__(self, name: TopicName, domain: Domain) -> None:
        self._next = 0
        self._boot = int.from_bytes(os.urandom(8), "little")
        self._process = os.getpid()
        try:
            self._place = _Place(domain, name)
        except OSError as error:
            raise trouble.broken(domain, f"{domain.root}: {error.strerror}") from None
        self._end = weakref.finalize(self, self._place.leave, self._process)

    def send(self, angle_rad: float, *, rate_rad_s: float | None = None, stamp_ns: int | None = None) -> None:
        """Says that the mount was at `angle_rad`, right-handed around its axis, at `stamp_ns` of `time.monotonic_ns()`
        (None: now), and how fast the angle grew (None: not known). Impossible if that is no time; Short if there is no
        memory for it: its number is used up.
        """
        if not self._end.alive or self._process != os.getpid():
            raise Failure("this publication has ended", "publish again; a child publishes under a name of its own")
        now_ns, wall_ns = time.monotonic_ns(), time.time_ns()
        at_ns = now_ns if stamp_ns is None else operator.index(stamp_ns)
        if not 0 <= at_ns < 1 << 64:
            raise Impossible(f"stamp_ns {at_ns} is no time", "a time of time.monotonic_ns(), or None for now")
        tilt = layout.Tilt(angle_rad, float("nan") if rate_rad_s is None else rate_rad_s)
        header = layout.Header(
            seq=self._next,
            topic_seq=self._next,
            stamp_first_ns=at_ns,
            stamp_last_ns=at_ns,
            wall_ns=wall_ns - (now_ns - at_ns),
            boot=self._boot,
            hub_pid=self._process,
        )
        self._next += 1
        self._place.outlet.send(header, tilt)

    @property
    def subscribers(self) -> int:
        """Consumers that follow it."""
        return self._place.outlet.subscribers if self._end.alive else 0

    def close(self) -> None:
        """Takes the topic away and gives its name free."""
        self._end()

    def __enter__(self) -> Publication:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class _Place:
    """A name in a domain, and what is published under it."""

    def __init__(self, domain: Domain, name: TopicName) -> None:
        self._domain = domain
        self._lock = NameLock(domain, name.sensor)
        try:
            if any(other.sensor == name.sensor and other.topic in LINKS for other in memory.topics(domain)):
                # A hub that is starting, or that has waited for this name, takes it now.
                hub = holder(domain, "hub.lock")
                if hub is not None:
                    raise name_held(name.sensor, hub)
                what = f'"{name.sensor}" is no name to publish under: it is a sensor of the hub'
                raise Impossible(what, "any other name, for example house")
            # In one step: a name without a process is forgotten by the next one that ends.
            with making(domain):
                prefix.settle(domain)
                membership = memory.Membership(domain)
            try:
                membership.clean_up()
                self.outlet = Outlet(membership, name, Tilt)
            except BaseException as error:
                membership.leave()
                # Who keeps the failure keeps its frames, and what they hold keeps this process in the domain.
                traceback.clear_frames(error.__traceback__)
                raise
        except BaseException:
            self._give_free()
            raise

    def leave(self, process: int) -> None:
        """Ends it; what a child has of its parent stays its parent's."""
        if process == os.getpid():
            self.outlet.close()
            self._give_free()

    def _give_free(self) -> None:
        """The last one out takes the names of the shared memory along."""
        try:
            with contextlib.suppress(OSError, Failure), making(self._domain):
                if not is_held(self._domain):
                    memory.forget_names(self._domain)
        finally:
            self._lock.release()
