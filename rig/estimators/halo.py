"""Light of the stripe that the fog scatters once more: a halo on both sides of it, part of each position's hypothesis.

At the distance d along the row from a stripe of s photons stand, per pixel,

    s rho(w, d),   rho(w, d) = sum over k of halo(w, k) exp(-|d| / HALO_REACHES_PX[k]) / (2 HALO_REACHES_PX[k])

photons; halo(w, k) is learned (`halo_learning`) at HALO_NODES path inverse depths, in between by straight lines.
"""

import numpy as np
from numpy.typing import NDArray

from rig.estimators.row_model import HALO_REACHES_PX, RowModel


def halo_shares(model: RowModel, pixels: int) -> NDArray[np.float32]:
    """rho at each profile bin and 0 to pixels - 1 px from the stripe, (BINS, pixels); zeros where there is no halo."""
    reach = np.array(HALO_REACHES_PX)[:, None]
    shape = np.exp(-np.arange(pixels) / reach) / (2 * reach)
    return np.asarray(over_bins(np.asarray(model.halo), len(model.profile)) @ shape, np.float32)


def over_bins(values: NDArray[np.floating], bins: int) -> NDArray[np.float64]:
    """What stands at HALO_NODES nodes (nodes, n) at each profile bin, (bins, n)."""
    at = np.linspace(0, len(values) - 1, bins)
    low = np.minimum(at.astype(int), len(values) - 2)
    part = (at - low)[:, None]
    return np.asarray((1 - part) * values[low] + part * values[low + 1])
