"""One simulated scan that serves several estimators: its frames are kept, and every estimator makes its maps from them.

Estimators learn from the first map. The frames of the last one are counted and estimated when the SPAD has stopped, so
that times do not include the simulation, as on a rig whose frames are not computed by the same machine. Only the pixels
that the plan uses are kept, as with a SPAD that sends windows. Begin reading at `score_methods`.
"""

import statistics
import time
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from rig.config.models import RigConfig
from rig.count.volume import Counter, FrameTally, SweepLayout, SweepTally
from rig.depth.reconstruct import MapResult, Reconstructor
from rig.depth.warm_up import warm_binding, warm_up
from rig.devices.open import open_rig
from rig.devices.prepare import prepare
from rig.errors import UsageError
from rig.estimate.registry import LEARNING
from rig.geometry.stripe_table import StripeTable
from rig.geometry.windows import WORD_PX
from rig.scan.acquisition import Acquisition, AcquisitionRequest
from rig.scan.scan import make_reconstructor
from rig.tradeoff.rows import Place, TradeoffRow, TrialSetting, score_map

MAPS = 2
"""Maps of a scan: estimators learn from the first one, the last one is scored."""
TIMED_PASSES = 3
"""Largest number of passes over the last map; its time is their median."""
LONG_S = 1.0
"""Seconds after which no further pass begins."""
MOST_KEPT_BYTES = 2_000_000_000
"""Most bytes of frames of one sweep in memory."""

Block = tuple[NDArray[np.uint8], NDArray[np.int32], NDArray[np.float64], NDArray[np.int32]]
"""Arguments of `Counter.add`: bits, bins, columns, x0."""
Method = tuple[str, str]
"""Estimator and filter."""


@dataclass(frozen=True, slots=True, kw_only=True)
class KeptSweep(FrameTally):
    """A counted sweep with its frames."""

    blocks: list[Block]


