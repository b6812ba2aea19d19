"""The one port of the viewer without a browser: who is refused, what a client that hangs or floods does, no tunnel."""

import http.client
import json
import os
import re
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from pathlib import Path

import msgspec
import numpy as np
import pytest
import viser
from viser import _messages
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from rig.errors import UsageError
from rig.view.access import Access, listen
from rig.view.pages import MOST_PAGES, Pages
from rig.view.server import ViewServer, require_viser
from rig.view.viewer import MOST_RATE_HZ
from tests.system.conftest import Rig
from tests.system.view.conftest import PATIENCE_S, Served, served

TOKEN = "token-of-the-tests-0"
COOKIE = "spadrig-{}=" + TOKEN
VISER = f"viser-v{viser.__version__}"


@pytest.fixture(scope="module")
def guarded(scanned: Path, slots: Path) -> Iterator[Served]:
    """A viewer that asks for a token, as on any address but loopback."""
    with served(scanned, "--token", TOKEN, folder=slots) as viewer:
        yield viewer


def get(port: int, path: str = "/", **headers: str) -> http.client.HTTPResponse:
    """The answer to GET, its body read. `Host` is the right one unless given."""
    link = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)
    link.putrequest("GET", path, skip_host=True)
    for name, value in {"Host": f"127.0.0.1:{port}", **headers}.items():
        link.putheader(name, value)
    link.endheaders()
    answer = link.getresponse()
    answer.body = answer.read()  # type: ignore[attr-defined]
    link.close()
    return answer


def open_socket(
    port: int, path: str, host: str = "", origin: str | None = "", cookie: str = "", protocol: str = VISER
) -> ClientConnection:
    """A web socket as a browser opens it. host, origin: the right ones unless given; None sends no origin."""
    host = host or f"127.0.0.1:{port}"
    return connect(
        f"ws://{host}{path}",
        sock=socket.create_connection(("127.0.0.1", port)),
        origin=f"http://{host}" if origin == "" else origin,  # type: ignore[arg-type]
        additional_headers={"Cookie": cookie.format(port)} if cookie else {},
        subprotocols=[protocol] if path == "/cloud" else None,  # type: ignore[list-item]
        max_size=None,
        open_timeout=PATIENCE_S,
        close_timeout=0.5,
    )


def refused(*arguments: object, **more: object) -> int:
    """The status with which a web socket is refused."""
    with pytest.raises(InvalidStatus) as caught:
        open_socket(*arguments, **more)  # type: ignore[arg-type]
    return caught.value.response.status_code


def told(link: ClientConnection, topic: str) -> dict[str, object]:
    """The next message of a topic."""
    while True:
        message = link.recv(PATIENCE_S)
        assert isinstance(message, bytes)
        content: dict[str, object] = json.loads(message[4 : 4 + int.from_bytes(message[:4], "little")])
        if content["topic"] == topic:
            return content


def send_all(link: ClientConnection, messages: Iterable[str | bytes]) -> None:
    """Send messages, and read until the web socket is closed."""
    for message in messages:
        link.send(message)
    while True:
        link.recv(PATIENCE_S)


def memory_bytes(pid: int) -> int:
    fields = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines())
    return int(fields["VmRSS"].split()[0]) * 1024


PATHS = ("/", "/cloud/", "/points.ply", "/nothing")


def test_without_the_token_there_is_no_page_no_file_and_no_web_socket(guarded: Served) -> None:
    port = guarded.port
    for path in PATHS:
        for headers in ({}, {"Cookie": f"spadrig-{port}=wrong"}, {"Cookie": f"other={TOKEN}"}):
            answer = get(port, path, **headers)
            assert answer.status == 401, path
            assert b"needs a token" in answer.body  # type: ignore[attr-defined]
            assert TOKEN.encode() not in answer.body  # type: ignore[attr-defined]
    for path in ("/data", "/cloud"):
        assert refused(port, path) == 401
        assert refused(port, f"{path}?token={TOKEN}") == 401
        assert refused(port, path, cookie="spadrig-{}=wrong") == 401
        with open_socket(port, path, cookie=COOKIE) as link:
            assert link.recv(PATIENCE_S)


