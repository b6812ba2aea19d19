"""SplitMix64 (Steele, Lea, Flood 2014): random numbers that a seed and a place tell, and nothing else."""

from typing import Any

import numba
import numpy as np

GOLDEN = np.uint64(0x9E3779B97F4A7C15)
FRAME_STEP = np.uint64(0xD1342543DE82EF95)
"""An odd multiplier that spreads frame numbers."""
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_S27, _S30, _S31 = np.uint64(27), np.uint64(30), np.uint64(31)


def mixed(z: Any) -> Any:
    """64 bits, uint64 alone or as an array, each of which depends on all of z. Products wrap: see numpy's errstate."""
    z = (z ^ (z >> _S30)) * _MIX_1
    z = (z ^ (z >> _S27)) * _MIX_2
    return z ^ (z >> _S31)


mixed_word = numba.njit(cache=True, nogil=True, inline="always")(mixed)
"""`mixed` for compiled code."""


@numba.njit(cache=True, nogil=True)
def frame_key(seed: np.uint64, frame: np.uint64) -> np.uint64:
    """Start of a frame's random stream."""
    return np.uint64(mixed_word(mixed_word(seed + GOLDEN) + frame * FRAME_STEP))
