"""Estimator `joint`: the row likelihood tied across rows and columns, for a whole map at a time.

Each label (candidate position) of a row and column (`rig.estimate.joint.labels.grid`) gets a cost from the counts
(`rig.estimate.joint.labels.costs`, a fast form of `rig.estimate.row.likelihood`). The cost includes the halo, if there
is one (`rig.estimate.joint.labels.halo_rows`), and the previous map, if requested (`rig.estimate.joint.temporal`).
Under a halo the cost is averaged with a second one that needs no model of the medium
(`rig.estimate.joint.labels.contrast`). Costs are tied to those of the neighbours along four paths
(`rig.estimate.joint.paths`); weak answers are decided by a vote of all neighbours (`rig.estimate.joint.vote`). The
answer of each row and column is then refined to a position between labels, with the help of neighbours on its surface
(`rig.estimate.joint.place.place`), and gets a confidence (`rig.estimate.joint.confidence`). Each row is searched for a
second line (`rig.estimate.joint.second_returns`). The model of light and medium is learned row by row first, as by
`likelihood`, then from the map's own stripes.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rig.count.volume import Counter, CountVolume, SweepCounter, SweepLayout
from rig.estimate.joint.confidence import pairs_to_ask, stripe_table
from rig.estimate.joint.halo import bright_lines, halfway, learn_first_halo, learn_next_halo
from rig.estimate.joint.labels.contrast import cost_contrast
from rig.estimate.joint.labels.grid import BAND_ROWS, LabelGrid
from rig.estimate.joint.lesson import add_quiet, fill_trust, read_positions
from rig.estimate.joint.paths import CHUNK, along_columns, along_rows
from rig.estimate.joint.place.place import amplitudes_of, line_width, place, weigh_light
from rig.estimate.joint.second_returns import second_returns
from rig.estimate.joint.tables import JointTables, Memory, grid_of, memory_for, tables_of
from rig.estimate.joint.temporal import TemporalPrior
from rig.estimate.joint.vote import NEIGHBOURS_PX, collect, vote
from rig.estimate.joint.winner import new_readout
from rig.estimate.row.ambient import ambient_map
from rig.estimate.row.em import expect, learn_again, lines_of, next_lattice
from rig.estimate.row.inputs import state_of
from rig.estimate.row.model import RowModel
from rig.estimate.search.online_learning import LearningSetting, OnlineLearner, Seen, first_model
from rig.geometry.stripe_table import StripeTable
from rig.geometry.windows import SweepGeometry
from rig.simd import Float32, Float64
from rig.simd.memory import pointers
from rig.threads import RowWorkers

LESSONS = 2
"""Number of times that the first map's stripes are estimated and the model is learned again from them."""
HALO_LESSONS = 3
"""Number of these lessons under a halo."""
KEPT_WORSE = 0.0015
"""Share of the log likelihood by which a kept medium may explain a first sweep worse than the one that was learned from
it row by row. It is at most 0.0004 in the same fog, 0.001 at 0.8 of the visibility, 0.002 and more in other scenes."""
AGREE_PX = np.float32(1.0)
"""Under a halo, a first map's stripe is learned from only if contrast alone puts it at most this far away, in px."""
TRUSTED = np.float32(0.5)
"""An answer teaches if its trust exceeds this: under a halo, amplitudes are learned only from such stripes."""
LOST = 0.2
"""If fewer answers than this share teach the last lesson in fog, light scattered many times may hide the stripes."""
QUIET_COLUMNS = 8
"""If there are dark frames, one column in so many is also used to learn the ambient light; else every column."""


