"""The effects there are, when a scene calls for each, and where its code is; code is loaded only when called for."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Literal

from sim_backend.effects.setting import PlannedFor, Setting
from sim_backend.light.optics import ambient_irradiance

Call = tuple[bool, str]
EffectKind = Literal["laser", "steady", "bits", "within"]
"""The target of an effect: the sheet's light (`LaserEffect`), light or counts that are there without it
(`SteadyEffect`), the sensor's bits (`BitEffect`); `within`: it is worked into a simulated device, another effect or the
gain, which hold its code."""


@dataclass(frozen=True, slots=True)
class Entry:
    """One effect: its name, what it acts on, what makes it as module:name ("" where it is worked in elsewhere), and the
    rule that calls for it.

    `called(setting)` gives yes or no and the reason in words. `changes(setting, planned_for)`, in closed form: the
    largest share of decisions on a row and column that can differ without the effect (may exceed 1). None: there is no
    such form; the planner then evaluates light and dark counts, and never leaves out others, nor light that moves.
    """

    name: str
    kind: EffectKind
    code: str
    called: Callable[[Setting], Call]
    changes: Callable[[Setting, PlannedFor], float] | None = None

    def load(self) -> Callable[..., Any]:
        """The factory of a `Setting`'s effect, imported now."""
        module, _, name = self.code.partition(":")
        loaded: Callable[..., Any] = getattr(import_module(module), name)
        return loaded


def _stripe(setting: Setting) -> Call:
    return True, "it is what is measured"


def _fog(setting: Setting) -> Call:
    if setting.scene.medium is None:
        return False, "the scene has no medium"
    return True, f"the medium has an extinction of {setting.scene.medium.extinction_per_m:.3g} /m"


def _halo(setting: Setting) -> Call:
    medium = setting.scene.medium
    if medium is None:
        return False, "the scene has no medium"
    if not medium.multiple_scattering or medium.scattering_per_m == 0:
        return False, "the medium's multiple_scattering is off, or it only absorbs"
    depth = (medium.scattering_per_m - medium.forward_per_m) * setting.view.median_depth_m
    return True, f"the optical depth of the medium in front of the scene is {depth:.2g}"


def _forward_blur(setting: Setting) -> Call:
    medium = setting.scene.medium
    if medium is None or medium.forward_per_m == 0:
        return False, "the scene has no medium with a forward_share"
    depth = medium.forward_per_m * setting.view.median_depth_m
    return True, f"the optical depth of what is scattered forward is {depth:.2g}"


def _rain(setting: Setting) -> Call:
    rain = setting.scene.rain
    if rain is None:
        return False, "it does not rain in the scene"
    return True, f"it rains {1e3 * rain.rate:g} mm/h: {rain.sizes.density_per_m3():.0f} drops per m^3"


def _snow(setting: Setting) -> Call:
    snow = setting.scene.snow
    if snow is None:
        return False, "it does not snow in the scene"
    return True, f"it snows {1e3 * snow.rate:g} mm/h: {snow.sizes.density_per_m3():.0f} flakes per m^3"


def _speckle(setting: Setting) -> Call:
    if not setting.line.speckle:
        return False, "the line's speckle is off"
    return True, "the laser is coherent"


def _defocus(setting: Setting) -> Call:
    optics, line = setting.optics, setting.line
    if optics.focus is None and line.spread == 0:
        return False, "the optics name no focus and the line's spread is 0: it is equally wide at all depths"
    focus = "everywhere sharp" if optics.focus is None else f"focused at {optics.focus:g} m"
    return True, f"the picture is {focus}, the sheet spreads by {line.spread:g} rad; part of the stripe"


def _surface(setting: Setting) -> Call:
    return True, "each pixel has its albedo and its facet's tilt; part of the stripe and of ambient light"


def _motion(setting: Setting) -> Call:
    motion = setting.scene.motion
    if motion is None:
        return False, "nothing moves in the scene"
    return True, f"the surfaces move by {', '.join(f'{speed:g}' for speed in motion.velocity)} m/s"


def _between_surfaces(setting: Setting) -> Call:
    return False, "a world is one depth per pixel: it lacks the sides nobody sees, from which light would come"


def _ambient(setting: Setting) -> Call:
    if setting.scene.illuminance_lux == 0:
        return False, "the scene has no ambient light"
    return True, f"the scene has {setting.scene.illuminance_lux:g} lux"


def _ambient_changes(setting: Setting, planned_for: PlannedFor) -> float:
    white = setting.gain * ambient_irradiance(setting.scene.illuminance_lux, setting.optics) / math.pi
    return white * planned_for.exposure_s * setting.view.width


def _airlight(setting: Setting) -> Call:
    for called, why in (_fog(setting), _ambient(setting)):
        if not called:
            return False, why
    return True, f"{setting.scene.illuminance_lux:g} lux light up the medium"


