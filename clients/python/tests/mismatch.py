"""Subscribes to `front/scan` of a hub that uses another layout. Arguments are domain and root."""

import asyncio
import sys

import scanhub


async def follow() -> None:
    async for _ in subscribe():
        raise AssertionError("the layout differs")


def subscribe() -> scanhub.Subscriber:
    return scanhub.subscribe("front/scan", domain=domain, root=root, timeout=20)


domain, root = sys.argv[1:]
for what in (lambda: next(subscribe()), lambda: asyncio.run(follow())):
    try:
        what()
        raise AssertionError("the layout differs")
    except scanhub.Mismatch as refused:
        assert refused.message.endswith("the hub uses another layout") and refused.remedy, refused
