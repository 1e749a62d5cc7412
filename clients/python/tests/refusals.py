"""What cannot be followed, and what is said of it: arguments are domain and root, of which nobody else knows."""

import ctypes
import fcntl
import os
import resource
import struct
import sys
import time

import iceoryx2 as iox2
import scanhub
from scanhub import layout, memory, names
from scanhub.presence import LOOK_EVERY, Presence


def refusal(error: type, what) -> scanhub.Failure:
    try:
        what()
    except error as refused:
        assert refused.message and str(refused).startswith(refused.message), refused
        return refused
    raise AssertionError(f"{error} was not raised")


def follow(*topics: str, timeout: float = 20.0):
    return next(scanhub.subscribe(*topics, domain=domain, root=root, timeout=timeout))


def publish(name: str = "mount") -> scanhub.Publication:
    return scanhub.publish(f"{name}/tilt", domain=domain, root=root)


def names_that_are_none() -> None:
    for topic in ("front", "front/", "front/scans", "scan", "robot/zones", "Front/scan", "a.b.c/scan", ""):
        assert refusal(scanhub.Failure, lambda: scanhub.subscribe(topic)).remedy, topic
    refusal(scanhub.NoTopic, scanhub.subscribe)
    for name in ("", "A", "a_b", "a/b", "a" * 17):
        refusal(scanhub.Impossible, lambda: scanhub.subscribe("front/scan", domain=name))
    said = refusal(scanhub.Impossible, lambda: scanhub.subscribe("front/scan", root="/" + "b" * 60))
    assert "too long" in said.message
    refusal(scanhub.Impossible, lambda: scanhub.background("front", "paint"))
    refusal(scanhub.Impossible, lambda: scanhub.control("front", "show"))


def places_in_their_order() -> None:
    variables = ("SCANHUB_DOMAIN", "RUNTIME_DIRECTORY", "XDG_RUNTIME_DIR")
    before = {name: os.environ.pop(name, None) for name in variables}
    fallback = f"/tmp/scanhub-{os.getuid()}"
    session = f"/run/user/{os.getuid()}/scanhub"
    expected = ["/run/scanhub/scanhub", f"{session}/scanhub", f"{fallback}/scanhub"]
    assert [place.root for place in names.candidates()] == expected
    os.environ.update(SCANHUB_DOMAIN="a", RUNTIME_DIRECTORY="/run/one:/run/two", XDG_RUNTIME_DIR="/run/user/7")
    expected = ["/run/one/a", "/run/scanhub/a", "/run/user/7/scanhub/a", f"{fallback}/a"]
    assert [place.root for place in names.candidates()] == expected
    assert [place.prefix for place in names.candidates("b", "/x")] == ["sh_b_"]
    for name, value in before.items():
        os.environ.pop(name) if value is None else os.environ.update({name: value})


def no_hub() -> None:
    begin = time.monotonic()
    said = refusal(scanhub.NoHub, lambda: follow("front/scan", timeout=0.3))
    assert "scanhub run" in said.remedy and root in said.remedy and time.monotonic() - begin < 10
    for ask in (scanhub.sensors, scanhub.topics, lambda **place: scanhub.background("front", **place)):
        refusal(scanhub.NoHub, lambda: ask(domain=domain, root=root))


def somebody_elses_domain() -> None:
    if os.geteuid() != 0:
        print("skipped: only root can be somebody else", flush=True)
        return
    os.makedirs(place.root, mode=0o700)
    os.chmod(place.root, 0o700)
    child = os.fork()
    if child == 0:
        os.setresuid(65534, 65534, 65534)
        refused = [refusal(scanhub.Denied, what) for what in (lambda: follow("front/scan"), publish)]
        words = "belongs to user 0 (root) with mode 0755, this is user 65534"
        os._exit(0 if all(words in said.message for said in refused) else 1)
    assert os.waitpid(child, 0)[1] == 0


class Scan(ctypes.Structure):
    """One value, as in version 1, and not a slice."""

    _fields_ = [("ranges", ctypes.c_uint16 * 610)]

    @staticmethod
    def type_name() -> str:
        return "scanhub.Scan.v1"


