"""Sub-pixel places of stripes whose labels are known: their light, their pooled places, and the width of the line.

The steps are: light of each stripe; its brightness, pooled over neighbours; score and information of its place; its
place, pooled over neighbours; that place joined with pairs of opposite neighbours. The formulas are in
`rig.estimate.joint.place.places` and `rig.estimate.joint.place.pool`. Positions are float32 (rows, columns) in px.
"""

from itertools import pairwise

import numpy as np

from rig.count.volume import Counts, CountVolume
from rig.estimate.joint.place.light import FRACTIONS, measure_light, score_places
from rig.estimate.joint.place.places import REACH_PX, TAPS, Places, add_moments, fetch_counts
from rig.estimate.joint.place.pool import join_pairs, pool_amplitude, pool_places
from rig.estimate.row.inputs import RowState, Sweep
from rig.estimate.row.model import pixel_shares
from rig.geometry.stripe_table import StripeTable
from rig.simd import Bools, Float32, Float64
from rig.simd.memory import aligned_zeros
from rig.simd.shuffles import EIGHT
from rig.threads import RowWorkers

LIGHT_REACH = 3
"""Rows and columns to either side over which a stripe's brightness is pooled."""
REACHES = (1, 2)
"""Rows and columns to either side over which a stripe's place is pooled: the first that gives ENOUGH, else the last."""
LESSON_REACHES = (1, 2, 3, 4)
"""REACHES for the lessons of the first map, whose places are not joined with pairs: joined places of weak stripes are
so smooth that their brightness would be learned too dark."""
ENOUGH = 1 / 0.06**2
"""Information, 1/px^2, that is enough for a place: no more neighbours are used, since surfaces bend."""
PAIRS = ((4, 0.576), (6, 0.280))
"""For each round of joining: rows and columns to the neighbours of a pair, and `share` of `join_pairs`. A place pooled
over 5 x 5 stripes has the information of 25 stripes, of 140 after the first round and of 454 after the second. Since
neighbourhoods overlap, these are less than 9 x 25 and 81 x 25."""
MOST_MOVED_PX = 0.9
"""Largest shift of a stripe from its label, all rounds together. Labels end a pixel beyond the searched pixels, so
answers end within 2 px of these. Only in pictures of saturated pixels would stripes move farther."""
BEYOND = 3.0
"""Factor by which brightness may lie beyond the learned amplitudes, either way."""
DARKEST = 300.0
"""Largest ratio of the brightest of the four amplitudes of `amplitudes_of` to another."""
ENOUGH_TRUSTED = 0.5
"""Share of trusted answers from which on the others are taken for dark stripes, rather than for no stripes."""
SLOPE_STEP_PX = 0.05
LEAST_PHOTONS = 100.0
"""Least light of all stripes, in photons per exposure, from which `line_width` gives a width."""
LINE_SIGMA_PX = np.array([0.25, 2.4])
"""Smallest and largest width that `line_width` gives."""


def profile_table(sigma_px: float) -> Float32:
    """Shares of a line of this width, and their slopes: `shares` of `score_places`."""
    centre = (np.arange(FRACTIONS) + 0.5) / FRACTIONS - 0.5
    distance = np.arange(-REACH_PX, REACH_PX + 1) - centre[:, None]
    on, back = (pixel_shares(sigma_px, distance - step) for step in (SLOPE_STEP_PX, -SLOPE_STEP_PX))
    slope = (on - back) / np.float32(2 * SLOPE_STEP_PX)
    return np.pad(np.stack([pixel_shares(sigma_px, distance), slope], axis=1), ((0, 0), (0, 0), (0, EIGHT - TAPS)))


def new_places(rows: int, columns: int) -> Places:
    """Memory for the places of a map, in one piece so that the system gives it large pages.

    Kernels may read a vector that goes beyond the end of any field but the last.
    """
    return Places(*aligned_zeros((len(Places._fields), rows, columns), np.float32))


