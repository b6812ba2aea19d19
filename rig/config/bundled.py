"""The rigs and scenes that come with the program: their names, their files, and a sentence on each.

This module imports little, since shells ask for the names at every Tab.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

BUNDLED = Path(__file__).parents[2] / "config"
"""Folder of the configs that come with the program."""
SCENES = BUNDLED / "scenes"
"""Folder of the scenes that come with the program."""


@dataclass(frozen=True, slots=True)
class Bundled:
    """A rig or a scene that comes with the program. about: first sentence of the comment that its file begins with."""

    name: str
    about: str
    file: Path


def bundled_rigs() -> tuple[Bundled, ...]:
    """The rigs that commands take by name as CONFIG, sorted by name."""
    # Boards and calibrations lie in the same folder.
    is_rig = re.compile(r"^scan:", re.MULTILINE).search
    return tuple(_bundled(path) for path in _by_name(BUNDLED) if is_rig(path.read_text(encoding="utf-8")))


def bundled_scenes() -> tuple[Bundled, ...]:
    """The scenes that simulated rigs take by name as `scene`, sorted by name."""
    return tuple(_bundled(path) for path in _by_name(SCENES))


def short_names(scenes: Iterable[str]) -> dict[str, str]:
    """Short names of scenes for tables, by the scenes' paths: the last part of the path, or the whole path if the last
    part of another one is equal."""
    last = {scene: scene.rstrip("/").rsplit("/", 1)[-1] for scene in scenes}
    names = list(last.values())
    return {scene: name if names.count(name) == 1 else scene for scene, name in last.items()}


def _by_name(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.yaml"), key=lambda path: path.stem)


def _bundled(path: Path) -> Bundled:
    comment: list[str] = []
    for line in path.read_text(encoding="utf-8").splitlines():
        if not line.startswith("#"):
            break
        comment.append(line.removeprefix("#").strip())
    first = re.match(r".*?\.(?=\s|$)", " ".join(comment))
    return Bundled(path.stem, first.group() if first else "", path)
