"""The depth stream: what clients get of a scan's slot, and that a bad client harms nobody."""

import json
import re
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from rig.errors import UsageError
from rig.live.slot import SlotWriter
from rig.requests import StreamRequest
from rig.stream import server as server_module
from rig.stream.server import DepthServer

ROOT = Path(__file__).parents[4]
PATIENCE_S = 30.0
ROWS, WIDTH = 6, 8
CAPACITIES = dict.fromkeys(("setup", "status", "frame", "map", "row", "figures"), 1 << 20)


@pytest.fixture(autouse=True)
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr(server_module, "LOOK_S", 0.02)
    monkeypatch.setattr(server_module, "POLL_S", 0.005)


@pytest.fixture
def slot() -> Iterator[SlotWriter]:
    with SlotWriter.create("scan", "lab", CAPACITIES) as writer:
        set_up(writer)
        yield writer


@pytest.fixture
def server() -> Iterator[DepthServer]:
    with DepthServer(StreamRequest(port=0)) as running:
        yield running


def set_up(writer: SlotWriter, name: str = "lab") -> None:
    """What a scan writes first."""
    rays = np.ones((ROWS, WIDTH), np.float32)
    writer.write("setup", {"name": name, "rows": ROWS, "width": WIDTH}, {"u": rays, "v": 2 * rays})
    writer.write("status", {"frames": 5})


def put_map(writer: SlotWriter, index: int) -> None:
    """A map whose depth is its number."""
    depth_m = np.full((ROWS, WIDTH), index, np.float32)
    depth_m[0, 0] = np.nan
    arrays = {"depth_m": depth_m, "confidence": depth_m / 10, "intensity": np.full((ROWS, WIDTH), 3, np.uint32)}
    writer.write("map", {"index": index, "doubts": []}, arrays)


class Message(NamedTuple):
    """A message that came."""

    kind: int
    about: dict[str, Any]
    arrays: dict[str, np.ndarray]


class Client:
    """A client that reads what the page says. hello: its first line."""

    def __init__(self, server: DepthServer, hello: bytes = b"\n") -> None:
        self.link = socket.create_connection(server.address, timeout=PATIENCE_S)
        self.link.sendall(hello)
        self._stream = self.link.makefile("rb")

    def read(self) -> Message | None:
        head = self._stream.read(16)
        if len(head) < 16:
            return None
        magic, version, kind, json_bytes, array_bytes = struct.unpack("<4sHHII", head)
        assert (magic, version) == (b"SPDS", 1)
        about = json.loads(self._stream.read(json_bytes))
        data = self._stream.read(array_bytes)
        arrays = {
            each["name"]: np.frombuffer(data, each["dtype"], int(np.prod(each["shape"])), each["offset"]).reshape(
                each["shape"]
            )
            for each in about["arrays"]
        }
        return Message(kind, about, arrays)

    def until(self, found: Callable[[Message], bool]) -> Message:
        while (message := self.read()) is not None:
            if found(message):
                return message
        raise AssertionError("the connection ended first")

    def close(self) -> None:
        self._stream.close()
        self.link.close()


def wait_until(condition: Callable[[], bool]) -> None:
    ends = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < ends, "nothing came of it"
        time.sleep(0.005)


def test_a_client_gets_the_setup_and_then_each_new_map(slot: SlotWriter, server: DepthServer) -> None:
    put_map(slot, 4)
    with closing(Client(server, b'{"arrays": ["depth_m", "intensity"]}\n')) as client:
        setup = client.until(lambda message: message.kind == 1)
        assert (setup.about["name"], setup.about["run"]) == ("lab", 1)
        assert np.array_equal(setup.arrays["v"], np.full((ROWS, WIDTH), 2, np.float32))
        first = client.until(lambda message: message.kind == 2)
        # What came before a client did is nothing that it missed.
        assert (first.about["index"], first.about["missed"], set(first.arrays)) == (4, 0, {"depth_m", "intensity"})
        assert np.isnan(first.arrays["depth_m"][0, 0])
        assert first.arrays["depth_m"][1, 1] == 4
        assert first.arrays["intensity"].dtype == np.dtype("<u4")
        put_map(slot, 5)
        second = client.until(lambda message: message.kind == 2)
        assert (second.about["index"], second.about["missed"]) == (5, 0)
        put_map(slot, 9)  # those between were never in the slot for long enough
        third = client.until(lambda message: message.kind == 2)
        assert (third.about["index"], third.about["missed"]) == (9, 3)


