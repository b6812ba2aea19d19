"""One row counted beside a sweep: its bits, and nothing changed for the counter of the whole."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.count import followed_row
from rig.count.followed_row import FollowedRow, RowFollower, RowWish, add_row
from tests.stability.inventory import covers

covers(followed_row)

WIDTH, COLUMNS = 128, 12


@given(st.data())
def test_a_row_has_every_bit_of_its_frames_in_the_bin_of_each(data: st.DataObject) -> None:
    n = data.draw(st.integers(0, 40))
    px = data.draw(st.sampled_from([64, 128]))
    rng = np.random.default_rng(data.draw(st.integers(0, 99)))
    bins = np.array(data.draw(st.lists(st.integers(-2, COLUMNS - 1), min_size=n, max_size=n)), np.int32)
    if data.draw(st.booleans()):
        bins = np.sort(bins)
    x0 = np.array(data.draw(st.lists(st.sampled_from([0, 64]), min_size=n, max_size=n)), np.int32)
    x0 = x0 if px < WIDTH else np.zeros(n, np.int32)
    pixels = rng.random((n, px)) < 0.3
    counts = np.ones((COLUMNS, WIDTH), np.uint16)
    add_row(counts, np.packbits(pixels, axis=1).reshape(n, px // 8), bins, x0)
    expected = np.ones((COLUMNS, WIDTH), np.uint16)
    for frame, column, first in zip(pixels, bins.tolist(), x0.tolist(), strict=True):
        if column >= 0:
            expected[column, first : first + px] += frame
    np.testing.assert_array_equal(counts, expected)


class Recorder:
    """A counter that notes what it is asked for."""

    def __init__(self) -> None:
        self.asked: list[Any] = []

    def reset(self) -> None:
        self.asked.append("reset")

    def add(self, *values: Any) -> None:
        self.asked.append(values)

    def settle(self, under_way: int = 0) -> None:
        self.asked.append(("settle", under_way))

    def finish(self) -> Any:
        self.asked.append("finish")
        return "the sweep"


def test_the_counter_of_the_sweep_gets_everything_and_the_row_comes_before_its_sweep() -> None:
    inner, found = Recorder(), []
    wanted: list[int | None] = [3, None, 3]

    def note(row: FollowedRow) -> None:
        found.append((row, list(inner.asked)))

    follower = RowFollower(inner, RowWish(lambda: wanted.pop(0), note), COLUMNS, WIDTH)
    bits = np.full((2, 5, WIDTH // 8), 255, np.uint8)
    frames = bits, np.array([1, 2], np.int32), np.zeros(2), np.zeros(2, np.int32)
    for _ in range(2):
        follower.reset()
        follower.add(*frames)
        follower.settle(1)
        assert follower.finish() == "the sweep"
    assert inner.asked == ["reset", frames, ("settle", 1), "finish"] * 2
    assert len(found) == 1, "in the second sweep nobody followed a row"
    row, before = found[0]
    assert before == ["reset", frames, ("settle", 1)]
    assert row.row == 3
    np.testing.assert_array_equal(np.flatnonzero(row.counts.any(axis=1)), [1, 2])
    assert (row.counts[1:3] == 1).all()


@pytest.mark.parametrize("row", [-1, 5, 10**6])
def test_a_row_beyond_the_image_disturbs_nothing(row: int) -> None:
    inner, found = Recorder(), []
    follower = RowFollower(inner, RowWish(lambda: row, found.append), COLUMNS, WIDTH)
    follower.reset()
    bits = np.full((2, 5, WIDTH // 8), 255, np.uint8)
    follower.add(bits, np.array([1, 2], np.int32), np.zeros(2), np.zeros(2, np.int32))
    assert follower.finish() == "the sweep"
    assert not found[0].counts.any()


def test_a_row_that_cannot_be_counted_ends_no_run(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr("rig.count.followed_row.add_row", fail)
    inner, found = Recorder(), []
    follower = RowFollower(inner, RowWish(lambda: 3, found.append), COLUMNS, WIDTH)
    follower.reset()
    frames = np.full((2, 5, WIDTH // 8), 255, np.uint8), np.array([1, 2], np.int32), np.zeros(2), np.zeros(2, np.int32)
    follower.add(*frames)
    assert follower.finish() == "the sweep"
    assert inner.asked == ["reset", frames, "finish"]
    assert not found
