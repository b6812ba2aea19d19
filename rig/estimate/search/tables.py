"""Tables of the search along a row: a fast form of `rig.estimate.row.likelihood`, tested against it.

There is a table per column and band of rows; a thread's buffers are here too. Tables hold the terms of the likelihood
in integers, with `units` units to an octave (a factor of 2) of likelihood. With the probability p' that a pixel fires,
p'_L left and p'_R right of the stripe, and p'_S where the stripe lights it,

    edge = logit p'_L - logit p'_R                  int8: a count at a pixel left of position x
    tap  = logit p'_S - logit p'_L or R             int8: a count at a pixel around x, for SCREENS amplitudes
    constant: the same of log(1 - p'), per exposure, since the number of frames differs from column to column

If near is left, the light on the left is haze and ambient light, on the right the pedestal (the level behind the
stripe) and ambient light; with the scanner on the other side it is the other way round. Haze and pedestal vary slowly
from row to row, so the rows of a band share one table per column. Processors multiply and add 8-bit weights in one
instruction. `ScreenTables` has the shapes.
"""

from typing import Final, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rig.count.lane_order import PAIRS, STEPS, pair_bytes, place_of
from rig.estimate.row.inputs import RowState, Sweep, row_buffers, row_fluxes
from rig.estimate.row.likelihood import FLUX_MAX, cell_of, none_prior
from rig.simd import Float32, Int16, Int32, Uint8
from rig.simd.memory import CACHE_LINE, address_of, keep_alive, read_int16, write_int16
from rig.simd.shuffles import FOLDED
from rig.simd.vectors import LANES

SCREENS: Final = 2
"""Stripe amplitudes of the search, for the dim and the bright half of the learned ones; the likelier one counts."""
OUTSIDE: Final = -32000
"""Score of a position where the column's stripe cannot lie."""
NONE: Final = 5
SLOPE: Final = 8
WEIGHT_LIMIT: Final = 127
"""Largest weight; larger ones are cut to it."""
LN2: Final = 0.6931471805599453
FLUX_LEFT, FLUX_RIGHT, GAIN_LEFT, GAIN_RIGHT, LOSS_LEFT, LOSS_RIGHT = range(6)
"""Indices of the numbers per pixel: its flux left and right of the stripe, and their entries in the logit table."""


class ScreenTables(NamedTuple):
    """Tables of all columns and bands, see the module.

    P: stored pixels per row, padded to whole vectors. Unless stated otherwise pixels are in lane order, in STEPS steps,
    which make PAIRS pairs (`rig.count.lane_order`). T: pixels to each side of a position that are looked at.

    edge: int8 (columns, bands, PAIRS, lanes, 2), weight of a count left of the stripe.
    tap: int8 (columns, bands, SCREENS, STEPS, T + 1, lanes, 2), for each position the weights of counts up to T px
    around it, in T + 1 pairs from `first_pair` on. At odd positions the first pixel of the position's own pair also has
    its weight as a pixel left of the stripe.
    position: int16 (columns, bands, SCREENS, P), constant of position x at the nominal number of exposures, its prior
    included; slope: int16, the same shape, what each further exposure adds to it, in 1 / SLOPE of a unit.
    lane: float32 (columns, bands, lanes), score in units per exposure if all pixels up to the lane's last one lie left
    of the stripe.
    none: float32 (columns, bands, NONE), log priors, in units, of 'no stripe': all pixels right of the stripe, all left
    of it, a change in a given lane; then the first and last lane with pixels of the column.
    neutral: float32 (columns, bands, P), ones per exposure that are as likely left of the stripe as right of it, in
    pixel order.
    before, scale: float32 (columns, bands, P) as in `RowBuffers`, in pixel order.
    first, last: int32 (columns, bands), first and last position in stored pixels; first > last if there is none.
    ambient: float32 (columns, bands, P), ambient light and other lines' haze, in pixel order; of shape (0, bands, P) if
    other lines have hardly any.
    """

    edge: NDArray[np.int8]
    tap: NDArray[np.int8]
    position: Int16
    slope: Int16
    lane: Float32
    none: Float32
    neutral: Float32
    before: Float32
    scale: Float32
    first: Int32
    last: Int32
    ambient: Float32


