"""Reads recordings only with readers of other projects, and prints the content as JSON."""

import json
import math
import struct
import sys

from mcap.exceptions import EndOfFile
from mcap.reader import NonSeekingReader


def left(path):
    """Counts the messages in a file that may lack its end."""
    count = 0
    with open(path, "rb") as file:
        try:
            for _ in NonSeekingReader(file).iter_messages(log_time_order=False):
                count += 1
        except EndOfFile:
            pass
    return {"messages": count}


def number(value):
    if math.isfinite(value):
        return float(value)
    return "nan" if math.isnan(value) else "inf" if value > 0 else "-inf"


def header(header):
    return {
        "frame": header.frame_id,
        "stamp_ns": header.stamp.sec * 1_000_000_000 + header.stamp.nanosec,
    }


def content(topic, log_time, message):
    """Returns the content of a ROS 2 message as a dictionary, the same for every reader."""
    line = {"topic": topic, "log_time": log_time}
    if topic == "/tf_static":
        line["transforms"] = [
            header(found.header)
            | {"child": found.child_frame_id}
            | {key: getattr(found.transform.translation, key) for key in "xyz"}
            | {"q" + key: getattr(found.transform.rotation, key) for key in "xyzw"}
            for found in message.transforms
        ]
        return line
    if topic.endswith("/points"):
        line |= header(message.header)
        line["fields"] = [field.name for field in message.fields]
        values = struct.unpack(f"<{4 * message.width}f", bytes(message.data))
        line["points"] = [list(values[at : at + 4]) for at in range(0, len(values), 4)]
        return line
    keys = "angle_min angle_max angle_increment time_increment scan_time range_min range_max"
    line |= header(message.header) | {key: number(getattr(message, key)) for key in keys.split()}
    line["ranges"] = [number(value) for value in message.ranges]
    line["intensities"] = [int(value) for value in message.intensities]
    return line


def mcap_ros2(path):
    """Returns all messages, as mcap-ros2-support reads them."""
    from mcap_ros2.reader import read_ros2_messages

    return [content(found.channel.topic, found.log_time_ns, found.ros_msg) for found in read_ros2_messages(path)]


def rosbags(path):
    """Returns all messages, as rosbags reads them."""
    from pathlib import Path

    from rosbags.highlevel import AnyReader

    with AnyReader([Path(path)]) as reader:
        return [
            content(connection.topic, log_time, reader.deserialize(data, connection.msgtype))
            | {"durability": connection.ext.offered_qos_profiles[0].durability.name}
            for connection, log_time, data in reader.messages()
        ]


verb, path = sys.argv[1:]
print(json.dumps({"left": left, "mcap_ros2": mcap_ros2, "rosbags": rosbags}[verb](path)))
