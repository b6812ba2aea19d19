"""The model of the Pulse Streamer 8/2: alone, and behind the vendor's own package, which connects over loopback."""

import base64
import json
import math
import socket
import struct
import time
from bisect import bisect_right
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
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

GATE = [(1000, 2, 0, 0), (2000, 3, 0, 0), (1000, 0, 0, 0)]
"""Output 1 high for 3 us, output 0 with it for the last 2 us, then both low for 1 us."""
ZERO, MARKER = [0, 0, 0, 0], [0, 4, 0, 0]


class Wire:
    """A trigger line that changes its level at the given times, low before the first."""

    def __init__(self, *edges: float) -> None:
        self._edges = edges

    def level(self, at_s: float) -> bool:
        return bool(bisect_right(self._edges, at_s) % 2)

    def high(self, from_s: float, until_s: float) -> float | None:
        return self._first(True, from_s, until_s)

    def low(self, from_s: float, until_s: float) -> float | None:
        return self._first(False, from_s, until_s)

    def _first(self, wanted: bool, from_s: float, until_s: float) -> float | None:
        if self.level(from_s) == wanted:
            return from_s
        return next((at for at in self._edges if from_s < at < until_s and self.level(at) == wanted), None)


def packed(steps: list[tuple[int, int, int, int]], order: str = ">") -> str:
    return base64.b64encode(b"".join(struct.pack(f"{order}IBhh", *step) for step in steps)).decode()


def streaming(model: PulseStreamerModel, *, start: int, rearm: int = AUTO, n_runs: int = 1, at_s: float = 0.0) -> None:
    """Upload `GATE`, which waits for its start, with a final state in which output 2 is high."""
    model.call("setTrigger", [start, rearm], at_s)
    model.call("stream", [packed(GATE), n_runs, MARKER], at_s)


def starts(model: PulseStreamerModel, until_s: float) -> list[float]:
    """Times at which `GATE` began, up to a time to which the model is advanced now."""
    model.advance(until_s)
    return [at for at, level in model.changes(-1.0, until_s) if level == 2]


def states(model: PulseStreamerModel, at_s: float) -> tuple[Any, Any, Any]:
    """Whether the device streams, has a sequence, and has finished."""
    streams, has, finished = (model.call(f, [], at_s) for f in ("isStreaming", "hasSequence", "hasFinished"))
    return streams, has, finished


# Sequences


def test_a_sequence_plays_at_once_its_last_state_follows_and_it_never_comes_again_by_itself() -> None:
    model = PulseStreamerModel()
    assert states(model, 0.0) == (0, 0, 0)
    model.call("constant", [[0, 1, 0, 0]], 0.5)
    streaming(model, start=IMMEDIATE, n_runs=2, at_s=1.0)
    assert states(model, 1.0) == (1, 1, 0)
    assert states(model, 1.0 + 7.9e-6) == (1, 1, 0)
    assert states(model, 9.0) == (0, 1, 1)
    times, levels = zip(*model.changes(0.0, 9.0), strict=True)
    assert levels == (0, 1, 2, 3, 0, 2, 3, 0, 4)
    assert times == pytest.approx([0, 0.5, 1, *(1 + us * 1e-6 for us in (1, 3, 4, 5, 7, 8))], abs=1e-10)
    assert [model.outputs_at(at) for at in times] == list(levels)


@pytest.mark.parametrize(("total_ns", "period_ns"), [(4000, 4000), (4001, 4008), (4007, 4008), (3, 8)])
def test_a_run_is_padded_to_a_multiple_of_8_ns_with_its_last_level(total_ns: int, period_ns: int) -> None:
    model = PulseStreamerModel()
    model.call("stream", [packed([(1, 1, 0, 0), (total_ns - 1, 2, 0, 0)]), 3, ZERO], 0.0)
    model.advance(1.0)
    rises = [at for at, level in model.changes(-1.0, 1.0) if level == 1]
    assert rises == pytest.approx([0.0, period_ns * 1e-9, 2 * period_ns * 1e-9], abs=1e-11)
    end_s, level = model.changes(-1.0, 1.0)[-1]
    assert (end_s, level) == pytest.approx((3 * period_ns * 1e-9, 0), abs=1e-11)


