"""From a topic that a program publishes to its service in shared memory, and what wakes its consumers, in every language.
Refuses to know what is in a sample, and who else publishes."""

from __future__ import annotations

import ctypes
import errno
import os
import time
import traceback
from typing import Any, Callable

import iceoryx2 as iox2

from . import layout, lock, trouble
from .bell import Ringer
from .errors import Failure, Short
from .memory import Kept, Membership, payload
from .names import TopicName, service
from .sample import Sample


class Outlet(Kept):
    """The publisher's end of a topic that is the only one of its name. Made with all memory that it may need: Short,
    Mismatch, Denied, Failure."""

    def __init__(self, membership: Membership, name: TopicName, kind: type[Sample]) -> None:
        samples = _WAITING + _CONSUMERS * _BORROWED + _LOANED
        trouble.check_room(_DESCRIPTORS, samples * (ctypes.sizeof(kind.struct) + _CHUNK_HEADER) + 2 * _SERVICE)
        self._name = name
        # First what wakes: who finds the topic sleeps at it.
        self._ringer = Ringer(membership.prefix, name.sensor)
        try:
            wake = service(name.sensor, "wake")
            self._event = _made(membership, wake, "an event", lambda: _event(membership.service(wake)))
            notifier = self._event.notifier_builder().default_event_id(_TELEGRAM)
            self._notifier = membership.port(wake, notifier)
            types = trouble.types(kind.struct)
            topic = _made(membership, name.service, types, lambda: _topic(lambda: membership.service(name.service), kind))
            samples = _WAITING + topic.static_config.max_subscribers * _BORROWED + _LOANED
            publisher = topic.publisher_builder().max_loaned_samples(_LOANED)
            self._publisher = membership.port(name.service, publisher.override_sample_preallocation(samples))
            self._topic = topic
            _allocate(membership.prefix)
        except BaseException:
            self.close()
            raise

    @property
    def subscribers(self) -> int:
        """Consumers that follow it."""
        return self._topic.dynamic_config.number_of_subscribers

    def send(self, header: layout.Header, payload: ctypes.Structure) -> None:
        """Sends a sample, and wakes who follows it. Short if there is no memory for it."""
        try:
            loan = self._publisher.loan_uninit()
            ctypes.memmove(loan.user_header_ptr, ctypes.addressof(header), ctypes.sizeof(header))
            ctypes.memmove(loan.payload_ptr, ctypes.addressof(payload), ctypes.sizeof(payload))
            reached = loan.assume_init().send()
        except (iox2.LoanError, iox2.SendError) as error:
            remedy = "drop samples that are held, or free some of /dev/shm"
            raise Short(f"a sample of {self._name} was not sent: {error}", remedy) from None
        if reached:
            self._ringer.ring()
        if self._event.dynamic_config.number_of_listeners:
            try:
                self._notifier.notify_with_custom_event_id(_TELEGRAM)
            except iox2.NotifierNotifyError:
                # Who is not woken looks ten times a second.
                pass

    def close(self) -> None:
        """Takes the topic away; its consumers keep what they have."""
        self._publisher = self._topic = None
        self._ringer.close()
        self._notifier = self._event = None


def _made(membership: Membership, name: str, ours: str, make: Callable[[], Any]) -> Any:
    """Makes a service of types `ours`; one that its last user is leaving comes back soon."""
    give_up_at = time.monotonic() + _PATIENCE
    while True:
        try:
            with lock.making(membership.domain):
                return make()
        except (OSError, Failure):
            raise
        except Exception as error:  # Each pattern has its own type of error, which share no other parent.
            # Who keeps the failure keeps its frames, and what they hold keeps this process in the domain.
            traceback.clear_frames(error.__traceback__)
            trouble.check_in_flux(membership.domain, name, ours, str(error), time.monotonic() >= give_up_at)
        time.sleep(0.01)


def _event(builder: Any) -> Any:
    builder = builder.event().max_notifiers(4).max_listeners(250).max_nodes(_NODES).event_id_max_value(7)
    builder = builder.notifier_created_event(_HUB_UP).notifier_dropped_event(_HUB_DOWN)
    return builder.notifier_dead_event(_HUB_DOWN).open_or_create()


def _topic(builder: Callable[[], Any], kind: type[Sample]) -> Any:
    def begun() -> Any:
        return builder().publish_subscribe(payload(kind)).user_header(layout.Header)

    revision = iox2.AttributeVerifier.new().require(iox2.AttributeKey.new("revision"), iox2.AttributeValue.new("1"))
    whole = begun().max_publishers(1).max_subscribers(_CONSUMERS).max_nodes(_NODES).history_size(0)
    whole = whole.subscriber_max_buffer_size(_WAITING).subscriber_max_borrowed_samples(_BORROWED)
    try:
        return whole.enable_safe_overflow(True).open_or_create_with_attributes(revision)
    except iox2.PublishSubscribeOpenOrCreateError as error:
        # What a dead one's consumers keep alive has the places that it was made with.
        if "DoesNotSupportRequestedAmountOfSubscribers" not in str(error):
            raise
        return begun().open_with_attributes(revision)


def _allocate(prefix: str) -> None:
    """Makes sure of the memory that was promised: to write into what there is not would end the process."""
    for segment in os.scandir("/dev/shm"):
        try:
            seen = segment.stat(follow_symlinks=False)
            if not segment.name.startswith(prefix) or seen.st_uid != os.geteuid() or not seen.st_size:
                continue
            file = os.open(segment.path, os.O_WRONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
            try:
                os.posix_fallocate(file, 0, seen.st_size)
            finally:
                os.close(file)
        except OSError as error:
            # For any other reason it may be had later all the same.
            if error.errno == errno.ENOSPC:
                what = f"shared memory is short: /dev/shm: no room for {segment.name}: {seen.st_size // 1024} kB"
                raise Short(what, "free some of /dev/shm, then start again") from None


_TELEGRAM, _HUB_UP, _HUB_DOWN = (iox2.EventId.new(number) for number in (1, 3, 4))
"""Why consumers are woken: "Services" in docs/topics.md."""
_WAITING, _CONSUMERS, _BORROWED, _LOANED, _NODES = 64, 32, 4, 2, 260
"""Samples of `tilt` that wait for a consumer; consumers; samples that each may hold, and the publisher; processes: as a topic
of this project's libraries is made."""
_CHUNK_HEADER, _SERVICE = 128, 48 * 1024
"""Bytes before a sample, and of the lists of a service, rounded up."""
_DESCRIPTORS = 16
_PATIENCE = 2.0
