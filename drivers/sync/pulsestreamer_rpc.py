"""JSON-RPC over HTTP with a Pulse Streamer: each call has a connection of its own, and a deadline for the whole call.

The box answers at port 8050 under /json-rpc (docs/reference/devices/pulsestreamer.md). As in Swabian's clients, each
call has a connection of its own, so that one that hangs holds up no other, least of all one that takes the gate low.
The number in an answer is not compared with that of the question: newer clients that do so refuse the box's answers. As
in the vendor's client, boxes are found by a datagram that they answer.
"""

import errno
import http.client
import itertools
import json
import math
import os
import selectors
import socket
import struct
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from drivers.errors import GONE, CommandRefused, DeviceDisconnected, DeviceNotFound, DeviceTimeout, ProtocolError
from drivers.json_text import parse_json
from drivers.transports.endpoints import one_line
from drivers.transports.tap import IN, OUT, Tap

PORT = 8050
CALL_S = 2.0
"""Deadline for a call, from the connection to the end of the answer."""
LATE_CALLS = 5
"""After a call that was not answered, no program is started for so many times the deadline: heard late, the call could
stop the program in its midst, with the gate high."""
RETRY_S = 0.3
"""Time for which a connection that fails, or one closed without a word, is tried again: the box may serve others. A
question with a deadline of its own is tried again until then."""
_QUESTIONS = ("get", "has", "is")
_REPEATABLE = ("constant", *_QUESTIONS)
"""Beginnings of methods that may be called again if the box may have heard them already. A second `stream` could stop a
sequence in its midst, with the gate high."""
_RETRY_PAUSE_S = 0.005
_STEP_S = 0.01
"""Time from one look at what has arrived to the next."""
_MOST_SHOWN = 200
"""Most characters of the box's own words in a message."""
_MOST_BYTES = 65_536
"""Longer than any answer."""
EVERYBODY = (("255.255.255.255", 12_345), ("239.255.255.82", 12_345))
"""Addresses at which boxes are asked who is there: the broadcast, and a multicast group."""
_WHO, _HERE = b"PS-DISCOVERY", b"PS-DISCOVERY-REPLY"


def discover(wait_s: float = 0.5, to: Sequence[tuple[str, int]] = EVERYBODY) -> Iterator[tuple[str, str]]:
    """Numeric address and serial number of each box that answers within `wait_s`. The multicast goes out at every
    network card, the broadcast only at the default one. Ends early, without an error, if the socket fails."""
    ends_at = time.monotonic() + wait_s
    with suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asker:
        asker.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        for index, _ in socket.if_nameindex():
            card = struct.pack("!I", index) if sys.platform == "win32" else struct.pack("=8xi", index)
            for address in to:
                with suppress(OSError):  # the card is not connected
                    asker.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, card)
                    asker.sendto(_WHO, address)
        while (left_s := ends_at - time.monotonic()) > 0:
            asker.settimeout(left_s)
            datagram, sender = asker.recvfrom(2048)
            with suppress(ValueError, KeyError, TypeError):  # from something else
                if datagram.startswith(_HERE):
                    yield sender[0], str(parse_json(datagram.removeprefix(_HERE))["serial"])


