"""From the counts of one map to its stripes, with tables that are given: the steps of `joint` that learn nothing.

A `MapSolver` owns the memory that these steps need, and uses it again for the next map: for every row and column two
bytes per label and about a hundred bytes more. Several solvers can work on several maps at the same time.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rig.count.volume import CountVolume
from rig.estimate.joint.confidence import pairs_to_ask, stripe_table
from rig.estimate.joint.halo import bright_lines
from rig.estimate.joint.labels.contrast import cost_contrast, share_of
from rig.estimate.joint.labels.cost_rows import CostRoom
from rig.estimate.joint.labels.grid import BAND_ROWS, LabelGrid
from rig.estimate.joint.lesson import add_quiet, fill_trust, read_positions
from rig.estimate.joint.paths import CHUNK, along_columns, along_rows
from rig.estimate.joint.place.place import new_places, place
from rig.estimate.joint.place.places import Places
from rig.estimate.joint.place.shown import lower_unshown
from rig.estimate.joint.second_returns import SecondRoom, behind_specks, second_returns, second_room
from rig.estimate.joint.tables import JointTables
from rig.estimate.joint.temporal import TemporalPrior
from rig.estimate.joint.vote import NEIGHBOURS_PX, Ballots, collect, new_ballots, vote
from rig.estimate.joint.winner import LabelAnswers, new_answer, new_readout
from rig.estimate.online_learning import LessonInput
from rig.estimate.row.em import lines_of, next_lattice
from rig.geometry.stripe_table import StripeTable
from rig.geometry.windows import SweepGeometry
from rig.simd import Float32, Float64, Uint8
from rig.simd.memory import aligned_zeros, pointers
from rig.threads import RowWorkers

QUIET_COLUMNS = 8
"""If there are dark frames, one column in so many is also used to learn the ambient light; else every column."""


class Memory(NamedTuple):
    """Memory that a solver uses for every map: costs and messages, uint8 (rows, columns, labels), and the answers."""

    cost: Uint8
    message: Uint8
    answer: LabelAnswers
    ballots: Ballots
    places: Places
    seconds: SecondRoom

    def fits(self, grid: LabelGrid) -> bool:
        """Whether the memory has the shape of this grid's maps."""
        return self.cost.shape == (*grid.x_far.shape, grid.labels)


def memory_for(grid: LabelGrid) -> Memory:
    """Memory for maps of a grid."""
    rows, columns = grid.x_far.shape
    cost, message = (aligned_zeros((rows, columns, grid.labels), np.uint8) for _ in range(2))
    return Memory(
        cost, message, new_answer(rows, columns), new_ballots(rows, columns), new_places(rows, columns),
        second_room(grid),
    )  # fmt: skip


