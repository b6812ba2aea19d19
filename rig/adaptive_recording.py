"""The passes of a recording: each start of the SPAD is one, with the plan it was taken with beside the frames."""

from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from drivers.interfaces import SpadTiming
from drivers.spb1 import BlockLayout
from rig.adaptive import Pass
from rig.counting import CountVolume
from rig.recording.inputs import read_plan, write_plan
from rig.recording.passes import PASSES, pass_plan
from rig.replaying import PlaysRecording
from rig.run import Run
from rig.scan_plan import ScanPlan
from rig.session import OpenRig


class PassNotes:
    """Notes the passes of a run in its manifest and, where it is recorded, their plans beside the frames."""

    def __init__(self, manifest: dict[str, Any], recorded: Run | None) -> None:
        self._passes: list[dict[str, int]] = manifest.setdefault(PASSES, [])
        self._recorded = recorded

    def note(self, index: int, one: Pass, plan: ScanPlan) -> None:
        """A pass of map `index` comes next."""
        if self._recorded is not None:
            name = pass_plan(len(self._passes))
            self._recorded.add_input(name, lambda file: write_plan(file, plan))
        self._passes.append({"map": index, **asdict(one)})


class RecordedPasses:
    """The passes of the maps of a recording, again and again where it loops."""

    def __init__(
        self, rig: OpenRig, whole: ScanPlan, passes: Sequence[Sequence[tuple[int, Pass]]], timing: SpadTiming
    ) -> None:
        """passes: of each map, with the recorded starts they are. timing: of the SPAD, configured by `replay_plan`."""
        assert isinstance(rig.spad, PlaysRecording), "asked for by a replay"
        self._rig = rig
        self._folder = rig.spad.recording.path
        self._whole = whole
        self._maps = [[one for _, one in of_map] for of_map in passes]
        plans = [read_plan(self._folder, pass_plan(start)) for of_map in passes for start, _ in of_map]
        widest = max(plan.frame_width for plan in plans)
        least, most = (BlockLayout(1, width, whole.rows).min_stride for width in (plans[0].frame_width, widest))
        self._timing = replace(timing, stride=-(-timing.stride * most // least))
        self._plans = plans
        self._next = 0

    def next(self, index: int, taken: int, counts: CountVolume | None, spent_s: float) -> Pass | None:
        """See `ChoosesPasses`."""
        passes = self._maps[index % len(self._maps)]
        return passes[taken] if taken < len(passes) else None

    def prepare(self, one: Pass) -> tuple[ScanPlan, SpadTiming]:
        """See `ChoosesPasses`."""
        plan = self._plans[self._next % len(self._plans)]
        self._next += 1
        if self._rig.model is not None:
            from rig.recalibrated import recalibrated

            plan = recalibrated(plan, self._rig.model)
        x0 = np.ascontiguousarray(self._whole.x0[one.part])
        return replace(plan, x0=x0, window=self._whole.window), self._timing
