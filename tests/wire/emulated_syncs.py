"""The real drivers of a PrawnDO, a Teensy and a Pulse Streamer on emulated wires."""

from bisect import bisect_right
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from drivers.clock import Clock, VirtualClock, now_s
from drivers.interfaces import OUT_GATE, Pulse
from drivers.registry import Surroundings
from drivers.sync.prawndo import PrawnDo, PrawnDoConfig
from drivers.sync.prawndo_line import USUAL_TIMING, PrawnDoTiming
from drivers.sync.pulsestreamer import PulseStreamer, PulseStreamerConfig
from drivers.sync.pulsestreamer_rpc import CALL_S
from drivers.sync.teensy import Teensy, TeensyConfig
from drivers.sync.teensy_line import REPLY_S
from sim_backend.wire.firmware.prawndo import PrawnDoModel
from sim_backend.wire.firmware.pulsestreamer import PulseStreamerModel
from sim_backend.wire.firmware.teensy import TeensyModel
from sim_backend.wire.serve.serial import SerialServer
from tests.wire.faults import FaultSchedule, FaultyHttpServer
from tests.wire.serial_wire import SerialWire

USB_BAUD = 8_000_000
"""A virtual COM port over USB full speed carries about 0.8 MB/s."""
SWEEP = (Pulse(0, None), Pulse(0, 1e-3), Pulse(OUT_GATE, 5e-3), Pulse(0, 1e-5))


class TriggerLine:
    """A trigger input that is switched by hand. Calls must be in order of time."""

    def __init__(self) -> None:
        self._edges: list[tuple[float, bool]] = []

    def pulse(self, at_s: float, width_s: float) -> None:
        """Hold the line high for `width_s` from `at_s` on, which must not be before the last pulse."""
        self._edges += [(at_s, True), (at_s + width_s, False)]

    def __call__(self, from_s: float, until_s: float) -> float | None:
        """First time in [from_s, until_s) at which the line is high; None: it is low until then."""
        index = bisect_right(self._edges, from_s, key=lambda edge: edge[0]) - 1
        if index >= 0 and self._edges[index][1]:
            return from_s
        return next((at for at, high in self._edges[index + 1 :] if high and at < until_s), None)

    def low(self, from_s: float, until_s: float) -> float | None:
        """The same for low."""
        index = bisect_right(self._edges, from_s, key=lambda edge: edge[0]) - 1
        if index < 0 or not self._edges[index][1]:
            return from_s
        return next((at for at, high in self._edges[index + 1 :] if not high and at < until_s), None)


class Board:
    """A PrawnDO with a trigger input, in virtual time. terminal: on a pseudo terminal, for a guard's process. usb_ids:
    those that its port shows."""

    def __init__(
        self,
        faults: FaultSchedule | None = None,
        *,
        terminal: bool = False,
        usb_ids: tuple[int, int] | None = None,
        **settings: Any,
    ) -> None:
        self.usb_ids = usb_ids
        self.clock = VirtualClock()
        self.trigger = TriggerLine()
        self.model: Any = self.make(**settings)
        settings = {"clock": self.clock, "baud": USB_BAUD}
        self.server: SerialServer = (
            SerialServer(self.model, **settings) if terminal else SerialWire(self.model, faults=faults, **settings)
        )

    def make(self, **settings: Any) -> Any:
        return PrawnDoModel(self.trigger, **settings)

    @property
    def now_s(self) -> float:
        return now_s(self.clock)

    @property
    def pins(self) -> int:
        with self.server.lock:
            self.model.advance(self.now_s)
            return int(self.model.outputs_at(self.now_s))

    @property
    def plays(self) -> bool:
        return self.model.status in (1, 2)

    @property
    def held(self) -> list[tuple[int, int]] | None:
        """The program in the memory without its end: outputs and ns."""
        return [(outputs, 10 * cycles) for outputs, cycles in self.model.words[:-2]]

    def changes(self, from_s: float) -> list[tuple[float, int]]:
        with self.server.lock:
            return list(self.model.changes(from_s, self.now_s))

    def pass_time(self, seconds: float) -> None:
        with self.server.lock:
            self.clock.sleep(seconds)
            self.model.tick(self.now_s)

    @property
    def surroundings(self) -> Surroundings:
        return Surroundings(self.clock, None, 0, {"sync": replace(self.server.endpoint, usb_ids=self.usb_ids)})

    def open(self, timing: PrawnDoTiming = USUAL_TIMING, **config: Any) -> PrawnDo:
        made = PrawnDoConfig.model_validate({"port": "emulated:sync", **config})
        return PrawnDo(made, self.surroundings, timing)


@contextmanager
def board(faults: FaultSchedule | None = None, **settings: Any) -> Iterator[Board]:
    made = Board(faults, **settings)
    with made.server:
        yield made


class TeensyBoard(Board):
    """A Teensy in place of the PrawnDO."""

    def make(self, **settings: Any) -> TeensyModel:
        return TeensyModel(self.trigger, self.trigger.low, **settings)

    @property
    def plays(self) -> bool:
        return bool(self.model.state == "playing")

    @property
    def held(self) -> None:
        """Not looked at: what plays is."""

    def open(self, timing: float = REPLY_S, **config: Any) -> Teensy:  # type: ignore[override]
        made = TeensyConfig.model_validate({"port": "emulated:sync", **config})
        return Teensy(made, self.surroundings, timing)


@contextmanager
def teensy(faults: FaultSchedule | None = None, **settings: Any) -> Iterator[TeensyBoard]:
    made = TeensyBoard(faults, **settings)
    with made.server:
        yield made


class PulseBox:
    """A Pulse Streamer with a trigger input. clock: of the box and of the driver's count of sweeps; calls travel in the
    host's time."""

    def __init__(self, faults: FaultSchedule | None = None, *, clock: Clock | None = None, **settings: Any) -> None:
        self.clock = clock or VirtualClock()
        self.trigger = TriggerLine()
        self.model = PulseStreamerModel(self.trigger, low=self.trigger.low, **settings)
        self.server = FaultyHttpServer(self.model, faults=faults, clock=self.clock)

    @property
    def now_s(self) -> float:
        return now_s(self.clock)

    @property
    def pins(self) -> int:
        with self.server.lock:
            self.model.advance(self.now_s)
            return self.model.outputs_at(self.now_s)

    @property
    def plays(self) -> bool:
        with self.server.lock:
            return bool(self.model.call("isStreaming", [], self.now_s))

    @property
    def held(self) -> None:
        """Not looked at: what plays is."""

    def changes(self, from_s: float) -> list[tuple[float, int]]:
        with self.server.lock:
            self.model.advance(self.now_s)
            return self.model.changes(from_s, self.now_s)

    def pass_time(self, seconds: float) -> None:
        self.clock.sleep(seconds)

    def open(self, call_s: float = CALL_S, **config: Any) -> PulseStreamer:
        silence = {"silence": f"{2 * call_s} s"}  # each of its two questions gets as long as any other call
        made = PulseStreamerConfig.model_validate({"port": "emulated:sync", **silence, **config})
        return PulseStreamer(made, Surroundings(self.clock, None, 0, {"sync": self.server.endpoint}), call_s)


@contextmanager
def pulse_box(faults: FaultSchedule | None = None, **settings: Any) -> Iterator[PulseBox]:
    made = PulseBox(faults, **settings)
    with made.server:
        yield made
