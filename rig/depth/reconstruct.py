"""From the counts of a sweep to its map: stripe table, depth map, intensity, fog and doubts."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from calibration.model.rig_model import RigModel
from drivers.cores import cores
from rig.config.models import EstimateConfig
from rig.count.map_checks import MapChecks
from rig.count.volume import Counter, FrameTally, LineCounter, SweepLayout
from rig.depth.depth import DepthMap, depth_map, share_claims
from rig.depth.floating import floating_points
from rig.depth.fog_meter import FogEstimate, read_fog
from rig.errors import UsageError
from rig.estimate.registry import ESTIMATORS, LEARNING, Learned, ManyMaps, create_estimator, is_coupled, recalling
from rig.geometry.line_grid import LineGrid
from rig.geometry.stripe_table import StripeTable
from rig.geometry.windows import SweepGeometry, sweep_geometry, uncalibrated_geometry
from rig.simd import Float32, Float64, Int32
from rig.threads import RowWorkers


@dataclass(frozen=True, slots=True)
class MapResult:
    """One reconstructed map: stripe table, depth, intensity (rows, width) uint32, fog.

    depth_m, confidence, depth_sd_m: float32 (rows, width), as in `rig.depth.depth.DepthMap`: NaN, 0 and NaN where there
    is no depth, which is everywhere without a calibration.
    compute_s: seconds that estimating and making the map took. learned: the state that the estimator used, None if it
    learns nothing. doubts: sentences on why the map may be wrong, judged by its own light (`rig.count.map_checks`) and
    frames (`rig.count.sweep_watch`). floating: number of points left out because they float between two surfaces; None
    if such points are kept, or without depth.
    """

    stripe: StripeTable
    depth_m: Float32
    confidence: Float32
    depth_sd_m: Float32
    intensity: NDArray[np.uint32]
    fog: FogEstimate
    compute_s: float
    learned: Learned | None = None
    doubts: tuple[str, ...] = ()
    floating: int | None = None


def map_geometry(
    model: RigModel | None, column_commands: Sequence[float] | Float64, depth_range_m: tuple[float, float], *,
    sensor: tuple[int, int] | None = None, lines: LineGrid | None = None,
) -> SweepGeometry:  # fmt: skip
    """The geometry for a `Reconstructor`.

    model: rig model; None for an uncalibrated rig, which gives stripes only and needs sensor (rows, width).
    column_commands: (columns,) mirror command of each column's centre. lines: which line lights which column, if there
    are several. Raises UsageError if model and sensor are both None, and the errors of `sweep_geometry`.
    """
    if model is None:
        if sensor is None:
            raise UsageError("without a calibration the sensor size (rows, width) must be given")
        return uncalibrated_geometry(*sensor, len(column_commands))
    geometry = sweep_geometry(model, np.asarray(column_commands, dtype=np.float64), depth_range_m)
    return geometry if lines is None else replace(geometry, others=lines.others(geometry.plane))


class MapUnderWay(NamedTuple):
    """A map that was begun. run: makes the map, on any thread. end: makes the estimator learn from it; called in the
    order of the sweeps."""

    run: Callable[[], MapResult]
    end: Callable[[], None]


class Lane(NamedTuple):
    """Room to make one of several maps at the same time: the estimator's memory, and a thread."""

    solver: Any
    workers: RowWorkers


class MakesMaps(Protocol):
    """The part of a `Reconstructor` that a scan uses. Once the counting thread runs, no other thread calls it."""

    def counter(self, layout: SweepLayout) -> Counter:
        """Make a counter whose sweeps `map` takes."""
        ...

    def map(self, sweep: FrameTally) -> MapResult:
        """Make the map of one counted sweep."""
        ...


