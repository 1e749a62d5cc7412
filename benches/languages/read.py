"""Reads the scans of a recording into arrays, and prints the time that it took: `took NS BEAMS`. Argument: FILE."""

import sys
import time

import scanhub

begin = time.monotonic_ns()
beams = 0
for sensor in ("front", "rear"):
    ranges, stamps, angles = scanhub.read(sys.argv[1], sensor=sensor).to_numpy()
    beams += ranges.size
print(f"took {time.monotonic_ns() - begin} {beams}")
print("end")
