"""Examines the bridge like a ROS 2 node, but without ROS: with zenoh-ros2-sdk (graph and subscribers) and rosbags
(types, hashes, CDR) from PyPI. Compares scans with the scans that subscribers of the hub received. Prints one JSON
object.

Usage: ros2.py PORT DOMAIN_ID SECONDS ECHO... Each ECHO is a file to which `scanhub echo SENSOR/scan --json` writes
during the test."""

import json
import math
import sys
import time

import numpy
from rosbags.typesys import Stores, get_typestore
from zenoh_ros2_sdk import ROS2Subscriber
from zenoh_ros2_sdk.attachment import Attachment
from zenoh_ros2_sdk.discovery import get_topic_info, get_topic_names_and_types
from zenoh_ros2_sdk.keyexpr import topic_keyexpr
from zenoh_ros2_sdk.qos import QosProfile
from zenoh_ros2_sdk.session import ZenohSession
from zenoh_ros2_sdk.utils import compute_type_hash_from_msg, ros2_to_dds_type

port, domain, seconds, echoes = int(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3]), sys.argv[4:]
here = {"domain_id": domain, "router_ip": "127.0.0.1", "router_port": port}
store = get_typestore(Stores.ROS2_JAZZY)


def text(name):
    """Returns rosbags' definition of a type, with the definitions of all types that it contains."""
    return store.generate_msgdef(name, ros_version=2)[0]


def sdk_hash(name):
    """Returns the hash that zenoh-ros2-sdk computes from the definition of a type."""
    first, *others = text(name).split("=" * 80 + "\nMSG: ")
    contained = {}
    for other in others:
        of, fields = other.split("\n", 1)
        contained["/msg/".join(of.split("/"))] = fields
    return compute_type_hash_from_msg(name, first, dependencies=contained)


def graph():
    topics = {}
    for name, types in get_topic_names_and_types(**here, timeout=2.0):
        info = get_topic_info(name, **here, timeout=2.0, verbose=True)
        for publisher in info.publishers:
            qos = QosProfile.decode(publisher.qos)
            topics[name] = {
                "type": types[0],
                "hash": publisher.type_hash,
                "rosbags_hash": store.hash_rihs01(types[0]),
                "sdk_hash": sdk_hash(types[0]),
                "node": publisher.node_name,
                "namespace": publisher.node_namespace,
                "reliability": qos.reliability.name,
                "durability": qos.durability.name,
                "depth": qos.history_depth,
            }
    return topics


def published(path):
    """Returns the scans in a file of JSON lines, by their `wall_ns`."""
    scans = {}
    with open(path) as lines:
        for line in lines:
            try:
                scan = json.loads(line)
            except ValueError:
                break  # The line is still being written.
            if scan["class"] == "scan":
                scans[scan["wall_ns"]] = scan
    return scans


def stamp_ns(header):
    return header.stamp.sec * 1_000_000_000 + header.stamp.nanosec


def apart(message, scan):
    """Returns the largest difference between angles of `message` and `scan`, in radians, and whether every range of
    `message` is the float nearest to the range in `scan`."""
    first, step = math.radians(scan["first_angle_deg"]), math.radians(scan["step_deg"])
    turned = step < 0
    if turned:
        first, step = first + (scan["count"] - 1) * step, -step
    angles = [message.angle_min - first, message.angle_increment - step]
    angles.append(message.angle_max - first - (scan["count"] - 1) * step)
    wanted = scan["ranges"][::-1] if turned else scan["ranges"]
    got = numpy.asarray(message.ranges, dtype=numpy.float32)
    if len(got) != len(wanted):
        return max(map(abs, angles)), False
    unit = scan["unit_um"]
    equal = all(
        not math.isfinite(range_m) if value is None else range_m == numpy.float32(value * unit / 1e6) or value == 0
        for range_m, value in zip(got, wanted)
    )
    return max(map(abs, angles)), equal


def main():
    deadline = time.monotonic() + 20
    while len(topics := graph()) < 6 + 5 * (len(echoes) - 1) + 1 and time.monotonic() < deadline:
        time.sleep(0.2)
    received = {name: [] for name in topics}
    attached = []
    subscribers = [
        ROS2Subscriber(
            name,
            topic["type"],
            received[name].append,
            msg_definition=text(topic["type"]),
            type_hash=topic["hash"],
            qos=":1:,1:,:,:,," if topic["durability"] == "TRANSIENT_LOCAL" else None,
            **here,
        )
        for name, topic in topics.items()
    ]
    scans = sorted(name for name in topics if name.endswith("/scan"))
    key = topic_keyexpr(domain, scans[0], ros2_to_dds_type(topics[scans[0]]["type"]), topics[scans[0]]["hash"])
    session = ZenohSession.get_instance("127.0.0.1", port).session
    raw = session.declare_subscriber(key, lambda sample: attached.append(sample.attachment.to_bytes()))
    time.sleep(seconds)
    raw.undeclare()
    for subscriber in subscribers:
        subscriber.close()
    time.sleep(0.5)
    result = {"topics": topics, "received": {name: len(messages) for name, messages in received.items()}, "scans": {}}
    for path, name in zip(echoes, scans):
        known = list(published(path).values())
        messages = received[name]
        # A message has the stamp of its first beam, and a line of an echo has the stamp of the telegram's start. The
        # difference between the two stamps is the same for every scan of a sensor. It is computed from the first
        # message whose ranges equal the ranges of a scan.
        lag = next((scan["wall_ns"] - stamp_ns(m.header) for m in messages for scan in known if apart(m, scan)[1]), 0)
        wanted = {scan["wall_ns"] - lag: scan for scan in known}
        pairs = [(message, wanted.get(stamp_ns(message.header))) for message in messages]
        found = [(message, scan) for message, scan in pairs if scan]
        between = [t for t in wanted if messages and stamp_ns(messages[0].header) <= t <= stamp_ns(messages[-1].header)]
        differences = [apart(message, scan) for message, scan in found]
        result["scans"][name] = {
            "decoded": len(messages),
            "published": len(between),
            "matched": len(found),
            "lag_ns": lag,
            "angles": max((angle for angle, _ in differences), default=None),
            "ranges_equal": all(equal for _, equal in differences),
            "frames": sorted({message.header.frame_id for message in messages}),
            "beams": sorted({len(message.ranges) for message in messages}),
            "scan_time": sorted({round(float(message.scan_time), 6) for message in messages}),
            "time_increment": sorted({round(float(message.time_increment), 9) for message in messages}),
        }
    numbers = [Attachment.from_bytes(bytes_).sequence_id for bytes_ in attached]
    result["attachments"] = {
        "count": len(numbers),
        "ascend": numbers == sorted(set(numbers)),
        "gids": len({Attachment.from_bytes(bytes_).gid for bytes_ in attached}),
        "length": sorted({len(bytes_) for bytes_ in attached}),
    }
    for name, messages in received.items():
        if name.endswith("/verdict"):
            result.setdefault("verdicts", {})[name] = sorted({message.data for message in messages})
        if name.endswith("/tf_static") and messages:
            result["frames"] = [[t.header.frame_id, t.child_frame_id] for t in messages[-1].transforms]
        if name.endswith("/diagnostics"):
            statuses = [status for message in messages for status in message.status]
            result["diagnostics"] = sorted({(status.name, int(status.level), status.message) for status in statuses})
        if name.endswith("/zones"):
            result.setdefault("zones", {})[name] = sorted({len(message.markers) for message in messages})
    print(json.dumps(result))


main()
