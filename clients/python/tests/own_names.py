"""Programs that publish under names of their own, how they come and go: arguments are domain and root, of which nobody else
knows."""

import contextlib
import ctypes
import fcntl
import os
import signal
import struct
import sys
from unittest import mock

import iceoryx2 as iox2
import scanhub
from scanhub import memory, names, outlet, prefix


def publish(name: str = "mount") -> scanhub.Publication:
    return scanhub.publish(f"{name}/tilt", domain=domain, root=root)


def is_empty() -> bool:
    return prefix.of(place) is None and not [name for name in os.listdir("/dev/shm") if name.startswith(place.prefix)]


def who_comes_while_another_goes_is_found() -> None:
    names_of_two = ("left", "right")
    children = []
    for name in names_of_two:
        child = os.fork()
        if child == 0:
            with contextlib.ExitStack() as at_end:
                at_end.callback(os._exit, 1)
                for _ in range(ROUNDS):
                    with publish(name):
                        assert f"{name}/tilt" in map(str, memory.topics(place)), f"{name} cannot be found"
                os._exit(0)
        children.append(child)
    assert [os.waitpid(child, 0)[1] for child in children] == [0, 0]
    assert is_empty()


def a_child_does_not_keep_the_name_of_one_that_is_killed() -> None:
    (said, say), (lives, ends) = os.pipe(), os.pipe()
    parent = os.fork()
    if parent == 0:
        os.close(ends)
        mount = publish()
        if os.fork() == 0:
            os.write(say, b"!")
            # Until the test ends it.
            os.read(lives, 1)
            os._exit(0)
        signal.pause()
    assert os.read(said, 1) == b"!"
    os.kill(parent, signal.SIGKILL)
    assert os.waitpid(parent, 0)[1] == signal.SIGKILL
    publish().close()
    os.close(ends)


def who_is_refused_leaves_nothing() -> None:
    kept = []
    short = scanhub.Short("shared memory is short", "free some")
    with mock.patch.object(outlet, "_allocate", side_effect=short):
        try:
            publish()
        except scanhub.Short as refused:
            kept.append(refused)
    assert kept and is_empty()
    with publish("other"):
        other = memory.Membership(place)
        old = other.service("scanhub/v2/old/tilt").publish_subscribe(iox2.Slice[ctypes.c_uint8]).open_or_create()
        try:
            publish("old")
        except scanhub.Mismatch as refused:
            kept.append(refused)
        config = memory._config(place, other.prefix)
        assert len(iox2.Node.list(iox2.ServiceType.Ipc, config)) == 2 == len(kept)
        del old, other
    assert is_empty()


def a_stamp_is_a_time() -> None:
    with publish() as mount:
        for stamp_ns in (-1, 1 << 64, 1 << 70):
            try:
                mount.send(0.1, stamp_ns=stamp_ns)
            except scanhub.Impossible as refused:
                assert str(stamp_ns) in refused.message and "monotonic_ns" in refused.remedy
            else:
                raise AssertionError(f"{stamp_ns} is a time")
        for stamp_ns in (0, (1 << 64) - 1):
            mount.send(0.1, stamp_ns=stamp_ns)


def a_hub_that_just_starts_has_its_place_already() -> None:
    second = names.candidates(domain, os.path.join(root, "second"))[0]
    os.makedirs(second.root, mode=0o700)
    lock = os.open(f"{second.root}/hub.lock", os.O_RDWR | os.O_CREAT, 0o600)
    fcntl.fcntl(lock, fcntl.F_OFD_SETLK, struct.pack("hhqqi0q", fcntl.F_WRLCK, os.SEEK_SET, 0, 0, 0))
    with mock.patch.object(scanhub, "candidates", return_value=[place, second]), publish():
        assert "mount/tilt" in map(str, memory.topics(second)) and prefix.of(place) is None
    os.close(lock)
    # The last one out takes the names along.
    scanhub.publish("mount/tilt", domain=domain, root=os.path.join(root, "second")).close()
    assert is_empty()


ROUNDS = 50
domain, root = sys.argv[1:]
place = names.candidates(domain, root)[0]
for check in (
    who_comes_while_another_goes_is_found,
    a_child_does_not_keep_the_name_of_one_that_is_killed,
    who_is_refused_leaves_nothing,
    a_stamp_is_a_time,
    a_hub_that_just_starts_has_its_place_already,
):
    check()
    print(check.__name__, flush=True)