class MapSolver:
    """Estimates one map at a time, on the threads of `workers`. prior: added to the costs, if there is one."""

    def __init__(self, workers: RowWorkers, prior: TemporalPrior | None = None) -> None:
        self._workers = workers
        self._prior = prior
        self._memory: Memory | None = None
        self._rooms: tuple[JointTables, dict[int, tuple[CostRoom, CostRoom]]] | None = None

    @property
    def places(self) -> Places:
        """Places of the last map's stripes, with the light measured there. Only after a map; the next one overwrites
        them."""
        assert self._memory is not None, "a map has been estimated"
        return self._memory.places

    def map(self, volume: CountVolume, tables: JointTables) -> StripeTable:
        """The stripe table of a map, with second returns."""
        first, room = self.stripes(volume, tables), self._room(tables.grid).seconds
        x2_px, confidence2 = second_returns(
            volume, tables.grid, tables.sweep, tables.light, first.x_px, room, self._workers
        )
        both = replace(first, x2_px=x2_px, confidence2=confidence2)
        return behind_specks(both, volume.n_frames, tables.grid, room, self._workers)

    def stripes(self, volume: CountVolume, tables: JointTables, *, lesson: bool = False) -> StripeTable:
        """Stripe table of a map without second returns. lesson: only for learning; stripes are placed less finely."""
        grid, workers, memory = tables.grid, self._workers, self._room(tables.grid)
        x_px = np.empty(grid.x_far.shape, np.float32)
        self._read(volume, tables, x_px)
        seen = volume, tables.sweep, tables.state
        sd = place(*seen, tables.shares, x_px, memory.places, workers, lesson=lesson)
        lit = volume.n_frames > 0
        pairs = tables.pairs if lit.all() else pairs_to_ask(np.isfinite(grid.x_far) & lit)
        table = stripe_table(x_px, sd, volume.n_frames, memory.answer, memory.places, pairs, tables.bright, workers)
        if lesson or tables.contrast is None or tables.belief >= 1.0:
            return table
        workers.settle()
        shown = lower_unshown(volume, x_px, table.confidence, tables.belief, workers)
        return replace(table, confidence=shown)

    def by_contrast(self, volume: CountVolume, tables: JointTables) -> Float32:
        """x_px (rows, columns) from the costs of `rig.estimate.joint.labels.contrast` alone."""
        x_px = np.empty(tables.grid.x_far.shape, np.float32)
        self._read(volume, tables, x_px, alone=True)
        self._workers.settle()
        return x_px

    def teaching(self, volume: CountVolume, tables: JointTables, stripes: StripeTable) -> StripeTable:
        """`stripes`, the last map's stripe table, with the trust of `fill_trust` in place of the confidence."""
        memory, trust = self._room(tables.grid), np.empty_like(stripes.confidence)
        self._workers.over(
            len(trust),
            lambda first, last: fill_trust(
                stripes.x_px, stripes.x_sd_px, volume.n_frames, memory.answer.margin, memory.places,
                tables.bright.ambient, first, last, trust,
            ),
        )  # fmt: skip
        return replace(stripes, confidence=trust)

    def seen(
        self, volume: CountVolume, geometry: SweepGeometry, tables: JointTables, stripes: StripeTable
    ) -> LessonInput:
        """The part of the last map from which the next model is learned. stripes: the map's stripe table."""
        quiet = self.quiet(volume, geometry, tables, stripes)
        lines = lines_of(volume, next_lattice(geometry), stripes)
        bright = bright_lines(volume, tables, stripes, self.places, self._workers)
        return LessonInput(volume, volume.intensity(self._workers), quiet, lines, bright)

    def quiet(self, volume: CountVolume, geometry: SweepGeometry, tables: JointTables, stripes: StripeTable) -> Float64:
        """Ones and exposures of pixels behind clear stripes (2, rows, width), see `ambient_map`."""
        quiet = np.zeros((2, geometry.rows, geometry.width))
        most_light = float(np.median(tables.state.ambient))

        def work(first: int, last: int) -> None:
            add_quiet(
                volume.counts, volume.n_frames, tables.sweep, tables.state, tables.halo, stripes.x_px, stripes.signal,
                stripes.confidence, QUIET_COLUMNS if tables.dark else 1, most_light, first, last, quiet,
            )  # fmt: skip

        self._workers.over(geometry.rows, work)
        return quiet

    def _read(self, volume: CountVolume, tables: JointTables, x_px: Float32, *, alone: bool = False) -> None:
        """Fill x_px (rows, columns) with the positions of the best labels, and the answers in memory.

        The last step, which writes x_px, is only queued. alone: whether costs are those of contrast alone.
        """
        grid, workers = tables.grid, self._workers
        rows, columns = x_px.shape
        memory, rooms = self._room(grid), self._cost_rooms(tables)
        share = 0 if alone else share_of(tables.belief)

        def tie_rows(first: int, last: int) -> None:
            # Band by band: rows of a band share tables, and their costs are tied while they are still in the cache.
            if first not in rooms:
                room = tables.costs.room()
                rooms[first] = room, pointers(room)
            _, room_at = rooms[first]
            for band in range(first, last, BAND_ROWS):
                end = min(band + BAND_ROWS, last)
                tables.costs.fill(volume, band, end, room_at, memory.cost)
                if tables.contrast is not None:
                    cost_contrast(volume, tables.contrast, band, end, memory.cost, share)
                if self._prior is not None:
                    self._prior.add(volume, band, end, memory.cost)
                along_rows(memory.cost, memory.message, band, end)

        def tie_columns(first: int, last: int) -> None:
            desk = new_readout(tables.settings, memory.answer, CHUNK, grid.labels)
            along_columns(memory.cost, memory.message, first, last, pointers(desk))

        neighbours = grid.column_px <= NEIGHBOURS_PX

        def read(first: int, last: int) -> None:
            if neighbours:
                vote(memory.ballots, memory.cost, first, last, memory.answer)
            read_positions(
                grid.x_far, volume.n_frames, grid.side, tables.sweep.u.shape[1], memory.answer, first, last, x_px,
                memory.places.distance,
            )  # fmt: skip

        workers.over(rows, tie_rows)
        workers.post(columns, tie_columns)
        if neighbours:
            workers.post(columns, lambda first, last: collect(memory.answer, first, last, memory.ballots))
        workers.settle()
        workers.post(rows, read)  # without waiting: each thread goes on with the same rows

    def _room(self, grid: LabelGrid) -> Memory:
        memory = self._memory
        if memory is None or not memory.fits(grid):
            memory = self._memory = memory_for(grid)
        return memory

    def _cost_rooms(self, tables: JointTables) -> dict[int, tuple[CostRoom, CostRoom]]:
        """Memory for costs and `pointers` to it, by the first row of the thread using it; making it takes 0.5 ms."""
        if self._rooms is None or self._rooms[0] is not tables:
            self._rooms = tables, {}
        return self._rooms[1]
