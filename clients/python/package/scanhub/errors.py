"""Errors and warnings of the package. Each error has a message, and a remedy for the user."""

from __future__ import annotations


class Failure(Exception):
    """Any error of this package. `message` says what happened, and `remedy` how to fix it; the remedy may be empty."""

    def __init__(self, message: str, remedy: str = "") -> None:
        super().__init__(message)
        self.message = message
        self.remedy = remedy

    def __str__(self) -> str:
        return f"{self.message}\n  {self.remedy}" if self.remedy else self.message


class SilenceWarning(UserWarning):
    """Nothing was received for two seconds after the start of a subscription. The text names the reason: there is no
    hub, a sensor or topic is missing, or a scanner is paused or absent."""


class RecordingWarning(UserWarning):
    """A recording is damaged, or does not contain information that is needed to read its values. The text names what is
    missing."""


class Unreadable(Failure, OSError):
    """The file does not exist, cannot be read, or is not a recording."""


class NoHub(Failure):
    """No hub runs in the domain, or the hub ended before it replied."""


class NoTopic(Failure):
    """The name is not a topic, or the hub has no such sensor."""


class Silent(Failure, TimeoutError):
    """A hub runs, but no sample arrived within the timeout."""


class Mismatch(Failure):
    """The hub uses another layout, or another version of iceoryx2."""


class Denied(Failure):
    """The domain belongs to another user."""


class Short(Failure):
    """Shared memory, descriptors or subscriber slots are exhausted: try later."""


class Held(Failure):
    """The program keeps more samples of a topic than a subscriber may hold at a time."""


class Taken(Failure):
    """Another process publishes under the name: a program, or a hub that has a sensor of this name."""


class Impossible(Failure, ValueError):
    """A name or a value is invalid."""


class Refused(Failure):
    """The hub refused the request."""
