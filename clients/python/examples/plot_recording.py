"""Plots a scan of a recording and the background that the hub learns from it, x ahead and y to the left.

    python plot_recording.py walk.mcap                    # a window
    python plot_recording.py walk.mcap --sensor front --at 30 --out picture.png

Needs matplotlib: pip install matplotlib
"""

from __future__ import annotations

import argparse
import sys

import numpy as np
import scanhub
from numpy.typing import NDArray

try:
    import matplotlib
except ImportError:
    sys.exit("plot_recording.py needs matplotlib: pip install matplotlib")


def points_m(ranges_m: NDArray[np.float64], angles: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns points in the sensor's frame: ahead and to the left, in meters."""
    return ranges_m * np.cos(angles), ranges_m * np.sin(angles)


def scan_and_background(
    file: str, sensor: str | None, config: str | None, at_s: float
) -> tuple[scanhub.Scan | None, scanhub.Background | None]:
    """Returns the last scan up to `at_s` seconds after the first one, and the background at that time."""
    scan, background, begin_ns = None, None, None
    with scanhub.read(file, topics=["scan", "background"], sensor=sensor, config=config) as recording:
        # Without --sensor, the first sensor of the recording is used.
        chosen = recording.sensors[0]
        for sample in recording:
            if begin_ns is None:
                begin_ns = sample.stamp_ns
            if sample.stamp_ns > begin_ns + at_s * 1e9:
                break
            if sample.sensor != chosen:
                continue
            if isinstance(sample, scanhub.Scan):
                scan = sample
            else:
                background = sample
    return scan, background


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", help="MCAP file, CARMEN log or stream of telegrams")
    parser.add_argument("--sensor", help="default: the first one")
    parser.add_argument("--config", metavar="FILE", help="settings of the hub, such as robot.toml")
    parser.add_argument("--at", metavar="SECONDS", type=float, default=float("inf"), help="default: the end")
    parser.add_argument("--out", metavar="FILE", help="saves the picture, for example as picture.png")
    options = parser.parse_args()
    scan, background = scan_and_background(options.file, options.sensor, options.config, options.at)
    if scan is None:
        sys.exit(f"plot_recording.py: {options.file} has no scan before {options.at} s")
    if options.out:
        matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    if not options.out and plt.get_backend().lower() == "agg":
        sys.exit("plot_recording.py: no window can be shown here: use --out FILE")
    figure, axes = plt.subplots()
    if background is None or background.angles is None or background.known_beams == 0:
        print("the background is not learned yet: --config FILE with a smaller background.scans learns it earlier")
    else:
        ahead, left = points_m(background.ranges_m, background.angles)
        # An infinite range means that the background is beyond the maximum range, so omit it from the picture.
        is_near = np.isfinite(ahead)
        axes.plot(left[is_near], ahead[is_near], "-", color="silver", linewidth=4, label="background")
    ahead, left = points_m(scan.ranges_m, scan.angles)
    axes.plot(left, ahead, ".", markersize=3, label="scan")
    axes.plot([0], [0], "^", color="black")
    axes.set(xlabel="m to the left", ylabel="m ahead", aspect="equal", title=f"{scan.sensor}, scan {scan.seq}")
    axes.invert_xaxis()
    axes.grid(True)
    axes.legend()
    if options.out:
        figure.savefig(options.out, dpi=120)
    else:
        plt.show()


if __name__ == "__main__":
    try:
        main()
    except scanhub.Failure as failure:
        sys.exit(f"plot_recording.py: {failure}")
    except KeyboardInterrupt:
        pass
