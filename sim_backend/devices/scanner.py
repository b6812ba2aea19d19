"""The simulated galvanometer. Its clock is slightly wrong, and its mirror lags behind the command."""

import math
from fractions import Fraction
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from drivers.interfaces import BeamScanner, ScannerLimits, ScannerStatus, ScanWaveform
from drivers.registry import Kind, KindConfig, Surroundings
from drivers.units import Ppm, Seconds
from sim_backend.bench import Bench
from sim_backend.mirror_motion import Jitter
from sim_backend.world import bench_of, note_effect

MASTER_HZ = 48_000_000
"""Master clock: the point clock is this divided by a whole number, as in a timer of a microcontroller."""

LIMITS = ScannerLimits(
    command_range=(-1.0, 1.0),
    velocity_per_s=4000.0,
    acceleration_per_s2=4e6,
    step=0.25,
    rms_duty=1.0,
    max_points=1_000_000,
    point_rate_hz=(1e3, 200e3),
)
"""Limits of a small, fast galvo. At its largest velocity it crosses its range in half a millisecond."""


class SimulatedScannerConfig(KindConfig):
    """Config of the simulated scanner."""

    real_time: ClassVar[bool] = False

    kind: Literal["simulated"] = "simulated"
    clock_error: Annotated[Ppm, Field(ge=-1e-3, le=1e-3)] = 20e-6
    """Relative error of the scanner's crystal, positive if it runs fast."""
    start_latency: Annotated[Seconds, Field(ge=0)] = 1.3373e-3
    """Time from `start` to the first point. The default is not a whole number of frame periods."""
    jitter: float = Field(default=0.0, ge=0, le=0.1)
    """Standard deviation of the mirror's random error, in units of the mirror command, whose range is -1 to 1. Columns
    of the bundled rig are 3.5e-3 apart."""
    serial: str = Field(default="SIM-MIRROR-0001", min_length=1)
    """Serial number. A scanner with another one needs a calibration of its own."""


class SimulatedScanner(BeamScanner):
    """The simulated galvo scanner. It tells the bench, the state that all simulated devices share, where the mirror
    goes."""

    def __init__(self, config: SimulatedScannerConfig, bench: Bench) -> None:
        super().__init__("simulated scanner")
        self._config = config
        self._bench = bench
        self._loaded: tuple[ScanWaveform, int, Fraction] | None = None

    @property
    def limits(self) -> ScannerLimits:
        """Limits of the simulated galvo."""
        return LIMITS

    @property
    def serial(self) -> str:
        """The serial number in the config."""
        return self._config.serial

    def _do_status(self) -> ScannerStatus:
        return ScannerStatus(moving=self._bench.moving(), fault=None, position=self._bench.mirror())

    def _do_point_clock(self, requested_hz: float) -> Fraction:
        low, high = LIMITS.point_rate_hz
        divider = min(max(round(MASTER_HZ / requested_hz), math.ceil(MASTER_HZ / high)), math.floor(MASTER_HZ / low))
        return Fraction(MASTER_HZ, divider)

    def _do_load(self, waveform: ScanWaveform, repeats: int, clock_hz: Fraction) -> None:
        frozen = ScanWaveform(waveform.command.copy(), waveform.markers.copy(), waveform.point_rate_hz)
        self._loaded = (frozen, repeats, clock_hz)

    def _do_start(self) -> None:
        assert self._loaded is not None, "the interface starts loaded scanners only"
        waveform, repeats, clock_hz = self._loaded
        true_hz = float(clock_hz) * (1 + self._config.clock_error)
        self._bench.play(waveform, repeats, latency_s=self._config.start_latency, rate_hz=true_hz)

    def _do_stop(self) -> None:
        self._bench.rest(self._bench.mirror())

    def _do_park(self) -> None:
        self._bench.rest(LIMITS.command_range[0])

    def _do_close(self) -> None:
        self._loaded = None


def create(config: SimulatedScannerConfig, surroundings: Surroundings) -> SimulatedScanner:
    """The scanner. It acts on the simulated world's bench, or on a new bench if the rig has no simulated world. The
    bench gets the jitter of the config, and the world is told of lag and jitter."""
    bench = bench_of(surroundings)
    bench.jitter = Jitter(config.jitter, surroundings.seed)
    forward_us, backward_us = 1e6 * bench.lag.forward, 1e6 * bench.lag.backward
    if forward_us or backward_us:
        note_effect(surroundings, "galvo lag", f"the mirror lags {forward_us:g} us, on the way back {backward_us:g} us")
    if config.jitter:
        note_effect(surroundings, "galvo jitter", f"the mirror is off by {config.jitter:g} of its drive (rms)")
    return SimulatedScanner(config, bench)


KIND = Kind(config=SimulatedScannerConfig, create=create)
