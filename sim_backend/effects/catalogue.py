"""The effects there are, when a scene calls for each, and where its code is; code is loaded only when called for."""

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from sim_backend.optics import Sensor
from sim_backend.scene import SceneFile

Call = tuple[bool, str]


@dataclass(frozen=True, slots=True)
class Entry:
    """One effect: its name, whether the laser causes it, its class as module:name, and the rule that calls for it.

    `called(scene, sensor)` gives yes or no and the reason in words.
    """

    name: str
    from_laser: bool
    code: str
    called: Callable[[SceneFile, Sensor], Call]

    def load(self) -> Callable[..., Any]:
        """The effect's class, imported now."""
        module, _, name = self.code.partition(":")
        loaded: Callable[..., Any] = getattr(import_module(module), name)
        return loaded


def _stripe(scene: SceneFile, sensor: Sensor) -> Call:
    return True, "it is what is measured"


def _fog(scene: SceneFile, sensor: Sensor) -> Call:
    if scene.medium is None:
        return False, "the scene has no medium"
    return True, f"the medium has an extinction of {scene.extinction_per_m:.3g} /m"


def _ambient(scene: SceneFile, sensor: Sensor) -> Call:
    if scene.illuminance_lux == 0:
        return False, "the scene has no ambient light"
    return True, f"the scene has {scene.illuminance_lux:g} lux"


def _airlight(scene: SceneFile, sensor: Sensor) -> Call:
    for called, why in (_fog(scene, sensor), _ambient(scene, sensor)):
        if not called:
            return False, why
    return True, f"{scene.illuminance_lux:g} lux light up the medium"


def _dark_counts(scene: SceneFile, sensor: Sensor) -> Call:
    if sensor.dark_rate == 0:
        return False, "the sensor's dark_rate is 0"
    return True, f"the sensor counts {sensor.dark_rate:g} cps in the dark"


CATALOGUE = (
    Entry("stripe", True, "sim_backend.effects.stripe:Stripe", _stripe),
    Entry("fog", True, "sim_backend.effects.fog:Haze", _fog),
    Entry("ambient", False, "sim_backend.effects.ambient:Ambient", _ambient),
    Entry("airlight", False, "sim_backend.effects.airlight:Airlight", _airlight),
    Entry("dark counts", False, "sim_backend.effects.dark_counts:DarkCounts", _dark_counts),
)
