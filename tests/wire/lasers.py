"""Real laser drivers on emulated wires, for conformance and wire tests."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from drivers.clock import Clock, VirtualClock
from drivers.cobolt import CoboltConfig
from drivers.cobolt import create as create_cobolt
from drivers.cobolt_line import LineTiming as CoboltTiming
from drivers.interfaces import LineLaser
from drivers.obis import ObisConfig
from drivers.obis import create as create_obis
from drivers.obis_line import LineTiming as ObisTiming
from drivers.registry import Surroundings
from sim_backend.wire.faults import FaultSchedule
from sim_backend.wire.serial_server import SerialModel, SerialServer

QUICK_COBOLT = CoboltTiming(gap_s=0.1, reply_s=0.15, quiet_s=0.02, drain_s=0.1)
"""For virtual time, in which the gap costs nothing: replies come within milliseconds."""
QUICK_OBIS = ObisTiming(reply_s=0.15, quiet_s=0.02, drain_s=0.1)


def around(clock: Clock, server: SerialServer) -> Surroundings:
    return Surroundings(clock, None, 0, {"laser": server.endpoint})


@contextmanager
def wire(
    model: SerialModel, *, clock: Clock | None = None, baud: int = 1_000_000, faults: FaultSchedule | None = None
) -> Iterator[tuple[SerialServer, Surroundings]]:
    clock = clock or VirtualClock()
    with SerialServer(model, clock=clock, baud=baud, faults=faults) as server:
        yield server, around(clock, server)


def open_cobolt(surroundings: Surroundings, **config: Any) -> LineLaser:
    made = CoboltConfig.model_validate({"port": "emulated:laser", "max_power": "80 mW", **config})
    return create_cobolt(made, surroundings, QUICK_COBOLT)


def open_obis(surroundings: Surroundings, **config: Any) -> LineLaser:
    made = ObisConfig.model_validate({"port": "emulated:laser", "max_power": "80 mW", **config})
    return create_obis(made, surroundings, QUICK_OBIS)
