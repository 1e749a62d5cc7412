"""The datagrams of `scanhub gateway` for programs in Python: checks one, and tells what it says.

Refuses to know sockets and what is missing between two datagrams. Needs Python 3.9 and nothing else; with numpy the
ranges of a scan are a view into the datagram. docs/datagram.md has the bytes.

    import socket, struct, scanhub_lan

    listener = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    listener.bind(("", scanhub_lan.PORT))
    group = socket.inet_aton(scanhub_lan.group("scan"))
    listener.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, group + socket.inet_aton("0.0.0.0"))
    parts = scanhub_lan.Parts()
    while True:
        try:
            datagram = parts.take(scanhub_lan.read(listener.recv(2048)))
            if datagram is None or datagram.topic != "scan":
                continue
            scan = datagram.unpack()
        except scanhub_lan.Refused:
            continue
        if datagram.topic == "scan":
            print(datagram.sensor, datagram.sequence, min(filter(None, scan.ranges_m()), default=None), "m")
"""

import hashlib
import hmac
import math
import os
import struct
import time
from dataclasses import astuple, dataclass, replace
from typing import Optional, Union

PORT = 22200
TOPICS = ("announce", "telegram", "scan", "marks", "zones", "foreground", "background", "status", "lines", "motion", "early", "tracks", "events", "tilt", "cloud", "obstacles")
VERDICTS = ("clear", "slow", "stop", "unknown")
STATES = ("absent", "probing", "switching", "starting", "streaming", "silent", "paused")
FAMILIES = ("lms", "ld", "rplidar")
CODES = ("not_measured", "no_return", "beyond", "too_near", "too_bright", "weak", "overflow", "error")
"""Why a beam has no reading, from the greatest value down; those of an LMS count from that of its measuring mode."""
_OF_LMS = {0: "no_return", 1: "too_bright", 4: "weak", 5: "error", 8: "beyond"}
COUNTERS = (
    "bytes_read", "bytes_in_telegrams", "bytes_acknowledge", "bytes_discarded", "bytes_buffered", "telegrams",
    "suspect", "aborted", "resyncs", "reconnects", "lost_in_restart", "wakeups", "loan_failed", "rejected_address",
    "rejected_length", "rejected_command", "rejected_count", "rejected_crc", "rejected_vetoed", "rejected_superseded",
    "line_errors",
    "bytes_damaged",
    "damaged_ppm",
    "due_on_line",
    "lost_on_line",
    "lost_ppm",
    "scanner_restarts",
)

AUTHENTICATED, SIMULATED, REPLAYED, STAMP_ESTIMATED, SUSPECT = 1, 2, 4, 8, 16
"""Bits of `Datagram.flags`."""


class Refused(ValueError):
    """A datagram that is none, or is not for us; `reason` is one word."""

    def __init__(self, reason: str):
        super().__init__(f"refused: {reason}")
        self.reason = reason


def group(topic: str) -> str:
    """The address of the group that a topic goes to."""
    last = {"announce": 80, "status": 80, "scan": 82, "background": 82, "telegram": 83}.get(topic, 81)
    return f"239.255.76.{last}"


@dataclass(frozen=True)
class Announced:
    """One topic in an announcement: the last byte of its group, and the number of its next datagram."""

    topic: int
    group: int
    port: int
    next: int


@dataclass(frozen=True)
class Announce:
    """Who a sensor is and what goes out of it; `boot` is the hub's life."""

    boot: int
    sensor: str
    type: str
    topics: "tuple[Announced, ...]"


@dataclass(frozen=True)
class Telegram:
    """What a sensor sent, as it came: of an LMS a telegram, STX to CRC; of other families whole packets that arrived
    together, `packets` of them (None of an LMS). `family` is None if it is not known here."""

    telegram: bytes
    family: Optional[str]
    packets: Optional[int]