def test_the_address_with_the_token_sets_a_cookie_that_scripts_and_other_pages_cannot_use(guarded: Served) -> None:
    assert guarded.url == f"http://127.0.0.1:{guarded.port}/?token={TOKEN}"
    answer = get(guarded.port, f"/?token={TOKEN}")
    assert answer.status == 200
    assert answer.getheader("Set-Cookie") == f"spadrig-{guarded.port}={TOKEN}; HttpOnly; SameSite=Strict; Path=/"
    assert b'content="0;url=/"' in answer.body  # type: ignore[attr-defined]
    assert get(guarded.port, "/?token=wrong").getheader("Set-Cookie") is None
    page = get(guarded.port, Cookie=f"spadrig-{guarded.port}={TOKEN}")
    assert page.status == 200
    assert TOKEN.encode() not in page.body  # type: ignore[attr-defined]
    assert page.getheader("Set-Cookie") is None
    assert any(re.search(r"token=", line) for line in guarded.said)


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "10.9.8.7"])
def test_a_wrong_host_is_refused_on_the_page_and_on_both_web_sockets(guarded: Served, host: str) -> None:
    port, cookie = guarded.port, COOKIE.format(guarded.port)
    for path in PATHS:
        assert get(port, path, Host=host, Cookie=cookie).status == 421
    for path in ("/data", "/cloud"):
        assert refused(port, path, host=host, cookie=COOKIE) == 421


@pytest.mark.parametrize("origin", ["http://evil.example", "http://127.0.0.1:1", "null", None])
def test_a_wrong_origin_is_refused_on_the_page_and_on_both_web_sockets(guarded: Served, origin: str | None) -> None:
    port, cookie = guarded.port, COOKIE.format(guarded.port)
    if origin is not None:
        for path in PATHS:
            assert get(port, path, Origin=origin, Cookie=cookie).status == 403
    for path in ("/data", "/cloud"):
        assert refused(port, path, origin=origin, cookie=COOKIE) == 403


def test_every_answer_keeps_the_page_to_itself(guarded: Served) -> None:
    for path in ("/", "/cloud/"):
        answer = get(guarded.port, path, Cookie=COOKIE.format(guarded.port))
        assert answer.status == 200
        policy = answer.getheader("Content-Security-Policy") or ""
        assert f"connect-src 'self' ws://127.0.0.1:{guarded.port} blob: data:" in policy
        assert "frame-ancestors 'self'" in policy
        assert "default-src 'self'" in policy
        assert answer.getheader("Referrer-Policy") == "no-referrer"
        assert answer.getheader("Cross-Origin-Resource-Policy") == "same-origin"
        assert answer.getheader("Cache-Control") == "no-store"
        assert answer.getheader("Access-Control-Allow-Origin") is None


@pytest.mark.parametrize(
    "path", ["/cloud/../../etc/passwd", "/cloud/%2e%2e/%2e%2e/etc/passwd", "/assets/x.js", "/data", "/page.html"]
)
def test_no_other_file_is_served(guarded: Served, path: str) -> None:
    assert get(guarded.port, path, Cookie=COOKIE.format(guarded.port)).status == 404


def test_a_busy_port_is_an_error_of_one_line_and_no_other_port_is_taken(
    guarded: Served, scanned: Path, rig: Rig
) -> None:
    ran = rig("view", scanned, "--port", guarded.port)
    assert ran.code == 2
    assert ran.problems == [
        f"error: cannot listen on port {guarded.port} of 127.0.0.1: address already in use; end what uses it, or name "
        "another --port or --host"
    ]
    assert "page:" not in ran.err


