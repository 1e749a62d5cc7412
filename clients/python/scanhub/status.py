"""How a link and its sensor are. What is not known is None."""

from __future__ import annotations

import re
from typing import NamedTuple

from . import layout
from .sample import Sample
from .scan import named_family


class Pose(NamedTuple):
    """Where a sensor sits: x ahead of the robot's centre, y to the left, yaw counter-clockwise from ahead."""

    x_m: float
    y_m: float
    yaw_rad: float
    upside_down: bool


class Status(Sample):
    """State, properties and counters of a link."""

    topic = "status"
    struct = layout.Status

    @property
    def state(self) -> str:
        """`absent`, `probing`, `switching`, `starting`, `streaming`, `silent` or `paused`."""
        return _STATES[self._fields.state] if self._fields.state < len(_STATES) else "unknown"

    @property
    def since_ns(self) -> int:
        """When the state began, CLOCK_MONOTONIC."""
        return self._fields.since_ns

    @property
    def baud(self) -> int | None:
        """Rate of the line."""
        return self._fields.baud or None

    @property
    def mode(self) -> int | None:
        """The measuring mode."""
        return None if self._fields.mode == 0xFF else self._fields.mode

    @property
    def family(self) -> str | None:
        """What the scanner speaks, such as `lms`; None if it is not known here."""
        return named_family(self._fields.family)

    @property
    def model(self) -> str | None:
        """The scanner's model in lower case: the first word of what it calls itself."""
        word = re.split(r"[;\s]", self.type, maxsplit=1)[0]
        return word.lower() or None

    @property
    def unit_mm(self) -> int | None:
        """Millimetres per device unit."""
        return self._fields.unit_mm or None

    @property
    def angle_deg(self) -> int | None:
        """Field of view."""
        return self._fields.angle_deg or None

    @property
    def step_deg(self) -> float | None:
        """Between two beams."""
        return self._fields.resolution_cdeg / 100 or None

    @property
    def hz(self) -> float:
        """Scans per second."""
        return self._fields.rate_mhz / 1000

    @property
    def type(self) -> str:
        """What the sensor calls itself; empty if it has not."""
        return layout.text(self._fields.type_text)

    @property
    def port(self) -> str:
        """As configured."""
        return layout.text(self._fields.port_text)

    @property
    def last_error(self) -> str:
        """In words; empty if there was none."""
        return layout.text(self._fields.last_error_text)

    @property
    def counters(self) -> dict[str, int]:
        """By the names of docs/output.md: copied."""
        return dict(zip(COUNTERS, self._fields.counters))

    @property
    def damaged(self) -> float:
        """Share of the line's bytes that were in nothing over the last 10 s, 0 to 1."""
        return self.counters["damaged_ppm"] / 1e6

    @property
    def lost_on_line(self) -> int | None:
        """Scans that must have been sent and did not arrive; `None` where that cannot be known."""
        counters = self.counters
        return counters["lost_on_line"] if counters["due_on_line"] else None

    @property
    def pose(self) -> Pose:
        """Where the sensor sits, as configured."""
        pose = self._fields.pose
        return Pose(pose.x_m, pose.y_m, pose.yaw_rad, pose.upside_down == 1)


_STATES = ("absent", "probing", "switching", "starting", "streaming", "silent", "paused")
COUNTERS = (
    "bytes_read",
    "bytes_in_telegrams",
    "bytes_acknowledge",
    "bytes_discarded",
    "bytes_buffered",
    "telegrams",
    "suspect",
    "aborted",
    "resyncs",
    "reconnects",
    "lost_in_restart",
    "wakeups",
    "loan_failed",
    "rejected_address",
    "rejected_length",
    "rejected_command",
    "rejected_count",
    "rejected_crc",
    "rejected_vetoed",
    "rejected_superseded",
    "line_errors",
    "bytes_damaged",
    "damaged_ppm",
    "due_on_line",
    "lost_on_line",
    "lost_ppm",
    "scanner_restarts",
)
"""The counters that have a name, in their order."""
