"""Reads recordings. Arguments are `dump FILE CONFIG`, which prints every sample, or `check` with an MCAP file of two
sensors, a CARMEN log, a stream of packets and a directory for other files."""

import hashlib
import json
import os
import pickle
import signal
import sys
import threading
import time
import warnings

import numpy as np
import scanhub

TOPICS = ("telegram", "scan", "zones", "marks", "lines", "motion", "foreground", "background", "status")


def dump(file: str, config: str) -> None:
    for sample in scanhub.read(file, topics=TOPICS, config=config):
        header = (sample.topic_seq, sample.seq, sample.quality, sample.reasons, sorted(sample.flags - {"stamp_estimated"}))
        times = (sample.period_us, sample.wall_ns, sample.stamp_last_ns - sample.stamp_ns)
        payload = sample.__reduce__()[1][3]
        print(json.dumps([sample.sensor, sample.topic, *header, *times, hashlib.sha256(payload).hexdigest()]))


def refusal(error: type, *words: str, **what) -> None:
    try:
        scanhub.read(**what).to_numpy()
    except error as refused:
        assert isinstance(refused, scanhub.Failure) and refused.remedy, refused
        assert all(word in str(refused) for word in words), refused
        return
    raise AssertionError(f"{error} was not raised")


def samples_are_those_of_a_subscription() -> None:
    with scanhub.read(two, topics=["scan", "zones"]) as recording:
        assert recording.sensors == ("front", "rear") and iter(recording) is recording
        samples = list(recording)
    assert list(recording) == []
    assert {(of.sensor, of.topic) for of in samples} == {(a, b) for a in ("front", "rear") for b in ("scan", "zones")}
    scans = [of for of in samples if of.topic == "scan"]
    assert isinstance(scans[0], scanhub.Scan) and scans[0].flags == {"replayed"} and not scans[0].restarted
    # The scans are in the order in which they were measured, with stamps on the clock of the recording.
    ends = [of.stamp_last_ns for of in scans]
    assert ends == sorted(ends) and 1_000_000_000 < ends[0] < 1_100_000_000, ends[:3]
    assert all(of.wall_ns - of.stamp_ns == 1_700_000_000 * 10**9 for of in scans)
    numbers = [of.topic_seq for of in scans if of.sensor == "rear"]
    assert numbers == list(range(len(numbers))) and len(numbers) > 100
    of = scans[3]
    assert not of.ranges.flags.writeable and of.ranges.dtype == np.uint16 and of.count == 361
    kept = pickle.loads(pickle.dumps(of))
    assert np.array_equal(kept.ranges, of.ranges) and kept.seq == of.copy().seq == of.seq


def arrays_have_all_scans() -> None:
    for file, sensor in ((two, "rear"), (log, None), (packets, None)):
        arrays = scanhub.read(file, sensor=sensor).to_numpy()
        ranges, stamps, angles = arrays
        scans = list(scanhub.read(file, sensor=sensor))
        widest = max(scan.count for scan in scans)
        assert ranges.shape == (len(scans), widest) and ranges.dtype == np.float64 and ranges.flags.writeable
        assert stamps.dtype == np.int64 and stamps.tolist() == [scan.stamp_ns for scan in scans]
        for row, scan in enumerate(scans):
            assert np.array_equal(ranges[row, : scan.count], scan.ranges_m, equal_nan=True)
            assert np.isnan(ranges[row, scan.count :]).all()
            of_scan = angles if angles.ndim == 1 else angles[row]
            assert np.array_equal(of_scan[: scan.count], scan.angles)
        assert angles.ndim == (2 if file == packets else 1)
        assert np.isfinite(ranges * np.cos(angles)).any()
    rest = scanhub.read(log)
    first = next(rest)
    ranges, stamps, _ = rest.to_numpy()
    assert len(stamps) == len(list(scanhub.read(log))) - 1 and stamps[0] > first.stamp_ns
    ranges, stamps, angles = rest.to_numpy()
    assert ranges.shape == (0, 0) and stamps.size == angles.size == 0


