"""A lens that was knocked between two maps is doubted, a scene that moves is not."""

from typing import Any

import numpy as np
import pytest

from rig.depth.depth import DepthMap
from rig.depth.fog_meter import FogEstimate
from rig.depth.knocks import KNOCKED, KnockWatch
from rig.depth.reconstruct import MapResult
from rig.geometry.stripe_table import StripeTable
from tests.unit.small_maps import simulated

ROWS, COLUMNS = 64, 160
SWEEP = simulated("report", 10, rows=ROWS, columns=COLUMNS)
GEOMETRY, TRUE_PX = SWEEP.geometry, SWEEP.point.truth()


def a_map(x_px: Any, sure: float = 0.95) -> MapResult:
    """A map with these stripes, up to 0.1 px off by chance."""
    x_px = (x_px + np.random.default_rng(1).normal(0, 0.1, x_px.shape)).astype(np.float32)
    nothing = np.zeros_like(x_px)
    stripe = StripeTable(x_px, np.where(np.isfinite(x_px), np.float32(sure), nothing), nothing, nothing, nothing)
    depth = DepthMap.empty(ROWS, GEOMETRY.width)
    return MapResult(stripe, *depth, np.zeros((ROWS, GEOMETRY.width), np.uint32), FogEstimate(), 0.0)


def doubts(before: Any, after: Any, sure: float = 0.95) -> tuple[str, ...]:
    watch = KnockWatch(GEOMETRY)
    assert watch.checked(a_map(before)).doubts == ()
    return watch.checked(a_map(after, sure)).doubts


def nearer(share: float) -> Any:
    """Stripes of the scene with all inverse depths larger by a share: the camera has come closer."""
    row = np.arange(ROWS)[:, None]
    px = np.clip(np.nan_to_num(TRUE_PX), 0, GEOMETRY.width - 1).astype(int)
    ray = np.stack([GEOMETRY.u[row, px], GEOMETRY.v[row, px], np.ones(px.shape)], axis=2)
    inverse = np.einsum("rck,ck->rc", ray, GEOMETRY.plane)
    away = -1 if GEOMETRY.near_is_left else 1
    return TRUE_PX + away * GEOMETRY.px_per_inverse_depth() * share * inverse


@pytest.mark.parametrize("by_px", [-6.0, -3.0, 3.0, 6.0])
def test_a_shift_of_all_stripes_is_doubted(by_px: float) -> None:
    assert doubts(TRUE_PX, TRUE_PX + by_px) == (KNOCKED,)


@pytest.mark.parametrize("share", [0.3, 0.7])
def test_a_knock_in_the_middle_of_a_sweep_is_doubted(share: float) -> None:
    since = np.arange(COLUMNS) < share * COLUMNS
    assert doubts(TRUE_PX, TRUE_PX + np.where(since, 5.0, 0.0)) == (KNOCKED,)
    assert doubts(TRUE_PX, TRUE_PX + np.where(since, 0.0, 5.0)) == (KNOCKED,)


@pytest.mark.parametrize("share", [-0.2, -0.05, 0.0, 0.05, 0.2])
def test_a_scene_that_moves_or_stands_is_not_doubted(share: float) -> None:
    assert doubts(TRUE_PX, nearer(share)) == ()


def test_what_is_unsure_or_uncalibrated_is_not_judged() -> None:
    assert doubts(TRUE_PX, TRUE_PX + 2, sure=0.5) == ()
    watch = KnockWatch(None)
    assert [watch.checked(a_map(TRUE_PX + by)).doubts for by in (0, 2)] == [(), ()]
