"""Reads the inputs of a calibration: sources of views, files and quantities. All problems are listed together.

A source is a live or simulated rig, a recorded run, a session with views kept earlier, or a file of pictures.
`known_camera` decides whether a separately calibrated camera may, by its verdict, be used to calibrate the planes.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from calibration.files.rig_file import KnownCamera, load_camera
from drivers.units import parse_quantity
from rig.config.files import NO_CONFIG
from rig.config.models import RigConfig
from rig.config.overrides import SIMULATED, Config, configure, seed_problems
from rig.devices.calibration_use import Refusal, failed_verdict, require_accepted
from rig.errors import UsageError
from rig.requests import CalibrationRequest
from rig.run_folder.manifest import MANIFEST

VIEWS = "views"
"""Folder of a session that holds its views."""
PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
BOARD_SCENE = "board"
"""Scene that a simulated rig is shown if its own scene has no board."""


SourcesLike = Config | Sequence[Config]


@dataclass(frozen=True, slots=True)
class ViewSources:
    """Sources of views. live: rig that takes new ones; None without one. sessions: folders of earlier calibrations.
    recorded: folders of runs. pictures: files. notes: lines for the user.
    """

    live: RigConfig | None
    sessions: tuple[Path, ...] = ()
    recorded: tuple[Path, ...] = ()
    pictures: tuple[Path, ...] = ()
    notes: tuple[str, ...] = ()


def sort_sources(sources: SourcesLike, *, pictures: bool = False, scene: str | None = None) -> ViewSources:
    """Find out what each source is. Without any, the bundled simulated rig is used.

    pictures: whether picture files are allowed. scene: scene for a simulated rig; None means its own scene or, if that
    has no board, the bundled scene 'board'. Raises UsageError with a line per problem, DeviceError for an unreadable
    scene.
    """
    live, problems, notes = list[RigConfig](), list[str](), list[str]()
    sessions, recorded, found = list[Path](), list[Path](), list[Path]()
    if isinstance(sources, RigConfig | str | os.PathLike):
        sources = [sources]
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
                    f"{path} holds neither views nor a recording nor pictures; name a run taken with `record`, the "
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
            f"{found[0]} is a picture, which serves 'rig calibrate camera' only; name runs taken with `record`"
        )
    known = dict[Path, Path]()
    for path in (*sessions, *recorded, *found):
        first = known.setdefault(path.resolve(), path)
        if first is not path:
            also = "" if str(first) == str(path) else f" (the first time as {first})"
            problems.append(f"{path} is named twice{also}; what is in it must count once: name it once")
    if problems:
        raise UsageError.of(problems)
    return ViewSources(live[0] if live else None, tuple(sessions), tuple(recorded), tuple(found), tuple(notes))


def _live(source: Config, scene: str | None, notes: list[str]) -> RigConfig:
    """The config of a rig. If a simulated rig's scene has no board, it is replaced and a note is added."""
    loaded = configure(source, scene=scene)
    world = loaded.world
    if scene is not None or world is None or "board_pose" not in type(world).model_fields:
        return loaded
    if getattr(world, "has_board", False):
        return loaded
    own = getattr(world, "scene", "its own")
    notes.append(f"scene {own!r} of {loaded.name} has no board: the bundled scene {BOARD_SCENE!r} is shown instead")
    return configure(loaded, scene=BOARD_SCENE)


_QUANTITIES = {
    "accuracy": ("accuracy_m", "length"),
    "at": ("at_m", "length"),
    "stated_baseline": ("stated_baseline_m", "length"),
    "angle": ("angle_rad", "angle"),
}
"""Fields of requests that are texts with a unit: their name in SI units, and their dimension."""


def si_values(request: CalibrationRequest) -> dict[str, float]:
    """The quantities that a request states, in SI units, by names such as `accuracy_m`; without those that it does not
    state. Raises UsageError with a line for each that is wrong, and for wrong exposures, poses and seeds."""
    exposures, poses = getattr(request, "exposures", ()), getattr(request, "poses", 1)
    problems = [f"exposures has {k}; it must be at least 1" for k in exposures if k < 1]
    if poses < 1:
        problems.append(f"poses is {poses}; it must be at least 1")
    problems += seed_problems(request.seed)
    values: dict[str, float] = {}
    for field, (name, dimension) in _QUANTITIES.items():
        text = getattr(request, field, None)
        if text is None:
            continue
        try:
            values[name] = parse_quantity(text, dimension)
        except ValueError as error:
            problems.append(f"{field}: {error}")
            continue
        if not values[name] > 0:
            problems.append(f"{field} is {text}; it must be above 0")
    if problems:
        raise UsageError.of(problems)
    return values


def known_camera(file: Path, *, accept: bool = False) -> tuple[KnownCamera, list[Refusal]]:
    """Read a camera file; return the camera and the accepted reasons against it, none if it has not failed.

    accept: whether to use a camera whose verdict is 'failed'. Raises UsageError for one that is not accepted, and
    CalibrationError if the file is no camera file. A camera without a verdict is used.
    """
    known = load_camera(file)
    found = failed_verdict(known.verdict, known.reasons)
    require_accepted(f"camera {file}", found, {each.code for each in found} if accept else ())
    return known, found
