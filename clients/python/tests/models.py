"""Requests background models, and controls a link. Arguments are domain and root. `front` must stream."""

import sys
import time
import warnings

import numpy as np
import scanhub

domain, root = sys.argv[1:]


def ask(*order: str) -> scanhub.Shown:
    return scanhub.background("front", *order, domain=domain, root=root)


def until(what) -> None:
    give_up_at = time.monotonic() + 20
    while not what():
        assert time.monotonic() < give_up_at, "timed out"
        time.sleep(0.05)


def state() -> str:
    return next(scanhub.subscribe("front/status", domain=domain, root=root, timeout=20)).state


def models_are_shown_and_ordered() -> None:
    until(lambda: ask().known_beams > 300)
    model = ask("freeze")
    assert model.frozen and model.count == 361 and model.sensor == "front"
    assert np.isfinite(model.ranges_m).sum() > 200 and abs(model.angles[180]) < 1e-12
    published = next(scanhub.subscribe("front/background", domain=domain, root=root, timeout=20))
    assert published.generation == model.generation and published.count == 361
    anew = ask("reset")
    assert anew.generation == model.generation + 1 and anew.known_beams == 0 and anew.frozen
    assert not ask("thaw").frozen


def the_flow_is_ordered() -> None:
    scanhub.control("front", "pause", domain=domain, root=root)
    until(lambda: state() == "paused")
    paused = scanhub.subscribe("front/scan", domain=domain, root=root, timeout=0.5)

    def reason() -> "tuple[str, str]":
        try:
            next(paused)
            raise AssertionError("it is paused")
        except scanhub.Silent as silent:
            return silent.message, silent.remedy

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        until(lambda: reason() == ("nothing of front/scan in 0.5 s: front is paused", "scanhub control front resume") and caught)
    assert str(caught[0].message) == "nothing yet: front is paused\n  scanhub control front resume", caught[0]
    assert len(caught) == 1 and paused.silent_for() >= 2
    scanhub.control("front", "resume", domain=domain, root=root)
    until(lambda: state() == "streaming")


def refusals_are_the_hubs() -> None:
    try:
        scanhub.background("rear", domain=domain, root=root)
        raise AssertionError("there is no such sensor")
    except scanhub.NoTopic as refused:
        assert "rear" in refused.message and "front" in refused.remedy, refused
    try:
        scanhub.control("robot-with-a-long-name.the-front-one", "resume", domain=domain, root=root)
        raise AssertionError("no other machine's sensor takes orders here")
    except scanhub.NoTopic as refused:
        assert "robot-with" in refused.message, refused


for check in (models_are_shown_and_ordered, the_flow_is_ordered, refusals_are_the_hubs):
    check()
    print(check.__name__, flush=True)
