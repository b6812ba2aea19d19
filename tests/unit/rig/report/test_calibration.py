"""The report on a calibration file: its age, its checks, and the depth error that it leaves."""

from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from calibration.depth_error import depth_uncertainty
from calibration.errors import in_mm
from calibration.files.rig_file import load_rig_model
from rig.report.calibration import age_words, calibration_report
from tests.unit.rig.report.pages import calibration_file, words_of

NOW = datetime(2025, 12, 1, 10, tzinfo=UTC)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    np.save(tmp_path / "covariance.npy", np.diag([0.5, 1e-8]))
    names = {"names": ["fx", "axis_shift_1"], "file": "covariance.npy"}
    return calibration_file(tmp_path / "calibration.yaml", covariance=names)


def test_a_calibration_is_dated_judged_and_has_an_error_for_each_distance(file: Path) -> None:
    model = load_rig_model(file)
    html = calibration_report(file, model, {}, NOW)
    words = words_of(html)
    assert "PASSED Expected depth error at 5 m: " in words
    assert "2025-11-24 10:00 UTC, 7 days ago" in words
    expected = depth_uncertainty(model, 2.0)
    assert in_mm(float(np.nanmedian(expected.sd_m))) in words
    assert html.count("<figure><img") == 1
    assert "axis_shift_1 0.0001" in words
    assert f"rig report {file}" in words


def test_a_failed_check_comes_before_its_own_verdict(file: Path) -> None:
    notes = {"check": {"date": "2025-11-30T08:00:00+00:00", "passed": False, "reasons": ["the board is bent"]},
             "pixels": {"date": "2025-11-29T08:00:00+00:00", "passed": True, "reasons": []}}  # fmt: skip
    html = calibration_report(file, load_rig_model(file), notes, NOW, ["more"])
    words = words_of(html)
    assert "FAILED A CHECK" in words
    assert "check: the board is bent." in words
    assert "pixels 2025-11-29T08:00:00+00:00 passed" in words
    assert 'class="bad"' in html


def test_one_written_by_hand_says_that_its_error_is_not_known(tmp_path: Path) -> None:
    file = calibration_file(tmp_path / "calibration.yaml")
    content = file.read_text()
    file.write_text(content[: content.index("identity:")] + content[content.index("lag_s:") :])
    words = words_of(calibration_report(file, load_rig_model(file), {}, NOW))
    assert "NOT JUDGED Its error is not known: it states no covariance." in words


@pytest.mark.parametrize(
    ("hours", "said"), [(0.2, "0 hours"), (47, "47 hours"), (49, "2 days"), (24 * 400, "400 days")]
)
def test_ages_in_words(hours: float, said: str) -> None:
    assert age_words(timedelta(hours=hours)) == said
