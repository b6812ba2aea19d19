"""The stripe table of `joint`, compiled: light of each answer, and the probability that it lies within a pixel of a
stripe.

Three things can be wrong with an answer, and each has its factor:

    confidence = erf(1 / (sqrt 2 WIDER sd))                    the stripe is more than a pixel off
               / (1 + exp(A - B margin + G apart))             another position is the right one
               / (1 + exp(C - D ln contrast' + hole            there is no stripe: haze ends, nothing shines
                          + g (E - F ln odds) + H ((1 - g)^2 missing + e unseen)))

- margin: how much more the next best position costs or, after a vote, how much neighbours favour this one, in cost
  divided by UNITS. apart: share of the pairs of opposite neighbours that put the answer elsewhere (`apart_row`).
- contrast: mean light of the 3 x 3 neighbours on the surface above the *whole* haze before the stripe, divided by the
  noise of this mean; contrast' = max(contrast + 3, 1). The whole haze, because an answer can lie a little before the
  end of haze, and half of the haze would then be taken for light. hole: by how much contrast is below -FAR_BELOW, 30 at
  most.
- odds: ratio of pairs of answers around that agree to those that do not (`agreement_row`). The more haze ends at the
  stripe, the more the odds count: by the factor g = k / (k + SOME_HAZE), with k photons of that haze per pixel in all
  exposures. In clear air only stripes give a margin; small things, although their surroundings do not agree, are as
  certain as others there.
- missing: max(ln((1 + bright) / (1 + light)) - DARKER - CLEARLY max(contrast, 0), 0), with light: photons of the 3 x 3
  neighbours above the whole haze, in all exposures; bright: the same at the model's largest amplitude. If even a dark
  stripe would be visible, missing light means that there is no stripe. The contrast cannot show this.
- unseen: max(AT_END - CLEARLY max(contrast, 0), 0), with e = 1 up to 1 px from the far end of the depth range and 0
  from 3 px on. Haze that continues beyond the range seems to end there, so evenly that answers agree; a stripe so far
  away must be seen by its own light.

Agreement distinguishes a surface from nothing at all. Without a stripe every row finds the place where its noise looks
most like one, and four paths tie those answers into streaks but not into surfaces. Each answer has a number of 5 x 5
neighbours on the same surface (`count_neighbours`); odds come from the sum of these numbers over 7 x 7 answers
(`agreement_row`). Thin and slanted things have few such neighbours. There a wrong answer usually shows by not being at
the mean of opposite neighbours (`apart_row`).

Arrays are float32 (rows, columns), numbers of neighbours int16. Source of the constants: WIDER, B, C, D, E and F are
fitted by maximum likelihood to random cluttered scenes of a second simulator, K = 1 to 30 in air and fog, with all
answers counted. A and G are chosen on random scenes of the tests' simulator, since fitted values would make stripes
without haze too uncertain. H, DARKER, CLEARLY and AT_END are chosen by the likelihood of random scenes that are partly
open to the sky (`tests.reference.tables.open_scenes`); larger values lower the confidence of dim stripes in clear air
too much.
"""

import math
from typing import Final, NamedTuple

import cv2
import numba
import numpy as np

from rig.estimate.joint.place.places import LIGHT_PX, Places
from rig.estimate.joint.winner import UNITS, LabelAnswers
from rig.estimate.row.model import RowModel
from rig.estimate.row.neighbours import COPIED_ROWS, MARGIN, SAME_PX, on_surface, with_margin
from rig.geometry.stripe_table import StripeTable
from rig.simd import Bools, Float32, Int16, Int32
from rig.simd.functions import error_function, exponential, logarithm
from rig.simd.memory import address_of, copy_floats, keep_alive, load_float32, store_float32, store_int16
from rig.simd.vectors import LANES, larger_float, smaller_float, square_root, to_int16, where_small, zero_float32
from rig.threads import RowWorkers

