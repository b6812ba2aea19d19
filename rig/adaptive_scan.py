"""Runs a scan whose maps are taken in passes: each is a start of the SPAD with a compiled plan of its own.

Between two passes the host decides, which takes as long as two estimates: the rig is then as safe as behind any scan
(gate low, laser paused, mirror parked, SPAD stopped), and no frame is exposed. A mirror that scanned on meanwhile would
have to be met in phase by a plan that is not yet known, under a gate that must stay low. So each pass is an
`Acquisition` of one sweep, and what holds for that in every respect of safety holds here.
"""

import time
from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from dataclasses import replace
from typing import Any

import numpy as np

from drivers.interfaces import SpadCounters
from rig.acquisition import SILENCE_S, Acquisition, ScanProgress, added_counters
from rig.adaptive import Pass
from rig.adaptive_counts import add_pass
from rig.adaptive_decision import ChoosesPasses
from rig.counting import CountVolume, SweepCounter, SweepLayout
from rig.fog_meter import FogEstimate
from rig.map_queue import AcquiredMap
from rig.monitor import Watch
from rig.overload import Overload
from rig.reconstruction import MapResult, Reconstructor
from rig.recording.writer import Recording
from rig.row_threads import RowWorkers
from rig.scan_plan import ScanPlan
from rig.session import OpenRig
from rig.stages import PipelineStats
from rig.stripes import StripeTable
from rig.summary import AdaptiveFigures
from rig.sweeps import FrameCounts, SweepAccount, SweepStart

NotePass = Callable[[int, Pass, ScanPlan], None]


