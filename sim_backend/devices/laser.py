"""The simulated line laser: no key, no warm-up, emission follows arm and pause at once."""

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from drivers.interfaces import LaserLimits, LaserStatus, LineLaser
from drivers.registry import Kind, KindConfig, Surroundings
from drivers.units import Watts
from sim_backend.bench import Bench
from sim_backend.devices.place import bench_of


class SimulatedLaserConfig(KindConfig):
    """Config of the simulated laser."""

    real_time: ClassVar[bool] = False

    kind: Literal["simulated"] = "simulated"
    max_power: Annotated[Watts, Field(gt=0)] = 0.1


class SimulatedLaser(LineLaser):
    """Tells the bench how much it emits."""

    def __init__(self, config: SimulatedLaserConfig, bench: Bench) -> None:
        super().__init__("simulated laser")
        self._limits = LaserLimits(0.0, config.max_power)
        self._bench = bench
        self._armed = False
        self._emission = False

    @property
    def limits(self) -> LaserLimits:
        """0 W to the config's max_power."""
        return self._limits

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
        self._bench.emit(power_w)

    def _do_pause(self) -> None:
        self._emission = False
        self._bench.emit(0.0)

    def _do_disarm(self) -> None:
        self._do_pause()
        self._armed = False

    def _do_close(self) -> None:
        self._do_disarm()


def create(config: SimulatedLaserConfig, surroundings: Surroundings) -> SimulatedLaser:
    """The laser on the world's bench."""
    return SimulatedLaser(config, bench_of(surroundings))


KIND = Kind(config=SimulatedLaserConfig, create=create)