class Reconstructor:
    """Turns counted sweeps into maps; estimators that learn carry their state from map to map.

    model, column_commands, lines: the same that were given to `map_geometry`. learned: states kept of earlier maps, one
    for each map to come; each map is then estimated with its own state, and nothing is learned. kept: the state of an
    earlier run, used by `joint` if it explains the first map. Raises KeyError for the estimator `auto`
    (`rig.scan.estimator` chooses one first), and with `learned` for estimators that learn nothing.
    """

    def __init__(
        self,
        model: RigModel | None,
        column_commands: Sequence[float] | Float64,
        geometry: SweepGeometry,
        estimate: EstimateConfig,
        *,
        learned: Sequence[Learned] = (),
        kept: Learned | None = None,
        lines: LineGrid | None = None,
    ) -> None:
        self.geometry = geometry
        self._model = model
        self._commands = np.asarray(column_commands, dtype=np.float64)
        self._min_confidence = estimate.min_confidence
        self._keep_floating = estimate.keep_floating
        self._filter = estimate.filter
        self._name = estimate.estimator
        self._coupled = is_coupled(self._name)
        self._lines = lines
        threads = estimate.threads or cores()
        self._workers = RowWorkers(threads)
        prior = estimate.temporal_prior
        if learned:
            self.estimator = recalling(estimate.estimator, learned, threads, temporal_prior=prior)
        else:
            self.estimator = create_estimator(estimate.estimator, threads, temporal_prior=prior, kept=kept)
        self._fog_lines: tuple[Int32, Int32] | None = None
        self._checks = MapChecks(geometry, calibrated=model is not None, knows=estimate.estimator in LEARNING)

    @property
    def state(self) -> Learned | None:
        """The state for the next map; None if nothing has been learned."""
        state: Learned | None = getattr(self.estimator, "model", None)  # not every estimator has one
        return state

    @property
    def kept_serves(self) -> bool:
        """Whether the first map was estimated with the state of an earlier run."""
        return bool(getattr(self.estimator, "kept_serves", False))

    def counter(self, layout: SweepLayout) -> Counter:
        """A counter whose sweeps go to `map`, one after the other and each before frames of the next are added."""
        if self._lines is not None:
            return LineCounter(layout, self._lines, self._workers)
        return self.estimator.counter(layout, self.geometry)

    def map(self, sweep: FrameTally) -> MapResult:
        """Make the map of one counted sweep; its `compute_s` covers the estimate and all that follows it.

        sweep: the result of a `counter`, or a `CountVolume`. Raises UsageError if an estimator of another package gives
        a stripe table that is not valid.
        """
        begun = time.perf_counter()
        try:
            stripe = self.estimator.estimate(sweep, self.geometry)
        except Exception as error:
            if self._name not in ESTIMATORS:
                error.add_note(f"raised by the estimator {self._name} of another package: tell its authors")
            raise
        return self.complete(stripe, sweep, self._filter, time.perf_counter() - begun)

    def lanes(self) -> list[Lane]:
        """Room for the maps that can be made at the same time; empty if they have to be made one by one."""
        if not isinstance(self.estimator, ManyMaps):
            return []
        n = min(self._workers.threads, self.estimator.most_at_once(self.geometry))
        return [Lane(self.estimator.solver(), RowWorkers(1)) for _ in range(n)] if n > 1 else []

    def may_begin(self, frames: int) -> bool:
        """Whether the next map may be begun while maps with `frames` lit frames in total are under way. Only with
        `lanes`."""
        assert isinstance(self.estimator, ManyMaps), "it has lanes"
        return self.estimator.may_begin(frames)

    def begin(self, sweep: FrameTally, lane: Lane) -> MapUnderWay:
        """Begin the map of a sweep. lane: used by no other map until the map's `end` is called."""
        assert isinstance(self.estimator, ManyMaps), "it has lanes"
        work = self.estimator.begin(sweep, self.geometry, lane.solver)

        def complete() -> MapResult:
            begun = time.perf_counter()
            stripe = work.run()
            estimate_s = time.perf_counter() - begun
            return self.completed(stripe, sweep, self._filter, estimate_s, work.used, lane.workers)

        return MapUnderWay(complete, partial(self.estimator.end, work))

    def complete(self, stripe: StripeTable, sweep: FrameTally, filter: str, estimate_s: float) -> MapResult:
        """Make the map of a sweep from its stripe table: filter, depth without floating points, intensity, fog, doubts.

        estimate_s: the time that the estimator took for the table."""
        return self.completed(stripe, sweep, filter, estimate_s, self.estimator.used, self._workers)

    def completed(
        self, stripe: StripeTable, sweep: FrameTally, filter: str, estimate_s: float, used: Learned | None,
        workers: RowWorkers,
    ) -> MapResult:  # fmt: skip
        """Do the work of `complete` for a stripe table estimated with the state `used`; on any thread. Raises
        UsageError as `map` does."""
        begun = time.perf_counter() - estimate_s
        geometry = self._bound(sweep)
        if self._name not in ESTIMATORS and (problem := stripe.problem(geometry.rows, geometry.columns)):
            raise UsageError(
                f"estimator {self._name} gives {problem}; correct it: docs/how-to/plugin.md says what it owes"
            )
        fog, intensity = self._fog(sweep, stripe, used), sweep.intensity(workers)
        doubts, checked = self._checks.check(sweep, intensity, stripe)
        doubts = (*sweep.doubts, *doubts)
        if filter == "median":
            from rig.estimate.median import median_filter

            filtered = median_filter(checked, geometry.reference_px(), coupled=self._coupled)
            # What the checks doubt is not to be believed again because of its neighbours.
            most = np.where(checked.confidence < stripe.confidence, checked.confidence, np.float32(1))
            checked = replace(filtered, confidence=np.minimum(filtered.confidence, most))
        stripe = checked
        if self._lines is not None:  # after the filter, which makes answers surer
            stripe = share_claims(stripe, self._lines)
        floating: int | None = None
        if self._model is None:
            depth = DepthMap.empty(geometry.rows, geometry.width)
        else:
            depth = depth_map(stripe, geometry, self._min_confidence, workers)
            if not self._keep_floating:
                floats = floating_points(depth.depth_m, geometry.px_per_inverse_depth(), workers)
                depth, floating = depth.without(floats), int(np.count_nonzero(floats))
        compute_s = time.perf_counter() - begun
        return MapResult(stripe, *depth, intensity, fog, compute_s, used, doubts, floating)

    def _bound(self, sweep: FrameTally) -> SweepGeometry:
        """Geometry with the planes at which the frames of each column were actually taken."""
        if self._model is None:
            return self.geometry
        column = sweep.bound_column()
        if self._lines is None:
            commands = np.interp(column, np.arange(len(self._commands)), self._commands)
        else:
            commands = self._lines.bound_commands(self._commands, column)
        return self.geometry.bound_to(self._model, commands, sweep.velocity_per_s)

    def _fog(self, sweep: FrameTally, stripe: StripeTable, state: Learned | None) -> FogEstimate:
        """Fog of the map; an empty estimate if its estimator learns no haze, or without a calibration."""
        if state is None or self._model is None:
            return FogEstimate()
        from rig.estimate.row.em import next_lattice

        if self._fog_lines is None:  # they are always the same, and take a while to find
            self._fog_lines = next_lattice(self.geometry)
        return read_fog(sweep, stripe, self.geometry, state, self._fog_lines)
