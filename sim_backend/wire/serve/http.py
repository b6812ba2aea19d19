"""Serves a model of a device that speaks JSON-RPC over HTTP: the vendor's own client connects to it, on this computer.

Such clients fix the port. Every server therefore has a loopback address of its own (127.x.y.z, all of which Linux
answers) and listens on the device's true ports there. A model may have a second port, to which clients send bytes.
"""

import json
import random
import selectors
import socket
import socketserver
import struct
import sys
from contextlib import suppress
from http.server import BaseHTTPRequestHandler
from typing import Any, Protocol

from drivers.clock import Clock
from sim_backend.wire.serve.wire_server import WireServer

CHUNK_BYTES = 65_536
PARSE_ERROR, INVALID_REQUEST = -32700, -32600
"""Codes of JSON-RPC 2.0."""
_TURN_S = 0.01
_ATTEMPTS = 20
"""Loopback addresses that are tried before the server gives up."""


class RpcModel(Protocol):
    """A device behind a network socket: a pure state machine that is given calls and a time. No threads, no waiting."""

    http_port: int
    http_path: str
    raw_port: int | None
    """TCP port that takes bytes; None: the device has none."""

    def call(self, method: str, params: list[Any], now_s: float) -> Any:
        """The result of a call. May raise an exception with a `code`, which becomes an error of JSON-RPC."""

    def upload(self, data: bytearray, now_s: float) -> bytes:
        """Take complete messages away from the front of what a connection has received; returns the answers."""


class HttpServer(WireServer[RpcModel]):
    """A device on its network cable. It serves any number of clients, each in a thread.

    Unplugging resets connections and refuses new ones. A real cable leaves its client waiting instead, as `hang` does.
    """

    def __init__(self, model: RpcModel, *, clock: Clock | None = None, host: str | None = None) -> None:
        """host: address to listen at; None: a loopback address of its own, which is found when it is plugged in."""
        super().__init__(model, clock)
        self._host = host
        self._listeners: list[_Listener] = []
        self._clients: set[socket.socket] = set()

    @property
    def address(self) -> str:
        """Address of the calls, HOST:PORT. A client that knows the port itself is given HOST alone."""
        return f"{self._host}:{self.model.http_port}"

    def plug(self) -> None:
        """Plug the cable in, at the same address as before. Raises OSError if the address is in use."""
        with self.lock:
            if self._listeners:
                return
            for attempt in range(_ATTEMPTS):
                host = self._host or ".".join(["127", *(str(random.randint(1, 254)) for _ in range(3))])
                try:
                    self._listen(host)
                except OSError:
                    if self._host is not None or attempt == _ATTEMPTS - 1:
                        raise
                else:
                    self._host = host
                    return

    def unplug(self) -> None:
        """Pull the cable. Clients' connections are reset, and new ones are refused."""
        with self.lock:
            listeners, self._listeners = self._listeners, []
            clients, self._clients = self._clients, set()
        for listener in listeners:
            listener.server_close()
        for client in clients:
            with suppress(OSError):  # it may have gone by itself
                client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                client.shutdown(socket.SHUT_RD)

    def _listen(self, host: str) -> None:
        """Listen at all ports of the model, or at none."""
        handlers = {self.model.http_port: _HttpHandler, self.model.raw_port: _RawHandler}
        try:
            for port, handler in handlers.items():
                if port is not None:
                    self._listeners.append(_Listener((host, port), handler, self))
        except OSError:
            for listener in self._listeners:
                listener.server_close()
            self._listeners = []
            raise

    def _serve(self) -> None:
        while not self._ending.wait(0):
            with self.lock:
                listeners = [] if self._hung else list(self._listeners)
            with selectors.DefaultSelector() as ready:
                for listener in listeners:
                    with suppress(OSError, ValueError):  # it has been closed since
                        ready.register(listener, selectors.EVENT_READ)
                if not ready.get_map():
                    self._ending.wait(_TURN_S)
                    continue
                for key, _ in ready.select(_TURN_S):
                    with suppress(OSError, ValueError):
                        key.fileobj.handle_request()  # type: ignore[union-attr]

    def joins(self, client: socket.socket) -> None:
        """Note a new connection."""
        with self.lock:
            self._clients.add(client)

    def leaves(self, client: socket.socket) -> None:
        """Note that a connection is over."""
        with self.lock:
            self._clients.discard(client)

    def answer(self, client: socket.socket, body: bytes) -> bytes | None:
        """The answer to the body of a request, b"" if it wants none; None: the connection is lost."""
        if not self._awake(client):
            return None
        try:
            request = json.loads(body)
        except ValueError:
            return _error(None, PARSE_ERROR, "Parse error")
        if not isinstance(request, dict) or not isinstance(request.get("method"), str):
            return _error(None, INVALID_REQUEST, "Invalid request")
        ident, params = request.get("id"), request.get("params", [])
        if not isinstance(params, list):
            return _error(ident, INVALID_REQUEST, "Invalid request: params is no list")
        try:
            with self.lock:
                result = self.model.call(request["method"], params, self._now_s())
        except Exception as error:
            if not hasattr(error, "code"):
                raise
            return _error(ident, error.code, str(error))
        return _said(ident, result=result) if "id" in request else b""

    def take(self, client: socket.socket, data: bytearray) -> bytes | None:
        """Take complete messages away from the front of `data`, which came to the port that takes bytes. Returns the
        answers; None: the connection is lost."""
        if not self._awake(client):
            return None
        with self.lock:
            return self.model.upload(data, self._now_s())

    def _awake(self, client: socket.socket) -> bool:
        """Wait out a hang; returns whether the connection has outlived it."""
        while not self._ending.wait(0):
            with self.lock:
                if client not in self._clients or not self._listeners:
                    return False
                if not self._hung:
                    return True
            self._ending.wait(_TURN_S)
        return False


