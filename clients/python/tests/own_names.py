"""Tests of programs that publish under their own names, start and end. Arguments are domain and root of a domain that
no other program uses."""

import contextlib
import os
import signal
import sys

import scanhub


def publish(name: str = "mount") -> scanhub.Publication:
    return scanhub.publish(f"{name}/tilt", domain=domain, root=root)


def is_empty() -> bool:
    begin = f"sh_{domain}_"
    return not os.path.exists(f"{root}/{domain}/prefix") and not [n for n in os.listdir("/dev/shm") if n.startswith(begin)]


def who_comes_while_another_goes_has_a_place() -> None:
    names_of_two = ("left", "right")
    children = []
    for name in names_of_two:
        child = os.fork()
        if child == 0:
            with contextlib.ExitStack() as at_end:
                at_end.callback(os._exit, 1)
                for _ in range(ROUNDS):
                    with publish(name) as mount:
                        mount.send(0.25)
                os._exit(0)
        children.append(child)
    assert [os.waitpid(child, 0)[1] for child in children] == [0, 0]
    assert is_empty()


def a_child_does_not_keep_the_name_of_one_that_is_killed() -> None:
    (ready_read, ready_write), (lives, ends) = os.pipe(), os.pipe()
    parent = os.fork()
    if parent == 0:
        os.close(ends)
        mount = publish()
        if os.fork() == 0:
            os.write(ready_write, b"!")
            # Wait until the test ends this process.
            os.read(lives, 1)
            os._exit(0)
        signal.pause()
    assert os.read(ready_read, 1) == b"!"
    os.kill(parent, signal.SIGKILL)
    assert os.waitpid(parent, 0)[1] == signal.SIGKILL
    publish().close()
    os.close(ends)


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


ROUNDS = 50
domain, root = sys.argv[1:]
for check in (
    who_comes_while_another_goes_has_a_place,
    a_child_does_not_keep_the_name_of_one_that_is_killed,
    a_stamp_is_a_time,
):
    check()
    print(check.__name__, flush=True)
