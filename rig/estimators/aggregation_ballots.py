"""Compiled ballots of a vote (`aggregation_vote`): labels and margins of all answers with a margin around.

Speed: 0.2 ms for 512 x 500 answers (Zen 3, AVX2, one busy thread).
"""

from typing import Final, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from rig.estimators.aggregation_answer import Answer
from rig.estimators.label_volume_buffers import signed_address
from rig.lane_memory import load_float32, load_widened, store_float32, store_int16
from rig.lanes import LANES, to_int16

REACH: Final = 2
"""Rows and columns to either side that vote."""
SHARE_BITS: Final = 2
SHARE: Final = 1 << SHARE_BITS
"""Units of margin to a vote: so 16 bits hold what all neighbours say."""
NOWHERE: Final = 30000
"""Label of what lies outside the picture: farther than FAR from all others, so that it is never elected."""


class Ballots(NamedTuple):
    """Labels and votes of a map with REACH rows and columns without votes around, as long as a vote lasts.

    label: float32 as answered; whole: int16, the nearest whole one; votes: int16, the margin over SHARE.
    """

    label: NDArray[np.float32]
    whole: NDArray[np.int16]
    votes: NDArray[np.int16]


def new_ballots(rows: int, columns: int) -> Ballots:
    """Room for the ballots of a map."""
    shape = rows + 2 * REACH, -(-columns // LANES) * LANES + LANES
    return Ballots(np.zeros(shape, np.float32), np.full(shape, NOWHERE, np.int16), np.zeros(shape, np.int16))


@numba.njit(cache=True, nogil=True)
def collect(answer: Answer, first_column: int, last_column: int, out: Ballots) -> None:
    """The ballots of columns first_column..last_column-1."""
    # Named apart: every use of a tuple with arrays in the loop would count references to all of them.
    labels, margins, label, whole, votes = answer.label, answer.margin, out.label, out.whole, out.votes
    at_label, at_margin, to_label = signed_address(labels), signed_address(margins), signed_address(label)
    to_whole, to_votes, half = signed_address(whole), signed_address(votes), np.float32(0.5)
    (rows, columns), width = labels.shape, label.shape[1]
    for y in range(rows):
        for c in range(first_column, last_column - LANES + 1, LANES):
            here, there = y * columns + c, (y + REACH) * width + REACH + c
            own = load_float32(at_label, here)
            store_float32(to_label, there, own)
            store_int16(to_whole, there, to_int16(own + half))
            store_int16(to_votes, there, load_widened(at_margin, here) >> np.int16(SHARE_BITS))
        for c in range(last_column - (last_column - first_column) % LANES, last_column):
            label[y + REACH, c + REACH] = labels[y, c]
            whole[y + REACH, c + REACH] = np.int16(labels[y, c] + half)
            votes[y + REACH, c + REACH] = margins[y, c] >> SHARE_BITS