def test_steps_without_a_duration_are_left_out() -> None:
    model = PulseStreamerModel()
    model.call("stream", [packed([(0, 7, 0, 0), (800, 1, 0, 0), (0, 0xAA, 5, 5), (800, 2, 0, 0)]), 1, ZERO], 0.0)
    model.advance(1.0)
    assert [level for _, level in model.changes(-1.0, 1.0)] == [0, 1, 2, 0]
    model.call("stream", [packed([(0, 1, 0, 0)]), 1, ZERO], 2.0)
    model.advance(3.0)
    assert [level for _, level in model.changes(1.5, 3.0)] == [0, 1, 0]


def test_an_endless_sequence_plays_for_hours_at_no_cost_until_it_is_replaced() -> None:
    model = PulseStreamerModel()
    model.call("stream", [packed([(4, 1, 0, 0), (4, 0, 0, 0)]), -1, MARKER], 0.0)
    hours = 36_000.0
    model.advance(hours)
    assert states(model, hours) == (1, 1, 0)
    assert len(model.changes(hours - 1e-6, hours)) == pytest.approx(250, abs=3)
    assert model.outputs_at(hours - 2e-9) in (0, 1)
    model.call("stream", [packed(GATE), 1, ZERO], hours)
    model.advance(hours + 1)
    assert [level for _, level in model.changes(hours, hours + 1)] == [2, 3, 0]


def test_a_new_sequence_that_waits_finds_the_outputs_as_the_old_one_left_them() -> None:
    model = PulseStreamerModel()
    streaming(model, start=IMMEDIATE, n_runs=-1)
    streaming(model, start=SOFTWARE, at_s=2e-6)
    model.advance(1.0)
    assert model.changes(1.5e-6, 1.0) == [(1.5e-6, 3)]
    assert states(model, 1.0) == (0, 1, 0)


@pytest.mark.parametrize("call", ["constant", "reset", "forceFinal"])
@pytest.mark.parametrize("at_s", [2e-6, 1.0])
def test_what_stops_a_sequence_forgets_it(call: str, at_s: float) -> None:
    model = PulseStreamerModel()
    streaming(model, start=SOFTWARE)
    model.call("startNow", [], 0.0)
    assert model.call(call, [], at_s) in (0, None)
    after = 4 if call == "forceFinal" else 0
    assert model.outputs_at(at_s) == after
    assert model.call("rearm", [], at_s + 1) == 0
    model.call("startNow", [], at_s + 2)
    model.advance(at_s + 3)
    assert model.changes(at_s, at_s + 3) == [(at_s, after)]
    assert states(model, at_s + 3) == (0, 0, int(call == "forceFinal"))
    assert model.call("getTriggerStart", [], at_s + 3) == (IMMEDIATE if call == "reset" else SOFTWARE)


def test_the_final_state_is_forced_on_a_sequence_that_waits_but_not_on_constant_outputs() -> None:
    model = PulseStreamerModel()
    model.call("constant", [[0, 1, 0, 0]], 0.0)
    model.call("forceFinal", [], 0.0)
    assert (model.outputs_at(0.0), states(model, 0.0)) == (1, (0, 0, 0))
    streaming(model, start=SOFTWARE, at_s=1.0)
    model.call("forceFinal", [], 2.0)
    assert (model.outputs_at(2.0), states(model, 2.0)) == (4, (0, 0, 1))


@pytest.mark.parametrize("call", ["constant", "forceFinal"])
@pytest.mark.parametrize(("stops_s", "n_runs"), [(0.5, 1), (1.0 + 2e-6, 1), (1.5, 1), (1.5, -1)])
def test_firmware_that_keeps_the_sequence_starts_it_again_with_the_next_edge(
    call: str, stops_s: float, n_runs: int
) -> None:
    wire = Wire(1.0, 1.1, 2.0, 2.1)
    model = PulseStreamerModel(wire.high, low=wire.low, keeps_sequence=True)
    streaming(model, start=RISING, n_runs=n_runs)
    model.call(call, [], stops_s)
    assert model.outputs_at(stops_s) == (0 if call == "constant" else 4)
    model.advance(2.0 + 0.5e-6)
    assert model.outputs_at(2.0 + 0.5e-6) == 2
    model.call("reset", [], 2.0 + 1e-6)
    assert states(model, 3.0) == (0, 0, 0)


# Triggers


