"""What the search along a row works with: a table made ready for a column, and a thread's buffers."""

from typing import Final, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rig.aligned import CACHE_LINE
from rig.estimators.screen_tables import SCREENS
from rig.lane_memory import address_of, read_int16, write_int16
from rig.lane_order import PAIRS, STEPS, pair_bytes, place_of
from rig.lane_reductions import FOLDED
from rig.lanes import LANES

BATCH: Final = LANES
"""Rows that go through each part of the search together: what one row waits for, the others fill, and what is one
number a row fills the lanes."""
PLACE_BEFORE: Final = 8
"""Pixels before the first one, and behind the last one, of which the place is known."""


class Table(NamedTuple):
    """One table made ready for a number of exposures.

    Addresses, in lane order: edge, tap as in `Tables`, constant as in `Search`; in pixel order, float32 of the stored
    pixels: before, scale, ambient. Numbers: all_right, all_left: scores of 'no stripe' as of
    `Tables.none`, that of all pixels lying right complete. searched: whether there is any position to find.
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
    """Addresses of a thread's buffers for BATCH rows of `lanes` lanes, and the bytes from row to row of each.

    n: counts, see `rig.lane_order`. int16: score (STEPS, lanes); start (lanes,), score of a change at the lane's first
    pixel; tops (LANES,), best scores of some lanes each; constant (SCREENS, STEPS, lanes), the tables' part per
    exposure times the exposures; lane (lanes,), the same; change (lanes,), what a change without a stripe in
    the lane adds; label (LANES,), scores of the close-up; place: index of pixel
    -PLACE_BEFORE on in a row of counts. neutral, muted: bytes, counts of hot pixels, see `row_search`. Of each row of
    the batch, int16: all_left, score of all pixels lying left; best, x: best score and its pixel; left, right: the
    scores beside it; levels: of the close-up; lift: what makes a score a power; ceiling: what no score exceeds.
    float32:
    light, before, scale, ambient: see `row_search`; answer: one field of the answers on its way out. Folded
    (`lane_reductions`): mass, sum of all likelihoods; moment, square: sums of the close-up.
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
def search_memory(lanes: int) -> NDArray[np.uint8]:
    """Memory for the buffers of a `Search`, at whole cache lines."""
    _, end = _search_at(0, lanes)
    whole = np.zeros(end + CACHE_LINE, np.uint8)
    begin = -address_of(whole) % CACHE_LINE
    memory = whole[begin : begin + end]
    search = search_in(address_of(memory), lanes)
    for i in range(STEPS * lanes + 2 * PLACE_BEFORE):
        write_int16(search.place, i, np.int16(place_of(i - PLACE_BEFORE, lanes)))
    return memory


@numba.njit(forceinline=True)
def search_in(memory: int, lanes: int) -> Search:
    """The buffers in `search_memory` at that address."""
    return _search_at(memory, lanes)[0]


@numba.njit(forceinline=True)
def count_place(search: Search, x: int) -> int:
    """Index of pixel x in a row of counts, from -PLACE_BEFORE on."""
    return np.int64(read_int16(search.place, x + PLACE_BEFORE))
