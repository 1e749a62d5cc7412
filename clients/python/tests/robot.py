"""Subscribes to the verdict of a robot, and prints each verdict as a line of JSON. Arguments are domain, root and
sensors, and optionally `--early` before them. Every tenth verdict is also requested with `now`, which never waits.
Ctrl-C ends the program, which then prints a last line. With `--asked` in place of sensors, prints the result of `now`
for each line of stdin."""

import json
import os
import sys
import time
from dataclasses import asdict

import scanhub


def say(line: dict) -> None:
    """Writes a line with one system call, so that Ctrl-C leaves no partial line."""
    written = (json.dumps(line) + "\n").encode()
    assert os.write(sys.stdout.fileno(), written) == len(written)


def refused(what) -> None:
    try:
        what()
    except scanhub.Impossible:
        return
    raise AssertionError("a name that is not possible")


domain, root, *sensors = sys.argv[1:]
refused(lambda: scanhub.robot("front", "Front"))
refused(lambda: scanhub.robot("robot"))
with scanhub.robot(domain=domain, root=root) as asked:
    assert asked.now() == scanhub.Robot() and asked.now().verdict == "unknown", "no verdict was received yet"
assert asked.now() == scanhub.Robot() and list(asked) == [], "it was closed"

if sensors == ["--asked"]:
    robot = scanhub.robot(domain=domain, root=root)
    for _ in sys.stdin:
        say({"class": "now", **asdict(robot.now())})
    sys.exit()

early = sensors[:1] == ["--early"]
robot = scanhub.robot(*sensors[early:], domain=domain, root=root, early=early)
try:
    for number, now in enumerate(robot):
        say({"class": "robot", **asdict(now)})
        if number % 10 == 0:
            begin = time.monotonic()
            now = robot.now()
            say({"class": "now", **asdict(now), "took_s": time.monotonic() - begin})
except KeyboardInterrupt:
    say({"class": "end"})
