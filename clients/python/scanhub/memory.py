"""From a topic to its service in shared memory. Other modules get ports and never see iceoryx2. Refuses to know why a
program waits, and what a sample means."""

from __future__ import annotations

import ctypes
import gc
import os
import time
from typing import Any

import iceoryx2 as iox2

from . import bell, counter, layout, prefix, trouble
from .errors import Held, NoHub, Short
from .names import Domain, TopicName, of_service
from .sample import Sample


class Kept:
    """What a child that a fork makes has of its parent and never gives back, not even at its end: the parent would get no
    more."""


class Membership(Kept):
    """The stay of this process in a domain; Failure if it cannot join.

    The configuration is made here, never read from a file: the library would search the working directory for one.
    Signals stay Python's.
    """

    def __init__(self, domain: Domain) -> None:
        self.domain = domain
        found = prefix.of(domain)
        if found is None:
            what = f"{domain.root} does not contain the name of the shared memory"
            raise NoHub(what, "its hub is just starting or ending, or has another version")
        self.prefix = found
        counter.ensure(self.prefix)
        iox2.set_log_level_from_env_or(iox2.LogLevel.Error)
        builder = iox2.NodeBuilder.new().config(_config(domain, self.prefix))
        try:
            builder = builder.signal_handling_mode(iox2.SignalHandlingMode.Disabled)
            self._node = builder.create(iox2.ServiceType.Ipc)
        except iox2.NodeCreationFailure as error:
            raise trouble.broken(domain, f"cannot join {domain.name}: {error}") from None

    def is_current(self) -> bool:
        """Whether the names of shared memory are still valid: after everything ended, a new hub has others."""
        return prefix.of(self.domain) == self.prefix

    def clean_up(self) -> None:
        """Removes what dead processes left in the domain."""
        self._node.try_cleanup_dead_nodes()

    def leave(self) -> None:
        """Ends the stay, as soon as nothing that was made of it is in use."""
        self._node = None

    def service(self, name: str) -> Any:
        """The builder of a service."""
        return self._node.service_builder(iox2.ServiceName.new(name))

    def listen(self, event: str) -> Any | None:
        """The listener of an event, or None until a hub has made it. Announced to the hub. Raises Failure, Short."""
        factory = self.open(event, self.service(event).event(), "an event")
        return factory and self._announced(event, factory.listener_builder())

    def subscribe(self, name: TopicName, kind: type[Sample]) -> Port | None:
        """The subscriber of a topic, or None until a hub has made it. The hub sends it the next sample. Raises Mismatch,
        Short, Failure."""
        builder = self.service(name.service).publish_subscribe(payload(kind)).user_header(layout.Header)
        factory = self.open(name.service, builder, trouble.types(kind.element or kind.struct))
        return factory and Port(name, kind, self._announced(name.service, factory.subscriber_builder()))

    def _announced(self, service: str, builder: Any) -> Any:
        """Makes a port, and announces it to the publisher of `service`."""
        port = self.port(service, builder)
        bell.announce(self.prefix, service.split("/")[2])
        return port

    def open(self, name: str, builder: Any, ours: str) -> Any | None:
        """Opens a service of types `ours`; one that is not there, or just being made or removed, is nothing."""
        try:
            return builder.open()
        except Exception as error:  # Each pattern has its own type of error, which share no other parent.
            trouble.check_absent(self.domain, name, ours, str(error))
            return None

    def port(self, name: str, builder: Any) -> Any:
        """Makes a port. Raises Short if memory, descriptors or places are short."""
        trouble.check_room()
        try:
            return builder.create()
        except Exception as error:
            raise trouble.no_port(name, str(error)) from None


class Received(Kept):
    """A sample in shared memory. The hub does not reuse its memory while this object, or an array of it, is in use."""

    __slots__ = ("_sample", "_kind", "_data", "header")

    def __init__(self, sample: Any, kind: type[Sample]) -> None:
        self._sample = sample
        self._kind = kind
        self._data: Any = None
        self.header = _header_at(sample.user_header_ptr)

    def data(self) -> Any:
        """The payload as an array of bytes; made on first use, because a program that waits for a sample is in a hurry."""
        if self._data is None:
            kind, sample = self._kind, self._sample
            size = ctypes.sizeof(kind.element) * sample.payload().len() if kind.element else ctypes.sizeof(kind.struct)
            self._data = (ctypes.c_uint8 * size).from_address(sample.payload_ptr)
            self._data.sample = sample
        return self._data


