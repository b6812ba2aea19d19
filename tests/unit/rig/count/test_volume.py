import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rig.count.volume import BIN_DARK, BIN_UNUSABLE, CountVolume, SweepCounter, SweepLayout
from rig.threads import RowWorkers

WORD = 64
VOLUME = [field.name for field in dataclasses.fields(CountVolume)]


def packed(frames):
    """Frames (n, rows, width) bool as bytes, rows padded to whole words."""
    bits = np.packbits(frames, axis=2)
    return np.pad(bits, ((0, 0), (0, 0), (0, -bits.shape[2] % 8)))


def expected_counts(frames, bins, x0, window):
    """Counts by unpacked sums, whole pixels beyond the picture zero."""
    n_columns, (_, rows, width) = len(x0), frames.shape
    wide = np.zeros((n_columns, rows, width + window + WORD), np.int64)
    for c in range(n_columns):
        wide[c, :, :width] = frames[bins == c].sum(axis=0)
    return np.stack([wide[c, :, x : x + window] for c, x in enumerate(x0)])


def layout_of(frames, x0, window, used_px=None):
    _, rows, width = frames.shape
    return SweepLayout(len(x0), rows, width, np.asarray(x0, np.int32), window, 1, used_px)


def count(frames, bins, column, x0, window, *, threads=2, blocks=(10**9,)):
    """The project's volume of whole frames, see `counted`."""
    nowhere = np.zeros(len(frames), np.int32)
    return counted(packed(frames), bins, column, nowhere, layout_of(frames, x0, window), threads, blocks)


def counted(bits, bins, column, frame_x0, layout, threads, blocks):
    """The project's volume, the stream cut into blocks of the given sizes (the last one repeated)."""
    first, sizes = 0, list(blocks)
    with RowWorkers(threads) as workers:
        counter = SweepCounter(layout, workers)
        while first < len(bits):
            part = slice(first, first + (sizes.pop(0) if len(sizes) > 1 else sizes[0]))
            counter.add(np.ascontiguousarray(bits[part]), bins[part], column[part], frame_x0[part])
            first = part.stop
        return counter.finish()


def stream(seed, n, rows, width, n_columns, rate=0.3):
    rng = np.random.default_rng(seed)
    frames = rng.random((n, rows, width)) < rate
    bins = rng.integers(BIN_UNUSABLE, n_columns, n).astype(np.int32)
    return frames, bins, rng.uniform(-0.5, n_columns - 0.5, n)


