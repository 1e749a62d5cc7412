"""Reads datagrams with clients/python/scanhub_lan.py: a line of hex digits in, behind the hex digits of a key and a colon
where there is one, a line of JSON out, in the words of the list of golden datagrams."""

import dataclasses
import json
import sys

import scanhub_lan

try:
    import numpy
except ImportError:
    numpy = None
    print("there is no numpy: the view of ranges is not tested", file=sys.stderr)


def plain(value):
    """JSON has no bytes."""
    return value.hex() if isinstance(value, bytes) else value


def says(datagram):
    payload = datagram.unpack()
    out = {name: plain(value) for name, value in dataclasses.asdict(payload).items()}
    if datagram.topic == "announce":
        out["boot"] = f"{payload.boot:016x}"
    if datagram.topic == "scan":
        del out["payload"]
        out["upper"] = list(payload.upper)
        out["mm"] = [-1 if range_mm is None else range_mm for range_mm in payload.ranges_mm()]
        if numpy is not None:
            view = payload.view()
            assert view.dtype == numpy.uint16 and not view.flags.writeable and not view.flags.owndata
            assert tuple(view.tolist()) == payload.ranges
    head = {name: getattr(datagram, name) for name in "flags epoch sequence stamp_ns sensor revision counter".split()}
    head.update(topic=datagram.number, hub=f"{datagram.hub:016x}", payload_len=len(datagram.payload))
    return {"head": head, "authenticated": datagram.authenticated, "payload": out}


assert scanhub_lan.crc32c(b"123456789") == 0xE3069283
for line in sys.stdin:
    key, _, digits = line.strip().rpartition(":")
    try:
        out = says(scanhub_lan.read(bytes.fromhex(digits), bytes.fromhex(key) if key else None))
    except scanhub_lan.Refused as refused:
        out = {"refusal": refused.reason}
    print(json.dumps(out), flush=True)
