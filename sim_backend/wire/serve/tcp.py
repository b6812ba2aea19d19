"""Serves a model of a program that speaks TCP: the real driver connects to it with a real socket, on this computer.

It serves one client at a time, as vendors' programs do. Meanwhile it does not listen, and other clients are refused.
"""

import socket
import struct
from contextlib import suppress
from typing import Protocol

from drivers.clock import Clock
from sim_backend.wire.serve.wire_server import WireServer

HOST = "127.0.0.1"
CHUNK_BYTES = 65_536
"""Most bytes that are taken from the model at a time."""
_TURN_S = 0.002
"""Length of one turn of the serving thread while no byte moves."""


class TcpModel(Protocol):
    """A program behind a port: a pure state machine that is given bytes and a time. No threads, no waiting.

    A model that ends connections itself has an attribute `hung_up`, which is true from then until the next client.
    """

    def connected(self, now_s: float) -> None:
        """Note that a client has connected."""

    def receive(self, data: bytes, now_s: float) -> None:
        """Take bytes from the client, in pieces of any size."""

    def send(self, limit: int, now_s: float) -> bytes:
        """The next bytes for the client, at most `limit`; b"" if there are none yet."""

    def disconnected(self, now_s: float) -> None:
        """Note that the client is gone."""


class TcpServer(WireServer[TcpModel]):
    """A program that serves one client."""

    def __init__(self, model: TcpModel, *, clock: Clock | None = None) -> None:
        super().__init__(model, clock)
        self._port = 0
        self._listener: socket.socket | None = None
        self._client: socket.socket | None = None

    @property
    def address(self) -> str:
        """Address at which a client finds the device."""
        return f"{HOST}:{self._port}"

    def plug(self) -> None:
        """Start the program. It listens on any free port the first time, later on the same one."""
        with self.lock:
            if self._listener is None and self._client is None:
                self._listen()

    def unplug(self) -> None:
        """End the program. The client's connection is reset, and new ones are refused."""
        with self.lock:
            if self._listener is not None:
                self._listener.close()
                self._listener = None
            self._drop_client()

    def _listen(self) -> None:
        self._listener = socket.create_server((HOST, self._port), backlog=1)
        self._listener.setblocking(False)
        self._port = self._listener.getsockname()[1]

    def _serve(self) -> None:
        while not self._ending.is_set():
            with self.lock:
                moved = not self._hung and self._turn()
            if not moved:
                self._ending.wait(_TURN_S)

    def _turn(self) -> bool:
        """Accept, take, answer; returns whether anything moved."""
        now_s = self._now_s()
        if self._client is None:
            return self._accept(now_s)
        took = self._take(now_s)
        gave = self._give(now_s)
        if self._client is not None and not self._outbox and getattr(self.model, "hung_up", False):
            self._hang_up(reset=False)
        return gave or took

    def _accept(self, now_s: float) -> bool:
        if self._listener is None:
            return False
        try:
            self._client, _ = self._listener.accept()
        except OSError:
            return False
        self._listener.close()  # refuses everybody else from now on
        self._listener = None
        self._client.setblocking(False)
        self._outbox.clear()
        self._free_at = 0.0
        self.model.connected(now_s)
        return True

    def _take(self, now_s: float) -> bool:
        assert self._client is not None, "asked for by the turn"
        try:
            data = self._client.recv(CHUNK_BYTES)
        except BlockingIOError:
            return False
        except OSError:
            data = b""
        if data:
            self.model.receive(data, now_s)
        else:
            self._hang_up()
        return True

    def _give(self, now_s: float) -> bool:
        """Send what is due. Ask the model for more only when all is sent: until then a real program blocks in send."""
        if self._client is None:
            return False
        if not self._outbox and self._wire_s() >= self._free_at:
            self._reply(self.model.send(CHUNK_BYTES, now_s))
        now, moved = self._wire_s(), False
        while self._client is not None and self._outbox and self._outbox[0][0] <= now:
            due_at, data = self._outbox.popleft()
            sent = self._send(data)
            moved = moved or sent > 0
            if sent < len(data):
                self._outbox.appendleft((due_at, data[sent:]))
                break
        return moved

    def _send(self, data: bytes) -> int:
        assert self._client is not None, "asked for by the caller"
        try:
            return self._client.send(data)
        except BlockingIOError:
            return 0
        except OSError:
            self._hang_up()
            return len(data)

    def _hang_up(self, *, reset: bool = True) -> None:
        """End the connection, and take the next client; at once, since this one may come back as soon as it notices."""
        self._listen()
        self._drop_client(reset=reset)

    def _drop_client(self, *, reset: bool = True) -> None:
        """End the connection. reset: whether to reset it, as when a program ends; else what was sent still arrives."""
        if self._client is None:
            return
        if reset:
            with suppress(OSError):
                self._client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self._client.close()
        self._client = None
        self._outbox.clear()
        self.model.disconnected(self._now_s())
