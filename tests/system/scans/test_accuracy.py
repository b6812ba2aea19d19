"""Accuracy of `rig reconstruct` on cubes that another program made, beside a genie that is told everything.

Limits: mean stripe error of `likelihood` without filter at most 1.3 times the genie's, below 0.6 px at K = 10 at the
report's working point, at most 5 % missing. The full table: `python -m tests.reference.tables.accuracy`.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rig.api.scans import scan
from tests.reference.genie import Genie
from tests.reference.geometry import Geometry
from tests.reference.scene import Scene, load_scene, procedural_scene
from tests.reference.tables.accuracy import RIGS
from tests.reference.working_point import POINTS, WorkingPoint, score
from tests.system.conftest import Rig

GENIE_RATIO = 1.3
MISSING = 0.05
MOST_PX = {10: 0.6, 20: 0.4}
"""Largest mean error without filter by exposures, at the report's working point on the prepared scenes."""
ROWS, COLUMNS = 32, 250
Reconstruct = Callable[..., Any]


def scene_of(name: str) -> Scene:
    """The middle rows of a prepared scene, or the procedural one."""
    if name == "procedural":
        return procedural_scene(ROWS, 512)
    scene = load_scene(name)
    if scene is None:
        pytest.skip(f"prepared scene {name!r} is absent: ../shared/scenes/{name}/world.npz")
    return scene.crop(ROWS, scene.shape[1])


def working_point(scene: Scene, light: str, rig: str, columns: int) -> WorkingPoint:
    height, width = scene.shape
    geometry = Geometry.build(width=width, height=height, columns=columns, **RIGS[rig])  # type: ignore[arg-type]
    return WorkingPoint(scene, POINTS[light], geometry)


@pytest.fixture
def reconstruct(rig: Rig, tmp_path: Path) -> Reconstruct:
    """x_px (rows, columns) of the command `rig reconstruct` on the cube in the test's folder."""

    def run(estimator: str = "likelihood", filtered: str = "none") -> Any:
        out = tmp_path / f"out-{estimator}-{filtered}"
        done = rig(
            "reconstruct", tmp_path / "cube.npy", "--plan", tmp_path / "plan.yaml", "--calibration",
            tmp_path / "calibration.yaml", "--estimator", estimator, "--filter", filtered, "--json", "--out", out,
        )  # fmt: skip
        assert done.code == 0, done.err
        assert json.loads(done.out)["estimator"] == estimator
        assert np.isfinite(np.load(out / "depth" / "000000.npy")).any()
        with np.load(out / "stripe" / "000000.npz") as stripe:
            return stripe["x_px"]

    return run


def genie_figures(point: WorkingPoint, exposures: int, seed: int) -> dict[str, float]:
    x = Genie().estimate(point, point.counts(exposures, seed), exposures, slice(None))
    return score(x, point.truth(), point.trusted)


CASES = [
    pytest.param("art", "report", "rectified", 10, id="art, report, rectified", marks=pytest.mark.long),
    pytest.param(
        "cones",
        "report",
        "turned",
        20,
        marks=pytest.mark.long,
        id="cones, report, rolled, distorted, tilted, scanner on the right",
    ),
    pytest.param("motorcycle", "dense", "rectified", 10, id="motorcycle, dense fog, rectified"),
    pytest.param("moebius", "clear", "turned", 3, id="moebius, clear air, turned", marks=pytest.mark.long),
    pytest.param("procedural", "report", "rectified", 1, id="procedural, report, one exposure"),
]


@pytest.mark.parametrize(("name", "light", "rig_kind", "exposures"), CASES)
def test_likelihood_comes_near_the_genie(
    tmp_path: Path, reconstruct: Reconstruct, name: str, light: str, rig_kind: str, exposures: int
) -> None:
    point = working_point(scene_of(name), light, rig_kind, COLUMNS)
    point.write_cube(tmp_path, exposures, seed=1)
    genie = genie_figures(point, exposures, 1)
    ours = score(reconstruct(), point.truth(), point.trusted)
    assert ours["mean_abs"] <= GENIE_RATIO * genie["mean_abs"]
    assert ours["missing"] <= MISSING
    if light == "report" and name != "procedural":
        assert ours["mean_abs"] < MOST_PX[exposures]


def test_naive_estimators_lose_in_fog_and_the_median_filter_helps(tmp_path: Path, reconstruct: Reconstruct) -> None:
    point = working_point(scene_of("procedural"), "report", "rectified", COLUMNS)
    point.write_cube(tmp_path, 10, seed=1)
    truth, trusted = point.truth(), point.trusted

    def error(estimator: str, filtered: str = "none") -> float:
        return score(reconstruct(estimator, filtered), truth, trusted)["mean_abs"]

    likelihood = error("likelihood")
    assert error("edge") > 2 * likelihood
    assert error("argmax") > 10 * likelihood
    assert error("likelihood", "median") < likelihood


@pytest.mark.parametrize(
    ("exposures", "columns", "height", "width"),
    [(1, 125, 77, 499), pytest.param(300, 51, 23, 450, marks=pytest.mark.long)],
)
def test_any_number_of_exposures_columns_and_pixels(
    tmp_path: Path, reconstruct: Reconstruct, exposures: int, columns: int, height: int, width: int
) -> None:
    point = working_point(procedural_scene(height, width), "report", "rectified", columns)
    point.write_cube(tmp_path, exposures, seed=1)
    x = reconstruct()
    assert x.shape == (height, columns)
    ours = score(x, point.truth(), point.trusted)
    assert ours["missing"] <= MISSING
    if exposures > 1:
        assert ours["mean_abs"] <= GENIE_RATIO * genie_figures(point, exposures, 1)["mean_abs"]


@pytest.mark.long
def test_in_dense_fog_the_halo_is_not_taken_for_a_wide_line() -> None:
    """A line of 0.8 px was learned as one of 1.85 px here, while wider lines were judged by more pixels."""
    result = scan("simulated", scene="street-dense-fog", estimator="likelihood", exposures=3, seed=31)
    assert result.last is not None
    assert result.truth is not None
    assert result.last.learned.line_sigma_px < 1.5
    sure = result.last.stripe.confidence >= 0.9
    assert (np.abs(result.last.stripe.x_px - result.truth.x_px)[sure] <= 1.0).mean() > 0.95
