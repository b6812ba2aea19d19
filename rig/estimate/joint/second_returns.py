"""Second returns: a second line of light beside the stripe, from a pane before a wall, a twig, a flake of snow.

A row has one stripe in the model, so the other line's light is searched for before and behind the stripe. In a single
row it exceeds the haze by too little to be seen. So light is first summed over blocks of rows and columns
(`rig.estimate.joint.second_return_blocks`) and compared, at each distance in px from the far end of the depth range,
with the light that is expected from haze and ambient light. Then each row is examined with its neighbours. Let own and
block be the light of a candidate in standard deviations, own pooled over its neighbours, block over its block and the
blocks around. The probability that the candidate is right is

    logit confidence2 = LOG_ODDS . (1, own, block)

Positions x2_px and confidence2 are float32 (rows, columns), NaN and 0 where nothing stands out. LOG_ODDS are fitted to
maps with a pane over a third of the picture and to maps without a pane. Light closer to a stripe than APART_PX plus
LINE_SIGMAS standard deviations of the line counts as the stripe's own, so closer surfaces are not separated.

A flake or a drop is a speck: a nearer answer for a few rows and columns, while the surface behind it is lit too. What a
scan asks for is that surface, so there the two returns are exchanged (`behind_specks`).
"""

from typing import Final, NamedTuple

import numba
import numpy as np

from rig.count.volume import Counts, CountVolume
from rig.estimate.joint.labels.costs import hot_in_bands
from rig.estimate.joint.labels.grid import PER_PX, LabelGrid
from rig.estimate.joint.place.pool import pool_row
from rig.estimate.joint.second_return_blocks import BLOCK, HAZE_STEP, LEFT_OUT, Blocks, line_places, sum_blocks
from rig.estimate.row.inputs import RowState, Sweep, fluxes_at, line_light
from rig.estimate.row.neighbours import SAME_PX, with_margin
from rig.geometry.kernels import with_rays
from rig.geometry.stripe_table import StripeTable
from rig.simd import Bools, Float32, Float64, Int16, Int32
from rig.simd.memory import address_of, aligned_zeros, keep_alive, load_float32, store_float32
from rig.simd.vectors import LANES, larger_float, largest_float, square_root, zero_float32
from rig.threads import RowWorkers, Work