def test_a_client_that_hangs_costs_one_picture_and_delays_nobody(guarded: Served) -> None:
    port = guarded.port
    with ExitStack() as stack:
        hanging = []
        for path in ("/data", "/cloud") * 4:
            link = stack.enter_context(open_socket(port, path, cookie=COOKIE))
            link.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            hanging.append(link)  # whose messages nobody takes: 16 in the client, the rest stays in the server
        reading = stack.enter_context(open_socket(port, "/data", cookie=COOKIE))
        told(reading, "map")
        before = memory_bytes(guarded.pid)
        slowest_s = 0.0
        for i in range(60):
            begun_s = time.monotonic()
            reading.send(json.dumps({"ask": "map", "index": i % 2}))
            while told(reading, "map")["number"] != i % 2:
                pass
            told(reading, "picture-confidence")
            slowest_s = max(slowest_s, time.monotonic() - begun_s)
            time.sleep(0.03)
        assert slowest_s < PATIENCE_S / 4
        assert memory_bytes(guarded.pid) - before < 60e6


@pytest.mark.parametrize(
    ("path", "message"), [("/data", '{"ask": "row", "row": 1, "x": 1}'), ("/cloud", b"\x80" * 100)]
)
def test_a_client_that_floods_is_cut_off_and_others_go_on(guarded: Served, path: str, message: str | bytes) -> None:
    with (
        open_socket(guarded.port, "/data", cookie=COOKIE) as calm,
        open_socket(guarded.port, path, cookie=COOKIE) as flood,
    ):
        told(calm, "map")
        with pytest.raises(ConnectionClosed) as caught:
            send_all(flood, [message] * 100_000)
        assert caught.value.rcvd is None or caught.value.rcvd.code == 1008
        calm.send('{"ask": "colour", "by": "signal"}')
        while told(calm, "map")["colour"] != "signal":
            pass


def test_however_often_colours_are_asked_for_points_are_sent_no_more_often_than_the_page_may(guarded: Served) -> None:
    with open_socket(guarded.port, "/data", cookie=COOKIE) as link:
        told(link, "picture-confidence")
        begun_s = time.monotonic()
        for i in range(60):
            link.send(json.dumps({"ask": "confidence", "least": 0.01 * (i % 7)}))
            link.send(json.dumps({"ask": "map", "index": i % 2}))
            time.sleep(0.03)
        link.send(json.dumps({"ask": "confidence", "least": 0.5}))
        sent = 1
        while told(link, "map")["least"] != 0.5:
            sent += 1
        assert 5 < sent <= 2 + MOST_RATE_HZ * (time.monotonic() - begun_s)
        link.send(json.dumps({"ask": "confidence", "least": 0.0}))


def test_a_message_too_large_or_nonsense_ends_the_client_that_sent_it(guarded: Served) -> None:
    for message, code in (("x" * 100_000, 1009), ('{"ask": "arm"}', 1008), (b"\xff\xfe", 1008)):
        with open_socket(guarded.port, "/data", cookie=COOKIE) as link, pytest.raises(ConnectionClosed) as caught:
            send_all(link, [message])
        assert caught.value.rcvd is not None
        assert caught.value.rcvd.code == code


def test_more_pages_than_there_is_room_for_are_turned_away(guarded: Served) -> None:
    with ExitStack() as stack:
        for _ in range(MOST_PAGES):
            stack.enter_context(open_socket(guarded.port, "/data", cookie=COOKIE))
        assert refused(guarded.port, "/data", cookie=COOKIE) == 503
    deadline_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline_s:
        try:
            open_socket(guarded.port, "/data", cookie=COOKIE).close()
            return
        except InvalidStatus:
            time.sleep(0.1)
    raise AssertionError("pages that are gone still take room")