class Port(Kept):
    """A consumer's end of a topic."""

    def __init__(self, name: TopicName, kind: type[Sample], subscriber: Any) -> None:
        self._name = name
        self._kind = kind
        self._subscriber = subscriber
        self._unconnected_since: float | None = None

    def receive(self) -> Received | None:
        """The oldest waiting sample, or None. Raises Held if too many are kept, Short if there is no connection."""
        try:
            sample = self._subscriber.receive()
        except iox2.ReceiveError as error:
            self._refused(str(error))
            return None
        self._unconnected_since = None
        return None if sample is None else Received(sample, self._kind)

    def _refused(self, what: str) -> None:
        if what == "ExceedsMaxBorrows":
            remedy = "let go of them and of their views, or keep `sample.copy()`"
            raise Held(f"four samples of {self._name} are kept, and no more are possible", remedy)
        # Seen while a killed hub's memory is being removed; what stays so is a shortage.
        now = time.monotonic()
        self._unconnected_since = self._unconnected_since or now
        if now - self._unconnected_since > _UNCONNECTED_LIMIT:
            raise Short(f"cannot connect to {self._name}: {what}", "`ulimit -n` or /dev/shm may be too small")


class Wakeups(Kept):
    """What wakes the consumers of several sensors: the hub notifies once per telegram, after its last sample."""

    def __init__(self) -> None:
        builder = iox2.WaitSetBuilder.new().signal_handling_mode(iox2.SignalHandlingMode.Disabled)
        self._set = builder.create(iox2.ServiceType.Ipc)
        self._listeners: list[Any] = []
        self._guards: list[Any] = []

    def add(self, listener: Any) -> None:
        """Adds a sensor that wakes it."""
        self._guards.append(self._set.attach_notification(listener))
        self._listeners.append(listener)

    def wait(self, seconds: float) -> None:
        """Sleeps until one of them is notified, a signal comes, or the time is over; returns at once if one was since
        the caller looked. Other threads run during the wait."""
        try:
            # What was notified stays so until it is taken, and that after receiving, which has more haste.
            if any([listener.try_wait() for listener in self._listeners]):
                return
            if self._listeners:
                self._set.wait_and_process_with_timeout(iox2.Duration.from_nanos(int(seconds * 1e9)))
            else:
                time.sleep(seconds)
        except (iox2.ListenerWaitError, iox2.WaitSetRunError) as error:
            if "Interrupt" not in str(error):
                raise Short(f"cannot wait for the hub: {error}", "`ulimit -n` may be too small") from None


def _keep_the_parents() -> None:
    for found in gc.get_objects():
        if issubclass(type(found), Kept):
            ctypes.pythonapi.Py_IncRef(ctypes.py_object(found))


os.register_at_fork(after_in_child=_keep_the_parents)


def topics(domain: Domain) -> list[TopicName]:
    """All topics of the domain, sorted. Those of a dead hub stay as long as a consumer keeps them."""
    begin = prefix.of(domain)
    if begin is None:
        return []
    try:
        found = iox2.Service.list(_config(domain, begin), iox2.ServiceType.Ipc)
    except Exception as error:
        raise trouble.broken(domain, f"cannot list topics: {error}") from None
    named = {of_service(str(details.name().to_string())) for details in found}
    return sorted(name for name in named if name)


def forget_names(domain: Domain) -> None:
    """Where nobody is left in the domain: the next one there has other names. Only for who holds the lock `making`."""
    begin = prefix.of(domain)
    if begin is None:
        return
    try:
        left = iox2.Node.list(iox2.ServiceType.Ipc, _config(domain, begin))
    except iox2.NodeListFailure as error:
        raise trouble.broken(domain, f"cannot list processes: {error}") from None
    if not left:
        counter.remove(begin)
        prefix.forget(domain)


def _config(domain: Domain, begin: str) -> Any:
    config = iox2.config.default()
    everything = config.global_cfg
    everything.prefix = iox2.FileName.new(begin)
    everything.root_path = iox2.Path.new(domain.root)
    everything.creation_timeout = iox2.Duration.from_millis(100)
    # Cleaning up is the hub's business.
    everything.node.cleanup_dead_nodes_on_creation = False
    everything.node.cleanup_dead_nodes_on_destruction = False
    everything.service.cleanup_dead_nodes_on_open = False
    return config


def payload(kind: type[Sample]) -> Any:
    """As which the samples of a topic lie in shared memory."""
    return iox2.Slice[kind.element] if kind.element else kind.struct


_header_at = layout.Header.from_address
_UNCONNECTED_LIMIT = 3.0
"""Seconds for which a publisher may be just dying that cannot be connected to."""