@dataclass(frozen=True)
class Scan:
    """One turn of a scanner, its beams in the order of their measuring.

    `ranges` are in device units (x `unit_um` = micrometres); those above `valid_to` are codes, which are no ranges:
    `ranges_m()` is what to calculate with. Angles are in radians: 0 is the sensor's own ahead, counter-clockwise positive
    seen from above; `exact` has those of a scanner whose points fall where they like, NaN where nothing was measured.
    `upper` is the additional byte of each range: an intensity or field bits. `collapsed` points, with or without a return, were
    dropped because another one has the same beam; `incomplete`: packets of the turn are missing. `family` is None if it is not known here.
    """

    family: Optional[str]
    unit_um: int
    count: int
    first_angle: float
    step: float
    spacing: float
    beam_time_ns: int
    first_beam_ns: int
    turns: int
    turn_ns: int
    valid_to: int
    no_return: int
    beyond: int
    collapsed: int
    incomplete: bool
    intensity_bits: int
    exact: "tuple[float, ...]"
    ranges: "tuple[int, ...]"
    intensities: "tuple[int, ...]"
    upper: bytes
    payload: bytes

    def ranges_m(self) -> "list[Optional[float]]":
        """The ranges in metres, None where there is no reading."""
        return [value * self.unit_um / 1e6 if value <= self.valid_to else None for value in self.ranges]

    def angles(self) -> "list[float]":
        """Where each beam looks, exact where the sensor says so."""
        grid = [self.first_angle + i * self.step for i in range(self.count)]
        return [known if angle != angle else angle for known, angle in zip(grid, self.exact)] if self.exact else grid

    def codes(self) -> "list[Optional[str]]":
        """Why each beam has no reading, None where it has one."""
        return [self._code(value) if value > self.valid_to else None for value in self.ranges]

    def times_ns(self) -> "list[int]":
        """When each beam was measured, in ns after the datagram's stamp."""
        step, turns = self.beam_time_ns, max(self.turns, 1)
        return [self.first_beam_ns + i * step + i % turns * self.turn_ns for i in range(self.count)]

    def view(self):
        """The ranges as a numpy array of the device's u16, codes included: a view into the datagram, not a copy."""
        import numpy

        return numpy.frombuffer(self.payload, dtype="<u2", count=self.count, offset=64 + 4 * len(self.exact))

    def _code(self, value: int) -> str:
        if value != 0xFFFF and self.family == "lms":
            return _OF_LMS.get(self.no_return - value, "overflow")
        return CODES[min(0xFFFF - value, len(CODES) - 1)]


@dataclass(frozen=True)
class Mark:
    """A reflector: angle in 1/1000 degree (0 ahead), range in 1/10 mm, sum and greatest of its intensities, its beams; `edge` is
    1 if a part of it may lie outside of the scan."""

    angle_mdeg: int
    range_dmm: int
    weight: int
    peak: int
    edge: int
    first_beam: int
    last_beam: int


@dataclass(frozen=True)
class Marks:
    """The reflectors of a scan; `unavailable` means that the sensor's mode does not tell."""

    overflow: bool
    unavailable: bool
    marks: "tuple[Mark, ...]"


@dataclass(frozen=True)
class Line:
    """A straight surface: both ends in metres ahead and to the left of the robot's centre; x cos alpha + y sin alpha = r, with
    standard deviations; its first and last beam, and how many of them have a range."""

    x1_m: float
    y1_m: float
    x2_m: float
    y2_m: float
    r_m: float
    alpha_rad: float
    sd_r_m: float
    sd_alpha_rad: float
    first: int
    last: int
    points: int


@dataclass(frozen=True)
class Corner:
    """Where two lines meet, and their numbers."""

    x_m: float
    y_m: float
    first_line: int
    second_line: int


@dataclass(frozen=True)
class Lines:
    """The straight lines of a scan: beams with a range, beams that end on a line, deviation of a range, the lines and their
    corners. `overflow`: there are more than are allowed."""

    overflow: bool
    readings: int
    on_lines: int
    noise_m: float
    lines: "tuple[Line, ...]"
    corners: "tuple[Corner, ...]"


METHODS = ("first", "refused", "beams", "points", "lines", "both")


@dataclass(frozen=True)
class Motion:
    """How the robot moved: the sum of all steps, the last step with its covariance (9 numbers, row by row), the share of
    readings that lie on the scan before, and one of METHODS. `first` and `refused` have no step (0), `refused` no place.
    `valid`: the sum is known, and none of its steps was degenerate. `pose_covariance`: of the sum, in the same form; 0 if the
    sum is not valid or the sender is older."""

    x_m: float
    y_m: float
    yaw_rad: float
    dx_m: float
    dy_m: float
    dyaw_rad: float
    covariance: "tuple[float, ...]"
    overlap: float
    method: str
    valid: bool
    degenerate: bool
    breaks: int
    pose_covariance: "tuple[float, ...]"