def test_viser_hears_no_client_and_opens_no_tunnel() -> None:
    listening, access = listen(Access.to("127.0.0.1", 0, None))
    server = ViewServer(access, listening, Pages(threading.Event()), lambda: None)
    try:
        handlers = server.viser._websock_server._incoming_handlers
        assert _messages.ShareUrlRequest not in handlers
        assert _messages.ShareUrlDisconnect not in handlers
        heard: list[object] = []
        for kind in (_messages.ShareUrlRequest, _messages.ViewerCameraMessage, _messages.GuiUpdateMessage):
            server.viser._websock_server.register_handler(kind, lambda client, message: heard.append(message))
        with open_socket(access.port, "/cloud") as link:
            link.recv(PATIENCE_S)
            for kind in (_messages.ShareUrlRequest, _messages.GuiUpdateMessage):
                link.send(msgspec.msgpack.encode({"type": kind.__name__, "uuid": "x", "updates": {}}))
            server.viser.scene.add_point_cloud("/p", points=np.zeros((1, 3)), colors=(1, 2, 3))
            link.recv(PATIENCE_S)
        assert heard == []
        assert server.viser._share_tunnel is None
        with open_socket(access.port, "/cloud", protocol="viser-v0.0.1") as link, pytest.raises(ConnectionClosed):
            link.recv(PATIENCE_S)
    finally:
        server.close()


def test_on_the_whole_network_a_token_is_made_and_only_own_names_are_answered(scanned: Path, slots: Path) -> None:
    with served(scanned, "--host", "0.0.0.0", folder=slots) as viewer:
        token = re.search(r"\?token=([A-Za-z0-9_-]{32})$", viewer.url)
        assert token is not None
        own = socket.gethostname()
        for host in ("127.0.0.1", own, "10.1.2.3"):
            assert get(viewer.port, Host=f"{host}:{viewer.port}").status == 401
            assert get(viewer.port, f"/?token={token[1]}", Host=f"{host}:{viewer.port}").status == 200
        assert get(viewer.port, f"/?token={token[1]}", Host=f"evil.example:{viewer.port}").status == 421


def test_without_viser_the_command_names_what_to_install(scanned: Path) -> None:
    code = "import sys; sys.modules['viser'] = None; from rig.cli.main import main; main(sys.argv[1:])"
    ran = subprocess.run(
        [sys.executable, "-c", code, "view", str(scanned)], capture_output=True, text=True, timeout=PATIENCE_S,
        env=os.environ,
    )  # fmt: skip
    assert ran.returncode == 2
    problem = f'error: rig view needs viser; install it: "{sys.executable}" -m pip install "viser<2,>=1.1"'
    assert ran.stderr.splitlines()[-1] == problem  # lines of progress come before it on a slow machine
    require_viser()


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        ([], "rig view got neither a run nor --live; name the folder of a run, or --live for the running scan"),
        (["there", "--live"], "rig view got both a run and --live; name the folder of a run, or --live for the"),
        (["nowhere"], "nowhere does not exist; name the folder of a run with maps or a recording"),
        (["--live", "--token", "x"], "--token has 1 characters; it needs at least 16"),
        (["--live", "--view-rate", "11"], "--view-rate is 11 a second; it must be above 0 and at most 10"),
        (["--live", "--view-points", "0"], "--view-points is 0; it must be at least 1 and at most 250000"),
        (["--live", "--port", "70000"], "--port is 70000; it must be 1 to 65535, or 0 for any free one"),
    ],
)
def test_mistakes_are_told_in_one_line(arguments: list[str], problem: str, rig: Rig) -> None:
    ran = rig("view", *arguments)
    assert ran.code == 2
    assert len(ran.problems) == 1
    assert ran.problems[0].startswith(f"error: {problem}")


def test_an_address_of_another_computer_is_refused() -> None:
    with pytest.raises(UsageError, match=r"cannot listen on port 0 of 192\.0\.2\.1: .*; end what uses it, or name"):
        listen(Access.to("192.0.2.1", 0, None))