def settings_change_the_results() -> None:
    config = write("near.toml", b"zones.radii = [0.02, 0.01]\n")
    verdicts = [
        {of.verdict for of in scanhub.read(two, topics="zones", sensor="front", config=config)}
        for config in (config, write("far.toml", b"zones.radii = [8, 7]\n"))
    ]
    assert "clear" in verdicts[0] and "stop" not in verdicts[0] and "stop" in verdicts[1], verdicts


def what_cannot_be_read() -> None:
    missing, text = os.path.join(place, "no.mcap"), write("no.txt", b"this is no recording\n" * 100)
    refusal(scanhub.Unreadable, missing, "No such file", "existing recording", file=missing)
    refusal(OSError, text, "neither an MCAP file", file=text)
    refusal(scanhub.Unreadable, "empty", file=write("empty", b""))
    refusal(scanhub.Unreadable, place, "directory", file=place)
    refusal(scanhub.NoTopic, '"scans"', "telegram, scan", file=two, topics="scans")
    refusal(scanhub.NoTopic, "early is not computed", "telegram, scan", file=two, topics=["scan", "early"])
    refusal(scanhub.NoTopic, "no topic", file=two, topics=[])
    refusal(scanhub.NoTopic, '"left"', "front, rear", file=two, sensor="left")
    refusal(scanhub.Impossible, "several sensors: front, rear", 'sensor="front"', file=two)
    refusal(scanhub.Impossible, "without its scans", file=log, topics="zones")
    refusal(scanhub.Impossible, '"lsm"', "families are lms", file=log, family="lsm")
    refusal(scanhub.Failure, "no.toml", "No such file", file=log, config=os.path.join(place, "no.toml"))
    wrong = write("wrong.toml", b"zones.radius = [1]\n")
    refusal(scanhub.Impossible, wrong, "`radius`", "radii", file=log, config=wrong)
    other = write("other.toml", b'[[link]]\nname = "front"\nport = "/dev/x"\nfamily = "ld"\n')
    remedy = 'set=["link.front.family=lms"]'
    refusal(scanhub.Impossible, "family lms", "family ld", remedy, file=two, config=other)
    assert scanhub.read(two, sensor="front", config=other, set=["link.front.family=lms"]).to_numpy().stamps.size > 100
    refusal(scanhub.Impossible, "family lms, and not ld", "leave the family out", file=log, family="ld")
    refusal(scanhub.Impossible, 'set=["link.front.prot=1"]: unknown key', "port", file=log, set="link.front.prot=1")


def warned(**what) -> "tuple[scanhub.Recording, list[str]]":
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        return scanhub.read(**what), [str(warning.message) for warning in caught]


def remedies_are_what_python_takes() -> None:
    no_mode = os.path.join(place, "no_mode.bin")
    recording, (warning,) = warned(file=no_mode)
    assert 'no scans; set=["link.front.mode=VALUE"]' in warning and not list(recording), warning
    recording, caught = warned(file=no_mode, set=["link.front.mode=1"], system_config=False)
    assert not caught and recording.to_numpy().ranges.shape == (9, 181)
    # The recording names remote sensors, whose links have other names.
    remote = os.path.join(place, "remote.mcap")
    names = scanhub.read(remote).sensors
    assert names == ("robot1-front", "robot1-rear")
    refusal(scanhub.Impossible, 'sensor="robot1-front"', file=remote)
    lengths = [scanhub.read(remote, sensor=name).to_numpy().stamps.size for name in (*names, "robot1.front")]
    assert lengths[0] == lengths[2] > 20, lengths
    os.environ["SCANHUB_CONFIG"] = ""
    assert len(list(scanhub.read(log))) > 50
    del os.environ["SCANHUB_CONFIG"]


