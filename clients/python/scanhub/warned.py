"""Zones with the early warnings of their sensor: a warning makes the verdict worse until the zones of the same scan are there,
or until it is withdrawn. It never makes it better. Refuses to know where samples come from."""

from __future__ import annotations

from typing import NamedTuple

RANKS = {"clear": 0, "slow": 1, "unknown": 2, "stop": 3}
"""What is seen inside outweighs what is not known."""


class Said(NamedTuple):
    """A sensor's verdict, and how far what is nearest is."""

    verdict: str
    nearest_mm: int | None


class Scan(NamedTuple):
    """Life of the hub, and number in it."""

    boot: int
    seq: int


class Warned:
    """What is known of one sensor's zones, and what was said of the scan after that."""

    def __init__(self) -> None:
        self._known = Said("unknown", None)
        self._scan: Scan | None = None
        self._warning: tuple[Scan, Said] | None = None

    def hear(self, zones: Said, scan: Scan | None) -> Said:
        """Takes the zones of a scan, or a silence, which has none; the zones as a warning of a later scan makes them."""
        self._known = zones
        if scan is None:
            self._warning = None
            return zones
        self._scan = scan
        if self._warning and not _is_behind(self._warning[0], scan):
            self._warning = None
        return self._worse(self._warning[1]) if self._warning else zones

    def warn(self, early: Said, is_withdrawn: bool, scan: Scan) -> Said | None:
        """The zones as `early` makes them; nothing if it is of a scan whose zones are known."""
        if self._scan and self._scan.boot == scan.boot and not _is_behind(scan, self._scan):
            return None
        if is_withdrawn:
            self._warning = None
            return self._known
        self._warning = scan, early
        return self._worse(early)

    def _worse(self, early: Said) -> Said:
        # What this program does not know is no warning.
        verdicts = [self._known.verdict] + [early.verdict] * (early.verdict in ("slow", "stop"))
        distances = [mm for mm in (self._known.nearest_mm, early.nearest_mm) if mm is not None]
        return Said(max(verdicts, key=lambda verdict: RANKS[verdict]), min(distances, default=None))


def _is_behind(scan: Scan, other: Scan) -> bool:
    return scan.boot == other.boot and scan.seq > other.seq
