"""The doorbell of a sensor, a page in shared memory: "The doorbell" in docs/topics.md. A publisher rings its words, on
which subscribers in Rust and C sleep. A subscriber announces itself there."""

from __future__ import annotations

import ctypes
import errno
import mmap
import os
import platform
import stat

from .errors import Denied, Failure, Short


def announce(prefix: str, sensor: str) -> None:
    """Counts at the doorbell of `sensor` that this process has attached to one of its services, so that the hub sends it
    the next sample. Where this is not possible, the hub finds the subscriber after a tenth of a second."""
    futex = _FUTEX.get(platform.machine())
    if futex is None:
        return
    try:
        file = os.open(f"/dev/shm/{prefix}{sensor}.bell", os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError:
        return
    try:
        seen = os.fstat(file)
        is_ours = stat.S_ISREG(seen.st_mode) and seen.st_uid == os.geteuid() and not seen.st_mode & 0o022
        if is_ours and seen.st_size >= _PAGE:
            _count(futex, (ctypes.c_uint32 * (_PAGE // 4)).from_buffer(mmap.mmap(file, _PAGE)), _ATTACHED)
    except OSError:
        pass
    finally:
        os.close(file)


class Ringer:
    """The bell of a name: that of a publisher that was killed, which its consumers still have, else a new one. Denied if
    the place is taken by another user, Short if there is no memory for it."""

    def __init__(self, prefix: str, name: str) -> None:
        self._futex = _FUTEX.get(platform.machine())
        if self._futex is None:
            raise Failure(f"no way to wake consumers on {platform.machine()}", "publish from Rust or C there")
        self._path = f"/dev/shm/{prefix}{name}.bell"
        self._words = _opened(self._path)
        while self._words[_CLOSED]:
            # Whose publisher was killed while it ended: nobody may wait at it any more.
            os.unlink(self._path)
            self._words = _opened(self._path)

    def ring(self) -> None:
        """Counts one more and wakes all who sleep at the word of the topics that are no link's."""
        _count(self._futex, self._words, _LAST)

    def close(self) -> None:
        """Says that nobody rings any more, and wakes all once more."""
        self._words[_CLOSED] = 1
        for word in (_FIRST, _LAST, _EARLY):
            _count(self._futex, self._words, word)
        try:
            os.unlink(self._path)
        except FileNotFoundError:
            pass


def _count(futex: int, words: ctypes.Array[ctypes.c_uint32], word: int) -> None:
    """Adds 1 to a word and wakes all threads that sleep at it, in one system call (FUTEX_WAKE_OP). A process that sees
    the new number also sees what was sent or attached before."""
    address = ctypes.c_void_p(ctypes.addressof(words) + 4 * word)
    _syscall(ctypes.c_long(futex), address, _WAKE_OP, _ALL, None, address, _ADD_ONE)


def _opened(path: str) -> ctypes.Array[ctypes.c_uint32]:
    """The words of the page at `path`, made if there is none."""
    try:
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o600)
    except OSError as error:
        if error.errno not in (errno.ELOOP, errno.EACCES, errno.ENXIO):
            raise
        raise _in_the_way(path, os.lstat(path)) from None
    try:
        seen = os.fstat(file)
        if not stat.S_ISREG(seen.st_mode) or seen.st_uid != os.geteuid() or seen.st_mode & 0o022:
            raise _in_the_way(path, seen)
        os.posix_fallocate(file, 0, _PAGE)
        page = mmap.mmap(file, _PAGE)
    except OSError as error:
        if error.errno != errno.ENOSPC:
            raise
        what = f"shared memory is short: /dev/shm: no room for {path}: {_PAGE // 1024} kB"
        raise Short(what, "free some of /dev/shm, then start again") from None
    finally:
        os.close(file)
    return (ctypes.c_uint32 * (_PAGE // 4)).from_buffer(page)


def _in_the_way(path: str, seen: os.stat_result) -> Denied:
    what = f"{path} belongs to user {seen.st_uid} with mode {seen.st_mode & 0o7777:04o}: it is in the way"
    return Denied(what, f"let its owner or an administrator remove it: sudo rm {path}")


_PAGE = 4096
_FIRST, _ATTACHED, _CLOSED, _LAST, _EARLY = 0, 1, 16, 32, 48
"""Positions of the words, of four bytes each."""
_FUTEX = {"x86_64": 202, "aarch64": 98, "riscv64": 98}
"""Number of the call futex(2) by the machine."""
_WAKE_OP = ctypes.c_int(5)
_ALL = ctypes.c_int(2**31 - 1)
_ADD_ONE = ctypes.c_uint32(1 << 28 | 1 << 12)
"""FUTEX_OP(FUTEX_OP_ADD, 1, FUTEX_OP_CMP_EQ, 0)."""
_syscall = ctypes.CDLL(None).syscall
_syscall.restype = ctypes.c_long
