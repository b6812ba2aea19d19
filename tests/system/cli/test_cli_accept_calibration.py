"""A calibration of another rig: exit code 2 and one line, or `--accept-calibration` and a line in the table."""

import json
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


def test_a_tradeoff_asks_for_it_as_the_scan_of_its_answer_will(rig: Rig, foreign: Path) -> None:
    asked = ["tradeoff", foreign, "--exposures", 4, "--estimators", "argmax", "--filters", "none", "--no-limits"]
    refused = rig(*asked, "--out", "none")
    assert (refused.code, len(refused.problems)) == (2, 1)
    assert "'SPB-0042', this rig has 'SIM-0001'; calibrate again, or add --accept-calibration" in refused.problems[0]
    assert not Path("none").exists()
    accepted = rig(*asked, "--lines", 2, "--error", "100 px", "--accept-calibration", "--out", "tried")
    assert accepted.code == 0, accepted.err
    assert "calibration accepted in spite of other-spad" in accepted.out
    (noted,) = json.loads(Path("tried/tradeoff.json").read_text())["accepted_calibration"]
    assert noted.startswith("other-spad: ")
    assert "scan with accept_calibration" in Path("tried/setting.yaml").read_text()
