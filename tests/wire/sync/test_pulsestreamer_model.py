"""The model of the Pulse Streamer 8/2: alone, behind the vendor's own package, and its server (loopback)."""

import base64
import json
import math
import socket
import struct
from bisect import bisect_right
from contextlib import closing, suppress
from typing import Any

import pytest

from drivers.clock import VirtualClock
from sim_backend.wire.firmware.pulsestreamer import (
    AUTO,
    BOTH,
    FALLING,
    IMMEDIATE,
    INVALID_PARAMS,
    MANUAL,
    METHOD_NOT_FOUND,
    RISING,
    SOFTWARE,
    PulseStreamerModel,
    RpcError,
)
from sim_backend.wire.serve.http import HttpServer

PATIENCE_S = 60.0
"""Longest wait for what comes for sure."""
GATE = [(1000, 2, 0, 0), (2000, 3, 0, 0), (1000, 0, 0, 0)]
"""Output 1 high for 3 us, output 0 with it for the last 2 us, then both low for 1 us."""
ZERO, MARKER = [0, 0, 0, 0], [0, 4, 0, 0]
US = 1e-6


def model(*edges: float, **settings: Any) -> PulseStreamerModel:
    """A box whose trigger line changes its level at these times, low before the first."""

    def first(wanted: bool, from_s: float, until_s: float) -> float | None:
        index = bisect_right(edges, from_s)
        if bool(index % 2) == wanted:
            return from_s
        return edges[index] if index < len(edges) and edges[index] < until_s else None

    return PulseStreamerModel(lambda *times: first(True, *times), low=lambda *times: first(False, *times), **settings)


def packed(steps: list[tuple[int, int, int, int]]) -> str:
    return base64.b64encode(b"".join(struct.pack(">IBhh", *step) for step in steps)).decode()


def streaming(box: PulseStreamerModel, *, start: int, rearm: int = AUTO, n_runs: int = 1, at_s: float = 0.0) -> None:
    """Upload `GATE`, which waits for its start, with a final state in which output 2 is high."""
    box.call("setTrigger", [start, rearm], at_s)
    box.call("stream", [packed(GATE), n_runs, MARKER], at_s)


def starts(box: PulseStreamerModel, until_s: float) -> list[float]:
    """Times at which `GATE` began, up to a time to which the model is advanced now."""
    box.advance(until_s)
    return [at for at, level in box.changes(-1.0, until_s) if level == 2]


def states(box: PulseStreamerModel, at_s: float) -> tuple[Any, ...]:
    """Whether the device streams, has a sequence, and has finished."""
    return tuple(box.call(f, [], at_s) for f in ("isStreaming", "hasSequence", "hasFinished"))


# Sequences


def test_a_sequence_plays_at_once_its_last_state_follows_and_it_never_comes_again_by_itself() -> None:
    box = model()
    assert states(box, 0.0) == (0, 0, 0)
    box.call("constant", [[0, 1, 0, 0]], 0.5)
    streaming(box, start=IMMEDIATE, n_runs=2, at_s=1.0)
    assert states(box, 1.0) == states(box, 1.0 + 7.9 * US) == (1, 1, 0)
    assert states(box, 9.0) == (0, 1, 1)
    times, levels = zip(*box.changes(0.0, 9.0), strict=True)
    assert levels == (0, 1, 2, 3, 0, 2, 3, 0, 4)
    assert times == pytest.approx([0, 0.5, 1, *(1 + us * US for us in (1, 3, 4, 5, 7, 8))], abs=1e-10)
    assert [box.outputs_at(at) for at in times] == list(levels)


@pytest.mark.parametrize(("total_ns", "period_ns"), [(4000, 4000), (4001, 4008), (4007, 4008), (3, 8)])
def test_a_run_is_padded_to_a_multiple_of_8_ns_with_its_last_level(total_ns: int, period_ns: int) -> None:
    box = model()
    box.call("stream", [packed([(1, 1, 0, 0), (0, 7, 0, 0), (total_ns - 1, 2, 0, 0)]), 3, ZERO], 0.0)
    box.advance(1.0)
    expected = [(1e-9 * (run * period_ns + at), level) for run in range(3) for at, level in ((0, 1), (1, 2))]
    flat = [number for change in [*expected, (3e-9 * period_ns, 0)] for number in change]
    assert [number for change in box.changes(-1.0, 1.0)[1:] for number in change] == pytest.approx(flat, abs=1e-11)


