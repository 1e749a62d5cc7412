"""Where the arrays of a sample lie, and how long they stay: arguments are domain and root. `front` has to stream."""

import gc
import os
import sys
import threading
import time

import numpy as np
import scanhub


def mappings() -> list:
    """The parts of shared memory that this process has mapped: first and last address, permissions, file."""
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


def views_are_the_hubs_memory(scans: scanhub.Subscription) -> None:
    scan = next(scans)
    for array in (scan.ranges, scan.upper, scan.intensities):
        assert array.size == 361 and lies_in_shared_memory(array)
    assert not lies_in_shared_memory(scan.ranges_m) and not lies_in_shared_memory(scan.copy().ranges)


def views_cannot_be_written(scans: scanhub.Subscription) -> None:
    ranges = next(scans).ranges
    refuses(ValueError, lambda: ranges.__setitem__(0, 0))
    refuses(ValueError, lambda: ranges.setflags(write=True))
    refuses(ValueError, lambda: ranges[5:].setflags(write=True))


def a_view_keeps_its_sample(scans: scanhub.Subscription) -> None:
    scan = next(scans)
    kept, before = scan.ranges[100:200], scan.ranges[100:200].copy()
    seq = scan.topic_seq
    del scan
    # Far more than the hub has places for, were they not taken anew: the sample's own is not among them.
    for scan in scans:
        assert scan.ranges.ctypes.data + 200 != kept.ctypes.data
        if scan.topic_seq > seq + 60:
            break
    assert np.array_equal(kept, before)


def four_may_be_kept_and_no_more(scans: scanhub.Subscription) -> None:
    kept = [next(scans).ranges for _ in range(4)]
    said = refuses(scanhub.Held, lambda: next(scans))
    assert "front/scan" in said and "copy()" in said, said
    kept.pop()
    gc.collect()
    assert next(scans).topic_seq > 0
    copies = [next(scans).copy() for _ in range(3 * len(kept))]
    assert len({copy.topic_seq for copy in copies}) == len(copies)


def other_threads_run_meanwhile(scans: scanhub.Subscription) -> None:
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
        # They would hardly run while the lock of the interpreter is held over a wait; and who sleeps uses no time. A
        # machine that is full gives neither, for a while.
        if turns[0] > 50 and used < 0.4:
            break
        assert time.monotonic() < give_up_at, (turns, used)
    is_over.set()
    thread.join()


def a_child_takes_nothing_from_its_parent(scans: scanhub.Subscription) -> None:
    scan = next(scans)
    kept, before = scan.ranges, scan.ranges.copy()
    child = os.fork()
    if child == 0:
        del scan, kept, scans
        # Ends as a program does, not as multiprocessing lets it.
        sys.exit(0)
    assert os.waitpid(child, 0)[1] == 0
    for _ in range(20):
        next(scans)
    assert np.array_equal(kept, before)


def what_is_closed_ends(scans: scanhub.Subscription) -> None:
    with scans:
        scan = next(scans)
        kept, before = scan.ranges, scan.ranges.copy()
    assert list(scans) == [] and np.array_equal(kept, before)


def a_subscriber_announces_itself(scans: scanhub.Subscription) -> None:
    def attached() -> int:
        with open(f"/dev/shm/{scans._membership.prefix}front.bell", "rb") as page:
            return int.from_bytes(page.read(8)[4:], sys.byteorder)

    next(scans)
    before = attached()
    with scanhub.subscribe("front/scan", domain=domain, root=root, timeout=20) as others:
        next(others)
        # The subscriber, and the listener of the event.
        assert attached() == before + 2


domain, root = sys.argv[1:]
for check in (
    a_subscriber_announces_itself,
    views_are_the_hubs_memory,
    views_cannot_be_written,
    a_view_keeps_its_sample,
    four_may_be_kept_and_no_more,
    other_threads_run_meanwhile,
    a_child_takes_nothing_from_its_parent,
    what_is_closed_ends,
):
    check(scanhub.subscribe("front/scan", domain=domain, root=root, timeout=20))
    print(check.__name__, flush=True)
