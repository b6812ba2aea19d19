"""Serves depth maps to other programs: one thread follows the newest running scan, one accepts connections, and each
client has a thread.

A client gets the newest map as soon as its connection has taken the one before; maps in between are counted, not kept.
So a client that is slow, stops reading or floods costs one map of memory and a thread, and neither the scan nor any
other client notices.
"""

import logging
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from typing import Any, Final

from numpy.typing import NDArray

from rig.errors import UsageError
from rig.live.slot import SlotReader
from rig.requests import StreamRequest
from rig.stream.messages import MOST_HELLO, Hello, MessageKind, message, read_hello
from rig.view.access import Access, listen

_log = logging.getLogger(__name__)

POLL_S: Final = 0.05
"""Time from one look at the scan's slot to the next; a scan writes at most ten maps a second there."""
LOOK_S: Final = 0.5
"""Time from one look for a running scan to the next, while there is none."""
STATUS_S: Final = 1.0
HELLO_S: Final = 5.0
"""Longest wait for a client's first line."""
STUCK_S: Final = 60.0
"""A client that takes nothing for this long is dropped."""
MOST_CLIENTS: Final = 32
_SEND_BUFFER: Final = 1 << 16
"""Bytes that the system may keep of a connection: old maps must not wait there."""


@dataclass(frozen=True, slots=True, eq=False)
class _Newest:
    """State of the stream. run: number of the scan since the server began, 0 before the first. serial: grows with each
    change. index: of the newest map, -1 before the first."""

    run: int = 0
    serial: int = 0
    state: str = "waiting"
    setup: tuple[Mapping[str, Any], Mapping[str, NDArray[Any]]] | None = None
    status: Mapping[str, Any] = field(default_factory=dict)
    index: int = -1
    map: tuple[Mapping[str, Any], Mapping[str, NDArray[Any]]] | None = None


@dataclass(slots=True)
class StreamCounts:
    """Counts of a server. clients: those that were served. refused: those that were refused, for a wrong first line or
    token, or because too many were connected. maps_sent: over all clients."""

    clients: int = 0
    refused: int = 0
    maps_sent: int = 0


