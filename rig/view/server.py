"""The one port of the viewer: our page, viser's client and server, and the page's own web socket, all behind `Access`.

viser by itself opens a port without any check. Here it does not: while it starts, its one call of `serve` (in
`viser.infra`, of the package websockets) is replaced by ours. Ours listens on a socket that we have bound, checks every
request before viser sees it, and serves viser's part below `/cloud`. Whatever clients send to viser is thrown away: it
only shows points, and needs no messages for that. So nobody opens its public tunnel or fills its memory.
"""

import asyncio
import contextlib
import io
import logging
import socket
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from http import HTTPStatus
from importlib.resources import files
from typing import TYPE_CHECKING, Any, Final

from drivers.optional_packages import install_command
from rig.errors import UsageError
from rig.view.access import Access, Asked
from rig.view.pages import MOST_MESSAGE_BYTES, MOST_PAGES, Allowance, Pages

if TYPE_CHECKING:
    from viser import ViserServer
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

CLOUD: Final = "/cloud"
"""Path of viser's client and web socket."""
DATA: Final = "/data"
"""Path of the page's web socket."""
POINTS: Final = "/points.ply"
_CAMERA_MESSAGES_PER_S: Final = 200.0
"""viser's client sends its camera fifty times a second while somebody turns it."""
_CLOSE_S: Final = 1.0
"""Longest wait for a client to agree that its web socket is closed: one that floods does not."""
_ONLY_POINTS: Final = b"<style>body *:not(:has(canvas)):not(canvas){display:none!important}</style>"
"""Hides viser's own panels; only the canvas is left."""
_ON_TO_THE_PAGE: Final = b'<!doctype html><meta http-equiv="refresh" content="0;url=/">'
"""Leads on without the token. After a link from another page, a browser would follow a redirect without the cookie."""

Handler = Callable[["ServerConnection"], Awaitable[None]]
Download = Callable[[], tuple[str, bytes] | None]
"""Returns the name and the content of a file to download; None if there is nothing."""


def require_viser() -> None:
    """Raise UsageError, with the command that installs it, if viser is missing."""
    try:
        import viser  # noqa: F401
    except ImportError as error:
        raise UsageError(f"rig view needs viser; install it: {install_command('viser')}") from error


@dataclass(slots=True)
class _Route:
    """Counts the web sockets of one path."""

    most: int
    open: int = 0


