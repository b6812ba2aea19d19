"""The scene file: surfaces, medium, weather, ambient light, motion. docs/reference/config.md explains the keys."""

import difflib
import os
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from pydantic import Field, model_validator

from calibration.errors import FileError
from calibration.files.npy_files import load_arrays
from calibration.files.problems import ValueSources, validated
from calibration.files.sections import load_yaml
from drivers.errors import DeviceError
from drivers.units import Lux, Metres, MetresPerSecond, Radians
from sim_backend.scenes.medium import Fog, Medium, Rain, Section, Smoke, Snow
from sim_backend.scenes.surfaces import Array, Surfaces, checked

SCENE_FOLDER = Path(__file__).parents[2] / "config" / "scenes"
"""Folder in which the bundled scenes are found by name."""
WORLD_FILE = "world.npz"
CLEAR = "clear"
"""Word in place of a visibility: no fog."""


class AmbientLight(Section):
    """Daylight or lamps on the scene, diffuse."""

    illuminance: Annotated[Lux, Field(ge=0, examples=["100 lux"])]
    """Diffuse daylight or lamp light on the scene."""


class SceneMotion(Section):
    """Uniform motion of all surfaces together, from time 0 on, which is when the simulated world is made."""

    velocity: tuple[MetresPerSecond, MetresPerSecond, MetresPerSecond] = Field(examples=["[0 m/s, 0 m/s, -2 m/s]"])
    """Velocity along x (right), y (down), z (away from the camera)."""


class BoardPlace(Section):
    """Pose of a calibration board, as in `calibration.views.BoardPose`."""

    rotation: tuple[Radians, Radians, Radians] = Field(examples=["[20 deg, 0 deg, 0 deg]"])
    """Rotation vector; all 0: the board is perpendicular to the camera's axis."""
    position: tuple[Metres, Metres, Metres] = Field(examples=["[-30 cm, -20 cm, 1.5 m]"])
    """Position of the top left corner of the board's squares: x right, y down, z away from the camera."""


class SceneBoard(BoardPlace):
    """A calibration board in the scene."""

    file: str | None = None
    """Board file of the print; the bundled one by default."""
    mirrored: bool = False
    """Whether it is printed the wrong way round."""


class SceneFile(Section):
    """A whole scene file."""

    surfaces: str = Field(default="street", examples=["street"])
    """Surfaces: `street`, `board`, or a folder with `world.npz`, relative to this file."""
    board: SceneBoard | tuple[SceneBoard, ...] = Field(
        default=(), examples=["{rotation: [20 deg, 0 deg, 0 deg], position: [-30 cm, -20 cm, 1.5 m]}"]
    )
    """Boards in front of the wall, if `surfaces` is `board`."""
    wall: Annotated[Metres, Field(gt=0, examples=["4 m"])] = 4.0
    """Distance from the camera's plane to the wall behind the boards."""
    medium: Medium | None = Field(default=None, examples=["{fog: {visibility: 30 m}}"])
    rain: Rain | None = Field(default=None, examples=["{rate: 20 mm/h}"])
    snow: Snow | None = Field(default=None, examples=["{rate: 2 mm/h}"])
    ambient: AmbientLight | None = Field(default=None, examples=["{illuminance: 100 lux}"])
    motion: SceneMotion | None = Field(default=None, examples=["{velocity: [0 m/s, 0 m/s, -2 m/s]}"])
    seed: int = Field(default=1, ge=0, lt=2**63, examples=["1"])
    """Seed of the drops and flakes (sizes and places) and of the speckle."""

    @model_validator(mode="after")
    def _boards_on_board_scenes(self) -> Self:
        if (self.surfaces == "board") != bool(self.boards):
            raise ValueError("write both or neither of 'surfaces: board' and 'board: {rotation: ..., position: ...}'")
        return self

    @property
    def boards(self) -> tuple[SceneBoard, ...]:
        """All boards of the scene."""
        return (self.board,) if isinstance(self.board, SceneBoard) else self.board

    @property
    def illuminance_lux(self) -> float:
        """Ambient illuminance, 0 in darkness."""
        return 0.0 if self.ambient is None else self.ambient.illuminance

    @property
    def extinction_per_m(self) -> float:
        """Extinction coefficient in 1/m of everything in the air, 0 in clear air."""
        return sum((part.extinction_per_m for part in (self.medium, self.rain, self.snow) if part is not None), 0.0)

    @property
    def diffuse_extinction_per_m(self) -> float:
        """Extinction coefficient in 1/m for haze, airlight and ambient light, without the medium's forward scattering:
        such light counts even if it was deflected a little on its way.
        """
        return self.extinction_per_m - (0.0 if self.medium is None else self.medium.forward_per_m)


