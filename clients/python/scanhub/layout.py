"""The structs of docs/topics.md, version 2, field by field, as they lie in shared memory. Refuses to know what they
mean."""

from __future__ import annotations

import ctypes
from ctypes import c_double, c_float, c_int32, c_uint8, c_uint16, c_uint32, c_uint64

BEAMS = 8192
"""The most beams of a scan."""


class _Struct(ctypes.LittleEndianStructure):
    @classmethod
    def type_name(cls) -> str:
        """The name that both sides of a service compare."""
        return f"scanhub.{cls.__name__.removesuffix('Word')}.v2"


class Header(_Struct):
    _fields_ = [
        ("seq", c_uint64),
        ("topic_seq", c_uint64),
        ("stamp_first_ns", c_uint64),
        ("stamp_last_ns", c_uint64),
        ("wall_ns", c_uint64),
        ("boot", c_uint64),
        ("sensor", c_uint8),
        ("quality", c_uint8),
        ("flags", c_uint8),
        ("family", c_uint8),
        ("period_us", c_uint32),
        ("hub_pid", c_uint32),
        ("reasons", c_uint8),
        ("hub_time", c_uint8 * 3),
    ]


class ScanHead(_Struct):
    """Behind it `count` values of each array that there is: exact angles, ranges, wide intensities, upper bits."""

    _fields_ = [
        ("first_angle", c_double),
        ("step", c_double),
        ("spacing", c_float),
        ("beam_time_ns", c_uint32),
        ("first_beam_ns", c_int32),
        ("unit_um", c_uint32),
        ("count", c_uint16),
        ("valid_to", c_uint16),
        ("no_return", c_uint16),
        ("beyond", c_uint16),
        ("collapsed", c_uint16),
        ("family", c_uint8),
        ("flags", c_uint8),
        ("contents", c_uint8),
        ("intensity_bits", c_uint8),
        ("turns", c_uint8),
        ("reserved", c_uint8),
        ("turn_ns", c_uint32),
        ("reserved2", c_uint8 * 12),
    ]


class ScanWord(_Struct):
    """Eight bytes of a scan: in shared memory it is a slice of them."""

    _fields_ = [("word", c_uint64)]


class Mark(_Struct):
    _fields_ = [
        ("angle_mdeg", c_int32),
        ("range_dmm", c_uint32),
        ("weight", c_uint16),
        ("peak", c_uint8),
        ("edge", c_uint8),
        ("first_beam", c_uint16),
        ("last_beam", c_uint16),
    ]


class Marks(_Struct):
    _fields_ = [("count", c_uint8), ("flags", c_uint8), ("reserved", c_uint16), ("mark_array", Mark * 64)]


class Line(_Struct):
    _fields_ = [
        ("x1_m", c_float),
        ("y1_m", c_float),
        ("x2_m", c_float),
        ("y2_m", c_float),
        ("r_m", c_float),
        ("alpha_rad", c_float),
        ("sd_r_m", c_float),
        ("sd_alpha_rad", c_float),
        ("first", c_uint16),
        ("last", c_uint16),
        ("points", c_uint16),
        ("reserved", c_uint16),
    ]


class Corner(_Struct):
    _fields_ = [("x_m", c_float), ("y_m", c_float), ("first_line", c_uint16), ("second_line", c_uint16)]


class Lines(_Struct):
    _fields_ = [
        ("count", c_uint8),
        ("corners", c_uint8),
        ("flags", c_uint8),
        ("reserved", c_uint8),
        ("readings", c_uint16),
        ("on_lines", c_uint16),
        ("noise_m", c_float),
        ("line_array", Line * 64),
        ("corner_array", Corner * 64),
    ]


class Motion(_Struct):
    _fields_ = [
        ("x_m", c_double),
        ("y_m", c_double),
        ("yaw_rad", c_double),
        ("dx_m", c_float),
        ("dy_m", c_float),
        ("dyaw_rad", c_float),
        ("covariance", c_float * 9),
        ("overlap", c_float),
        ("method", c_uint8),
        ("flags", c_uint8),
        ("breaks", c_uint16),
        ("pose_covariance", c_float * 9),
        ("reserved", c_uint32),
    ]


class Early(_Struct):
    _fields_ = [
        ("verdict", c_uint8),
        ("flags", c_uint8),
        ("beam", c_uint16),
        ("distance_mm", c_uint32),
        ("bytes_seen", c_uint16),
        ("beams_seen", c_uint16),
    ]


class Track(_Struct):
    _fields_ = [
        ("id", c_uint64),
        ("x_m", c_float),
        ("y_m", c_float),
        ("vx_m_s", c_float),
        ("vy_m_s", c_float),
        ("covariance", c_float * 3),
        ("score", c_float),
        ("age_ms", c_uint32),
        ("sensors", c_uint32),
        ("room_text", c_uint8 * 24),
        ("state", c_uint8),
        ("reserved", c_uint8 * 7),
    ]