class _Listener(socketserver.ThreadingTCPServer):
    """A port of the device."""

    allow_reuse_address = True
    daemon_threads = True
    block_on_close = False
    timeout = 0

    def __init__(self, address: tuple[str, int], handler: Any, device: HttpServer) -> None:
        self.device = device
        super().__init__(address, handler)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Serve a connection in a thread, and know of it before that thread runs."""
        self.device.joins(request)
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        """Close a connection. If it has been reset, no farewell is sent."""
        self.device.leaves(request)
        request.close()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Let a lost connection pass in silence, and report anything else to the thread's exception hook."""
        error = sys.exc_info()[1]
        if error is not None and not isinstance(error, OSError):
            raise error


class _HttpHandler(BaseHTTPRequestHandler):
    """One connection of an HTTP client, for any number of calls."""

    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True
    wbufsize = CHUNK_BYTES
    server: _Listener

    def do_POST(self) -> None:
        """Answer a call."""
        body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        if self.path != self.server.device.model.http_path:
            self.send_error(404)
            return
        answer = self.server.device.answer(self.connection, body)
        if answer is None:
            self.close_connection = True
            return
        self.send_response(200)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(answer)))
        self.end_headers()
        self.wfile.write(answer)

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing."""


class _RawHandler(socketserver.BaseRequestHandler):
    """One connection of the port that takes bytes."""

    server: _Listener

    def handle(self) -> None:
        """Answer messages until the client goes."""
        data = bytearray()
        while received := self.request.recv(CHUNK_BYTES):
            data += received
            answer = self.server.device.take(self.request, data)
            if answer is None:
                return
            self.request.sendall(answer)


def _said(ident: Any, **content: Any) -> bytes:
    return json.dumps({"jsonrpc": "2.0", "id": ident, **content}).encode()


def _error(ident: Any, code: int, message: str) -> bytes:
    return _said(ident, error={"code": code, "message": message, "data": None})
