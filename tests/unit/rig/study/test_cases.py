"""The cases of a study; what is wrong with a setting is said before any case is done."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rig.batch.case import INSTALLED, Case
from rig.errors import UsageError
from rig.kernel_cache import TOP
from rig.study.cases import cases_of, kept_cases
from rig.study.definition import load_study


def cases(**content: Any) -> list[Case]:
    """The cases of a study."""
    return cases_of(load_study(content))


def test_each_setting_is_done_with_each_seed() -> None:
    made = cases(do="scan", set={"config": "small"}, vary={"exposures": [2, 4]}, repeat=2, seed=7)
    assert [each.labels for each in made] == [
        {"exposures": 2, "seed": 7}, {"exposures": 2, "seed": 8},
        {"exposures": 4, "seed": 7}, {"exposures": 4, "seed": 8},
    ]  # fmt: skip
    assert {each.function for each in made} == {"rig.api.studies.cases:scan_once"}
    assert [each.inputs["config"]["scan"]["exposures"] for each in made] == [2, 2, 4, 4]
    assert [each.inputs["seed"] for each in made] == [7, 8, 7, 8]
    assert {each.inputs["maps"] for each in made} == {1}
    assert not any(each.keeps for each in made)


def test_short_names_and_keys_of_the_config_are_set() -> None:
    (made,) = cases(
        do="scan", keep=True, set={"config": "small", "fog": "20m", "estimator": "edge", "scan.columns": 150, "maps": 3}
    )
    content = made.inputs["config"]
    assert content["world"]["fog"] == "20m"
    assert content["estimate"]["estimator"] == "edge"
    assert content["scan"]["columns"] == 150
    assert made.inputs["maps"] == 3
    assert made.keeps
    assert content["calibration"].startswith(INSTALLED), "it lies elsewhere on another computer"
    assert made.files == (content["calibration"],)


def test_a_calibration_of_ones_own_counts_by_its_content(tmp_path: Path) -> None:
    for name in ("small.yaml", "small-rig.yaml"):
        (tmp_path / name).write_bytes((TOP / "config" / name).read_bytes())
    (made,) = cases(do="scan", set={"config": str(tmp_path / "small.yaml")})
    assert made.files == (str(tmp_path / "small-rig.yaml"),)


def test_poses_of_a_calibration() -> None:
    (made,) = cases(do="calibrate", set={"config": "small"})
    assert made.function == "rig.api.studies.cases:calibrate_once"
    assert made.inputs["poses"] == 12


def test_a_reconstruction_has_no_seed_and_reads_its_recording(tmp_path: Path) -> None:
    frames = tmp_path / "frames.npy"
    np.save(frames, np.zeros((4, 2, 1), np.uint8))
    for name in ("plan.yaml", "calibration.yaml"):
        (tmp_path / name).write_text("")
    taken = {"recording": str(frames), "plan": str(tmp_path / "plan.yaml")}
    taken |= {"calibration": str(tmp_path / "calibration.yaml")}
    made = cases(do="reconstruct", set=taken, vary={"estimator": ["edge", "joint"]})
    assert [each.labels for each in made] == [{"estimator": "edge"}, {"estimator": "joint"}]
    assert made[0].inputs == {**taken, "estimator": "edge"}
    assert made[0].files == tuple(taken.values())
    in_python = cases(do="reconstruct", set={key: Path(value) for key, value in taken.items()})
    assert in_python[0].inputs == taken
    with pytest.raises(UsageError, match=r"frames\.npy holds frames alone; add plan and calibration to say how"):
        cases(do="reconstruct", set={"recording": str(frames)})
    (tmp_path / "empty").mkdir()
    with pytest.raises(UsageError) as refused:
        cases(do="reconstruct", vary={"recording": [str(tmp_path / "empty"), str(tmp_path / "plan.yaml")]})
    assert len(str(refused.value).splitlines()) == 2


@pytest.mark.parametrize(
    ("content", "line"),
    [
        ({"do": "scan", "set": {"config": "none"}}, "none"),
        ({"do": "scan", "set": {"config": "small", "maps": 0}}, "maps is 0; it must be a whole number, at least 1"),
        ({"do": "scan", "set": {"config": "small", "scene": "nowhere"}}, "nowhere"),
        ({"do": "scan", "set": {"config": "small", "scan.columns": "wide"}}, "scan.columns"),
        ({"do": "scan", "set": {"config": "lab-emulated"}}, "runs in the host's time"),
        ({"do": "scan", "set": {"config": "small", "maps": True}}, "maps is True; it must be a whole number"),
        ({"do": "calibrate", "set": {"config": "small", "poses": 1.5}}, "poses is 1.5; it must be a whole number"),
        ({"do": "reconstruct", "set": {"recording": 20261129}}, "recording is 20261129; it must be text"),
        ({"do": "reconstruct", "set": {"recording": "/", "min_confidence": "high"}}, "'high'; it must be a number"),
        ({"do": "reconstruct", "set": {"recording": "/", "min_confidence": 2}}, "a probability from 0 to 1"),
        ({"do": "reconstruct"}, "reconstruct needs the setting 'recording'"),
        ({"do": "reconstruct", "set": {"recording": "/none"}}, "/none does not exist; correct the path"),
        ({"do": "reconstruct", "set": {"recording": "/", "estimator": "auto"}}, "depends on the computer; name one"),
        ({"do": "reconstruct", "set": {"recording": "/", "estimator": "x"}}, "estimator 'x' is unknown; choose one of"),
        ({"do": "reconstruct", "set": {"recording": "/", "filter": "x"}}, "filter 'x' is unknown; choose one of"),
        ({"do": "scan", "set": {"config": "small"}, "omit": [{"config": "small"}]}, "omit leaves all of them out"),
    ],
)
def test_what_is_wrong_with_a_setting_is_one_line(content: dict[str, Any], line: str) -> None:
    with pytest.raises(UsageError) as refused:
        cases(**content)
    assert line in str(refused.value)
    assert len(str(refused.value).splitlines()) == 1


def test_the_problems_of_all_settings_are_told_together() -> None:
    with pytest.raises(UsageError) as refused:
        cases(do="scan", set={"config": "small"}, vary={"maps": [0, 1, -3]})
    assert [line[:8] for line in str(refused.value).splitlines()] == ["maps is ", "maps is "]


def test_cases_are_left_out_by_their_labels() -> None:
    made = [Case("a:b", {}, {"fog": fog}) for fog in ("clear", "20m")]
    assert kept_cases(made, [{"fog": "clear"}]) == [False, True]
