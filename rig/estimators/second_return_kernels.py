"""Compiled search for light of a second surface beside each stripe: a pane before a wall, a twig, a flake of snow.

Such light stands off the haze by too little for a row alone, and rows that see both surfaces answer with one of them.
So light is summed over blocks of rows and columns at equal distances from the far end first, pixel by pixel of
distance, and compared with what haze and ambient light bring; then each row is asked itself, with its neighbours.
"""

from typing import Final, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rig.estimators.placing_kernels import Float32
from rig.estimators.placing_pools import pool_row
from rig.estimators.row_input import State, Sweep, fluxes_at, line_light, with_rays

BLOCK: Final = 4
"""Rows, and columns, whose light is summed at once; a block is judged together with its eight neighbours."""
HAZE_STEP: Final = 8
"""Pixels from one place where haze is worked out to the next."""
RING_PX: Final = 4
"""Pixels to either side of where light is looked for that tell whether haze is as strong as was learned."""
GAP_PX: Final = 1
"""Pixels between the two."""
APART_PX: Final = 2.0
"""Light so far from a stripe, and further by LINE_SIGMAS widths of the line, is not its own."""
LINE_SIGMAS: Final = 2.5
LEAST_RING: Final = 0.25
"""Share of those pixels that must be seen on each side."""
STEEPER: Final = 1.5
"""Haze that the ring shows beyond the learned one may be this much more between its two sides: it is not straight."""
CANDIDATE: Final = 4.0
"""Standard deviations from which a block's light is looked at more closely."""
REACH: Final = 3
"""Rows and columns to either side that light is pooled over in the end."""


class Blocks(NamedTuple):
    """Sums per block: float32 (block rows, block columns, pixels of distance): ones, and those that were expected."""

    ones: Float32
    expected: Float32


class Candidates(NamedTuple):
    """What stands out most in each block and its neighbours, float32 (block rows, block columns) each.

    distance: from the far end in px, NaN where nothing does; sure: standard deviations by which its light does; haze:
    how much stronger haze is there than was learned, at least 1.
    """

    distance: Float32
    sure: Float32
    haze: Float32


class Seconds(NamedTuple):
    """What is known of second returns, float32 (rows, columns) each.

    distance: from the far end in px, NaN where there is no candidate; ones, expected: within the line's reach of it;
    light, moment: ones above those expected, and that times the distance in px.
    """

    distance: Float32
    ones: Float32
    expected: Float32
    light: Float32
    moment: Float32


