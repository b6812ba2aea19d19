"""JSON-RPC over HTTP with a Pulse Streamer: a connection of its own for each call, and a deadline for the whole of it.

The box answers at port 8050 under /json-rpc (Swabian's clients; docs/reference/hardware.md). Each call has a connection
of its own, as in these clients, so that a call that hangs holds up no other, least of all one that takes the gate low.
The number in an answer is not compared with that of the question: newer clients that do so refuse the box's answers.
"""

import http.client
import io
import itertools
import json
import re
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
RETRY_S = 0.3
"""Time for which a connection that is refused, or closed without a word, is tried again: the box may serve another."""
_RETRY_PAUSE_S = 0.005
_MOST_BYTES = 65_536
"""Longer than any answer."""
_LENGTH = re.compile(rb"(?im)^content-length:[ \t]*(\d{1,9})")
_CHUNKED = re.compile(rb"(?im)^transfer-encoding:.*chunked")


class JsonRpc:
    """Calls to one box. May be used from any thread."""

    def __init__(self, name: str, address: str, tap: Tap | None = None) -> None:
        """Look the host up, once. name: the device's name in messages; address: "host" or "host:port".

        Raises `DeviceNotFound` for an address that is none or a host that is not known.
        """
        self._name, self._address, self._tap = name, address, tap
        self._numbers = itertools.count(1)
        host, colon, port = address.partition(":")
        if not host or (colon and not (port.isascii() and port.isdigit() and 0 < int(port) < 65_536)):
            raise DeviceNotFound(f"{name}: {address!r} is no address; write 'port' as host or host:port")
        try:
            found = socket.getaddrinfo(host, int(port or PORT), socket.AF_INET, socket.SOCK_STREAM)
        except (OSError, UnicodeError) as error:
            raise DeviceNotFound(f"{name}: {host!r} is not known ({one_line(error)}); correct 'port'") from None
        self._peer: tuple[Any, ...] = found[0][4]

    def call(self, method: str, *params: Any, within_s: float = CALL_S) -> Any:
        """Call a method of the box and return its result.

        Raises `DeviceDisconnected` if the box cannot be reached, `DeviceTimeout` if it does not answer in time,
        `CommandRefused` with the box's own words, or `ProtocolError` for an answer that is no JSON-RPC.
        """
        asked = {"jsonrpc": "2.0", "id": next(self._numbers), "method": method, "params": params}
        body = json.dumps(asked).encode()
        head = (
            f"POST /json-rpc HTTP/1.1\r\nHost: {self._peer[0]}:{self._peer[1]}\r\nConnection: close\r\n"
            f"Content-Type: application/json\r\nContent-Length: {len(body)}\r\n\r\n"
        )
        self._note(OUT, body)
        raw = self._exchange(method, head.encode() + body, within_s)
        try:
            response = http.client.HTTPResponse(_Heard(raw))  # type: ignore[arg-type]
            response.begin()
            text = response.read()
            self._note(IN, text)
            answer = parse_json(text)
        except (http.client.HTTPException, ValueError):
            answer = None
        if isinstance(answer, dict) and answer.get("error") is not None:
            error = answer["error"]
            said = error.get("message", error) if isinstance(error, dict) else error
            raise CommandRefused(f"{self._name} refuses {method}: {one_line(Exception(said))}; update its firmware")
        if not isinstance(answer, dict) or "result" not in answer:
            raise ProtocolError(
                f"{self._name}: {raw[:80]!r} is no answer to {method}; is {self._address} a Pulse Streamer?"
            )
        return answer["result"]

    def _exchange(self, method: str, question: bytes, within_s: float) -> bytes:
        """Send a question; returns the bytes of its answer."""
        begun = time.monotonic()
        while True:
            reached = False
            try:
                with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as link:
                    link.settimeout(_left_s(begun + within_s))
                    link.connect(self._peer)
                    reached = True
                    link.settimeout(_left_s(begun + within_s))
                    link.sendall(question)  # its time-out is that of the whole
                    return self._received(method, link, begun + within_s)
            except TimeoutError:
                if reached:
                    raise DeviceTimeout(
                        f"{self._name} did not answer {method} within {within_s:g} s at {self._address}; power-cycle it"
                    ) from None
                raise DeviceDisconnected(
                    f"{self._name}: no connection to {self._address} within {within_s:g} s; check its power and cable"
                ) from None
            except OSError as error:
                again = isinstance(error, ConnectionError) and time.monotonic() - begun < RETRY_S
                if not again:
                    raise DeviceDisconnected(
                        f"{self._name} cannot be reached at {self._address} ({one_line(error)}); check power and cable"
                    ) from None
                time.sleep(_RETRY_PAUSE_S)

    def _received(self, method: str, link: socket.socket, ends_at: float) -> bytes:
        data = b""
        while not _whole(data):
            link.settimeout(_left_s(ends_at))
            piece = link.recv(_MOST_BYTES)
            if not piece and not data:
                raise ConnectionResetError("closed without an answer")
            data += piece
            if len(data) > _MOST_BYTES:
                raise ProtocolError(f"{self._name} answers {method} with more than {_MOST_BYTES} bytes: noise")
            if not piece:
                break
        return data

    def _note(self, direction: str, data: bytes) -> None:
        if self._tap is not None:
            self._tap.note("tcp", direction, data)


class _Heard:
    """Bytes that were received, in the place of the socket from which `HTTPResponse` reads."""

    def __init__(self, data: bytes) -> None:
        self._data = data

    def makefile(self, _mode: str) -> io.BytesIO:
        return io.BytesIO(self._data)


def _whole(data: bytes) -> bool:
    """Whether these bytes are a whole answer. If they do not say how long they are, the end of the connection shows."""
    head, gap, body = data.partition(b"\r\n\r\n")
    if not gap:
        return False
    if _CHUNKED.search(head):
        return body.endswith(b"0\r\n\r\n")
    length = _LENGTH.search(head)
    return length is not None and len(body) >= int(length[1])


def _left_s(ends_at: float) -> float:
    left_s = ends_at - time.monotonic()
    if left_s <= 0:
        raise TimeoutError
    return left_s