def test_a_slow_client_gets_the_newest_map_and_is_told_what_it_missed(tmp_path: Path, server: DepthServer) -> None:
    """A map is larger than what connections keep, so a client that does not read holds up its own thread alone."""
    large = np.zeros((1500, 1500), np.float32)
    with SlotWriter.create("scan", "lab", {"setup": 1 << 16, "status": 1 << 16, "map": 1 << 24}) as slot:
        slot.write("setup", {"name": "lab"})
        with closing(Client(server)) as slow, closing(Client(server)) as quick:
            slot.write("map", {"index": 0}, {"depth_m": large})
            for index in range(1, 30):
                got = quick.until(lambda message: message.kind == 2)
                assert got.about["index"] == index - 1
                slot.write("map", {"index": index}, {"depth_m": large})
            quick.until(lambda message: message.kind == 2 and message.about["index"] == 29)
            indices, missed = [], 0
            while not indices or indices[-1] < 29:
                message = slow.until(lambda message: message.kind == 2)
                indices.append(message.about["index"])
                missed += message.about["missed"]
            assert indices == sorted(set(indices))
            assert len(indices) <= 4
            assert missed == 29 - indices[0] - (len(indices) - 1)


def test_clients_that_hang_flood_or_go_away_harm_no_other(slot: SlotWriter, server: DepthServer) -> None:
    put_map(slot, 0)
    silent = socket.create_connection(server.address)  # never says hello
    flood = Client(server, b"\n" + b"x" * 1_000_000)
    gone = Client(server)
    gone.close()
    half = socket.create_connection(server.address)
    half.sendall(b'{"arrays"')
    half.close()
    with closing(Client(server)) as good:
        for index in range(1, 20):
            good.until(lambda message, at=index: message.kind == 2 and message.about["index"] == at - 1)  # type: ignore[misc]
            put_map(slot, index)
    silent.close()
    flood.close()


def test_strangers_that_drip_a_first_line_take_no_room_and_are_dropped(
    slot: SlotWriter, server: DepthServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server_module, "MOST_CLIENTS", 1)
    monkeypatch.setattr(server_module, "HELLO_S", 0.5)
    dripping = socket.create_connection(server.address, timeout=PATIENCE_S)
    with closing(Client(server)) as good:
        good.until(lambda message: message.kind == 1)
    ends = time.monotonic() + PATIENCE_S
    with suppress(ConnectionError):
        while time.monotonic() < ends:
            dripping.sendall(b" ")
            time.sleep(0.05)
    assert time.monotonic() < ends, "as long as it drips"
    dripping.close()


def test_a_scan_of_another_version_does_not_end_the_stream(server: DepthServer) -> None:
    with SlotWriter.create("scan", "newer", {"setup_2": 1 << 10}) as writer, closing(Client(server)) as client:
        client.until(lambda message: message.about.get("state") == "live")
        assert writer.watched
    with SlotWriter.create("scan", "lab", CAPACITIES) as writer, closing(Client(server)) as client:
        set_up(writer)
        assert client.until(lambda message: message.kind == 1).about["name"] == "lab"


def test_the_end_of_a_scan_is_told_and_the_next_one_is_followed(server: DepthServer) -> None:
    with closing(Client(server)) as client:
        assert client.until(lambda message: message.kind == 3).about["state"] == "waiting"
        for run in (1, 2):
            with SlotWriter.create("scan", f"rig {run}", CAPACITIES) as writer:
                set_up(writer, f"rig {run}")
                put_map(writer, 2 * run)
                setup = client.until(lambda message: message.kind == 1)
                assert (setup.about["run"], setup.about["name"]) == (run, f"rig {run}")
                found = client.until(lambda message: message.kind == 2)
                # Of the second scan, which began while it was connected, it missed the maps before.
                assert (found.about["index"], found.about["missed"]) == ((2, 2), (4, 4))[run - 1]
            ended = client.until(lambda message: message.kind == 3 and message.about["state"] == "ended")
            assert ended.about["run"] == run


def test_status_comes_though_maps_do(slot: SlotWriter, server: DepthServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server_module, "STATUS_S", 0.05)
    with closing(Client(server)) as client:
        kinds = []
        for index in range(40):
            put_map(slot, index)
            slot.write("status", {"frames": index})
            kinds.append(client.until(lambda message: message.kind in (2, 3)).kind)
            time.sleep(0.01)
        assert {2, 3} <= set(kinds)


