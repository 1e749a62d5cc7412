"""Tests of subscriptions that are refused, and of the messages. Arguments are domain and root of a domain that no other
program uses."""

import asyncio
import fcntl
import os
import resource
import struct
import sys
import time
import warnings

import scanhub


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
    failure = refusal(scanhub.Impossible, lambda: scanhub.subscribe("front/scan", root="/" + "b" * 60))
    assert "too long" in failure.message
    refusal(scanhub.Impossible, lambda: scanhub.background("front", "paint"))
    refusal(scanhub.Impossible, lambda: scanhub.control("front", "show"))


def no_hub() -> None:
    begin = time.monotonic()
    failure = refusal(scanhub.NoHub, lambda: follow("front/scan", timeout=0.3))
    assert "scanhub run" in failure.remedy and root in failure.remedy and time.monotonic() - begin < 10
    for ask in (scanhub.sensors, scanhub.topics, lambda **place: scanhub.background("front", **place)):
        refusal(scanhub.NoHub, lambda: ask(domain=domain, root=root))


def somebody_elses_domain() -> None:
    if os.geteuid() != 0:
        print("skipped: only root can become another user", flush=True)
        return
    os.makedirs(place, mode=0o700)
    os.chmod(place, 0o700)
    child = os.fork()
    if child == 0:
        os.setresuid(65534, 65534, 65534)
        refused = [refusal(scanhub.Denied, what) for what in (lambda: follow("front/scan"), publish)]
        words = "belongs to user 0 (root) with mode 0755, this is user 65534"
        os._exit(0 if all(words in failure.message for failure in refused) else 1)
    assert os.waitpid(child, 0)[1] == 0


def hub_without_topics(pid: "int | None" = None) -> int:
    """Takes the lock of a hub, as a hub that has created all of its topics. The lock names the process `pid`, or this
    process."""
    os.makedirs(place, mode=0o700, exist_ok=True)
    lock = os.open(f"{place}/hub.lock", os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o600)
    fcntl.fcntl(lock, fcntl.F_OFD_SETLK, struct.pack("hhqqi0q", fcntl.F_WRLCK, os.SEEK_SET, 0, 0, 0))
    os.write(lock, b"%d\nready\n" % (pid or os.getpid()))
    return lock


def silence() -> None:
    lock = hub_without_topics()
    with publish("other"):
        assert scanhub.topics(domain=domain, root=root) == [("other", "tilt")]
        failure = refusal(scanhub.Silent, lambda: follow("front/marks", "rear/scan", timeout=0.3))
        assert "front/marks, rear/scan in 0.3 s: the hub has no sensor front; the hub has no sensor rear" in failure.message, failure
        assert failure.remedy == "the sensors are other", failure
        failure = refusal(scanhub.Silent, lambda: follow("other/scan", timeout=0.3))
        assert "does not publish other/scan" in failure.message and "the topics are tilt" in failure.remedy, failure
        failure = refusal(scanhub.Silent, lambda: follow("other/tilt", timeout=0.3))
        assert failure.message == "nothing of other/tilt in 0.3 s" and "scanhub info other" in failure.remedy, failure
        failure = refusal(scanhub.NoHub, lambda: scanhub.background("front", domain=domain, root=root))
        assert "takes no requests" in failure.message, failure
    os.close(lock)


def reasons_of_a_silence() -> None:
    lock = hub_without_topics()
    for topic, other_domain in (("othr/tilt", domain), ("front/scan", "nowhere")):
        with publish("other"), warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            silent = scanhub.subscribe(topic, domain=other_domain, root=root, timeout=4)
            begin = time.monotonic()
            refusal(scanhub.Failure, lambda: next(silent))
            assert time.monotonic() - begin >= 4
        (warning,) = caught
        assert warning.category is scanhub.SilenceWarning and warning.filename == __file__, warning
        text = str(warning.message)
        words = ("no sensor othr", "the sensors are other") if other_domain == domain else ("nothing yet: no hub", "scanhub run")
        assert all(word in text for word in words), text
    os.close(lock)


def a_silent_topic_beside_others() -> None:
    lock = hub_without_topics()
    topics = ("othr/tilt", "other/tilt", "third/tilt")
    with publish("other") as mount, publish("third"), warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        begin = time.monotonic()
        tilts = scanhub.subscribe(*topics, domain=domain, root=root, timeout=20)
        assert tilts._poll() is None
        # Each sample has arrived before the next call, so the calls never find the queue empty.
        while not caught or time.monotonic() - begin < 4:
            while not mount.subscribers:
                assert tilts._poll() is None
            mount.send(angle_rad=0.25)
            next(tilts)
            assert not caught or time.monotonic() - begin > 1.9
    (warning,) = caught
    assert "no sensor othr" in str(warning.message) and "third" in str(warning.message), warning
    assert "no sensor third" not in str(warning.message), warning
    os.close(lock)


