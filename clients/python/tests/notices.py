"""Subscribes with a callback that fails when the hub ends. Arguments are domain and root. `front` publishes its status,
and its hub ends after this program has printed a line. The program waits for a line of stdin before it prints, and for
another one after the hub has ended."""

import select
import sys
import time

import scanhub


def notice(kind: str) -> None:
    notices.append(kind)
    if kind == "hub_gone":
        raise KeyError(kind)


domain, root = sys.argv[1:]
notices: "list[str]" = []
statuses = scanhub.subscribe("front/status", domain=domain, root=root, timeout=20, on_notice=notice)
while not select.select([sys.stdin], [], [], 0.05)[0]:
    assert statuses._poll() is None
sys.stdin.readline()
print('{"class": "waits"}', flush=True)
sys.stdin.readline()
# Wait until the subscription checks again whether its hub runs.
time.sleep(1.2)
try:
    next(statuses)
    raise AssertionError("the callback failed")
except KeyError:
    pass
assert next(statuses).topic_seq == 7
assert notices == ["hub_back", "hub_gone"], notices
