"""Estimator `likelihood`: maximum likelihood of 'haze, stripe, then less' on every row, told nothing of the medium.

Search along a row: `row_search`; what it knows and how that is learned: `row_model`, `learning`. The first map is
counted whole and estimated twice (the first pass finds which pixels were quiet behind the stripe). Every later map is
judged column by column while its frames come in, with what earlier maps taught: it depends on nothing inside itself.
Now and then a map teaches, on a thread beside the stream, and is heeded a fixed number of frames later, so that a live
scan never waits and results do not depend on speed.
"""

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rig.counting import BYTE_EXPOSURES, Counter, CountVolume, FrameTally, SweepCounter, SweepLayout
from rig.estimators.ambient import ambient_map
from rig.estimators.judging import judge_of, nothing_found, quiet_of, stripes_of
from rig.estimators.learning import Expectation, learn_first, learn_next, lines_of, next_lattice
from rig.estimators.row_input import Lines
from rig.estimators.row_model import RowModel
from rig.estimators.search_buffers import search_memory
from rig.estimators.search_desk import Judge
from rig.estimators.stream import ColumnJudge, SearchedSweep
from rig.estimators.stream_kernels import search_counts
from rig.geometry import SweepGeometry
from rig.lane_order import padded_lanes
from rig.row_threads import RowWorkers, yield_to_others
from rig.stripes import StripeTable

LEAST_SURE = 0.02
"""Share of confident answers below which a map teaches nothing: a closed shutter must not spoil the maps after it."""
TEACH_FRAMES = 100_000
"""Lit frames from one map that teaches to the next: a second at 100 kHz. Learning costs some 0.2 s of one core."""
LAG_FRAMES = 50_000
"""Lit frames from a map that teaches to the first one judged with what it taught: time to learn beside the stream."""


class Likelihood:
    """Row likelihood with the state it has learned so far; `model` is None before a map that taught.

    Pass `model` to estimate a map again with the state that it was estimated with: the result is the same bit for bit.
    learns: whether later maps change that state.
    """

    def __init__(self, threads: int = 2, model: RowModel | None = None, *, learns: bool = True) -> None:
        self._workers = RowWorkers(threads)
        self._learns = learns
        self.model = model
        self.used: RowModel | None = None
        """The state that the last map was estimated with."""
        self._judge: tuple[_JudgeKey, Judge] | None = None
        self._taught: Expectation | None = None
        self._lesson: Future[_Lesson] | None = None
        self._tutor = ThreadPoolExecutor(1, thread_name_prefix="learning", initializer=yield_to_others)
        self._frames_since = 0
        """Lit frames since the last map that taught."""

    def counter(self, layout: SweepLayout, geometry: SweepGeometry) -> Counter:
        """A counter whose sweeps `estimate` takes; geometry: nominal, as of every sweep."""
        return _LikelihoodCounter(self, layout, geometry, self._workers)

    def estimate(self, sweep: CountVolume | SearchedSweep, geometry: SweepGeometry) -> StripeTable:
        """Stripe table of one sweep; afterwards `model` is what the next sweep will be estimated with."""
        if isinstance(sweep, SearchedSweep):
            stripes, quiet, lines = sweep.stripe, sweep.quiet, sweep.lines
            assert self.model is not None, "a sweep is judged under a model"
            self.used = self.model
        else:
            self.used = self.model if self.model is not None else self._first_model(sweep, geometry)
            stripes, quiet = self._search(sweep, geometry, self.used)
            lines = lines_of(sweep, next_lattice(geometry))
        self._frames_since += int(sweep.n_frames.sum())
        sure = bool(np.mean(stripes.confidence > 0.5) >= LEAST_SURE)
        if sure and self.model is None:
            self.model = self.used
        if self._lesson is None:
            if self._learns and sure and self._frames_since >= TEACH_FRAMES:
                self._frames_since = 0
                assert self._judge is not None, "a map has been judged"
                self._lesson = self._tutor.submit(
                    _teach, self.used, self._taught, sweep, sweep.intensity(), self._judge[0], quiet, lines
                )
        elif self._frames_since >= LAG_FRAMES:
            # Waits where the lesson is not over: which map is judged with what never depends on speed.
            self.model, self._taught, self._judge = self._lesson.result()
            self._lesson = None
        return stripes

    def judge(self, geometry: SweepGeometry, exposures: int, *, dark: bool) -> Judge:
        """What the search under the present model reads; made once per model."""
        assert self.model is not None, "the first map is learned from counts"
        return self._judge_of(self.model, geometry, exposures, dark=dark)

    def _judge_of(self, model: RowModel, geometry: SweepGeometry, exposures: int, *, dark: bool) -> Judge:
        key = _JudgeKey(model, geometry, exposures, dark)
        if self._judge is None or not self._judge[0].same(key):
            self._judge = key, judge_of(model, geometry, exposures, self._workers, dark=dark)
        return self._judge[1]

    def _first_model(self, volume: CountVolume, geometry: SweepGeometry) -> RowModel:
        intensity = volume.intensity()
        model = learn_first(volume, geometry, ambient_map(volume, intensity, geometry, None), self._workers)
        _, quiet = self._search(volume, geometry, model)
        model = replace(model, ambient=ambient_map(volume, intensity, geometry, quiet))
        lines = lines_of(volume, next_lattice(geometry))
        return learn_next(lines, geometry, model, None, self._workers)[0]

    def _search(
        self, volume: CountVolume, geometry: SweepGeometry, model: RowModel
    ) -> tuple[StripeTable, NDArray[np.float64]]:
        """Stripes under `model`, and the ones and exposures of pixels behind clear stripes (2, rows, width)."""
        exposures = volume.exposures
        if exposures is None:
            frames = volume.n_frames[volume.n_frames > 0]
            exposures = int(np.median(frames)) if len(frames) else 1
        judge = self._judge_of(model, geometry, exposures, dark=volume.dark_counts is not None)
        found = nothing_found(geometry, None)

        def work(first: int, last: int) -> None:
            memory = search_memory(padded_lanes(geometry.window))
            search_counts(volume.counts, volume.n_frames, judge, memory, found, first, last)

        self._workers.over(geometry.rows, work)
        return stripes_of(found, judge, self._workers), quiet_of(found, geometry.width)


