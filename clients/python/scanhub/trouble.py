"""What goes wrong with shared memory, sorted by what there is to do: come back later, or tell the user, in words. The
library itself says no more than a name."""

from __future__ import annotations

import ctypes
import glob
import importlib.metadata
import os
import re
import resource
from typing import Any

from . import layout
from .directory import directory_of
from .errors import Denied, Failure, Mismatch, Short, Taken
from .names import Domain


def check_absent(domain: Domain, name: str, ours: str, what: str) -> None:
    """A service that is not there, or just being made or removed, is nothing; all else is raised."""
    if what in _ABSENT:
        return
    if what in _OTHER:
        raise _mismatch(domain, name, ours)
    if what == "ExceedsMaxNumberOfNodes":
        raise Short(f"{name} has no place for another process", "stop some consumers")
    raise broken(domain, f"{name}: {what}")


def check_in_flux(domain: Domain, name: str, ours: str, what: str, is_late: bool) -> None:
    """A service that is just being made or removed by others may be made soon, unless it `is_late`; all else is raised."""
    kind = re.sub(r"^\w+\((\w+)\)$", r"\1", what)
    if kind not in _IN_FLUX:
        check_absent(domain, name, ours, kind)
    if is_late:
        raise Failure(f"{name} cannot be created", "remove what is left of it")


def no_port(name: str, what: str) -> Failure:
    """Why there is no port."""
    if "Publishers" in what:
        return Taken(f"{name} has a publisher already", "end it, or choose another name")
    if "ExceedsMaxSupported" in what:
        return Short(
            f"{name} has no place for another consumer", "stop some; those that crashed free theirs in seconds"
        )
    return Short(f"no port at {name}: {what}", "`ulimit -n` or /dev/shm may be too small")


def broken(domain: Domain, what: str) -> Failure:
    """Why something failed in a domain: it is another user's, or something is short, or else `what`."""
    try:
        check_room()
        directory = directory_of(domain)
        if directory:
            with directory:
                pass
    except (Short, Denied) as failure:
        return failure
    except OSError:
        pass
    return Failure(what, "IOX2_LOG_LEVEL=debug shows the messages of the shared-memory library")


def check_room(descriptors: int = 8, size: int = 64 * 1024) -> None:
    """Refuses to make one more port where there is no room for it: the library would make one that gets nothing, or
    end the process. What one takes, with some to spare, if no more is said. Short."""
    try:
        opened = len(os.listdir("/proc/self/fd"))
    except FileNotFoundError:
        opened = 0
    limit = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    if limit != resource.RLIM_INFINITY and limit - opened < descriptors:
        what = f"descriptors are short: {opened} are open, {descriptors} more needed, the limit is {limit}"
        raise Short(what, "raise the limit: `ulimit -n`, for a service LimitNOFILE")
    memory = os.statvfs("/dev/shm")
    free = memory.f_bavail * memory.f_frsize
    if memory.f_blocks and free < size:
        what = f"shared memory is short: /dev/shm: {free // 1024} kB free, {-(-size // 1024)} kB needed"
        raise Short(what, "free some of /dev/shm, then start again")


def types(struct: Any) -> str:
    """What this program reads, in words: `struct`, or bytes, under the header."""
    payload = struct.type_name() if hasattr(struct, "type_name") else "u8"
    return _words(payload, ctypes.sizeof(struct), layout.Header.type_name(), ctypes.sizeof(layout.Header))


def _words(payload: str, size: object, header: str, header_size: object) -> str:
    return f"{payload} of {size} bytes under {header} of {header_size}"


def _mismatch(domain: Domain, name: str, ours: str) -> Mismatch:
    """Says what both sides have. That of the maker stands in a file of the service."""
    theirs = "something else"
    for path in glob.glob(f"{glob.escape(domain.root)}/services/{domain.prefix}*.service"):
        try:
            with open(path, encoding="utf-8") as file:
                written = file.read()
        except (OSError, UnicodeDecodeError):
            continue
        if f'service_name = "{name}"' not in written:
            continue
        version = ".".join(re.findall(r"^(?:major|minor|patch) = (\d+)$", written, re.M))
        of = {part: (kind, size) for part, kind, size in _TYPES.findall(written)}
        if {"payload", "user_header"} <= of.keys():
            theirs = _words(*of["payload"], *of["user_header"]) + f", by iceoryx2 {version}"
    what = f"{name}: there is {theirs}; this program reads {ours}, by iceoryx2 {_installed()}"
    return Mismatch(
        what, "hub and client are of different versions: install the scanhub package that came with the hub"
    )


def _installed() -> str:
    try:
        return importlib.metadata.version("iceoryx2")
    except importlib.metadata.PackageNotFoundError:
        return "of unknown version"


_TYPES = re.compile(r'message_type_details\.(\w+)\]\s+variant = "\w+"\s+type_name = "([^"]*)"\s+size = (\d+)')
_ABSENT = {"DoesNotExist", "HangsInCreation", "IsMarkedForDestruction", "Interrupt", "ServiceInCorruptedState"}
_IN_FLUX = _ABSENT | {"AlreadyExists", "IsBeingCreatedByAnotherInstance", "SystemInFlux"}
_OTHER = {"IncompatibleTypes", "IncompatiblePayload", "IncompatibleMessagingPattern", "VersionMismatch"}
