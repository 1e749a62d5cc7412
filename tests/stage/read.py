"""Reads recordings with other people's readers alone, and tells of them in JSON."""

import json
import math
import sys

from mcap.exceptions import EndOfFile
from mcap.reader import NonSeekingReader, make_reader


def left(path):
    """How many messages there are in a file without an end."""
    count = 0
    with open(path, "rb") as file:
        try:
            for _ in NonSeekingReader(file).iter_messages(log_time_order=False):
                count += 1
        except EndOfFile:
            pass
    return {"messages": count}


def range_mm(range_m):
    if math.isfinite(range_m):
        return round(range_m * 1000)
    return "nan" if math.isnan(range_m) else "inf" if range_m > 0 else "-inf"


def scans(path, topic):
    """The scans of a topic of ROS 2."""
    from mcap_ros2.decoder import DecoderFactory

    with open(path, "rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        return [
            {
                "frame": scan.header.frame_id,
                "stamp_ns": scan.header.stamp.sec * 1_000_000_000 + scan.header.stamp.nanosec,
                "angle_min": scan.angle_min,
                "angle_increment": scan.angle_increment,
                "ranges_mm": [range_mm(value) for value in scan.ranges],
                "intensities": [int(value) for value in scan.intensities],
            }
            for _, _, _, scan in reader.iter_decoded_messages(topics=[topic])
        ]


verb, path, *rest = sys.argv[1:]
print(json.dumps({"left": left, "scans": scans}[verb](path, *rest)))
