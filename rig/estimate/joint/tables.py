"""Tables that `joint` makes once per model."""

from typing import NamedTuple

import numpy as np

from rig.errors import UsageError
from rig.estimate.joint.confidence import Brightness, brightness_of, pairs_to_ask
from rig.estimate.joint.labels.contrast import Contrast, contrast_of
from rig.estimate.joint.labels.costs import Costs, costs_of
from rig.estimate.joint.labels.grid import LabelGrid, label_grid
from rig.estimate.joint.place.place import profile_table
from rig.estimate.joint.second_returns import SecondLight, second_light
from rig.estimate.joint.winner import AnswerSettings, answer_settings
from rig.estimate.online_learning import LearningSetting
from rig.estimate.row.inputs import RowState, Sweep, halo_shares, state_of, sweep_of
from rig.geometry.windows import SweepGeometry
from rig.simd import Float32
from rig.threads import RowWorkers

MOST_BYTES = 4 << 30
"""Most bytes that costs and messages (`rig.estimate.joint.paths`) of all maps under way may take: room for a map of
1000 columns, each searched over all of 1024 x 1024 pixels. Tables of a halo would take half as much in addition."""


class JointTables(NamedTuple):
    """All that `tables_of` makes once per model, geometry and number of exposures.

    `sweep`, `state` and `dark` are no tables, but kernels need them too. contrast: None if not needed. shares: made by
    `profile_table`. halo: made by `halo_shares`; it has no pixels if there is no halo. dark: whether there are dark
    frames.
    """

    grid: LabelGrid
    costs: Costs
    contrast: Contrast | None
    sweep: Sweep
    state: RowState
    shares: Float32
    halo: Float32
    light: SecondLight
    bright: Brightness
    dark: bool
    settings: AnswerSettings
    belief: float
    """In the medium of the model; of no effect without `contrast`."""
    pairs: Float32
    """Pairs of `pairs_to_ask`, for maps whose columns all have frames."""


def bytes_of(grid: LabelGrid) -> int:
    """Bytes that costs and messages of a map take."""
    rows, columns = grid.x_far.shape
    return int(2 * rows * columns * grid.labels)


def grid_of(geometry: SweepGeometry) -> LabelGrid:
    """The labels of a geometry. Raises UsageError if their costs would take too much memory."""
    grid = label_grid(geometry)
    rows, columns = grid.x_far.shape
    if (needed := bytes_of(grid)) > MOST_BYTES:
        raise UsageError(
            f"joint weighs {grid.labels} places on each of {rows} rows of {columns} columns, which takes "
            f"{needed / 2**30:.1f} GiB; it may take {MOST_BYTES / 2**30:.3g}: narrow depth_range, or use the estimator "
            "likelihood"
        )
    return grid


def tables_of(setting: LearningSetting, workers: RowWorkers, *, contrast: bool = False) -> JointTables:
    """The tables of a model, for a geometry and a number of exposures per column. Raises UsageError as `grid_of`.

    contrast: whether to make tables for costs of contrast; under a halo they are always made.
    """
    model, geometry, grid = setting.model, setting.geometry, grid_of(setting.geometry)
    costs = costs_of(model, geometry, grid, setting.exposures, workers)
    state, sigma_px, sweep = state_of(model), model.line_sigma_px, sweep_of(geometry)
    by_contrast = contrast_of(costs, sigma_px, geometry.width) if contrast or model.halo.any() else None
    return JointTables(
        grid, costs, by_contrast, sweep, state, profile_table(sigma_px),
        halo_shares(model, geometry.width if model.halo.any() else 0), second_light(state, sigma_px, grid, sweep),
        brightness_of(model), setting.dark, answer_settings(grid.stripes), model.belief,
        pairs_to_ask(np.isfinite(grid.x_far)),
    )  # fmt: skip