NEIGHBOURS: Final = 2
"""Rows and columns to either side in which neighbours are counted."""
AROUND: Final = 3
"""Rows and columns to either side over which the numbers of neighbours are summed."""
OPPOSITE: Final = 2, 4
"""Distances, in rows and columns, from an answer to the neighbours that lie opposite each other."""
ASKED: Final = 4 * len(OPPOSITE)
"""Number of pairs of opposite neighbours: along rows, columns and both diagonals."""
_ANYWHERE: Final = np.float32(1e6)
"""In px: larger than the distance of any two answers."""


class Neighbours(NamedTuple):
    """For each answer, the number of neighbours on its surface, itself included, and the number of pairs that could
    agree.

    number: int16 (rows, columns) with a margin of AROUND rows and LANES columns that holds 0. pairs: of `pairs_to_ask`.
    """

    number: Int16
    pairs: Float32


def new_neighbours(pairs: Float32) -> Neighbours:
    """Memory for the neighbours of a map. pairs: of `pairs_to_ask`."""
    rows, columns = pairs.shape
    return Neighbours(np.zeros((rows + 2 * AROUND, (-(-columns // LANES) + 2) * LANES), np.int16), pairs)


def pairs_to_ask(there: Bools) -> Float32:
    """Number of pairs around each answer that could agree (`agreement_row`), at least 1: (rows, columns).

    there: whether an answer is searched and has frames; others are in no pair.
    """
    weight = there.astype(np.float32)
    return np.maximum(_around(weight * _around(weight, NEIGHBOURS), AROUND), np.float32(1))


def _around(number: Float32, reach: int) -> Float32:
    """Sums of whole numbers over `reach` rows and columns to either side, with 0 beyond the array."""
    side = 2 * reach + 1
    return np.asarray(cv2.boxFilter(number, -1, (side, side), normalize=False, borderType=cv2.BORDER_CONSTANT))


@numba.njit(cache=True, nogil=True)
def count_neighbours(distance: Float32, first_row: int, last_row: int, out: Neighbours) -> None:
    """Fill `Neighbours.number` of rows first_row..last_row-1.

    distance: (rows, columns), of answers from the far end in px, NaN where there is no answer.
    """
    for band in range(first_row, last_row, COPIED_ROWS):
        end = min(band + COPIED_ROWS, last_row)
        copy = with_margin(distance, band, end)
        for y in range(band, end):
            _count_row(copy, y - band + MARGIN, out.number[y + AROUND, LANES:])


@numba.njit(cache=True, nogil=True)
def _count_row(distance: Float32, row: int, number: Int16) -> None:
    """Write, for each answer of a row, how many of the 5 x 5 answers around it, itself included, lie on its surface.

    distance: a copy `with_margin`; row: of the copy.
    """
    width, at, one = distance.shape[1], address_of(distance), zero_float32() + np.float32(1.0)
    for c in range(0, width - 2 * LANES, LANES):
        here = row * width + LANES + c
        own, same = load_float32(at, here), zero_float32()
        for away in range(-NEIGHBOURS, NEIGHBOURS + 1):
            line = here + away * width
            for near in range(line - NEIGHBOURS, line + NEIGHBOURS + 1):
                same = same + where_small(one, load_float32(at, near) - own, SAME_PX)
        store_int16(address_of(number), c, to_int16(same))


@numba.njit(cache=True, nogil=True)
def agreement_row(number: Int16, y: int, line: Int16, out: Float32) -> None:
    """Write, for each answer of row y, the number of pairs that agree: an answer of the 7 x 7 around and a neighbour on
    its surface.

    number: as in `Neighbours`; line: working memory of the same width, whose margins are 0.
    """
    columns = number.shape[1] - 2 * LANES
    own = line[LANES:]
    own[:columns] = 0
    for row in range(y, y + 2 * AROUND + 1):
        near = number[row, LANES:]
        for c in range(columns):
            own[c] += near[c]
    out[:columns] = 0.0
    for left in range(LANES - AROUND, LANES + AROUND + 1):
        near = line[left:]
        for c in range(columns):
            out[c] += np.float32(near[c])


@numba.njit(cache=True, nogil=True)
def apart_row(placed: Float32, row: int, out: Float32) -> None:
    """Write, for each answer of a row, the number of pairs of opposite neighbours whose mean is not within SAME_PX of
    it. A pair with a missing neighbour does not count.

    placed: a copy `with_margin` of final distances; row: of the copy.
    """
    width, at, one, half = placed.shape[1], address_of(placed), zero_float32() + np.float32(1.0), np.float32(0.5)
    for c in range(0, width - 2 * LANES, LANES):
        here = row * width + LANES + c
        own, apart = load_float32(at, here), zero_float32()
        for step in OPPOSITE:
            for away in (1, width - 1, width, width + 1):
                off = (load_float32(at, here - step * away) + load_float32(at, here + step * away)) * half - own
                # A pair of which one is missing, NaN, counts in neither term.
                apart = apart + where_small(one, off, _ANYWHERE) - where_small(one, off, SAME_PX)
        store_float32(address_of(out), c, apart)


@numba.njit(cache=True, nogil=True)
def light_row(distance: Float32, light: Float32, row: int, number: Float32, total: Float32) -> None:
    """Write the number of 3 x 3 neighbours on the surface of each answer of a row, itself included, and their total
    light.

    distance, light: copies `with_margin`; row: of these copies.
    """
    width, at, to_add = distance.shape[1], address_of(distance), address_of(light)
    for c in range(0, width - 2 * LANES, LANES):
        same, lit = on_surface(at, to_add, row * width + LANES + c, width, 1)
        store_float32(address_of(number), c, same)
        store_float32(address_of(total), c, lit)


WIDER: Final = 1.556
"""Factor on the stated standard deviation: surfaces bend, and neighbours are shared, which counts do not show."""
A: Final = 1.0
B: Final = 0.890
G: Final = 2.0
C: Final = -1.539
D: Final = 1.569
E: Final = 5.871
F: Final = 2.585
H: Final = 4.0
DARKER: Final = 2.0
"""Natural logarithm of the ratio of a bright stripe's light to that of a dark one."""
CLEARLY: Final = 1.2
"""Decrease of `missing` and `unseen` per unit of contrast."""
AT_END: Final = 3.0
"""`unseen` of an answer without any light."""
NEAR_END_PX: Final = 1.0, 3.0
SOME_HAZE: Final = 0.05
"""Photons of haze per pixel, over all exposures, at which odds count half."""
FAR_BELOW: Final = 6.0
"""A contrast below minus this is a hole where light should be, whatever the answers around."""
_HALF_PX: Final = LIGHT_PX + 0.5
"""Half the number of pixels over which a stripe's light is summed."""
_LEAST_ODDS: Final = 1e-3
_MOST_AGREE: Final = 1.02
"""Odds of agreement stay between 0.001 and 50."""
(
    _PAIRS, _LIT, _LIGHT_SUM, _SD, _SCALE, _LIGHT, _HAZE, _REST, _MARGIN, _FRAMES, _ALL, _APART, _OFF, _CONFIDENCE
) = range(14)  # fmt: skip
_LINES: Final = 14


class Brightness(NamedTuple):
    """Smallest and largest amplitude of a stripe, and the usual ambient light in photons per exposure and pixel."""

    faintest: float
    brightest: float
    ambient: float


@numba.njit(cache=True, nogil=True, error_model="numpy")
def confidences(
    x_px: Float32, sd_px: Float32, n_frames: Int32, answer: LabelAnswers, places: Places, neighbours: Neighbours,
    bright: Brightness, first_row: int, last_row: int, confidence: Float32, signal: Float32, haze: Float32,
) -> None:  # fmt: skip
    """Fill confidence, signal and haze of rows first_row..last_row-1, all (rows, columns).

    Where x_px is NaN the confidence is set to 0 and the others, including sd_px, to NaN. `count_neighbours` must have
    run.
    """
    nothing = np.float32(np.nan)
    # Local names: each use of the tuple itself in the loop would count references to all of its arrays.
    scales, lights, hazes, rests = places.scale, places.light, places.haze, places.rest
    number, margins, columns = neighbours.number, answer.margin, x_px.shape[1]
    # An odd number of cache lines per row of `lines`, so that its rows do not displace one another in the cache.
    width = (-(-columns // LANES) | 1) * LANES
    lines, pairs = np.zeros((_LINES, width), np.float32), np.zeros(number.shape[1], np.int16)
    at = address_of(lines)
    sources = (
        (address_of(sd_px), _SD), (address_of(scales), _SCALE), (address_of(lights), _LIGHT),
        (address_of(hazes), _HAZE), (address_of(rests), _REST), (address_of(neighbours.pairs), _ALL),
    )  # fmt: skip
    targets = (
        (address_of(confidence), _CONFIDENCE), (address_of(signal), _LIGHT), (address_of(haze), _HAZE),
    )  # fmt: skip
    for c in range(columns):
        lines[_FRAMES, c] = max(n_frames[c], 1)
    for band in range(first_row, last_row, COPIED_ROWS):
        end = min(band + COPIED_ROWS, last_row)
        distance, light = with_margin(places.distance, band, end), with_margin(lights, band, end)
        placed = with_margin(places.placed, band, end)
        for y in range(band, end):
            row = y - band + MARGIN
            agreement_row(number, y, pairs, lines[_PAIRS])
            light_row(distance, light, row, lines[_LIT], lines[_LIGHT_SUM])
            apart_row(placed, row, lines[_APART])
            copy_floats(address_of(distance[row, LANES:]), at + 4 * _OFF * width, columns)
            for source, line in sources:
                copy_floats(source + 4 * columns * y, at + 4 * line * width, columns)
            for c in range(columns):
                lines[_MARGIN, c] = margins[y, c]
            _judge(at, width, bright)
            for target, line in targets:
                copy_floats(at + 4 * line * width, target + 4 * columns * y, columns)
            for c in range(columns):
                if np.isnan(x_px[y, c]):
                    confidence[y, c] = 0.0
                    signal[y, c] = haze[y, c] = sd_px[y, c] = nothing
        keep_alive(distance)
    keep_alive(lines)


@numba.njit(cache=True, nogil=True)
def _judge(at: int, width: int, bright: Brightness) -> None:
    """Fill the confidence of a row's answers, and limit their light to the model's amplitudes."""
    one, none = zero_float32() + 1.0, zero_float32()
    for c in range(0, width, LANES):
        scale, light = load_float32(at, _SCALE * width + c), load_float32(at, _LIGHT * width + c)
        light = smaller_float(larger_float(light, scale * bright.faintest), scale * bright.brightest)
        store_float32(at, _LIGHT * width + c, light)
        contrast = _contrast(at, width, c, bright.ambient)
        shines = logarithm(larger_float(contrast + 3.0, one))
        hole = smaller_float(larger_float(none - FAR_BELOW - contrast, none), none + 30.0)
        pairs = larger_float(load_float32(at, _ALL * width + c), one)
        agree = load_float32(at, _PAIRS * width + c) / pairs
        agree = logarithm(agree / (none + _MOST_AGREE - agree) + _LEAST_ODDS)
        haze = load_float32(at, _FRAMES * width + c) * _ending(at, width, c)
        hazy = haze / (haze + SOME_HAZE)
        unlit = _unlit(at, width, c, larger_float(contrast, none) * CLEARLY, one - hazy, bright.brightest)
        dark = exponential(none + C - shines * D + hole + hazy * (none + E - agree * F) + unlit * H)
        margin = load_float32(at, _MARGIN * width + c)
        apart = load_float32(at, _APART * width + c)
        rival = exponential(none + A - margin * (B / UNITS) + apart * (G / ASKED))
        sd = larger_float(load_float32(at, _SD * width + c), none + 1e-3)
        within = error_function(one / (sd * (WIDER * math.sqrt(2.0))))
        store_float32(at, _CONFIDENCE * width + c, within / ((rival + 1.0) * (dark + 1.0)))


@numba.njit(forceinline=True)
def _ending(at, width, c):  # type: ignore[no-untyped-def]
    """Haze that ends at a stripe: haze before it less that behind it."""
    ends = load_float32(at, _HAZE * width + c) - load_float32(at, _REST * width + c)
    return larger_float(ends, zero_float32())


@numba.njit(forceinline=True)
def _number(at, width, c):  # type: ignore[no-untyped-def]
    """Number of the 3 x 3 answers around each answer, itself included, that lie on its surface."""
    return larger_float(load_float32(at, _LIT * width + c), zero_float32() + 1.0)


@numba.njit(forceinline=True)
def _above_haze(at, width, c):  # type: ignore[no-untyped-def]
    """Sum of the light of the answers of `_number`, photons per exposure, above the whole haze before them."""
    return load_float32(at, _LIGHT_SUM * width + c) - _ending(at, width, c) * _HALF_PX * _number(at, width, c)


@numba.njit(forceinline=True)
def _unlit(at, width, c, shines, clear, brightest):  # type: ignore[no-untyped-def]
    """(1 - g)^2 missing + e unseen, as in the module. shines: CLEARLY max(contrast, 0); clear: 1 - g."""
    one, none = zero_float32() + 1.0, zero_float32()
    exposures, number = load_float32(at, _FRAMES * width + c), _number(at, width, c)
    light, most = _above_haze(at, width, c), load_float32(at, _SCALE * width + c) * brightest * number
    less = logarithm((most * exposures + one) / (larger_float(light, none) * exposures + one))
    missing = larger_float(less - DARKER - shines, none)
    off = load_float32(at, _OFF * width + c)
    first, last = NEAR_END_PX
    at_end = smaller_float(larger_float((larger_float(off, none - off) - last) * (1.0 / (first - last)), none), one)
    return clear * clear * missing + at_end * larger_float(none + AT_END - shines, none)


@numba.njit(forceinline=True)
def _contrast(at, width, c, ambient):  # type: ignore[no-untyped-def]
    """Contrast, as in the module."""
    one, none = zero_float32() + 1.0, zero_float32()
    haze, rest = load_float32(at, _HAZE * width + c), load_float32(at, _REST * width + c)
    number, exposures = _number(at, width, c), load_float32(at, _FRAMES * width + c)
    light = load_float32(at, _LIGHT_SUM * width + c) / number
    noise = larger_float(light, none) + (haze + rest + 2.0 * ambient) * _HALF_PX + one / (exposures * 9.0)
    return _above_haze(at, width, c) * square_root(exposures / (number * noise))


def brightness_of(model: RowModel) -> Brightness:
    """Brightness of a learned state, for `stripe_table`."""
    return Brightness(float(model.amplitude[0]), float(model.amplitude[-1]), float(np.median(model.ambient)))


def stripe_table(
    x_px: Float32, sd_px: Float32, n_frames: Int32, answer: LabelAnswers, places: Places, pairs: Float32,
    bright: Brightness, workers: RowWorkers,
) -> StripeTable:  # fmt: skip
    """The stripe table of a map. n_frames: (columns,); pairs: of `pairs_to_ask`; other arrays: (rows, columns). x_px is
    NaN where there is no answer, and sd_px is set to NaN there."""
    confidence, signal, haze = (np.empty_like(x_px) for _ in range(3))
    neighbours = new_neighbours(pairs)

    def work(first: int, last: int) -> None:
        confidences(x_px, sd_px, n_frames, answer, places, neighbours, bright, first, last, confidence, signal, haze)

    workers.over(len(x_px), lambda first, last: count_neighbours(places.distance, first, last, neighbours))
    workers.over(len(x_px), work)
    return StripeTable(x_px, confidence, sd_px, signal, haze)
