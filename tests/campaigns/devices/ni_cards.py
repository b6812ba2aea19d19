"""Random faults between NI's package and a card behind a gRPC server: every sequence ends right, or with one of our
errors, in time.

The channel is within this process and in virtual time, deadlines included; the package, the driver's interceptor and
the server's answers are the real ones. Calls come late, get lost before or after they are done, are refused with one of
NI's errors or fail after they are done; the server stalls, hangs or goes away. Beside what is right for all scanners,
a card that was closed without an error has its markers low and its mirror at the centre.
"""

import random
import threading
from functools import lru_cache
from typing import Any
from unittest.mock import patch

import grpc
import numpy as np
from nidaqmx._stubs.nidaqmx_pb2_grpc import NiDAQmxStub

from drivers.clock import VirtualClock, now_s
from drivers.interfaces import LEVEL_BACKWARD, BeamScanner, ScanWaveform
from drivers.registry import Surroundings, lookup
from drivers.transports.endpoints import Endpoint
from sim_backend.wire.firmware.helios import BLUE, GREEN, INTENSITY
from sim_backend.wire.firmware.nidaq import NidaqModel
from sim_backend.wire.serve.grpc import GrpcServer
from tests.campaigns.devices import scanners
from tests.campaigns.outcomes import Ending, close_or_raise
from tests.wire.emulated_scanners import GALVO
from tests.wire.faults import Fault, FaultSchedule

FAULTS = (Fault.LATE, Fault.LOST, Fault.STALL, Fault.UNPLUG, Fault.HANG, Fault.CORRUPTED, Fault.TRUNCATED)
"""Corrupted: refused. Truncated: done, but told to have failed."""
CODES = (-50103, -200587, -200452, -88709, -201003, -50405, -200474, -200290, -12345)
GONE = (-88709, -201003, -50405)
"""Codes after which the driver takes the card for lost, with nothing left to be made safe."""
NIDAQ = scanners.Subject("nidaq", NidaqModel, {"buffer": "100 ms"}, BLUE, GREEN, INTENSITY)
DEADLINE_S = 60.0


class CallFailed(grpc.RpcError):
    """An answer other than OK."""

    def __init__(self, status: Any, text: str = "", trailing: Any = ()) -> None:
        self._status, self._text, self._trailing = status, text, trailing

    def code(self) -> Any:
        return self._status

    def details(self) -> str:
        return self._text

    def trailing_metadata(self) -> Any:
        return self._trailing

    def result(self) -> None:
        raise self


class _Key:
    def __init__(self, key: str, value: str) -> None:
        self.key, self.value = key, value


class Context:
    """The server's side of a call."""

    def __init__(self, clock: VirtualClock, timeout_s: float) -> None:
        self._clock, self._until_s = clock, now_s(clock) + timeout_s
        self._trailing: list[_Key] = []

    def is_active(self) -> bool:
        return now_s(self._clock) < self._until_s

    def set_trailing_metadata(self, pairs: list[tuple[str, str]]) -> None:
        self._trailing = [_Key(*pair) for pair in pairs]

    def abort(self, status: Any, text: str) -> None:
        late = status is grpc.StatusCode.UNAVAILABLE and not self.is_active()
        raise CallFailed(grpc.StatusCode.DEADLINE_EXCEEDED if late else status, text, self._trailing)


