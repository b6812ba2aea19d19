"""Estimator `joint`: the row likelihood tied across rows and columns, for a whole map at a time.

Each label (candidate position) of a row and column (`rig.estimate.joint.labels.grid`) gets a cost from the counts
(`rig.estimate.joint.labels.costs`, a fast form of `rig.estimate.row.likelihood`). The cost includes the halo, if there
is one (light of the stripe that fog scatters to both sides, `rig.estimate.joint.labels.halo_rows`), and the previous
map, if requested (`rig.estimate.joint.temporal`). Under a halo the cost is averaged with a second one that needs no
model of the medium (`rig.estimate.joint.labels.contrast`). Costs are tied to those of the neighbours along four paths
(`rig.estimate.joint.paths`). If columns are close to each other, all neighbours vote on weak answers
(`rig.estimate.joint.vote`). The answer of each row and column is then refined to a position between labels, with the
help of neighbours on its surface (`rig.estimate.joint.place.place`), and gets a confidence
(`rig.estimate.joint.confidence`). Each row is searched for a second stripe (`rig.estimate.joint.second_returns`). The
model of light and medium is first learned row by row, as `likelihood` does, then from the map's own stripes.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rig.count.volume import Counter, CountVolume, SweepCounter, SweepLayout
from rig.estimate.joint.halo import halfway, learn_first_halo, learn_next_halo
from rig.estimate.joint.place.belief import belief_of
from rig.estimate.joint.place.place import amplitudes_of, line_width, weigh_light
from rig.estimate.joint.solver import MapSolver
from rig.estimate.joint.tables import MOST_BYTES, JointTables, bytes_of, grid_of, tables_of
from rig.estimate.joint.temporal import TemporalPrior
from rig.estimate.online_learning import LearningSetting, OnlineLearner, first_model
from rig.estimate.row.ambient import ambient_map
from rig.estimate.row.em import evidence, learn_again, lines_of, next_lattice
from rig.estimate.row.inputs import halo_shares, state_of
from rig.estimate.row.model import RowModel
from rig.geometry.stripe_table import StripeTable
from rig.geometry.windows import SweepGeometry
from rig.simd import Float32
from rig.threads import RowWorkers

LESSONS = 2
"""Number of lessons: times that the first map's stripes are estimated and the model is learned again from them."""
HALO_LESSONS = 3
"""Number of lessons in which stripes are checked by contrast, after a new start: under a halo or with lost stripes."""
KEPT_WORSE = 0.0015
"""Share of the log likelihood by which a kept medium may explain a first sweep worse than the medium learned from that
sweep. Measured: up to 0.0004 in the same fog, 0.001 at 0.8 of the visibility, 0.002 and more in other scenes."""
AGREE_PX = np.float32(1.0)
"""In the lessons that check stripes by contrast, a stripe teaches only if contrast alone puts it this near, in px."""
TRUSTED = np.float32(0.5)
"""An answer teaches if its trust (`fill_trust`) exceeds this. In lessons with contrast only these teach amplitudes; in
all others they limit them."""
COUNTING_THREADS = 4
"""Most threads that count: more only get into each other's way, since counting waits for memory."""
MISLED = 0.2
"""Relative error of the light of a learned fog above which light scattered many times may hide the stripes."""
START_BELIEF = 0.1
"""Belief in the medium learned row by row, which knows no halo, when lessons begin again by contrast: it only decides
between places that look alike."""
LOST = 0.2
"""If a smaller share of answers teaches one of the lessons in fog, light scattered many times may hide the stripes. The
next lesson may have many that agree on a wrong place."""


