"""Until when a verdict may be believed, in made-up time."""

from scanhub import layout
from scanhub.freshness import REMOTE, Freshness, Moment

MS = 1_000_000
PERIOD_US = 26_640
"""Of half degrees: two of them and 40 ms are 93.28 ms."""


def at(ms: int) -> Moment:
    return Moment(ms * MS, ms * MS)


def header(stamp_ms: int, period_us: int = PERIOD_US, flags: int = 0) -> layout.Header:
    return layout.Header(stamp_last_ns=stamp_ms * MS, period_us=period_us, flags=flags)


def one_word_per_silence() -> None:
    freshness = Freshness(at(50))
    assert not freshness.silence(at(1049)) and freshness.silence(at(1050)) and not freshness.silence(at(9000))
    assert freshness.heard(header(100), False, at(100)) and freshness.left(at(100)) == 0.09328
    assert not freshness.silence(at(193)) and freshness.silence(at(194)) and not freshness.silence(at(90_000))
    assert freshness.left(at(195)) == float("inf")
    assert freshness.heard(header(200), True, at(60_000)) and not freshness.silence(at(90_000)), "it is said already"


def what_waited_is_no_news() -> None:
    freshness = Freshness(at(0))
    assert freshness.heard(header(100), False, at(180))
    assert not freshness.silence(at(193)) and freshness.silence(at(194))
    assert not freshness.heard(header(100), False, at(500)), "too old when it came"
    assert not freshness.silence(at(9000)), "which says enough"
    assert freshness.heard(header(99_999), False, at(600))
    assert not freshness.silence(at(693)) and freshness.silence(at(694)), "a stamp in the future"


def time_passes_while_the_machine_is_suspended() -> None:
    freshness = Freshness(at(0))
    freshness.heard(header(100), False, at(100))
    assert freshness.silence(Moment(110 * MS, 3_600_000 * MS))


def a_network_has_half_a_second_at_least() -> None:
    for period_us, seconds in ((0, 0.5), (PERIOD_US, 0.5), (230_000, 0.5), (1_000_000, 2.04)):
        freshness = Freshness(at(0))
        freshness.heard(header(100, period_us, REMOTE), False, at(100))
        assert freshness.left(at(100)) == seconds, period_us


one_word_per_silence()
what_waited_is_no_news()
time_passes_while_the_machine_is_suspended()
a_network_has_half_a_second_at_least()