def test_an_edge_starts_the_sequence_after_61_to_69_ns_in_step_with_the_clock() -> None:
    edges = [0.1 + index * 1.234567e-3 for index in range(50)]
    wire = Wire(*(at for edge in edges for at in (edge, edge + 1e-6)))
    model = PulseStreamerModel(wire.high, low=wire.low)
    streaming(model, start=RISING)
    began = starts(model, 1.0)
    delays = [start - edge for start, edge in zip(began, edges, strict=True)]
    assert min(delays) > 60.9e-9
    assert max(delays) < 69.1e-9
    assert max(delays) - min(delays) > 6e-9
    assert all(
        math.isclose((start * 1e9 - 61) / 8 % 1, round((start * 1e9 - 61) / 8 % 1), abs_tol=0.1) for start in began
    )


@pytest.mark.parametrize(
    ("start", "expected"),
    [(RISING, [1.0, 2.0]), (FALLING, [1.1, 2.1]), (BOTH, [1.0, 1.1, 2.0, 2.1]), (SOFTWARE, []), (IMMEDIATE, [0.0])],
)
@pytest.mark.parametrize("pieces", [1, 7, 1000])
def test_only_the_chosen_edges_count(start: int, expected: list[float], pieces: int) -> None:
    wire = Wire(1.0, 1.1, 2.0, 2.1)
    model = PulseStreamerModel(wire.high, low=wire.low)
    streaming(model, start=start)
    for piece in range(1, pieces + 1):
        model.advance(3.0 * piece / pieces)
    assert starts(model, 3.0) == pytest.approx(expected, abs=1e-7)


def test_a_line_that_is_high_when_the_device_is_armed_starts_nothing_before_it_has_been_low() -> None:
    wire = Wire(0.5, 2.0, 3.0, 4.0)
    model = PulseStreamerModel(wire.high, low=wire.low)
    streaming(model, start=RISING, at_s=1.0)
    assert starts(model, 5.0) == pytest.approx([3.0], abs=1e-7)


def test_edges_while_the_sequence_plays_and_shortly_after_are_lost() -> None:
    wire = Wire(1.0, 1.0 + 1e-6, 1.0 + 2e-6, 1.0 + 3e-6, 1.0 + 8e-6, 1.0 + 9e-6, 1.0 + 20e-6, 1.0 + 21e-6)
    model = PulseStreamerModel(wire.high, low=wire.low, rearm_s=10e-6)
    streaming(model, start=RISING)
    assert starts(model, 2.0) == pytest.approx([1.0, 1.0 + 20e-6], abs=1e-7)
    quick = PulseStreamerModel(wire.high, low=wire.low, rearm_s=0.0)
    streaming(quick, start=RISING)
    assert starts(quick, 2.0) == pytest.approx([1.0, 1.0 + 8e-6, 1.0 + 20e-6], abs=1e-7)


def test_only_the_end_of_all_runs_makes_the_device_ready_again() -> None:
    wire = Wire(1.0, 1.5, 2.0, 2.5, 3.0, 3.5)
    model = PulseStreamerModel(wire.high, low=wire.low)
    streaming(model, start=RISING, n_runs=300_000)
    model.advance(4.0)
    changes = model.changes(2.2 - 4e-6, 2.2 + 4e-6)
    assert [level for _, level in changes[-2:]] == [0, 4], "300 000 runs of 4 us end after 1.2 s"
    assert states(model, 4.0) == (1, 1, 0), "the edge at 3 s started it again"


def test_manual_rearm_lets_one_sequence_through() -> None:
    wire = Wire(*(at for second in range(1, 9) for at in (second, second + 0.5)))
    model = PulseStreamerModel(wire.high, low=wire.low)
    streaming(model, start=RISING, rearm=MANUAL)
    assert states(model, 3.2) == (0, 1, 1)
    assert model.call("rearm", [], 4.2) == 1, "the line is high: the edge at 5 s is next"
    assert model.call("rearm", [], 6.7) == 1
    assert starts(model, 9.0) == pytest.approx([1.0, 5.0, 7.0], abs=1e-7)
    assert states(model, 9.0) == (0, 1, 1)


def test_software_starts_work_only_in_their_modes_and_between_sequences() -> None:
    model = PulseStreamerModel()
    streaming(model, start=SOFTWARE)
    assert states(model, 0.5) == (0, 1, 0)
    for at_s in (1.0, 1.0 + 2e-6, 2.0):
        assert model.call("startNow", [], at_s) == 0
    model.call("setTrigger", [RISING, AUTO], 3.0)
    model.call("startNow", [], 3.5)
    model.call("setTrigger", [IMMEDIATE, AUTO], 4.0)
    model.call("startNow", [], 5.0)
    assert starts(model, 6.0) == [1.0, 2.0, 5.0]


