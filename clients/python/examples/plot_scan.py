"""Draws scans as they arrive, x ahead and y to the left, or saves one scan as a picture.

    python plot_scan.py front                    # a window, until it is closed
    python plot_scan.py front --output scan.png

Needs matplotlib: pip install matplotlib
"""

import argparse
import sys

import numpy as np
import scanhub

try:
    import matplotlib
except ImportError:
    sys.exit("plot_scan.py needs matplotlib: pip install matplotlib")


def points_m(scan: scanhub.Scan) -> "tuple[np.ndarray, np.ndarray]":
    """Returns the ends of the beams in the sensor's frame: ahead and to the left, in meters."""
    angles, ranges = scan.angles, scan.ranges_m
    return ranges * np.cos(angles), ranges * np.sin(angles)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sensor", nargs="?", default="front")
    parser.add_argument("--domain", help="of the hub")
    parser.add_argument("--root", help="the directory that the hub was started with")
    parser.add_argument("--output", metavar="FILE", help="draws one scan into it, for example scan.png")
    options = parser.parse_args()
    scans = scanhub.subscribe(f"{options.sensor}/scan", domain=options.domain, root=options.root, timeout=5)
    if options.output:
        matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    if not options.output and plt.get_backend().lower() == "agg":
        sys.exit("plot_scan.py: no window can be shown here: use --output FILE")
    figure, axes = plt.subplots()
    (dots,) = axes.plot([], [], ".", markersize=3)
    axes.plot([0], [0], "^", color="black")
    axes.set(xlabel="m to the left", ylabel="m ahead", aspect="equal")
    axes.invert_xaxis()
    axes.grid(True)
    for scan in scans:
        ahead, left = points_m(scan)
        dots.set_data(left, ahead)
        axes.set_title(f"{scan.sensor}, scan {scan.seq}: {scan.valid.sum()} of {scan.count} beams")
        axes.relim()
        axes.autoscale_view()
        if options.output:
            figure.savefig(options.output, dpi=120)
            break
        # Drawing takes longer than a scan. Scans that arrive in this time are counted as missed.
        plt.pause(0.001)
        if not plt.fignum_exists(figure.number):
            break


if __name__ == "__main__":
    try:
        main()
    except scanhub.Failure as failure:
        sys.exit(f"plot_scan.py: {failure}")
    except KeyboardInterrupt:
        pass
