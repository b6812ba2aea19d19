"""A board drawn so that a picture of it can be compared with the drawing."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.board.board import MARGIN_SQUARES, Board

_PX_PER_SQUARE = (32, 256)
"""At least and at most."""
_MOST_PX = 1 << 25
"""Of a drawing, 128 MB: reached by boards of more than 21 x 21 squares; 57 a square on the largest there are. 30 x 29
squares, each 17 to 24 pixels in the picture, drawn 134 to a square in the place of 256, had corners off by 0.0018 px
for 0.0009."""


@dataclass(frozen=True, slots=True)
class Drawing:
    """The board as drawn for the comparison: white is 1, black 0. margin_px: drawn around the squares."""

    board: Board
    picture: NDArray[np.float32]
    px_per_square: int
    margin_px: int

    @classmethod
    def of(cls, board: Board, px_per_square: float) -> "Drawing":
        """Draw it, so fine if it can be: every pixel is the white share of its area, exactly, for markers end between
        pixels.
        """
        modules = board.modules
        down, across, side, _ = modules.shape
        least, most = _PX_PER_SQUARE
        squares = (down + 2 * MARGIN_SQUARES) * (across + 2 * MARGIN_SQUARES)
        fine = int(np.clip(np.nan_to_num(px_per_square), least, min(most, (_MOST_PX / squares) ** 0.5)))
        pad = round(MARGIN_SQUARES * fine)
        white = np.zeros((down, across, side + 2, side + 2), np.float32)
        white[np.add.outer(np.arange(down), np.arange(across)) % 2 == 1] = 1  # quiet zone of the markers and all
        white[:, :, 1:-1, 1:-1] -= modules
        share = 0.0 if board.marker_m is None else board.marker_m / board.square_m
        edges = np.concatenate([[0.0], 0.5 + share * (np.arange(side + 1) / max(side, 1) - 0.5), [1.0]])
        pixels = np.arange(fine + 1) / fine
        upper = np.minimum(pixels[1:, None], edges[1:])
        covered = np.maximum(upper - np.maximum(pixels[:-1, None], edges[:-1]), 0) * fine
        covered = covered.astype(np.float32)
        drawn = np.einsum("pi,rcij,qj->rpcq", covered, white, covered, optimize=True)
        size = (down * fine, across * fine)
        return cls(board, np.pad(drawn.reshape(size), pad, constant_values=1.0), fine, pad)