def bundled_scenes() -> tuple[str, ...]:
    """Names of the scenes that come with the project."""
    return tuple(sorted(path.stem for path in SCENE_FOLDER.glob("*.yaml")))


def load_scene(name: str) -> tuple[SceneFile, Path]:
    """A scene given by a bundled name, a scene file or a folder of surfaces; and the folder that its paths are relative
    to.

    A folder alone means its surfaces in clear, dark air. Raises DeviceError if there is no such scene or its file is
    wrong, with a line for each problem.
    """
    bundled = SCENE_FOLDER / f"{name}.yaml"
    path = Path(os.path.expanduser(name))  # which leaves a user that does not exist as it is
    file = bundled if name in bundled_scenes() else path
    if os.path.isdir(file):  # unlike Path.is_dir, it accepts any text as a name
        return SceneFile(surfaces=str(file.resolve())), file
    if not os.path.isfile(file):
        close = difflib.get_close_matches(path.stem, bundled_scenes(), n=1)
        meant = f"did you mean '{close[0]}'? " if close else ""
        raise DeviceError(
            f"scene {name!r} is no file, no folder and none of the bundled; {meant}bundled scenes are "
            f"{', '.join(bundled_scenes())}"
        )
    try:
        read = load_yaml(file, "a scene", "surfaces: street")
        return validated(SceneFile, read.content, ValueSources(str(file), read.lines)), file.parent
    except FileError as error:
        raise DeviceError("\n".join(error.problems)) from error


def with_fog(scene: SceneFile, visibility: str) -> SceneFile:
    """The scene with air of another visibility (text with a unit), or without a medium if `visibility` is CLEAR.

    Only the density changes: smoke stays smoke, with its own phase function and shares. Clear air becomes fog.
    """
    if visibility == CLEAR:
        return scene.model_copy(update={"medium": None})
    fog = Fog(visibility=visibility)  # type: ignore[arg-type]
    medium = scene.medium or Medium(fog=fog)
    changed: dict[str, Any] = {"fog": fog, "extinction": None}
    if medium.smoke is not None:
        changed = {"smoke": Smoke(visibility=visibility)}  # type: ignore[arg-type]
    return scene.model_copy(update={"medium": medium.model_copy(update=changed)})


def with_board_at(scene: SceneFile, place: BoardPlace) -> SceneFile:
    """The scene with its board, or the first of several, moved to another place. Raises DeviceError if it has
    no board."""
    if not scene.boards:
        raise DeviceError(
            "board_pose moves the board of a scene, this one has none; choose a scene with 'surfaces: board'"
        )
    moved = scene.boards[0].model_copy(update={"rotation": place.rotation, "position": place.position})
    return scene.model_copy(update={"board": (moved, *scene.boards[1:])})


def load_surfaces(scene: SceneFile, folder: Path, u: Array, v: Array) -> Surfaces:
    """The scene's surfaces along the rays (u, v), each (rows, width). Relative paths start at `folder`. Raises
    DeviceError if the surfaces or a board's file cannot be used."""
    if scene.surfaces == "street":
        from sim_backend.scenes.street import street

        return street(u, v)
    if scene.surfaces == "board":
        from sim_backend.scenes.board import board_scene, load_boards

        return board_scene(u, v, load_boards(scene.boards, folder), scene.wall)
    path = folder / os.path.expanduser(scene.surfaces)
    if not os.path.isdir(path):  # unlike Path.is_dir, it accepts any text as a name
        raise DeviceError(
            f"surfaces {scene.surfaces!r}: {str(path)!r} is no folder; name 'street', 'board' or a folder with a scene "
            "in it"
        )
    return load_folder(path, (u.shape[0], u.shape[1]))


def load_folder(folder: Path, size: tuple[int, int]) -> Surfaces:
    """Surfaces from a folder for a camera of size (rows, width). Raises DeviceError if they are invalid
    or of another size.

    `world.npz` holds `depth_m`, `albedo` and, if some depths were guessed, `trusted`.
    """
    path = folder / WORLD_FILE
    if not path.is_file():
        raise DeviceError(f"scene folder {folder} has no {WORLD_FILE}")
    try:
        stored = load_arrays(path)
    except (OSError, ValueError) as error:
        raise DeviceError(f"scene file {path} cannot be read: {error}; write it with numpy.savez") from error
    missing = [key for key in ("depth_m", "albedo") if key not in stored]
    if missing:
        raise DeviceError(f"scene file {path} lacks {' and '.join(missing)}; it holds {', '.join(stored)}")
    depth_m = stored["depth_m"]
    return checked(str(folder), depth_m, stored["albedo"], stored.get("trusted", np.ones(depth_m.shape, bool)), size)
