"""A calibration of another rig: exit code 2 and one line, or `--accept-calibration` and a line in the table."""

from dataclasses import replace
from pathlib import Path

import pytest

from calibration.files.rig_file import load_rig_model, save_rig_model
from calibration.model.rig_model import Identity
from tests.system.conftest import Rig


@pytest.fixture
def foreign(small: Path) -> Path:
    """Config of the small rig with a calibration that was made with another sensor."""
    identity = Identity(rig="0" * 16, created="2026-11-22T10:00:00+00:00", name="lab", serials={"spad": "SPB-0042"})
    save_rig_model(replace(load_rig_model(small.parent / "rig.yaml"), identity=identity), small.parent / "lab.yaml")
    small.write_text(small.read_text().replace("calibration: rig.yaml", "calibration: lab.yaml"))
    return small


def test_scan_replay_and_reconstruct_refuse_it_and_accept_it_where_told_to(rig: Rig, foreign: Path) -> None:
    refused = rig("scan", foreign, "--out", "none")
    assert refused.code == 2
    assert len(refused.problems) == 1
    said = "with spad serial number 'SPB-0042', this rig has 'SIM-0001'; calibrate again, or add --accept-calibration"
    assert said in refused.problems[0]
    assert rig("scan", foreign, "--dry-run").code == 2
    assert rig("scan", foreign, "--dry-run", "--accept-calibration").code == 0

    scanned = rig("scan", foreign, "--accept-calibration", "--record", "--out", "run")
    assert scanned.code == 0
    assert "accepted in spite of other-spad" in scanned.out

    other = foreign.parent / "lab.yaml"
    assert rig("reconstruct", "run", "--calibration", other, "--out", "none").code == 2
    again = rig("reconstruct", "run", "--calibration", other, "--accept-calibration", "--out", "depth")
    assert again.code == 0
    assert "accepted in spite of other-spad" in again.out
    assert rig("replay", "run", "--clock", "max", "--accept-calibration", "--out", "replayed").code == 0
