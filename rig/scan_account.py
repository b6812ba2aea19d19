"""What the sweeps of a scan come to: frames, synchronisation, verdict, and an account of each for the manifest."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from calibration.model.rig_model import RigModel
from drivers.interfaces import SpadCounters
from rig.summary import RunFrames, Synchronisation, Verdict
from rig.sweeps import Gap, SweepAccount


def frames_of(sweeps: list[SweepAccount], crc_errors: int | None, outside: Sequence[Gap] = ()) -> RunFrames:
    """Sums over the sweeps; crc_errors: as the SPAD counts them, None where it does not.

    outside: frames that are known to be lost beside the sweeps, (first, last).
    """
    beside = sum(last + 1 - first for first, last in outside)
    return RunFrames(
        expected=beside + sum(sweep.frames.expected for sweep in sweeps),
        received=sum(sweep.frames.received for sweep in sweeps),
        lost=beside + sum(sweep.frames.lost for sweep in sweeps),
        crc_errors=crc_errors,
        lit=sum(sweep.frames.lit for sweep in sweeps),
    )


def frames_that_came(of_maps: RunFrames, counters: SpadCounters, dropped: int) -> RunFrames:
    """Frames of a run that ended before its last map: all of them, those behind its last whole map too.

    counters: the SPAD's own; dropped: frames that found no free slot, for a SPAD that does not say what got lost.
    """
    lost = dropped if counters.lost is None else counters.lost
    return replace(of_maps, expected=counters.delivered + lost, received=counters.delivered, lost=lost)


def synchronisation_of(sweeps: list[SweepAccount]) -> Synchronisation | None:
    """How well the sweeps were bound: the worst of each figure; None without any."""
    if not sweeps:
        return None
    residuals = [sweep.residual_columns for sweep in sweeps]
    found = [sweep.detection for sweep in sweeps if sweep.detection is not None]
    return Synchronisation(
        by="blanking pattern" if found else "markers",
        residual_columns=None if any(map(math.isnan, residuals)) else max(residuals),
        clock_error=max((sweep.clock_error for sweep in sweeps), key=abs),
        detection_probability=min(found) if found else None,
    )


def verdict_of(
    sweeps: list[SweepAccount],
    model: RigModel | None,
    *,
    aborted: bool,
    doubtful: bool,
    outside: Sequence[Gap] = (),
) -> Verdict:
    """The gravest that applies. doubtful: whether a map's own light speaks against it. outside: as of `frames_of`."""
    if aborted:
        return Verdict.ABORTED
    if not all(sweep.synchronised or _markers_lost(sweep) for sweep in sweeps):
        return Verdict.UNSYNCHRONISED
    if doubtful:
        return Verdict.DOUBTFUL
    if outside or any(sweep.frames.lost for sweep in sweeps):
        return Verdict.GAPS
    return Verdict.COMPLETE if model is not None else Verdict.UNCALIBRATED


def _markers_lost(sweep: SweepAccount) -> bool:
    """Whether so many frames were lost that too few markers are left to judge the sweep's clock."""
    return sweep.frames.lost > 0 and math.isnan(sweep.residual_columns)


def sweep_content(sweep: SweepAccount) -> dict[str, Any]:
    """One sweep for the manifest."""
    return {
        "direction": sweep.direction,
        "first_frame": sweep.first_frame,
        "end_frame": sweep.end_frame,
        "lost": sweep.frames.lost,
        "dark": sweep.frames.dark,
        "clock_error": sweep.clock_error,
        "residual_columns": sweep.residual_columns,
        "detection_probability": sweep.detection,
    }
