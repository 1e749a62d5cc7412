"""Checks memory and lifetime of arrays, and threads, tasks and processes. Arguments are domain and root, and `uvloop`
to check only the tasks, in a loop of uvloop. `front` must stream."""

import asyncio
import contextlib
import gc
import importlib
import multiprocessing
import os
import pickle
import signal
import sys
import threading
import time
from typing import Any, Callable

import numpy as np
import scanhub


def mappings() -> list:
    """Returns first address, last address, permissions and file of each shared-memory segment that this process has
    mapped."""
    found = []
    with open("/proc/self/maps", encoding="utf-8") as lines:
        for line in lines:
            span, permissions, *_, path = line.split(None, 5)
            begin, end = (int(part, 16) for part in span.split("-"))
            found.append((begin, end, permissions, path.strip()))
    return [mapping for mapping in found if mapping[3].startswith("/dev/shm/")]


def lies_in_shared_memory(array: np.ndarray) -> bool:
    begin = array.ctypes.data
    inside = [mapping for mapping in mappings() if mapping[0] <= begin and begin + array.nbytes <= mapping[1]]
    return len(inside) == 1 and "w" not in inside[0][2]


def refuses(error: type, what) -> str:
    try:
        what()
    except error as refused:
        return str(refused)
    raise AssertionError(f"{error} was not raised")


def subscribe(*topics: str, timeout: float = 20.0, **options: Any) -> scanhub.Subscriber:
    return scanhub.subscribe(*topics, domain=domain, root=root, timeout=timeout, **options)


def until(is_done: Callable[[], bool]) -> None:
    give_up_at = time.monotonic() + 60
    while not is_done():
        assert time.monotonic() < give_up_at
        time.sleep(0.01)


def views_are_the_hubs_memory(scans: scanhub.Subscriber) -> None:
    scan = next(scans)
    for array in (scan.ranges, scan.upper, scan.intensities):
        assert array.size == 361 and lies_in_shared_memory(array)
    assert not lies_in_shared_memory(scan.ranges_m) and not lies_in_shared_memory(scan.copy().ranges)


def views_cannot_be_written(scans: scanhub.Subscriber) -> None:
    ranges = next(scans).ranges
    refuses(ValueError, lambda: ranges.__setitem__(0, 0))
    refuses(ValueError, lambda: ranges.setflags(write=True))
    refuses(ValueError, lambda: ranges[5:].setflags(write=True))


def a_view_keeps_its_sample(scans: scanhub.Subscriber) -> None:
    scan = next(scans)
    kept, before = scan.ranges[100:200], scan.ranges[100:200].copy()
    seq = scan.topic_seq
    del scan
    # Receive far more samples than the hub has slots. The hub reuses slots, but not the slot of the kept sample.
    for scan in scans:
        assert scan.ranges.ctypes.data + 200 != kept.ctypes.data
        if scan.topic_seq > seq + 60:
            break
    assert np.array_equal(kept, before)


def four_may_be_kept_and_no_more(scans: scanhub.Subscriber) -> None:
    kept = [next(scans).ranges for _ in range(4)]
    text = refuses(scanhub.Held, lambda: next(scans))
    assert "front/scan" in text and "copy()" in text, text
    kept.pop()
    gc.collect()
    assert next(scans).topic_seq > 0
    copies = [next(scans).copy() for _ in range(3 * len(kept))]
    assert len({copy.topic_seq for copy in copies}) == len(copies)


def other_threads_run_meanwhile(scans: scanhub.Subscriber) -> None:
    turns, is_over = [0], threading.Event()

    def turn() -> None:
        while not is_over.wait(0.001):
            turns[0] += 1

    thread = threading.Thread(target=turn, daemon=True)
    thread.start()
    give_up_at = time.monotonic() + 20
    while True:
        turns[0], begin, used = 0, time.monotonic(), time.process_time()
        while time.monotonic() - begin < 0.5:
            next(scans)
        used = time.process_time() - used
        # If a wait held the lock of the interpreter, the other thread would hardly run. If the wait did not sleep, it
        # would use CPU time. On a busy machine, one of the conditions may be false for a while.
        if turns[0] > 50 and used < 0.4:
            break
        assert time.monotonic() < give_up_at, (turns, used)
    is_over.set()
    thread.join()