@dataclass(frozen=True)
class Early:
    """A warning by a telegram that was not complete: slow or stop, the beam of the nearest point so far and its distance, and
    what of the telegram had arrived. `withdrawn`: what was said under this number does not hold."""

    verdict: str
    withdrawn: bool
    beam: int
    distance_mm: int
    bytes_seen: int
    beams_seen: int


TRACK_STATES = ("tentative", "confirmed", "hidden", "between_rooms")
EVENTS = ("appeared", "left", "door")


@dataclass(frozen=True)
class Track:
    """A person: number, place and speed in the map of the site, covariance of the place (xx, xy, yy, m2), how sure it is that
    this is a person (0 to 1), since when he is known, bits of the sensors that see him, room (empty: none), and one of
    TRACK_STATES."""

    id: int
    x_m: float
    y_m: float
    vx_m_s: float
    vy_m_s: float
    covariance: "tuple[float, float, float]"
    score: float
    age_ms: int
    sensors: int
    room: str
    state: str


@dataclass(frozen=True)
class Site:
    """Where a sensor sits in the map, and where it looks, counter-clockwise from x."""

    name: str
    site_x_m: float
    site_y_m: float
    yaw_rad: float
    upside_down: bool


@dataclass(frozen=True)
class Tracks:
    """People at one instant, which is `stamp_ns`, and the sensors."""

    sites: "tuple[Site, ...]"
    tracks: "tuple[Track, ...]"


@dataclass(frozen=True)
class Event:
    """What happened to a person: one of EVENTS, the room where he then is (empty: none); of `door` the door, and from where to
    where."""

    kind: str
    id: int
    room: str
    door: str
    from_room: str
    to_room: str


@dataclass(frozen=True)
class Tilt:
    """The angle of a mount at `stamp_ns`, right-handed around its axis, and how fast it grows (nan: not known)."""

    angle_rad: float
    rate_rad_s: float


POINT_CLASSES = ("unknown", "background", "foreground", "behind")


@dataclass(frozen=True)
class Point:
    """A point in the robot's frame: metres ahead, to the left and above the floor, its beam's number in the scan, and one of
    POINT_CLASSES."""

    x_m: float
    y_m: float
    z_m: float
    beam: int
    point_class: str


@dataclass(frozen=True)
class Cloud:
    """The points of one scan of a sweep. The samples of a sweep come one behind the other, from `first` to `last`. A sweep is
    `complete` if it went from turn to turn without a missing angle, and `doubted` if its angles contradict the background, of
    which `generation` is the number."""

    sweep: int
    generation: int
    first: bool
    last: bool
    complete: bool
    doubted: bool
    points: "tuple[Point, ...]"


@dataclass(frozen=True)
class Obstacle:
    """The mean, the least and the greatest coordinates of its points in the robot's frame, the distance of the nearest one over
    ground, how many there are, and whether some are before the background, or in the space that is to be free."""

    x_m: float
    y_m: float
    z_m: float
    low_m: "tuple[float, float, float]"
    high_m: "tuple[float, float, float]"
    distance_m: float
    points: int
    foreground: bool
    near: bool


@dataclass(frozen=True)
class Obstacles:
    """What one sweep has found, the nearest first. If it is `doubted`, nothing is known of what stands there."""

    sweep: int
    generation: int
    complete: bool
    doubted: bool
    left_out: int
    obstacles: "tuple[Obstacle, ...]"


@dataclass(frozen=True)
class Zone:
    """A circle around the robot's centre and the beams that met something inside."""

    radius_mm: int
    beams: int
    violated: bool


@dataclass(frozen=True)
class Zones:
    """What is near the robot. `nearest_beam` and `nearest_mm` are None if no beam has a valid reading."""

    verdict: str
    nearest_beam: Optional[int]
    nearest_mm: Optional[int]
    invalid_beams: int
    provisional: bool
    zones: "tuple[Zone, ...]"


@dataclass(frozen=True)
class Segment:
    """Foreground beams that belong together: beams, device units, mm ahead and to the left of the robot's centre. It has
    `support` if it has several beams, or the foreground of the scan before was near it."""

    first: int
    last: int
    nearest: int
    width: int
    x_mm: int
    y_mm: int
    support: bool


