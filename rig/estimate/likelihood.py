"""Estimator `likelihood`: maximum likelihood of 'haze, stripe, then less' on every row. The medium is learned.

The likelihood itself: `rig.estimate.row.likelihood`; the search along a row: `rig.estimate.search.rows`; the model and
how it is learned: `rig.estimate.row.model`, `rig.estimate.row.em`, `rig.estimate.online_learning`; the confidence of an
answer, from its neighbours: `rig.estimate.row.confidence`. The first map is counted completely and estimated twice,
because the first estimate shows which pixels lie behind the stripe, and these show the ambient light. Every later map
is estimated with a model learned from earlier maps alone: column by column while its frames come in, or when it is
complete if its columns have more than BYTE_EXPOSURES exposures.
"""

import numpy as np

from rig.count.volume import BYTE_EXPOSURES, Counter, CountVolume, SweepCounter, SweepLayout
from rig.estimate.online_learning import LearningSetting, LessonInput, OnlineLearner, first_model
from rig.estimate.row.confidence import believed
from rig.estimate.row.em import lines_of, next_lattice
from rig.estimate.row.model import RowModel, line_profile
from rig.estimate.search.prepare import judge_of, signal_reach
from rig.estimate.search.rows import SearchTables
from rig.estimate.search.stream import ColumnJudge, SearchedSweep, search_volume
from rig.geometry.stripe_table import StripeTable
from rig.geometry.windows import SweepGeometry
from rig.simd import Float32, Float64, Int32, Uint8
from rig.threads import RowWorkers


class Likelihood:
    """Row likelihood with the state it has learned so far.

    Pass `model` to estimate a map again with the state that it was estimated with: the result is the same bit for bit.
    learns: whether later maps change that state.
    """

    def __init__(self, threads: int = 2, model: RowModel | None = None, *, learns: bool = True) -> None:
        self._workers = RowWorkers(threads)
        self._lessons = OnlineLearner(_judge, model, learns=learns)
        self._at: tuple[SweepGeometry, Float32] | None = None
        self._light: tuple[RowModel, float, int] | None = None
        self.used: RowModel | None = None
        """The state that the last map was estimated with."""

    @property
    def model(self) -> RowModel | None:
        """The state with which the next map will be estimated; None until a map was good enough to learn from."""
        return self._lessons.model

    @model.setter
    def model(self, model: RowModel) -> None:
        self._lessons.model = model

    def counter(self, layout: SweepLayout, geometry: SweepGeometry) -> Counter:
        """A counter whose finished sweeps go to `estimate`. geometry: the nominal one, which holds for every sweep."""
        return _LikelihoodCounter(self, layout, geometry, self._workers)

    def estimate(self, sweep: CountVolume | SearchedSweep, geometry: SweepGeometry) -> StripeTable:
        """Stripe table of one sweep. Afterwards `model` is the state for the next sweep. Raises UsageError if `model`
        was learned from a sweep of another size, and what a failed lesson raised."""
        if isinstance(sweep, SearchedSweep):
            assert self.model is not None, "a sweep is judged under a model"
            used, found = self.model, sweep.stripe
            quiet, lines = sweep.quiet, sweep.lines
        else:
            used = self._lessons.model_for(lambda: first_model(sweep, geometry, self._workers))
            setting = LearningSetting(used, geometry, sweep.exposures, sweep.dark_counts is not None)
            found, quiet = search_volume(sweep, geometry, self._lessons.tables(setting, self._workers), self._workers)
            lines = lines_of(sweep, next_lattice(geometry))
        self.used = used
        # Learning goes row by row, so by each row's own confidence, without its neighbours.
        self._lessons.attend(
            found, used, int(sweep.n_frames.sum()), lambda: LessonInput(sweep, sweep.intensity(), quiet, lines)
        )
        return believed(found, self._reference(geometry), sweep.n_frames, *self._light_of(used), self._workers)

    def _reference(self, geometry: SweepGeometry) -> Float32:
        """The geometry's `reference_px`, computed once while the geometry stays the same."""
        if self._at is None or self._at[0] is not geometry:
            self._at = geometry, geometry.reference_px().astype(np.float32)
        return self._at[1]

    def _light_of(self, model: RowModel) -> tuple[float, int]:
        """A model's median ambient light, and the number of pixels over which a stripe's light is summed."""
        if self._light is None or self._light[0] is not model:
            line_px = 2 * signal_reach(line_profile(model.line_sigma_px)) + 1
            self._light = model, float(np.median(model.ambient)), line_px
        return self._light[1:]

    def judge(self, geometry: SweepGeometry, exposures: int, *, dark: bool) -> SearchTables:
        """Tables of the search under the present model, made again only when something has changed."""
        assert self.model is not None, "the first map is learned from counts"
        return self._lessons.tables(LearningSetting(self.model, geometry, exposures, dark), self._workers)


def _judge(setting: LearningSetting, workers: RowWorkers) -> SearchTables:
    return judge_of(setting.model, setting.geometry, setting.exposures, workers, dark=setting.dark)


class _LikelihoodCounter:
    """Counts whole sweeps if there is no model or over BYTE_EXPOSURES exposures; else judges columns as they come."""

    def __init__(self, of: Likelihood, layout: SweepLayout, geometry: SweepGeometry, workers: RowWorkers) -> None:
        self._of, self._layout, self._geometry, self._workers = of, layout, geometry, workers
        self._counter: SweepCounter | ColumnJudge | None = None
        self._memory: ColumnJudge | None = None

    def reset(self) -> None:
        """Begin the next sweep."""
        self._counter = None

    def add(self, bits: Uint8, bins: Int32, column: Float64, x0: Int32) -> None:
        """Add frames as in `Counter`."""
        self._present().add(bits, bins, column, x0)

    def settle(self, under_way: int = 0) -> None:
        """See `Counter`."""
        if self._counter is not None:
            self._counter.settle(under_way)

    def finish(self) -> CountVolume | SearchedSweep:
        """Counts of the sweep, or its stripes if its columns were judged on the way."""
        return self._present().finish()

    def _present(self) -> SweepCounter | ColumnJudge:
        # Chosen with the first frames: only then has the sweep before been estimated and learned from.
        if self._counter is None:
            layout = self._layout
            if self._of.model is None or layout.exposures > BYTE_EXPOSURES:
                self._counter = SweepCounter(layout, self._workers)
            else:
                judge = self._of.judge(self._geometry, layout.exposures, dark=layout.dark)
                if self._memory is None:
                    self._memory = ColumnJudge(layout, self._geometry, judge, self._workers)
                else:
                    self._memory.begin(judge)
                self._counter = self._memory
        return self._counter