class Joint:
    """The row likelihood tied to that of the neighbours, with the state that it has learned so far.

    Pass `model` to estimate a map again with the state that it was estimated with: the result is the same bit for bit.
    learns: whether later maps change that state. temporal_prior: whether the last map is a weak prior for the next.
    kept: state of an earlier run, used for the first map if it explains that map's counts.
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
        """Whether the first map was estimated with the kept state; None before that map, or if no state was kept."""
        self._prior = TemporalPrior(temporal_prior)
        self._solver = MapSolver(self._workers, self._prior)
        self.used: RowModel | None = None
        """The state that the last map was estimated with."""
        if model is not None:
            self.model = model

    @property
    def model(self) -> RowModel | None:
        """The state with which the next map will be estimated; None until a map was good enough to learn from."""
        model, before = self._lessons.model, self._prior.before
        return model if model is None or before is None else replace(model, before=before)

    @model.setter
    def model(self, model: RowModel) -> None:
        self._prior.recall(model.before)
        self._lessons.model = model if model.before is None else replace(model, before=None)

    def counter(self, layout: SweepLayout, geometry: SweepGeometry) -> Counter:
        """A counter whose finished sweeps go to `estimate`. geometry: the nominal one, which holds for every sweep.

        Raises UsageError if its maps would take too much memory.
        """
        grid_of(geometry)
        few = self._workers if self._workers.threads <= COUNTING_THREADS else RowWorkers(COUNTING_THREADS)
        return SweepCounter(layout, few)

    def estimate(self, sweep: CountVolume, geometry: SweepGeometry) -> StripeTable:
        """Stripe table of one sweep. Afterwards `model` is the state for the next sweep."""
        work = self.begin(sweep, geometry, self._solver)
        stripes = work.run()
        self.end(work)
        return stripes

    def most_at_once(self, geometry: SweepGeometry) -> int:
        """See `rig.estimate.registry.ManyMaps`; 1 with a temporal prior, 0 if there is only memory for one map."""
        # The estimator itself keeps memory for one map more.
        return 1 if self._prior.on else MOST_BYTES // bytes_of(grid_of(geometry)) - 1

    def solver(self) -> MapSolver:
        """A solver for one of several maps at the same time, which works on the caller's thread."""
        return MapSolver(RowWorkers(1))

    def may_begin(self, frames: int) -> bool:
        """Whether there is a model for the next map that will not change while other maps are under way. frames: number
        of frames that these maps have counted for columns, all together."""
        return self._lessons.certain(frames)

    def begin(self, sweep: CountVolume, geometry: SweepGeometry, solver: MapSolver) -> "MapWork":
        """Begin the map of a sweep, see `rig.estimate.registry.ManyMaps`. The first map's model is learned here.

        Raises UsageError if the model was learned from a sweep of another size, or if maps would take too much memory.
        """
        model = self._lessons.model_for(lambda: self._first_model(sweep, geometry))
        setting = LearningSetting(model, geometry, sweep.exposures, sweep.dark_counts is not None)
        tables = self._lessons.tables(setting, self._workers)
        self._prior.begin(geometry, tables.grid)
        self.used = model if self._prior.before is None else replace(model, before=self._prior.before)
        return MapWork(sweep, setting, tables, solver, self.used)

    def end(self, work: "MapWork") -> None:
        """Take note of a map that `run` has made: afterwards `model` is the state for the next sweep. Call it before
        the map's solver makes another map. Raises what a failed lesson raised."""
        assert work.stripes is not None, "the map has been made"
        sweep, tables, stripes, model = work.sweep, work.tables, work.stripes, work.setting.model
        self._prior.leave(stripes, tables.grid)
        # Whether the first map is good enough to learn from is judged by the trust of its lessons.
        known = self._lessons.model is not None
        judged = stripes if known else work.solver.teaching(sweep, tables, stripes)
        self._lessons.attend(
            judged, model, int(sweep.n_frames.sum()),
            lambda: work.solver.seen(sweep, work.setting.geometry, tables, stripes),
        )  # fmt: skip

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
        fewest = 1.0  # share of answers that taught a lesson
        foggy = bool(model.profile[:, 0].max() > np.median(model.ambient))
        while lessons < (LESSONS if witness_px is None else HALO_LESSONS):
            (taught, teaching, error), lessons = (
                self._taught(volume, intensity, geometry, model, witness_px), lessons + 1
            )  # fmt: skip
            if witness_px is not None and model.halo.any() and taught.halo.any() and taught.belief < model.belief:
                break  # a lesson that explains less of the counts has learned from wrong stripes
            model = taught
            fewest = min(fewest, teaching)
            lost = foggy and lessons == LESSONS and (fewest < LOST or error > MISLED)
            if witness_px is None and (model.halo.any() or lost):
                # Light scattered many times may have misled these lessons: they found a halo, or too few stripes to
                # find one. Begin again, and check stripes by contrast.
                misled = model
                setting = LearningSetting(model, geometry, volume.exposures, volume.dark_counts is not None)
                tables = tables_of(setting, self._workers, contrast=True)
                witness_px, lessons = self._solver.by_contrast(volume, tables), 0
                model = replace(start, belief=START_BELIEF)
        if witness_px is None:
            return replace(model, belief=1.0)
        # Lost stripes prove no halo. Without a halo, nothing has to be learned by contrast.
        return model if model.halo.any() or misled.halo.any() else replace(misled, belief=1.0)

    def _adapted(
        self, kept: RowModel, fresh: RowModel, volume: CountVolume, geometry: SweepGeometry
    ) -> RowModel | None:
        """The state of an earlier run, adapted to a first sweep; None if it does not explain the sweep's counts.

        fresh: learned row by row from the sweep. A state with a halo is taken over whole, but only if it explains the
        counts better than `fresh`, since a single row cannot tell a halo from haze. From a state without a halo, the
        line's width and the brightness of stripes are taken over if the medium is still the same.
        """
        lines = lines_of(volume, next_lattice(geometry))

        def explains(model: RowModel) -> float:
            return evidence(lines, geometry, model, self._workers)

        if kept.halo.any():
            return kept if explains(kept) > explains(fresh) else None
        profile = np.column_stack([kept.profile[:, :3], fresh.profile[:, 3]]).astype(np.float32)
        medium = replace(fresh, profile=profile, row_gain=kept.row_gain, column_gain=kept.column_gain)
        own = explains(fresh)
        if explains(medium) < own - KEPT_WORSE * abs(own):
            return None
        return replace(fresh, amplitude=kept.amplitude, weight=kept.weight, line_sigma_px=kept.line_sigma_px)

    def _taught(
        self, volume: CountVolume, intensity: NDArray[np.uint32], geometry: SweepGeometry, model: RowModel,
        witness_px: Float32 | None,
    ) -> tuple[RowModel, float, float]:  # fmt: skip
        """The model learned from stripes that are estimated with `model`, the share of answers that teach it, and the
        relative error of its light.

        intensity: of the volume. witness_px: of `by_contrast`, or None; stripes over AGREE_PX from it are left out.
        """
        before, solver = model, self._solver
        setting = LearningSetting(model, geometry, volume.exposures, volume.dark_counts is not None)
        tables = tables_of(setting, self._workers, contrast=witness_px is not None)
        stripes = solver.teaching(volume, tables, solver.stripes(volume, tables, lesson=True))
        if witness_px is not None:
            with np.errstate(invalid="ignore"):
                agree = np.abs(stripes.x_px - witness_px) <= AGREE_PX
            stripes = replace(stripes, confidence=np.where(agree, stripes.confidence, np.float32(0)))
        quiet = solver.quiet(volume, geometry, tables, stripes)
        ambient = ambient_map(volume, intensity, geometry, quiet)
        width = line_width(volume, tables.sweep, tables.state, stripes, self._workers)
        model = replace(model, line_sigma_px=width or model.line_sigma_px)
        model = learn_again(volume, geometry, model, ambient, stripes, self._workers)
        places = solver.places
        model = learn_first_halo(volume, geometry, model, ambient, tables, stripes, places, self._workers)
        if witness_px is not None:
            model = halfway(before, model)
        # Amplitudes are relative to the scale of the model that they are written into.
        weigh_light(volume, tables.sweep, state_of(model), stripes.x_px, places, self._workers)
        self._workers.settle()
        certain = stripes.confidence > TRUSTED
        amplitude, weight = amplitudes_of(places, certain, others=witness_px is None)
        lines = lines_of(volume, next_lattice(geometry), stripes)
        shares = halo_shares(model, geometry.width if model.halo.any() else 0)
        light = places.light[lines.row, lines.column]
        belief, error = belief_of(
            lines, light, tables.sweep, state_of(model), shares, model.hot_flux(), self._workers
        )  # fmt: skip
        model = replace(model, amplitude=amplitude, weight=weight, belief=belief)
        return model, float(np.mean(certain)), error


@dataclass(slots=True, eq=False)
class MapWork:
    """A map under way: counts, the model and its tables, and a solver.

    used: the model with the last map's labels, if they are a prior. stripes: None until `run` has made them.
    """

    sweep: CountVolume
    setting: LearningSetting
    tables: JointTables
    solver: MapSolver
    used: RowModel
    stripes: StripeTable | None = None

    def run(self) -> StripeTable:
        """Make the stripe table."""
        self.stripes = self.solver.map(self.sweep, self.tables)
        return self.stripes
