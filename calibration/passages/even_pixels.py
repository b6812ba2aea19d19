"""Pixels of a picture in an order whose every beginning is spread evenly over it."""

import numpy as np
from numpy.typing import NDArray


def evenly(mask: NDArray[np.bool_]) -> NDArray[np.int64]:
    """(row, column) (n, 2) of the pixels in a mask (height, width), in the order of Bayer's dither matrix.

    It visits every second, then every fourth pixel of both directions, and so on from coarse to fine: reading the bits
    of y and of y xor x from the last to the first, in turn.
    """
    rows, columns = np.nonzero(mask)
    bits = max(1, int(max(mask.shape) - 1).bit_length())
    rank = np.zeros(len(rows), np.int64)
    for bit in range(bits):
        rank = (rank << 2) | (((rows ^ columns) >> bit & 1) << 1) | (rows >> bit & 1)
    at = np.argsort(rank, kind="stable")
    return np.stack([rows[at], columns[at]], axis=1)
