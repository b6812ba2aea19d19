"""Bit-sliced counting against unpacked sums: every number of frames, ragged chunks, dark frames, moving windows."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rig.count import kernels
from rig.count.kernels import CHUNK, PLANES, add_frames, add_runs, planes_for
from rig.count.lane_order import PAIRS, pixel_order
from rig.simd.vectors import LANES
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


@pytest.mark.parametrize("k", [*range(1, 41), 63, 64, 255])
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


def test_words_beside_a_chunk_are_left_alone():
    planes = random_words(4, (PLANES + 1) * CHUNK)
    before = planes.copy()
    add_frames(random_words(3, 30, 10).ravel(), 10, 0, 0, 30, 10, 0, planes)
    untouched = np.ones((PLANES + 1, CHUNK), bool)
    untouched[:, :10] = False
    np.testing.assert_array_equal(planes[untouched.ravel()], before[untouched.ravel()])


def runs(words, first_word, row_words, used_words, bins, x0, window, rows, width_words, pieces=(0, 1), dtype=np.uint16):
    """Counts (columns, rows, window) and dark sums (rows, width) of `add_runs`, rows in pieces as of threads."""
    counts = np.zeros((len(x0), rows, window), dtype)
    dark = np.zeros((rows, PAIRS, width_words * WORD // 8 + LANES, 2), np.int32)
    edges = [round(share * rows) for share in pieces]
    for first, last in pairwise(edges):
        add_runs(
            words.ravel(), np.asarray(first_word, np.int32), row_words, used_words, np.asarray(bins, np.int32),
            np.arange(len(x0), dtype=np.int32)[:, None], np.asarray(x0, np.int32), counts, dark, first, last,
        )  # fmt: skip
    return counts, pixel_order(dark, width_words * WORD)


@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 2**32), st.integers(1, 40), st.integers(1, 70), st.integers(1, 9), st.integers(1, 5), st.data()
)  # fmt: skip
def test_runs_of_whole_frames_are_the_unpacked_sums(seed, n, rows, width_words, columns, data):
    rng = np.random.default_rng(seed)
    used = data.draw(st.integers(1, width_words))
    words = random_words(seed, n, rows, width_words)
    bins = np.sort(rng.integers(-2, columns, n))
    window_words = data.draw(st.integers(1, width_words))
    x0 = rng.integers(0, width_words - window_words + 1, columns) * WORD
    # Lit frames are used wherever their column's window lies; dark ones only where their used pixels do.
    first_word = rng.integers(0, width_words - used + 1, n)
    pieces = data.draw(st.sampled_from([(0, 1), (0, 0.5, 1), (0, 0.3, 0.4, 1)]))
    counts, dark = runs(
        words, first_word, width_words, used, bins, x0, window_words * WORD, rows, width_words, pieces
    )  # fmt: skip
    pixels = bits_of(words)
    for c in range(columns):
        wanted = pixels[bins == c][:, :, x0[c] : x0[c] + window_words * WORD].sum(axis=0)
        np.testing.assert_array_equal(counts[c], wanted)
    wanted = np.zeros((rows, width_words * WORD), np.int64)
    for f in np.flatnonzero(bins == -1):
        part = slice(first_word[f] * WORD, (first_word[f] + used) * WORD)
        wanted[:, part] += pixels[f][:, part]
    np.testing.assert_array_equal(dark, wanted)


@pytest.mark.parametrize("k", [1, 10, 15, 16, 255, 256, 600])
def test_runs_of_any_length_are_counted(k):
    words = random_words(k, k, 2, 1)
    words[:, 0] = 2**64 - 1
    for value in (0, -1):
        counts, dark = runs(words, np.zeros(k), 1, 1, np.full(k, value), [0], WORD, 2, 1, (0, 1))
        wanted = bits_of(words).sum(axis=0)
        np.testing.assert_array_equal(counts[0], wanted if value == 0 else 0)
        np.testing.assert_array_equal(dark, wanted if value == -1 else 0)
        assert wanted[0, 0] == k


def test_without_columns_only_dark_frames_are_counted():
    words = random_words(6, 12, 3, 2)
    bins = np.array([-1, 0, 1, -2] * 3)
    dark = np.zeros((3, PAIRS, 16 + LANES, 2), np.int32)
    none = np.zeros((0, 3, WORD), np.uint8)
    add_runs(
        words.ravel(),
        np.zeros(12, np.int32),
        2,
        2,
        bins.astype(np.int32),
        np.zeros((0, 0), np.int32),
        np.zeros(2, np.int32),
        none,
        dark,
        0,
        3,
    )
    np.testing.assert_array_equal(pixel_order(dark, 128), bits_of(words)[bins == -1].sum(axis=0))
