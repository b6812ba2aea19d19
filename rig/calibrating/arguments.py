"""Reads what a calibrating call is given: sources, files and quantities; what is wrong with them is listed together."""

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING

from drivers.units import parse_quantity
from rig.api_config import Config, PathLike, seed_problems
from rig.config import RigConfig

if TYPE_CHECKING:
    from calibration.board.board import Board
    from calibration.model.rig_model import RigModel

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