@dataclass(frozen=True)
class Foreground:
    """What stands before the background: beams and their ranges in device units, and the segments that had room."""

    generation: int
    count: int
    unit_um: int
    left_out: int
    beams: "tuple[int, ...]"
    ranges: "tuple[int, ...]"
    segments: "tuple[Segment, ...]"


@dataclass(frozen=True)
class Background:
    """Where each beam ends when nobody is there, in device units: 0 not learned, 65535 beyond the sensor's range; angles as
    in a scan, `step` is 0 before the first."""

    generation: int
    taught: int
    count: int
    unit_um: int
    first_angle: float
    step: float
    frozen: bool
    ranges: "tuple[int, ...]"


@dataclass(frozen=True)
class Pose:
    """Where a sensor sits in the robot's frame: x ahead, y left, yaw counter-clockwise from ahead."""

    x_m: float
    y_m: float
    yaw_rad: float
    upside_down: bool


@dataclass(frozen=True)
class Status:
    """How a link and its sensor are. 0 is unknown; `mode` 255 and `state` None are."""

    state: Optional[str]
    mode: int
    unit_mm: int
    family: Optional[str]
    baud: int
    since_ns: int
    rate_mhz: int
    angle_deg: int
    resolution_cdeg: int
    type: str
    port: str
    last_error: str
    counters: "dict[str, int]"
    pose: Pose


Payload = Union[
    Announce, Telegram, Scan, Marks, Zones, Foreground, Background, Status, Lines, Motion, Early, Tracks, Event, Tilt, Cloud, Obstacles
]


@dataclass(frozen=True)
class Datagram:
    """A datagram whose header, lengths and checksum are right.

    `hub` is the gateway, `epoch` its life (a greater one ends the one before), `sequence` the number of the sample among
    those of this sensor and topic (modulo 2^32: a gap is what was lost), `counter` the same in all that came from one
    telegram, `stamp_ns` the wall clock of the telegram's first byte. `part` of `parts`, from 0: a sample that is longer
    than a datagram comes in several, see `Parts`. `family` is the number of the sensor's. `authenticated`: a key was given, and the MAC is of it.
    """

    number: int
    flags: int
    hub: int
    epoch: int
    sequence: int
    stamp_ns: int
    sensor: int
    part: int
    parts: int
    family: int
    revision: int
    counter: int
    payload: bytes
    authenticated: bool

    @property
    def topic(self) -> Optional[str]:
        """Its name, None if it is not known here."""
        return TOPICS[self.number] if self.number < len(TOPICS) else None

    def unpack(self) -> Payload:
        """What the payload says; Refused: `skipped` if the topic is not known, `payload` if it contradicts itself or is a
        part by itself."""
        if self.number >= len(TOPICS):
            raise Refused("skipped")
        if self.revision == 0 or self.parts != 1:
            raise Refused("payload")
        try:
            if self.topic == "telegram":
                return _telegram(self.payload, self.family)
            return _UNPACK[self.number](self.payload)
        except struct.error:
            raise Refused("payload") from None


def read(data: bytes, key: Optional[bytes] = None) -> Datagram:
    """Checks `data`, a whole datagram as it was received. With a key only what has its MAC is taken."""
    data = bytes(data)
    if len(data) < 48:
        raise Refused("short")
    magic, version, header, number, flags = struct.unpack_from("<4sBBBB", data)
    if magic != b"SHUB":
        raise Refused("magic")
    if version != 2:
        raise Refused("version")
    fields = struct.unpack_from("<QIIQBBBBHHII", data, 8)
    hub, epoch, sequence, stamp_ns, sensor, part, parts, family, length, revision, counter, crc = fields
    if not 48 <= header <= len(data) or part >= parts:
        raise Refused("header")
    end = header + length
    if end + (16 if flags & AUTHENTICATED else 0) != len(data) or (parts > 1 and length > 1424):
        raise Refused("length")
    without = data[:44] + bytes(4) + data[48:]
    if crc32c(without) != crc:
        raise Refused("crc")
    if key is not None:
        if not flags & AUTHENTICATED:
            raise Refused("unauthenticated")
        if not hmac.compare_digest(hmac.new(key, without[:end], hashlib.sha256).digest()[:16], data[end:]):
            raise Refused("mac")
    payload, authenticated = data[header:end], key is not None
    head = number, flags, hub, epoch, sequence, stamp_ns, sensor, part, parts, family, revision, counter
    return Datagram(*head, payload, authenticated)