class DepthServer:
    """The server. `address` is (host, port) on which it listens. Use it as a context manager, which starts and ends all
    threads.

    Raises UsageError if the address is not one of this computer, the port is taken, or the token is too short or has
    other characters than letters, digits, - and _.
    """

    def __init__(self, request: StreamRequest) -> None:
        self._listening, self._access = listen(Access.to(request.host, request.port, request.token))
        self.token = self._access.token
        """The token that clients must send; None for nobody."""
        self.counts = StreamCounts()
        self._newest = _Newest()
        self._changed = threading.Condition()
        self._over = threading.Event()
        self._clients: set[socket.socket] = set()
        self._served = 0
        self.address: tuple[str, int] = self._listening.getsockname()[:2]
        self._threads = [
            threading.Thread(target=work, name=name, daemon=True)
            for name, work in (("stream follower", self._follow), ("stream listener", self._listen))
        ]

    def __enter__(self) -> "DepthServer":
        """Start to serve."""
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        """Close all connections and end all threads."""
        self._over.set()
        with suppress(OSError):
            self._listening.shutdown(socket.SHUT_RDWR)  # wakes `accept`
        self._listening.close()
        with self._changed:
            for client in self._clients:
                with suppress(OSError):
                    client.shutdown(socket.SHUT_RDWR)
            self._changed.notify_all()
        for thread in self._threads:
            thread.join()

    # The scan

    def _follow(self) -> None:
        while not self._over.is_set():
            try:
                slot = SlotReader.newest()
                if slot is None:
                    self._over.wait(LOOK_S)
                    continue
                with SlotReader.open(slot.path) as reader:
                    self._follow_scan(reader)
            except (OSError, UsageError, KeyError) as error:  # the scan ended meanwhile, or is of another version
                _log.debug("cannot read the running scan: %s", error)
                self._over.wait(LOOK_S)

    def _follow_scan(self, reader: SlotReader) -> None:
        """Follow a scan to its end."""
        run = self._newest.run + 1
        self._change(run=run, state="live", setup=None, status={}, index=-1, map=None)
        numbers = {"setup": 0, "status": 0, "map": 0}
        alive = True
        while alive and not self._over.is_set():
            reader.touch()
            alive = reader.alive  # before reading: what came last is read, too
            for section in numbers:
                value = reader.read(section, numbers[section])
                if value is None:
                    continue
                numbers[section] = value.number
                if section == "status":
                    self._change(status=value.header)
                elif section == "setup":
                    self._change(setup=(value.header, value.arrays))
                else:
                    self._change(map=(value.header, value.arrays), index=int(value.header["index"]))
            self._over.wait(POLL_S)
        if not alive:
            self._change(state="ended")

    def _change(self, **changes: Any) -> None:
        with self._changed:
            self._newest = replace(self._newest, **changes, serial=self._newest.serial + 1)
            self._changed.notify_all()

    # The clients

    def _listen(self) -> None:
        while not self._over.is_set():
            try:
                client, _ = self._listening.accept()
            except OSError:
                if self._over.is_set():
                    return
                self._over.wait(POLL_S)  # no file descriptor is left, for example
                continue
            threading.Thread(target=self._serve, args=(client,), name="stream client", daemon=True).start()

    def _serve(self, client: socket.socket) -> None:
        with client, suppress(OSError), self._connected(client):  # of which a client that goes away is one
            client.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            why, hello = "", None
            try:
                hello = read_hello(_first_line(client))
                why = "" if self._knows(hello) else "the token is missing or wrong; 'rig stream' prints it"
            except ValueError as error:
                why = str(error)
            with self._changed:  # only who has the token takes room
                if not why and self._served >= MOST_CLIENTS:
                    why = f"{MOST_CLIENTS} clients are connected; close one"
                self._served += not why
                self.counts.clients += not why
                self.counts.refused += bool(why)
            if why or hello is None:
                _send(client, message(MessageKind.ERROR, {"error": why}))
                return
            try:
                client.settimeout(STUCK_S)
                self._send_news(client, hello)
            finally:
                with self._changed:
                    self._served -= 1

    @contextmanager
    def _connected(self, client: socket.socket) -> Iterator[None]:
        """A context in which the server's end closes a connection."""
        with self._changed:
            self._clients.add(client)
        try:
            yield
        finally:
            with self._changed:
                self._clients.discard(client)

    def _knows(self, hello: Hello) -> bool:
        return self._access.knows(hello.token)

    def _send_news(self, client: socket.socket, hello: Hello) -> None:
        """Send a client all that is new to it, until it goes away or the server ends."""
        serial, run, setup_of, state = -1, -1, -1, ""
        index: int | None = None
        told_s = -STATUS_S
        while (now := self._next_after(serial)) is not None:
            serial = now.serial
            if now.run != run:  # maps of before the client came are none that it missed
                index = None if run == -1 else -1
                run = now.run
            if now.setup is not None and setup_of != run:
                setup_of = run
                _send(client, message(MessageKind.SETUP, {"run": run, **now.setup[0]}, now.setup[1]))
            if now.map is not None and setup_of == run and (index is None or now.index > index):
                header, arrays = now.map
                missed = 0 if index is None else now.index - index - 1
                wanted = {name: arrays[name] for name in hello.arrays if name in arrays}
                _send(client, message(MessageKind.MAP, {"run": run, "missed": missed, **header}, wanted))
                index = now.index
                with self._changed:
                    self.counts.maps_sent += 1
            if now.state != state or time.monotonic() - told_s >= STATUS_S:
                state, told_s = now.state, time.monotonic()
                _send(client, message(MessageKind.STATUS, {"run": run, "state": state, **now.status}))

    def _next_after(self, serial: int) -> _Newest | None:
        """The state once it is another one than that of this number, or after STATUS_S; None at the server's end."""
        with self._changed:
            self._changed.wait_for(lambda: self._newest.serial != serial or self._over.is_set(), STATUS_S)
            return None if self._over.is_set() else self._newest


def serve(request: StreamRequest, *, ready: Callable[[DepthServer], None] | None = None) -> StreamCounts:
    """Serve the depth of running scans until an interrupt (Ctrl-C) (`rig stream`); returns what was served.

    ready: called once clients can connect. Raises UsageError as `DepthServer` does.
    """
    with DepthServer(request) as server:
        try:
            if ready is not None:
                ready(server)
            while True:
                threading.Event().wait(3600)
        except KeyboardInterrupt:
            pass
        return server.counts


def _first_line(client: socket.socket) -> bytes:
    """The first line that a client sends, read within HELLO_S altogether. Raises OSError if it takes longer."""
    line, ends_s = b"", time.monotonic() + HELLO_S
    while b"\n" not in line and len(line) <= MOST_HELLO:
        client.settimeout(max(ends_s - time.monotonic(), 1e-3))  # 0 would mean: do not wait
        piece = client.recv(MOST_HELLO)
        if not piece:
            break
        line += piece
    return line[: line.find(b"\n") + 1] or line


def _send(client: socket.socket, pieces: list[memoryview]) -> None:
    for piece in pieces:
        client.sendall(piece)
