"""The search along rows over the counts of a whole sweep."""

import math

import numpy as np
from numpy.typing import NDArray

from rig.counting import CountVolume
from rig.estimators.judging import FRAMES_OVER_TWICE, nothing_found, quiet_of, stripes_of
from rig.estimators.search_buffers import search_memory
from rig.estimators.search_desk import Judge
from rig.estimators.stream_kernels import search_counts
from rig.geometry import SweepGeometry
from rig.lane_order import padded_lanes
from rig.row_threads import RowWorkers
from rig.stripes import StripeTable


def search_volume(
    volume: CountVolume, geometry: SweepGeometry, judge: Judge, workers: RowWorkers
) -> tuple[StripeTable, NDArray[np.float64]]:
    """Stripes as `judge` sees them, and the ones and exposures of pixels behind clear stripes (2, rows, width)."""
    found = nothing_found(geometry, None)

    def work(first: int, last: int) -> None:
        memory = search_memory(padded_lanes(geometry.window))
        search_counts(volume.counts, volume.n_frames, judge, memory, found, first, last)

    workers.over(geometry.rows, work)
    return stripes_of(found, judge, workers), quiet_of(found, geometry.width)


def nominal_exposures(volume: CountVolume) -> int:
    """Frames nominally taken per column; where only the counts are known, the median of those with any.

    Or more than that, as after passes over a small part of the columns: so many that those of all but a hundredth of
    them need not be halved.
    """
    if volume.exposures is not None:
        return volume.exposures
    frames = volume.n_frames[volume.n_frames > 0]
    if not len(frames):
        return 1
    most = float(np.percentile(frames, 99.0, method="lower"))
    return max(int(np.median(frames)), math.ceil((most - FRAMES_OVER_TWICE) / 2))
