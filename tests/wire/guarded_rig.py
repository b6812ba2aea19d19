"""A laser and a gate on emulated wires in this process, and what counts: when there was light (emission AND gate)."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from sim_backend.wire.firmware.obis import ObisModel
from sim_backend.wire.firmware.prawndo import PrawnDoModel
from sim_backend.wire.serve.serial import SerialServer

USB_BAUD = 8_000_000
"""A virtual COM port over USB full speed carries about 0.8 MB/s."""
SWEEP_S = 0.012
MARKER_S = 20e-6
POWER_W = 0.02


def sweeping(from_s: float, until_s: float) -> float | None:
    """The scan marker of a mirror that sweeps for ever, as the trigger of a PrawnDO."""
    into_s = from_s % SWEEP_S
    first = from_s if into_s < MARKER_S else from_s - into_s + SWEEP_S
    return first if first < until_s else None


@dataclass
class Line:
    """A level over time, from the callbacks of a model."""

    times: list[float] = field(default_factory=lambda: [float("-inf")])
    levels: list[bool] = field(default_factory=lambda: [False])

    def __call__(self, level: bool, at_s: float) -> None:
        self.times.append(at_s)
        self.levels.append(level)

    def dark_for(self, seconds: float) -> bool:
        """Whether it has been low for so long."""
        return not self.levels[-1] and time.monotonic() - self.times[-1] >= seconds


@dataclass
class GuardedRig:
    laser: SerialServer
    sync: SerialServer
    emission: Line


@contextmanager
def guarded_rig() -> Iterator[GuardedRig]:
    emission = Line()
    laser = ObisModel(cdrh_delay_s=0.0, on_emission=emission)  # a Cobolt takes 4 s to be asked about and armed
    sync = PrawnDoModel(sweeping, board=2)
    with SerialServer(laser) as laser_server, SerialServer(sync, baud=USB_BAUD) as sync_server:
        yield GuardedRig(laser_server, sync_server, emission)