def read_key(path: str) -> bytes:
    """The key in a file of `scanhub key new`, for `read`: 32 bytes, or 64 hex digits. ValueError if it is none, or if others
    can use it."""
    with open(path, "rb") as file:
        mode = os.fstat(file.fileno()).st_mode
        if mode & 0o077:
            raise ValueError(f"{path}: its mode is {mode & 0o777:04o}, so others can use the key; chmod 600 it")
        content = file.read(256)
    try:
        key = content if len(content) == 32 else bytes.fromhex(content.decode().strip())
    except ValueError:
        key = b""
    if len(key) != 32:
        raise ValueError(f"{path}: its {len(content)} bytes are no key: 32 bytes, or 64 hex digits")
    return key


class Guard:
    """What is new, and not of a recording, of what was read with a key.

        datagram = guard.take(scanhub_lan.read(data, key))

    A sensor is believed from an announcement on that is stamped within 5 s of our clock; from then on numbers and epochs only
    go forward. `epochs` has the greatest epoch of each gateway: keep it over restarts, and begin with it. It knows no
    senders. Parts are judged, and not counted: `take` the sample again when `Parts` has made it whole.
    """

    STREAMS = 1024
    """The most topics of all sensors."""

    def __init__(self, epochs: "Optional[dict[int, int]]" = None):
        self.epochs: "dict[int, int]" = dict(epochs or {})
        # By hub, sensor and topic: the lowest number that is believed, the highest that came, those of the window that did.
        self._streams: "dict[tuple[int, int, int], tuple[int, Optional[int], set[int]]]" = {}
        # By hub: the epoch of which the streams are.
        self._lives: "dict[int, int]" = {}

    def take(self, datagram: Datagram, wall_ns: Optional[int] = None) -> Datagram:
        """`datagram`, if it is to be believed; `wall_ns` is our clock, ns since 1970.

        Refused: `unauthenticated` if it was read without a key, `untimely`, `epoch`, `stale`, `capacity`, and `duplicate` if
        it came before."""
        if not datagram.authenticated:
            raise Refused("unauthenticated")
        hub, sensor = datagram.hub, datagram.sensor
        if datagram.epoch < self.epochs.get(hub, 0):
            raise Refused("epoch")
        is_next = self._lives.get(hub) != datagram.epoch
        is_announce = datagram.number == 0
        if is_next or (hub, sensor, 0) not in self._streams:
            wall_ns = time.time_ns() if wall_ns is None else wall_ns
            if not is_announce or abs(wall_ns - datagram.stamp_ns) > 5_000_000_000:
                raise Refused("untimely")
        if not is_announce:
            if (hub, sensor, datagram.number) not in self._streams:
                raise Refused("untimely")
            self._count(datagram)
            return datagram
        announce = datagram.unpack()
        if is_next:
            self._streams = {key: stream for key, stream in self._streams.items() if key[0] != hub}
        first = {topic.topic: topic.next for topic in announce.topics if topic.topic < len(TOPICS)}
        first[0] = datagram.sequence
        new = {(hub, sensor, topic): number for topic, number in first.items()}
        new = {key: (number, None, set()) for key, number in new.items() if key not in self._streams}
        if len(self._streams) + len(new) > self.STREAMS:
            raise Refused("capacity")
        self.epochs[hub] = self._lives[hub] = datagram.epoch
        self._streams.update(new)
        self._count(datagram)
        return datagram

    def _count(self, datagram: Datagram) -> None:
        key = datagram.hub, datagram.sensor, datagram.number
        lowest, highest, seen = self._streams[key]
        # The number without wrapping: the nearest to what is known.
        known = lowest if highest is None else highest
        number = known + (datagram.sequence - known + 0x80000000) % 0x100000000 - 0x80000000
        if number < lowest:
            raise Refused("stale")
        if number in seen:
            raise Refused("duplicate")
        if datagram.parts > 1:
            return
        seen.add(number)
        highest = number if highest is None else max(highest, number)
        lowest = max(lowest, highest - _WINDOW + 1)
        if len(seen) > 2 * _WINDOW:
            seen = {number for number in seen if number >= lowest}
        self._streams[key] = lowest, highest, seen