def no_warning_after_the_end_of_a_hub() -> None:
    lock = hub_without_topics()
    with publish("third"), warnings.catch_warnings():
        warnings.simplefilter("error")
        with publish("other") as mount:
            tilts = scanhub.subscribe("other/tilt", "third/tilt", domain=domain, root=root, timeout=4)
            while not mount.subscribers:
                assert tilts._poll() is None
            mount.send(angle_rad=0.25)
            next(tilts)
        os.close(lock)
        refusal(scanhub.Failure, lambda: next(tilts))


def no_notice_after_a_close() -> None:
    def notice(kind: str) -> None:
        notices.append(kind)
        if kind == "hub_gone":
            tilts.close()

    notices: "list[str]" = []
    lock = hub_without_topics()
    tilts = scanhub.subscribe("other/tilt", domain=domain, root=root, on_notice=notice)
    with publish("other"):
        while not notices:
            assert tilts._poll() is None
        os.close(lock)
        # The next check of the subscription finds both the end of one hub and the start of another.
        lock = hub_without_topics(os.getppid())
        while len(notices) < 2:
            assert tilts._poll() is None
        assert list(tilts) == [] and notices == ["hub_back", "hub_gone"], notices
    os.close(lock)


def warning(what) -> str:
    with warnings.catch_warnings():
        warnings.simplefilter("error", scanhub.SilenceWarning)
        try:
            what()
        except scanhub.SilenceWarning as warning:
            return str(warning)
    raise AssertionError("nothing can be received")


def warnings_in_asyncio() -> None:
    async def follow(silent: "scanhub.Subscriber | scanhub.RobotSubscriber") -> None:
        with silent:
            async for _ in silent:
                pass

    for ask in (lambda **place: scanhub.subscribe("front/scan", **place), scanhub.robot):
        silent = ask(domain="nowhere", root=root)
        text = warning(lambda: asyncio.run(asyncio.wait_for(follow(silent), 20)))
        assert "scanhub run" in text, text


def warnings_of_a_robot() -> None:
    def follow() -> None:
        for now in silent:
            assert now.verdict == "unknown"

    def ask() -> None:
        give_up_at = time.monotonic() + 20
        while time.monotonic() < give_up_at:
            assert silent.now().verdict == "unknown"
            time.sleep(0.01)

    lock = hub_without_topics()
    with publish("other"):
        for what in (follow, ask):
            silent = scanhub.robot("othr", domain=domain, root=root)
            text = warning(what)
            assert "no sensor othr" in text and "the sensors are other" in text, text
            silent = scanhub.robot(domain=domain, root=root)
            text = warning(what)
            assert "no sensor with zones" in text and "the sensors are other" in text, text
    os.close(lock)


def duration_of_a_silence() -> None:
    lock = hub_without_topics()
    with publish("other") as mount, scanhub.subscribe("other/tilt", domain=domain, root=root, timeout=0.1) as tilts:
        refusal(scanhub.Silent, lambda: next(tilts))
        before = tilts.silent_for()
        assert 0.1 <= before < 60, before
        assert mount.subscribers == 1
        begin = time.monotonic()
        mount.send(angle_rad=0.25)
        next(tilts)
        assert tilts.silent_for() <= time.monotonic() - begin
        time.sleep(0.05)
        assert tilts.silent_for() >= 0.05
    failure = refusal(scanhub.Failure, tilts.silent_for)
    assert "closed" in failure.message, failure
    with scanhub.robot(domain=domain, root=root) as robot:
        time.sleep(0.02)
        assert robot.silent_for() >= 0.02
    os.close(lock)


def finds_resource_shortages() -> None:
    lock = hub_without_topics()
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    mount = publish("other")
    subscription = scanhub.subscribe("other/tilt", domain=domain, root=root, timeout=1)
    # Another subscription or publication needs more descriptors than these.
    resource.setrlimit(resource.RLIMIT_NOFILE, (len(os.listdir("/proc/self/fd")) + 6, before[1]))
    refused = [refusal(scanhub.Short, lambda: next(subscription)), refusal(scanhub.Short, publish)]
    resource.setrlimit(resource.RLIMIT_NOFILE, before)
    for failure in refused:
        assert "ulimit -n" in failure.remedy, failure
    # A refused publication has released the name.
    publish().close()
    follower = scanhub.subscribe("other/tilt", domain=domain, root=root, timeout=1)
    resource.setrlimit(resource.RLIMIT_NOFILE, (3, before[1]))
    failure = refusal(scanhub.Short, lambda: next(follower))
    resource.setrlimit(resource.RLIMIT_NOFILE, before)
    assert "ulimit -n" in failure.remedy, failure
    mount.close()
    os.close(lock)


def a_taken_name() -> None:
    with publish("other"):
        failure = refusal(scanhub.Taken, lambda: publish("other"))
        assert "the name other is published by" in failure.message, failure


domain, root = sys.argv[1:]
place = os.path.join(root, domain)
for check in (
    names_that_are_none,
    no_hub,
    somebody_elses_domain,
    a_taken_name,
    silence,
    reasons_of_a_silence,
    a_silent_topic_beside_others,
    no_warning_after_the_end_of_a_hub,
    no_notice_after_a_close,
    warnings_in_asyncio,
    warnings_of_a_robot,
    duration_of_a_silence,
    finds_resource_shortages,
):
    check()
    print(check.__name__, flush=True)