def closed_recordings_say_so() -> None:
    def refused(recording: scanhub.Recording) -> None:
        try:
            recording.to_numpy()
        except scanhub.Failure as closed:
            assert "is closed" in str(closed) and closed.remedy == "call scanhub.read again", closed
            return
        raise AssertionError("to_numpy of a closed recording")

    with scanhub.read(log) as recording:
        next(recording)
    refused(recording)
    assert list(recording) == []
    long = scanhub.read(write("long.log", read_bytes(log) * 60), topics=["scan", "lines", "motion", "foreground"])
    threading.Timer(0.1, long.close).start()
    refused(long)


def file_that_becomes_shorter_is_unreadable() -> None:
    for take in (list, scanhub.Recording.to_numpy):
        cut = write("cut.log", read_bytes(log) * 10)
        recording = scanhub.read(cut)
        next(recording)
        os.truncate(cut, os.path.getsize(cut) // 2)
        try:
            take(recording)
        except scanhub.Unreadable as short:
            assert f"{cut} became shorter" in str(short) and "front lacks " in str(short) and short.remedy, short
        else:
            raise AssertionError("nothing was missing")
        assert list(recording) == []


def missing_beams_have_no_angle() -> None:
    counts = (181, 361, 181)
    lines = [f"FLASER {n} {'1.0 ' * n}0 0 0 0 0 0 {at} host {at}\n" for at, n in enumerate(counts)]
    file = write("var.log", "".join(lines).encode())
    ranges, _, angles = scanhub.read(file).to_numpy()
    assert ranges.shape == angles.shape == (3, 361)
    for row, scan in enumerate(scanhub.read(file)):
        assert scan.count == counts[row] and np.array_equal(angles[row, : scan.count], scan.angles)
        assert np.isnan(angles[row, scan.count :]).all() and np.isnan(ranges[row, scan.count :]).all()


def damage_is_a_warning() -> None:
    with open(two, "rb") as file:
        cut = write("cut.mcap", file.read()[:-2000])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert sum(1 for _ in scanhub.read(cut)) > 100
    (warning,) = caught
    assert warning.category is scanhub.RecordingWarning and warning.filename == __file__, warning
    assert f"{cut}: missing: " in str(warning.message), warning


def one_thread_at_a_time_and_no_child() -> None:
    recording = scanhub.read(two)
    next(recording)
    child = os.fork()
    if child == 0:
        try:
            next(recording)
        except scanhub.Failure as refused:
            os._exit(0 if "parent process" in str(refused) else 1)
        os._exit(2)
    assert os.waitpid(child, 0)[1] == 0
    seen = []
    thread = threading.Thread(target=lambda: seen.extend(recording))
    thread.start()
    thread.join()
    assert len(seen) > 200


def control_c_ends_it() -> None:
    long = write("long.log", read_bytes(log) * 60)
    recording = scanhub.read(long, topics=["scan", "lines", "motion", "foreground"])
    sent = []

    def interrupt() -> None:
        sent.append(time.monotonic())
        os.kill(os.getpid(), signal.SIGINT)

    threading.Timer(0.1, interrupt).start()
    try:
        recording.to_numpy()
    except KeyboardInterrupt:
        took = time.monotonic() - sent[0]
        print(f"ended {took:.3f} s after the signal")
        assert took < 2
    else:
        raise AssertionError("the recording is too short for this machine")


def read_bytes(path: str) -> bytes:
    with open(path, "rb") as file:
        return file.read()


def write(name: str, content: bytes) -> str:
    path = os.path.join(place, name)
    with open(path, "wb") as file:
        file.write(content)
    return path


if sys.argv[1] == "dump":
    dump(*sys.argv[2:])
    sys.exit()
two, log, packets, place = sys.argv[2:]
for check in (
    samples_are_those_of_a_subscription,
    arrays_have_all_scans,
    settings_change_the_results,
    what_cannot_be_read,
    remedies_are_what_python_takes,
    closed_recordings_say_so,
    file_that_becomes_shorter_is_unreadable,
    missing_beams_have_no_angle,
    damage_is_a_warning,
    one_thread_at_a_time_and_no_child,
    control_c_ends_it,
):
    check()
    print(check.__name__, flush=True)