@pytest.mark.parametrize(
    ("hello", "told"),
    [
        (b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n", "must be a JSON object"),
        (b'{"arrays": ["depth"]}\n', "no array 'depth'"),
        (b"x" * 10_000, "must end within"),
    ],
)
def test_a_stranger_gets_one_sentence_and_no_depth(
    slot: SlotWriter, server: DepthServer, hello: bytes, told: str
) -> None:
    put_map(slot, 0)
    with closing(Client(server, hello)) as client:
        answer = client.read()
        assert answer is not None
        assert answer.kind == 4
        assert told in answer.about["error"]
        with suppress(ConnectionResetError):  # what it sent was not all read
            assert client.read() is None
    wait_until(lambda: server.counts.refused == 1)


def test_with_a_token_only_who_has_it_sees_anything(slot: SlotWriter) -> None:
    put_map(slot, 0)
    with DepthServer(StreamRequest(port=0, token="a-token-long-enough")) as server:
        for wrong in (b"\n", b'{"token": "a-token-long-enougH"}\n', '{"token": "ü"}\n'.encode()):
            with closing(Client(server, wrong)) as client:
                answer = client.read()
                assert answer is not None
                assert answer.kind == 4
                assert "token is missing or wrong" in answer.about["error"]
                assert client.read() is None
        with closing(Client(server, b'{"token": "a-token-long-enough"}\n')) as client:
            assert client.until(lambda message: message.kind == 2).about["index"] == 0


def test_loopback_needs_no_token_and_every_other_address_has_one() -> None:
    for host, token in (("127.0.0.1", False), ("0.0.0.0", True)):
        with DepthServer(StreamRequest(host=host, port=0)) as server:
            assert (server.token is not None) == token
    assert StreamRequest().host == "127.0.0.1"


def test_a_taken_port_a_short_token_and_a_foreign_address_are_refused_in_one_line(server: DepthServer) -> None:
    for request, told in (
        (StreamRequest(port=server.address[1]), f"port {server.address[1]}"),
        (StreamRequest(port=0, token="short"), "`token` has 5 characters"),
        (StreamRequest(port=0, host="192.0.2.1"), "cannot listen on port 0 of 192.0.2.1"),
        (StreamRequest(port=70000), "`port` is 70000"),
    ):
        with pytest.raises(UsageError, match=re.escape(told)) as refused:
            DepthServer(request)
        assert str(refused.value).count("\n") == 0


def test_more_clients_than_there_is_room_for_are_told_so(
    slot: SlotWriter, server: DepthServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server_module, "MOST_CLIENTS", 2)
    clients = [Client(server) for _ in range(2)]
    for client in clients:
        client.until(lambda message: message.kind == 1)
    with closing(Client(server)) as third:
        answer = third.read()
        assert answer is not None
        assert (answer.kind, answer.about["error"]) == (4, "2 clients are connected; close one")
    clients[0].close()
    put_map(slot, 1)

    def served() -> bool:
        with closing(Client(server)) as again:
            answer = again.read()
            return answer is not None and answer.kind == 1

    wait_until(served)
    clients[1].close()


def test_the_client_of_the_page_runs_as_it_is_written(slot: SlotWriter, server: DepthServer, tmp_path: Path) -> None:
    page = (ROOT / "docs/reference/depth-stream.md").read_text()
    (code,) = re.findall(r"^```python\n(.*?)^```", page, re.M | re.S)
    assert len(code.splitlines()) <= 20
    assert code.count("8766") == 1
    script = tmp_path / "client.py"
    script.write_text(code.replace("8766", str(server.address[1])))
    put_map(slot, 3)
    process = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        assert process.stdout.readline().split() == ["3", "0", "3.0"]
        put_map(slot, 5)
        assert process.stdout.readline().split() == ["5", "1", "5.0"]
    finally:
        process.kill()
        process.communicate()


def test_the_page_names_every_kind_and_array_and_the_limits() -> None:
    from rig.stream.messages import ARRAYS, MAGIC, MOST_HELLO, VERSION, MessageKind

    page = (ROOT / "docs/reference/depth-stream.md").read_text()
    for kind in MessageKind:
        assert f"{kind.value} {kind.name.lower()}" in page
        assert f"\n| {kind.name.lower()} |" in page
    assert all(f"`{name}`" in page for name in ARRAYS)
    assert f"`{MAGIC.decode()}`" in page
    assert f"version of the format, {VERSION}" in page
    assert f"at most {MOST_HELLO} bytes" in page
    assert f"nothing for {server_module.STUCK_S:g} s" in page
    assert f"At most {server_module.MOST_CLIENTS} clients" in page
    assert str(StreamRequest().port) in page
