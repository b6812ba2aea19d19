"""What `joint` makes once per model, and the room that it keeps from map to map."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.aligned import aligned_zeros
from rig.errors import UsageError
from rig.estimators.aggregation_answer import Answer, new_answer
from rig.estimators.aggregation_ballots import Ballots, new_ballots
from rig.estimators.halo import halo_shares
from rig.estimators.joint_agreement import pairs_to_ask
from rig.estimators.joint_answer import brightness_of
from rig.estimators.joint_confidence import Brightness
from rig.estimators.label_grid import LabelGrid, label_grid
from rig.estimators.label_volume import Costs, costs_of
from rig.estimators.lessons import Setting
from rig.estimators.placing import new_places, profile_table
from rig.estimators.placing_kernels import Places
from rig.estimators.row_input import State, Sweep, state_of, sweep_of
from rig.estimators.second_return import SecondLight, SecondRoom, second_light, second_room
from rig.geometry import SweepGeometry
from rig.row_threads import RowWorkers

MOST_BYTES = 4 << 30
"""Costs and messages of a map may take so much: room for 1000 columns, each searched over all of 1024 x 1024 pixels."""


class Tables(NamedTuple):
    """What is made once per model."""

    grid: LabelGrid
    costs: Costs
    sweep: Sweep
    state: State
    shares: NDArray[np.float32]
    halo: NDArray[np.float32]
    light: SecondLight
    bright: Brightness
    dark: bool
    pairs: NDArray[np.float32]
    """Of maps whose columns all have frames."""


class Memory(NamedTuple):
    """Room for one map after the other: costs and messages (rows, columns, labels) uint8, and the answers."""

    cost: NDArray[np.uint8]
    message: NDArray[np.uint8]
    answer: Answer
    ballots: Ballots
    places: Places
    seconds: SecondRoom

    def fits(self, grid: LabelGrid) -> bool:
        """Whether maps of this grid have their room in it."""
        return self.cost.shape == (*grid.x_far.shape, grid.labels)


def memory_for(grid: LabelGrid) -> Memory:
    """Room for maps of a grid."""
    rows, columns = grid.x_far.shape
    cost, message = (aligned_zeros((rows, columns, grid.labels), np.uint8) for _ in range(2))
    return Memory(
        cost, message, new_answer(rows, columns), new_ballots(rows, columns), new_places(rows, columns),
        second_room(grid),
    )  # fmt: skip


def grid_of(geometry: SweepGeometry) -> LabelGrid:
    """The labels of a geometry. UsageError where their costs would take too much memory."""
    grid = label_grid(geometry)
    rows, columns = grid.x_far.shape
    if (needed := 2 * rows * columns * grid.labels) > MOST_BYTES:
        raise UsageError(
            f"joint weighs {grid.labels} places on each of {rows} rows of {columns} columns, which takes "
            f"{needed / 2**30:.1f} GiB; it may take {MOST_BYTES / 2**30:.3g}: narrow depth_range, or use the estimator "
            "likelihood"
        )
    return grid


def tables_of(setting: Setting, workers: RowWorkers) -> Tables:
    """The tables of a model, for a geometry and so many exposures a column."""
    grid = grid_of(setting.geometry)
    costs = costs_of(setting.model, setting.geometry, grid, setting.exposures, workers)
    state, sigma_px, sweep = state_of(setting.model), setting.model.line_sigma_px, sweep_of(setting.geometry)
    halo = halo_shares(setting.model, setting.geometry.width if setting.model.halo.any() else 0)
    return Tables(
        grid, costs, sweep, state, profile_table(sigma_px), halo, second_light(state, sigma_px, grid, sweep),
        brightness_of(setting.model), setting.dark, pairs_to_ask(np.isfinite(grid.x_far)),
    )  # fmt: skip
