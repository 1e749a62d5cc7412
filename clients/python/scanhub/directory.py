"""The directory of a domain. It is opened step by step from the root of the file system, and its files relative to it.
So another user cannot replace it.

The rules are those of the hub (schema/shm/src/directory.rs). Base and domain belong to this user, and no other user can
write there. Links are followed only above them, if root or this user made the links.
"""

from __future__ import annotations

import errno
import os
import pwd
import stat

from .errors import Denied
from .names import Domain


class Directory:
    """An open directory that this user owns; closed by `with`."""

    def __init__(self, descriptor: int, path: str) -> None:
        self._descriptor = descriptor
        self._path = path

    def __enter__(self) -> Directory:
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._descriptor)

    def file(self, name: str) -> int | None:
        """A descriptor of the file `name` to read, or nothing if there is none; Denied if it is another user's, a link
        or no file."""
        try:
            return self._open(name, os.O_RDONLY)
        except FileNotFoundError:
            return None

    def file_or_new(self, name: str) -> int:
        """A descriptor of the file `name` to read and write, made for this user alone if there is none; Denied as
        `file`."""
        return self._open(name, os.O_RDWR | os.O_CREAT)

    def replace(self, name: str, content: bytes) -> None:
        """Puts a file `name` with this content there in one step: a reader sees the old or the new one."""
        beside = f"{name}.new"
        file = self.file_or_new(beside)
        try:
            os.ftruncate(file, 0)
            os.pwrite(file, content, 0)
        finally:
            os.close(file)
        os.rename(beside, name, src_dir_fd=self._descriptor, dst_dir_fd=self._descriptor)

    def remove(self, name: str) -> None:
        """Removes the file `name`, if it is there."""
        try:
            os.unlink(name, dir_fd=self._descriptor)
        except FileNotFoundError:
            pass

    def _open(self, name: str, how: int) -> int:
        path, flags = os.path.join(self._path, name), how | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
        try:
            opened = os.open(name, flags, 0o600, dir_fd=self._descriptor)
        except OSError as error:
            if error.errno != errno.ELOOP:
                raise
            raise _planted(path, "is a link") from None
        seen = os.fstat(opened)
        if stat.S_ISREG(seen.st_mode) and seen.st_uid == os.geteuid():
            return opened
        os.close(opened)
        raise _planted(path, f"belongs to user {seen.st_uid} or is no file")


def directory_of(domain: Domain) -> Directory | None:
    """The directory of `domain`, or nothing if there is none; Denied if it is another user's, or can be replaced."""
    return _walk(domain, make=False)


def made_directory(domain: Domain) -> Directory:
    """The same; what is missing is made for this user alone."""
    made = _walk(domain, make=True)
    if made is None:
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), domain.root)
    return made


def _walk(domain: Domain, make: bool) -> Directory | None:
    steps = [step for step in os.path.abspath(domain.root).split("/") if step]
    above, guarded = steps[:-2], steps[-2:]
    at, path, links = os.open("/", _ENTER), "/", 0
    try:
        while above:
            step = above.pop(0)
            entered = _enter(at, path, step, make)
            if entered is None:
                return None
            if entered >= 0:
                os.close(at)
                at, path = entered, os.path.join(path, step)
                continue
            target, links = _target(at, path, step), links + 1
            if links > _LINKS:
                raise _planted(os.path.join(path, step), "leads in a circle of links")
            if os.path.isabs(target):
                os.close(at)
                at, path = os.open("/", _ENTER), "/"
            above = [part for part in target.split("/") if part not in ("", ".")] + above
        for step in guarded:
            entered = _enter(at, path, step, make)
            if entered is None:
                return None
            path = os.path.join(path, step)
            if entered < 0:
                raise _planted(path, "is a link, or no directory")
            os.close(at)
            at = entered
            _check_own(path, os.fstat(at))
        opened, at = at, -1
        return Directory(opened, path)
    finally:
        if at >= 0:
            os.close(at)


def _enter(at: int, path: str, step: str, make: bool) -> int | None:
    """The directory `step`, nothing if it is absent and not to be made, -1 if it is a link or no directory."""
    try:
        return os.open(step, _ENTER, dir_fd=at)
    except FileNotFoundError:
        if not make:
            return None
        try:
            os.mkdir(step, 0o700, dir_fd=at)
        except FileExistsError:
            pass
        return _enter(at, path, step, make=False)
    except NotADirectoryError:
        return -1
    except PermissionError:
        raise foreign(path, os.fstat(at)) from None


def _target(at: int, path: str, link: str) -> str:
    whole = os.path.join(path, link)
    seen = os.stat(link, dir_fd=at, follow_symlinks=False)
    if not stat.S_ISLNK(seen.st_mode):
        raise _planted(whole, "is no directory")
    if seen.st_uid not in (0, os.geteuid()) or os.fstat(at).st_mode & _OTHERS_WRITE:
        raise _planted(whole, f"is a link of user {seen.st_uid} that others could have made")
    return os.readlink(link, dir_fd=at)


def _check_own(path: str, seen: os.stat_result) -> None:
    if seen.st_uid != os.geteuid():
        raise foreign(path, seen)
    if seen.st_mode & _OTHERS_WRITE:
        what = f"{path} has mode {seen.st_mode & 0o7777:04o}: others can put files there"
        own = "choose a directory of your own as root"
        raise Denied(what, own if seen.st_mode & stat.S_ISVTX else f"chmod go-w {path}, or {own}")


def foreign(path: str, seen: os.stat_result) -> Denied:
    """Whose the directory at `path` is."""
    owner, mode = _named(seen.st_uid), seen.st_mode & 0o7777
    what = f"{path} belongs to user {owner} with mode {mode:04o}, this is user {_named(os.geteuid())}"
    remedy = (
        f"shared memory is for one user: run as user {owner}; or get the data of that user's hub:"
        " `scanhub gateway --interface lo` as that user, `scanhub listen --publish --interface lo` as this one"
    )
    return Denied(what, remedy)


def _named(user: int) -> str:
    try:
        return f"{user} ({pwd.getpwuid(user).pw_name})"
    except KeyError:
        return str(user)


def _planted(path: str, what: str) -> Denied:
    return Denied(f"{path} {what}: scanhub opens nothing in it", f"look at it with `ls -ld {path}` and remove it")


_ENTER = os.O_PATH | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC
_OTHERS_WRITE = 0o022
_LINKS = 40
