"""Scenes in different air, as files that a simulated world reads: fog of a visibility, rain, snow, or clear air.

A scene is a bundled name, a scene file, a folder of surfaces, or `ramp`: a wall with random texture that recedes from
1.2 to 14 m, so that every distance is there. The air that is asked for replaces fog, rain and snow of the scene. Fog of
a visibility is always one of droplets that scatter light more than once, whatever fog the scene has. Ambient light is
that of the scene; a scene without any gets that of the bundled scenes.
"""

import os
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml

from calibration.errors import CalibrationError, FileError
from calibration.files.rig_file import load_rig_model
from calibration.files.sections import load_yaml
from calibration.model.rig_model import RigModel
from drivers.units import parse_quantity
from rig.config.bundled import bundled_scenes
from rig.config.models import RigConfig
from rig.errors import UsageError

CLEAR: Final = "clear"
OWN: Final = "own"
"""Word for the air of the scene itself."""
WEATHER: Final[dict[str, dict[str, Any]]] = {
    "rain": {"rain": {"rate": "20 mm/h", "wind": "1 m/s"}},
    "snow": {"snow": {"rate": "2 mm/h", "wind": "0.5 m/s"}},
}
"""Air by name: heavy rain and moderate snow, as in the bundled scenes."""
USUAL_LUX: Final = 5.0
"""Ambient light, in lux, of a scene that states none. The bundled scenes have it: a street at night."""
LEAST_VISIBLE_M: Final = 0.1
"""Smoke is hardly ever denser than this visibility."""
RAMP: Final = "ramp"
RAMP_M: Final = (1.2, 14.0)
TEXTURE_PX: Final = 6
"""Size of the patches of the ramp's texture."""
ALBEDO: Final = (0.2, 0.8)


def air_problems(airs: "list[str] | tuple[str, ...]") -> list[str]:
    """A line for each name that is not an air, saying why."""
    problems = []
    for air in airs:
        if air in (CLEAR, OWN) or air in WEATHER:
            continue
        try:
            visible_m = parse_quantity(air, "length")
        except ValueError:
            problems.append(
                f"`fogs` has {air!r}; write a visibility with a unit such as 20m, or {CLEAR}, {', '.join(WEATHER)} or "
                f"{OWN}"
            )
        else:
            if visible_m < LEAST_VISIBLE_M:
                problems.append(f"`fogs` has {air!r}; a visibility is at least {LEAST_VISIBLE_M:g} m")
    return problems


def visibility_m(air: str | None) -> float | None:
    """Visibility of an air in metres; infinite for clear air, None for rain, snow and a scene's own air."""
    if air is None or air in WEATHER:
        return None
    return float("inf") if air == CLEAR else parse_quantity(air, "length")


def scene_file(scene: str, air: str | None, lux: float | None, model: RigModel, folder: Path) -> Path:
    """Write a scene in an air to a file in `folder`, and return its path. Raises UsageError if the scene cannot be read
    or names surfaces that are not there.

    air: None for the scene's own. lux: ambient illuminance, None for the scene's own. model: the rig whose camera
    `ramp` is made for.
    """
    content = _content(scene, model, folder)
    if air is not None:
        content = {key: value for key, value in content.items() if key not in ("medium", "rain", "snow")}
        if air in WEATHER:
            content |= WEATHER[air]
        elif air != CLEAR:
            content["medium"] = {"fog": {"visibility": air}}
    if lux is not None or "ambient" not in content:
        content["ambient"] = {"illuminance": f"{USUAL_LUX if lux is None else lux:g} lux"}
    file = folder / f"scene-{len(list(folder.iterdir()))}.yaml"
    file.write_text(yaml.safe_dump(content), encoding="utf-8")
    return file


def scene_path(scene: str) -> str:
    """The absolute path of a scene; a bundled name, or `ramp`, as it is."""
    named = scene == RAMP or scene in {each.name for each in bundled_scenes()}
    return scene if named else os.path.abspath(os.path.expanduser(scene))


def _content(scene: str, model: RigModel, folder: Path) -> dict[str, Any]:
    bundled = {each.name: each.file for each in bundled_scenes()}
    path = bundled.get(scene, Path(os.path.expanduser(scene)))
    if scene == RAMP:
        return {"surfaces": str(_ramp(model, folder))}
    if path.is_dir():
        return {"surfaces": str(path.resolve())}
    try:
        content = load_yaml(path, "a scene", "surfaces: street").content
    except FileError as error:
        near = get_close_matches(scene, [*bundled, RAMP], n=1)
        raise UsageError(
            f"{'; '.join(error.problems)}; {f'did you mean {near[0]}? ' if near else ''}name a scene of those that "
            f"'rig scenes' lists, a scene file, a folder or {RAMP!r}"
        ) from error
    surfaces = content.get("surfaces", "street")
    if isinstance(surfaces, str) and surfaces not in ("street", "board"):
        content["surfaces"] = str((path.parent / surfaces).resolve())
        if not os.path.exists(content["surfaces"]):
            raise UsageError(f"scene {scene!r} names surfaces that are not there, {content['surfaces']}; correct it")
    return content


def _ramp(model: RigModel, folder: Path) -> Path:
    """A folder with the surfaces of `ramp`: nearest on the side where the source stands."""
    made = folder / RAMP
    if not made.exists():
        rows, width = model.camera.height, model.camera.width
        near_m, far_m = RAMP_M
        inverse = np.linspace(1 / near_m, 1 / far_m, width)
        if model.source_m is not None and model.source_m[0] > 0:
            inverse = inverse[::-1]
        rng = np.random.default_rng(1)
        patches = rng.uniform(*ALBEDO, (-(-rows // TEXTURE_PX), -(-width // TEXTURE_PX)))
        texture = patches.repeat(TEXTURE_PX, axis=0).repeat(TEXTURE_PX, axis=1)[:rows, :width]
        made.mkdir()
        depth_m = np.broadcast_to(1 / inverse, (rows, width)).astype(np.float32)
        np.savez(made / "world.npz", depth_m=depth_m, albedo=texture.astype(np.float32))
    return made


def rig_model(config: RigConfig) -> RigModel:
    """The calibrated rig of a config. Raises UsageError if the config has no calibration, or an unreadable one."""
    if config.calibration is None:
        raise UsageError(f"{config.name} has no calibration, so no depth; name one in the config")
    try:
        return load_rig_model(config.calibration)
    except CalibrationError as error:
        raise UsageError(f"calibration {error}") from error