def test_without_low_the_line_is_sampled() -> None:
    wire = Wire(1.0, 1.1, 2.0, 2.0 + 3e-6, 3.0, 3.1)
    model = PulseStreamerModel(wire.high)
    streaming(model, start=RISING)
    for piece in range(4001):
        model.advance(piece * 1e-3)
    assert starts(model, 4.0) == pytest.approx([1.0, 2.0, 3.0], abs=1e-7)


def test_the_trigger_line_is_never_asked_about_the_future() -> None:
    now_s = 0.0

    def high(from_s: float, until_s: float) -> float | None:
        assert from_s <= now_s + 1e-12
        assert until_s <= now_s + 1e-12 or until_s == math.nextafter(from_s, math.inf)
        return Wire(*(at / 10 for at in range(1, 100))).high(from_s, until_s)

    model = PulseStreamerModel(high)
    streaming(model, start=RISING)
    for step in range(1, 1000):
        now_s = step * 1.3e-3
        model.advance(now_s)
    assert len(starts(model, now_s)) == 6


def test_hours_of_triggers_leave_no_history_behind() -> None:
    def high(from_s: float, until_s: float) -> float | None:
        second = math.floor(from_s) + (from_s % 1 >= 0.25)
        first = max(from_s, float(second))
        return first if first < until_s else None

    def low(from_s: float, until_s: float) -> float | None:
        first = from_s if from_s % 1 >= 0.25 else math.floor(from_s) + 0.25
        return first if first < until_s else None

    model = PulseStreamerModel(high, low=low)
    streaming(model, start=RISING)
    for hour in range(1, 11):
        model.advance(hour * 3600.0)
        assert [level for _, level in model.changes(hour * 3600 - 1.5, hour * 3600)] == [4, 2, 3, 0, 4]
        model.forget(hour * 3600.0 - 20)
        assert len(model._spans) < 50
        assert model.outputs_at(hour * 3600.0 - 20) == 4


# Calls that are refused, and the state at power-up


@pytest.mark.parametrize(
    ("method", "params", "code"),
    [
        ("isRunning", [], METHOD_NOT_FOUND),
        ("start", [0, -1], METHOD_NOT_FOUND),
        ("constant", [[0, 256, 0, 0]], INVALID_PARAMS),
        ("constant", [[0, 1]], INVALID_PARAMS),
        ("constant", [ZERO, 1], INVALID_PARAMS),
        ("stream", [], INVALID_PARAMS),
        ("stream", ["", 1, ZERO], INVALID_PARAMS),
        ("stream", ["AAAA", 1, ZERO], INVALID_PARAMS),
        ("stream", ["!", 1, ZERO], INVALID_PARAMS),
        ("stream", [packed(GATE), 0, ZERO], INVALID_PARAMS),
        ("stream", [packed(GATE), 1, [0]], INVALID_PARAMS),
        ("setTrigger", [5, 0], INVALID_PARAMS),
        ("setTrigger", [0, 2], INVALID_PARAMS),
        ("selectClock", [3], INVALID_PARAMS),
        ("isStreaming", [1], INVALID_PARAMS),
    ],
)
def test_a_call_that_is_refused_changes_nothing(method: str, params: list[Any], code: int) -> None:
    model = PulseStreamerModel()
    streaming(model, start=SOFTWARE, at_s=0.0)
    with pytest.raises(RpcError) as caught:
        model.call(method, params, 1.0)
    assert caught.value.code == code
    assert states(model, 1.0) == (0, 1, 0)
    assert model.call("getTriggerStart", [], 1.0) == SOFTWARE


def test_without_power_everything_is_forgotten_and_low() -> None:
    model = PulseStreamerModel()
    model.call("selectClock", [2], 0.0)
    streaming(model, start=SOFTWARE)
    model.call("startNow", [], 1.0)
    model.power_cycle(1.0 + 2e-6)
    assert model.outputs_at(1.0 + 2e-6) == 0
    assert states(model, 2.0) == (0, 0, 0)
    assert [model.call(f, [], 2.0) for f in ("getTriggerStart", "getTriggerRearm", "getClock")] == [IMMEDIATE, AUTO, 0]


