"""Is there a hub, or a listener that stands for hubs of other machines, and where? Asks the locks of the places that a
domain may be at; opens nothing else there."""

from __future__ import annotations

import errno
import time

from .errors import Denied, Failure, NoHub, Short
from .lock import holder
from .names import Domain

LOOK_EVERY = 0.1
"""Seconds between two looks at the locks."""

GRACE = 0.5
"""Seconds that a hub which is just starting may take to appear, where it has to be there."""


class Presence:
    """The hub of a domain, as far as its lock tells: the first live one of several places."""

    def __init__(self, places: list[Domain]) -> None:
        self._places = places
        self._holder: tuple[Domain, int, bool] | None = None
        self._looked_at = float("-inf")
        self.denied: Denied | Short | None = None

    def look(self) -> tuple[bool, bool]:
        """Looks again, if the last look is long enough ago; whether one went, and whether one came."""
        now = time.monotonic()
        if now - self._looked_at < LOOK_EVERY:
            return False, False
        self._looked_at, before = now, self._holder
        self._holder = self._live()
        changed = self._holder != before
        return changed and before is not None, changed and self._holder is not None

    @property
    def domain(self) -> Domain | None:
        """Where the hub lives, if there is one."""
        return self._holder and self._holder[0]

    @property
    def is_hub(self) -> bool:
        """It is a hub that lives there, not only a listener that brings the sensors of other machines."""
        return self._holder is not None and self._holder[2]

    def absent(self) -> Failure:
        """What to tell who cannot wait for a hub."""
        if self.denied:
            return self.denied
        looked = ", ".join(place.root for place in self._places)
        name = self._places[0].name if self._places else ""
        start = "start one with `scanhub run`; `scanhub list --domains` shows the hubs of other domains and users"
        return NoHub(f"no hub in domain {name}", f"{start}; looked at {looked}")

    def _live(self) -> tuple[Domain, int, bool] | None:
        self.denied = None
        for place in self._places:
            for lock, is_hub in (("hub.lock", True), ("listen.lock", False)):
                try:
                    pid = holder(place, lock)
                except Denied as denied:
                    self.denied = denied
                    break
                except OSError as error:
                    if error.errno not in (errno.EMFILE, errno.ENFILE):
                        raise
                    # Nothing is known then, and who is there already goes on.
                    self.denied = Short(f"cannot look for a hub: {error}", "`ulimit -n` may be too small")
                    return self._holder
                if pid:
                    return place, pid, is_hub
        return None


def find(places: list[Domain]) -> Domain:
    """The hub at the first live one of `places`, waiting a moment for one that is just starting; NoHub, Denied."""
    presence, give_up_at = Presence(places), time.monotonic() + GRACE
    while True:
        presence.look()
        if presence.domain:
            return presence.domain
        if time.monotonic() >= give_up_at:
            raise presence.absent()
        time.sleep(LOOK_EVERY)