def test_an_endless_sequence_plays_at_no_cost_until_it_is_replaced_and_a_new_one_that_waits_finds_its_outputs() -> None:
    box, hours = model(), 36_000.0
    box.call("stream", [packed([(4, 1, 0, 0), (4, 0, 0, 0)]), -1, MARKER], 0.0)
    box.advance(hours)
    assert len(box.changes(hours - US, hours)) == pytest.approx(250, abs=3)
    streaming(box, start=IMMEDIATE, n_runs=-1, at_s=hours)
    streaming(box, start=SOFTWARE, at_s=hours + 2 * US)
    box.advance(hours + 1)
    assert box.changes(hours + 1.5 * US, hours + 1) == [(hours + 1.5 * US, 3)]
    assert states(box, hours + 1) == (0, 1, 0)


@pytest.mark.parametrize("call", ["constant", "reset", "forceFinal"])
@pytest.mark.parametrize("at_s", [2 * US, 1.0])
def test_what_stops_a_sequence_forgets_it(call: str, at_s: float) -> None:
    box = model()
    streaming(box, start=SOFTWARE)
    box.call("startNow", [], 0.0)
    box.call(call, [], at_s)
    after = 4 if call == "forceFinal" else 0
    assert box.call("rearm", [], at_s + 1) == 0
    box.call("startNow", [], at_s + 2)
    box.advance(at_s + 3)
    assert box.changes(at_s, at_s + 3) == [(at_s, after)]
    assert states(box, at_s + 3) == (0, 0, int(call == "forceFinal"))
    assert box.call("getTriggerStart", [], at_s + 3) == (IMMEDIATE if call == "reset" else SOFTWARE)


# Triggers


def test_an_edge_starts_the_sequence_after_61_to_69_ns_in_step_with_the_clock() -> None:
    edges = [0.1 + index * 1.234567e-3 for index in range(50)]
    box = model(*(at for edge in edges for at in (edge, edge + US)))
    streaming(box, start=RISING)
    began = starts(box, 1.0)
    delays = [start - edge for start, edge in zip(began, edges, strict=True)]
    assert 60.9e-9 < min(delays) < 63e-9
    assert 67e-9 < max(delays) < 69.1e-9
    assert all(abs((start * 1e9 - 61) / 8 - round((start * 1e9 - 61) / 8)) < 0.1 for start in began)


SECONDS = [at for second in range(1, 9) for at in (second, second + 0.5)]
QUICK = [1.0, 1 + US, 1 + 2 * US, 1 + 3 * US, 1 + 8 * US, 1 + 9 * US, 1 + 20 * US, 1 + 21 * US]


@pytest.mark.parametrize(
    ("edges", "asked", "calls", "expected"),
    [
        ([1.0, 1.1, 2.0, 2.1], {"start": RISING}, [], [1.0, 2.0]),
        ([1.0, 1.1, 2.0, 2.1], {"start": FALLING}, [], [1.1, 2.1]),
        ([1.0, 1.1, 2.0, 2.1], {"start": BOTH}, [], [1.0, 1.1, 2.0, 2.1]),
        ([1.0, 1.1, 2.0, 2.1], {"start": SOFTWARE}, [], []),
        ([1.0, 1.1, 2.0, 2.1], {"start": IMMEDIATE}, [], [0.0]),
        ([0.5, 2.0, 3.0, 4.0], {"start": RISING, "at_s": 1.0}, [], [3.0]),  # it is high when the box is armed
        (QUICK, {"start": RISING}, [], [1.0, 1 + 20 * US]),  # while it plays, and until it is armed again
        (SECONDS, {"start": RISING, "rearm": MANUAL}, [("rearm", 4.2), ("rearm", 6.7)], [1.0, 5.0, 7.0]),
        ([], {"start": SOFTWARE}, [("startNow", at) for at in (1.0, 1 + 2 * US, 2.0)], [1.0, 2.0]),
        ([], {"start": RISING}, [("startNow", 1.0)], []),
        ([], {"start": SOFTWARE, "rearm": MANUAL}, [("startNow", 1.0), ("startNow", 2.0)], [1.0]),
    ],
)
@pytest.mark.parametrize("pieces", [1, 1000])
def test_only_what_is_a_trigger_starts_the_sequence(
    edges: list[float], asked: dict[str, Any], calls: list[tuple[str, float]], expected: list[float], pieces: int
) -> None:
    box = model(*edges)
    streaming(box, **asked)
    for piece in range(1, pieces + 1):
        at_s = 9.0 * piece / pieces
        while calls and calls[0][1] <= at_s:
            box.call(calls[0][0], [], calls[0][1])
            calls = calls[1:]
        box.advance(at_s)
    assert starts(box, 9.0) == pytest.approx(expected, abs=1e-7)


