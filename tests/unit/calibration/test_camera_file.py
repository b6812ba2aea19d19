"""The file of a camera alone says how its calibration ended."""

from pathlib import Path

import numpy as np
import pytest

from calibration.errors import CalibrationError
from calibration.files.rig_file import KnownCamera, camera_file_text, load_camera
from calibration.model.rig_model import Covariance
from calibration.verdict import Verdict, reason_for
from tests.unit.calibration.cameras import camera

KNOWN = Covariance(("fx", "fy"), np.diag([0.04, 0.09]))


def read_back(folder: Path, text: str) -> KnownCamera:
    file = folder / "camera.yaml"
    file.write_text(text)
    return load_camera(file)


@pytest.mark.parametrize("codes", [(), ("no-tilt", "poor-coverage")])
def test_the_verdict_and_its_reasons_are_read_back_with_the_camera(tmp_path: Path, codes: tuple[str, ...]) -> None:
    verdict = Verdict(not codes, tuple(reason_for(code, "said") for code in codes))
    lens = camera([-0.1, 0.02, 0, 0, 0])
    known = read_back(tmp_path, camera_file_text(lens, KNOWN, ["0" * 16], verdict))
    assert (known.verdict, known.reasons) == ("failed" if codes else "passed", codes)
    assert np.array_equal(known.camera.distortion, lens.distortion)
    assert known.views == {"0" * 16}


def test_a_file_of_old_is_one_that_nobody_judged(tmp_path: Path) -> None:
    text = camera_file_text(camera([]), KNOWN, [], Verdict(True))
    known = read_back(tmp_path, text.replace("verdict: passed\n", ""))
    assert (known.verdict, known.reasons) == (None, ())
    with pytest.raises(CalibrationError, match="verdict is 'good'"):
        read_back(tmp_path, text.replace("verdict: passed\n", "verdict: good\n"))
