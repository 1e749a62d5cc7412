"""What the topics carry, as it lies in shared memory: numbers are read in place, arrays are views, nothing is copied
before it is asked for. Refuses to know how a sample came here.

A sample keeps its place in the hub's memory as long as it, or a view that was made of it, is in use. There are four of
them for each topic that is followed; `copy()` makes one that needs none.
"""

from __future__ import annotations

import ctypes
from typing import Any, ClassVar, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from . import layout

Self = TypeVar("Self", bound="Sample")


class Chunk(Protocol):
    """Where a sample lies."""

    header: layout.Header

    def data(self) -> Any:
        """The payload as an array of bytes, which keeps the place."""


class Copied:
    """Header and payload in memory of their own."""

    def __init__(self, header: layout.Header, data: Any) -> None:
        self.header = layout.Header.from_buffer_copy(header)
        self._data = type(data).from_buffer_copy(data)

    def data(self) -> Any:
        return self._data


class Sample:
    """What all samples have: who sent it, and the numbers, stamps and quality of its telegram.

    `missed` samples of this topic were sent before this one and not received; `restarted`: another hub than that of the
    sample before sent it, and its numbers began again.
    """

    topic: ClassVar[str]
    struct: ClassVar[Any]
    """What is at the beginning."""
    element: ClassVar[Any] = None
    """What a slice of it is made of; None: every sample is a `struct`, and nothing else."""
    _read: Any = None

    def __init__(self, sensor: str, chunk: Chunk, missed: int = 0, restarted: bool = False) -> None:
        self.sensor = sensor
        self.missed = missed
        self.restarted = restarted
        self._header = chunk.header
        self._chunk = chunk

    def copy(self: Self) -> Self:
        """The same in memory of its own: may be kept for as long as you like."""
        return type(self)(self.sensor, Copied(self._header, self._data), self.missed, self.restarted)

    def copy_of_header(self) -> layout.Header:
        """Numbers, stamps and flags as they lie in memory."""
        return layout.Header.from_buffer_copy(self._header)

    @property
    def _data(self) -> Any:
        return self._chunk.data()

    @property
    def _fields(self) -> Any:
        if self._read is None:
            data = self._data
            # A stranger's may be shorter: then there is nothing.
            self._read = self.struct.from_buffer(data) if len(data) >= ctypes.sizeof(self.struct) else self.struct()
        return self._read

    @property
    def seq(self) -> int:
        """Number of the telegram, per sensor and hub life, from 0; in a status that of the last one."""
        return self._header.seq

    @property
    def topic_seq(self) -> int:
        """Number of the sample in its topic, from 0: a gap is what was missed."""
        return self._header.topic_seq

    @property
    def stamp_ns(self) -> int:
        """When the telegram's first byte came: ns of CLOCK_MONOTONIC, that is of `time.monotonic_ns()`."""
        return self._header.stamp_first_ns

    @property
    def stamp_last_ns(self) -> int:
        """When its last byte came."""
        return self._header.stamp_last_ns

    @property
    def wall_ns(self) -> int:
        """The wall clock of the first byte, ns since 1970."""
        return self._header.wall_ns

    @property
    def boot(self) -> int:
        """Random per start of the hub."""
        return self._header.boot

    @property
    def quality(self) -> str:
        """`clean`, or `suspect`: something around the telegram was wrong."""
        return "suspect" if self._header.quality else "clean"

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why it is suspect."""
        return tuple(name for bit, name in enumerate(_REASONS) if self._header.reasons >> bit & 1)

    @property
    def flags(self) -> frozenset[str]:
        """Of `simulated`, `replayed`, `stamp_estimated` and `remote` what holds."""
        return frozenset(name for bit, name in _FLAGS.items() if self._header.flags & bit)

    @property
    def period_us(self) -> int | None:
        """Nominal time between two samples of a scan; None if it is not known."""
        return self._header.period_us or None

    @property
    def hub_time_ns(self) -> int | None:
        """From the last byte until the sample was sent, in steps of 256 ns; None if not told, or more than 4 s."""
        units = int.from_bytes(bytes(self._header.hub_time), "little")
        return 256 * units if 0 < units < 0xFFFFFF else None

    def __repr__(self) -> str:
        return f"<{self.sensor}/{self.topic} {self.topic_seq}, {self.quality}>"


def view(data: Any, kind: str | np.dtype[Any], offset: int, count: int) -> NDArray[Any]:
    """The `count` items at `offset` in `data`, as far as they are there: cannot be written, and keeps what `data` keeps."""
    room = max(len(data) - offset, 0) // np.dtype(kind).itemsize
    return np.frombuffer(memoryview(data).toreadonly(), kind, min(count, room), min(offset, len(data)))


def in_mm(micrometres: int) -> float:
    """A whole number where it is one."""
    return micrometres / 1000 if micrometres % 1000 else micrometres // 1000


_REASONS = ("line_error", "neighbour", "slow", "forbidden_bits", "header_inside")
_FLAGS = {2: "simulated", 4: "replayed", 8: "stamp_estimated", 32: "remote"}
