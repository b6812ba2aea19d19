"""All effects, when a scene calls for each, and where its code is. Code is loaded only when it is needed."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Literal

from sim_backend.effects.setting import PlannedFor, Setting
from sim_backend.light.optics import ambient_irradiance

EffectKind = Literal["laser", "steady", "bits", "within"]
"""Target of an effect. "laser": the sheet's light (`LaserEffect`). "steady": light or counts without the laser; its
code is a function that returns detections per second, float64 (rows, width). "bits": the sensor's bits (`BitEffect`).
"within": the effect is part of a simulated device, of another effect or of the gain, and has no code of its own."""


@dataclass(frozen=True, slots=True)
class Entry:
    """One effect: its name, what it acts on, its factory as module:name ("" for kind "within"), and the rule that calls
    for it.

    why(setting): the reason in words why the effect is called for, None if it is not. absent: the reason why it is not
    called for; "" means that the sensor has no such effect.
    of_sensor: light or counts that stay under a covered lens.
    changes(setting, planned_for), in closed form: the largest share of decisions on a row and column that can differ
    without the effect (may exceed 1). None: there is no closed form. The planner then evaluates the effect if it is
    dark counts or light that does not move, except the stripe; any other effect is never left out.
    """

    name: str
    kind: EffectKind
    code: str
    why: Callable[[Setting], str | None]
    absent: str = ""
    changes: Callable[[Setting, PlannedFor], float] | None = None
    of_sensor: bool = False

    def called(self, setting: Setting) -> tuple[bool, str]:
        """Whether the setting calls for the effect, and why or why not."""
        why = self.why(setting)
        return why is not None, why or self.absent or f"the sensor has no {self.name}"

    def load(self) -> Callable[..., Any]:
        """The function that makes the effect from a `Setting`, imported now."""
        module, _, name = self.code.partition(":")
        loaded: Callable[..., Any] = getattr(import_module(f"sim_backend.effects.{module}"), name)
        return loaded


def _fog(setting: Setting) -> str | None:
    medium = setting.scene.medium
    return None if medium is None else f"the medium has an extinction of {medium.extinction_per_m:.3g} /m"


def _halo(setting: Setting) -> str | None:
    medium = setting.scene.medium
    if medium is None or not medium.multiple_scattering or medium.scattering_per_m == 0:
        return None
    depth = (medium.scattering_per_m - medium.forward_per_m) * setting.view.median_depth_m
    return f"the optical depth of the medium in front of the scene is {depth:.2g}"


def _forward_blur(setting: Setting) -> str | None:
    medium = setting.scene.medium
    if medium is None or medium.forward_per_m == 0:
        return None
    return f"the optical depth of what is scattered forward is {medium.forward_per_m * setting.view.median_depth_m:.2g}"


def _rain(setting: Setting) -> str | None:
    rain = setting.scene.rain
    if rain is None:
        return None
    return f"it rains {1e3 * rain.rate:g} mm/h: {rain.sizes.density_per_m3():.0f} drops per m^3"


def _snow(setting: Setting) -> str | None:
    snow = setting.scene.snow
    if snow is None:
        return None
    return f"it snows {1e3 * snow.rate:g} mm/h: {snow.sizes.density_per_m3():.0f} flakes per m^3"


def _speckle(setting: Setting) -> str | None:
    return "the laser is coherent" if setting.line.speckle else None


def _defocus(setting: Setting) -> str | None:
    focus, spread = setting.optics.focus, setting.line.spread
    if focus is None and spread == 0:
        return None
    sharp = "everywhere sharp" if focus is None else f"focused at {focus:g} m"
    return f"the picture is {sharp}, the sheet spreads by {spread:g} rad; part of the stripe"


def _motion(setting: Setting) -> str | None:
    speeds = () if setting.scene.motion is None else setting.scene.motion.velocity
    return f"the surfaces move by {', '.join(f'{speed:g}' for speed in speeds)} m/s" if speeds else None


def _ambient(setting: Setting) -> str | None:
    lux = setting.scene.illuminance_lux
    return f"the scene has {lux:g} lux" if lux else None


def _ambient_changes(setting: Setting, planned_for: PlannedFor) -> float:
    white = setting.gain * ambient_irradiance(setting.scene.illuminance_lux, setting.optics) / math.pi
    return white * planned_for.exposure_s * setting.view.width


def _airlight(setting: Setting) -> str | None:
    lux = setting.scene.illuminance_lux
    return f"{lux:g} lux light up the medium" if lux and setting.scene.medium is not None else None


def _dark_counts(setting: Setting) -> str | None:
    rate = setting.sensor.dark_rate
    return f"the sensor counts {rate:g} cps in the dark" if rate else None


def _efficiency(setting: Setting) -> str:
    sensor, optics = setting.sensor, setting.optics
    return (
        f"the lens passes {optics.transmission:.3g} of the light, {sensor.fill_factor:.3g} of that meets a diode, "
        f"which detects {sensor.detection_probability:.3g}; part of the gain of all light"
    )


def _afterpulsing(setting: Setting) -> str | None:
    share, dead_s = setting.sensor.afterpulsing, setting.sensor.dead_time
    if share == 0 and dead_s == 0:
        return None
    return f"the sensor has {share:.3g} afterpulses a detection, dead time {1e9 * dead_s:.3g} ns"


def _crosstalk(setting: Setting) -> str | None:
    share = setting.sensor.crosstalk
    return f"a detection sets off {share:.3g} neighbours" if share else None


def _defects(setting: Setting) -> str | None:
    dead, hot = setting.sensor.dead_share, setting.sensor.hot_share
    return f"{dead:.3g} of the pixels always read 0, {hot:.3g} always 1" if dead or hot else None


def _bit_errors(setting: Setting) -> str | None:
    rate = setting.sensor.bit_error_rate
    return f"{rate:.3g} of the bits are read wrongly" if rate else None


def _of_device(effect: str) -> Entry:
    return Entry(effect, "within", "", lambda setting: setting.devices.get(effect), "no simulated device has it")


# No decision on a row changes where none of its bits does.
def _crosstalk_changes(setting: Setting, planned_for: PlannedFor) -> float:
    return setting.sensor.crosstalk * setting.view.width * planned_for.exposures


def _defects_change(setting: Setting, planned_for: PlannedFor) -> float:
    return (setting.sensor.dead_share + setting.sensor.hot_share) * setting.view.width


def _bit_errors_change(setting: Setting, planned_for: PlannedFor) -> float:
    return setting.sensor.bit_error_rate * setting.view.width * planned_for.exposures


DEVICES_OWN = ("galvo lag", "galvo jitter", "sheet bow", "row delay", "lost frames", "duplicated frames", "clock drift")
MEASURED = "stripe"
"""Name of the effect without which there is nothing to decide."""
_NO_MEDIUM = "the scene has no medium"
_SURFACE = "each pixel has its albedo and its facet's tilt; part of the stripe and of ambient light"
_FLAT = "a world is one depth per pixel: it lacks the sides nobody sees, from which light would come"
_SHARP = "the optics name no focus and the line's spread is 0: it is equally wide at all depths"

CATALOGUE = (
    Entry("stripe", "laser", "stripe:Stripe", lambda _: "it is what is measured"),
    Entry("texture and cosine", "within", "", lambda _: _SURFACE),
    Entry("line width and defocus", "within", "", _defocus, _SHARP),
    # Acts on the light that the effects before it added: the stripe.
    Entry("speckle", "laser", "speckle:Speckle", _speckle, "the line's speckle is off"),
    Entry("fog", "laser", "fog:Haze", _fog, _NO_MEDIUM),
    Entry("forward blur", "laser", "stripe:ForwardBlur", _forward_blur, f"{_NO_MEDIUM} with a forward_share"),
    Entry("halo", "laser", "halo:Halo", _halo, f"{_NO_MEDIUM}, its multiple_scattering is off, or it only absorbs"),
    Entry("rain", "laser", "particles:rain_drops", _rain, "it does not rain in the scene"),
    Entry("snow", "laser", "particles:snow_flakes", _snow, "it does not snow in the scene"),
    Entry("motion", "laser", "motion:Motion", _motion, "nothing moves in the scene"),
    Entry("inter-reflection", "within", "", lambda _: None, _FLAT),
    Entry("ambient", "steady", "ambient:ambient", _ambient, "the scene has no ambient light", _ambient_changes),
    Entry("airlight", "steady", "ambient:airlight", _airlight, f"{_NO_MEDIUM} or no ambient light", _ambient_changes),
    Entry("dark counts", "steady", "dark_counts:dark_counts", _dark_counts, of_sensor=True),
    Entry("quantum efficiency and fill factor", "within", "", _efficiency),
    # Reads the frame before, so it is the first effect on bits: the frame then holds only photons and dark counts.
    Entry("afterpulsing and dead time", "bits", "afterpulsing:Afterpulsing", _afterpulsing),
    Entry("crosstalk", "bits", "sensor_bits:Crosstalk", _crosstalk, changes=_crosstalk_changes),
    Entry("hot and dead pixels", "bits", "sensor_bits:Defects", _defects, changes=_defects_change),
    Entry("bit errors", "bits", "sensor_bits:BitErrors", _bit_errors, changes=_bit_errors_change),
    *map(_of_device, DEVICES_OWN),
)
