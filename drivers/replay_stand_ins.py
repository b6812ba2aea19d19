"""Stand-ins for the scanner, laser and sync source of a recording: what they did is in the frames already.

They take every verb, within wide limits, and do nothing: nothing moves, nothing shines.
"""

from collections.abc import Sequence
from fractions import Fraction
from typing import ClassVar, Literal

from drivers.interfaces import (
    BeamScanner,
    LaserLimits,
    LaserStatus,
    LineLaser,
    Pulse,
    ScannerLimits,
    ScannerStatus,
    ScanWaveform,
    SyncSource,
    SyncStatus,
)
from drivers.registry import Kind, KindConfig, Surroundings

LIMITS = ScannerLimits(
    command_range=(-1.0, 1.0),
    velocity_per_s=1e9,
    acceleration_per_s2=1e15,
    step=2.0,
    rms_duty=1.0,
    max_points=1 << 31,
    point_rate_hz=(1e-3, 1e9),
)
"""Of a mirror that has followed already."""
LASER_LIMITS = LaserLimits(0.0, 1e3)
RESOLUTION_S = 1e-9
_LARGEST_DIVISOR = 100_000
"""Point clocks are quotients of whole numbers up to some 50 000; a float says which."""


class StandInConfig(KindConfig):
    """Config of a device whose part a recording plays."""

    real_time: ClassVar[bool] = False

    kind: Literal["replay"] = "replay"


class RecordedScanner(BeamScanner):
    """A scanner that has scanned already."""

    _moving = False

    @property
    def limits(self) -> ScannerLimits:
        """Wide ones."""
        return LIMITS

    def _do_status(self) -> ScannerStatus:
        return ScannerStatus(moving=self._moving, fault=None, position=None)

    def _do_point_clock(self, requested_hz: float) -> Fraction:
        return Fraction(requested_hz).limit_denominator(_LARGEST_DIVISOR)

    def _do_load(self, waveform: ScanWaveform, repeats: int, clock_hz: Fraction) -> None:
        pass

    def _do_start(self) -> None:
        self._moving = True

    def _do_stop(self) -> None:
        self._moving = False

    def _do_park(self) -> None:
        pass  # `stop` came first

    def _do_close(self) -> None:
        pass  # no handles


class RecordedLaser(LineLaser):
    """A laser that has shone already."""

    _armed = _emission = False

    @property
    def limits(self) -> LaserLimits:
        """Wide ones."""
        return LASER_LIMITS

    def _do_status(self) -> LaserStatus:
        return LaserStatus(
            emission=self._emission,
            armed=self._armed,
            interlock_closed=True,
            fault=None,
            key_on=None,
            warming_up=False,
            input_mode="recorded",
        )

    def _do_arm(self, power_w: float) -> None:
        self._armed = self._emission = True

    def _do_pause(self) -> None:
        self._emission = False

    def _do_disarm(self) -> None:
        self._armed = self._emission = False

    def _do_close(self) -> None:
        self._armed = self._emission = False


class RecordedSync(SyncSource):
    """A sync source whose program has run already."""

    _running = False

    @property
    def resolution_s(self) -> float:
        """Finer than any device's."""
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


def _scanner(config: StandInConfig, surroundings: Surroundings) -> RecordedScanner:
    return RecordedScanner("recorded scanner")


def _laser(config: StandInConfig, surroundings: Surroundings) -> RecordedLaser:
    return RecordedLaser("recorded laser")


def _sync(config: StandInConfig, surroundings: Surroundings) -> RecordedSync:
    return RecordedSync("recorded sync source")


SCANNER = Kind(config=StandInConfig, create=_scanner)
LASER = Kind(config=StandInConfig, create=_laser)
SYNC = Kind(config=StandInConfig, create=_sync)
