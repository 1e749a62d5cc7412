"""How long a verdict is valid. Time is an argument; refuses to know how the verdict is used."""

from __future__ import annotations

import time
from typing import NamedTuple

from . import layout


class Moment(NamedTuple):
    """A time: CLOCK_MONOTONIC, and CLOCK_BOOTTIME, which goes on while the machine is suspended."""

    monotonic_ns: int
    boottime_ns: int

    def later(self, by_ns: int) -> Moment:
        """The time this long after it."""
        return Moment(self.monotonic_ns + by_ns, self.boottime_ns + by_ns)


def now() -> Moment:
    """The present time."""
    return Moment(time.monotonic_ns(), time.clock_gettime_ns(time.CLOCK_BOOTTIME))


class Freshness:
    """The deadline of one sensor's verdict."""

    def __init__(self, now: Moment) -> None:
        self._until = now.later(_FIRST_WORD_NS)
        self._said = False

    def heard(self, header: layout.Header, is_unknown: bool, now: Moment) -> bool:
        """A verdict came at `now`; whether it may be believed. What waited for long is no news, a stamp in the future
        keeps nothing fresh, and an unknown one stands however old it is."""
        period_us = header.period_us
        limit_ns = 2000 * period_us + _HUB_LIMIT_NS + _AFTER_HUB_NS if period_us else _NO_PERIOD_NS
        if header.flags & REMOTE:
            limit_ns = max(limit_ns, _NO_PERIOD_NS)
        silent_at = now.later(limit_ns)
        self._until = silent_at._replace(monotonic_ns=min(silent_at.monotonic_ns, header.stamp_last_ns + limit_ns))
        is_fresh = now.monotonic_ns < self._until.monotonic_ns
        self._said = is_unknown or not is_fresh
        return is_unknown or is_fresh

    def silence(self, now: Moment) -> bool:
        """Whether a verdict became too old just now; true once per silence."""
        if self._said or self.left(now):
            return False
        self._said = True
        return True

    def left(self, now: Moment) -> float:
        """Seconds for which `silence` need not be asked."""
        if self._said:
            return float("inf")
        left_ns = min(until - at for until, at in zip(self._until, now))
        return max(left_ns, 0) / 1e9


REMOTE = 32
"""Flag of a header: the sample came from another machine."""
_HUB_LIMIT_NS = 20_000_000
"""The hub says `unknown` two periods and this long after the last scan (docs/topics.md)."""
_AFTER_HUB_NS = 20_000_000
"""A client waits this much longer: if the hub runs, its own `unknown` comes first."""
_NO_PERIOD_NS = 500_000_000
"""The limit if no period is known, and the least limit for samples from a network."""
_FIRST_WORD_NS = 1_000_000_000
"""How long the first verdict may take."""
