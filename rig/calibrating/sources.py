"""What a calibration is made from: a live or simulated rig, recorded runs, views kept earlier, picture files."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rig.api_config import SIMULATED, Config, configure
from rig.config import RigConfig
from rig.config_files import NO_CONFIG
from rig.errors import UsageError
from rig.recording.manifest import MANIFEST

VIEWS = "views"
"""Folder of a session that holds its views."""
PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
BOARD_SCENE = "board"
"""Scene that a simulated rig is shown where its own has no board."""


@dataclass(frozen=True, slots=True)
class Sources:
    """live: the rig that takes new views, None: none is named; the others in the order they were named. notes: what
    is to be said of them.
    """

    live: RigConfig | None
    sessions: tuple[Path, ...] = ()
    recorded: tuple[Path, ...] = ()
    pictures: tuple[Path, ...] = ()
    notes: tuple[str, ...] = ()


def sort_sources(sources: Sequence[Config], *, pictures: bool = False, scene: str | None = None) -> Sources:
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
    return Sources(live[0] if live else None, tuple(sessions), tuple(recorded), tuple(found), tuple(notes))


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