@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 2**32), st.integers(1, 150), st.integers(1, 7), st.integers(1, 200), st.integers(1, 9), st.data()
)  # fmt: skip
def test_counts_are_the_unpacked_sums_whatever_the_order_of_columns(seed, n, rows, width, n_columns, data):
    frames, bins, column = stream(seed, n, rows, width, n_columns)
    words = -(-width // WORD)
    window = WORD * data.draw(st.integers(1, words))
    starts = st.integers(0, words - window // WORD).map(lambda w: w * WORD)
    x0 = np.array(data.draw(st.lists(starts, min_size=n_columns, max_size=n_columns)), np.int32)
    volume = count(frames, bins, column, x0, window)
    np.testing.assert_array_equal(volume.counts, expected_counts(frames, bins, x0, window))
    np.testing.assert_array_equal(volume.n_frames, [(bins == c).sum() for c in range(n_columns)])
    picture = np.zeros((rows, words * WORD), np.int64)
    for x, counts in zip(x0, expected_counts(frames, bins, x0, window), strict=True):
        picture[:, x : x + window] += counts
    np.testing.assert_array_equal(volume.intensity(), picture[:, :width])
    means = [column[bins == c].mean() if (bins == c).any() else np.nan for c in range(n_columns)]
    np.testing.assert_allclose(volume.column, means, rtol=1e-12)
    assert volume.n_dark == (bins == BIN_DARK).sum()
    if volume.n_dark:
        np.testing.assert_array_equal(volume.dark_counts, frames[bins == BIN_DARK].sum(axis=0))
    else:
        assert volume.dark_counts is None


@pytest.mark.parametrize(
    ("k", "dtype"),
    [(255, np.uint8), (256, np.uint16), (300, np.uint16), (65_535, np.uint16), (65_536, np.uint32),
     (70_000, np.uint32)],
)  # fmt: skip
def test_counts_widen_before_they_overflow(k, dtype):
    frames, _, _ = stream(1, 100, 2, 70, 1)
    frames[:, 0] = True
    bits, nowhere = packed(frames), np.zeros(100, np.int32)
    counter = SweepCounter(layout_of(frames, [0, 0], 128), RowWorkers(1))
    # The neighbour was counted while the counts were still narrow.
    counter.add(bits, np.ones(100, np.int32), np.ones(100), nowhere)
    expected = np.zeros((2, 70), np.int64)
    for first in range(0, k, 100):
        n = min(100, k - first)
        counter.add(bits[:n], np.zeros(n, np.int32), np.zeros(n), nowhere[:n])
        expected += frames[:n].sum(axis=0)
    volume = counter.finish()
    assert volume.counts.dtype == dtype
    np.testing.assert_array_equal(volume.counts[0, :, :70], expected)
    np.testing.assert_array_equal(volume.counts[1, :, :70], frames.sum(axis=0))
    assert volume.counts[0, 0, 0] == k
    assert volume.intensity()[0, 0] == k + 100


@pytest.mark.parametrize("threads", [2, 16])
@pytest.mark.parametrize("blocks", [(1,), (64, 1, 63)])
def test_neither_threads_nor_blocks_change_a_bit(threads, blocks):
    frames, bins, column = stream(5, 400, 13, 130, 5)
    bins = np.sort(bins)  # long runs of one column, so that blocks cut them
    x0 = [0, 64, 64, 0, 64]
    one = count(frames, bins, column, x0, 128, threads=1)
    other = count(frames, bins, column, x0, 128, threads=threads, blocks=blocks)
    for name in VOLUME:
        np.testing.assert_array_equal(getattr(other, name), getattr(one, name))


def test_a_volume_outlives_the_next_sweep():
    frames, bins, column = stream(1, 60, 3, 64, 3)
    counter = SweepCounter(layout_of(frames, [0, 0, 0], 64), RowWorkers(1))
    volumes = []
    for _ in range(2):
        counter.reset()
        assert not counter.finish().counts.any()
        counter.add(packed(frames), bins, column, np.zeros(60, np.int32))
        volumes.append(counter.finish())
    np.testing.assert_array_equal(volumes[0].counts, expected_counts(frames, bins, [0, 0, 0], 64))
    for name in VOLUME:
        np.testing.assert_array_equal(getattr(volumes[1], name), getattr(volumes[0], name))


@pytest.mark.parametrize(("blocks", "threads"), [((10**9,), 1), ((1,), 3), ((7, 30), 3)])
def test_frames_cut_to_their_used_pixels_are_counted_as_whole_ones(blocks, threads):
    frames, bins, column = stream(11, 300, 5, 300, 6)
    rng, used, window = np.random.default_rng(2), 192, 128
    bins = np.repeat(bins[::5], 5)  # runs of one column, so that its frames share a run
    x0 = np.array([0, 64, 64, 128, 128, 192], np.int32)
    used_x0 = rng.integers(0, 3, 300).astype(np.int32) * 64  # rows of 300 pixels have 5 words, windows 3
    outside = (bins >= 0) & ~((used_x0 <= x0[bins]) & (x0[bins] + window <= used_x0 + used))
    bins[outside] = BIN_UNUSABLE
    assert len(np.unique(bins)) == 8
    whole = packed(frames)
    cut = np.stack([frame[:, at // 8 : (at + used) // 8] for frame, at in zip(whole, used_x0, strict=True)])
    layout = layout_of(frames, x0, window, used)
    volumes = [counted(bits, bins, column, used_x0, layout, threads, blocks) for bits in (whole, cut)]
    for name in VOLUME:
        np.testing.assert_array_equal(getattr(volumes[0], name), getattr(volumes[1], name))
    np.testing.assert_array_equal(volumes[0].counts, expected_counts(frames, bins, x0, window))
    seen = (used_x0[:, None] <= np.arange(300)) & (np.arange(300) < used_x0[:, None] + used)
    dark = bins == BIN_DARK
    np.testing.assert_array_equal(volumes[0].dark_frames, seen[dark].sum(axis=0))
    np.testing.assert_array_equal(volumes[0].dark_counts, (frames & seen[:, None, :])[dark].sum(axis=0))
    assert volumes[0].n_dark == dark.sum()


@pytest.mark.parametrize(("window", "x0"), [(100, 0), (64, 32), (64, 1)])
def test_windows_off_the_word_grid_are_refused(window, x0):
    with pytest.raises(ValueError, match="multiples of 64"):
        SweepLayout(1, 2, 200, np.array([x0], np.int32), window, 10)