def a_child_takes_nothing_from_its_parent(scans: scanhub.Subscriber) -> None:
    scan = next(scans)
    kept, before = scan.ranges, scan.ranges.copy()
    child = os.fork()
    if child == 0:
        del scan, kept, scans
        # The child exits as a program does. A child of multiprocessing would skip the shutdown of the interpreter.
        sys.exit(0)
    assert os.waitpid(child, 0)[1] == 0
    for _ in range(20):
        next(scans)
    assert np.array_equal(kept, before)


def what_is_closed_ends(scans: scanhub.Subscriber) -> None:
    with scans:
        scan = next(scans)
        kept, before = scan.ranges, scan.ranges.copy()
    assert list(scans) == [] and np.array_equal(kept, before)


def copies_can_be_pickled_and_views_cannot(scans: scanhub.Subscriber) -> None:
    scan = next(scans)
    text = refuses(TypeError, lambda: pickle.dumps(scan))
    assert "copy()" in text, text
    copy = pickle.loads(pickle.dumps(scan.copy()))
    assert type(copy) is scanhub.Scan and repr(copy) == repr(scan) and copy.stamp_ns == scan.stamp_ns
    assert np.array_equal(copy.ranges, scan.ranges) and copy.codes == scan.codes and copy.flags == scan.flags
    for broken in (b"", b"123", bytes(65)):
        refuses(ValueError, lambda: scanhub._scanhub._restore("front", "marks", bytes(64), broken, (0, False, False)))


def other_threads_drop_samples(scans: scanhub.Subscriber) -> None:
    for _ in range(5):
        kept = [next(scans) for _ in range(4)]
        views = [scan.ranges for scan in kept]
        thread = threading.Thread(target=lambda: (kept.clear(), views.clear()))
        thread.start()
        thread.join()
        # Four slots are free again.
        kept = [next(scans) for _ in range(4)]
        kept.clear()


def a_sample_is_dropped_while_another_thread_waits(_: scanhub.Subscriber) -> None:
    def has_subscriber() -> bool:
        assert tilts._poll() is None
        return mount.subscribers == 1

    with scanhub.publish("mount/tilt", domain=domain, root=root) as mount, subscribe("mount/tilt") as tilts:
        until(has_subscriber)

        def sent(angle_rad: float) -> scanhub.Tilt:
            mount.send(angle_rad)
            return next(tilts)

        kept = [sent(angle_rad) for angle_rad in (0.0, 1.0, 2.0, 3.0)]
        received: list[float] = []
        thread = threading.Thread(target=lambda: received.append(next(tilts).angle_rad))
        thread.start()
        # This call reserves the subscription like `next`, but holds the lock of the interpreter.
        until(lambda: "another thread" in refuses(scanhub.Failure, tilts._descriptor))
        kept.clear()
        mount.send(4.0)
        thread.join()
        assert received == [4.0], received
        kept = [sent(angle_rad) for angle_rad in (5.0, 6.0, 7.0, 8.0)]


def two_threads_at_a_time_are_refused(scans: scanhub.Subscriber) -> None:
    waits, may_continue, refused = threading.Event(), threading.Event(), []

    def notice(_: str) -> None:
        waits.set()
        may_continue.wait()

    # `next` finds the hub, so it calls `notice` and then waits.
    nothing = subscribe("nobody/scan", timeout=0.1, on_notice=notice)
    thread = threading.Thread(target=lambda: refused.append(refuses(scanhub.Silent, lambda: next(nothing))))
    thread.start()
    waits.wait()
    text = refuses(scanhub.Failure, lambda: next(nothing))
    may_continue.set()
    thread.join()
    assert "another thread" in text and "nobody" in refused[0], (text, refused)
    # Several threads may use the same object one after the other.
    next(scans)
    thread = threading.Thread(target=lambda: refused.append(next(scans).sensor))
    thread.start()
    thread.join()
    assert refused[1:] == ["front"], refused


def ctrl_c_ends_a_wait(_: scanhub.Subscriber) -> None:
    nothing = scanhub.subscribe("nobody/scan", domain=domain, root=root)
    took = []
    for _ in range(5):
        sent = []
        timer = threading.Timer(0.3, lambda: (sent.append(time.monotonic()), os.kill(os.getpid(), signal.SIGINT)))
        timer.start()
        refuses(KeyboardInterrupt, lambda: next(nothing))
        took.append(time.monotonic() - sent[0])
        timer.join()
    assert min(took) < 0.2, took