class Joint:
    """The row likelihood tied to the neighbours', with the state it has learned so far.

    Pass `model` to estimate a map again with the state that it was estimated with: the result is the same bit for bit.
    learns: whether later maps change that state. temporal_prior: whether the last map is a weak prior for the next.
    kept: state of an earlier run, used for the first map if it explains its counts.
    """

    def __init__(
        self,
        threads: int = 2,
        model: RowModel | None = None,
        *,
        learns: bool = True,
        temporal_prior: bool = False,
        kept: RowModel | None = None,
    ) -> None:
        self._workers = RowWorkers(threads)
        self._lessons = OnlineLearner(tables_of, None, learns=learns, learn_more=learn_next_halo)
        self._kept = kept
        self.kept_serves: bool | None = None
        """Whether the first map was estimated with the kept state; None before, and if there is none."""
        self._prior = TemporalPrior(temporal_prior)
        self._memory: Memory | None = None
        self.used: RowModel | None = None
        """The state that the last map was estimated with."""
        if model is not None:
            self.model = model

    @property
    def model(self) -> RowModel | None:
        """The state with which the next map will be estimated."""
        model, before = self._lessons.model, self._prior.before
        return model if model is None or before is None else replace(model, before=before)

    @model.setter
    def model(self, model: RowModel) -> None:
        self._prior.recall(model.before)
        self._lessons.model = model if model.before is None else replace(model, before=None)

    def counter(self, layout: SweepLayout, geometry: SweepGeometry) -> Counter:
        """A counter whose finished sweeps go to `estimate`. geometry: the nominal one, which holds for every sweep.

        Raises UsageError if its maps would take too much memory, before any light is let out.
        """
        grid_of(geometry)
        return SweepCounter(layout, self._workers)

    def estimate(self, sweep: CountVolume, geometry: SweepGeometry) -> StripeTable:
        """Stripe table of one sweep. Afterwards `model` is the state for the next sweep."""
        model = self._lessons.model_for(lambda: self._first_model(sweep, geometry))
        setting = LearningSetting(model, geometry, sweep.exposures, sweep.dark_counts is not None)
        tables = self._lessons.tables(setting, self._workers)
        self._prior.begin(geometry, tables.grid)
        self.used = model if self._prior.before is None else replace(model, before=self._prior.before)
        first, room = self._stripes(sweep, tables), self._room(tables.grid).seconds
        x2_px, confidence2 = second_returns(
            sweep, tables.grid, tables.sweep, tables.light, first.x_px, room, self._workers
        )
        stripes = replace(first, x2_px=x2_px, confidence2=confidence2)
        self._prior.leave(stripes, tables.grid)
        # Whether the first map is good enough to learn from is judged by the trust of its lessons.
        known = self._lessons.model is not None
        judged = stripes if known else self._teaching(sweep, tables, stripes)
        self._lessons.attend(
            judged, model, int(sweep.n_frames.sum()), lambda: self._seen(sweep, geometry, tables, stripes)
        )
        return stripes

    def _first_model(self, volume: CountVolume, geometry: SweepGeometry) -> RowModel:
        """The model for the first sweep: learned row by row, then from a kept state or the whole map's stripes."""
        self._prior.recall(None)  # forget maps from which nothing was learned
        model = start = first_model(volume, geometry, self._workers)
        if self._kept is not None:
            kept = self._adapted(self._kept, model, volume, geometry)
            self.kept_serves = kept is not None
            if kept is not None:
                return kept
        witness_px, lessons, intensity, misled = None, 0, volume.intensity(self._workers), model
        foggy = bool(model.profile[:, 0].max() > np.median(model.ambient))
        while lessons < (LESSONS if witness_px is None else HALO_LESSONS):
            (model, teaching), lessons = self._taught(volume, intensity, geometry, model, witness_px), lessons + 1
            lost = foggy and lessons == LESSONS and teaching < LOST
            if witness_px is None and (model.halo.any() or lost):
                # Light scattered many times has misled these lessons, so that they found a halo, or too few stripes to
                # find one. Begin again, and check stripes by contrast.
                misled = model
                witness_px, model, lessons = self._by_contrast(volume, geometry, model), start, 0
        # Lost stripes prove no halo: without one, nothing has to be learned by contrast.
        return misled if witness_px is not None and not (model.halo.any() or misled.halo.any()) else model

    def _adapted(
        self, kept: RowModel, fresh: RowModel, volume: CountVolume, geometry: SweepGeometry
    ) -> RowModel | None:
        """The state of an earlier run, adapted to a first sweep; None if it does not explain the sweep's counts.

        fresh: learned row by row from the sweep. A halo is taken over together with everything else, but only if that
        explains the counts better, since a single row cannot tell it from haze. Without a halo, the line's width and
        the brightness of stripes are taken over if the medium is still the same.
        """
        lines = lines_of(volume, next_lattice(geometry))

        def evidence(model: RowModel) -> float:
            return expect(lines, geometry, model, self._workers).evidence

        if kept.halo.any():
            return kept if evidence(kept) > evidence(fresh) else None
        profile = np.column_stack([kept.profile[:, :3], fresh.profile[:, 3]]).astype(np.float32)
        medium = replace(fresh, profile=profile, row_gain=kept.row_gain, column_gain=kept.column_gain)
        own = evidence(fresh)
        if evidence(medium) < own - KEPT_WORSE * abs(own):
            return None
        return replace(fresh, amplitude=kept.amplitude, weight=kept.weight, line_sigma_px=kept.line_sigma_px)

    def _taught(
        self, volume: CountVolume, intensity: NDArray[np.uint32], geometry: SweepGeometry, model: RowModel,
        witness_px: Float32 | None,
    ) -> tuple[RowModel, float]:  # fmt: skip
        """The model learned from stripes that are estimated with `model`, and the share of answers that teach it.

        intensity: of the volume. witness_px: x_px of `_by_contrast`; stripes more than AGREE_PX from it are not used.
        """
        before = model
        setting = LearningSetting(model, geometry, volume.exposures, volume.dark_counts is not None)
        tables = tables_of(setting, self._workers, contrast=witness_px is not None)
        stripes = self._teaching(volume, tables, self._stripes(volume, tables, lesson=True))
        if witness_px is not None:
            with np.errstate(invalid="ignore"):
                agree = np.abs(stripes.x_px - witness_px) <= AGREE_PX
            stripes = replace(stripes, confidence=np.where(agree, stripes.confidence, np.float32(0)))
        quiet = self._quiet(volume, geometry, tables, stripes)
        ambient = ambient_map(volume, intensity, geometry, quiet)
        width = line_width(volume, tables.sweep, tables.state, stripes, self._workers)
        model = replace(model, line_sigma_px=width or model.line_sigma_px)
        model = learn_again(volume, geometry, model, ambient, stripes, self._workers)
        assert self._memory is not None, "a map has been estimated"
        places = self._memory.places
        model = learn_first_halo(volume, geometry, model, ambient, tables, stripes, places, self._workers)
        if witness_px is not None:
            model = halfway(before, model)
        # Amplitudes are relative to the scale of the model that they are written into.
        weigh_light(volume, tables.sweep, state_of(model), stripes.x_px, places, self._workers)
        self._workers.settle()
        amplitude, weight = amplitudes_of(places, None if witness_px is None else stripes.confidence > TRUSTED)
        return replace(model, amplitude=amplitude, weight=weight), float(np.mean(stripes.confidence > TRUSTED))

    def _by_contrast(self, volume: CountVolume, geometry: SweepGeometry, model: RowModel) -> Float32:
        """x_px (rows, columns) from the costs of `rig.estimate.joint.labels.contrast` alone."""
        setting = LearningSetting(model, geometry, volume.exposures, volume.dark_counts is not None)
        tables = tables_of(setting, self._workers, contrast=True)
        x_px = np.empty(tables.grid.x_far.shape, np.float32)
        self._read(volume, tables, x_px, alone=True)
        self._workers.settle()
        return x_px

    def _teaching(self, volume: CountVolume, tables: JointTables, stripes: StripeTable) -> StripeTable:
        """The stripe table with the trust of `fill_trust` in place of the confidence."""
        memory, trust = self._room(tables.grid), np.empty_like(stripes.confidence)
        self._workers.over(
            len(trust),
            lambda first, last: fill_trust(
                stripes.x_px, stripes.x_sd_px, volume.n_frames, memory.answer.margin, memory.places,
                tables.bright.ambient, first, last, trust,
            ),
        )  # fmt: skip
        return replace(stripes, confidence=trust)

    def _read(self, volume: CountVolume, tables: JointTables, x_px: Float32, *, alone: bool = False) -> None:
        """Fill x_px (rows, columns) with the positions of the best labels, and the answers in memory.

        The last step is only queued. alone: whether costs are those of contrast alone.
        """
        grid, workers = tables.grid, self._workers
        rows, columns = x_px.shape
        memory = self._room(grid)

        def tie_rows(first: int, last: int) -> None:
            # Band by band: rows of a band share tables, and their costs are tied while they are still in the cache.
            if first not in tables.rooms:
                room = tables.costs.room()
                tables.rooms[first] = room, pointers(room)
            _, room_at = tables.rooms[first]
            for band in range(first, last, BAND_ROWS):
                end = min(band + BAND_ROWS, last)
                tables.costs.fill(volume, band, end, room_at, memory.cost)
                if tables.contrast is not None:
                    cost_contrast(volume, tables.contrast, band, end, memory.cost, alone=alone)
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

    def _stripes(self, volume: CountVolume, tables: JointTables, *, lesson: bool = False) -> StripeTable:
        grid, workers, memory = tables.grid, self._workers, self._room(tables.grid)
        x_px = np.empty(grid.x_far.shape, np.float32)
        self._read(volume, tables, x_px)
        seen = volume, tables.sweep, tables.state
        sd = place(*seen, tables.shares, x_px, memory.places, workers, lesson=lesson)
        lit = volume.n_frames > 0
        pairs = tables.pairs if lit.all() else pairs_to_ask(np.isfinite(grid.x_far) & lit)
        return stripe_table(x_px, sd, volume.n_frames, memory.answer, memory.places, pairs, tables.bright, workers)

    def _room(self, grid: LabelGrid) -> Memory:
        memory = self._memory
        if memory is None or not memory.fits(grid):
            memory = self._memory = memory_for(grid)
        return memory

    def _seen(self, volume: CountVolume, geometry: SweepGeometry, tables: JointTables, stripes: StripeTable) -> Seen:
        assert self._memory is not None, "a map has been estimated"
        quiet = self._quiet(volume, geometry, tables, stripes)
        lines = lines_of(volume, next_lattice(geometry), stripes)
        bright = bright_lines(volume, tables, stripes, self._memory.places, self._workers)
        return Seen(volume, volume.intensity(self._workers), quiet, lines, bright)

    def _quiet(
        self, volume: CountVolume, geometry: SweepGeometry, tables: JointTables, stripes: StripeTable
    ) -> Float64:
        quiet = np.zeros((2, geometry.rows, geometry.width))
        most_light = float(np.median(tables.state.ambient))

        def work(first: int, last: int) -> None:
            add_quiet(
                volume.counts, volume.n_frames, tables.sweep, tables.state, tables.halo, stripes.x_px, stripes.signal,
                stripes.confidence, QUIET_COLUMNS if tables.dark else 1, most_light, first, last, quiet,
            )  # fmt: skip

        self._workers.over(geometry.rows, work)
        return quiet
