"""What a calibration is made from: a live or simulated rig, recorded runs, views kept earlier, picture files.

Reads what a calibrating call is given: sources, files and quantities; what is wrong with them is listed together.

Whether the camera of `rig calibrate camera` may go into a calibration of the planes, by its verdict.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calibration.files.camera_file import KnownCamera, load_camera
from drivers.units import parse_quantity
from rig.config.files import NO_CONFIG
from rig.config.models import RigConfig
from rig.config.overrides import SIMULATED, Config, PathLike, configure, seed_problems
from rig.devices.calibration_use import Refusal, check_content, failed_verdict, require_accepted
from rig.errors import UsageError
from rig.run_folder.manifest import MANIFEST

if TYPE_CHECKING:
    from calibration.board.board import Board
    from calibration.model.rig_model import RigModel

VIEWS = "views"
"""Folder of a session that holds its views."""
PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
BOARD_SCENE = "board"
"""Scene that a simulated rig is shown where its own has no board."""


@dataclass(frozen=True, slots=True)
class ViewSources:
    """live: the rig that takes new views, None: none is named; the others in the order they were named. notes: what
    is to be said of them.
    """

    live: RigConfig | None
    sessions: tuple[Path, ...] = ()
    recorded: tuple[Path, ...] = ()
    pictures: tuple[Path, ...] = ()
    notes: tuple[str, ...] = ()


def sort_sources(sources: Sequence[Config], *, pictures: bool = False, scene: str | None = None) -> ViewSources:
    """Tell what each source is; none at all: the bundled simulated rig. scene: of a simulated rig, by default its own,
    the bundled one with a board where that has none. Raises UsageError with a line per problem, DeviceError where its
    scene cannot be read.
    """
    live: list[RigConfig] = []
    sessions: list[Path] = []
    recorded: list[Path] = []
    found: list[Path] = []
    problems: list[str] = []
    notes: list[str] = []
    for source in sources or (SIMULATED,):
        path = None if isinstance(source, RigConfig) else Path(source)
        if path is not None and path.is_dir():
            inside = sorted(file for file in path.iterdir() if file.suffix.lower() in PICTURES)
            if (path / VIEWS).is_dir():
                sessions.append(path)
            elif (path / MANIFEST).is_file():
                recorded.append(path)
            elif inside:
                found += inside
            else:
                problems.append(
                    f"{path} holds neither views nor a recording nor pictures; name a run taken with --record, the "
                    "folder of an earlier calibration or a config"
                )
        elif path is not None and path.suffix.lower() in PICTURES:
            found.append(path)
            if not path.is_file():
                problems.append(f"there is no picture {path}; check the path")
        else:
            try:
                live.append(_live(source, scene, notes))
            except UsageError as error:
                also = f"; nor is there a folder of that name ({'pictures, ' * pictures}a run, an earlier calibration)"
                problems += [one + also * one.startswith(NO_CONFIG) for one in error.problems]
    if len(live) > 1:
        problems.append(f"{len(live)} rigs are named; one at a time can be calibrated")
    if found and not pictures:
        problems.append(
            f"{found[0]} is a picture, which serves 'rig calibrate camera' only; name runs taken with --record"
        )
    problems += _named_twice([*sessions, *recorded, *found])
    if problems:
        raise UsageError.of(problems)
    return ViewSources(live[0] if live else None, tuple(sessions), tuple(recorded), tuple(found), tuple(notes))


def _named_twice(paths: Sequence[Path]) -> list[str]:
    """A line for each source that an earlier one is already."""
    problems, known = [], dict[Path, Path]()
    for path in paths:
        first = known.setdefault(path.resolve(), path)
        if first is not path:
            also = "" if str(first) == str(path) else f" (the first time as {first})"
            problems.append(f"{path} is named twice{also}; what is in it must count once: name it once")
    return problems


def _live(source: Config, scene: str | None, notes: list[str]) -> RigConfig:
    """The rig. What is shown to a simulated one in place of its own scene goes to the notes."""
    loaded = configure(source, scene=scene)
    world = loaded.world
    if scene is not None or world is None or "board_pose" not in type(world).model_fields:
        return loaded
    if getattr(world, "holds_board", False):
        return loaded
    own = getattr(world, "scene", "its own")
    notes.append(f"scene {own!r} of {loaded.name} has no board: the bundled scene {BOARD_SCENE!r} is shown instead")
    return configure(loaded, scene=BOARD_SCENE)


SourcesLike = Config | Sequence[Config]


def listed(sources: SourcesLike) -> Sequence[Config]:
    """The sources, where only one was given too."""
    return [sources] if isinstance(sources, RigConfig | str | os.PathLike) else list(sources)


def read_board(file: PathLike | None) -> "Board":
    """A board's file, None: the bundled one. Raises CalibrationError."""
    from calibration.board.board import BUNDLED_BOARD, load_board

    return load_board(BUNDLED_BOARD if file is None else file)


def read_base(file: PathLike | None) -> "RigModel | None":
    """The calibration to start from, if any. Raises CalibrationError."""
    from calibration.files.rig_file import load_rig_model

    return None if file is None else load_rig_model(file)


def problems_of(poses: int | None, seed: int, exposures: Sequence[int] = ()) -> list[str]:
    """What is wrong with numbers that calls have in common."""
    problems = [f"exposures has {k}; it must be at least 1" for k in exposures if k < 1]
    if poses is not None and poses < 1:
        problems.append(f"poses is {poses}; it must be at least 1")
    return problems + seed_problems(seed)


def quantity(problems: list[str], name: str, text: str | None, dimension: str) -> float | None:
    """The number that a text means, above 0; what is wrong with it goes to the problems."""
    if text is None:
        return None
    try:
        value = parse_quantity(text, dimension)
    except ValueError as error:
        problems.append(f"{name}: {error}")
        return None
    if not value > 0:
        problems.append(f"{name} is {text}; it must be above 0")
    return value


def length_m(problems: list[str], name: str, text: str | None) -> float | None:
    """The same of a length."""
    return quantity(problems, name, text, "length")


@dataclass(frozen=True, slots=True)
class CameraUse:
    """A camera that is known from elsewhere. accepted: what it was used in spite of."""

    known: KnownCamera
    accepted: tuple[Refusal, ...] = ()

    def content(self) -> dict[str, Any]:
        """For the provenance of what is made with it."""
        return check_content("unchecked" if self.known.verdict is None else "passed", self.accepted)


def camera_use(file: Path, *, accept: bool = False) -> CameraUse:
    """Read a camera file. UsageError where its verdict failed, unless `accept`; one that says nothing of a verdict, as
    written by hand or of old, is used unchecked. Raises CalibrationError where it cannot be read."""
    known = load_camera(file)
    found = failed_verdict(known.verdict, known.reasons)
    require_accepted(f"camera {file}", found, {each.code for each in found} if accept else ())
    return CameraUse(known, tuple(found))
