"""Where the compiled label costs find their tables and keep what they work on: addresses, for `rig.lane_memory`."""

from typing import Final, NamedTuple

import numba
import numpy as np

from rig.aligned import CACHE_LINE
from rig.estimators.label_places import FAR_PX, PHASES, VARIANTS
from rig.estimators.label_tables import LIGHTS
from rig.lane_memory import address_of
from rig.lanes import LANES

BATCH: Final = LANES
"""Rows that go through each part of the work together: what one waits for, the others fill."""
SUMS_FROM: Final = LANES - 1
"""Sums up to and including a pixel belong to the next one: so they are written at whole vectors."""
POSITION: Final = PHASES * LIGHTS * LANES
"""Numbers that a vector of pixels has in a table."""


class Ways(NamedTuple):
    """How scores and costs are counted.

    units: of scores per nat, of columns with the usual number of `exposures`; bits: of the largest count; most: what a
    column's exposures may count as; sharp: exposures at which a nat is worth half as many units; down: power of two
    that scores are divided by to be costs; reach: taps on either side; side, stripes: as in `LabelGrid`; band_rows:
    rows that share tables.
    """

    units: float
    bits: int
    exposures: int
    most: int
    sharp: float
    down: int
    reach: int
    side: int
    stripes: int
    band_rows: int


class At(NamedTuple):
    """Addresses of what tables and places hold, see there, and the elements from table to table."""

    edge: int
    edge_sum: int
    pixels: int
    tap: int
    taps: int
    constant: int
    constants: int
    span: int
    used: int
    hot_start: int
    hot_x: int


class Fitted(NamedTuple):
    """Addresses of what tables say at a number of exposures, int16: of all tables, or of a column's variants."""

    constant: int
    edge: int


class Buffers(NamedTuple):
    """Addresses; of BATCH rows, int16 unless said, with the elements from row to row.

    n: counts of pixels from far to near; sums: score of a change at each pixel from SUMS_FROM on, the first one BASE;
    score: of pixel and phase; top: largest ones of some lanes each, later of all.
    cost: bytes of labels, from that of the first pixel's phase 0 on. Of all rows: mask: bytes, EXCLUDED or 0 for each
    label; constant: of positions, edge: of pixels, for each variant; through: room for sums. As
    int32, table: of variants from -1 on, -1 where there is none; here: of each row of the batch, fitted: place of it in
    `Fitted`; shown: labels that the mask is for, from and up to. labels: how many there are.
    """

    n: int
    n_row: int
    sums: int
    score: int
    score_row: int
    top: int
    cost: int
    cost_row: int
    mask: int
    constant: int
    edge: int
    through: int
    table: int
    here: int
    fitted: int
    shown: int
    labels: int


@numba.njit(forceinline=True)
def buffers_at(begin, pixels, vectors, labels):  # type: ignore[no-untyped-def]
    """The buffers from an address on, and where they end."""
    n_row = _whole(max(pixels, FAR_PX + vectors * LANES + LANES) + LANES)
    score_row = vectors * PHASES * LANES
    cost_row = _whole(max(labels, score_row) + 2 * 2 * LANES)
    sums = begin + 2 * BATCH * n_row
    score = sums + 2 * BATCH * n_row
    top = score + 2 * BATCH * score_row
    cost = top + 2 * BATCH * LANES
    mask = cost + BATCH * cost_row
    constant = mask + _whole(labels)
    edge = constant + 2 * VARIANTS * vectors * POSITION
    through = edge + 2 * VARIANTS * pixels
    table = through + 2 * (pixels + 2 * LANES)
    here = table + 4 * (VARIANTS + 1)
    buffers = Buffers(begin, n_row, sums, score, score_row, top, cost, cost_row, mask, constant, edge,
                       through, table, here, here + 4 * BATCH, here + 8 * BATCH, labels)  # fmt: skip
    return buffers, here + 4 * (2 * BATCH + 2)


@numba.njit(forceinline=True)
def signed_address(array):  # type: ignore[no-untyped-def]
    """Address of an array's first element, signed: sums of both kinds would be floats."""
    return np.int64(address_of(array))


@numba.njit(inline="always")
def _whole(number):  # type: ignore[no-untyped-def]
    """The next multiple of a cache line's bytes."""
    return -(-number // CACHE_LINE) * CACHE_LINE
