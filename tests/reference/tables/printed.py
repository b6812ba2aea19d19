"""Tables that programs print while they measure, and the scenes that they are asked for."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from tests.reference.made_scenes import random_scene
from tests.reference.scene import Scene, load_scene, procedural_scene, scene_names


class Table:
    """A Markdown table: rows are printed as they come, and kept."""

    def __init__(self, titles: Sequence[str]) -> None:
        self.text = ""
        self.add(titles)
        self._put("|---" * len(titles) + "|\n")

    def add(self, cells: Sequence[object]) -> None:
        """One more row."""
        self._put("| " + " | ".join(map(str, cells)) + " |\n")

    def write(self, file: Path | None) -> None:
        """Write all rows so far, where a file is asked for."""
        if file is not None:
            file.write_text(self.text)

    def _put(self, text: str) -> None:
        self.text += text
        print(text, end="", flush=True)


def parser_of(program: str, doc: str | None, points: str | None = None) -> argparse.ArgumentParser:
    """A command line that asks for scenes and a file for the table. points: those by default, where it asks for any."""
    parser = argparse.ArgumentParser(
        prog=f"python -m {program}", description=doc, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--scenes", help="comma-separated; 'procedural' and 'random-NUMBER' are built in; default: all prepared ones"
    )
    if points is not None:
        parser.add_argument("--points", default=points, help="comma-separated")
    parser.add_argument("--markdown", type=Path, help="file for the table")
    return parser


def scenes_asked(parser: argparse.ArgumentParser, names: str | None) -> Sequence[str]:
    """Names of the scenes asked for; by default all prepared ones or, where there are none, the built-in one.

    Ends the program if one of them is absent.
    """
    wanted = names.split(",") if names else scene_names() or ("procedural",)
    if any(scene_named(name) is None for name in wanted):
        parser.error(f"a scene of {names} is absent; present: {', '.join([*scene_names(), 'procedural'])}")
    return wanted


def scene_of(name: str, rows: int | None = None) -> Scene:
    """The scene of a name that is present. rows: the middle ones, None for all."""
    scene = scene_named(name)
    assert scene is not None, f"{name} was there when the table was asked for"
    return scene if rows is None else scene.crop(min(rows, scene.shape[0]), scene.shape[1])


def scene_named(name: str) -> Scene | None:
    """The scene of a name; None if there is none."""
    if name.startswith("random-"):
        return random_scene(int(name.removeprefix("random-")))
    return procedural_scene() if name == "procedural" else load_scene(name)
