"""The simulated line laser: tells the bench, the state that simulated devices share, how much it emits."""

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from drivers.lasers.serial_laser import PlainLaser
from drivers.registry import Kind, KindConfig, Surroundings
from drivers.units import Watts
from sim_backend.world import bench_of


class SimulatedLaserConfig(KindConfig):
    """Config of the simulated laser."""

    real_time: ClassVar[bool] = False

    kind: Literal["simulated"] = "simulated"
    max_power: Annotated[Watts, Field(gt=0)] = 0.1
    """Largest power."""


def create(config: SimulatedLaserConfig, surroundings: Surroundings) -> PlainLaser:
    """The laser. It acts on the simulated world's bench, or on a new bench if the rig has no simulated world."""
    return PlainLaser("simulated laser", config.max_power, bench_of(surroundings).emit)


KIND = Kind(config=SimulatedLaserConfig, create=create)
