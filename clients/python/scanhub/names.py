"""The names: topics, sensors, domains, and the places where a domain may be. Looks at nothing but the environment."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import NamedTuple

from .errors import Impossible, NoTopic

TOPICS = ("telegram", "scan", "marks", "zones", "foreground", "background", "status", "lines", "motion", "early", "tracks", "events", "tilt", "cloud", "obstacles")
"""What the hub publishes for each sensor; the last five are of trackers, mounts and clouds."""

LINKS = TOPICS[:10]
"""Those of sensors."""

CONTROL = "scanhub/v2/control"
"""The service that takes requests; beside it are the events that wake the hub and its clients."""


class TopicName(NamedTuple):
    """One topic of one sensor."""

    sensor: str
    topic: str

    def __str__(self) -> str:
        return f"{self.sensor}/{self.topic}"

    @property
    def service(self) -> str:
        """The name of its service."""
        return service(self.sensor, self.topic)


def service(sensor: str, word: str) -> str:
    """The name of a service of `sensor`: a topic, or `wake`."""
    return f"scanhub/v2/{sensor}/{word}"


def of_service(name: str) -> TopicName | None:
    """The topic whose service has this name; nothing if it is none."""
    head, version, sensor, topic = (name.split("/") + 4 * [""])[:4]
    is_ours = (head, version) == ("scanhub", "v2") and topic in TOPICS
    return TopicName(sensor, topic) if is_ours else None


def parse(text: str) -> TopicName:
    """The topic that `text` names, as in `front/scan`; NoTopic, or Impossible for the sensor's name."""
    sensor, slash, topic = text.partition("/")
    if not slash or topic not in TOPICS:
        raise NoTopic(f"no topic {text!r}", f"write SENSOR/TOPIC, as front/scan; topics are {', '.join(TOPICS)}")
    check_sensor(sensor)
    return TopicName(sensor, topic)


def check_sensor(name: str) -> None:
    """Refuses what is no sensor's name, nor that of another machine's, `HUB.SENSOR`: Impossible."""
    halves = name.split(".")
    if len(halves) > 2 or not all(_is_name(half) for half in halves):
        raise Impossible(f"sensor name {name!r} is not possible", "1 to 24 of a-z, 0-9, _ and -, for example front")


def is_remote(name: str) -> bool:
    """Whether this is the name of another machine's sensor."""
    return "." in name


def _is_name(name: str) -> bool:
    return 1 <= len(name) <= 24 and name != "robot" and not set(name) - _OF_SENSORS


@dataclass(frozen=True)
class Domain:
    """A domain at its place: `root` is the directory of all its files."""

    name: str
    root: str

    @property
    def prefix(self) -> str:
        """How the names of its shared memory begin; what follows is in the directory's file `prefix`."""
        return f"sh_{self.name}_"


def candidates(name: str | None = None, base: str | os.PathLike[str] | None = None) -> list[Domain]:
    """Where domain `name` (None: what SCANHUB_DOMAIN says, else `scanhub`) may be: below the directory `base` only, if
    given, else every place that a hub may have chosen, in the order in which all clients look. Impossible if the name
    is, or root and prefix are too long together.
    """
    name = os.environ.get("SCANHUB_DOMAIN", "scanhub") if name is None else name
    if not 1 <= len(name) <= 16 or set(name) - _OF_DOMAINS:
        raise Impossible(f"domain name {name!r} is not possible", "1 to 16 of a-z, 0-9 and -, for example scanhub")
    if base is not None:
        domain = _at(name, os.path.abspath(base))
        if not _fits(domain):
            what = f"domain {name} at {domain.root} is too long: root and prefix have {_length(domain)} bytes"
            raise Impossible(f"{what}, at most {_LIMIT - 1} are possible", "choose a shorter root or domain")
        return [domain]
    bases = [place for place in (_service(), "/run/scanhub", _session(), _fallback()) if place]
    domains = [_at(name, base) for base in dict.fromkeys(bases)]
    return [domain for domain in domains if _fits(domain)]


def home(name: str | None = None, base: str | os.PathLike[str] | None = None) -> Domain:
    """Where a hub would put the domain: the first place that the environment offers; all else as `candidates`."""
    return candidates(name, base if base is not None else _service() or _user() or _fallback())[0]


def _at(name: str, base: str) -> Domain:
    return Domain(name, os.path.join(base, name))


def _length(domain: Domain) -> int:
    return len(os.fsencode(domain.root)) + len(domain.prefix) + _RANDOM


def _fits(domain: Domain) -> bool:
    return _length(domain) < _LIMIT


def _service() -> str | None:
    """What systemd makes for a service."""
    return _of_environment("RUNTIME_DIRECTORY")


def _user() -> str | None:
    """The place of a user who has logged in."""
    user = _of_environment("XDG_RUNTIME_DIR")
    return user and os.path.join(user, "scanhub")


def _session() -> str:
    """The place of a user, which clients find outside of the login session too, such as under sudo, ssh or cron."""
    return _user() or f"/run/user/{os.getuid()}/scanhub"


def _fallback() -> str:
    return f"/tmp/scanhub-{os.getuid()}"


def _of_environment(variable: str) -> str | None:
    """The first of a colon-separated list, if it is absolute."""
    first = os.environ.get(variable, "").split(":")[0]
    return first if os.path.isabs(first) else None


_OF_SENSORS = set("abcdefghijklmnopqrstuvwxyz0123456789_-")
_OF_DOMAINS = _OF_SENSORS - {"_"}
_RANDOM = 6
"""Bytes that the file `prefix` adds."""
_LIMIT = 66
"""Root and prefix together stay below this many bytes, for the path of a listener's socket."""
