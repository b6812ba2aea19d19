"""Which physical effects a simulated scene calls for, as its world says."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Protocol, runtime_checkable

from drivers.clock import VirtualClock
from drivers.errors import DeviceError
from drivers.registry import Surroundings, lookup
from rig.config import RigConfig
from rig.errors import UsageError


@runtime_checkable
class ReportsEffects(Protocol):
    """A world that can say what its effects are worth."""

    def effects_report(self, power_w: float, exposure_s: float, exposures: int) -> Sequence[Mapping[str, Any]]:
        """One mapping per effect, keys as the fields of `Effect`."""
        ...


@dataclass(frozen=True, slots=True)
class Effect:
    """One effect in one scene.

    on, why: whether the scene calls for it, and the reason. share: of all detected photons. divergence: what leaving it
    out changes in the data of one row and column, summed over the exposures. changed_decisions_bound: the share of
    decisions that can change at most (Pinsker's inequality). negligible: at most 1 % can.
    """

    effect: str
    on: bool
    why: str
    share: float
    divergence: float
    changed_decisions_bound: float
    negligible: bool

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)


def scene_effects(config: RigConfig) -> tuple[Effect, ...]:
    """The effects of a config's scene at its scan's power, exposure and exposures. UsageError without a world."""
    if config.world is None:
        raise UsageError(f"{config.name} has no simulated world; name a config that has one, such as 'simulated'")
    try:
        world = lookup("world", config.world.kind).create(config.world, Surroundings(VirtualClock(), None, 0))
    except DeviceError as error:  # a scene that is not there is the config's fault
        raise UsageError(f"world: {error}") from error
    if not isinstance(world, ReportsEffects):
        raise UsageError(f"world {config.world.kind} says nothing of its effects")
    scan = config.scan
    power_w = _power_w(config)
    return tuple(Effect(**line) for line in world.effects_report(power_w, scan.exposure_s, scan.exposures))


def _power_w(config: RigConfig) -> float:
    if config.scan.power is not None:
        return config.scan.power
    # As a scan does: the laser's limit. A simulated one states it in its config.
    limit = getattr(config.laser, "max_power", None)
    if limit is None:
        raise UsageError(f"{config.name} states no laser power; add for example 'power: 20 mW' under scan")
    return float(limit)
