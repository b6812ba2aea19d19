"""Depth maps as SVG text: a coarse mosaic of few colours, runs of equal ones drawn as one line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import cv2
import numpy as np
from numpy.typing import NDArray

from rig.run_folder.charts import INK, Series

COLOURS = 24
"""Steps between the nearest and the farthest depth."""
SIDE_PX = 246
"""Side of a mosaic."""
PLACE_PX = (SIDE_PX + 24, SIDE_PX + 50)
"""Width and height that it takes with its words."""


@dataclass(frozen=True, slots=True)
class Mosaic:
    """A depth map (rows, width) in metres, NaN where there is none, as `cells` x `cells` cells; limits: near, far."""

    title: str
    depth_m: NDArray[np.floating]
    limits: tuple[float, float]
    cells: int = 73

    @property
    def legend(self) -> Sequence[Series]:
        """Nothing to explain."""
        return ()

    def svg(self) -> str:
        """The mosaic in a place of a chart, depth in words below it."""
        near, far = self.limits
        steps = self._steps()
        scale = SIDE_PX / self.cells
        left = 16
        paths = [
            f'<path d="{_runs(steps == step)}" stroke="{_colour(step)}"/>'
            for step in range(COLOURS)
            if (steps == step).any()
        ]
        return (
            f'<text x="{left}" y="18" font-weight="bold" fill="{INK}">{escape(self.title)}</text>'
            f'<g transform="translate({left} 28) scale({scale:.3f})" fill="none" stroke-width="1.1">'
            f'<path d="M0 0h{self.cells}v{self.cells}h-{self.cells}z" fill="#111" stroke="none"/>{"".join(paths)}</g>'
            f'<text x="{left}" y="{SIDE_PX + 41}" font-size="10" fill="{INK}">red {near:.1f} m, blue {far:.1f} m, '
            "black: no answer</text>"
        )

    def _steps(self) -> NDArray[np.int64]:
        """Colour of each cell, -1 where most of it has no depth: the depth in its middle rank."""
        rows, width = (part // self.cells for part in self.depth_m.shape)
        used = self.depth_m[: rows * self.cells, : width * self.cells]
        parts = used.reshape(self.cells, rows, self.cells, width).swapaxes(1, 2).reshape(self.cells, self.cells, -1)
        ranked = np.sort(parts, axis=2)  # NaN last
        known = np.isfinite(parts).sum(axis=2)
        middle = np.take_along_axis(ranked, np.maximum(known - 1, 0)[..., None] // 2, axis=2)[..., 0]
        near, far = self.limits
        step = np.clip((middle - near) / (far - near) * COLOURS, 0, COLOURS - 1)
        return np.where(known * 2 > rows * width, np.nan_to_num(step), -1).astype(np.int64)


def _runs(mask: NDArray[np.bool_]) -> str:
    parts = []
    for y, row in enumerate(mask):
        ends = np.flatnonzero(np.diff(np.concatenate([[0], row.astype(np.int8), [0]])))
        parts += [f"M{a} {y}.5h{b - a}.1" for a, b in zip(ends[::2], ends[1::2], strict=True)]
    return "".join(parts)


def _colour(step: int) -> str:
    level = np.array([[round(20 + 225 * (1 - (step + 0.5) / COLOURS))]], np.uint8)
    blue, green, red = (int(part) for part in cv2.applyColorMap(level, cv2.COLORMAP_TURBO)[0, 0])
    return f"#{red:02x}{green:02x}{blue:02x}"