def _teach(
    model: RowModel,
    before: Expectation | None,
    tally: FrameTally,
    intensity: NDArray[np.uint32],
    key: "_JudgeKey",
    quiet: NDArray[np.float64],
    lines: Lines,
) -> "_Lesson":
    """The model carried on by one sweep, and the judge that follows from it, on one thread beside the stream."""
    model = replace(model, ambient=ambient_map(tally, intensity, key.geometry, quiet))
    with RowWorkers(1) as workers:
        model, taught = learn_next(lines, key.geometry, model, before, workers)
        judge = judge_of(model, key.geometry, key.exposures, workers, dark=key.dark)
    return model, taught, (replace(key, model=model), judge)


@dataclass(frozen=True, slots=True, eq=False)
class _JudgeKey:
    """What a judge was made of."""

    model: RowModel
    geometry: SweepGeometry
    exposures: int
    dark: bool

    def same(self, other: "_JudgeKey") -> bool:
        """Whether the other's judge would be the same one."""
        made = self.model is other.model and self.geometry is other.geometry
        return made and (self.exposures, self.dark) == (other.exposures, other.dark)


_Lesson = tuple[RowModel, Expectation, tuple[_JudgeKey, Judge]]


class _LikelihoodCounter:
    """Counts the first sweep whole; judges the columns of every later one as they come."""

    def __init__(self, of: Likelihood, layout: SweepLayout, geometry: SweepGeometry, workers: RowWorkers) -> None:
        self._of = of
        self._layout = layout
        self._geometry = geometry
        self._workers = workers
        self._counter: SweepCounter | ColumnJudge | None = None
        self._memory: ColumnJudge | None = None

    def reset(self) -> None:
        """Begin the next sweep."""
        self._counter = None

    def add(
        self, bits: NDArray[np.uint8], bins: NDArray[np.int32], column: NDArray[np.float64], x0: NDArray[np.int32]
    ) -> None:
        """Add frames, see `Counter`."""
        self._present().add(bits, bins, column, x0)

    def settle(self, under_way: int = 0) -> None:
        """See `Counter`."""
        if self._counter is not None:
            self._counter.settle(under_way)

    def finish(self) -> CountVolume | SearchedSweep:
        """What the sweep gave."""
        return self._present().finish()

    def _present(self) -> SweepCounter | ColumnJudge:
        # Chosen with the first frames: only then has the sweep before this one been estimated and has taught.
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
