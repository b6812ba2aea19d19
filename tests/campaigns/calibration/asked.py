"""Whether the figures of a campaign are what is asked for (docs/results/), so that a shortfall is an exit code."""

import math
import sys
from collections.abc import Iterable
from typing import NamedTuple

RATIO = (0.8, 1.3)
"""Ratio of actual depth errors to stated standard deviations."""
INSIDE = (0.93, 0.97)
"""Share of the stated 95 % intervals that hold the truth."""
ADDED_PX = (0.0, 0.1)
"""Pixels that an estimated model may add to a scan's error."""
NAMED = (0.9, 1.0)
"""Share of the trials in which a deliberate mistake is named."""


class Figure(NamedTuple):
    """A figure that a campaign found and the limits asked for, which count as kept; nan: there is none."""

    name: str
    value: float
    limits: tuple[float, float]


def shortfalls(figures: Iterable[Figure]) -> list[str]:
    """A line for each figure beyond its limits, or that there is none of."""
    lines = []
    for figure in figures:
        low, high = figure.limits
        if not low <= figure.value <= high:
            found = "was not found" if math.isnan(figure.value) else f"is {figure.value:.4g}"
            lines.append(f"{figure.name} {found}, asked for are {low:g} to {high:g}")
    return lines


def exit_code(figures: Iterable[Figure]) -> int:
    """Says what falls short on stderr; 1 where anything does, else 0."""
    lines = shortfalls(figures)
    for line in lines:
        print(f"short: {line}", file=sys.stderr)
    return 1 if lines else 0