RING_PX: Final = 4
"""Pixels on either side of a candidate (the ring) that show whether haze is as strong as was learned."""
GAP_PX: Final = 1
"""Pixels between the candidate's light and the ring."""
LEAST_RING: Final = 0.25
"""Least ones expected per pixel on each side of the ring, as a share of the candidate's: else too few were seen."""
STEEPER: Final = 1.5
"""Factor on the excess haze of the ring's brighter side: haze is not linear between both sides."""
CANDIDATE: Final = np.float32(4.0)
"""Standard deviations above which a block's light is a candidate."""
REACH: Final = 3
"""Rows and columns to either side over which a candidate's own light is pooled."""
LOG_ODDS: Final = -16.0, 0.4, 3.0
"""Factors of the log odds that a candidate is right, see the module."""
_AROUND: Final = -(-(RING_PX + GAP_PX + 6) // LANES) * LANES
"""Zeros on either side of the pixels of distance, enough for a ring around a line of up to 6 px reach."""


StripeArrays = tuple[Float32, Float32, Float32, Float32, Float32, Float32, Float32]


class Candidates(NamedTuple):
    """The light that stands out most in each block and its neighbours, float32 (block rows, block columns) each.

    distance: from the far end in px, NaN if nothing stands out; sure: its significance in standard deviations; haze:
    ratio of the haze there to the learned haze, at least 1.
    """

    distance: Float32
    sure: Float32
    haze: Float32


class SecondReturns(NamedTuple):
    """Candidates of second returns, float32 (rows, columns) each.

    distance: from the far end in px, NaN if there is no candidate; ones, expected: ones counted and expected within
    the line's reach of the candidate; light: ones - expected; moment: sum of each pixel's light times its distance from
    the candidate in px; moved: see `move_seconds`.
    """

    distance: Float32
    ones: Float32
    expected: Float32
    light: Float32
    moment: Float32
    moved: Float32


@numba.njit(cache=True, nogil=True, error_model="numpy")
def find_candidates(blocks: Blocks, reach: int, side: int, first_block: int, last_block: int, out: Candidates) -> None:
    """Find the candidates of block rows first_block..last_block-1. reach: of `SecondLight`; side: of `LabelGrid`."""
    rows, columns, pixels = blocks.ones.shape
    three = np.zeros((2, columns, pixels), np.float32)
    nine, above = np.zeros((2, pixels + 2 * _AROUND), np.float32), np.empty(pixels, np.float32)
    room, excess, row = address_of(nine), address_of(above), 4 * pixels * columns
    of_three, of_nine = address_of(three), room + 4 * _AROUND
    ones, expected = address_of(blocks.ones), address_of(blocks.expected)
    for by in range(first_block, last_block):
        lines = max(by - 1, 0), min(by + 2, rows)
        _add_lines(ones + row * lines[0], row, lines[1] - lines[0], pixels * columns, of_three)
        _add_lines(expected + row * lines[0], row, lines[1] - lines[0], pixels * columns, of_three + row)
        for bx in range(columns):
            first, number = max(bx - 1, 0), min(bx + 2, columns) - max(bx - 1, 0)
            _add_lines(of_three + 4 * pixels * first, 4 * pixels, number, pixels, of_nine)
            _add_lines(of_three + row + 4 * pixels * first, 4 * pixels, number, pixels, of_nine + 4 * nine[0].size)
            out.distance[by, bx], out.sure[by, bx], out.haze[by, bx] = np.nan, CANDIDATE, 1.0
            if not _light_above(room, pixels, reach, excess) > 0.0:
                continue
            for i in range(pixels):
                if above[i] > 0.0:
                    sure, more = _stands_out(nine, i + _AROUND, reach)
                    if sure > out.sure[by, bx]:
                        out.distance[by, bx] = i - (pixels - 1 if side > 0 else 0)
                        out.sure[by, bx], out.haze[by, bx] = sure, more
    keep_alive(three, nine, above)


@numba.njit(cache=True, nogil=True)
def _add_lines(first: int, apart: int, number: int, size: int, total: int) -> None:
    """Write the sum of `number` lines of `size` float32, `apart` bytes from one another. first, total: addresses."""
    for i in range(0, size, LANES):
        lines = load_float32(first, i)
        for k in range(1, number):
            lines = lines + load_float32(first + k * apart, i)
        store_float32(total, i, lines)


@numba.njit(cache=True, nogil=True)
def _light_above(room: int, pixels: int, reach: int, excess: int) -> np.float32:
    """Write to `excess` by how many ones the light around each pixel exceeds CANDIDATE standard deviations. Returns the
    largest excess, at least 0. room, excess: addresses."""
    row, most = pixels + 2 * _AROUND, zero_float32()
    for i in range(0, pixels, LANES):
        ones, expected = zero_float32(), zero_float32()
        for k in range(_AROUND - reach, _AROUND + reach + 1):
            ones = ones + load_float32(room, i + k)
            expected = expected + load_float32(room, row + i + k)
        noise = square_root(expected + np.float32(1.0)) * CANDIDATE
        above = ones - expected - noise
        most = larger_float(most, above)
        store_float32(excess, i, above)
    return np.float32(largest_float(most))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _stands_out(sums: Float32, i: int, reach: int) -> tuple[float, float]:
    """Light around i above the haze that its ring shows, in standard deviations, and ratio of that haze to the learned.

    (0, 1) if too few pixels of the ring were seen (LEAST_RING). sums[0]: ones; sums[1]: ones expected.
    """
    n, e = sums[0, i - reach : i + reach + 1].sum(), sums[1, i - reach : i + reach + 1].sum()
    more = 1.0
    # Light that falls off to one side only is a halo of the stripe, or haze that was learned too weak.
    for start in (i - reach - GAP_PX - RING_PX, i + reach + 1 + GAP_PX):
        ring, asked = sums[0, start : start + RING_PX].sum(), sums[1, start : start + RING_PX].sum()
        if not asked > LEAST_RING * e * RING_PX / (2 * reach + 1):
            return 0.0, 1.0
        more = max(more, (ring + 1.0) / (asked + 1.0))
    more = 1.0 + STEEPER * (more - 1.0)
    return (n - e * more) / np.sqrt(e * more + 1.0), more


@numba.njit(cache=True, nogil=True, error_model="numpy")
def measure_seconds(
    counts: Counts, n_frames: Int32, sweep: Sweep, state: RowState, still: Float32, x_far: Float64, side: int,
    apart: float, reach: int, x_px: Float32, haze: Float32, first_row: int, last_row: int, out: SecondReturns,
) -> None:  # fmt: skip
    """Fill ones, expected, light and moment of rows first_row..last_row-1 for candidates at `out.distance`.

    Pixels near the stripe are left out. 0 without candidate or stripe. state, still, apart, reach: see `SecondLight`;
    haze: of `Candidates`.
    """
    width = sweep.u.shape[1]
    alone = still[LANES:-LANES].reshape(sweep.u.shape)
    for y in range(first_row, last_row):
        for c in range(x_px.shape[1]):
            # Clear the values of an earlier map: neighbours pool them wherever the distance is known.
            out.ones[y, c] = out.expected[y, c] = out.light[y, c] = out.moment[y, c] = 0.0
            place = np.float32(x_far[y, c]) + out.distance[y, c]
            if np.isnan(place) or np.isnan(x_px[y, c]) or sweep.x_lo[y, c] > sweep.x_hi[y, c]:
                continue
            lo, hi = with_rays(sweep.u, y, max(sweep.x0[c], 0), min(sweep.x0[c] + sweep.window, width) - 1)
            x, frames = int(np.rint(place)), np.float32(n_frames[c])
            at = min(max(x, sweep.x_lo[y, c]), sweep.x_hi[y, c])
            path_p, strength = line_light(sweep, state, y, c, at)
            # Mean of the haze on both sides: at the candidate, it may contain light of the second surface itself.
            near, far = max(at - HAZE_STEP // 2, lo), min(at + HAZE_STEP // 2, hi)
            before, behind, _, _, _, _, _ = fluxes_at(sweep, state, y, near, c, path_p, strength)
            before_too, behind_too, _, _, _, _, _ = fluxes_at(sweep, state, y, far, c, path_p, strength)
            more = haze[y // BLOCK, c // BLOCK]
            before = np.exp(np.float32(-0.5) * more * (before + before_too))
            behind = np.exp(np.float32(-0.5) * more * (behind + behind_too))
            for t in range(max(x - reach, lo), min(x + reach, hi) + 1):
                if abs(t - x_px[y, c]) < apart or alone[y, t] == LEFT_OUT:
                    continue
                clear = before if (t - x_px[y, c]) * side < 0 else behind
                n = np.float32(counts[c, y, t - sweep.x0[c]])
                e = (np.float32(1.0) - clear * alone[y, t]) * frames
                out.ones[y, c] += n
                out.expected[y, c] += e
                out.light[y, c] += n - e
                out.moment[y, c] += (n - e) * (t - place)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def move_seconds(reach: int, first_row: int, last_row: int, seconds: SecondReturns) -> None:
    """Fill moved: each candidate's distance after a shift by up to `reach` px to the centroid of the light around it,
    pooled over neighbours."""
    moved = seconds.moved
    distance = with_margin(seconds.distance, first_row, last_row)
    moment, light = with_margin(seconds.moment, first_row, last_row), with_margin(seconds.light, first_row, last_row)
    sums = np.empty((2, distance.shape[1] - 2 * LANES), np.float32)
    for y in range(first_row, last_row):
        if np.isnan(seconds.distance[y]).all():
            moved[y] = np.nan
            continue
        pool_row(distance, moment, light, y - first_row, REACH, sums)
        for c in range(moved.shape[1]):
            step = sums[0, c] / sums[1, c] if sums[1, c] > 0.0 else np.float32(0.0)
            moved[y, c] = seconds.distance[y, c] + min(max(step, np.float32(-reach)), np.float32(reach))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def judge_seconds(
    x_far: Float64, x_px: Float32, sure: Float32, first_row: int, last_row: int, seconds: SecondReturns, x2_px: Float32,
    confidence2: Float32,
) -> None:  # fmt: skip
    """Fill x2_px and confidence2 of rows first_row..last_row-1; NaN and 0 where nothing stands out.

    The light of a candidate in standard deviations, pooled over neighbours, is the square root of twice the gain in
    log-likelihood of Poisson counts. This holds for few photons too. sure: of `Candidates`.
    """
    distance = with_margin(seconds.distance, first_row, last_row)
    ones, expected = with_margin(seconds.ones, first_row, last_row), with_margin(seconds.expected, first_row, last_row)
    sums = np.empty((2, distance.shape[1] - 2 * LANES), np.float32)
    for y in range(first_row, last_row):
        x2_px[y], confidence2[y] = np.nan, 0.0
        if np.isnan(seconds.distance[y]).all():
            continue
        pool_row(distance, ones, expected, y - first_row, REACH, sums)
        for c in range(x_px.shape[1]):
            n, e = sums[0, c], max(sums[1, c], np.float32(1e-3))
            if n > e and not np.isnan(x_px[y, c]):
                own = np.sqrt(2.0 * max(n * np.log(n / e) - (n - e), 0.0))
                odds = LOG_ODDS[0] + LOG_ODDS[1] * own + LOG_ODDS[2] * sure[y // BLOCK, c // BLOCK]
                x2_px[y, c], confidence2[y, c] = x_far[y, c] + seconds.distance[y, c], 1.0 / (1.0 + np.exp(-odds))


APART_PX = 2.0
"""Light farther from a stripe than this plus LINE_SIGMAS standard deviations of the line is not the stripe's own."""
LINE_SIGMAS = 2.5
LIGHT_SIGMAS = 1.5
"""Standard deviations of the line, on either side of a candidate, over which its light is summed."""


class SecondLight(NamedTuple):
    """Inputs of the search for second returns that depend on the model; made once per model by `second_light`.

    state: without ambient light. still: float32, rows x width numbers with LANES zeros at either end, the probability
    that a pixel stays dark under ambient light alone; LEFT_OUT for hot pixels (`hot_in_bands`) and those that must not
    be used. place: of `line_places`. apart: px from a stripe within which light counts as its own. reach: px to either
    side of a candidate over which its light is summed.
    """

    state: RowState
    still: Float32
    place: Int16
    apart: float
    reach: int


def second_light(state: RowState, line_sigma_px: float, grid: LabelGrid, sweep: Sweep) -> SecondLight:
    """The inputs of the search under `state`, for a line of this standard deviation."""
    still = np.where(hot_in_bands(state.ambient), LEFT_OUT, np.exp(-state.ambient))
    return SecondLight(
        state._replace(ambient=np.zeros_like(state.ambient)),
        np.pad(still.ravel(), LANES),
        line_places(sweep, grid.x_far, grid.side, grid.labels // PER_PX),
        APART_PX + LINE_SIGMAS * line_sigma_px,
        max(int(np.rint(LIGHT_SIGMAS * line_sigma_px)), 1),
    )


class SecondRoom(NamedTuple):
    """Working memory of the search, used for all maps, since new memory is slow."""

    blocks: Blocks
    candidates: Candidates
    seconds: SecondReturns


def second_room(grid: LabelGrid) -> SecondRoom:
    """Working memory for maps of these labels."""
    rows, columns = grid.x_far.shape
    shape = -(-rows // BLOCK), -(-columns // BLOCK)
    return SecondRoom(
        Blocks(*(aligned_zeros((*shape, grid.labels // PER_PX), np.float32) for _ in Blocks._fields)),
        Candidates(*(np.empty(shape, np.float32) for _ in Candidates._fields)),
        SecondReturns(*(np.empty((rows, columns), np.float32) for _ in SecondReturns._fields)),
    )


def second_returns(
    volume: CountVolume, grid: LabelGrid, sweep: Sweep, light: SecondLight, x_px: Float32, room: SecondRoom,
    workers: RowWorkers,
) -> tuple[Float32, Float32]:  # fmt: skip
    """x2_px and confidence2 (rows, columns) beside stripes at x_px; NaN and 0 where nothing stands out."""
    rows, columns = x_px.shape
    blocks, candidates, seconds = room
    # It is read by address, so its type must be int32.
    n_frames = np.ascontiguousarray(volume.n_frames, np.int32)
    seen = volume.counts, n_frames, sweep, light.state, light.still
    reach, side, apart, block_rows = light.reach, grid.side, light.apart, len(candidates.distance)

    x2_px, confidence2 = (np.empty((rows, columns), np.float32) for _ in range(2))

    def look(first: int, last: int) -> None:
        sum_blocks(*seen, light.place, side, apart, x_px, first, last, blocks)
        here = slice(first * BLOCK, last * BLOCK)
        seconds.distance[here] = x2_px[here] = np.nan  # also in rows without candidates: neighbours read them
        confidence2[here] = 0.0

    workers.over(block_rows, look)
    workers.over(block_rows, lambda first, last: find_candidates(blocks, reach, side, first, last, candidates))
    # At least one row of blocks, so that nothing is left to compile for the first second return of a scan.
    asked = np.flatnonzero(np.isfinite(candidates.distance).any(axis=1))
    asked = asked if len(asked) else np.array([0])

    def of_asked(work: Work) -> None:
        def each(first: int, last: int) -> None:
            for run in np.split(asked[first:last], np.flatnonzero(np.diff(asked[first:last]) > 1) + 1):
                work(int(run[0]) * BLOCK, min((int(run[-1]) + 1) * BLOCK, rows))

        workers.over(len(asked), each)

    def measure(first: int, last: int) -> None:
        measure_seconds(*seen, grid.x_far, side, apart, reach, x_px, candidates.haze, first, last, seconds)

    def begin(first: int, last: int) -> None:
        here = candidates.distance[first // BLOCK : -(-last // BLOCK)].repeat(BLOCK, 0).repeat(BLOCK, 1)
        seconds.distance[first:last] = here[: last - first, :columns]
        measure(first, last)

    def measure_moved(first: int, last: int) -> None:
        seconds.distance[first:last] = seconds.moved[first:last]
        measure(first, last)

    def judge(first: int, last: int) -> None:
        judge_seconds(grid.x_far, x_px, candidates.sure, first, last, seconds, x2_px, confidence2)

    for work in (begin, lambda first, last: move_seconds(reach, first, last, seconds), measure_moved, judge):
        of_asked(work)
    return x2_px, confidence2


SPECK: Final = 4
"""A speck is smaller than so many rows and columns: none of the answers that far around lies on its surface."""
SPECK_SURE: Final = 0.5
"""Least confidence of the second return behind a speck."""
SPECK_AMONG: Final = 0.4
"""Least share of the answers around a speck that must lie on the surface behind it."""
SPECK_LIT: Final = 3.0
"""Least log-likelihood ratio, from the row's own counts, of half the surface's light at the second return to none."""


@numba.njit(cache=True, nogil=True, error_model="numpy")
def find_specks(
    distance: Float32, distance2: Float32, confidence2: Float32, signal: Float32, n_frames: Int32, ones: Float32,
    expected: Float32, first_row: int, last_row: int, speck: Bools,
) -> None:  # fmt: skip
    """Fill speck (rows, columns), whether answers of rows first_row..last_row-1 are specks before a lit surface.

    distance, distance2: of answer and second return from the far end in px, NaN where there is none; signal: of
    `StripeTable`; ones, expected: of `SecondReturns`. The light is tested on the speck's own row, since the surface
    around a small opaque thing is lit too. Arrays are float32 (rows, columns), n_frames (columns,).
    """
    rows, columns = distance.shape
    for y in range(first_row, last_row):
        for c in range(columns):
            speck[y, c] = False
            behind = distance2[y, c]
            if not (confidence2[y, c] >= SPECK_SURE and abs(behind) < abs(distance[y, c])):
                continue
            same, among, light, cells = 0, 0, 0.0, 0
            for row in range(y - SPECK, y + SPECK + 1):
                for column in range(c - SPECK, c + SPECK + 1):
                    if not (0 <= row < rows and 0 <= column < columns):
                        continue
                    cells += 1
                    edge = max(abs(row - y), abs(column - c)) == SPECK
                    if edge and abs(distance[row, column] - distance[y, c]) <= SAME_PX:
                        same += 1
                    if abs(distance[row, column] - behind) <= SAME_PX:
                        among += 1
                        light += signal[row, column]
                if same:
                    break
            if same or among < SPECK_AMONG * cells:
                continue
            usual = n_frames[c] * -np.expm1(-0.5 * light / among)
            n, e = ones[y, c], max(expected[y, c], np.float32(1e-3))
            speck[y, c] = n * np.log1p(usual / e) - usual > SPECK_LIT


@numba.njit(cache=True, nogil=True, error_model="numpy")
def exchange(
    distance: Float32, distance2: Float32, speck: Bools, first_row: int, last_row: int, table: StripeArrays
) -> None:
    """Exchange both returns where rows first_row..last_row-1 have specks.

    The answer gets the mean x_sd_px, signal and haze of the answers around it on its new surface, and the smaller of
    the second return's confidence and their mean confidence. table: the arrays of a `StripeTable`.
    """
    x_px, confidence, sd_px, signal, haze, x2_px, confidence2 = table
    rows, columns = distance.shape
    for y in range(first_row, last_row):
        for c in range(columns):
            if not speck[y, c]:
                continue
            number, sums = 0, np.zeros(4)
            for row in range(max(y - SPECK, 0), min(y + SPECK + 1, rows)):
                for column in range(max(c - SPECK, 0), min(c + SPECK + 1, columns)):
                    if not speck[row, column] and abs(distance[row, column] - distance2[y, c]) <= SAME_PX:
                        number += 1
                        sums[0] += confidence[row, column]
                        sums[1] += sd_px[row, column]
                        sums[2] += signal[row, column]
                        sums[3] += haze[row, column]
            if number:
                x_px[y, c], x2_px[y, c] = x2_px[y, c], x_px[y, c]
                sure, confidence2[y, c] = confidence2[y, c], confidence[y, c]
                confidence[y, c] = min(sure, np.float32(sums[0] / number))
                sd_px[y, c], signal[y, c], haze[y, c] = sums[1] / number, sums[2] / number, sums[3] / number


def behind_specks(
    stripes: StripeTable, n_frames: Int32, grid: LabelGrid, room: SecondRoom, workers: RowWorkers
) -> StripeTable:
    """The table with both returns exchanged, in place, where the answer is a speck before a lit surface.

    room: as `second_returns` has left it for these stripes.
    """
    x2_px, confidence2 = stripes.x2_px, stripes.confidence2
    assert x2_px is not None, "second returns have been looked for"
    assert confidence2 is not None, "second returns have been looked for"
    rows = len(x2_px) if (confidence2 >= SPECK_SURE).any() else 0
    far, n_frames = grid.x_far[:rows].astype(np.float32), np.ascontiguousarray(n_frames, np.int32)
    distance, distance2 = stripes.x_px[:rows] - far, x2_px[:rows] - far
    speck, (_, ones, expected, *_) = np.zeros(distance.shape, np.bool_), room.seconds
    table = (stripes.x_px, stripes.confidence, stripes.x_sd_px, stripes.signal, stripes.haze, x2_px, confidence2)

    def find(first: int, last: int) -> None:
        find_specks(distance, distance2, confidence2, stripes.signal, n_frames, ones, expected, first, last, speck)

    def both(first: int, last: int) -> None:
        exchange(distance, distance2, speck, first, last, table)

    if not rows:
        # No row, so that nothing is left to compile for the first speck of a scan.
        find(0, 0)
        both(0, 0)
        return stripes
    workers.over(rows, find)
    workers.over(rows, both)
    return stripes
