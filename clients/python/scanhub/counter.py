"""The one segment that the shared-memory library would open to all users: its counter of nodes. Made or checked here
before the library looks for it, as the hub does (schema/shm/src/segments.rs)."""

from __future__ import annotations

import os
import stat
import threading

from .errors import Denied


def ensure(prefix: str) -> None:
    """Makes sure that the counter under `prefix` is there and this user's alone; Denied."""
    path = _path(prefix)
    beside = f"{path}.new-{os.getpid()}-{threading.get_ident()}"
    while True:
        try:
            seen = os.lstat(path)
        except FileNotFoundError:
            descriptor = os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
            try:
                os.write(descriptor, _CONTENT)
                os.link(beside, path)
            except FileExistsError:
                pass
            finally:
                os.close(descriptor)
                os.unlink(beside)
            continue
        if stat.S_ISREG(seen.st_mode) and seen.st_uid == os.geteuid() and not seen.st_mode & 0o022:
            return
        what = f"{path} belongs to user {seen.st_uid} with mode {seen.st_mode & 0o7777:04o}: it is in the way"
        raise Denied(what, f"let its owner or an administrator remove it: sudo rm {path}")


def remove(prefix: str) -> None:
    """Removes the counter under `prefix`, which nobody needs any more."""
    try:
        os.unlink(_path(prefix))
    except FileNotFoundError:
        pass


def _path(prefix: str) -> str:
    return f"/dev/shm/{prefix}{_NAME}"


_NAME = "9204dd183d1c4d8e1ff592a30766ffa6765aa8b5_node.0_10_0.global_mgmt"
_CONTENT = (10 << 16).to_bytes(8, "little") + bytes(8)
"""The library's version as it packs it, then the counter."""