def hub_of_another_layout() -> list:
    """What a hub holds: the lock with its process id, and services, one of which is of another layout."""
    os.makedirs(place.root, mode=0o700, exist_ok=True)
    lock = os.open(f"{place.root}/hub.lock", os.O_RDWR | os.O_CREAT, 0o600)
    fcntl.fcntl(lock, fcntl.F_OFD_SETLK, struct.pack("hhqqi0q", fcntl.F_WRLCK, os.SEEK_SET, 0, 0, 0))
    os.write(lock, b"%d\n" % os.getpid())
    with open(f"{place.root}/prefix", "w", encoding="ascii") as names_begin:
        names_begin.write(f"{place.prefix}01234_\n")
    hub = memory.Membership(place)
    wake = hub.service("scanhub/v2/front/wake").event().open_or_create()
    scan = hub.service("scanhub/v2/front/scan").publish_subscribe(Scan).user_header(layout.Header)
    zones = hub.service("scanhub/v2/front/zones").publish_subscribe(iox2.Slice[ctypes.c_uint8])
    tilt = hub.service("scanhub/v2/old/tilt").publish_subscribe(iox2.Slice[ctypes.c_uint8])
    return [lock, hub, wake, scan.open_or_create(), zones.open_or_create(), tilt.open_or_create()]


def other_layouts() -> None:
    held = hub_of_another_layout()
    assert scanhub.sensors(domain=domain, root=root) == ["front", "old"]
    said = refusal(scanhub.Mismatch, lambda: follow("front/scan"))
    theirs, ours = "scanhub.Scan.v1 of 1220 bytes", "scanhub.Scan.v2 of 8 bytes"
    assert theirs in said.message and ours in said.message and "iceoryx2 0.10.0" in said.message, said
    assert said.message.index(theirs) < said.message.index(ours)
    said = refusal(scanhub.Mismatch, lambda: follow("front/zones"))
    assert "u8 of 1 bytes under ()" in said.message and "scanhub.Zones.v2 of 76 bytes" in said.message, said
    said = refusal(scanhub.Mismatch, lambda: publish("old"))
    assert "u8 of 1 bytes under ()" in said.message and "scanhub.Tilt.v2 of 16 bytes" in said.message, said
    said = refusal(scanhub.Taken, lambda: publish("front"))
    assert "the name front is published by" in said.message, said
    said = refusal(scanhub.Silent, lambda: follow("front/marks", "rear/scan", timeout=0.3))
    assert "front/marks, rear/scan" in said.message and "front/scan" in said.remedy, said
    said = refusal(scanhub.NoHub, lambda: scanhub.background("front", domain=domain, root=root))
    assert "takes no requests" in said.message, said
    what_is_short()
    os.close(held[0])


def what_is_short() -> None:
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    # Fewer than one more port takes.
    resource.setrlimit(resource.RLIMIT_NOFILE, (len(os.listdir("/proc/self/fd")) + 6, before[1]))
    refused = [refusal(scanhub.Short, lambda: follow("front/scan", "front/marks", timeout=1))]
    refused.append(refusal(scanhub.Short, publish))
    resource.setrlimit(resource.RLIMIT_NOFILE, before)
    for said in refused:
        assert "descriptors are short" in said.message and "ulimit -n" in said.remedy, said
    # Whoever was refused has left the name.
    publish().close()
    follower, looker = scanhub.subscribe("front/scan", domain=domain, root=root, timeout=1), Presence([place])
    looker.look()
    time.sleep(LOOK_EVERY)
    resource.setrlimit(resource.RLIMIT_NOFILE, (3, before[1]))
    said, news = refusal(scanhub.Short, lambda: next(follower)), looker.look()
    resource.setrlimit(resource.RLIMIT_NOFILE, before)
    assert "cannot look for a hub" in said.message and "ulimit -n" in said.remedy, said
    assert (news, looker.domain) == ((False, False), place), "who is there already goes on"


domain, root = sys.argv[1:]
place = names.candidates(domain, root)[0]
for check in (names_that_are_none, places_in_their_order, no_hub, somebody_elses_domain, other_layouts):
    check()
    print(check.__name__, flush=True)
