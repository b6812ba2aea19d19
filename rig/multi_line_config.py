"""Several lines at once, as a config says it: where they stand, whose power they have, and what is wrong with that.

With L lines the mirror sweeps one L-th of the field, so a map takes one L-th of the frames. `scan.command_range` is
what the mirror does, and line l's columns lie at its commands plus `line_offsets[l]`.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import AfterValidator, Field

if TYPE_CHECKING:
    from rig.config import RigConfig

MOST_LINES = 16
LEAST_FRESH = 0.5
"""Share of the mirror's sweep by which neighbouring lines stand apart at least: closer ones light the same places."""

LinePower = Literal["shared", "each"]


def _in_order(value: tuple[float, ...]) -> tuple[float, ...]:
    if not 1 <= len(value) <= MOST_LINES:
        raise ValueError(f"names {len(value)} lines; a rig has 1 to {MOST_LINES}")
    if len(value) == 1 and value[0] != 0:
        raise ValueError(f"has the one offset {value[0]:g}; a single line stands at 0, add others or leave it out")
    for first, second in pairwise(value):
        if not first < second:
            raise ValueError(f"has {second:g} behind {first:g}; it must ascend")
    return value


LineOffsets = Annotated[
    tuple[Annotated[float, Field(ge=-2, le=2, allow_inf_nan=False)], ...],
    AfterValidator(_in_order),
    Field(
        description="places of the lines that leave the mirror together, in units of its command, ascending",
        examples=["[-0.22, 0.22]"],
    ),
]


def line_problems(offsets: Sequence[float], columns: int, command_range: tuple[float, float]) -> list[str]:
    """What stands against a map of so many columns, taken by these lines while the mirror sweeps `command_range`."""
    lines = len(offsets)
    problems = []
    if columns % lines:
        below, above = columns // lines * lines, -(-columns // lines) * lines
        fits = f"{above}" if below == 0 else f"{below} or {above}"
        problems.append(f"scan.columns is {columns}, no multiple of the {lines} lines of line_offsets; make it {fits}")
    span = abs(command_range[1] - command_range[0])
    spare = span * lines / columns  # a column: beyond its neighbours' reach nothing is lit
    for first, second in pairwise(offsets):
        apart = second - first
        told = f"line_offsets {first:g} and {second:g} are {apart:g} apart, scan.command_range spans {span:g}"
        if apart > span + spare:
            problems.append(
                f"{told}: what lies between them is never lit; widen it to {apart:g} or bring the lines closer"
            )
        elif apart < LEAST_FRESH * span:
            problems.append(f"{told}: most of it would be lit twice; narrow it to {apart:g}")
    return problems


def with_lines(config: "RigConfig", lines: int, power: LinePower = "shared") -> "RigConfig":
    """The same rig and field with so many lines, evenly spaced, and the mirror sweeping the share that is left to it.

    config: of one line. Columns are rounded down to a multiple of `lines`. Raises UsageError where that cannot be.
    """
    from rig.config_files import parse_config
    from rig.errors import UsageError

    if len(config.line_offsets) > 1:
        raise UsageError(f"{config.name} has {len(config.line_offsets)} lines already; name a config with one")
    if not 1 <= lines <= MOST_LINES:
        raise UsageError(f"lines is {lines}; it must be 1 to {MOST_LINES}")
    first, last = config.scan.command_range
    pitch, middle = (last - first) / lines, (first + last) / 2
    offsets = sorted((line - (lines - 1) / 2) * pitch for line in range(lines))
    content = config.model_dump(mode="json")
    content["scan"]["columns"] = max(1, config.scan.columns // lines) * lines
    if lines > 1:
        content["scan"]["command_range"] = [middle - pitch / 2, middle + pitch / 2]
    return parse_config({**content, "line_offsets": offsets if lines > 1 else [0.0], "line_power": power})
