"""The datagrams of `scanhub gateway` for programs in Python: checks one, and tells what it says.

Refuses to know sockets and what is missing between two datagrams. Needs Python 3.9 and nothing else; with numpy the
ranges of a scan are a view into the datagram. docs/datagram.md has the bytes.

    import socket, struct, scanhub_lan

    listener = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    listener.bind(("", scanhub_lan.PORT))
    group = socket.inet_aton(scanhub_lan.group("scan"))
    listener.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, group + socket.inet_aton("0.0.0.0"))
    while True:
        try:
            datagram = scanhub_lan.read(listener.recv(2048))
            scan = datagram.unpack()
        except scanhub_lan.Refused:
            continue
        if datagram.topic == "scan":
            print(datagram.sensor, datagram.sequence, min(filter(None, scan.ranges_mm()), default=None))
"""

import hashlib
import hmac
import struct
from dataclasses import dataclass
from typing import Optional, Union

PORT = 22200
TOPICS = ("announce", "telegram", "scan", "marks", "zones", "foreground", "background", "status")
VERDICTS = ("clear", "slow", "stop", "unknown")
STATES = ("absent", "probing", "switching", "starting", "streaming", "silent", "paused")
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
    """A telegram of the sensor, STX to CRC, as it came."""

    telegram: bytes


@dataclass(frozen=True)
class Scan:
    """Ranges in device units (x `unit_mm` = mm) as they were sent: the nine greatest values are codes.

    Beam i looks to first_angle_mdeg + i * step_mdeg (1/1000 degree): counter-clockwise seen from above, 0 right, 90
    degrees ahead. `upper` are the bits above the range, empty if all are 0: intensities if `intensity_bits` is not 0.
    """

    count: int
    unit_mm: int
    range_bits: int
    first_angle_mdeg: int
    step_mdeg: int
    intensity_bits: int
    ranges: "tuple[int, ...]"
    upper: bytes
    payload: bytes

    def ranges_mm(self) -> "list[Optional[int]]":
        """The ranges in mm, None where there is no valid reading."""
        codes = (1 << self.range_bits) - 9
        return [value * self.unit_mm if value < codes else None for value in self.ranges]

    def view(self):
        """The ranges as a numpy array of the device's u16: a view into the datagram, not a copy."""
        import numpy

        return numpy.frombuffer(self.payload, dtype="<u2", count=self.count, offset=12)


@dataclass(frozen=True)
class Mark:
    """A reflector: angle in 1/1000 degree, range in 1/10 mm, sum and greatest of its intensities, its beams; `edge` is
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
    """Foreground beams that belong together: beams, device units, mm ahead and to the left of the robot's centre."""

    first: int
    last: int
    nearest: int
    width: int
    x_mm: int
    y_mm: int


@dataclass(frozen=True)
class Foreground:
    """What stands before the background: beams and their ranges in device units, and the segments that had room."""

    generation: int
    count: int
    unit_mm: int
    left_out: int
    beams: "tuple[int, ...]"
    ranges: "tuple[int, ...]"
    segments: "tuple[Segment, ...]"


@dataclass(frozen=True)
class Background:
    """Where each beam ends when nobody is there, in device units: 0 not learned, 65535 beyond the sensor's range."""

    generation: int
    taught: int
    count: int
    unit_mm: int
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


Payload = Union[Announce, Telegram, Scan, Marks, Zones, Foreground, Background, Status]


@dataclass(frozen=True)
class Datagram:
    """A datagram whose header, lengths and checksum are right.

    `hub` is the gateway, `epoch` its life (a greater one ends the one before), `sequence` the number among those of
    this sensor and topic (modulo 2^32: a gap is what was lost), `counter` the same in all that came from one telegram,
    `stamp_ns` the wall clock of the telegram's first byte. `authenticated`: a key was given, and the MAC is of it.
    """

    number: int
    flags: int
    hub: int
    epoch: int
    sequence: int
    stamp_ns: int
    sensor: int
    revision: int
    counter: int
    payload: bytes
    authenticated: bool

    @property
    def topic(self) -> Optional[str]:
        """Its name, None if it is not known here."""
        return TOPICS[self.number] if self.number < len(TOPICS) else None

    def unpack(self) -> Payload:
        """What the payload says; Refused: `skipped` if the topic is not known, `payload` if it contradicts itself."""
        if self.number >= len(TOPICS):
            raise Refused("skipped")
        if self.revision == 0:
            raise Refused("payload")
        try:
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
    if version != 1:
        raise Refused("version")
    if not 48 <= header <= len(data):
        raise Refused("header")
    hub, epoch, sequence, stamp_ns, sensor, length, revision, counter, crc = struct.unpack_from("<QIIQB3xHHII", data, 8)
    end = header + length
    if end + (16 if flags & AUTHENTICATED else 0) != len(data):
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
    return Datagram(
        number, flags, hub, epoch, sequence, stamp_ns, sensor, revision, counter, payload, authenticated
    )


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


def _telegram(payload: bytes) -> Telegram:
    stx, length = struct.unpack_from("<BxH", payload)
    _limit(stx == 0x02 and length + 6 <= min(len(payload), 814))
    return Telegram(payload[: length + 6])


def _scan(payload: bytes) -> Scan:
    count, unit_mm, range_bits, first, step, intensity_bits, contents = struct.unpack_from("<HBBiHBB", payload)
    _limit(count <= 401 and range_bits <= 16)
    ranges = struct.unpack_from(f"<{count}H", payload, 12)
    upper = b""
    if contents & 1:
        (upper,) = struct.unpack_from(f"<{count}s", payload, 12 + 2 * count)
    upper = upper if any(upper) else b""
    return Scan(count, unit_mm, range_bits, first, step, intensity_bits, ranges, upper, payload)


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
    generation, count, number, unit_mm, left_out, segments = struct.unpack_from("<IHHBBH", payload)
    _limit(number <= count <= 401 and segments <= 64)
    size = (count + 7) // 8
    bits, *ranges = struct.unpack_from(f"<{size}s{number}H", payload, 12)
    beams = tuple(i for i in range(8 * size) if bits[i // 8] >> i % 8 & 1)
    items = _items(Segment, "<HHHHii", payload, 12 + size + 2 * number, segments)
    _limit(len(beams) == number and all(beam < count for beam in beams))
    _limit(all(item.first <= item.last < count for item in items))
    return Foreground(generation, count, unit_mm, left_out, beams, tuple(ranges), items)


def _background(payload: bytes) -> Background:
    generation, taught, count, unit_mm, flags = struct.unpack_from("<IHHBB2x", payload)
    _limit(count <= 401)
    ranges = struct.unpack_from(f"<{count}H", payload, 12)
    return Background(generation, taught, count, unit_mm, bool(flags & 1), ranges)


def _status(payload: bytes) -> Status:
    state, *numbers = struct.unpack_from("<BBBxIQIHH", payload)
    texts = struct.unpack_from("<24s128s160s", payload, 24)
    counters = dict(zip(COUNTERS, struct.unpack_from("<28Q", payload, 336)))
    x_m, y_m, yaw_rad, upside_down = struct.unpack_from("<dddB7x", payload, 560)
    return Status(
        STATES[state] if state < len(STATES) else None,
        *numbers,
        *map(_text, texts),
        counters,
        Pose(x_m, y_m, yaw_rad, upside_down == 1),
    )


_UNPACK = (_announce, _telegram, _scan, _marks, _zones, _foreground, _background, _status)
