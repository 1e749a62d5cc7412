"""Locks of the publishers in a domain: one process publishes under each name, and its lock ends with it. The files are
those of the hub (schema/shm/src/processes.rs)."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import struct
from typing import Iterator

from .directory import directory_of, made_directory
from .errors import Taken
from .names import Domain


class NameLock:
    """The lock of the process that publishes under a name. There need not be a hub. Taken, Denied, OSError."""

    def __init__(self, domain: Domain, name: str) -> None:
        self._file = _acquire(domain, name)
        _of_names.add(self._file)
        try:
            os.ftruncate(self._file, 0)
            os.pwrite(self._file, b"%d\n" % os.getpid(), 0)
        except BaseException:
            self.release()
            raise

    def release(self) -> None:
        """Gives the name free. Closing is not enough: a process that is just being started has a copy of the descriptor."""
        fcntl.fcntl(self._file, fcntl.F_OFD_SETLK, _whole_file(fcntl.F_UNLCK))
        _of_names.discard(self._file)
        os.close(self._file)


_of_names: set[int] = set()
"""Descriptors of the names that this process has."""


def _leave_the_parents() -> None:
    """A copy in a child would keep a name taken when the parent is killed."""
    while _of_names:
        os.close(_of_names.pop())


os.register_at_fork(after_in_child=_leave_the_parents)


@contextlib.contextmanager
def making(domain: Domain) -> Iterator[None]:
    """Held while services are made in a domain; nobody holds it for longer than that takes."""
    with made_directory(domain) as directory:
        file = directory.file_or_new("making.lock")
    try:
        fcntl.fcntl(file, fcntl.F_OFD_SETLKW, _whole_file(fcntl.F_WRLCK))
        yield
    finally:
        fcntl.fcntl(file, fcntl.F_OFD_SETLK, _whole_file(fcntl.F_UNLCK))
        os.close(file)


def holder(domain: Domain, lock: str) -> int | None:
    """The process that holds `hub.lock` or `listen.lock`, nothing if none does; 0 if it has not written yet who it is.
    Denied."""
    directory = directory_of(domain)
    if directory is None:
        return None
    with directory:
        file = directory.file(lock)
    if file is None:
        return None
    try:
        asked = fcntl.fcntl(file, fcntl.F_OFD_GETLK, _whole_file(fcntl.F_RDLCK))
        return None if struct.unpack(_FLOCK, asked)[0] == fcntl.F_UNLCK else _written(file)
    finally:
        os.close(file)


def is_held(domain: Domain) -> bool:
    """Whether a hub or a listener is there, also one that is just starting. Denied, OSError."""
    return any(holder(domain, lock) is not None for lock in ("hub.lock", "listen.lock"))


def _acquire(domain: Domain, name: str) -> int:
    while True:
        with made_directory(domain) as directory:
            file = directory.file_or_new(f"name.{name}.lock")
        try:
            fcntl.fcntl(file, fcntl.F_OFD_SETLK, _whole_file(fcntl.F_WRLCK))
        except OSError as error:
            pid = _written(file)
            os.close(file)
            if error.errno not in (errno.EAGAIN, errno.EACCES):
                raise
            raise name_held(name, pid) from None
        # Whoever held it until now may have taken the domain away, and the next one would lock another file.
        if os.fstat(file).st_nlink > 0:
            return file
        os.close(file)


def name_held(name: str, pid: int) -> Taken:
    """Returns the error if process `pid` publishes under `name`."""
    process = f"process {pid}" if pid else "another process"
    with contextlib.suppress(OSError), open(f"/proc/{pid}/comm", encoding="utf-8", errors="replace") as program:
        process += f" ({program.read().strip()})"
    return Taken(f"the name {name} is published by {process}", "end it, or choose another name")


def _written(file: int) -> int:
    """The lock itself tells no process, the file's content does."""
    lines = os.pread(file, 32, 0).split()
    return int(lines[0]) if lines and lines[0].isdigit() else 0


def _whole_file(kind: int) -> bytes:
    return struct.pack(_FLOCK, kind, os.SEEK_SET, 0, 0, 0)


_FLOCK = "hhqqi0q"
"""struct flock: kind, whence, start, length (0: the whole file), process."""
