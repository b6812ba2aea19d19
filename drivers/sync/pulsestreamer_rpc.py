"""JSON-RPC over HTTP with a Pulse Streamer: a connection of its own for each call, and a deadline for the whole of it.

The box answers at port 8050 under /json-rpc (docs/reference/devices/pulsestreamer.md). As in Swabian's clients, each
call has a connection of its own, so that one that hangs holds up no other, least of all one that takes the gate low.
The number in an answer is not compared with that of the question: newer clients that do so refuse the box's answers.
"""

import http.client
import itertools
import json
import math
import socket
import time
from typing import Any

from drivers.errors import CommandRefused, DeviceDisconnected, DeviceNotFound, DeviceTimeout, ProtocolError
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
"""Time for which a refused connection, or one closed without a word, is tried again: the box may serve others."""
_REPEATABLE = ("constant", "get", "has", "is")
"""Beginnings of methods that may be called again if the box may have heard them already. A second `stream` could stop a
sequence in its midst, with the gate high."""
_RETRY_PAUSE_S = 0.005
_MOST_BYTES = 65_536
"""Longer than any answer."""


class JsonRpc:
    """Calls to one box. May be used from any thread."""

    def __init__(self, name: str, address: str, tap: Tap | None = None, call_s: float = CALL_S) -> None:
        """Look the host up, once. name: the device's name in messages; address: "host" or "host:port".

        Raises `DeviceNotFound` for a malformed address or an unknown host.
        """
        self._name, self._address, self._tap, self._call_s = name, address, tap, call_s
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
        """Time in which the box may still hear a call that it has not answered; 0 or less if there is none."""
        return self._unanswered_s + LATE_CALLS * self._call_s - time.monotonic()

    def call(self, method: str, *params: Any) -> Any:
        """Call a method of the box and return its result.

        Raises `DeviceDisconnected` if the box cannot be reached, `DeviceTimeout` if it does not answer in time,
        `CommandRefused` with the box's own words, or `ProtocolError` for an answer that is no JSON-RPC.
        """
        body = json.dumps({"jsonrpc": "2.0", "id": next(self._numbers), "method": method, "params": params}).encode()
        self._note(OUT, body)
        text = self._exchange(method, body)
        self._note(IN, text)
        try:
            answer = parse_json(text)
        except ValueError:
            answer = None
        if isinstance(answer, dict) and answer.get("error") is not None:
            error = answer["error"]
            said = error.get("message", error) if isinstance(error, dict) else error
            raise CommandRefused(
                f"{self._name} refuses {method}: {one_line(Exception(said))}; correct the call, or update its firmware"
            )
        if not isinstance(answer, dict) or "result" not in answer:
            raise ProtocolError(
                f"{self._name}: {text[:80]!r} is no answer to {method}; is {self._address} a Pulse Streamer?"
            )
        return answer["result"]

    def _exchange(self, method: str, body: bytes) -> bytes:
        """Send a question; returns the answer as far as it came, or the error's text if it is no HTTP."""
        head = (
            f"POST /json-rpc HTTP/1.1\r\nHost: {self._peer[0]}:{self._peer[1]}\r\nConnection: close\r\n"
            f"Content-Type: application/json\r\nContent-Length: {len(body)}\r\n\r\n"
        )
        begun = time.monotonic()
        while True:
            reached = False
            try:
                with _Link(begun + self._call_s) as link:
                    link.connect(self._peer)
                    reached = True
                    link.sendall(head.encode() + body)
                    with http.client.HTTPResponse(link) as answer:
                        answer.begin()
                        return answer.read(_MOST_BYTES)
            except TimeoutError:
                where = f"within {self._call_s:g} s at {self._address}"
                if reached:
                    self._unanswered_s = time.monotonic()
                    raise DeviceTimeout(f"{self._name} did not answer {method} {where}; power-cycle it") from None
                raise DeviceDisconnected(
                    f"{self._name}: no connection {where}; check its power, its cable and 'port'"
                ) from None
            except OSError as error:
                again = isinstance(error, ConnectionError) and (not reached or method.startswith(_REPEATABLE))
                if not again or time.monotonic() - begun > RETRY_S:
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


class _Link(socket.socket):
    """A connection on which all waits together end at `ends_at`, a time of `time.monotonic`."""

    def __init__(self, ends_at: float) -> None:
        super().__init__(socket.AF_INET, socket.SOCK_STREAM)
        self._ends_at = ends_at

    def connect(self, address: Any) -> None:
        self._limit()
        super().connect(address)

    def sendall(self, *arguments: Any) -> None:
        self._limit()
        super().sendall(*arguments)

    def recv_into(self, *arguments: Any) -> int:
        self._limit()
        return super().recv_into(*arguments)

    def _limit(self) -> None:
        left_s = self._ends_at - time.monotonic()
        if left_s <= 0:
            raise TimeoutError
        self.settimeout(left_s)