class FrameKeeper:
    """A `Counter` that keeps the frames of a sweep, cut to the pixels that the plan uses."""

    def __init__(self, layout: SweepLayout) -> None:
        self._layout = layout
        self.reset()

    def reset(self) -> None:
        """Begin the next sweep."""
        self._tally = SweepTally(self._layout)
        self._blocks: list[Block] = []

    def add(
        self, bits: NDArray[np.uint8], bins: NDArray[np.int32], column: NDArray[np.float64], x0: NDArray[np.int32]
    ) -> None:
        """Keep frames, with arguments as in `Counter`."""
        self._tally.note(bins, column, x0 // np.int32(WORD_PX))
        self._blocks.append((self._used(bits, x0), bins.copy(), column.copy(), x0.copy()))

    def settle(self, under_way: int = 0) -> None:
        """Do nothing, since `add` copies its frames."""

    def finish(self) -> KeptSweep:
        """The sweep with its frames."""
        tally = self._tally.finish()
        return KeptSweep(
            n_frames=tally.n_frames, column=tally.column, dark_counts=tally.dark_counts, n_dark=tally.n_dark,
            width=tally.width, dark_frames=tally.dark_frames, blocks=self._blocks,
        )  # fmt: skip

    def _used(self, bits: NDArray[np.uint8], x0: NDArray[np.int32]) -> NDArray[np.uint8]:
        frames, rows, row_bytes = bits.shape
        used_bytes = self._layout.used_words * WORD_PX // 8
        if row_bytes == used_bytes:
            return bits.copy()
        used = np.empty((frames, rows, used_bytes), np.uint8)
        ends = np.flatnonzero(np.diff(x0, append=-1)) + 1
        for first, end in zip((0, *ends[:-1]), ends, strict=True):
            begin = int(x0[first]) // 8
            used[first:end] = bits[first:end, :, begin : begin + used_bytes]
        return used


class ManyMakers:
    """Makes maps of several estimators and filters from the same frames; used in place of a `Reconstructor`."""

    def __init__(self, makers: Mapping[str, Reconstructor], filters: Sequence[str]) -> None:
        self._makers = makers
        self._filters = filters
        self._counters: dict[str, Counter] = {}
        self._maps = 0
        self.results: dict[Method, tuple[MapResult, float]] = {}
        """Result of each method for the last map, with the seconds that counting and estimating took."""

    def counter(self, layout: SweepLayout) -> FrameKeeper:
        """Make the counter that keeps the frames."""
        self._counters = {name: maker.counter(layout) for name, maker in self._makers.items()}
        return FrameKeeper(layout)

    def map(self, sweep: FrameTally) -> MapResult:
        """Learn from the first map, and make the last one with all methods; returns one of the maps."""
        assert isinstance(sweep, KeptSweep), "made by the counter above"
        self._maps += 1
        last = self._maps == MAPS
        names = list(self._makers)
        if not last:  # the others have nothing to learn
            names = [name for name in names if name in LEARNING] or names[:1]
        for name in names:
            made = self._timed(name, sweep, TIMED_PASSES if last else 1)
            self.results |= {(name, filter): each for filter, each in made.items()} if last else {}
        sweep.blocks.clear()  # the next sweep's frames need the memory
        return next(iter(made.values()))[0]

    def _timed(self, name: str, sweep: KeptSweep, passes: int) -> dict[str, tuple[MapResult, float]]:
        """Results of the first pass by filter, each with the median of the seconds that the passes took."""
        begun = time.perf_counter()
        made = [self._all_filters(name, sweep)]
        while len(made) < passes and time.perf_counter() - begun < LONG_S:
            made.append(self._all_filters(name, sweep))
        return {
            filter: (made[0][filter], statistics.median(each[filter].compute_s for each in made)) for filter in made[0]
        }

    def _all_filters(self, name: str, sweep: KeptSweep) -> dict[str, MapResult]:
        stripe, counted, estimate_s = self._estimate(name, sweep)
        return {filter: self._makers[name].complete(stripe, counted, filter, estimate_s) for filter in self._filters}

    def _estimate(self, name: str, sweep: KeptSweep) -> tuple[StripeTable, FrameTally, float]:
        """Stripe table, counted sweep, and the seconds that counting and estimating took."""
        maker, counter = self._makers[name], self._counters[name]
        begun = time.perf_counter()
        counter.reset()
        for block in sweep.blocks:
            counter.add(*block)
        counted = replace(counter.finish(), velocity_per_s=sweep.velocity_per_s)
        stripe = maker.estimator.estimate(counted, maker.geometry)
        return stripe, counted, time.perf_counter() - begun


def score_methods(
    config: RigConfig, place: Place, estimators: Sequence[str], filters: Sequence[str], seed: int
) -> list[TradeoffRow]:
    """Scan once with a simulated rig and score the map that each estimator and filter makes from the same frames.
    Raises UsageError if the scan cannot be done or the line is nowhere seen."""
    with open_rig(config, seed=seed) as rig:
        assert rig.world is not None, "only simulated rigs are tried"
        plan, timing = prepare(rig)
        for method in product(estimators, filters):
            warm_up(*method, plan.exposures, dark=True)
        warm_binding(plan)
        estimate = rig.config.estimate
        settings = {name: estimate.model_copy(update={"estimator": name}) for name in estimators}
        makers = {name: make_reconstructor(rig, plan, each) for name, each in settings.items()}
        maker = ManyMakers(makers, filters)
        request = AcquisitionRequest(maps=MAPS, learns=not LEARNING.isdisjoint(estimators))
        running = Acquisition(rig, plan, timing, maker, request).run()
        with closing(running):
            last = [found for found in running][-1]
        time_s = plan.column_time_s(last.column, last.sweep.direction, last.sweep.first_frame)
        commands, velocity_per_s = plan.line_commands(last.column), plan.velocity_per_s(last.sweep.direction)
        truth = rig.world.truth(commands, velocity_per_s, time_s)
    expected = last.sweep.frames.expected
    sensor_ms = 1e3 * (expected / float(plan.frame_rate_hz) + plan.readout_s(expected))
    exposures, lines = config.scan.exposures, len(config.line_offsets)
    return [
        score_map(place, TrialSetting(*method, exposures, lines), result, truth, sensor_ms, 1e3 * compute_s)
        for method, (result, compute_s) in maker.results.items()
    ]


def require_plan(config: RigConfig) -> None:
    """Raise UsageError if the config's scan cannot be done, or has too many frames to be kept."""
    with open_rig(config) as rig:
        plan, _ = prepare(rig)
    frame = plan.rows * (plan.used_px or plan.width) // 8
    kept = float(plan.frames_per_sweep) * frame
    if kept > MOST_KEPT_BYTES:
        most = int(plan.exposures * MOST_KEPT_BYTES / kept)
        raise UsageError(
            f"{plan.exposures} exposures make {kept / 1e9:.3g} GB of frames a sweep, at most "
            f"{MOST_KEPT_BYTES / 1e9:g} GB are kept for all estimators; leave out `exposures` above {most}"
        )