def place(
    volume: CountVolume,
    sweep: Sweep,
    state: RowState,
    shares: Float32,
    x_px: Float32,
    places: Places,
    workers: RowWorkers,
    *,
    lesson: bool = False,
) -> Float32:
    """Move x_px to positions pooled over neighbours, and return their standard deviations in px.

    places: holds the distances of x_px from the far end, and receives light, haze and intermediate results. lesson:
    whether the result is for the first map's lessons. The last steps are only queued, see `weigh_light`.
    """
    sd = np.empty_like(x_px)
    around = weigh_light(volume, sweep, state, x_px, places, workers)
    seen = volume.n_frames, sweep, state, shares, around, x_px
    distance, placed, joined, joined_sd = places.distance, places.placed, places.joined, places.joined_sd
    near, far = PAIRS

    def pool(first: int, last: int) -> None:
        pool_places(places, LESSON_REACHES if lesson else REACHES, ENOUGH, first, last, placed, sd)
        placed[first:last] += distance[first:last]

    def move(first: int, last: int) -> None:
        moved = placed[first:last] - distance[first:last]
        x_px[first:last] += np.clip(moved, -MOST_MOVED_PX, MOST_MOVED_PX, out=moved)

    rows = len(x_px)
    workers.over(rows, lambda first, last: score_places(*seen, first, last, places))
    workers.over(rows, pool)
    if not lesson:
        workers.over(rows, lambda first, last: join_pairs(placed, sd, *near, ENOUGH, first, last, joined, joined_sd))
        workers.post(rows, lambda first, last: join_pairs(joined, joined_sd, *far, ENOUGH, first, last, placed, sd))
    workers.post(rows, move)
    return sd


def weigh_light(
    volume: CountVolume, sweep: Sweep, state: RowState, x_px: Float32, places: Places, workers: RowWorkers
) -> Counts:
    """Fill light, scale, haze, rest, glow and amplitude of `places` for stripes at x_px. state: the model.

    Returns the counts around the stripes, see `fetch_counts`. The amplitudes are only queued: work posted later for the
    same rows can use them; all other users must call `workers.settle` first.
    """
    faintest, brightest = float(state.amplitude[0]) / BEYOND, float(state.amplitude[-1]) * BEYOND
    around = np.empty((*x_px.shape, EIGHT), volume.counts.dtype)
    seen = volume.n_frames, sweep, state, around, x_px

    def measure(first: int, last: int) -> None:
        fetch_counts(volume.counts, sweep.x0, x_px, first, last, around)
        measure_light(*seen, first, last, places)

    workers.over(len(x_px), measure)
    workers.post(len(x_px), lambda first, last: pool_amplitude(LIGHT_REACH, faintest, brightest, first, last, places))
    return around


def line_width(
    volume: CountVolume, sweep: Sweep, state: RowState, stripes: StripeTable, workers: RowWorkers
) -> float | None:
    """Standard deviation of the line in px, from the light of clear stripes, limited to LINE_SIGMA_PX. None if there is
    too little light."""
    sums = np.zeros((stripes.x_px.shape[0], 2))
    clear = stripes.x_px, stripes.x_sd_px, stripes.confidence, stripes.signal
    seen = volume.counts, volume.n_frames, sweep, state, *clear
    workers.over(len(sums), lambda first, last: add_moments(*seen, first, last, sums))
    light, moment = sums.sum(axis=0)
    if light < LEAST_PHOTONS:
        return None
    pixel_variance = 1 / 12
    return float(np.sqrt(np.clip(moment / light - pixel_variance, *LINE_SIGMA_PX**2)))


def amplitudes_of(places: Places, trusted: Bools, *, others: bool) -> tuple[Float32, Float64]:
    """Four amplitudes, dark to bright, that represent those of a map's stripes, and the share of the stripes that each
    of them represents.

    trusted: (rows, columns), which stripes count for certain. others: whether all others count too, since many of them
    are dark stripes. But where most places have no stripe, what is measured there would make the amplitudes darker with
    every lesson. So if fewer than ENOUGH_TRUSTED are trusted, no amplitude is darker than that of the trusted stripes
    by a factor of more than BEYOND. If no stripe is trusted, the amplitudes are 1.
    """
    there = places.scale > 0
    edges, shares = (0.0, 0.2, 0.5, 0.8, 1.0), np.array([0.2, 0.3, 0.3, 0.2])
    middle = [0.5 * (a + b) for a, b in pairwise(edges)]
    certain = places.amplitude[trusted & there]
    if len(certain) == 0:
        return np.ones(4, np.float32), shares
    amplitude = np.quantile(certain, middle)
    if others:
        least = amplitude / BEYOND if len(certain) < ENOUGH_TRUSTED * np.count_nonzero(there) else 0.0
        amplitude = np.maximum(np.quantile(places.amplitude[there], middle), least)
    return np.maximum(amplitude, amplitude[-1] / DARKEST).astype(np.float32), shares
