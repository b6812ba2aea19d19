"""Learns haze and halo from the stripes of a sweep, in one weighted fit of least squares.

What is counted beside a stripe is haze, pedestal, halo and ambient light: each of them a sum of known shapes, so that
one linear fit tells them apart where averages behind and before the stripe cannot: the halo follows the brightness of
each stripe, haze does not. On its own a row cannot tell a stripe's brightness: neighbours are asked too, and stripes
that do not agree with theirs teach nothing (`halo_light`). Later maps are asked whether there still is a halo, or one
now.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rig.counting import CountVolume
from rig.estimators.halo import halo_shares, over_bins
from rig.estimators.halo_kernels import add_equations, solve
from rig.estimators.halo_light import likeliest_light
from rig.estimators.joint_tables import Tables
from rig.estimators.learning import LATTICE_LINES, PIECES, lattice, lines_of
from rig.estimators.lessons import Setting
from rig.estimators.placing_kernels import Places
from rig.estimators.row_input import Lines, state_of, sweep_of
from rig.estimators.row_model import BINS, HALO_NODES, HALO_REACHES_PX, RowModel, fit_haze
from rig.geometry import SweepGeometry
from rig.row_threads import RowWorkers
from rig.stripes import StripeTable

CLEAR: Final = np.float32(0.5)
"""Confidence of stripes that teach."""
FIRST_LINES: Final = LATTICE_LINES // 4
"""Rows x columns that tell whether there is a halo at all, and of later maps; once there is one in the first map, twice
LATTICE_LINES measure it."""
LEAST_EVIDENCE: Final = 50.0
"""By how much a halo must better the fit, in chi squared: without one it does by 2 to 10, in fog of optical depth 1 by
4000 to 30000."""
SMOOTH_HAZE, SMOOTH_SHARE, SMOOTH_HALO, SMALL_HALO = 3e4, 300.0, 3.0, 0.1
"""What bends of the haze, steps of its share behind the stripe, steps of the halo and the halo itself cost, over their
squares: they decide only where there are no data."""
_SHARE, _HALO = BINS, BINS + HALO_NODES
_SIZE = _HALO + HALO_NODES * len(HALO_REACHES_PX) + 1


@dataclass(frozen=True, slots=True, eq=False)
class BrightLines:
    """Lines with a clear stripe, and the light of each, photons: what can teach of a halo."""

    lines: Lines
    light: NDArray[np.float32]


def bright_lines(
    volume: CountVolume,
    geometry: SweepGeometry,
    tables: Tables,
    stripes: StripeTable,
    places: Places,
    workers: RowWorkers,
    number: int = FIRST_LINES,
) -> BrightLines:
    """Those of about so many lines of a map whose light is known; tables: it was made with, places: of its stripes."""
    rows, columns = lattice(geometry, number)
    clear = stripes.confidence[rows, columns] > CLEAR
    rows, columns = rows[clear], columns[clear]
    light, known = np.empty(len(rows), np.float32), np.empty(len(rows), np.bool_)
    seen = (
        volume.counts,
        volume.n_frames,
        tables.sweep,
        tables.state,
        tables.shares,
        stripes.x_px,
        places,
        rows,
        columns,
    )
    workers.over(len(rows), lambda first, last: likeliest_light(*seen, first, last, light, known))
    return BrightLines(lines_of(volume, (rows[known], columns[known]), stripes), light[known])


def learn_first_halo(
    volume: CountVolume,
    geometry: SweepGeometry,
    model: RowModel,
    ambient: NDArray[np.float32],
    tables: Tables,
    stripes: StripeTable,
    places: Places,
    workers: RowWorkers,
) -> RowModel:
    """What `learn_halo` gives for the first map; to be called again with the map that is made under it.

    Of several lines at once the model stays as it is: what the others bring would be taken for a halo.
    """
    if geometry.others is not None:
        return model
    number = 2 * LATTICE_LINES if model.halo.any() else FIRST_LINES
    seen = bright_lines(volume, geometry, tables, stripes, places, workers, number)
    return learn_halo(seen, geometry, model, ambient, workers, dark=volume.dark_counts is not None)


def learn_next_halo(setting: Setting, seen: BrightLines, workers: RowWorkers) -> RowModel:
    """The model of a later lesson: with a halo where the map begins to show one, without where it does not any more.

    One that stays is left as it was found. Told again from so few lines, lesson after lesson, halo, haze and the rest
    behind stripes shift among each other: over eight maps in steady fog errors grew by 10 to 25 %.
    """
    model = setting.model
    if setting.geometry.others is not None or (not model.halo.any() and np.isnan(model.extinction_per_m)):
        return model
    found = learn_halo(seen, setting.geometry, model, model.ambient, workers, dark=setting.dark)
    return model if found.halo.any() == model.halo.any() else found


def learn_halo(
    seen: BrightLines,
    geometry: SweepGeometry,
    model: RowModel,
    ambient: NDArray[np.float32],
    workers: RowWorkers,
    *,
    dark: bool,
) -> RowModel:
    """The model with the halo that these stripes have, and the haze under it; as it is where they have none.

    The scale of stripes stays that of the model, which their light goes by. ambient: of each pixel, (rows, width), that
    the fit begins with. dark: whether there are dark frames.
    """
    matrix, right = _equations(seen, geometry, replace(model, ambient=ambient), workers)
    free = -1 if dark else _SIZE - 1
    if free < 0:
        # Dark frames have measured the ambient light.
        matrix[-1], matrix[:, -1], right[-1] = 0.0, 0.0, 0.0
    smoothed = matrix + _smoothness()
    found = solve(smoothed, right, free)
    plain = np.r_[0:_HALO, _SIZE - 1]
    without = np.zeros(_SIZE)
    without[plain] = solve(smoothed[np.ix_(plain, plain)], right[plain], len(plain) - 1 if free >= 0 else -1)
    if _misfit(matrix, right, without) - _misfit(matrix, right, found) < LEAST_EVIDENCE:
        return replace(model, halo=np.zeros_like(model.halo))
    halo = found[_HALO:-1].reshape(HALO_NODES, -1).astype(np.float32)
    profile = model.profile.copy()
    profile[:, 0] = found[:_SHARE]
    profile[:, 1] = model.profile[:, 0] * over_bins(np.minimum(found[_SHARE:_HALO, None], 1.0), BINS)[:, 0]
    haze = np.diagonal(matrix)[:BINS]
    known = haze > 0
    variance = np.where(known, 1.0 / np.where(known, haze, 1.0), np.nan)
    fit = fit_haze(model.path_m(), np.where(known, found[:BINS], np.nan), variance)
    return replace(
        model, profile=profile, halo=halo, ambient=np.maximum(ambient + np.float32(found[-1]), np.float32(1e-6)),
        extinction_per_m=fit.extinction_per_m if fit else np.nan,
        extinction_sd_per_m=fit.extinction_sd_per_m if fit else np.nan,
    )  # fmt: skip


def _equations(
    seen: BrightLines, geometry: SweepGeometry, model: RowModel, workers: RowWorkers
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    sweep, state = sweep_of(geometry), state_of(model)
    shares, reaches = halo_shares(model, geometry.width), np.array(HALO_REACHES_PX)
    hot_flux = 5.0 * float(np.median(model.ambient)) + 1e-3
    # Fixed pieces, added in order: the sums do not depend on the number of threads.
    edges = np.linspace(0, len(seen.light), PIECES + 1).astype(int)
    matrices, rights = np.zeros((PIECES, _SIZE, _SIZE)), np.zeros((PIECES, _SIZE))

    def work(first: int, last: int) -> None:
        for i in range(first, last):
            add_equations(
                seen.lines, seen.light, sweep, state, shares, reaches, HALO_NODES, hot_flux, edges[i], edges[i + 1],
                matrices[i], rights[i],
            )  # fmt: skip

    workers.over(PIECES, work)
    half = matrices.sum(axis=0)
    return half + np.tril(half, -1).T, rights.sum(axis=0)


def _smoothness() -> NDArray[np.float64]:
    out = np.zeros((_SIZE, _SIZE))

    def add(places: list[int], taps: list[float], strength: float) -> None:
        out[np.ix_(places, places)] += strength * np.outer(taps, taps)

    for i in range(1, BINS - 1):
        add([i - 1, i, i + 1], [1, -2, 1], SMOOTH_HAZE)
    for i in range(_SHARE, _HALO - 1):
        add([i, i + 1], [1, -1], SMOOTH_SHARE)
    for i in range(_HALO, _SIZE - 1):
        add([i], [1], SMALL_HALO)
        if i + len(HALO_REACHES_PX) < _SIZE - 1:
            add([i, i + len(HALO_REACHES_PX)], [1, -1], SMOOTH_HALO)
    return out


def _misfit(matrix: NDArray[np.float64], right: NDArray[np.float64], x: NDArray[np.float64]) -> float:
    return float(x @ matrix @ x - 2 * right @ x)