def _dark_counts(setting: Setting) -> Call:
    if setting.sensor.dark_rate == 0:
        return False, "the sensor's dark_rate is 0"
    return True, f"the sensor counts {setting.sensor.dark_rate:g} cps in the dark"


def _efficiency(setting: Setting) -> Call:
    sensor, optics = setting.sensor, setting.optics
    return True, (
        f"the lens passes {optics.transmission:.3g} of the light, {sensor.fill_factor:.3g} of that meets a diode, "
        f"which detects {sensor.detection_probability:.3g}; part of the gain of all light"
    )


def _afterpulsing(setting: Setting) -> Call:
    sensor = setting.sensor
    if sensor.afterpulsing == 0 and sensor.dead_time == 0:
        return False, "the sensor's afterpulsing and dead_time are 0"
    what = f"{sensor.afterpulsing:.3g} afterpulses a detection, dead time {1e9 * sensor.dead_time:.3g} ns"
    return True, f"the sensor has {what}"


def _crosstalk(setting: Setting) -> Call:
    if setting.sensor.crosstalk == 0:
        return False, "the sensor's crosstalk is 0"
    return True, f"a detection sets off {setting.sensor.crosstalk:.3g} neighbours"


def _defects(setting: Setting) -> Call:
    sensor = setting.sensor
    if sensor.dead_share == 0 and sensor.hot_share == 0:
        return False, "the sensor's dead_share and hot_share are 0"
    return True, f"{sensor.dead_share:.3g} of the pixels always read 0, {sensor.hot_share:.3g} always 1"


def _bit_errors(setting: Setting) -> Call:
    if setting.sensor.bit_error_rate == 0:
        return False, "the sensor's bit_error_rate is 0"
    return True, f"{setting.sensor.bit_error_rate:.3g} of the bits are read wrongly"


def _of_device(effect: str) -> Callable[[Setting], Call]:
    def called(setting: Setting) -> Call:
        why = setting.devices.get(effect)
        return why is not None, why or "no simulated device has it"

    return called


# No decision on a row changes where none of its bits does.
def _crosstalk_changes(setting: Setting, planned_for: PlannedFor) -> float:
    return setting.sensor.crosstalk * setting.view.width * planned_for.exposures


def _defects_change(setting: Setting, planned_for: PlannedFor) -> float:
    return (setting.sensor.dead_share + setting.sensor.hot_share) * setting.view.width


def _bit_errors_change(setting: Setting, planned_for: PlannedFor) -> float:
    return setting.sensor.bit_error_rate * setting.view.width * planned_for.exposures


DEVICES_OWN = ("galvo lag", "galvo jitter", "sheet bow", "row delay", "lost frames", "duplicated frames", "clock drift")
MEASURED = "stripe"
"""The effect without which there is nothing to decide."""

CATALOGUE = (
    Entry("stripe", "laser", "sim_backend.effects.stripe:Stripe", _stripe),
    Entry("texture and cosine", "within", "", _surface),
    Entry("line width and defocus", "within", "", _defocus),
    # Acts on what the effects before it brought, and that is the stripe.
    Entry("speckle", "laser", "sim_backend.effects.speckle:Speckle", _speckle),
    Entry("fog", "laser", "sim_backend.effects.fog:Haze", _fog),
    Entry("forward blur", "laser", "sim_backend.effects.forward_blur:ForwardBlur", _forward_blur),
    Entry("halo", "laser", "sim_backend.effects.halo:Halo", _halo),
    Entry("rain", "laser", "sim_backend.effects.particles:rain_drops", _rain),
    Entry("snow", "laser", "sim_backend.effects.particles:snow_flakes", _snow),
    Entry("motion", "laser", "sim_backend.effects.motion:Motion", _motion),
    Entry("inter-reflection", "within", "", _between_surfaces),
    Entry("ambient", "steady", "sim_backend.effects.ambient:Ambient", _ambient, _ambient_changes),
    Entry("airlight", "steady", "sim_backend.effects.ambient:Airlight", _airlight, _ambient_changes),
    Entry("dark counts", "steady", "sim_backend.effects.dark_counts:DarkCounts", _dark_counts),
    Entry("quantum efficiency and fill factor", "within", "", _efficiency),
    # The one that reads the frame before is the first on the bits: those are then the photons' own.
    Entry("afterpulsing and dead time", "bits", "sim_backend.effects.afterpulsing:Afterpulsing", _afterpulsing),
    Entry("crosstalk", "bits", "sim_backend.effects.sensor_bits:Crosstalk", _crosstalk, _crosstalk_changes),
    Entry("hot and dead pixels", "bits", "sim_backend.effects.sensor_bits:Defects", _defects, _defects_change),
    Entry("bit errors", "bits", "sim_backend.effects.sensor_bits:BitErrors", _bit_errors, _bit_errors_change),
    *(Entry(name, "within", "", _of_device(name)) for name in DEVICES_OWN),
)