class TrackSensor(_Struct):
    _fields_ = [
        ("x_m", c_float),
        ("y_m", c_float),
        ("yaw_rad", c_float),
        ("upside_down", c_uint8),
        ("reserved", c_uint8 * 3),
        ("name_text", c_uint8 * 56),
    ]


class Tracks(_Struct):
    _fields_ = [
        ("count", c_uint8),
        ("sensors", c_uint8),
        ("reserved", c_uint8 * 6),
        ("track_array", Track * 64),
        ("sensor_array", TrackSensor * 32),
    ]


class Event(_Struct):
    _fields_ = [
        ("id", c_uint64),
        ("kind", c_uint8),
        ("reserved", c_uint8 * 7),
        ("room_text", c_uint8 * 24),
        ("door_text", c_uint8 * 24),
        ("from_text", c_uint8 * 24),
        ("to_text", c_uint8 * 24),
    ]


class Tilt(_Struct):
    _fields_ = [("angle_rad", c_double), ("rate_rad_s", c_double)]


class CloudHead(_Struct):
    """Behind it the points."""

    _fields_ = [
        ("sweep", c_uint32),
        ("generation", c_uint32),
        ("count", c_uint16),
        ("flags", c_uint8),
        ("reserved", c_uint8 * 5),
    ]


class CloudWord(_Struct):
    """Eight bytes of a cloud."""

    _fields_ = [("word", c_uint64)]


class CloudPoint(_Struct):
    _fields_ = [("at", c_float * 3), ("beam", c_uint16), ("point_class", c_uint8), ("reserved", c_uint8)]


class Obstacle(_Struct):
    _fields_ = [
        ("middle", c_float * 3),
        ("low", c_float * 3),
        ("high", c_float * 3),
        ("distance_m", c_float),
        ("points", c_uint32),
        ("flags", c_uint8),
        ("reserved", c_uint8 * 3),
    ]


class Obstacles(_Struct):
    _fields_ = [
        ("sweep", c_uint32),
        ("generation", c_uint32),
        ("left_out", c_uint32),
        ("count", c_uint8),
        ("flags", c_uint8),
        ("reserved", c_uint8 * 2),
        ("obstacle_array", Obstacle * 64),
    ]


class Zone(_Struct):
    _fields_ = [("radius_mm", c_uint16), ("beams", c_uint16), ("violated", c_uint8), ("reserved", c_uint8 * 3)]


class Zones(_Struct):
    _fields_ = [
        ("verdict", c_uint8),
        ("count", c_uint8),
        ("nearest_beam", c_uint16),
        ("nearest_mm", c_uint32),
        ("invalid_beams", c_uint16),
        ("flags", c_uint8),
        ("reserved", c_uint8),
        ("zone_array", Zone * 8),
    ]


class Segment(_Struct):
    _fields_ = [
        ("first", c_uint16),
        ("last", c_uint16),
        ("nearest", c_uint16),
        ("width", c_uint16),
        ("x_mm", c_int32),
        ("y_mm", c_int32),
    ]


class ForegroundHead(_Struct):
    """Behind it 64 segments, a bit for every beam of the scan in pairs of bytes, and a range for every beam."""

    _fields_ = [
        ("generation", c_uint32),
        ("unit_um", c_uint32),
        ("count", c_uint16),
        ("beams", c_uint16),
        ("segments", c_uint16),
        ("left_out", c_uint16),
        ("supported", c_uint64),
    ]


class ForegroundWord(_Struct):
    """Eight bytes of a foreground."""

    _fields_ = [("word", c_uint64)]


class BackgroundHead(_Struct):
    """Behind it a range for every beam."""

    _fields_ = [
        ("first_angle", c_double),
        ("step", c_double),
        ("generation", c_uint32),
        ("unit_um", c_uint32),
        ("taught", c_uint16),
        ("count", c_uint16),
        ("flags", c_uint8),
        ("reserved", c_uint8 * 3),
    ]


class BackgroundWord(_Struct):
    """Eight bytes of a background."""

    _fields_ = [("word", c_uint64)]


class Pose(_Struct):
    _fields_ = [
        ("x_m", c_double),
        ("y_m", c_double),
        ("yaw_rad", c_double),
        ("upside_down", c_uint8),
        ("reserved", c_uint8 * 7),
    ]


class Status(_Struct):
    _fields_ = [
        ("state", c_uint8),
        ("mode", c_uint8),
        ("unit_mm", c_uint8),
        ("family", c_uint8),
        ("baud", c_uint32),
        ("since_ns", c_uint64),
        ("rate_mhz", c_uint32),
        ("angle_deg", c_uint16),
        ("resolution_cdeg", c_uint16),
        ("type_text", c_uint8 * 24),
        ("port_text", c_uint8 * 128),
        ("last_error_text", c_uint8 * 160),
        ("counters", c_uint64 * 28),
        ("pose", Pose),
    ]


def text(field: ctypes.Array[c_uint8]) -> str:
    """A text that is filled up with 0; a character that was cut at its end is left out."""
    return bytes(field).split(b"\0", 1)[0].decode(errors="ignore")
