"""Stripe estimators by name. An estimator turns the counts of a sweep into a stripe table.

Estimators of other packages are entry points of the group `spadrig.estimator`. Each loads an `EstimatorKind`.

`create_estimator` makes one that has learned nothing yet. `recalling` makes one that estimates earlier maps again, bit
for bit, from the learned state that was kept with each of them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

from drivers.optional_packages import added
from rig.config.estimators import ESTIMATORS as ESTIMATORS
from rig.config.estimators import SLOT
from rig.errors import UsageError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from rig.count.volume import Counter, SweepLayout
    from rig.geometry.stripe_table import StripeTable
    from rig.geometry.windows import SweepGeometry

FILTERS = ("none", "median")
LEARNING = frozenset({"likelihood", "joint"})
"""Estimators that learn from the stream. Their first map takes much longer than later ones."""
COUPLED = frozenset({"joint"})
"""Estimators of this program in which neighbours influence each other's answers. See `is_coupled`."""


class Learned(Protocol):
    """State that an estimator has learned. Its extinction is NaN if there was too little haze for a fit. If the fit
    hardly depends on the extinction, the standard deviation is large or infinite."""

    @property
    def extinction_per_m(self) -> float:
        """Extinction of the medium, 1/m."""
        ...

    @property
    def extinction_sd_per_m(self) -> float:
        """Standard deviation of the extinction, 1/m."""
        ...

    def arrays(self) -> "dict[str, NDArray[np.generic]]":
        """Every field that is not None, as an array: enough to estimate the map again bit for bit."""
        ...


class Estimator(Protocol):
    """An estimator; those in LEARNING keep what they have learned for the next map."""

    @property
    def used(self) -> Learned | None:
        """State with which the last map was estimated; None before the first map, or if it learns nothing."""
        ...

    def counter(self, layout: "SweepLayout", geometry: "SweepGeometry") -> "Counter":
        """A counter whose finished sweeps go to `estimate`. geometry: the nominal one, the same for all sweeps."""
        ...

    def estimate(self, sweep: Any, geometry: "SweepGeometry") -> "StripeTable":
        """Stripe table of one sweep. sweep: the result of a counter of this estimator, or a `CountVolume`."""
        ...


@dataclass(frozen=True, slots=True)
class EstimatorKind:
    """The object that the entry point of an estimator of another package loads.

    create: makes a fresh estimator, given the number of threads that it may use. Its answers must not depend on that
    number. coupled: whether neighbouring rows or columns influence each other's answers.
    """

    create: Callable[[int], Estimator]
    coupled: bool = False


class Work(Protocol):
    """A map under way. used: the state with which it is estimated."""

    used: Learned

    def run(self) -> "StripeTable":
        """Make the stripe table; on any thread."""
        ...


@runtime_checkable
class ManyMaps(Protocol):
    """An estimator that can estimate several maps at the same time."""

    def most_at_once(self, geometry: "SweepGeometry") -> int:
        """Number of maps that can be under way at the same time. If it is less than 2, use `estimate` for each map."""
        ...

    def solver(self) -> Any:
        """Memory for one map at a time. The map is made on the thread that calls `run`."""
        ...

    def may_begin(self, frames: int) -> bool:
        """Whether there is a state for the next map that will not change while other maps are under way. frames: number
        of frames that these maps have counted for columns, all together."""
        ...

    def begin(self, sweep: Any, geometry: "SweepGeometry", solver: Any) -> Work:
        """Begin a map with a solver that no other map uses until `end`. Call the result's `run` on any thread, then
        `end`."""
        ...

    def end(self, work: Any) -> None:
        """Learn from a map that has been made. Call it in the order in which maps were begun."""
        ...


class LearnsFromStream(Estimator, Protocol):
    """An estimator in LEARNING. Its model can be set, to estimate a map again."""

    model: Any
    """The state with which the next map will be estimated, None until a map was good enough to learn from."""


def recalling(name: str, learned: Sequence[Learned], threads: int = 2, *, temporal_prior: bool = False) -> Estimator:
    """An estimator that learns nothing and estimates each map with that map's own state, as `Recalled` does.

    name: one of LEARNING, else KeyError. learned: the maps' states, in order, at least one. temporal_prior: whether the
    maps were made with it.
    """
    return (RecalledMaps if name == "joint" else Recalled)(
        _learning(name, threads, learns=False, temporal_prior=temporal_prior), learned
    )


