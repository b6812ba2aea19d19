"""A rig whose light bows and whose rows are late, calibrated at one and three exposures and scanned at one, both ways.

Estimated twice from the same frames, with the model that was found and with the true one. Of the pixels that
both answer with confidence some jump: the bits of a single frame allow their row two answers, and which one it gives
depends on a hundredth of a pixel of the window. Those are counted; what is left is what the model adds.
"""

import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray

from calibration.model.rig_model import RigModel
from rig import api
from tests.system.calibrate.board_rig import BRIGHT, FOCAL_PX, SIZE, write_board_rig

pytestmark = pytest.mark.long

BOW, ROW_DELAY_S = 0.02, 1e-7
"""Over the 256 rows of 300 px focal length: three pixels, and two and a half columns of one exposure."""
BASELINE_M = 0.3
JUMP_PX = 0.3
MOST_JUMPS = 0.1
"""Share of pixels."""


class Calibrated(NamedTuple):
    folder: Path
    config: Path
    planes: RigModel
    file: Path


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory: pytest.TempPathFactory) -> Calibrated:
    """The rig's folder, and its calibration."""
    folder = tmp_path_factory.mktemp("bent")
    config, board = write_board_rig(folder, scan=BRIGHT)
    true = yaml.safe_load((folder / "rig.yaml").read_text())
    true["scanner"]["pivot"]["bow_per_rad"], true["row_delay_s"] = BOW, ROW_DELAY_S
    (folder / "true.yaml").write_text(yaml.safe_dump(true))
    config.write_text(config.read_text().replace("geometry: ./rig.yaml", "geometry: ./true.yaml"))
    scene = str(folder / "scene.yaml")
    planes = api.calibrate_planes(
        config, board=board, scene=scene, poses=6, exposures=(1, 3), at="3 m", out=folder / "1"
    )
    return Calibrated(folder, config, planes.model, planes.calibration)


def test_bow_and_row_delay_are_found_with_their_sds(calibrated: Calibrated) -> None:
    model = calibrated.planes
    sd = dict(zip(model.covariance.names, np.sqrt(np.diag(model.covariance.matrix)), strict=True))
    assert model.scanner.bow_per_rad == pytest.approx(BOW, abs=4 * sd["bow"])
    assert model.row_delay_s == pytest.approx(ROW_DELAY_S, abs=4 * sd["row_delay"])
    assert sd["bow"] < 0.1 * BOW
    assert sd["row_delay"] < 0.1 * ROW_DELAY_S


def test_depth_is_that_of_the_true_model_and_wrong_without_bow_and_delay(calibrated: Calibrated) -> None:
    folder, run = calibrated.folder, calibrated.folder / "run"
    content = yaml.safe_load(calibrated.config.read_text()) | {"calibration": "true.yaml"}
    content["estimate"] = {"estimator": "likelihood"}
    config = folder / "scan.yaml"
    config.write_text(yaml.safe_dump(content))
    api.scan(config, maps=2, exposures=1, record=True, out=run)
    api.reconstruct(run, calibration=calibrated.file, out=run / "found")
    api.reconstruct(run, calibration=folder / "rig.yaml", out=run / "flat")
    for sweep in ("000000", "000001"):
        true_m = np.load(run / "depth" / f"{sweep}.npy")
        found_px = added_px(np.load(run / "found" / "depth" / f"{sweep}.npy"), true_m)
        jumps = np.abs(found_px) > JUMP_PX
        assert np.isfinite(found_px).sum() > 0.5 * SIZE**2
        assert jumps.sum() < MOST_JUMPS * np.isfinite(found_px).sum()
        found_px[jumps] = np.nan
        assert abs(np.nanmedian(found_px)) < 0.1
        assert np.sqrt(np.nanmean(found_px**2)) < 0.1
        flat_px = added_px(np.load(run / "flat" / "depth" / f"{sweep}.npy"), true_m)
        assert np.nanmedian(np.abs(flat_px)) > 1


def added_px(depth_m: NDArray[np.float32], true_m: NDArray[np.float32]) -> NDArray[np.float64]:
    """What depths (rows, width) are off, in pixels of the stripe; NaN where one of the two is unknown."""
    true_m = true_m.astype(np.float64)
    return (depth_m - true_m) * FOCAL_PX * BASELINE_M / true_m**2


def test_planes_are_found_in_fog_and_their_error_is_known(tmp_path: Path) -> None:
    """In clear air the median is 1.5 mm at 3 m, in this fog 5, and it says so."""
    fog = {"medium": {"extinction": "0.1 /m"}}
    config, board = write_board_rig(tmp_path, scan={"columns": 300}, scene=fog)
    result = api.calibrate_planes(
        config, board=board, scene=str(tmp_path / "scene.yaml"), poses=6, exposures=(3,), at="3 m",
        accuracy="20 mm", stated_baseline="300 mm", out=tmp_path / "out",
    )  # fmt: skip
    assert result.verdict.passed, result.verdict
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    stated_m, truth_m = summary["depth_error"]["median_m"], summary["truth"]["median_m"]
    assert truth_m < 0.012
    assert truth_m < 1.5 * stated_m < 0.03
