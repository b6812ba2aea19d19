"""The real PrawnDO driver on an emulated wire."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from drivers.clock import NS_PER_S, VirtualClock
from drivers.interfaces import OUT_GATE, Pulse
from drivers.registry import Surroundings
from drivers.sync.prawndo import PrawnDo, PrawnDoConfig
from drivers.sync.prawndo_line import USUAL_TIMING, PrawnDoTiming
from sim_backend.wire.firmware.prawndo import PrawnDoModel, TriggerLine
from sim_backend.wire.serve.serial import SerialServer, SerialWire
from sim_backend.wire.serve.wire_server import FaultSchedule

USB_BAUD = 8_000_000
"""A virtual COM port over USB full speed carries about 0.8 MB/s."""
SWEEP = (Pulse(0, None), Pulse(0, 1e-3), Pulse(OUT_GATE, 5e-3), Pulse(0, 1e-5))


class Board:
    """A PrawnDO with a trigger input, in virtual time. terminal: on a pseudo terminal, for a guard's process."""

    def __init__(self, faults: FaultSchedule | None = None, *, terminal: bool = False, **settings: Any) -> None:
        self.clock = VirtualClock()
        self.trigger = TriggerLine()
        self.model = PrawnDoModel(self.trigger, **settings)
        served = SerialServer if terminal else SerialWire
        self.server: SerialServer | SerialWire = served(self.model, clock=self.clock, baud=USB_BAUD, faults=faults)

    @property
    def now_s(self) -> float:
        return self.clock.now_ns() / NS_PER_S

    @property
    def pins(self) -> int:
        with self.server.lock:
            self.model.advance(self.now_s)
            return self.model.outputs_at(self.now_s)

    def open(self, timing: PrawnDoTiming = USUAL_TIMING, **config: Any) -> PrawnDo:
        made = PrawnDoConfig.model_validate({"port": "emulated:sync", **config})
        return PrawnDo(made, Surroundings(self.clock, None, 0, {"sync": self.server.endpoint}), timing)


@contextmanager
def board(faults: FaultSchedule | None = None, **settings: Any) -> Iterator[Board]:
    made = Board(faults, **settings)
    with made.server:
        yield made