def message(steps: list[tuple[int, int, int, int]], n_runs: int = 1, command: int = 0) -> bytes:
    body = b"".join(struct.pack("<IBhh", *step) for step in steps)
    body += bytes(32 - len(body) % 32)
    header = struct.pack("<4I2Q", 0x53504953, 77, command, 0, 32 + len(body), 0)
    return header + struct.pack("<qQ2h4BQ", n_runs, len(steps), 0, 0, 4, 0, 0, 0, 0) + body


def test_binary_uploads_come_in_pieces_and_are_answered_in_order() -> None:
    model = PulseStreamerModel()
    data, answers = bytearray(), b""
    for byte in message(GATE) + message(GATE, command=0x100) + message(GATE, n_runs=0) + message([(9, 1, 0, 0)] * 32):
        data.append(byte)
        answers += model.upload(data, 1.0)
    assert not data
    assert [struct.unpack("<4I2Q", answers[at : at + 32])[1:3] for at in range(0, len(answers), 32)] == [
        (77, 0),
        (77, 1),
        (77, 1),
        (77, 0),
    ]
    assert model.program is not None
    assert (len(model.program.steps), model.program.final) == (32, 4)
    assert struct.unpack("<4I2Q", model.upload(bytearray(b"GET / HTTP/1.1\r\n" * 3), 1.0))[2] == 1


# The vendor's package


@contextmanager
def serving(model: PulseStreamerModel, clock: VirtualClock | None = None) -> Iterator[tuple[HttpServer, str]]:
    """The server of a model, with the address that the package is given."""
    with HttpServer(model, clock=clock) as server:
        yield server, server.address.removesuffix(":8050")