# Numbers below the highest that are still kept apart.
_WINDOW = 1024


class Parts:
    """Puts together what comes in parts, of one sender: of each hub, sensor and topic at most four samples wait for parts
    that did not come, and no more than 64 in all; the oldest make room."""

    def __init__(self):
        self._unfinished: "dict[tuple[Datagram, int], dict[int, bytes]]" = {}

    def take(self, datagram: Datagram) -> Optional[Datagram]:
        """The sample that is whole with this datagram; None as long as parts of it are missing."""
        if datagram.parts == 1:
            return datagram
        head = replace(datagram, part=0, parts=1, payload=b"")
        # What waits for longest stands first.
        parts = self._unfinished.pop((head, datagram.parts), {})
        parts[datagram.part] = datagram.payload
        if len(parts) == datagram.parts:
            return replace(head, payload=b"".join(parts[i] for i in range(datagram.parts)))

        def topic(of):
            return of.hub, of.epoch, of.sensor, of.number

        others = [key for key in self._unfinished if topic(key[0]) == topic(head)]
        same = [key for key in others if key[0].sequence == head.sequence]
        oldest = others if len(others) >= 4 else list(self._unfinished) if len(self._unfinished) >= 64 else []
        for key in same or oldest[:1]:
            del self._unfinished[key]
        self._unfinished[head, datagram.parts] = parts
        return None


def crc32c(data: bytes) -> int:
    """CRC-32C (iSCSI): of b"123456789" it is E3069283h."""
    crc = 0xFFFFFFFF
    for byte in data:
        crc = crc >> 8 ^ _CRC[(crc ^ byte) & 0xFF]
    return crc ^ 0xFFFFFFFF


def _crc_of(byte: int) -> int:
    for _ in range(8):
        byte = byte >> 1 ^ (0x82F63B78 if byte & 1 else 0)
    return byte


_CRC = tuple(_crc_of(byte) for byte in range(256))


def _limit(is_possible: bool) -> None:
    if not is_possible:
        raise Refused("payload")


def _text(field: bytes) -> str:
    field = field.split(b"\0", 1)[0]
    try:
        return field.decode()
    except UnicodeDecodeError as error:
        return field[: error.start].decode()


def _items(kind, form: str, payload: bytes, begin: int, count: int) -> tuple:
    size = struct.calcsize(form)
    return tuple(kind(*struct.unpack_from(form, payload, begin + size * i)) for i in range(count))


def _announce(payload: bytes) -> Announce:
    boot, sensor, kind, count = struct.unpack_from("<Q32s24sB3x", payload)
    topics = _items(Announced, "<BBHI", payload, 68, count)
    name = sensor.split(b"\0", 1)[0]
    _limit(1 <= len(name) <= 24 and name != b"robot" and all(c in _OF_NAMES for c in name))
    return Announce(boot, name.decode(), _text(kind), topics)


_OF_NAMES = b"abcdefghijklmnopqrstuvwxyz0123456789_-"


