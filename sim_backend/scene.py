"""What a scene file says: surfaces, medium, ambient light. Unknown keys are refused, quantities carry units.

surfaces: street              # the built-in street, or a folder with world.npz or with disparity.npy and left.png
medium: {fog: {visibility: 30 m}, backscatter: 0.05 /sr}      # or {extinction: 0.13 /m}; leave out for clear air
ambient: {illuminance: 100 lux}                               # leave out for darkness
"""

import re
from pathlib import Path
from typing import Annotated, Any

import yaml
from pydantic import BaseModel, ConfigDict, Field, PlainSerializer, PlainValidator, ValidationError, model_validator

from drivers.errors import DeviceError
from drivers.units import Lux, Metres, PerMetre
from sim_backend.scenes.prepared import load_folder
from sim_backend.scenes.surfaces import Surfaces
from sim_backend.view import Array

KOSCHMIEDER = 3.912
"""-ln(0.02): extinction times visibility at 2 % contrast (Koschmieder's law)."""
SCENE_FOLDER = Path(__file__).parent.parent / "config" / "scenes"
"""Where the bundled scenes are found by name."""

_PER_STERADIAN = re.compile(r"\s*(\d+\.?\d*(?:[eE][+-]?\d+)?|\.\d+)\s*/sr\s*", re.ASCII)


def _parse_per_steradian(text: object) -> float:
    match = _PER_STERADIAN.fullmatch(text) if isinstance(text, str) else None
    if match is None:
        raise ValueError(f'{text!r} is no phase function value; write a number per steradian such as "0.05 /sr"')
    return float(match[1])


PerSteradian = Annotated[
    float,
    PlainValidator(_parse_per_steradian),
    PlainSerializer(lambda value: f"{value!r} /sr", return_type=str, when_used="json"),
]


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Fog(_Section):
    """Fog by how far one sees in it (2 % contrast)."""

    visibility: Annotated[Metres, Field(gt=0)]


class Medium(_Section):
    """A homogeneous scattering medium. Exactly one of `fog` and `extinction` says how dense it is."""

    fog: Fog | None = None
    extinction: Annotated[PerMetre, Field(gt=0)] | None = None
    backscatter: PerSteradian = 0.05
    """Phase function near 180 degrees. Water droplets about 0.05 /sr (lidar ratio 18 to 20 sr), isotropic 0.0796."""
    scattering_share: float = Field(default=1.0, ge=0, le=1)
    """Scattering over extinction; droplets hardly absorb visible light."""

    @model_validator(mode="after")
    def _one_density(self) -> "Medium":
        if (self.fog is None) == (self.extinction is None):
            raise ValueError("give exactly one of 'fog' and 'extinction', e.g. fog: {visibility: 30 m}")
        return self

    @property
    def extinction_per_m(self) -> float:
        """Extinction coefficient in 1/m."""
        if self.fog is not None:
            return KOSCHMIEDER / self.fog.visibility
        assert self.extinction is not None, "the validator lets exactly one be absent"
        return self.extinction

    @property
    def scattering_per_m(self) -> float:
        """Scattering coefficient in 1/m."""
        return self.scattering_share * self.extinction_per_m


class Ambient(_Section):
    """Daylight or lamps on the scene, diffuse."""

    illuminance: Annotated[Lux, Field(ge=0)]


class SceneFile(_Section):
    """A whole scene file."""

    surfaces: str = "street"
    medium: Medium | None = None
    ambient: Ambient | None = None

    @property
    def illuminance_lux(self) -> float:
        """Ambient illuminance, 0 in darkness."""
        return 0.0 if self.ambient is None else self.ambient.illuminance

    @property
    def extinction_per_m(self) -> float:
        """Extinction coefficient in 1/m, 0 in clear air."""
        return 0.0 if self.medium is None else self.medium.extinction_per_m


def bundled_scenes() -> tuple[str, ...]:
    """Names of the scenes that come with the project."""
    return tuple(sorted(path.stem for path in SCENE_FOLDER.glob("*.yaml")))


def load_scene(name: str) -> tuple[SceneFile, Path]:
    """The scene of a bundled name, a scene file or a folder of surfaces, and the folder its paths are relative to.

    A bare folder is its surfaces in clear, dark air. DeviceError, one line, where there is no such scene or it is
    wrong."""
    bundled = SCENE_FOLDER / f"{name}.yaml"
    path = Path(name).expanduser()
    file = bundled if name in bundled_scenes() else path
    if file.is_dir():
        return SceneFile(surfaces=str(file.resolve())), file
    if not file.is_file():
        raise DeviceError(
            f"scene {name!r} is no file, no folder and none of the bundled: {', '.join(bundled_scenes())}"
        )
    try:
        content: Any = yaml.safe_load(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        reason = " ".join(str(error).split())
        raise DeviceError(f"scene file {file} cannot be read: {reason}") from error
    try:
        return SceneFile.model_validate({} if content is None else content), file.parent
    except ValidationError as error:
        problems = "; ".join(
            f"{'.'.join(str(part) for part in item['loc']) or 'file'}: {item['msg']}" for item in error.errors()
        )
        raise DeviceError(f"scene file {file}: {problems}") from error


def load_surfaces(scene: SceneFile, folder: Path, u: Array, v: Array) -> Surfaces:
    """The scene's surfaces for the rays (u, v), each (rows, width); relative folders start at `folder`."""
    if scene.surfaces == "street":
        from sim_backend.scenes.street import street

        return street(u, v)
    path = folder / Path(scene.surfaces).expanduser()
    if not path.is_dir():
        raise DeviceError(
            f"surfaces {scene.surfaces!r}: {path} is no folder; name 'street' or a folder with a scene in it"
        )
    return load_folder(path, (u.shape[0], u.shape[1]))
