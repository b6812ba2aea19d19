"""What `rig scan` refuses before anything moves, in a line each."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from tests.system.conftest import Rig
from tests.system.run_files import files
from tests.system.small_rig import calibration, config, write_rig


def test_the_calibration_of_a_cube_is_refused_as_such(rig: Rig, tmp_path: Path) -> None:
    file = write_rig(tmp_path / "cube", config())
    content = calibration()
    del content["scanner"], content["source_m"], content["lag_s"]
    np.save(file.parent / "planes.npy", np.array([[1.0, 0.0, 0.3, 0.1]] * 200))
    (file.parent / "planes.yaml").write_text(yaml.safe_dump({**content, "planes": "planes.npy"}))
    file.write_text(file.read_text().replace("calibration: rig.yaml", "calibration: planes.yaml"))
    ran = rig("scan", file, "--dry-run")
    assert (ran.code, len(ran.problems)) == (2, 1)
    assert "is for a bare cube" in ran.problems[0]


@pytest.mark.parametrize(
    ("edit", "said"),
    [
        ({"scan.colums": 500}, "unknown key 'scan.colums'; did you mean 'scan.columns'?"),
        ({"scan.columns": 3, "scan.exposures": 1}, "raise scan.exposures to"),
        ({"spad.kind": "simulatd"}, "choose one of"),
        ({"world.scene": "nowhere"}, "nowhere' is no file, no folder and none of the bundled"),
        ({"calibration": "absent.yaml"}, "cannot read calibration"),
        ({"calibration": "other.yaml"}, "sensor of 128 x 40 pixels, this one has 96 x 40"),
    ],
)
def test_a_bad_config_is_refused_in_a_line_and_nothing_is_left(
    rig: Rig, tmp_path: Path, edit: dict[str, object], said: str
) -> None:
    content = config()
    for key, value in edit.items():
        *section, name = key.split(".")
        (content[section[0]] if section else content)[name] = value
    file = write_rig(tmp_path / "bad", content)
    (file.parent / "other.yaml").write_text(yaml.safe_dump(calibration(width=128)))
    ran = rig("scan", file, "--out", "deep/run", "--json")
    assert ran.code == 2
    assert json.loads(ran.out)["error"]["problems"] == [line.removeprefix("error: ") for line in ran.problems]
    assert said in ran.err
    assert ran.err.splitlines() == ran.problems
    assert len(ran.problems) == 1
    assert not list(Path().iterdir())


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--on-overload", "ignore"], "write 'abort', 'drop' or 'block'"),
        (["--exposures", "-1"], "--exposures is -1, it must be at least 1; write for example --exposures 10"),
        (["--exposures", "many"], "--exposures is 'many', which is no whole number; see 'rig scan --help'"),
        (["--min-confidence", "high"], "--min-confidence is 'high', which is no number; see 'rig scan --help'"),
        (["--exposure", "20"], "there is no option --exposure; did you mean --exposures? see 'rig scan --help'"),
        (["--zzz"], "there is no option --zzz; see 'rig scan --help'"),
        (["--maps", "0"], "maps is 0; it must be at least 1"),
        (["--seed", "-3"], "seed is -3; it must be 0 or more"),
        (["--seed", str(2**63)], "at most 2^63 - 1"),
        (["--dry-run", "--save", "never"], "write 'all', 'last' or 'every N'"),
        (["--estimator", "best"], "choose 'auto', 'argmax'"),
        (["--save", "every", "0"], "'every N' with N of 1 or more"),
    ],
)
def test_a_bad_option_is_refused_in_a_line(rig: Rig, small: Path, arguments: list[str], said: str) -> None:
    ran = rig("scan", small, *arguments)
    assert ran.code == 2
    assert said in ran.err
    assert len(ran.err.splitlines()) == 1
    assert not list(Path().iterdir())


def test_an_out_folder_that_cannot_be_is_refused_before_anything_runs(rig: Rig, small: Path) -> None:
    Path("file").write_text("")
    Path("full").mkdir()
    Path("full/notes.txt").write_text("mine")
    for out, said in (("file", "is a file"), ("file/run", "cannot write"), ("full", "not empty")):
        ran = rig("scan", small, "--out", out)
        assert (ran.code, len(ran.problems)) == (2, 1)
        assert said in ran.problems[0]
    assert files(Path()) == {"file", "full/notes.txt"}


@pytest.mark.parametrize(("width", "height"), [(1, 40), (96, 1)])
def test_a_simulated_camera_of_one_pixel_either_way_is_refused(
    rig: Rig, tmp_path: Path, width: int, height: int
) -> None:
    file = write_rig(tmp_path / "tiny", width=width, height=height)
    for command in (["scan", file], ["effects", file], ["tradeoff", file, "--exposures", 4]):
        ran = rig(*command)
        assert (ran.code, len(ran.problems)) == (2, 1), ran.err
        assert f"a camera of {width} x {height} pixels; simulated light needs at least 2 each way" in ran.problems[0]
    assert not list(Path().iterdir())


@pytest.mark.parametrize(("width", "height"), [(2, 2), (65, 3)])
def test_a_camera_of_a_few_pixels_is_scanned(rig: Rig, tmp_path: Path, width: int, height: int) -> None:
    file = write_rig(tmp_path / "tiny", width=width, height=height)
    ran = rig("scan", file, "--scene", "street-everything", "--out", "run")
    assert ran.code == 0, ran.err
    assert np.load("run/depth/000000.npy").shape == (height, width)
    ran = rig("effects", file)
    assert ran.code == 0, ran.err
