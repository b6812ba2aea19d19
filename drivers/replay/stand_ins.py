"""Stand-ins for the scanner, laser and sync source of a recorded run, whose frames already show what these did.

They accept every call within wide limits, but move nothing and emit no light. Only their states follow the calls: the
scanner counts as moving for as long as its waveform would take.
"""

from collections.abc import Sequence
from fractions import Fraction
from typing import ClassVar, Literal

from drivers.clock import Clock, now_s
from drivers.interfaces import BeamScanner, Pulse, ScannerLimits, ScannerStatus, ScanWaveform, SyncSource, SyncStatus
from drivers.lasers.serial_laser import PlainLaser
from drivers.registry import Kind, KindConfig

LIMITS = ScannerLimits(
    command_range=(-1.0, 1.0),
    velocity_per_s=1e9,
    acceleration_per_s2=1e15,
    step=2.0,
    rms_duty=1.0,
    max_points=1 << 24,
    point_rate_hz=(1e-3, 1e9),
)
"""Limits that every recorded waveform keeps. They need not be strict: a real mirror has followed it already."""
MAX_POWER_W = 1e3
RESOLUTION_S = 1e-9


class StandInConfig(KindConfig):
    """Config of a device that a recording replaces."""

    real_time: ClassVar[bool] = False

    kind: Literal["replay"] = "replay"


class RecordedScanner(BeamScanner):
    """A scanner that moves nothing, but takes as long as the real scan."""

    def __init__(self, clock: Clock) -> None:
        super().__init__("recorded scanner")
        self._clock = clock
        self._takes_s = 0.0
        self._ends_s = 0.0

    @property
    def limits(self) -> ScannerLimits:
        """Limits wider than those of any real scanner."""
        return LIMITS

    def _do_status(self) -> ScannerStatus:
        return ScannerStatus(moving=now_s(self._clock) < self._ends_s, fault=None, position=None)

    def _do_point_clock(self, requested_hz: float) -> Fraction:
        simplest = (Fraction(requested_hz).limit_denominator(10**digits) for digits in range(20))
        return next(rate for rate in simplest if float(rate) == requested_hz)  # the rate that any board's divider made

    def _do_load(self, waveform: ScanWaveform, repeats: int, clock_hz: Fraction) -> None:
        self._takes_s = float(repeats * len(waveform.command) / clock_hz)

    def _do_start(self) -> None:
        self._ends_s = now_s(self._clock) + self._takes_s

    def _do_stop(self) -> None:
        self._ends_s = 0.0

    def _do_park(self) -> None:
        pass  # `stop` came first

    def _do_close(self) -> None:
        pass  # no handles


class RecordedSync(SyncSource):
    """A sync source that plays nothing. From `run` to `abort` it says that it waits for the scan marker."""

    _running = False

    @property
    def resolution_s(self) -> float:
        """A resolution finer than any device's."""
        return RESOLUTION_S

    def _do_program(self, pulses: Sequence[Pulse], repeats: int) -> None:
        pass

    def _do_run(self) -> None:
        self._running = True

    def _do_gate_low(self) -> None:
        pass  # it is low, always

    def _do_abort(self) -> None:
        self._running = False

    def _do_status(self) -> SyncStatus:
        return SyncStatus("waiting" if self._running else "stopped", 0)

    def _do_close(self) -> None:
        pass  # no handles


SCANNER = Kind(config=StandInConfig, create=lambda _, surroundings: RecordedScanner(surroundings.clock))
LASER = Kind(config=StandInConfig, create=lambda _, surroundings: PlainLaser("recorded laser", MAX_POWER_W))
SYNC = Kind(config=StandInConfig, create=lambda _, surroundings: RecordedSync("recorded sync source"))