class JsonRpc:
    """Calls to one box. May be used from any thread."""

    def __init__(self, name: str, address: str, tap: Tap | None = None, call_s: float = CALL_S) -> None:
        """Look the host up, once. name: the device's name in messages; address: "host" or "host:port".

        Raises `DeviceNotFound` for a malformed address or an unknown host.
        """
        self._name, self._address, self._tap = name, address, tap
        self.call_s = call_s
        """Deadline for a call."""
        self._numbers, self._unanswered_s = itertools.count(1), -math.inf
        host, colon, port = address.partition(":")
        if not host or (colon and not (port.isascii() and port.isdigit() and 0 < int(port) < 65_536)):
            raise DeviceNotFound(f"{name}: {address!r} is no address; write 'port' as host or host:port")
        try:
            found = socket.getaddrinfo(host, int(port or PORT), socket.AF_INET, socket.SOCK_STREAM)
        except (OSError, UnicodeError) as error:
            raise DeviceNotFound(f"{name}: {host!r} is not known ({one_line(error)}); correct 'port'") from None
        self._peer: tuple[Any, ...] = found[0][4]

    @property
    def settles_in_s(self) -> float:
        """Seconds for which the box may still hear a call that it has not answered; 0 or less if there is no such call.
        Questions do not count."""
        return self._unanswered_s + LATE_CALLS * self.call_s - time.monotonic()

    def ask(self, method: str, silence_s: float) -> Any:
        """Ask the box a question and return its answer. After half of `silence_s` seconds ask once more, over another
        connection: if the first packet of a connection is lost, the computer sends it again only after 1 s. Raises as
        `call`."""
        try:
            return self.call(method, within_s=silence_s / 2)
        except GONE:
            return self.call(method, within_s=silence_s / 2)

    def call(self, method: str, *params: Any, within_s: float | None = None) -> Any:
        """Call a method of the box and return its result. within_s: deadline in place of `call_s`.

        Raises `DeviceDisconnected` if the box cannot be reached, `DeviceTimeout` if it does not answer in time,
        `CommandRefused` with the box's own words, or `ProtocolError` for an answer that is no JSON-RPC.
        """
        body = json.dumps({"jsonrpc": "2.0", "id": next(self._numbers), "method": method, "params": params}).encode()
        self._note(OUT, body)
        text = self._exchange(method, body, within_s or self.call_s, within_s or RETRY_S)
        self._note(IN, text)
        try:
            answer = parse_json(text)
        except ValueError:
            answer = None
        if isinstance(answer, dict) and answer.get("error") is not None:
            error = answer["error"]
            said = error.get("message", error) if isinstance(error, dict) else error
            raise CommandRefused(
                f"{self._name} refuses {method}: {one_line(said)[:_MOST_SHOWN]}; correct the call, or update its "
                "firmware"
            )
        if not isinstance(answer, dict) or "result" not in answer:
            raise ProtocolError(
                f"{self._name}: {text[:80]!r} is no answer to {method}; is {self._address} a Pulse Streamer?"
            )
        return answer["result"]

    def _exchange(self, method: str, body: bytes, within_s: float, retry_s: float) -> bytes:
        """Send a question; returns the answer as far as it came, or the error's text if it is no HTTP. retry_s: time
        for which a connection that fails is tried again."""
        head = (
            f"POST /json-rpc HTTP/1.1\r\nHost: {self._peer[0]}:{self._peer[1]}\r\nConnection: close\r\n"
            f"Content-Type: application/json\r\nContent-Length: {len(body)}\r\n\r\n"
        )
        patience, begun_s = _Patience(within_s), time.monotonic()
        while True:
            reached = False
            try:
                with _Link(patience) as link:
                    link.connect(self._peer)
                    reached = True
                    link.sendall(head.encode() + body)
                    with http.client.HTTPResponse(link) as answer:
                        answer.begin()
                        return answer.read(_MOST_BYTES)
            except TimeoutError:
                where = f"within {within_s:g} s at {self._address}"
                if reached:
                    if not method.startswith(_QUESTIONS):
                        self._unanswered_s = time.monotonic()
                    raise DeviceTimeout(f"{self._name} did not answer {method} {where}; power-cycle it") from None
                raise DeviceDisconnected(
                    f"{self._name}: no connection {where}; check its power, its cable and 'port'"
                ) from None
            except OSError as error:
                # Before the connection stands, any error may pass: also that there is no route to the box.
                again = not reached or (isinstance(error, ConnectionError) and method.startswith(_REPEATABLE))
                # Unlike silence, an error has an end that this computer has seen: all the time until then counts.
                patience.left_s = min(patience.left_s - _RETRY_PAUSE_S, within_s - (time.monotonic() - begun_s))
                if not again or patience.left_s < max(within_s - retry_s, 0):
                    raise DeviceDisconnected(
                        f"{self._name} cannot be reached at {self._address} ({one_line(error)}); check its power, its "
                        "cable and 'port'"
                    ) from None
                time.sleep(_RETRY_PAUSE_S)
            except http.client.HTTPException as error:
                return one_line(error).encode()

    def _note(self, direction: str, data: bytes) -> None:
        if self._tap is not None:
            self._tap.note("tcp", direction, data)


@dataclass(slots=True)
class _Patience:
    """Time that is left for the waits of a call."""

    left_s: float

    def wait(self, ready: selectors.BaseSelector) -> None:
        """Wait for a connection. It is looked at before time is judged, and of each look at most two steps count: that
        this computer is late is not the box's silence. Raises `TimeoutError`."""
        came = False
        while not came:
            begun = time.monotonic()
            came = bool(ready.select(_STEP_S if self.left_s > 0 else 0))
            if not came and self.left_s <= 0:
                raise TimeoutError
            self.left_s -= min(time.monotonic() - begun, 2 * _STEP_S)


class _Link(socket.socket):
    """A connection all of whose waits share one patience."""

    def __init__(self, patience: _Patience) -> None:
        super().__init__(socket.AF_INET, socket.SOCK_STREAM)
        self.setblocking(False)
        self._patience = patience

    def connect(self, address: Any) -> None:
        error = self.connect_ex(address)
        if error in (errno.EINPROGRESS, errno.EWOULDBLOCK):
            self._wait(selectors.EVENT_WRITE)
            error = self.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        if error:
            raise OSError(error, os.strerror(error))

    def sendall(self, data: Any, *_: Any) -> None:
        left = memoryview(data)
        while left:
            self._wait(selectors.EVENT_WRITE)
            left = left[self.send(left) :]

    def recv_into(self, *arguments: Any) -> int:
        self._wait(selectors.EVENT_READ)
        return super().recv_into(*arguments)

    def _wait(self, event: int) -> None:
        with selectors.DefaultSelector() as ready:
            ready.register(self, event)
            self._patience.wait(ready)
