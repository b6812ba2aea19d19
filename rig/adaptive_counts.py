"""Counts of the passes of a map, added up per column."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rig.adaptive import Pass
from rig.counting import CountVolume


def add_pass(total: CountVolume, one: Pass, volume: CountVolume) -> CountVolume:
    """The counts of a map with those of one more pass, whose columns have the same windows. `total` is used up."""
    if not np.array_equal(total.x0[one.part], volume.x0) or total.counts.shape[2] != volume.counts.shape[2]:
        raise ValueError("a pass has other windows than its map; compile it with those of the map")
    n_frames = total.n_frames.copy()
    n_frames[one.part] += volume.n_frames
    counts = _wide_enough(total.counts, int(n_frames.max(initial=0)))
    counts[one.part] += volume.counts
    column = total.column.copy()
    column[one.part] = _mean_column(total, one, volume)
    dark_counts, dark_frames = _dark(total, volume)
    return replace(
        total,
        counts=counts,
        n_frames=n_frames,
        column=column,
        dark_counts=dark_counts,
        n_dark=total.n_dark + volume.n_dark,
        dark_frames=dark_frames,
        exposures=None,
    )


def _wide_enough(counts: NDArray[np.unsignedinteger], most: int) -> NDArray[np.unsignedinteger]:
    for wider in (np.uint16, np.uint32):
        if most <= np.iinfo(counts.dtype).max:
            break
        counts = counts.astype(wider)
    return counts


def _mean_column(total: CountVolume, one: Pass, volume: CountVolume) -> NDArray[np.float64]:
    """Mean fractional column of all frames of the columns of a pass, NaN where there are none."""
    before, added = total.n_frames[one.part], volume.n_frames
    summed = np.where(before > 0, before * np.nan_to_num(total.column[one.part]), 0.0)
    summed += np.where(added > 0, added * (np.nan_to_num(volume.column) + one.first_column), 0.0)
    frames = before + added
    return np.where(frames > 0, summed / np.maximum(frames, 1), np.nan)


def _dark(a: CountVolume, b: CountVolume) -> tuple[NDArray[np.uint32] | None, NDArray[np.int32] | None]:
    """Dark counts of both, and the frames in which each pixel was used where that was not in all."""
    counts = [each.dark_counts for each in (a, b) if each.dark_counts is not None]
    if not counts:
        return None, None
    frames = None
    if a.dark_frames is not None or b.dark_frames is not None:
        used = [np.full(a.width, e.n_dark, np.int32) if e.dark_frames is None else e.dark_frames for e in (a, b)]
        frames = used[0] + used[1]
    return sum(counts[1:], counts[0].copy()), frames