class AdaptiveAcquisition:
    """A scan of `maps` maps in the passes that `passes` chooses; as `Acquisition`, iterate once over `run()`.

    whole: the plan of one sweep over all columns. on_pass: called before a pass, with the number of its map and its
    plan. starts: with which sweep the passes of a recording begin; None: it is none. learns: as of `Acquisition`.
    """

    def __init__(
        self,
        rig: OpenRig,
        whole: ScanPlan,
        maps: int,
        reconstructor: Reconstructor,
        passes: ChoosesPasses,
        threads: int,
        *,
        policy: Overload = Overload.ABORT,
        on_pass: NotePass | None = None,
        starts: Iterator[SweepStart] | None = None,
        recording: Recording | None = None,
        watch: Watch | None = None,
        on_progress: Callable[[ScanProgress], None] | None = None,
        learns: bool = False,
        silence_s: float = SILENCE_S,
    ) -> None:
        self._rig = rig
        self._whole = whole
        self._maps = maps
        self._reconstructor = reconstructor
        self._passes = passes
        self._workers = RowWorkers(threads)
        self._policy = policy
        self._on_pass = on_pass
        self._starts = starts
        self._recording = recording
        self._watch = watch
        self._on_progress = on_progress
        self._learns = learns
        self._silence_s = silence_s
        self._frames = 0
        self._done = 0
        self.counters = SpadCounters(0, 0, 0, 0, 0)
        """The SPAD's own counts over all its starts so far."""
        self.stages = PipelineStats()
        """What each stage has done so far."""
        self.taken = 0
        """Passes so far."""
        self.rest_s = 0.0
        """Wall time between passes of a map, in which the host decides and the rig rests."""
        self._wall_s = 0.0

    def run(self) -> Generator[AcquiredMap, None, None]:
        """Scan; yields the maps in order. Raises as `Acquisition.run`."""
        for index in range(self._maps):
            begun = time.perf_counter()
            found = self._map(index)
            self._wall_s += time.perf_counter() - begun
            self._done += 1
            yield found

    def figures(self, lit: int) -> AdaptiveFigures:
        """Of the whole maps, on which so many frames fell."""
        columns = self._done * self._whole.columns
        mean = round(lit / columns, 2) if columns else None
        return AdaptiveFigures(self.taken, mean, round(self.rest_s, 3), round(self._wall_s, 3))

    def _map(self, index: int) -> AcquiredMap:
        counts: CountVolume | None = None
        accounts: list[SweepAccount] = []
        spent_s = count_s = 0.0
        while True:
            begun = time.perf_counter()
            one = self._passes.next(index, len(accounts), counts, spent_s)
            if one is None:
                break
            plan, timing = self._passes.prepare(one)
            if self._on_pass is not None:
                self._on_pass(index, one, plan)
            if accounts:
                self.rest_s += time.perf_counter() - begun
            taken = _PassMaker(self._workers)
            found = self._take(Acquisition(self._rig, plan, timing, 1, taken, **self._settings()))
            assert taken.counts is not None, "a pass that ended without an error was counted"
            counts = taken.counts if counts is None else add_pass(counts, one, taken.counts)
            counts = replace(counts, exposures=None)
            accounts.append(replace(found.sweep, index=index))
            spent_s += _sensor_s(found.sweep, plan)
            count_s += found.compute_s
            self.taken += 1
        assert counts is not None, "there is a first pass"
        self._say("learning" if self._learns and index == 0 else "estimating")
        result = self._reconstructor.map(counts)
        self.stages = replace(self.stages, estimation_s=self.stages.estimation_s + result.compute_s)
        return AcquiredMap(
            _whole_account(accounts), counts.bound_column(), result, count_s + result.compute_s, tuple(accounts)
        )

    def _settings(self) -> dict[str, Any]:
        """What all passes have in common."""
        recorded = self._starts is not None
        return {
            "policy": self._policy,
            "groups": iter([1]) if recorded else None,
            "starts": iter([next(self._starts)]) if self._starts is not None else None,
            "recording": self._recording,
            "watch": self._watch,
            "on_progress": self._tell,
            "silence_s": self._silence_s,
        }

    def _take(self, acquisition: Acquisition) -> AcquiredMap:
        try:
            running = acquisition.run()
            with closing(running):
                (found,) = running
        finally:
            self.counters = added_counters(self.counters, acquisition.counters)
            self.stages = self.stages.and_then(acquisition.stages)
        self._frames += found.sweep.frames.received
        return found

    def _tell(self, now: ScanProgress) -> None:
        self._say(now.stage, now.frames, now.lost, self.stages.and_then(now.stages))

    def _say(self, stage: str, frames: int = 0, lost: int = 0, stages: PipelineStats | None = None) -> None:
        """Of the pass under way so many frames. How many there will be is decided pass by pass."""
        if self._on_progress is None:
            return
        frames += self._frames
        planned = max(round(self._maps * self._whole.frames_per_sweep), frames)
        lost += self.counters.lost or 0
        stages = stages or self.stages
        self._on_progress(ScanProgress(frames, planned, lost, self._done, self._maps, stages, stage=stage))


class _PassMaker:
    """Keeps the counts of a pass; by themselves they are no map."""

    def __init__(self, workers: RowWorkers) -> None:
        self._workers = workers
        self.counts: CountVolume | None = None

    def counter(self, layout: SweepLayout) -> SweepCounter:
        """Counts the pass whole."""
        return SweepCounter(layout, self._workers)

    def map(self, sweep: Any) -> MapResult:
        """Take the counts."""
        self.counts = sweep
        nothing = np.zeros((0, 0), np.float32)
        return MapResult(StripeTable.empty(0, 0), nothing, nothing.astype(np.uint32), FogEstimate(), 0.0)


def _sensor_s(sweep: SweepAccount, plan: ScanPlan) -> float:
    frames = sweep.frames.expected
    return frames / float(plan.frame_rate_hz) + plan.readout_s(frames)


def _whole_account(passes: list[SweepAccount]) -> SweepAccount:
    """Of a map in passes: frames added up, clocks the worst of them; frame numbers those of each start by itself."""
    frames = [one.frames for one in passes]
    total = FrameCounts(*(sum(getattr(each, name) for each in frames) for name in FrameCounts.__slots__))
    worst = max(passes, key=lambda one: (not one.synchronised, one.residual_columns))
    gaps = tuple(gap for one in passes for gap in one.gaps)
    return replace(worst, frames=total, gaps=gaps, first_frame=passes[0].first_frame, end_frame=passes[-1].end_frame)
