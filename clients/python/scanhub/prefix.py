"""Prefix of the names of a domain's shared memory: `sh_DOMAIN_`, then a random word. It is stored in the file `prefix`
of the domain's directory while any process uses the domain. The rules are those of the hub
(schema/shm/src/segments.rs)."""

from __future__ import annotations

import os
import re
import secrets

from .directory import Directory, directory_of, made_directory
from .errors import Failure
from .names import Domain


def of(domain: Domain) -> str | None:
    """How the names begin, or nothing as long as the domain has none; Denied."""
    directory = directory_of(domain)
    if directory is None:
        return None
    with directory:
        return _read(domain, directory)


def settle(domain: Domain) -> None:
    """Makes sure that the domain has one; only for who holds its lock `making`. Denied, Failure."""
    with made_directory(domain) as directory:
        if _read(domain, directory) is not None:
            return
        # Nobody can make files of all names; those of some may be there.
        tried = (f"{domain.prefix}{_word()}_" for _ in range(_TRIES))
        taken = os.listdir(_SHARED_MEMORY)
        free = (prefix for prefix in tried if not any(name.startswith(prefix) for name in taken))
        prefix = next(free, None)
        if prefix is None:
            what = f"{_SHARED_MEMORY} is full of files that start with {domain.prefix}"
            raise Failure(what, "have them removed, or choose another domain")
        directory.replace(_FILE, f"{prefix}\n".encode())


def forget(domain: Domain) -> None:
    """Takes it away where nobody is left; only for who holds the lock `making`."""
    directory = directory_of(domain)
    if directory is not None:
        with directory:
            directory.remove(_FILE)


def _read(domain: Domain, directory: Directory) -> str | None:
    """What is not of this form was not written by a hub, and counts as none."""
    file = directory.file(_FILE)
    if file is None:
        return None
    with open(file, "rb") as opened:
        written = opened.read(64)
    is_one = re.fullmatch(domain.prefix.encode() + rb"[0-9a-z]{5}_\n", written)
    return written[:-1].decode() if is_one else None


def _word() -> str:
    return "".join(secrets.choice(_LETTERS) for _ in range(5))


_FILE = "prefix"
_SHARED_MEMORY = "/dev/shm"
_LETTERS = "0123456789abcdefghijklmnopqrstuvwxyz"
_TRIES = 16
