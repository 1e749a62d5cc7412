"""What goes wrong, in the words of who has to do something about it: a message and a remedy."""

from __future__ import annotations


class Failure(Exception):
    """What happened, and in `remedy` what would be right; the remedy may be empty."""

    def __init__(self, message: str, remedy: str = "") -> None:
        super().__init__(message)
        self.message = message
        self.remedy = remedy

    def __str__(self) -> str:
        return f"{self.message}\n  {self.remedy}" if self.remedy else self.message


class NoHub(Failure):
    """No hub lives in the domain, or it went away before it answered."""


class NoTopic(Failure):
    """What was named is no topic, or the hub has no such sensor."""


class Silent(Failure, TimeoutError):
    """There is a hub, and nothing came within the time allowed."""


class Mismatch(Failure):
    """The hub speaks of something else: another layout, or another version of iceoryx2."""


class Denied(Failure):
    """The domain is another user's."""


class Short(Failure):
    """Shared memory, descriptors or places for consumers are short: try later."""


class Held(Failure):
    """More samples of a topic are kept than a consumer may have at a time."""


class Impossible(Failure, ValueError):
    """A name or a value that cannot be right."""


class Refused(Failure):
    """The hub does not do what it was asked for."""
