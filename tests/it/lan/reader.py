"""Reads datagrams with clients/python/scanhub_lan.py.

Each line of stdin has the hexadecimal digits of a datagram. The digits of a key and a colon may precede them. For each
datagram, prints a line of JSON in the format of the list of golden datagrams. If `@` and the second at which the
datagram arrives follow the key, the printed line has the outcome instead, which depends on earlier datagrams.
"""

import dataclasses
import json
import math
import sys

import scanhub_lan

try:
    import numpy
except ImportError:
    numpy = None
    print("there is no numpy: the view of ranges is not tested", file=sys.stderr)


def plain(value):
    """Converts bytes to hexadecimal digits, because JSON has no bytes."""
    return value.hex() if isinstance(value, bytes) else value


def says(datagram):
    payload = datagram.unpack()
    out = {name: plain(value) for name, value in dataclasses.asdict(payload).items()}
    if datagram.topic == "events":
        out["from"], out["to"] = out.pop("from_room"), out.pop("to_room")
    if datagram.topic == "tilt" and math.isnan(out["rate_rad_s"]):
        out["rate_rad_s"] = None
    if datagram.topic == "cloud":
        for point in out["points"]:
            point["class"] = point.pop("point_class")
    if datagram.topic == "announce":
        out["boot"] = f"{payload.boot:016x}"
    if datagram.topic == "telegram":
        # The list of golden datagrams has the family as a number in the head, not in the payload.
        assert out.pop("family") == scanhub_lan.FAMILIES[datagram.family]
    if datagram.topic == "scan":
        # The list has the values that are computed from these fields instead of the fields.
        for name in ("payload", "first_beam_ns", "turns", "turn_ns", "exact"):
            del out[name]
        out["codes"], out["times_ns"], out["upper"] = payload.codes(), payload.times_ns(), list(payload.upper)
        # JSON has neither nan nor infinity.
        out["angles"] = [angle if math.isfinite(angle) else None for angle in payload.exact]
        out["m"] = payload.ranges_m()
        assert all(math.isnan(known) or known == angle for known, angle in zip(payload.exact, payload.angles()))
        grid = [payload.first_angle + i * payload.step for i in range(payload.count)]
        assert payload.exact or payload.angles() == grid
        if numpy is not None:
            view = payload.view()
            assert view.dtype == numpy.uint16 and not view.flags.writeable and not view.flags.owndata
            assert tuple(view.tolist()) == payload.ranges
    head = {name: getattr(datagram, name) for name in "flags epoch sequence stamp_ns sensor part parts family revision counter".split()}
    head.update(topic=datagram.number, hub=f"{datagram.hub:016x}", payload_len=len(datagram.payload))
    return {"head": head, "authenticated": datagram.authenticated, "payload": out}


def whole(datagrams):
    """Reassembles the parts in these datagrams. Returns the payload, or None if it is incomplete."""
    parts = scanhub_lan.Parts()
    taken = [parts.take(scanhub_lan.read(datagram)) for datagram in datagrams]
    assert taken[:-1] == [None] * (len(taken) - 1)
    return taken[-1] and taken[-1].payload


assert scanhub_lan.crc32c(b"123456789") == 0xE3069283
if len(sys.argv) > 1:
    print((whole([bytes.fromhex(digits) for digits in sys.argv[1:]]) or b"").hex())
    sys.exit()
guard, parts = scanhub_lan.Guard(), scanhub_lan.Parts()


def outcome(data, key, at_s):
    """Returns the outcome of a datagram that arrives at this second."""
    datagram = guard.take(scanhub_lan.read(data, key), at_s * 1_000_000_000)
    if datagram.parts == 1:
        return "taken"
    whole = parts.take(datagram)
    return "taken" if whole and guard.take(whole) else "part"


for line in sys.stdin:
    key, _, digits = line.strip().rpartition(":")
    key, _, at_s = key.partition("@")
    if at_s:
        try:
            result = outcome(bytes.fromhex(digits), bytes.fromhex(key), int(at_s))
        except scanhub_lan.Refused as refused:
            result = refused.reason
        print(json.dumps({"outcome": result}), flush=True)
        continue
    try:
        out = says(scanhub_lan.read(bytes.fromhex(digits), bytes.fromhex(key) if key else None))
    except scanhub_lan.Refused as refused:
        out = {"refusal": refused.reason}
    print(json.dumps(out), flush=True)