class FaultyChannel:
    """A channel to the card's server, without a network. Replaces grpc.insecure_channel."""

    def __init__(self, model: NidaqModel, clock: VirtualClock, schedule: FaultSchedule, rng: random.Random) -> None:
        self._server, self._clock, self._schedule, self._rng = GrpcServer(model, clock=clock), clock, schedule, rng
        self._server._server = self
        self._methods = self._server._messages.DESCRIPTOR.services_by_name["NiDAQmx"].methods_by_name
        self._lock = threading.Lock()
        self.gone = self.hung = self.gone_told = False
        self._stalled_until_s = 0.0

    def unary_unary(self, path: str, *_: Any, **__: Any) -> Any:
        rpc = path.rpartition("/")[2]

        class Method:
            @staticmethod
            def with_call(request: Any, timeout: float, **_: Any) -> tuple[Any, Any]:
                return self._call(rpc, request, timeout), Answered()

        return Method()

    def __getattr__(self, name: str) -> Any:
        return lambda *_, **__: None  # calls of other kinds, and close

    def _call(self, rpc: str, request: Any, timeout_s: float) -> Any:
        with self._lock:
            fault = None if self.gone or self.hung else self._schedule.next()
            self.gone |= fault is Fault.UNPLUG
            self.hung |= fault is Fault.HANG
            if fault is Fault.STALL:
                self._stalled_until_s = now_s(self._clock) + self._schedule.stall_s
        context = Context(self._clock, timeout_s)
        if self.gone:
            raise CallFailed(grpc.StatusCode.UNAVAILABLE)
        wait_s = max(0.0, self._stalled_until_s - now_s(self._clock))
        if fault is Fault.LATE:
            wait_s += self._rng.uniform(0.1, 1.0) * self._schedule.late_s
        lost_before = fault is Fault.LOST and self._rng.random() < 0.5
        if self.hung or lost_before or wait_s >= timeout_s:
            self._clock.sleep(timeout_s)
            raise CallFailed(grpc.StatusCode.DEADLINE_EXCEEDED)
        if wait_s:
            self._clock.sleep(wait_s)
        if fault is Fault.CORRUPTED and rpc != "ClearTask":  # which is always done
            raise self._refused()
        answer = self._server._answer(rpc, request, context, self._type(rpc))
        if fault is Fault.LOST:
            self._clock.sleep(timeout_s)
            raise CallFailed(grpc.StatusCode.DEADLINE_EXCEEDED)
        if fault in (Fault.TRUNCATED, Fault.CORRUPTED):
            raise self._refused()
        return answer

    def _type(self, rpc: str) -> Any:
        if not self._server.model.serves(rpc):
            raise CallFailed(grpc.StatusCode.UNIMPLEMENTED, rpc)
        return getattr(self._server._messages, self._methods[rpc].output_type.name)

    def _refused(self) -> CallFailed:
        code = self._rng.choice(CODES)
        self.gone_told |= code in GONE
        return CallFailed(grpc.StatusCode.UNKNOWN, f"error {code}\nin detail", [_Key("ni-error", str(code))])


class Answered:
    """The client's side of a call that was answered."""

    def code(self) -> Any:
        return grpc.StatusCode.OK

    def __getattr__(self, name: str) -> Any:
        return lambda *_: ()


class _Ready:
    def result(self, timeout: float) -> None:
        """Return at once."""


def sequence(seed: int) -> Ending:
    rng = random.Random(seed)
    schedule = FaultSchedule(
        seed,
        rng.choice((0.003, 0.01, 0.05, 0.3)),
        FAULTS,
        skip=rng.randrange(250),
        most=rng.randrange(1, 5),
        late_s=rng.choice((0.01, 0.2)),
        stall_s=rng.choice((0.05, 0.3, 3.0)),
    )
    clock, model = VirtualClock(), NidaqModel()
    channel = FaultyChannel(model, clock, schedule, rng)
    entry = lookup("scanner", "nidaq")
    config = entry.config.model_validate({"kind": "nidaq", "port": "emulated:dac", **GALVO, **NIDAQ.config})
    surroundings = Surroundings(clock, None, 1, {"dac": Endpoint("127.0.0.1:1/Dev1")})

    def act() -> str:
        device = entry.create(config, surroundings)
        try:
            end = scanners.judged(NIDAQ, rng, device, lit_wave(device), lambda: now_s(clock), model.history)
        finally:
            close_or_raise(device)
        if not (channel.gone or channel.gone_told):
            require_rest(model, now_s(clock), {Fault.LOST, Fault.STALL}.isdisjoint(schedule.struck))
        return end

    with (
        patch("grpc.insecure_channel", lambda *_, **__: channel),
        patch("grpc.channel_ready_future", lambda _: _Ready()),
        patch("nidaqmx._stubs.nidaqmx_pb2_grpc.NiDAQmxStub", lru_cache(1)(NiDAQmxStub)),  # costs 10 ms a task
    ):
        return scanners.ending_of(act, schedule, lambda: now_s(clock), DEADLINE_S)


def lit_wave(device: BeamScanner) -> ScanWaveform:
    """The wave, with the level that marks the backward direction all through it: no ramp has it."""
    plain = scanners.wave(device)
    return ScanWaveform(plain.command, plain.markers | LEVEL_BACKWARD, plain.point_rate_hz)


def require_rest(model: NidaqModel, at_s: float, cleared: bool) -> None:
    """AssertionError unless the markers are low and the mirror is at the centre. cleared: all tasks must be gone, too.
    The package forgets a task that it asked to clear, even if no answer came."""
    model.advance(at_s)
    at = np.array([at_s + 1.0])
    levels = [int(model.history.level(line, at)[0]) for line in (BLUE, GREEN, INTENSITY)]
    assert levels == [0, 0, 0], f"closed with marker levels {levels}"
    drive = float(model.history.command(at)[0])
    assert drive == 0, f"closed with the mirror at {drive:g}"
    # The package forgets a task whose creation fails half-way; such a one has nothing yet.
    held = [task.name for task in model.tasks.values() if task.outputs]
    assert not (held and cleared), f"closed with outputs in the tasks {', '.join(held)}"
