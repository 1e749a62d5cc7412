"""Publishes the angles of a mount. Arguments are domain, root and the name of the mount. Each line of stdin is a
sample: angle, rate and stamp, which is 0 for now. The program prints a line when it starts to publish and after each
sample, and exits at the end of stdin."""

import math
import os
import sys

import scanhub


def refused(error: type, what) -> None:
    try:
        what()
    except error as refusal:
        assert refusal.message and str(refusal).startswith(refusal.message), refusal
        return
    raise AssertionError(f"{error} was not raised")


domain, root, name = sys.argv[1:]
place = {"domain": domain, "root": root}
for topic in ("mount/scan", "mount/tracks", "robot1.mount/tilt", "Mount/tilt", "robot/tilt"):
    refused(scanhub.Impossible, lambda: scanhub.publish(topic, **place))
for topic in ("mount", "mount/angles"):
    refused(scanhub.NoTopic, lambda: scanhub.publish(topic, **place))
try:
    with scanhub.publish(f"{name}/tilt", **place) as mount:
        child = os.fork()
        if child == 0:
            refused(scanhub.Failure, lambda: mount.send(0.0))
            # The child exits as any program does. The publication belongs to the parent, so it must not end.
            sys.exit()
        assert os.waitpid(child, 0)[1] == 0
        print('{"class": "open"}', flush=True)
        for line in sys.stdin:
            angle_rad, rate_rad_s, stamp_ns = line.split()
            rate = None if math.isnan(float(rate_rad_s)) else float(rate_rad_s)
            mount.send(angle_rad=float(angle_rad), rate_rad_s=rate, stamp_ns=int(stamp_ns) or None)
            print('{"class": "sent"}', flush=True)
except scanhub.Failure as refusal:
    print(type(refusal).__name__, refusal, file=sys.stderr)
    sys.exit(1)
refused(scanhub.Failure, lambda: mount.send(0.0))
assert mount.subscribers == 0
mount.close()
