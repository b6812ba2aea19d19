"""A simulated laser behind a fixed attenuator, so that small powers are set precisely.

All powers are those behind the filter. A driver of a real laser would send them to its port, where this one tells the
bench of the simulated rig; it would also leave `real_time` at True, and its config would have a `port`.
"""

from collections.abc import Callable
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from drivers.interfaces import LaserLimits, LaserStatus, LineLaser
from drivers.registry import Kind, KindConfig, Surroundings
from drivers.units import Watts
from sim_backend.world import bench_of


class FilteredLaserConfig(KindConfig):
    """Config of the laser. max_power: of the laser itself. transmission: of the filter."""

    real_time: ClassVar[bool] = False

    kind: Literal["foglab-filtered"] = "foglab-filtered"
    max_power: Annotated[Watts, Field(gt=0)] = 0.5
    transmission: Annotated[float, Field(gt=0, le=1)] = 0.1


class FilteredLaser(LineLaser):
    """The laser. emit: called with the power in W that leaves the filter while the gate is high."""

    def __init__(self, max_power_w: float, transmission: float, emit: Callable[[float], object]) -> None:
        super().__init__("filtered laser")
        self._most_w = max_power_w * transmission
        self._emit = emit
        self._armed = self._emission = False

    @property
    def limits(self) -> LaserLimits:
        """Powers behind the filter."""
        return LaserLimits(0.0, self._most_w)

    def _do_status(self) -> LaserStatus:
        return LaserStatus(
            emission=self._emission,
            armed=self._armed,
            interlock_closed=True,
            fault=None,
            key_on=None,
            warming_up=False,
            input_mode="digital",
        )

    def _do_arm(self, power_w: float) -> None:
        self._armed = self._emission = True
        self._emit(power_w)

    def _do_pause(self) -> None:
        self._emission = False
        self._emit(0.0)

    def _do_disarm(self) -> None:
        self._do_pause()
        self._armed = False

    def _do_close(self) -> None:
        self._do_disarm()


def create(config: FilteredLaserConfig, surroundings: Surroundings) -> FilteredLaser:
    """Open the laser on the bench of the simulated rig."""
    return FilteredLaser(config.max_power, config.transmission, bench_of(surroundings).emit)


KIND = Kind(config=FilteredLaserConfig, create=create)