class ViewServer:
    """Serves until `close`. access, listening: from `rig.view.access.listen`. download: makes the file of POINTS; it is
    called on another thread.

    viser: the server of the package viser, for the scene. Raises RuntimeError if this version of viser opens its port
    in another way.
    """

    def __init__(self, access: Access, listening: socket.socket, pages: Pages, download: Download) -> None:
        import viser
        import websockets.asyncio.server as websockets_server

        self.access = access
        self._pages, self._download = pages, download
        self._page = (files("rig.view") / "page.html").read_bytes()
        self._cloud_page: bytes | None = None
        self._routes = {CLOUD: _Route(MOST_PAGES), DATA: _Route(MOST_PAGES)}
        self._guarded = False
        serve = websockets_server.serve

        def guarded(handler: Handler, host: str, port: int, **options: Any) -> Any:
            self._guarded = True
            pages.begin(asyncio.get_running_loop())
            own = {
                "process_request": partial(self._answer, options["process_request"]),
                "max_size": MOST_MESSAGE_BYTES,
                "compression": None,
                "close_timeout": _CLOSE_S,
                "logger": _silent(),
                "server_header": None,
            }
            return serve(partial(self._talk, handler), sock=listening, **{**options, **own})

        websockets_server.serve = guarded  # type: ignore[assignment,misc]
        try:
            with contextlib.redirect_stdout(io.StringIO()):
                self.viser: ViserServer = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
        finally:
            websockets_server.serve = serve  # type: ignore[misc]
        if not self._guarded:
            self.close()
            raise RuntimeError(f"viser {viser.__version__} opens its port in a way that cannot be guarded")
        self._version = f"viser-v{viser.__version__}"
        _close_tunnel(self.viser)

    def close(self) -> None:
        """Stop serving."""
        with contextlib.redirect_stdout(io.StringIO()):
            self.viser.stop()

    async def _answer(self, viser_files: Any, connection: "ServerConnection", request: "Request") -> "Response | None":
        """Answer a request for a file, or None for a web socket to be opened."""
        headers = request.headers
        asked = Asked(
            request.path,
            headers.get("Upgrade", "").lower() == "websocket" if len(headers.get_all("Upgrade")) < 2 else True,
            headers.get_all("Host"),
            headers.get_all("Origin"),
            headers.get_all("Cookie"),
        )
        refusal = self.access.refusal(asked)
        if refusal is not None:
            return _response(refusal.status, f"{refusal.why}\n".encode())
        host, path = headers["Host"], request.path.partition("?")[0]
        if asked.socket:
            route = self._routes.get(path)
            if route is None:
                return _response(404, b"There is no such web socket.\n")
            return None if route.open < route.most else _response(503, b"Too many pages are open.\n")
        if path == "/" and self.access.brings_token(asked):
            cookie = f"{self.access.cookie}={self.access.token}; HttpOnly; SameSite=Strict; Path=/"
            return _response(200, _ON_TO_THE_PAGE, "text/html", host, {"Set-Cookie": cookie})
        if path == "/":
            return _response(200, self._page, "text/html; charset=utf-8", host)
        if path == f"{CLOUD}/":
            return _response(200, self._cloud(viser_files, connection, request), "text/html; charset=utf-8", host)
        if path == POINTS:
            file = await asyncio.get_running_loop().run_in_executor(None, self._download)
            if file is None:
                return _response(404, b"There are no points yet.\n")
            name = {"Content-Disposition": f'attachment; filename="{file[0]}"'}
            return _response(200, file[1], "application/octet-stream", host, name)
        return _response(404, b"There is no such page.\n")

    def _cloud(self, viser_files: Any, connection: "ServerConnection", request: "Request") -> bytes:
        """viser's client, which is a single file, with its panels hidden."""
        if self._cloud_page is None:
            plain = request.headers.copy()
            for name in ("Accept-Encoding", "Upgrade"):
                plain.pop(name, None)
            page: bytes = viser_files(connection, replace(request, path="/", headers=plain)).body
            self._cloud_page = page.replace(b"</head>", _ONLY_POINTS + b"</head>", 1)
        return self._cloud_page

    async def _talk(self, viser_handler: Handler, connection: "ServerConnection") -> None:
        """Serve one web socket until it is closed."""
        assert connection.request is not None, "the handshake is over"
        path = connection.request.path.partition("?")[0]
        with self._counted(path):
            if path == DATA:
                await self._pages.serve(connection)
            elif connection.subprotocol != self._version:
                await connection.close(1002, "another version of viser")
            else:
                await viser_handler(_Deaf(connection))  # type: ignore[arg-type]

    @contextlib.contextmanager
    def _counted(self, path: str) -> Iterator[None]:
        self._routes[path].open += 1
        try:
            yield
        finally:
            self._routes[path].open -= 1


class _Deaf:
    """A web socket of which viser hears nothing. A client that sends too much is cut off."""

    def __init__(self, connection: "ServerConnection") -> None:
        self._connection = connection
        self._allowance = Allowance(_CAMERA_MESSAGES_PER_S, 5 * _CAMERA_MESSAGES_PER_S)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._connection, name)

    async def recv(self) -> bytes:
        """Never returns; raises ConnectionClosed when the web socket is closed."""
        while True:
            await self._connection.recv()
            if not self._allowance.take():
                await self._connection.close(1008, "too many messages")


def _close_tunnel(server: "ViserServer") -> None:
    """Make viser deaf to wishes for a public tunnel, should one ever reach it."""
    from viser import _messages

    for kind in (_messages.ShareUrlRequest, _messages.ShareUrlDisconnect):
        server._websock_server.unregister_handler(kind)


def _response(
    status: int,
    body: bytes,
    kind: str = "text/plain; charset=utf-8",
    host: str = "",
    more: dict[str, str] | None = None,
) -> "Response":
    """An answer whose page asks no other host, is shown in no other page, and is kept in no cache. host: as asked for,
    and allowed."""
    from websockets.datastructures import Headers
    from websockets.http11 import Response

    here = f"'self' ws://{host}" if host else "'self'"
    policy = (
        "default-src 'self' 'unsafe-inline' 'unsafe-eval' blob: data:; "
        f"connect-src {here} blob: data:; frame-ancestors 'self'; "
        "form-action 'none'; base-uri 'none'; object-src 'none'"
    )
    headers: Headers = Headers(
        {
            "Content-Type": kind,
            "Content-Length": str(len(body)),
            "Content-Security-Policy": policy,
            "Cross-Origin-Resource-Policy": "same-origin",
            "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff",
            "Cache-Control": "no-store",
            "Connection": "close",
            **(more or {}),
        }
    )
    return Response(status, HTTPStatus(status).phrase, headers, body)


def _silent() -> logging.Logger:
    """A logger for websockets, which else reports every refused request."""
    logger = logging.getLogger("rig.view.websockets")
    logger.setLevel(logging.CRITICAL + 1)
    logger.propagate = False
    return logger
