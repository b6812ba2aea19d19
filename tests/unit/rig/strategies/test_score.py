"""Scores: known errors give known figures, and only what camera and source both see is scored."""

import numpy as np
import pytest

from drivers.interfaces import SweepTruth
from rig.strategies.comparison.score import score, scored_pixels
from rig.strategies.strategy import Answer
from tests.stability.inventory import covers
from tests.unit.rig.strategies.plain_scene import PlainScene, plain_geometry

covers(score, scored_pixels)
GEOMETRY = plain_geometry()
SCENE = PlainScene(GEOMETRY)


def true_stripes(depth_m: np.ndarray) -> np.ndarray:
    """Where each column is seen on each row: the pixel whose column is nearest, NaN if none is within one column."""
    column = GEOMETRY.column_of(depth_m)
    stripes = np.full((GEOMETRY.shape[0], GEOMETRY.columns), np.nan, np.float32)
    for c in range(GEOMETRY.columns):
        off = np.abs(np.nan_to_num(column, nan=1e9) - c)
        at = off.argmin(axis=1)
        near = off[np.arange(len(at)), at] <= 1
        stripes[near, c] = at[near]
    return stripes


def truth_of(depth_m: np.ndarray, trusted: np.ndarray | None = None) -> SweepTruth:
    return SweepTruth(true_stripes(depth_m), depth_m.astype(np.float32), trusted)


def test_pixels_count_if_lit_within_the_range_and_trusted():
    depth_m = SCENE.depth_m.copy()
    depth_m[:, 100:110] = 30.0  # beyond the range
    trusted = np.ones(GEOMETRY.shape, bool)
    trusted[5] = False
    lit = np.isfinite(GEOMETRY.column_of(depth_m))
    scored = scored_pixels(truth_of(depth_m, trusted), GEOMETRY)
    expected = lit & trusted
    expected[:, 100:110] = False
    assert np.mean(scored == expected) > 0.99
    assert not scored[5].any()
    assert not scored[:, 100:110].any()


def test_a_pixel_in_shadow_is_not_scored():
    truth = truth_of(SCENE.depth_m)
    truth.x_px[:, 60:80] = np.nan
    scored, all_of_them = scored_pixels(truth, GEOMETRY), scored_pixels(truth_of(SCENE.depth_m), GEOMETRY)
    assert 12 * GEOMETRY.shape[0] < np.count_nonzero(all_of_them & ~scored) < 25 * GEOMETRY.shape[0]


def test_known_errors_give_known_figures():
    truth = truth_of(SCENE.depth_m)
    scored = scored_pixels(truth, GEOMETRY)
    total = np.count_nonzero(scored)
    inverse = 1 / truth.depth_m.astype(np.float64)
    off_px = np.full(GEOMETRY.shape, 0.15)
    row, column = np.nonzero(scored)
    quarter = total // 4
    missing, wrong = (row[:quarter], column[:quarter]), (row[quarter : 2 * quarter], column[quarter : 2 * quarter])
    off_px[wrong] = 25.0  # counts as 10
    depth_m = (1 / (inverse + off_px / GEOMETRY.px_per_inverse_depth)).astype(np.float32)
    depth_m[missing] = np.nan
    confidence = np.where(np.isnan(depth_m), 0.0, 0.95).astype(np.float32)
    found = score(Answer(depth_m, confidence), truth, GEOMETRY, scored)
    share = quarter / total
    assert found.pixels == total
    assert found.mean_px == pytest.approx(0.15 * (1 - 2 * share) + 10 * 2 * share, rel=1e-4)
    assert found.median_px == pytest.approx(0.15, rel=1e-3)
    assert found.valid == pytest.approx(1 - share)
    assert found.confident_wrong == pytest.approx(share)
    assert found.good == pytest.approx(1 - 2 * share)  # 0.15 px at 3 to 5 m is 0.8 to 1.4 %
    assert found.median_m is not None
    assert 0.01 < found.median_m < 0.1


def test_no_answer_at_all_is_ten_pixels_and_no_median():
    truth = truth_of(SCENE.depth_m)
    scored = scored_pixels(truth, GEOMETRY)
    nothing = Answer(np.full(GEOMETRY.shape, np.nan, np.float32), np.zeros(GEOMETRY.shape, np.float32))
    found = score(nothing, truth, GEOMETRY, scored)
    assert (found.mean_px, found.median_px, found.median_m) == (10.0, None, None)
    assert (found.good, found.valid, found.confident_wrong) == (0.0, 0.0, 0.0)
    with pytest.raises(ValueError, match="no pixel"):
        score(nothing, truth, GEOMETRY, np.zeros(GEOMETRY.shape, bool))
