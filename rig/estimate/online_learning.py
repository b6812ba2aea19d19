"""Decides when an estimator learns, and holds the model that it uses meanwhile.

The first map is estimated with a model learned from that map itself. A map is used for learning (a lesson) when
enough frames have come since the last lesson (TEACH_FRAMES) and enough of its answers are confident (LEAST_SURE).
Lessons run on a thread of their own. The new model is used for maps LAG_FRAMES frames or more later, so that a live
scan hardly ever waits and results do not depend on the speed of the machine.
"""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from rig.count.volume import CountVolume, FrameTally
from rig.errors import UsageError
from rig.estimate.row.ambient import ambient_map
from rig.estimate.row.em import Expectation, learn_first, learn_next, lines_of, next_lattice
from rig.estimate.row.inputs import Lines
from rig.estimate.row.model import RowModel
from rig.estimate.search.prepare import judge_of
from rig.estimate.search.stream import search_volume
from rig.geometry.stripe_table import StripeTable
from rig.geometry.windows import SweepGeometry
from rig.simd import Float64
from rig.threads import RowWorkers, yield_to_others

LEAST_SURE = 0.02
"""Least share of answers with a confidence above 0.5 in a map to learn from: a closed shutter teaches nothing."""
TEACH_FRAMES = 100_000
"""Least number of lit frames from one lesson to the next: a second at 100 kHz. Learning costs some 0.2 s of one core,
with the tables of `joint` twice that."""
LAG_FRAMES = 50_000
"""Least number of lit frames from a lesson's map to the first map estimated with the new model: time to learn."""

Tables = TypeVar("Tables")
"""An estimator's tables for one model and one geometry."""


@dataclass(frozen=True, slots=True, eq=False)
class LearningSetting:
    """A model and the kind of sweep for which tables are made.

    exposures: nominal number of frames of a column. dark: whether there are dark frames.

    Raises UsageError if the model was learned from a sweep of another size.
    """

    model: RowModel
    geometry: SweepGeometry
    exposures: int
    dark: bool

    def __post_init__(self) -> None:
        """Check the model's size: kernels do not, and would read beyond the end of a model that is too small."""
        model, geometry = self.model, self.geometry
        size = "{} rows of {} pixels and {} columns".format
        learned = *model.ambient.shape, len(model.column_gain)
        here = geometry.rows, geometry.width, geometry.columns
        if learned != here or len(model.row_gain) != geometry.rows:
            raise UsageError(
                f"the learned state is of {size(*learned)}, the sweep of {size(*here)}; estimate it with a state of "
                "its own, or with none, to learn one from it"
            )

    def same(self, other: "LearningSetting") -> bool:
        """Whether the other setting has the same tables."""
        alike = (self.exposures, self.dark) == (other.exposures, other.dark)
        return alike and self.model is other.model and self.geometry is other.geometry


@dataclass(frozen=True, slots=True, eq=False)
class LessonInput:
    """The part of a sweep that is used for learning.

    tally: of the sweep; intensity: as returned by the tally; quiet: ones and exposures of pixels behind clear stripes,
    see `ambient_map`; lines: counts of the rows and columns of `next_lattice`. more: input of the estimator's own
    `learn_more`, see `OnlineLearner`.
    """

    tally: FrameTally
    intensity: NDArray[np.uint32]
    quiet: Float64
    lines: Lines
    more: Any = None