def test_hours_of_triggers_leave_no_history_behind() -> None:
    def high(from_s: float, until_s: float) -> float | None:
        first = max(from_s, float(math.floor(from_s) + (from_s % 1 >= 0.25)))
        return first if first < until_s else None

    def low(from_s: float, until_s: float) -> float | None:
        first = from_s if from_s % 1 >= 0.25 else math.floor(from_s) + 0.25
        return first if first < until_s else None

    box = PulseStreamerModel(high, low=low)
    streaming(box, start=RISING)
    for hour in range(1, 11):
        box.advance(hour * 3600.0)
        assert [level for _, level in box.changes(hour * 3600 - 1.5, hour * 3600)] == [4, 2, 3, 0, 4]
        box.forget(hour * 3600.0 - 20)
        assert len(box._spans) < 50


# Calls


@pytest.mark.parametrize(
    ("method", "params", "code"),
    [
        *(("isRunning", [], METHOD_NOT_FOUND), ("start", [0, -1], METHOD_NOT_FOUND)),
        *(("constant", params, INVALID_PARAMS) for params in ([[0, 256, 0, 0]], [[0, 1]], [ZERO, 1])),
        *(("stream", [text, 1, ZERO], INVALID_PARAMS) for text in ("", "AAAA", "!")),
        *(("stream", [packed(GATE), *more], INVALID_PARAMS) for more in ([0, ZERO], [1, [0]])),
        *(("setTrigger", [5, 0], INVALID_PARAMS), ("setTrigger", [0, 2], INVALID_PARAMS)),
        *(("selectClock", [3], INVALID_PARAMS), ("isStreaming", [1], INVALID_PARAMS)),
    ],
)
def test_a_call_that_is_refused_changes_nothing(method: str, params: list[Any], code: int) -> None:
    box = model()
    streaming(box, start=SOFTWARE)
    with pytest.raises(RpcError) as caught:
        box.call(method, params, 1.0)
    assert caught.value.code == code
    assert (states(box, 1.0), box.call("getTriggerStart", [], 1.0)) == ((0, 1, 0), SOFTWARE)


def test_without_power_everything_is_forgotten_and_low() -> None:
    box = model()
    box.call("selectClock", [2], 0.0)
    streaming(box, start=SOFTWARE)
    box.call("startNow", [], 1.0)
    box.power_cycle(1 + 2 * US)
    assert (box.outputs_at(1 + 2 * US), states(box, 2.0)) == (0, (0, 0, 0))
    assert [box.call(f, [], 2.0) for f in ("getTriggerStart", "getTriggerRearm", "getClock")] == [IMMEDIATE, AUTO, 0]


def message(steps: list[tuple[int, int, int, int]], n_runs: int = 1, command: int = 0) -> bytes:
    body = b"".join(struct.pack("<IBhh", *step) for step in steps)
    body += bytes(32 - len(body) % 32)
    header = struct.pack("<4I2Q", 0x53504953, 77, command, 0, 32 + len(body), 0)
    return header + struct.pack("<qQ2h4BQ", n_runs, len(steps), 0, 0, 4, 0, 0, 0, 0) + body


def test_binary_uploads_come_in_pieces_and_are_answered_in_order() -> None:
    box, data, answers = model(), bytearray(), b""
    for byte in message(GATE) + message(GATE, command=0x100) + message(GATE, n_runs=0) + message([(9, 1, 0, 0)] * 32):
        data.append(byte)
        answers += box.upload(data, 1.0)
    said = [struct.unpack("<4I2Q", answers[at : at + 32])[1:3] for at in range(0, len(answers), 32)]
    assert (said, bytes(data)) == ([(77, 0), (77, 1), (77, 1), (77, 0)], b"")
    assert box.program is not None
    assert (len(box.program.steps), box.program.final) == (32, 4)
    assert struct.unpack("<4I2Q", box.upload(bytearray(b"GET / HTTP/1.1\r\n" * 3), 1.0))[2] == 1


# The vendor's package, which proves that the model is what it takes for a Pulse Streamer


