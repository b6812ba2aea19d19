"""A study's file: what it may have, what it means, and one line for each mistake."""

from pathlib import Path
from typing import Any

import pytest
import yaml

from rig.errors import UsageError
from rig.study.definition import KEYS, MOST_CASES, Study, left_out, load_study


def problems_of(content: dict[str, Any]) -> list[str]:
    """The lines with which a study is refused."""
    with pytest.raises(UsageError) as refused:
        load_study(content)
    return str(refused.value).splitlines()


@pytest.mark.parametrize(
    ("content", "line"),
    [
        ({}, "study: do: field required"),
        ({"do": "paint"}, "study: do: input should be 'scan', 'reconstruct', 'tradeoff', 'strategies' or 'calibrate'"),
        ({"do": "scan", "vari": {}}, "study: 'vari' is no key of a study; its keys are do, vary, also, set, omit,"),
        ({"do": "scan", "vary": {"maps": []}}, "study: vary.maps: list should have at least 1 item"),
        ({"do": "scan", "vary": {"maps": 3}}, "study: vary.maps is 3, not a list; write maps: [3]"),
        (
            {"do": "scan", "vary": {"seed": [3]}},
            "study: 'seed' is no setting but a key of the study itself, beside vary",
        ),
        ({"do": "scan", "config": "small"}, "study: 'config' is a setting; it belongs under vary (a list) or set"),
        ({"do": "reconstruct", "repeat": 3}, "study: repeat is for what is drawn, and reconstruct draws nothing"),
        (
            {"do": "scan", "set": {"estimator": ["edge", "joint"]}},
            "set gives estimator a list; set is for what all cases",
        ),
        ({"do": "scan", "omit": [{}]}, "study: omit.0: dictionary should have at least 1 item"),
        ({"do": "scan", "repeat": 0}, "study: repeat: input should be greater than or equal to 1"),
        ({"do": "scan", "seed": -1}, "study: seed: input should be greater than or equal to 0"),
        ({"do": "scan", "time_limit": "long"}, "'long' is no time for a case; write it like '90 s', '10 min' or '2 h'"),
        ({"do": "scan", "time_limit": "0 s"}, "'0 s' is no time for a case"),
        ({"do": "scan", "memory_limit": "2 miles"}, "'2 miles' is no size of memory; write it like '2 GB'"),
        ({"do": "scan", "set": {"poses": 3}}, "study: scan has no setting 'poses'; it has config, scene,"),
        ({"do": "tradeoff", "set": {"scan.columns": 3}}, "study: tradeoff has no setting 'scan.columns'"),
        ({"do": "tradeoff", "also": [{"fog": "20m"}]}, "study: also is not for tradeoff, which combines all lists"),
        (
            {"do": "scan", "vary": {"fog": ["20m"]}, "omit": [{"fog": "20 m"}]},
            "study: omit has fog '20 m', which no case has; fog is one of ['20m']",
        ),
        (
            {"do": "tradeoff", "omit": [{"estimator": "edge"}]},
            "study: omit has 'estimator', but every case of tradeoff has all of them; make two studies",
        ),
        (
            {"do": "scan", "set": {"fog": "9m"}, "vary": {"fog": ["10m"]}},
            "study: fog is under set and under vary; name it once",
        ),
        ({"do": "scan", "repeat": MOST_CASES + 1}, f"{MOST_CASES + 1} cases are too many, at most {MOST_CASES}"),
    ],
)
def test_a_mistake_is_one_line(content: dict[str, Any], line: str) -> None:
    (said,) = problems_of(content)
    assert line in said


def test_all_mistakes_are_told_together() -> None:
    assert len(problems_of({"do": "paint", "vari": {}, "repeat": 0})) == 3
    assert len(problems_of({"do": "scan", "set": {"poses": 1, "lux": 2}, "omit": [{"poses": 1, "rows": 2}]})) == 3


@pytest.mark.parametrize(
    "content",
    [
        {"set": {"scan.exposures": 7}, "vary": {"exposures": [3, 4]}},
        {"set": {"fog": "20m", "world.fog": "50m"}},
        {"vary": {"scan.exposures": [3, 9], "exposures": [3]}},
        {"vary": {"exposures": [3, 4]}, "omit": [{"scan.exposures": 3}]},
    ],
)
def test_one_setting_has_one_name(content: dict[str, Any]) -> None:
    (problem,) = [each for each in problems_of({"do": "scan", **content}) if "same setting" in each]
    assert problem.endswith("are the same setting; write it in one way everywhere")


def test_nothing_is_left_out_that_no_case_names() -> None:
    (problem,) = problems_of({"do": "scan", "vary": {"exposures": [1]}, "omit": [{"maps": 7}]})
    assert problem == "study: omit has maps, which no case names; add it to vary, or leave it out of omit"
    assert load_study({"do": "strategies", "omit": [{"fog": "10m"}]}).omit, "it has usual values"


