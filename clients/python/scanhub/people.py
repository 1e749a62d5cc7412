"""People across the sensors of a site: where they are, and what happened to them."""

from __future__ import annotations

from typing import NamedTuple

from . import layout
from .sample import Sample

STATES = ("tentative", "confirmed", "hidden", "between_rooms")
KINDS = ("appeared", "left", "door")


class Track(NamedTuple):
    """A person: his number, which nobody else ever gets; `tentative`, `confirmed`, `hidden` or `between_rooms`; place and speed in
    the map of the site; covariance of the place (xx, xy, yy, m2); the room, None if he is in none; the sensors that see him;
    since when he is known; how sure it is that this is a person, 0 to 1."""

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
    """Where a sensor sits in the map, and where it looks, counter-clockwise from x."""

    name: str
    x_m: float
    y_m: float
    yaw_rad: float
    upside_down: bool


class Tracks(Sample):
    """People at one instant, which is `wall_ns`."""

    topic = "tracks"
    struct = layout.Tracks

    @property
    def sites(self) -> tuple[Site, ...]:
        """The sensors, in the order of the site: copied."""
        fields = self._fields
        return tuple(
            Site(layout.text(of.name_text), of.x_m, of.y_m, of.yaw_rad, of.upside_down == 1)
            for of in fields.sensor_array[: fields.sensors]
        )

    @property
    def tracks(self) -> tuple[Track, ...]:
        """By their numbers: copied."""
        fields, names = self._fields, tuple(site.name for site in self.sites)

        def track(of: layout.Track) -> Track:
            return Track(
                of.id,
                STATES[of.state] if of.state < len(STATES) else "tentative",
                of.x_m,
                of.y_m,
                of.vx_m_s,
                of.vy_m_s,
                tuple(of.covariance),
                layout.text(of.room_text) or None,
                tuple(name for i, name in enumerate(names) if of.sensors >> i & 1),
                of.age_ms / 1000,
                of.score,
            )

        return tuple(track(of) for of in fields.track_array[: fields.count])


class Event(Sample):
    """What happened to a person at `wall_ns`."""

    topic = "events"
    struct = layout.Event

    @property
    def kind(self) -> str | None:
        """`appeared`, `left` or `door`; None if this version does not know it."""
        kind = self._fields.kind
        return KINDS[kind] if kind < len(KINDS) else None

    @property
    def id(self) -> int:
        """His number in `tracks`."""
        return self._fields.id

    @property
    def room(self) -> str | None:
        """Where he then is; None: in no room."""
        return layout.text(self._fields.room_text) or None

    @property
    def door(self) -> str | None:
        """The door that he went through; None if it is no event of a door."""
        return self._of_door(self._fields.door_text)

    @property
    def from_room(self) -> str | None:
        """Where he came from: a room, or `outside`."""
        return self._of_door(self._fields.from_text)

    @property
    def to_room(self) -> str | None:
        """Where he went to: a room, or `outside`."""
        return self._of_door(self._fields.to_text)

    def _of_door(self, field: object) -> str | None:
        return layout.text(field) if self.kind == "door" else None