@numba.njit(cache=True, nogil=True, error_model="numpy")
def sum_blocks(
    counts: NDArray[np.unsignedinteger],
    n_frames: NDArray[np.int32],
    sweep: Sweep,
    state: State,
    dark: Float32,
    x_far: NDArray[np.float64],
    side: int,
    apart: float,
    x_px: Float32,
    first_block: int,
    last_block: int,
    out: Blocks,
) -> None:
    """Fill the sums of rows of blocks first_block..last_block-1, without what lies within `apart` px of stripes x_px.

    Haze is taken from the middle of each block: it changes slowly. state: without ambient light; dark: (rows, width),
    probability of a one by that alone, NaN for pixels that are left out.
    """
    rows, columns = x_px.shape
    width, pixels = sweep.u.shape[1], out.ones.shape[2]
    knots = -(-pixels // HAZE_STEP) * HAZE_STEP + 1
    left, right = np.zeros(knots, np.float32), np.zeros(knots, np.float32)
    for by in range(first_block, last_block):
        out.ones[by] = 0.0
        out.expected[by] = 0.0
        for bx in range(out.ones.shape[1]):
            my, mc = min(by * BLOCK + BLOCK // 2, rows - 1), min(bx * BLOCK + BLOCK // 2, columns - 1)
            if np.isnan(x_far[my, mc]):
                continue
            _haze_beside(sweep, state, my, mc, leftmost(x_far[my, mc], side, pixels), side, left, right)
            ones, expected = out.ones[by, bx], out.expected[by, bx]
            for y in range(by * BLOCK, min(by * BLOCK + BLOCK, rows)):
                for c in range(bx * BLOCK, min(bx * BLOCK + BLOCK, columns)):
                    if np.isnan(x_px[y, c]) or np.isnan(x_far[y, c]):
                        continue
                    start, x0 = leftmost(x_far[y, c], side, pixels), sweep.x0[c]
                    begin = max(sweep.x_lo[y, c], x0, 0, start)
                    end = max(min(sweep.x_hi[y, c], x0 + sweep.window - 1, width - 1, start + pixels - 1) + 1, begin)
                    stop = min(max(int(np.ceil(x_px[y, c] - apart)), begin), end)
                    on = max(min(int(np.floor(x_px[y, c] + apart)) + 1, end), begin)
                    line, alone, frames = counts[c, y], dark[y], np.float32(n_frames[c])
                    for first, last, haze in ((begin, stop, left), (on, end, right)):
                        _add_line(
                            line[first - x0 : last - x0], alone[first:last], frames, haze[first - start : last - start],
                            ones[first - start : last - start], expected[first - start : last - start],
                        )  # fmt: skip


@numba.njit(inline="always")
def leftmost(x_far, side, pixels):  # type: ignore[no-untyped-def]
    """Pixel that the first of so many pixels of distance is at: they run from left to right."""
    return int(np.rint(x_far)) - (pixels - 1 if side > 0 else 0)


@numba.njit(cache=True, nogil=True)
def _haze_beside(
    sweep: Sweep, state: State, y: int, c: int, start: int, side: int, left: Float32, right: Float32
) -> None:
    """Probability of a one by haze left and right of a stripe, in pixels from `start` on.

    Straight lines between every HAZE_STEP pixels; both as long as a multiple of that, and one more. Pixels without a
    ray have that of the nearest one with a ray.
    """
    first, last = with_rays(sweep.u, y, 0, sweep.u.shape[1] - 1)
    path_p, strength = line_light(sweep, state, y, c, min(max(start, sweep.x_lo[y, c]), sweep.x_hi[y, c]))
    for i in range(0, len(left), HAZE_STEP):
        before, behind, _, _, _, _, _ = fluxes_at(
            sweep, state, y, min(max(start + i, first), last), c, path_p, strength
        )
        if side < 0:
            before, behind = behind, before
        left[i], right[i] = -np.expm1(-before), -np.expm1(-behind)
        for k in range(max(i - HAZE_STEP + 1, 0), i):
            part = np.float32((i - k) / HAZE_STEP)
            left[k] = left[i] + part * (left[i - HAZE_STEP] - left[i])
            right[k] = right[i] + part * (right[i - HAZE_STEP] - right[i])


@numba.njit(cache=True, nogil=True)
def _add_line(
    line: NDArray[np.unsignedinteger],
    dark: Float32,
    frames: np.float32,
    haze: Float32,
    ones: Float32,
    expected: Float32,
) -> None:
    for i in range(len(line)):
        out = np.isnan(dark[i])
        ones[i] += np.float32(0.0) if out else np.float32(line[i])
        expected[i] += np.float32(0.0) if out else frames * (haze[i] + (np.float32(1.0) - haze[i]) * dark[i])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def find_candidates(blocks: Blocks, reach: int, side: int, first_block: int, last_block: int, out: Candidates) -> None:
    """Fill rows of blocks first_block..last_block-1. reach: of the line's light, px."""
    rows, columns, pixels = blocks.ones.shape
    span = reach + GAP_PX + RING_PX
    ones, expected = np.zeros(pixels + 2 * span + 1), np.zeros(pixels + 2 * span + 1)
    for by in range(first_block, last_block):
        for bx in range(columns):
            ones[:] = 0.0
            expected[:] = 0.0
            for y in range(max(by - 1, 0), min(by + 2, rows)):
                for x in range(max(bx - 1, 0), min(bx + 2, columns)):
                    for i in range(pixels):
                        ones[span + 1 + i] += blocks.ones[y, x, i]
                        expected[span + 1 + i] += blocks.expected[y, x, i]
            for i in range(1, len(ones)):
                ones[i] += ones[i - 1]
                expected[i] += expected[i - 1]
            out.distance[by, bx], out.sure[by, bx], out.haze[by, bx] = np.nan, CANDIDATE, 1.0
            for i in range(pixels):
                a, b = span + i - reach, span + i + reach + 1
                n, e = ones[b] - ones[a], expected[b] - expected[a]
                if n - e < out.sure[by, bx] * np.sqrt(e + 1.0):
                    continue
                more = 1.0
                # Light that only falls off to one side is a halo of the stripe or haze that was learned too weak.
                for start in (a - GAP_PX - RING_PX, b + GAP_PX):
                    ring, asked = ones[start + RING_PX] - ones[start], expected[start + RING_PX] - expected[start]
                    seen = asked > LEAST_RING * e * RING_PX / (b - a)
                    more = max(more, (ring + 1.0) / (asked + 1.0)) if seen else np.inf
                if np.isinf(more):
                    continue
                more = 1.0 + STEEPER * (more - 1.0)
                sure = (n - e * more) / np.sqrt(e * more + 1.0)
                if sure > out.sure[by, bx]:
                    out.distance[by, bx] = i - (pixels - 1 if side > 0 else 0)
                    out.sure[by, bx], out.haze[by, bx] = sure, more


@numba.njit(cache=True, nogil=True, error_model="numpy")
def measure_seconds(
    counts: NDArray[np.unsignedinteger],
    n_frames: NDArray[np.int32],
    sweep: Sweep,
    state: State,
    dark: Float32,
    x_far: NDArray[np.float64],
    side: int,
    apart: float,
    reach: int,
    x_px: Float32,
    haze: Float32,
    first_row: int,
    last_row: int,
    out: Seconds,
) -> None:
    """Fill all but distance of rows first_row..last_row-1; zeros where there is no candidate or a stripe is near.

    state, dark: as `sum_blocks`; haze: of `Candidates`.
    """
    width = sweep.u.shape[1]
    for y in range(first_row, last_row):
        for c in range(x_px.shape[1]):
            out.ones[y, c] = out.expected[y, c] = out.light[y, c] = out.moment[y, c] = 0.0
            place = np.float32(x_far[y, c]) + out.distance[y, c]
            if np.isnan(place) or np.isnan(x_px[y, c]) or sweep.x_lo[y, c] > sweep.x_hi[y, c]:
                continue
            lo, hi = with_rays(sweep.u, y, max(sweep.x0[c], 0), min(sweep.x0[c] + sweep.window, width) - 1)
            x, frames = int(np.rint(place)), np.float32(n_frames[c])
            at = min(max(x, sweep.x_lo[y, c]), sweep.x_hi[y, c])
            path_p, strength = line_light(sweep, state, y, c, at)
            # Of both sides: what the lesson of the haze took for haze may be light of the second surface itself.
            near, far = max(at - HAZE_STEP // 2, lo), min(at + HAZE_STEP // 2, hi)
            before, behind, _, _, _, _, _ = fluxes_at(sweep, state, y, near, c, path_p, strength)
            before_too, behind_too, _, _, _, _, _ = fluxes_at(sweep, state, y, far, c, path_p, strength)
            more = haze[y // BLOCK, c // BLOCK]
            before = -np.expm1(np.float32(-0.5) * more * (before + before_too))
            behind = -np.expm1(np.float32(-0.5) * more * (behind + behind_too))
            for t in range(max(x - reach, lo), min(x + reach, hi) + 1):
                if abs(t - x_px[y, c]) < apart or np.isnan(dark[y, t]):
                    continue
                veil = before if (t - x_px[y, c]) * side < 0 else behind
                n = np.float32(counts[c, y, t - sweep.x0[c]])
                e = (veil + (np.float32(1.0) - veil) * dark[y, t]) * frames
                out.ones[y, c] += n
                out.expected[y, c] += e
                out.light[y, c] += n - e
                out.moment[y, c] += (n - e) * (t - place)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def move_seconds(reach: int, first_row: int, last_row: int, seconds: Seconds, moved: Float32) -> None:
    """Distance of each candidate, moved to the middle of the light around it, pooled over neighbours."""
    sums = np.empty((2, moved.shape[1]), np.float32)
    for y in range(first_row, last_row):
        if np.isnan(seconds.distance[y]).all():
            moved[y] = np.nan
            continue
        pool_row(seconds.distance, seconds.moment, seconds.light, y, REACH, sums)
        for c in range(moved.shape[1]):
            step = sums[0, c] / sums[1, c] if sums[1, c] > 0.0 else np.float32(0.0)
            moved[y, c] = seconds.distance[y, c] + min(max(step, np.float32(-reach)), np.float32(reach))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def judge_seconds(first_row: int, last_row: int, seconds: Seconds, sure: Float32) -> None:
    """Standard deviations by which each candidate's light stands out, pooled over neighbours; 0 without candidate.

    That is the signed root of twice the gain in log-likelihood of Poisson counts: right for few photons, too.
    """
    sums = np.empty((2, sure.shape[1]), np.float32)
    for y in range(first_row, last_row):
        sure[y] = 0.0
        if np.isnan(seconds.distance[y]).all():
            continue
        pool_row(seconds.distance, seconds.ones, seconds.expected, y, REACH, sums)
        for c in range(sure.shape[1]):
            n, e = sums[0, c], max(sums[1, c], np.float32(1e-3))
            gain = n * np.log(n / e) - (n - e) if n > e else np.float32(0.0)
            sure[y, c] = np.sqrt(max(np.float32(2.0) * gain, np.float32(0.0)))