def test_a_file_is_named_in_its_mistakes(tmp_path: Path) -> None:
    (tmp_path / "study.yaml").write_text("do: paint")
    with pytest.raises(UsageError, match=r"study.yaml: do: input should be"):
        load_study(tmp_path / "study.yaml")
    with pytest.raises(UsageError, match=r"none.yaml: No such file"):
        load_study(tmp_path / "none.yaml")
    (tmp_path / "study.yaml").write_text("- scan")
    with pytest.raises(UsageError, match=r"study.yaml"):
        load_study(tmp_path / "study.yaml")


def test_every_combination_of_lists_is_one_setting_and_then_come_those_of_also() -> None:
    study = load_study(
        {
            "do": "scan",
            "set": {"config": "small", "maps": 1},
            "vary": {"fog": ["clear", "20m"], "exposures": [1, 3]},
            "also": [{"fog": "10m", "maps": 5}],
        }
    )
    found = list(study.combinations())
    assert [(each["fog"], each.get("exposures"), each["maps"]) for each in found] == [
        ("clear", 1, 1), ("clear", 3, 1), ("20m", 1, 1), ("20m", 3, 1), ("10m", None, 5),
    ]  # fmt: skip
    assert study.labels == ("fog", "exposures", "maps", "seed")


def test_without_lists_there_is_one_setting_and_with_also_alone_only_those() -> None:
    assert list(load_study({"do": "scan"}).combinations()) == [{}]
    assert list(load_study({"do": "scan", "also": [{"maps": 2}]}).combinations()) == [{"maps": 2}]


def test_a_setting_is_left_out_if_it_has_all_values_of_one_that_is_to_be() -> None:
    study = load_study(
        {
            "do": "scan",
            "vary": {"fog": ["clear", "20m"], "exposures": [1, 3]},
            "omit": [{"fog": "20m", "exposures": 1}],
        }
    )
    assert [(each["fog"], each["exposures"]) for each in study.combinations()] == [
        ("clear", 1), ("clear", 3), ("20m", 3),
    ]  # fmt: skip
    assert left_out({"a": 1, "b": 2}, [{"a": 1}])
    assert not left_out({"a": 1}, [{"a": 1, "b": 2}])


def test_seeds_and_limits() -> None:
    study = load_study({"do": "scan", "seed": 5, "repeat": 3, "time_limit": "1.5 min", "memory_limit": "500 MB"})
    assert list(study.seeds) == [5, 6, 7]
    assert (study.time_limit_s, study.memory_limit_bytes) == (90.0, 500_000_000)
    assert Study(do="scan").time_limit_s == 3600.0


def test_paths_are_relative_to_the_file_and_names_stay_names(tmp_path: Path) -> None:
    (tmp_path / "rigs").mkdir()
    (tmp_path / "rigs" / "mine.yaml").touch()
    (tmp_path / "dust.yaml").touch()
    (tmp_path / "street").mkdir()  # the results of a study that somebody called so
    content = {
        "do": "scan",
        "set": {"config": "rigs/mine.yaml"},
        "vary": {"scene": ["dust.yaml", "street"]},
        "also": [{"scene": "./dust.yaml", "estimator": "dust.yaml"}],
        "omit": [{"scene": "dust.yaml"}],
    }
    (tmp_path / "study.yaml").write_text(yaml.safe_dump(content))
    study = load_study(tmp_path / "study.yaml")
    assert study.set == {"config": str(tmp_path / "rigs" / "mine.yaml")}
    assert study.vary == {"scene": [str(tmp_path / "dust.yaml"), "street"]}
    assert study.also == [{"scene": str(tmp_path / "dust.yaml"), "estimator": "dust.yaml"}]
    assert [each["scene"] for each in study.combinations()] == ["street"], "what is left out is meant the same way"
    content = {"do": "reconstruct", "set": {"plan": "plan.json"}, "vary": {"recording": ["monday", "/data/tuesday"]}}
    (tmp_path / "study.yaml").write_text(yaml.safe_dump(content))
    made = load_study(tmp_path / "study.yaml")
    assert made.vary["recording"] == [str(tmp_path / "monday"), "/data/tuesday"], "also where there is none yet"
    assert made.set == {"plan": str(tmp_path / "plan.json")}


def test_a_study_may_be_its_content_or_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "dust.yaml").touch()
    study = load_study({"do": "scan", "set": {"scene": "dust.yaml"}})
    assert study.set == {"scene": str(tmp_path / "dust.yaml")}
    assert load_study(study) is study


def test_every_action_says_which_settings_it_has() -> None:
    for action, keys in KEYS.items():
        (said,) = problems_of({"do": action, "set": {"nonsense": 1}})
        assert f"it has {', '.join(keys)}" in said
        assert ("keys of the config such as scan.columns" in said) == (action in ("scan", "calibrate"))


@pytest.mark.parametrize("action", KEYS)
def test_the_guide_names_all_settings(action: str) -> None:
    guide = (Path(__file__).parents[4] / "docs/how-to/batch.md").read_text(encoding="utf-8")
    (line,) = (line for line in guide.splitlines() if line.startswith(f"| `{action}` |"))
    assert [key for key in KEYS[action] if f"`{key}`" not in line] == []