def _telegram(payload: bytes, number: int) -> Telegram:
    family = FAMILIES[number] if number < len(FAMILIES) else None
    if family != "lms":
        _limit(1 <= len(payload) <= 814)
        return Telegram(payload, family, len(payload) // _PACKET[family] if family in _PACKET else None)
    _limit(payload[:1] == b"\x02")
    (length,) = struct.unpack_from("<2xH", payload)
    _limit(length + 6 <= min(len(payload), 814))
    return Telegram(payload[: length + 6], family, None)


# Bytes of a packet.
_PACKET = {"ld": 47}


def _scan(payload: bytes) -> Scan:
    first, step, spacing, *numbers = struct.unpack_from("<ddfIiIHHHHHBBBBBxI12x", payload)
    beam_time_ns, first_beam_ns, unit_um, count, valid_to, no_return, beyond, collapsed = numbers[:8]
    family, flags, contents, intensity_bits, turns, turn_ns = numbers[8:]
    _limit(count <= 8192 and contents <= 7 and all(map(math.isfinite, (first, step, spacing))))
    # Exact angles, ranges, wide intensities, upper bits: those that there are.
    form = f"<{count * (contents >> 2 & 1)}f{count}H{count * (contents >> 1 & 1)}H{count * (contents & 1)}s"
    *values, upper = struct.unpack_from(form, payload, 64)
    exact = tuple(values[: count * (contents >> 2 & 1)])
    ranges = tuple(values[len(exact) : len(exact) + count])
    wide = tuple(values[len(exact) + count :]) if contents & 2 else tuple(upper)
    return Scan(
        FAMILIES[family] if family < len(FAMILIES) else None,
        unit_um,
        count,
        first,
        step,
        spacing,
        beam_time_ns,
        first_beam_ns,
        turns,
        turn_ns,
        valid_to,
        no_return,
        beyond,
        collapsed,
        bool(flags & 1),
        intensity_bits,
        exact,
        ranges,
        wide if intensity_bits else (),
        upper,
        payload,
    )


def _marks(payload: bytes) -> Marks:
    count, flags = struct.unpack_from("<BB2x", payload)
    _limit(count <= 64)
    return Marks(bool(flags & 1), bool(flags & 2), _items(Mark, "<iIHBBHH", payload, 4, count))


def _zones(payload: bytes) -> Zones:
    verdict, count, beam, distance_mm, invalid, flags = struct.unpack_from("<BBHIHBx", payload)
    _limit(count <= 8)
    zones = _items(lambda radius, beams, violated: Zone(radius, beams, violated == 1), "<HHB3x", payload, 12, count)
    nearest = (None, None) if beam == 0xFFFF else (beam, distance_mm)
    return Zones(VERDICTS[min(verdict, 3)], *nearest, invalid, bool(flags & 1), zones)


def _foreground(payload: bytes) -> Foreground:
    generation, unit_um, count, number, segments, left_out, supported = struct.unpack_from("<IIHHHHQ", payload)
    _limit(number <= count <= 8192 and segments <= 64 and supported >> segments == 0)
    size = (count + 7) // 8
    bits, *ranges = struct.unpack_from(f"<{size}s{number}H", payload, 24)
    beams = tuple(i for i in range(8 * size) if bits[i // 8] >> i % 8 & 1)
    support = (bool(supported >> i & 1) for i in range(segments))
    items = _items(
        lambda *fields: Segment(*fields, next(support)), "<HHHHii", payload, 24 + size + 2 * number, segments
    )
    _limit(len(beams) == number and all(beam < count for beam in beams))
    _limit(all(item.first <= item.last < count for item in items))
    return Foreground(generation, count, unit_um, left_out, beams, tuple(ranges), items)


def _background(payload: bytes) -> Background:
    first, step, generation, unit_um, taught, count, flags = struct.unpack_from("<ddIIHHB3x", payload)
    _limit(count <= 8192 and math.isfinite(first) and math.isfinite(step))
    ranges = struct.unpack_from(f"<{count}H", payload, 32)
    return Background(generation, taught, count, unit_um, first, step, bool(flags & 1), ranges)


def _status(payload: bytes) -> Status:
    state, mode, unit_mm, family, *numbers = struct.unpack_from("<BBBBIQIHH", payload)
    texts = struct.unpack_from("<24s128s160s", payload, 24)
    counters = dict(zip(COUNTERS, struct.unpack_from("<28Q", payload, 336)))
    x_m, y_m, yaw_rad, upside_down = struct.unpack_from("<dddB7x", payload, 560)
    return Status(
        STATES[state] if state < len(STATES) else None,
        mode,
        unit_mm,
        FAMILIES[family] if family < len(FAMILIES) else None,
        *numbers,
        *map(_text, texts),
        counters,
        Pose(x_m, y_m, yaw_rad, upside_down == 1),
    )


def _lines(payload: bytes) -> Lines:
    count, corners, flags, readings, on_lines, noise_m = struct.unpack_from("<BBBxHHf", payload)
    _limit(count <= 64 and corners <= 64)
    lines = _items(Line, "<8fHHH2x", payload, 12, count)
    meetings = _items(Corner, "<ffHH", payload, 12 + 40 * count, corners)
    _limit(math.isfinite(noise_m))
    _limit(all(math.isfinite(number) for line in lines for number in astuple(line)))
    _limit(all(math.isfinite(at.x_m) and math.isfinite(at.y_m) for at in meetings))
    _limit(all(max(at.first_line, at.second_line) < count for at in meetings))
    return Lines(bool(flags & 1), readings, on_lines, noise_m, lines, meetings)


def _motion(payload: bytes) -> Motion:
    *numbers, method, flags, breaks = struct.unpack_from("<3d13fBBH", payload)
    # Revision 1 ends here.
    of_pose = struct.unpack_from("<9f", payload, 80) if len(payload) >= 120 else (0.0,) * 9
    _limit(all(math.isfinite(number) for number in (*numbers, *of_pose)))
    method = METHODS[method] if method < len(METHODS) else "refused"
    valid = method != "refused" and not flags & 2
    return Motion(*numbers[:6], tuple(numbers[6:15]), numbers[15], method, valid, bool(flags & 1), breaks, of_pose)


def _early(payload: bytes) -> Early:
    verdict, flags, *numbers = struct.unpack_from("<BBHIHH", payload)
    _limit(verdict in (1, 2))
    return Early(VERDICTS[verdict], bool(flags & 1), *numbers)


def _tracks(payload: bytes) -> Tracks:
    count, sensors = struct.unpack_from("<BB6x", payload)
    _limit(count <= 64 and sensors <= 32)

    def track(*fields) -> Track:
        id, *numbers, score, age_ms, seen_by, room, state = fields
        _limit(all(math.isfinite(number) for number in (*numbers, score)) and not seen_by >> sensors)
        state = TRACK_STATES[state] if state < len(TRACK_STATES) else "tentative"
        return Track(id, *numbers[:4], tuple(numbers[4:]), score, age_ms, seen_by, _text(room), state)

    tracks = _items(track, "<Q7ffII24sB7x", payload, 8, count)

    def site(x_m, y_m, yaw_rad, upside_down, name) -> Site:
        _limit(all(math.isfinite(number) for number in (x_m, y_m, yaw_rad)))
        return Site(_text(name), x_m, y_m, yaw_rad, upside_down == 1)

    return Tracks(_items(site, "<3fB3x56s", payload, 8 + 80 * count, sensors), tracks)


def _events(payload: bytes) -> Event:
    id, kind, *texts = struct.unpack_from("<QB7x24s24s24s24s", payload)
    _limit(kind < len(EVENTS))
    room, *door = map(_text, texts)
    return Event(EVENTS[kind], id, room, *(door if EVENTS[kind] == "door" else ("", "", "")))


def _tilt(payload: bytes) -> Tilt:
    angle_rad, rate_rad_s = struct.unpack_from("<dd", payload)
    _limit(math.isfinite(angle_rad) and not math.isinf(rate_rad_s))
    return Tilt(angle_rad, rate_rad_s)


def _cloud(payload: bytes) -> Cloud:
    sweep, generation, count, flags = struct.unpack_from("<IIHB5x", payload)
    _limit(count <= 8192)

    def point(*fields) -> Point:
        *place, beam, number = fields
        _limit(all(math.isfinite(value) for value in place))
        return Point(*place, beam, POINT_CLASSES[number] if number < len(POINT_CLASSES) else "unknown")

    points = _items(point, "<fffHBx", payload, 16, count)
    return Cloud(sweep, generation, *(bool(flags & bit) for bit in (1, 2, 4, 8)), points)


def _obstacles(payload: bytes) -> Obstacles:
    sweep, generation, left_out, count, flags = struct.unpack_from("<IIIBB2x", payload)
    _limit(count <= 64)

    def obstacle(*fields) -> Obstacle:
        *numbers, points, bits = fields
        _limit(all(math.isfinite(value) for value in numbers))
        low_m, high_m = tuple(numbers[3:6]), tuple(numbers[6:9])
        return Obstacle(*numbers[:3], low_m, high_m, numbers[9], points, bool(bits & 1), bool(bits & 2))

    obstacles = _items(obstacle, "<10fIB3x", payload, 16, count)
    return Obstacles(sweep, generation, bool(flags & 4), bool(flags & 8), left_out, obstacles)


_UNPACK = (
    _announce,
    None,
    _scan,
    _marks,
    _zones,
    _foreground,
    _background,
    _status,
    _lines,
    _motion,
    _early,
    _tracks,
    _events,
    _tilt,
    _cloud,
    _obstacles,
)
