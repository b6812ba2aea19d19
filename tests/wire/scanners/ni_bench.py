"""An emulated NI card behind a gRPC server for tests, in virtual time, and the driver at it."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from drivers.clock import Clock, VirtualClock, now_s
from drivers.interfaces import MARKER_SCAN, BeamScanner, ScanWaveform
from drivers.registry import Surroundings
from drivers.scanners import nidaq, nidaq_card
from drivers.scanners.nidaq import Nidaq, NidaqConfig, create
from drivers.transports.endpoints import Endpoint
from sim_backend.wire.firmware.helios import BLUE, GREEN, INTENSITY
from sim_backend.wire.firmware.nidaq import NidaqModel
from sim_backend.wire.serve.grpc import GrpcServer
from tests.wire.emulated_lasers import PATIENCE_S
from tests.wire.emulated_scanners import GALVO, cosine


@dataclass(frozen=True)
class NiBench:
    """A card, its server and their clock."""

    model: NidaqModel
    server: GrpcServer
    clock: Clock

    def now_s(self) -> float:
        return now_s(self.clock)

    def open(self, **config: Any) -> Nidaq:
        settings = NidaqConfig.model_validate({"port": "emulated:card", **GALVO, **config})
        return create(settings, Surroundings(self.clock, None, 1, {"card": Endpoint(f"{self.server.address}/Dev1")}))

    def levels(self, *, after_s: float = 0.0) -> list[int]:
        """Line marker, scan marker, backward."""
        self.model.advance(self.now_s())
        at = np.array([self.now_s() + after_s])
        return [int(self.model.history.level(line, at)[0]) for line in (GREEN, BLUE, INTENSITY)]

    def drive(self, *times_s: float) -> NDArray[np.float64]:
        """Drive at times; without any, now."""
        self.model.advance(self.now_s())
        return self.model.history.command(np.array(times_s or [self.now_s()]))

    def jump(self, since_s: float, period_s: float) -> float:
        """Largest change of the drive within one point, from then to a little after now."""
        at = np.arange(since_s - 1e-3, self.now_s() + 1e-3, period_s)
        return float(np.abs(np.diff(self.drive(*at))).max(initial=0))


@contextmanager
def ni_bench(clock: Clock | None = None, **options: Any) -> Iterator[NiBench]:
    """options: those of the model. Calls take the host's time, so they get long deadlines: it may be busy."""
    clock = clock or VirtualClock(1_000_000_000)
    model = NidaqModel(**options)
    patient = patch.multiple(nidaq_card, CALL_S=PATIENCE_S, _LATE_S=PATIENCE_S, _CLOSE_S=PATIENCE_S)
    with patient, patch.object(nidaq, "_PATIENT", PATIENCE_S), GrpcServer(model, clock=clock) as server:
        yield NiBench(model, server, clock)


def marked(device: BeamScanner, points: int = 2500) -> ScanWaveform:
    """The cosine with a scan marker that is high nearly all the time, as in a scan."""
    wave = cosine(device, points)
    wave.markers[: points // 3] |= MARKER_SCAN
    wave.markers[points // 3 + 50 :] |= MARKER_SCAN
    return wave