@pytest.fixture
def package(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setenv("NO_PROXY", "*")
    monkeypatch.setattr("builtins.print", lambda *_: None)
    return pytest.importorskip("pulsestreamer")


def connected(package: Any, host: str) -> Any:
    """A client, to be closed: the package leaves its socket to the garbage collector."""
    client = package.PulseStreamer(host)
    client.close = client._PulseStreamerBase__binary_close
    return closing(client)


def test_the_package_uploads_starts_watches_and_stops_a_sequence(package: Any) -> None:
    clock, wire = VirtualClock(), Wire(2.0, 2.1, 3.0, 3.1)
    model = PulseStreamerModel(wire.high, low=wire.low)
    start, rearm = package.TriggerStart, package.TriggerRearm
    with serving(model, clock) as (_, host), connected(package, host) as client:
        assert (client.getSerial(), client.getFirmwareVersion()) == (model.serial, "1.7.0")
        assert client.reset() == 0
        assert client.setTrigger(start.HARDWARE_RISING, rearm.AUTO) == 0
        assert (client.getTriggerStart(), client.getTriggerRearm()) == (start.HARDWARE_RISING, rearm.AUTO)
        assert client.selectClock(package.ClockSource.EXT_10MHZ) == 0
        assert client.getClock() == package.ClockSource.EXT_10MHZ
        client.constant(package.OutputState([0]))
        sequence = client.createSequence()
        sequence.setDigital(0, [(1000, 0), (2000, 1), (1000, 0)])
        sequence.setDigital(1, [(3000, 1), (1000, 0)])
        client.stream(sequence, 2, package.OutputState([2]))
        assert model.program is not None
        assert (model.program.steps, model.program.n_runs) == (GATE, 2)
        assert (client.isStreaming(), client.hasSequence(), client.hasFinished()) == (False, True, False)
        clock.sleep(2.5)
        assert (client.isStreaming(), client.hasSequence(), client.hasFinished()) == (False, True, True)
        clock.sleep(1.0)
        assert starts(model, 3.5) == pytest.approx([2.0, 2.0 + 4e-6, 3.0, 3.0 + 4e-6], abs=1e-7)
        client.stream([(5_000_000_000, 2, 0, 0)], final=package.OutputState([]))
        assert [step[0] for step in model.program.steps] == [0xFFFFFFFF, 5_000_000_000 - 0xFFFFFFFF]
        assert client.rearm() is True
        client.forceFinal()
        assert (client.hasSequence(), model.outputs_at(3.5)) == (False, 0)
        assert client.startNow() == 0
        with pytest.raises(Exception, match="METHOD_NOT_FOUND"):
            client.start()
        with pytest.raises(AssertionError, match="error code: 1"):
            client.upload(0, [(8, 1, 0, 0)])


def test_package_2_1_garbles_sequences_for_firmware_before_1_1(package: Any) -> None:
    model = PulseStreamerModel(version="1.0.1")
    with serving(model, VirtualClock()) as (_, host):
        client = package.PulseStreamer(host)
        assert client.getSerial() == model.serial
        client.stream([(1000, 2, 0, 0)], 1)
    assert model.program is not None
    assert model.program.steps == [(int.from_bytes((1000).to_bytes(4, "little"), "big"), 2, 0, 0)]


@pytest.mark.filterwarnings("ignore:.*socket.*:pytest.PytestUnraisableExceptionWarning")  # the package leaves it open
def test_an_unplugged_device_refuses_clients_and_is_found_at_the_same_address_again(package: Any) -> None:
    model = PulseStreamerModel()
    with serving(model, VirtualClock()) as (server, host), connected(package, host) as client:
        client.constant(package.OutputState([1]))
        server.unplug()
        server.unplug()
        with pytest.raises(Exception, match="refused"):
            client.isStreaming()
        with pytest.raises(ConnectionError):
            client.stream([(8, 1, 0, 0)])
        server.plug()
        assert server.address == f"{host}:8050"
        assert client.isStreaming() is False
        assert model.outputs_at(0.0) == 2
        client.stream([(8, 1, 0, 0)])
        assert client.isStreaming() is True


def post(client: socket.socket, body: bytes, path: bytes = b"/json-rpc") -> tuple[bytes, bytes]:
    """Ask; returns status line and body of the answer."""
    client.sendall(b"POST %b HTTP/1.1\r\nHost: x\r\nContent-Length: %d\r\n\r\n%b" % (path, len(body), body))
    return answer(client)


def answer(client: socket.socket) -> tuple[bytes, bytes]:
    """The next status line and body that the server sends."""
    said = b""
    while b"\r\n\r\n" not in said:
        said += client.recv(65536)
    head, _, rest = said.partition(b"\r\n\r\n")
    length = int(
        next(line.split(b":")[1] for line in head.split(b"\r\n") if line.lower().startswith(b"content-length"))
    )
    while len(rest) < length:
        rest += client.recv(65536)
    return head.split(b"\r\n")[0], rest


def test_a_connection_is_kept_and_errors_are_those_of_json_rpc() -> None:
    with (
        serving(PulseStreamerModel(), VirtualClock()) as (_, host),
        socket.create_connection((host, 8050), timeout=5) as client,
    ):
        status, body = post(client, b'{"jsonrpc":"2.0","id":"1","method":"getHostname"}')
        assert (status, json.loads(body)) == (
            b"HTTP/1.1 200 OK",
            {"jsonrpc": "2.0", "id": "1", "result": "pulsestreamer"},
        )
        assert json.loads(post(client, b'{"id":2,"method":"nothing"}')[1])["error"]["code"] == METHOD_NOT_FOUND
        assert json.loads(post(client, b'{"id":2,"method":"reset","params":[1]}')[1])["error"]["code"] == INVALID_PARAMS
        assert json.loads(post(client, b'{"id":2,"method":"reset","params":{}}')[1])["error"]["code"] == -32600
        assert json.loads(post(client, b"[]")[1])["error"]["code"] == -32600
        assert json.loads(post(client, b"{")[1])["error"]["code"] == -32700
        assert post(client, b'{"method":"reset"}')[1] == b"", "a notification"
        assert post(client, b"{}", b"/")[0].startswith(b"HTTP/1.1 404")


def test_a_hung_device_answers_after_the_hang_and_a_connection_dies_with_the_cable() -> None:
    question = b'{"jsonrpc":"2.0","id":1,"method":"isStreaming"}'
    with (
        serving(PulseStreamerModel(), VirtualClock()) as (server, host),
        socket.create_connection((host, 8050), timeout=0.1) as client,
    ):
        post(client, question)
        server.hang()
        with pytest.raises(TimeoutError):
            post(client, question)
        server.resume()
        client.settimeout(5)
        assert json.loads(answer(client)[1])["result"] == 0
        server.hang()
        client.sendall(b"POST /json-rpc HTTP/1.1\r\nContent-Length: %d\r\n\r\n%b" % (len(question), question))
        server.unplug()
        with suppress(ConnectionResetError):
            assert client.recv(65536) == b""


def test_closing_a_hung_server_takes_no_time() -> None:
    began = time.monotonic()
    with serving(PulseStreamerModel(), VirtualClock()) as (server, host):
        with socket.create_connection((host, 21328), timeout=5) as client:
            server.hang()
            client.sendall(message(GATE))
        server.close()
    assert time.monotonic() - began < 2
