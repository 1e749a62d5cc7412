"""Requests to a running hub: background models, and the flow of data. They return when the link has accepted them."""

from __future__ import annotations

import ctypes
import os
import struct
import time
from typing import Any

import iceoryx2 as iox2

from .errors import Failure, Impossible, NoHub, NoTopic, Refused, Short, Silent
from .memory import Membership
from .model import Shown
from .names import CONTROL, candidates, check_sensor
from .presence import GRACE, LOOK_EVERY, Presence, find

MODEL_ORDERS = {"show": 16, "reset": 17, "freeze": 18, "thaw": 19}
"""Requests about a background model."""
FLOW_ORDERS = {"pause": 1, "resume": 2, "resync": 3}
"""Requests about the flow of data."""


def background(
    sensor: str, order: str = "show", *, domain: str | None = None, root: str | os.PathLike[str] | None = None
) -> Shown:
    """The background model of `sensor`, after `order` was done: `show`, `reset` (learn again), `freeze` or `thaw`.

    Refused if the hub does not do it, NoTopic if it has no such sensor; NoHub, Silent, Short.
    """
    code = _code(MODEL_ORDERS, order)
    client = _Client(sensor, domain, root)
    if order != "show":
        client.ask(code)
    return Shown(sensor, client.ask(MODEL_ORDERS["show"]))


def control(sensor: str, order: str, *, domain: str | None = None, root: str | os.PathLike[str] | None = None) -> None:
    """Asks the hub to `pause` a sensor, to `resume` its stream, or to restart the session with it (`resync`).

    Raises as `background`.
    """
    code = _code(FLOW_ORDERS, order)
    _Client(sensor, domain, root).ask(code)


def _code(orders: dict[str, int], order: str) -> int:
    if order not in orders:
        raise Impossible(f"no order {order!r}", f"there are {', '.join(orders)}")
    return orders[order]


class _Client:
    """A client's end of the control service."""

    def __init__(self, sensor: str, domain: str | None, root: str | os.PathLike[str] | None) -> None:
        check_sensor(sensor)
        self._sensor = sensor
        place = find(candidates(domain, root))
        self._presence = Presence([place])
        self._membership = Membership(place)
        self._client, self._requests, self._responses = self._open()

    def ask(self, verb: int) -> bytes:
        """The answer of the hub, without its header."""
        # The hub has none with a longer name.
        request = struct.pack("<32sH6x", self._sensor.encode(), verb)
        try:
            loan = self._client.loan_slice_uninit(len(request))
            ctypes.memmove(loan.payload_ptr, request, len(request))
            pending = loan.assume_init().send()
            if pending.number_of_server_connections == 0:
                raise NoHub("no hub takes requests", "start one with `scanhub run`")
            self._requests.notify()
        except (iox2.RequestSendError, iox2.LoanError, iox2.NotifierNotifyError) as error:
            raise Short(f"cannot ask the hub: {error}", "try again later") from None
        return self._answer(pending)

    def _answer(self, pending: Any) -> bytes:
        give_up_at = time.monotonic() + _PATIENCE
        while True:
            # In this order: what was answered before the hub went is an answer.
            self._presence.look()
            lives = pending.is_connected and self._presence.domain is not None
            response = pending.receive()
            if response is not None:
                return _read(bytes(response.payload().as_memory_view()))
            if not lives:
                remedy = f"the result is not known: `scanhub info {self._sensor}` shows the sensor's state"
                raise NoHub("the hub went away before it answered", remedy)
            if time.monotonic() >= give_up_at:
                what = f"the hub did not answer for {self._sensor} in {_PATIENCE:.0f} s"
                raise Silent(what, "its log says whether something is short")
            self._responses.timed_wait(iox2.Duration.from_millis(int(LOOK_EVERY * 1000)))

    def _open(self) -> tuple[Any, Any, Any]:
        """Waits a moment for the service of a hub that is just starting."""
        join, give_up_at = self._membership, time.monotonic() + GRACE
        while True:
            builder = join.service(CONTROL).request_response(_BYTES, _BYTES)
            control = join.open(CONTROL, builder, "bytes")
            asked = join.open(f"{CONTROL}/request", join.service(f"{CONTROL}/request").event(), "an event")
            answers = join.listen(f"{CONTROL}/response")
            if control and asked and answers:
                requests = asked.notifier_builder().default_event_id(iox2.EventId.new(1))
                client = join.port(CONTROL, control.client_builder().initial_max_slice_len(_REQUEST))
                return client, join.port(f"{CONTROL}/request", requests), answers
            if time.monotonic() >= give_up_at:
                raise NoHub("the hub takes no requests", "it may be an older one")
            time.sleep(0.01)


def _read(answer: bytes) -> bytes:
    """Exit code and length of the message, the message, whose second line is a remedy, and what was asked for."""
    try:
        code, length = struct.unpack_from("<HH", answer)
    except struct.error:
        raise Failure("the hub's answer cannot be read", "hub and client are of different versions") from None
    message, _, remedy = answer[4 : 4 + length].decode(errors="replace").partition("\n")
    if code:
        raise _KINDS.get(code, Refused)(message, remedy)
    return answer[4 + length :]


_KINDS: dict[int, type[Failure]] = {3: NoTopic, 75: Short}
"""The errors for exit codes; every other code is Refused."""
_PATIENCE = 5.0
"""Seconds: a link takes a request within milliseconds; one that opens its port may need longer."""
_BYTES: Any = iox2.Slice[ctypes.c_uint8]
_REQUEST = 40
"""Bytes of a request without a model."""
