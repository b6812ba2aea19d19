"""Columns judged as their frames come give the very bits of a sweep that was counted whole and judged afterwards."""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest

from rig.count.volume import BIN_DARK, BIN_UNUSABLE, BYTE_EXPOSURES, CountVolume, SweepCounter, SweepLayout
from rig.estimate import likelihood
from rig.estimate import online_learning as lessons
from rig.estimate.likelihood import Likelihood
from rig.estimate.row.model import RowModel
from rig.estimate.search.stream import ColumnJudge, SearchedSweep
from rig.geometry.windows import uncalibrated_geometry
from rig.threads import RowWorkers
from tests.stability.inventory import covers
from tests.unit.small_maps import Sweep, assert_same, learned_from, simulated

pytestmark = pytest.mark.slow

covers(likelihood)

ROWS, COLUMNS = 72, 24
"""Rows are several chunks of whole frames, the last one shorter."""


@dataclass(frozen=True)
class Frames:
    """A stream of whole frames, one sweep long. x0: first used pixel of each."""

    bits: np.ndarray
    bins: np.ndarray
    column: np.ndarray
    x0: np.ndarray

    def __getitem__(self, part) -> "Frames":
        return Frames(np.ascontiguousarray(self.bits[part]), self.bins[part], self.column[part], self.x0[part])

    def cut(self, used_px) -> "Frames":
        """The same frames as windows of their used pixels."""
        rows = [frame[:, at // 8 : (at + used_px) // 8] for frame, at in zip(self.bits, self.x0, strict=True)]
        return replace(self, bits=np.stack(rows))


@cache
def scene(rig="left") -> Sweep:
    return simulated("report", 10, rig, ROWS, COLUMNS)


def model(rig="left") -> RowModel:
    return learned_from("report", 10, rig, ROWS, COLUMNS)


@cache
def frames_of(rig="left", exposures=10, seed=1) -> Frames:
    """Frames of every column with dark ones, and ones that are of no use, between and inside columns."""
    rng = np.random.default_rng([seed, exposures])
    bits, bins = [], []
    for c in range(COLUMNS):
        rate = -np.expm1(-scene(rig).point.flux_of_column(c))
        # Most columns get what is nominal: a sweep that is there already is judged for its median.
        taken = exposures + int(rng.choice([0, 0, 0, 0, -1, 1])) if exposures > 2 else exposures
        kinds = np.full(taken, c)
        for other, share in ((BIN_DARK, 0.5), (BIN_UNUSABLE, 0.2)):
            if rng.random() < share:
                kinds = np.insert(kinds, rng.integers(0, len(kinds) + 1), other)
        lit = rng.random((len(kinds), *rate.shape)) < np.where(kinds[:, None, None] == BIN_DARK, 0.01, rate)
        bits.append(np.packbits(lit, axis=2))
        bins.append(kinds)
    bins = np.concatenate(bins).astype(np.int32)
    column = bins + rng.uniform(-0.4, 0.4, len(bins))
    return Frames(np.concatenate(bits), bins, column, np.zeros(len(bins), np.int32))


def layout_of(rig="left", exposures=10, used_px=None) -> SweepLayout:
    g = scene(rig).geometry
    return SweepLayout(COLUMNS, ROWS, g.width, g.x0, g.window, exposures, used_px)


def fed(counter, frames, sizes):
    """What the counter gives of a sweep that comes in blocks of these sizes, over and over."""
    counter.reset()
    first, turn = 0, 0
    while first < len(frames.bins):
        part = frames[first : first + sizes[turn % len(sizes)]]
        counter.add(part.bits, part.bins, part.column, part.x0)
        first, turn = first + len(part.bins), turn + 1
    return counter.finish()


def counted(rig, layout, sweeps):
    """Tables, sweeps and models of sweeps that were counted whole."""
    estimator, found = Likelihood(1, model(rig)), []
    with RowWorkers(1) as workers:
        for frames in sweeps:
            volume = fed(SweepCounter(layout, workers), frames, [10**9])
            found.append((estimator.estimate(volume, scene(rig).geometry), volume, estimator.model))
    return found


def judged(rig, layout, sweeps, threads, sizes):
    """The same of sweeps that were judged on the way."""
    estimator, found = Likelihood(threads, model(rig)), []
    counter = estimator.counter(layout, scene(rig).geometry)
    for frames in sweeps:
        sweep = fed(counter, frames, sizes)
        found.append((estimator.estimate(sweep, scene(rig).geometry), sweep, estimator.model))
    return found


def assert_same_maps(found, wanted):
    for (table, sweep, learned), (wanted_table, volume, wanted_learned) in zip(found, wanted, strict=True):
        assert_same(table, wanted_table)
        for name in ("n_frames", "column", "dark_counts", "n_dark", "dark_frames", "width"):
            np.testing.assert_array_equal(getattr(sweep, name), getattr(volume, name), err_msg=name)
        np.testing.assert_array_equal(sweep.intensity(), volume.intensity())
        for name, value in wanted_learned.arrays().items():
            np.testing.assert_array_equal(learned.arrays()[name], value, err_msg=name)


@pytest.fixture(autouse=True)
def every_map_teaches(monkeypatch):
    monkeypatch.setattr(lessons, "TEACH_FRAMES", 1)
    monkeypatch.setattr(lessons, "LAG_FRAMES", 1)


@pytest.mark.parametrize(
    ("rig", "exposures"),
    [
        pytest.param("left", 100, marks=pytest.mark.long),
        ("right", 1),
        pytest.param("turned", 10, marks=pytest.mark.long),
    ],
)
def test_judged_on_the_way_is_judged_afterwards(rig, exposures):
    layout = layout_of(rig, exposures)
    sweeps = [frames_of(rig, exposures, seed) for seed in (1, 2, 3)]
    found = judged(rig, layout, sweeps, 2, [37])
    assert all(isinstance(sweep, SearchedSweep) for _, sweep, _ in found)
    assert found[1][2] is not found[0][2], "the third sweep is judged with what the first one taught"
    assert_same_maps(found, counted(rig, layout, sweeps))


def test_columns_of_more_exposures_than_the_counters_hold_are_counted_whole():
    exposures = BYTE_EXPOSURES + 100
    layout, sweeps = layout_of(exposures=exposures), [frames_of(exposures=exposures)]
    found = judged("left", layout, sweeps, 2, [500])
    assert isinstance(found[0][1], CountVolume)
    assert_same_maps(found, counted("left", layout, sweeps))


@pytest.mark.parametrize("missing", ["some", "parts", "all"])
def test_gaps_leave_the_other_columns_alone(missing):
    whole = frames_of()
    lit, number = whole.bins >= 0, np.arange(len(whole.bins))
    some = (whole.bins > 2) & (whole.bins < COLUMNS - 3) & (whole.bins % 4 != 1)
    keep = {"some": ~lit | some, "parts": number % 40 != 1, "all": ~lit}[missing]
    layout, sweeps = layout_of(), [whole[keep], whole]
    found = judged("left", layout, sweeps, 2, [23])
    assert_same_maps(found, counted("left", layout, sweeps))
    seen = found[0][1].n_frames > 0
    assert not found[0][0].confidence[:, ~seen].any()
    assert np.isnan(found[0][0].x_px[:, ~seen]).all()


def moved(frames, layout, seed):
    """Frames whose used pixels begin anywhere that holds their column's window."""
    rng = np.random.default_rng(seed)
    x0 = rng.integers(0, (layout.padded_width - layout.used_px) // 64 + 1, len(frames.bins)) * 64
    lit = frames.bins >= 0
    window = layout.x0[frames.bins[lit]]
    lowest = np.maximum(window + layout.window - layout.used_px, 0)
    highest = np.minimum(window, layout.padded_width - layout.used_px)
    x0[lit] = lowest + 64 * rng.integers(0, (highest - lowest) // 64 + 1)
    return replace(frames, x0=x0.astype(np.int32))


@pytest.mark.parametrize(("rig", "exposures", "spare"), [("left", 10, 0), ("right", 30, 64), ("turned", 1, 128)])
def test_windows_that_move_even_within_a_column_give_the_bits_of_whole_frames(rig, exposures, spare):
    used = scene(rig).geometry.window + spare
    layout = layout_of(rig, exposures, used)
    whole = [moved(frames_of(rig, exposures, 1), layout, 1)]
    cut = [frames.cut(used) for frames in whole]
    wanted = counted(rig, layout, whole)
    for sweeps, threads, sizes in ((whole, 1, [10**9]), (cut, 3, [13])):
        assert_same_maps(judged(rig, layout, sweeps, threads, sizes), wanted)
    if spare and exposures > 1:
        lit = whole[0].bins == COLUMNS // 2
        assert len(np.unique(whole[0].x0[lit])) > 1


def test_a_block_of_very_many_frames_is_summed_without_running_over():
    # Small sensors: a block of 16 MiB holds more frames than a sum of 16 bits has room for.
    columns, exposures = 400, 150
    g = uncalibrated_geometry(2, 64, columns)
    layout = SweepLayout(columns, 2, 64, g.x0, g.window, exposures, None, False)
    bins = np.repeat(np.arange(columns, dtype=np.int32), exposures)
    bits = np.full((len(bins), 2, 8), 255, np.uint8)
    small = replace(model(), ambient=np.full((2, 64), 0.01, np.float32), row_gain=np.ones(2, np.float32))
    estimator = Likelihood(1, replace(small, column_gain=np.ones(columns, np.float32)))
    with RowWorkers(1) as workers:
        judge = ColumnJudge(layout, g, estimator.judge(g, exposures, dark=False), workers)
        judge.add(bits, bins, bins.astype(float), np.zeros(len(bins), np.int32))
        assert np.all(judge.finish().intensity() == len(bins))


def test_a_first_map_that_lost_frames_everywhere_is_the_same_again_with_what_it_taught():
    exposures, lost = 10, 6
    whole = frames_of(exposures=exposures)
    in_column = np.arange(len(whole.bins)) - np.searchsorted(whole.bins, whole.bins)
    frames, layout = whole[(whole.bins < 0) | (in_column >= lost)], layout_of(exposures=exposures)
    first = Likelihood(1)
    counter = first.counter(layout, scene().geometry)
    table = first.estimate(fed(counter, frames, [10**9]), scene().geometry)
    again = Likelihood(1, first.used)
    counter = again.counter(layout, scene().geometry)
    recalled = again.estimate(fed(counter, frames, [37]), scene().geometry)
    assert_same(recalled, table)
