"""The place of a simulated device: the bench of the world it was created in, or one of its own."""

from calibration.model.rig_model import Lag
from drivers.errors import DeviceError
from drivers.registry import Surroundings
from sim_backend.bench import Bench
from sim_backend.world import SimulatedWorld


def bench_of(surroundings: Surroundings) -> Bench:
    """The shared bench; without a simulated world a bench nobody else sees, for a single device among real ones."""
    world = surroundings.world
    if isinstance(world, SimulatedWorld):
        return world.bench
    return Bench(surroundings.clock, Lag())


def world_of(surroundings: Surroundings, device: str) -> SimulatedWorld:
    """The simulated world. DeviceError where the rig has none."""
    world = surroundings.world
    if not isinstance(world, SimulatedWorld):
        raise DeviceError(
            f"{device} has nothing to look at: the rig has no simulated world; add world: {{kind: simulated}}"
        )
    return world


def note_effect(surroundings: Surroundings, effect: str, why: str) -> None:
    """Tell the world that a device has an effect of its own, one of the catalogue's of kind `device`, and which."""
    if isinstance(surroundings.world, SimulatedWorld):
        surroundings.world.setting.devices[effect] = why
