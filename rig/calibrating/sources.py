"""What a calibration is made from: a live or simulated rig, recorded runs, views kept earlier, picture files."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rig.api_config import SIMULATED, Config, configure
from rig.config import RigConfig
from rig.errors import UsageError
from rig.recording.manifest import MANIFEST

VIEWS = "views"
"""Folder of a session that holds its views."""
PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
BOARD_SCENE = "board"
"""Scene of a simulated rig whose own has no board."""


@dataclass(frozen=True, slots=True)
class Sources:
    """live: the rig that takes new views, None where none is named. The others in the order they were named."""

    live: RigConfig | None
    sessions: tuple[Path, ...] = ()
    recorded: tuple[Path, ...] = ()
    pictures: tuple[Path, ...] = ()


def sort_sources(sources: Sequence[Config], *, pictures: bool = False, scene: str | None = None) -> Sources:
    """Tell what each source is; none at all: the bundled simulated rig. scene: of a simulated rig, by default with a
    board. Raises UsageError with a line per problem.
    """
    live: list[RigConfig] = []
    sessions: list[Path] = []
    recorded: list[Path] = []
    found: list[Path] = []
    problems: list[str] = []
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
                live.append(_live(source, scene))
            except UsageError as error:
                problems += error.problems
    if len(live) > 1:
        problems.append(f"{len(live)} rigs are named; one at a time can be calibrated")
    if found and not pictures:
        problems.append(
            f"{found[0]} is a picture, which serves 'rig calibrate camera' only; name runs taken with --record"
        )
    problems += _named_twice([*sessions, *recorded, *found])
    if problems:
        raise UsageError.of(problems)
    return Sources(live[0] if live else None, tuple(sessions), tuple(recorded), tuple(found))


def _named_twice(paths: Sequence[Path]) -> list[str]:
    """A line for each source that an earlier one is already."""
    problems, known = [], dict[Path, Path]()
    for path in paths:
        first = known.setdefault(path.resolve(), path)
        if first is not path:
            also = "" if str(first) == str(path) else f" (the first time as {first})"
            problems.append(f"{path} is named twice{also}; what is in it must count once: name it once")
    return problems


def _live(source: Config, scene: str | None) -> RigConfig:
    loaded = configure(source, scene=scene)
    world = loaded.world
    if scene is None and world is not None and "board_pose" in type(world).model_fields:
        return configure(loaded, scene=BOARD_SCENE)
    return loaded
