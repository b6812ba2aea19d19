"""The confidence of `likelihood`: its formula, what neighbours do to it, and where there are none."""

import numpy as np
import pytest

from rig.estimate.row.confidence import LEAST, MORE_NOISE, REACH, SEEN, SPARED, A, B, C, D, believed, confidences
from rig.estimate.row.neighbours import on_surface
from rig.geometry.stripe_table import StripeTable
from rig.threads import RowWorkers
from tests.stability.inventory import covers

covers(believed, confidences, on_surface)
LINE_PX, AMBIENT = 5, 0.01


def table_of(x, signal, haze):
    x, signal, haze = (np.broadcast_to(np.float32(values), np.shape(x)).copy() for values in (x, signal, haze))
    return StripeTable(x, np.full_like(x, 0.5), np.full_like(x, 0.1), signal, haze)


def judged(x, signal, haze, exposures, reference=0.0, threads=1):
    x = np.asarray(x, np.float32)
    reference = np.broadcast_to(np.float32(reference), x.shape)
    frames = np.broadcast_to(np.int32(exposures), x.shape[1:]).copy()
    with RowWorkers(threads) as workers:
        return believed(table_of(x, signal, haze), reference, frames, AMBIENT, LINE_PX, workers)


def direct(x, signal, haze, exposures, reference):
    """The formula of the module, answer by answer, in float64."""
    distance = x.astype(float) - reference
    out = np.zeros(x.shape)
    for y, c in np.argwhere(np.isfinite(distance)):
        block = np.s_[max(y - REACH, 0) : y + REACH + 1, max(c - REACH, 0) : c + REACH + 1]
        there = np.isfinite(distance[block])
        same = there & (np.abs(np.nan_to_num(distance[block]) - distance[y, c]) <= 1)
        n, others, k = same.sum(), there.sum() - same.sum(), exposures[c]
        mean, below = signal[block][same].mean(), LINE_PX / 2 * (haze[y, c] + 2 * AMBIENT)
        contrast = (mean - SPARED * haze[y, c]) * np.sqrt(k * n / (max(mean + below, 0) + below + MORE_NOISE / k))
        odds = np.log((n - 0.5) / (others + 0.5))
        odds *= np.clip(contrast / SEEN, 0, 1) if odds > 0 else 1
        doubt = A - B * odds - C * np.arcsinh(max(contrast, LEAST)) + D * np.log(k)
        out[y, c] = 1 / (1 + np.exp(doubt))
    return out


@pytest.mark.parametrize(("shape", "threads"), [((1, 1), 1), ((5, 3), 1), ((40, 33), 2), ((70, 17), 2)])
def test_the_confidence_is_that_of_the_formula(shape, threads):
    rng = np.random.default_rng(shape[0])
    x = (100 + rng.integers(0, 4, shape) * 0.7).astype(np.float32)
    x[rng.random(shape) < 0.1] = np.nan
    signal, haze = rng.normal(0.3, 0.4, shape).astype(np.float32), rng.uniform(0, 0.3, shape).astype(np.float32)
    exposures, reference = rng.integers(1, 30, shape[1]), rng.normal(0, 0.3, shape)
    found = judged(x, signal, haze, exposures, reference, threads)
    np.testing.assert_allclose(found.confidence, direct(x, signal, haze, exposures, reference), atol=2e-4)
    assert not found.confidence[np.isnan(x)].any()
    assert np.all(found.signal >= 0)


def test_a_lit_surface_is_believed_an_end_of_haze_and_scattered_answers_are_not():
    wall, rng = np.full((30, 30), 200.0), np.random.default_rng(1)
    scattered = wall + rng.uniform(0, 100, wall.shape)
    assert judged(wall, 0.5, 0.1, 10).confidence.min() > 0.95
    # Where haze merely ends, answers agree less well; a little of its light passes for the stripe's.
    half = np.where(rng.random(wall.shape) < 0.5, wall, scattered)
    ends = judged(half, 0.05, 0.1, 10).confidence[half == wall]
    assert ends.max() < 0.5 < judged(half, 0.5, 0.1, 10).confidence[half == wall].mean()
    assert judged(scattered, 0.5, 0.1, 10).confidence.mean() < 0.2
    # However many agree, less light than the haze alone would bring is a sign against them.
    assert judged(wall, -0.25, 0.1, 10).confidence.max() < 0.1
    assert judged(wall, 0.0, 0.0, 4).confidence.max() < 0.3


def test_an_answer_without_neighbours_is_judged_by_its_light():
    assert judged([[50.0]], 3.0, 0.0, 20).confidence.item() > 0.8
    assert judged([[50.0]], 0.0, 0.0, 20).confidence.item() < 0.2


def test_a_column_without_frames_has_no_answer_and_disturbs_no_other():
    x = np.full((9, 9), 30.0, np.float32)
    x[:, 4] = np.nan
    exposures = np.full(9, 10)
    exposures[4] = 0
    found = judged(x, 1.0, 0.0, exposures).confidence
    assert not found[:, 4].any()
    assert np.delete(found, 4, axis=1).min() > 0.95