@numba.njit(cache=True, nogil=True)
def fill_tables(
    sweep: Sweep, state: RowState, light: Float32, log_share: Float32, units: float, nominal: float, first_band: int,
    last_band: int, out: ScreenTables,
) -> None:  # fmt: skip
    """Fill the tables of bands first_band..last_band-1.

    sweep, state: of a sweep whose rows are the bands (`rig.estimate.search.prepare`). light, log_share: (SCREENS,),
    amplitudes of the search and the logarithm of their probability. units: per octave. nominal: exposures for
    `position`.
    """
    columns = sweep.plane.shape[0]
    lanes = out.lane.shape[2]
    pixels = STEPS * lanes
    per_nat = np.float32(units / LN2)
    row = row_buffers(pixels + 2, 1)
    levels = np.empty((6, pixels), np.float32)
    gain, loss = state.table[0], state.table[1]
    for b in range(first_band, last_band):
        for c in range(columns):
            edge, tap = out.edge[c, b], out.tap[c, b]
            edge[:] = 0
            tap[:] = 0
            out.position[c, b] = OUTSIDE
            out.slope[c, b] = 0
            out.lane[c, b] = 0.0
            out.neutral[c, b] = 0.0
            out.none[c, b] = np.float32(OUTSIDE)
            out.first[c, b], out.last[c, b] = 0, -1
            length, begin, end, start = row_fluxes(sweep, state, row, b, c)
            if length == 0:
                continue
            low = (start if sweep.near_is_left else start - length + 1) - sweep.x0[c]
            over = np.float32(0.0)
            for i in range(length):
                t = i if sweep.near_is_left else length - 1 - i
                x = low + i
                near, far = row.before[t], row.behind[t]
                levels[FLUX_LEFT, x], levels[FLUX_RIGHT, x] = (near, far) if sweep.near_is_left else (far, near)
                out.before[c, b, x], out.scale[c, b, x] = near, row.scale[t]
                if out.ambient.shape[0] > 0:
                    out.ambient[c, b, x] = state.ambient[b, x + sweep.x0[c]] + row.others[t]
                at = cell_of(levels[FLUX_LEFT, x])
                levels[GAIN_LEFT, x], levels[LOSS_LEFT, x] = gain[at], loss[at]
                at = cell_of(levels[FLUX_RIGHT, x])
                levels[GAIN_RIGHT, x], levels[LOSS_RIGHT, x] = gain[at], loss[at]
                weight = levels[GAIN_LEFT, x] - levels[GAIN_RIGHT, x]
                constant = levels[LOSS_LEFT, x] - levels[LOSS_RIGHT, x]
                # The rounding error is added to the next pixel, so that sums over many pixels do not drift.
                wanted = weight * per_nat + over
                edge[_pair(x), x // STEPS, x & 1] = _weight(wanted)
                over = wanted - edge[_pair(x), x // STEPS, x & 1] if abs(wanted) < WEIGHT_LIMIT else np.float32(0.0)
                if abs(weight) > 1e-3:
                    out.neutral[c, b, x] = min(max(-constant / weight, np.float32(0.0)), np.float32(1.0))
            span = low, length, begin, end, start
            _positions(sweep, state, light, log_share, per_nat, nominal, b, c, span, row, levels, out)


@numba.njit(cache=True, nogil=True)
def _positions(sweep, state, light, log_share, per_nat, nominal, b, c, span, row, levels, out):  # type: ignore[no-untyped-def]
    """Taps, constants and priors of every position of one table."""
    low, length, begin, end, start = span
    step = 1 if sweep.near_is_left else -1
    gain, loss = state.table[0], state.table[1]
    lanes, reach = out.lane.shape[2], out.tap.shape[4] - 1
    edge, tap = out.edge[c, b], out.tap[c, b]
    first = (start + step * (begin if step > 0 else end)) - sweep.x0[c]
    last = (start + step * (end if step > 0 else begin)) - sweep.x0[c]
    out.first[c, b], out.last[c, b] = first, last
    within = np.float32(0.0)
    for x in range(low, low + length):
        if x % STEPS == 0:
            within = np.float32(0.0)
        s, lane = x % STEPS, x // STEPS
        place = s * lanes + lane
        # First pixel of the pairs that have taps.
        first_px = 2 * (x // 2 + first_pair(s, reach))
        for m in range(light.shape[0]):
            constant = within
            weights = tap[m, s, :, lane]
            if s & 1:
                weights[(x - 1 - first_px) >> 1, 0] = edge[_pair(x - 1), lane, 0]
            for d in range(-reach, reach + 1):
                at = x + d
                if at < low or at >= low + length:
                    continue
                extra = light[m] * state.psi[abs(d)] * out.scale[c, b, at]
                if d < 0:
                    base, own_gain, own_loss = levels[FLUX_LEFT, at], levels[GAIN_LEFT, at], levels[LOSS_LEFT, at]
                else:
                    base, own_gain, own_loss = levels[FLUX_RIGHT, at], levels[GAIN_RIGHT, at], levels[LOSS_RIGHT, at]
                if d == 0:
                    base = np.float32(0.5) * (levels[FLUX_LEFT, at] + levels[FLUX_RIGHT, at])
                cell = cell_of(min(base + extra, FLUX_MAX))
                here = (at - first_px) >> 1
                before = np.float32(weights[here, at & 1])
                weights[here, at & 1] = _weight(before + (gain[cell] - own_gain) * per_nat)
                constant += (loss[cell] - own_loss) * per_nat
            if first <= x <= last:
                t = x - low if step > 0 else length - 1 - (x - low)
                prior = (row.log_prior[t] + log_share[m]) * per_nat
                out.position[c, b, m, place] = _within(nominal * constant + prior, OUTSIDE, -OUTSIDE)
                out.slope[c, b, m, place] = _within(SLOPE * constant, -32767.0, 32767.0)
        own = (levels[LOSS_LEFT, x] - levels[LOSS_RIGHT, x]) * per_nat
        within += own
        out.lane[c, b, x // STEPS] += own
    for i in range(1, lanes):
        out.lane[c, b, i] += out.lane[c, b, i - 1]
    mass = 0.0
    for t in range(begin, end + 1):
        mass += np.exp(row.log_prior[t])
    behind, before, change = none_prior(sweep.w_near, sweep.w_far, row.w[begin], row.w[end], state.none_weight)
    share = np.log((1.0 - behind - before - change) / mass)
    all_right, all_left = (behind, before) if step > 0 else (before, behind)
    out.none[c, b, 0] = (np.log(all_right) - share) * per_nat
    out.none[c, b, 1] = (np.log(all_left) - share) * per_nat
    out.none[c, b, 2] = (np.log(change * STEPS / (length + 1)) - share) * per_nat
    out.none[c, b, 3], out.none[c, b, 4] = low // STEPS, (low + length - 1) // STEPS


@numba.njit(inline="always")
def _within(value, low, high):  # type: ignore[no-untyped-def]
    return np.int16(round(min(max(value, low), high)))


@numba.njit(inline="always")
def _weight(value):  # type: ignore[no-untyped-def]
    return np.int8(round(min(max(value, np.float32(-WEIGHT_LIMIT)), np.float32(WEIGHT_LIMIT))))


@numba.njit(inline="always")
def _pair(x):  # type: ignore[no-untyped-def]
    return (x % STEPS) // 2


@numba.njit(inline="always")
def first_pair(s, reach):  # type: ignore[no-untyped-def]
    """First pair of the taps of step s, relative to the step's own pair. reach: px on either side."""
    return ((s - reach) >> 1) - (s >> 1)


BATCH: Final = LANES
"""Rows that go through each step of the search together: while one waits for a result, others go on."""
PLACE_BEFORE: Final = 8
"""Number of pixels before the first one, and behind the last one, that have an entry in `Search.place`."""


class ScreenTable(NamedTuple):
    """One table adapted to a number of exposures.

    Addresses, in lane order: edge, tap as in `ScreenTables`, constant as in `Search`; in pixel order, float32 of the
    stored pixels: before, scale, ambient. Numbers: all_right, score if all pixels lie right of the stripe; all_left,
    number that is added to the sum of all lanes if all pixels lie left. searched: whether there is any position to
    search.
    """

    edge: int
    tap: int
    constant: int
    before: int
    scale: int
    ambient: int
    all_right: np.int16
    all_left: np.int16
    searched: bool


class Search(NamedTuple):
    """Addresses of a thread's buffers for BATCH rows of `lanes` lanes, and the bytes from row to row of n and score.

    n: counts, see `rig.count.lane_order`. int16: score (STEPS, lanes); start (lanes,), score of a change at the lane's
    first pixel; tops (LANES,), item i: the largest score of lanes i, i + LANES, ...; constant (SCREENS, STEPS, lanes),
    that of each position for the column's exposures; lane (lanes,), the same for lanes; change (lanes,), score added
    by a change without a stripe in the lane; label (LANES,), scores of the close-up; place: index in a row of counts of
    each pixel from -PLACE_BEFORE on. neutral, muted: bytes, counts of hot pixels, see `rig.estimate.search.rows`. For
    each row of the batch, int16: all_left, sum of all lanes; best, x: best score and its pixel; left, right: the scores
    beside it; levels: of the close-up; lift: see `lift_to_powers`; ceiling: limit of scores of 'no stripe'. float32:
    light, before, scale, ambient: see `rig.estimate.search.rows`; answer: one field of the answers before it is
    written. Folded (`rig.simd.shuffles`): mass, sum of all likelihoods; moment, square: sums of the close-up.
    """

    lanes: int
    n: int
    n_bytes: int
    score: int
    score_bytes: int
    start: int
    tops: int
    constant: int
    lane: int
    change: int
    label: int
    place: int
    neutral: int
    muted: int
    all_left: int
    best: int
    x: int
    left: int
    right: int
    levels: int
    lift: int
    ceiling: int
    light: int
    before: int
    scale: int
    ambient: int
    answer: int
    mass: int
    moment: int
    square: int


@numba.njit(forceinline=True)
def _search_at(n, lanes):  # type: ignore[no-untyped-def]
    """The buffers from address n on, and where they end."""
    n_bytes, score_bytes = PAIRS * pair_bytes(lanes), 2 * STEPS * lanes
    score = n + BATCH * n_bytes
    start = score + BATCH * score_bytes
    tops = start + BATCH * 2 * lanes
    constant = tops + BATCH * 2 * LANES
    lane = constant + 2 * SCREENS * STEPS * lanes
    change = lane + 2 * lanes
    label = change + 2 * lanes
    row = label + BATCH * 2 * LANES
    number = row + 8 * 2 * BATCH
    folded = number + 5 * 4 * BATCH
    fold = 4 * FOLDED * BATCH
    place = folded + 3 * fold
    neutral = place + 2 * (STEPS * lanes + 2 * PLACE_BEFORE)
    search = Search(
        lanes, n, n_bytes, score, score_bytes, start, tops, constant, lane, change, label, place, neutral,
        neutral + STEPS * lanes, row, row + 2 * BATCH,
        row + 4 * BATCH, row + 6 * BATCH, row + 8 * BATCH, row + 10 * BATCH, row + 12 * BATCH, row + 14 * BATCH, number,
        number + 4 * BATCH, number + 8 * BATCH, number + 12 * BATCH, number + 16 * BATCH, folded, folded + fold,
        folded + 2 * fold,
    )  # fmt: skip
    return search, neutral + (1 + BATCH) * STEPS * lanes


@numba.njit(cache=True, nogil=True)
def search_memory(lanes: int) -> Uint8:
    """Memory for the buffers of a `Search`, beginning at a cache line."""
    _, end = _search_at(0, lanes)
    whole = np.zeros(end + CACHE_LINE, np.uint8)
    begin = -address_of(whole) % CACHE_LINE
    memory = whole[begin : begin + end]
    search = search_in(address_of(memory), lanes)
    for i in range(STEPS * lanes + 2 * PLACE_BEFORE):
        write_int16(search.place, i, np.int16(place_of(i - PLACE_BEFORE, lanes)))
    keep_alive(whole)
    return memory


@numba.njit(forceinline=True)
def search_in(memory: int, lanes: int) -> Search:
    """The buffers in memory made by `search_memory`. memory: its address."""
    return _search_at(memory, lanes)[0]


@numba.njit(forceinline=True)
def count_place(search: Search, x: int) -> int:
    """Index of pixel x in a row of counts; x may be as low as -PLACE_BEFORE."""
    return np.int64(read_int16(search.place, x + PLACE_BEFORE))
