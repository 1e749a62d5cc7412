"""What is known of a sensor that warns early, as the vectors say that Rust is tested with: the argument is their file."""

import sys
from pathlib import Path

from scanhub.processed import VERDICTS
from scanhub.warned import Said, Scan, Warned


def scan_of(word: str) -> Scan:
    return Scan(*map(int, word.split(":")))


def said_of(verdict: str, nearest: str) -> Said:
    return Said(VERDICTS[min(int(verdict), 3)], None if nearest == "-" else int(nearest))


def written(said: "Said | None") -> str:
    if said is None:
        return "old"
    return f"{VERDICTS.index(said.verdict)} {'-' if said.nearest_mm is None else said.nearest_mm}"


warned, steps = Warned(), 0
for number, line in enumerate(Path(sys.argv[1]).read_text().splitlines(), 1):
    step, _, known = line.partition(" => ")
    kind, *words = step.split(" ")
    if kind in ("", "#"):
        continue
    elif kind == "begin":
        warned = Warned()
        continue
    elif kind == "zones":
        told = warned.hear(said_of(*words[1:]), scan_of(words[0]))
    elif kind == "silence":
        told = warned.hear(Said("unknown", None), None)
    elif kind == "early":
        told = warned.warn(said_of(*words[1:]), False, scan_of(words[0]))
    else:
        assert kind == "withdrawn", line
        told = warned.warn(Said("stop", 500), True, scan_of(words[0]))
    assert written(told) == known, (number, line, told)
    steps += 1
assert steps > 40, steps