def asyncio_waits_without_a_thread(_: scanhub.Subscriber) -> None:
    async def follow() -> None:
        scans = scanhub.subscribe("front/scan", "front/zones", domain=domain, root=root, timeout=20)
        threads, seen, canceled, last = threading.active_count(), 0, 0, None
        while seen < 100 or canceled < 50:
            try:
                sample = await asyncio.wait_for(scans.__anext__(), 0.003)
            except asyncio.TimeoutError:
                canceled += 1
                continue
            if sample.topic == "scan":
                assert last is None or sample.topic_seq == last + 1 + sample.missed
                assert sample.missed == 0 or canceled > 10_000, "a canceled wait lost a sample"
                last, seen = sample.topic_seq, seen + 1
        assert threading.active_count() == threads
        async for verdict in scanhub.robot(domain=domain, root=root):
            assert verdict.sensors
            break
        silent = scanhub.subscribe("nobody/scan", domain=domain, root=root, timeout=0.3)
        try:
            await silent.__anext__()
            raise AssertionError("there is no such sensor")
        except scanhub.Silent as failure:
            assert "nobody/scan" in failure.message
        closed = scanhub.subscribe("front/scan", domain=domain, root=root)
        closed.close()
        assert [scan async for scan in closed] == []

    run(follow())


def a_close_ends_the_wait_of_a_task(_: scanhub.Subscriber) -> None:
    async def follow() -> None:
        for in_thread in (False, True):
            waits: list[Any] = [
                scanhub.subscribe("nobody/scan", domain=domain, root=root),
                scanhub.robot("nobody", domain=domain, root=root),
            ]
            for wait in waits:
                with contextlib.suppress(asyncio.TimeoutError):
                    while True:  # A robot returns its first verdict at once.
                        await asyncio.wait_for(wait.__anext__(), 0.3)
                task = asyncio.ensure_future(wait.__anext__())
                await asyncio.sleep(0.1)
                try:
                    await wait.__anext__()
                    raise AssertionError("two tasks waited")
                except scanhub.Failure as failure:
                    assert "another task" in failure.message
                if in_thread:
                    await asyncio.get_running_loop().run_in_executor(None, wait.close)
                else:
                    wait.close()
                try:
                    await asyncio.wait_for(task, 60)
                    raise AssertionError("it was closed")
                except StopAsyncIteration:
                    pass

    run(follow())


def a_subscription_has_one_kind_of_loop(scans: scanhub.Subscriber) -> None:
    next(scans)

    async def follow() -> None:
        async for _ in scans:
            raise AssertionError("it was used by `for` before")

    text = refuses(scanhub.Failure, lambda: run(follow()))
    assert "async for" in text, text


def a_child_of_multiprocessing_takes_nothing(scans: scanhub.Subscriber) -> None:
    scan = next(scans)
    kept, before = scan.ranges, scan.ranges.copy()
    children = multiprocessing.get_context("fork")
    for _ in range(2):
        child = children.Process(target=lambda: sys.exit(0 if kept[0] == before[0] else 1))
        child.start()
        child.join()
        assert child.exitcode == 0
    for _ in range(20):
        next(scans)
    assert np.array_equal(kept, before)


def a_child_is_refused(scans: scanhub.Subscriber) -> None:
    next(scans)
    child = os.fork()
    if child == 0:
        text = refuses(scanhub.Failure, lambda: next(scans))
        scans.close()
        os._exit(0 if "parent" in text else 1)
    assert os.waitpid(child, 0)[1] == 0
    next(scans)


TASKS = (
    asyncio_waits_without_a_thread,
    a_close_ends_the_wait_of_a_task,
    a_subscription_has_one_kind_of_loop,
)

domain, root, *loop = sys.argv[1:]
run = importlib.import_module(*loop).run if loop else asyncio.run
for check in TASKS if loop else (
    views_are_the_hubs_memory,
    views_cannot_be_written,
    a_view_keeps_its_sample,
    four_may_be_kept_and_no_more,
    other_threads_run_meanwhile,
    a_child_takes_nothing_from_its_parent,
    what_is_closed_ends,
    copies_can_be_pickled_and_views_cannot,
    other_threads_drop_samples,
    a_sample_is_dropped_while_another_thread_waits,
    two_threads_at_a_time_are_refused,
    ctrl_c_ends_a_wait,
    *TASKS,
    a_child_of_multiprocessing_takes_nothing,
    a_child_is_refused,
):
    check(subscribe("front/scan"))
    print(check.__name__, flush=True)