class OnlineLearner(Generic[Tables]):
    """The model that an estimator uses, None until a map was good enough to learn from, and the tables made for it.

    make: makes tables. learn_more: learns from `more` of a `LessonInput`, in addition to what every estimator learns.
    Both run on the learning thread, `make` also on the caller's. learns: whether later maps change the model.
    """

    def __init__(
        self,
        make: Callable[[LearningSetting, RowWorkers], Tables],
        model: RowModel | None,
        *,
        learns: bool,
        learn_more: Callable[[LearningSetting, Any, RowWorkers], RowModel] | None = None,
    ) -> None:
        self._make = make
        self._learn_more = learn_more
        self._learns = learns
        self.model = model
        self._made: tuple[LearningSetting, Tables] | None = None
        self._taught: Expectation | None = None
        self._lesson: Future[tuple[LearningSetting, Expectation, Tables]] | None = None
        self._tutor = ThreadPoolExecutor(1, thread_name_prefix="learning", initializer=yield_to_others)
        self._frames_since = 0
        """Lit frames since the last lesson's map."""

    def model_for(self, first: Callable[[], RowModel]) -> RowModel:
        """The model with which to estimate a sweep. first: called to learn it from the sweep if there is none yet."""
        return self.model if self.model is not None else first()

    def certain(self, frames: int) -> bool:
        """Whether there is a model that will not change during the next `frames` lit frames."""
        if self.model is None or frames == 0 or not self._learns:
            return self.model is not None
        # A lesson could begin with the first of these maps.
        since = 0 if self._lesson is None else self._frames_since
        return since + frames < LAG_FRAMES

    def tables(self, setting: LearningSetting, workers: RowWorkers) -> Tables:
        """Tables for a setting, made again only when the setting changes."""
        if self._made is None or not self._made[0].same(setting):
            self._made = None  # frees the old tables before new ones are made, unless a map under way uses them
            self._made = setting, self._make(setting, workers)
        return self._made[1]

    def attend(self, stripes: StripeTable, used: RowModel, frames: int, see: Callable[[], LessonInput]) -> None:
        """Take note of a map: begin a lesson from it if one is due, or take over the model of the last lesson when that
        is due; wait for the lesson if it is not over.

        used: the model that the map was estimated with; frames: its lit frames; see: called if the map is used.
        Raises what a failed lesson raised.
        """
        self._frames_since += frames
        sure = bool(np.mean(stripes.confidence > 0.5) >= LEAST_SURE)
        if sure and self.model is None:
            self.model = used
        if self._lesson is None:
            if self._learns and sure and self._frames_since >= TEACH_FRAMES:
                self._frames_since = 0
                assert self._made is not None, "a map has been estimated"
                self._lesson = self._tutor.submit(self._teach, self._made[0], see(), self._taught)
        elif self._frames_since >= LAG_FRAMES:
            # Waits if the lesson is not over: which map is estimated with which model must not depend on speed.
            lesson, self._lesson = self._lesson, None
            setting, self._taught, tables = lesson.result()
            self.model, self._made = setting.model, (setting, tables)

    def _teach(
        self, setting: LearningSetting, seen: LessonInput, before: Expectation | None
    ) -> tuple[LearningSetting, Expectation, Tables]:
        """Learn from one sweep, on the learning thread: the new setting, the sums for the next lesson, new tables."""
        ambient = ambient_map(seen.tally, seen.intensity, setting.geometry, seen.quiet)
        with RowWorkers(1) as workers:
            model = replace(setting.model, ambient=ambient)
            model, taught = learn_next(seen.lines, setting.geometry, model, before, workers)
            setting = replace(setting, model=model)
            if self._learn_more is not None:
                setting = replace(setting, model=self._learn_more(setting, seen.more, workers))
            return setting, taught, self._make(setting, workers)


def first_model(volume: CountVolume, geometry: SweepGeometry, workers: RowWorkers) -> RowModel:
    """The model of a first sweep, learned twice: at first without, then with the ambient light that pixels behind the
    stripes show."""
    intensity = volume.intensity(workers)
    model = learn_first(volume, geometry, ambient_map(volume, intensity, geometry, None), workers)
    dark = volume.dark_counts is not None
    judge = judge_of(model, geometry, volume.exposures, workers, dark=dark)
    _, quiet = search_volume(volume, geometry, judge, workers)
    model = replace(model, ambient=ambient_map(volume, intensity, geometry, quiet))
    return learn_next(lines_of(volume, next_lattice(geometry)), geometry, model, None, workers)[0]
