"""Bit-sliced addition against unpacked sums: every number of frames, ragged chunks. Runs of frames: test_volume.py."""

import numpy as np
import pytest

from rig.count import kernels
from rig.count.kernels import CHUNK, PLANES, add_frames, planes_for
from tests.stability.inventory import covers

covers(kernels)

WORD = 64
BYTES = 8


def random_words(seed, *shape):
    return np.random.default_rng(seed).integers(0, 2**64, shape, np.uint64)


def bits_of(words):
    """Pixels (..., words * 64) bool of words, most significant bit of the first byte first."""
    return np.unpackbits(np.ascontiguousarray(words).view(np.uint8), axis=-1).astype(bool)


def planes_counts(planes, n, frames):
    """Counts (n * 64,) of so many frames that a chunk's planes hold for its first n words."""
    planes = planes.reshape(PLANES + 1, CHUNK)[: planes_for(frames), :n]
    return sum(bits_of(plane).astype(np.int64) << q for q, plane in enumerate(planes))


def used_planes():
    """A chunk's planes as an earlier column left them."""
    return np.full((PLANES + 1) * CHUNK, 2**64 - 1, np.uint64)


@pytest.mark.parametrize("k", [*range(1, 18), 30, 31, 63, 64, 255])
@pytest.mark.parametrize("n", [1, 7, CHUNK])
def test_frames_are_added_exactly(k, n):
    frame, at = n + 5, 3
    words = random_words(k, k, frame)
    words[:, at] = 2**64 - 1  # the largest count there can be
    planes = used_planes()
    add_frames(words.ravel(), frame, at, 0, k, n, 0, planes)
    wanted = bits_of(words[:, at : at + n]).sum(axis=0)
    np.testing.assert_array_equal(planes_counts(planes, n, k), wanted)
    assert wanted[0] == k


@pytest.mark.parametrize(
    "pieces", [(1, 1, 1, 12), (7, 8), (14, 1), (3, 2, 10), (1, 2), (2, 1), (3, 1), (5, 2), (15, 185), (1, 30), (2, 253)]
)
def test_frames_may_come_in_pieces(pieces):
    words = random_words(1, sum(pieces), 20)
    planes, first = used_planes(), 0
    for piece in pieces:
        add_frames(words.ravel(), 20, 0, first, first + piece, 20, first, planes)
        first += piece
    np.testing.assert_array_equal(planes_counts(planes, 20, first), bits_of(words).sum(axis=0))