def create_estimator(
    name: str, threads: int = 2, *, temporal_prior: bool = False, kept: Learned | None = None
) -> Estimator:
    """A fresh estimator that uses up to `threads` threads. name: one of ESTIMATORS, or an estimator of another package;
    raises UsageError if there is none of this name, or it cannot be loaded.

    temporal_prior: whether `joint` uses the last map as a weak prior. kept: the state of an earlier run, with which
    `joint` begins if it explains the first map. The other estimators ignore both.
    """
    if name in LEARNING:
        return _learning(name, threads, learns=True, temporal_prior=temporal_prior, kept=kept)
    if name not in ESTIMATORS:
        return _kind(name).create(threads)
    from rig.estimate.argmax_edge import Peaks

    return {"argmax": Peaks(False, threads), "edge": Peaks(True, threads)}[name]


def estimate_problems(
    estimator: str | None, filter: str | None, min_confidence: float | None, known: Sequence[str]
) -> list[str]:
    """A line for each of these settings that is not allowed. A setting that is None was not given and is no problem.
    known: the estimators that may be named."""
    problems = []
    if estimator is not None and estimator not in known:
        problems.append(f"estimator {estimator!r} is unknown; choose one of {', '.join(known)}")
    if filter is not None and filter not in FILTERS:
        problems.append(f"filter {filter!r} is unknown; choose one of {', '.join(FILTERS)}")
    if min_confidence is not None and not 0 <= min_confidence <= 1:
        problems.append(f"min_confidence is {min_confidence:g}; it is a probability from 0 to 1")
    return problems


def is_coupled(name: str) -> bool:
    """Whether neighbours influence each other's answers with this estimator. If so, their agreement is no further
    evidence. Raises UsageError as `create_estimator` does."""
    return name in COUPLED if name in ESTIMATORS else _kind(name).coupled


def _kind(name: str) -> EstimatorKind:
    from drivers.errors import UnknownKind  # late: shells ask this module for names at every Tab
    from drivers.registry import load_entry

    try:
        return load_entry(SLOT, name, added(f"spadrig.{SLOT}"), EstimatorKind)
    except UnknownKind as error:
        raise UsageError(str(error)) from error


def _learning(name: str, threads: int, *, learns: bool, temporal_prior: bool, kept: Any = None) -> LearnsFromStream:
    if name == "likelihood":
        from rig.estimate.likelihood import Likelihood

        return Likelihood(threads, learns=learns)
    if name != "joint":
        raise KeyError(name)
    from rig.estimate.joint.joint import Joint

    return Joint(threads, learns=learns, temporal_prior=temporal_prior, kept=kept)


class Recalled:
    """Estimates each map with that map's own state, the next of `states` (at least one), and further maps with the last
    state. of: an estimator of LEARNING that does not learn."""

    def __init__(self, of: LearnsFromStream, states: Sequence[Learned]) -> None:
        self._states, self._of = list(states), of
        self._of.model = self._states.pop(0)

    @property
    def used(self) -> Learned | None:
        """State with which the last map was estimated; None before the first map."""
        return self._of.used

    def counter(self, layout: "SweepLayout", geometry: "SweepGeometry") -> "Counter":
        """A counter of the estimator."""
        return self._of.counter(layout, geometry)

    def estimate(self, sweep: Any, geometry: "SweepGeometry") -> "StripeTable":
        """Estimate a map with its own state, then take the next state."""
        stripes = self._of.estimate(sweep, geometry)
        self._take_next()
        return stripes

    def _take_next(self) -> None:
        if self._states:
            self._of.model = self._states.pop(0)


class RecalledMaps(Recalled):
    """A `Recalled` of an estimator that can estimate several maps at the same time."""

    @property
    def _many(self) -> ManyMaps:
        assert isinstance(self._of, ManyMaps), "it is joint"
        return self._of

    def most_at_once(self, geometry: "SweepGeometry") -> int:
        """See `ManyMaps`."""
        return self._many.most_at_once(geometry)

    def solver(self) -> Any:
        """See `ManyMaps`."""
        return self._many.solver()

    def may_begin(self, frames: int) -> bool:
        """True: no map's state depends on the maps under way."""
        return True

    def begin(self, sweep: Any, geometry: "SweepGeometry", solver: Any) -> Work:
        """Begin a map with its own state, then take the next state."""
        work: Work = self._many.begin(sweep, geometry, solver)
        self._take_next()
        return work

    def end(self, work: Any) -> None:
        """Learn nothing."""
