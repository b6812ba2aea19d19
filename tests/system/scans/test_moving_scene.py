"""A scan of a moving scene is compared with where each thing was when the line passed it."""

from pathlib import Path

import numpy as np
import pytest

from rig import api
from rig.plan.scan_plan import ScanPlan
from sim_backend import world
from tests.stability.inventory import covers
from tests.system.small_rig import config, write_rig

covers(world)

SCENE = """\
surfaces: street
ambient: {illuminance: 5 lux}
motion: {velocity: [0.5 m/s, 0 m/s, -2 m/s]}
"""


@pytest.mark.parametrize("bidirectional", [False, True])
def test_errors_do_not_contain_the_motion(tmp_path: Path, bidirectional: bool) -> None:
    content = config()
    content["world"]["scene"] = "./moving.scene.yaml"
    content["scan"] |= {"exposures": 20, "bidirectional": bidirectional}
    rig = write_rig(tmp_path, content)
    (tmp_path / "moving.scene.yaml").write_text(SCENE)
    api.scan(rig, maps=3, estimator="likelihood", out=tmp_path / "run")
    depths, truths = ([load(tmp_path / "run", i) for i in range(3)] for load in (_depth_m, _truth_m))
    # The maps take 0.05 s each, in which everything comes 0.1 m nearer.
    nearer_m = float(np.nanmedian(truths[0] - truths[2]))
    assert nearer_m == pytest.approx(0.2, abs=0.03)
    of_its_time, of_the_first = (float(np.nanmedian(np.abs(depths[2] - truths[i]))) for i in (2, 0))
    assert of_its_time < 0.06
    assert of_the_first > 0.15


def _depth_m(run: Path, index: int) -> np.ndarray:
    return np.asarray(np.load(run / "depth" / f"{index:06d}.npy"))


def _truth_m(run: Path, index: int) -> np.ndarray:
    return np.asarray(np.load(run / "truth" / f"{index:06d}.npz")["depth_m"])


def test_a_column_is_passed_when_the_mirror_is_there(tmp_path: Path) -> None:
    content = config()
    content["scan"]["bidirectional"] = True
    plan: ScanPlan = api.plan_scan(write_rig(tmp_path, content))
    columns = np.arange(float(plan.columns))
    for sweep, leg in enumerate(plan.legs):
        first_frame = round(sweep * float(plan.frames_per_sweep))
        passed_s = plan.column_time_s(columns, leg.direction, first_frame)
        np.testing.assert_allclose(plan.command(passed_s - leg.lag_s), plan.command_at(columns), atol=2e-3)