@pytest.fixture
def package(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setenv("NO_PROXY", "*")
    monkeypatch.setattr("builtins.print", lambda *_: None)
    return pytest.importorskip("pulsestreamer")


def connected(package: Any, server: HttpServer) -> Any:
    """A client, to be closed: the package leaves its socket to the garbage collector."""
    client = package.PulseStreamer(server.address.removesuffix(":8050"))
    client.close = client._PulseStreamerBase__binary_close
    return closing(client)


@pytest.mark.filterwarnings("ignore:.*socket.*:pytest.PytestUnraisableExceptionWarning")  # left open when unplugged
def test_the_package_uploads_starts_watches_and_stops_a_sequence(package: Any) -> None:
    clock, box = VirtualClock(), model(2.0, 2.1, 3.0, 3.1)
    start, rearm = package.TriggerStart, package.TriggerRearm
    with HttpServer(box, clock=clock) as server, connected(package, server) as client:
        assert (client.getSerial(), client.getFirmwareVersion(), client.reset()) == (box.serial, "1.7.0", 0)
        client.setTrigger(start.HARDWARE_RISING, rearm.AUTO)
        assert (client.getTriggerStart(), client.getTriggerRearm()) == (start.HARDWARE_RISING, rearm.AUTO)
        client.selectClock(package.ClockSource.EXT_10MHZ)
        assert client.getClock() == package.ClockSource.EXT_10MHZ
        client.constant(package.OutputState([0]))
        sequence = client.createSequence()
        sequence.setDigital(0, [(1000, 0), (2000, 1), (1000, 0)])
        sequence.setDigital(1, [(3000, 1), (1000, 0)])
        client.stream(sequence, 2, package.OutputState([2]))
        assert box.program is not None
        assert (box.program.steps, box.program.n_runs) == (GATE, 2)
        clock.sleep(2.5)
        assert (client.isStreaming(), client.hasSequence(), client.hasFinished()) == (False, True, True)
        clock.sleep(1.0)
        assert starts(box, 3.5) == pytest.approx([2.0, 2 + 4 * US, 3.0, 3 + 4 * US], abs=1e-7)
        client.stream([(5_000_000_000, 2, 0, 0)], final=package.OutputState([]))
        assert [step[0] for step in box.program.steps] == [0xFFFFFFFF, 5_000_000_000 - 0xFFFFFFFF]
        client.forceFinal()
        assert (client.hasSequence(), box.outputs_at(3.5)) == (False, 0)
        with pytest.raises(Exception, match="METHOD_NOT_FOUND"):
            client.start()
        with pytest.raises(AssertionError, match="error code: 1"):
            client.upload(0, [(8, 1, 0, 0)])
        server.unplug()
        with pytest.raises(Exception, match="refused"):
            client.isStreaming()
        server.plug()
        assert client.isStreaming() is False, "at the same address as before"


def test_package_2_1_garbles_sequences_for_firmware_before_1_1(package: Any) -> None:
    box = model(version="1.0.1")
    with HttpServer(box, clock=VirtualClock()) as server:
        package.PulseStreamer(server.address.removesuffix(":8050")).stream([(1000, 2, 0, 0)], 1)
    assert box.program is not None
    assert box.program.steps == [(int.from_bytes((1000).to_bytes(4, "little"), "big"), 2, 0, 0)]


# The server


def answer(client: socket.socket, body: bytes = b"", path: bytes = b"/json-rpc") -> tuple[bytes, Any]:
    """Ask, unless the body is empty; returns status line and body of the next answer."""
    if body:
        client.sendall(b"POST %b HTTP/1.1\r\nHost: x\r\nContent-Length: %d\r\n\r\n%b" % (path, len(body), body))
    said = b""
    while b"\r\n\r\n" not in said:
        said += client.recv(65536)
    head, _, rest = said.partition(b"\r\n\r\n")
    length = int(head.lower().partition(b"content-length:")[2].split(b"\r\n")[0])
    while len(rest) < length:
        rest += client.recv(65536)
    return head.split(b"\r\n")[0], json.loads(rest) if rest[:1] == b"{" else rest


def test_a_connection_is_kept_and_errors_are_those_of_json_rpc() -> None:
    with HttpServer(model()) as server, socket.create_connection((server._host, 8050), PATIENCE_S) as client:
        status, body = answer(client, b'{"jsonrpc":"2.0","id":"1","method":"getHostname"}')
        assert (status, body) == (b"HTTP/1.1 200 OK", {"jsonrpc": "2.0", "id": "1", "result": "pulsestreamer"})
        for asked, code in (
            (b'{"id":2,"method":"nothing"}', METHOD_NOT_FOUND),
            (b'{"id":2,"method":"reset","params":[1]}', INVALID_PARAMS),
            (b'{"id":2,"method":"reset","params":{}}', -32600),
            *((b"[]", -32600), (b"{", -32700)),
        ):
            assert answer(client, asked)[1]["error"]["code"] == code
        assert answer(client, b'{"method":"reset"}')[1] == b"", "a notification"
        assert answer(client, b"{}", b"/")[0].startswith(b"HTTP/1.1 404")


def test_a_hung_device_answers_after_the_hang_and_a_connection_dies_with_the_cable() -> None:
    question = b'{"jsonrpc":"2.0","id":1,"method":"isStreaming"}'
    with HttpServer(model()) as server, socket.create_connection((server._host, 8050), PATIENCE_S) as client:
        answer(client, question)
        server.hang()
        client.settimeout(0.2)
        with pytest.raises(TimeoutError):
            answer(client, question)
        server.resume()
        client.settimeout(PATIENCE_S)
        assert answer(client)[1]["result"] == 0
        server.hang()
        client.sendall(b"POST /json-rpc HTTP/1.1\r\nContent-Length: %d\r\n\r\n%b" % (len(question), question))
        server.unplug()
        with suppress(ConnectionResetError):
            assert client.recv(65536) == b""
