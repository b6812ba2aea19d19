"""A comparison on a small rig: its rows, files and refusals, and the ranges and pictures made of rows."""

import csv
import io
import math
import re
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml

from calibration.files.rig_file import load_rig_model
from rig.api import compare_strategies
from rig.api.strategies import as_cases
from rig.config.files import portable_content
from rig.config.overrides import configure
from rig.errors import RigError, UsageError
from rig.requests import StrategiesRequest
from rig.strategies.comparison import compare
from rig.strategies.comparison.compare import (
    Comparison,
    Reached,
    StrategyRow,
    measure_once,
    ranges,
    require_form,
    run_comparison,
)
from rig.strategies.comparison.files import (
    MOST_CURVES,
    best_of_kinds,
    csv_text,
    kind_of,
    time_svg,
    visibility_svg,
)
from rig.strategies.comparison.places import air_problems, scene_file, scene_path, visibility_m
from rig.strategies.comparison.scene import OpenScene, Place, close_scene, open_scene
from rig.strategies.comparison.tables import figures_tables, ranges_table, sources_table, too_short_lines
from rig.strategies.strategy import Answer, find_strategy
from tests.stability.inventory import covers
from tests.system import small_rig

covers(visibility_m, scene_file, OpenScene, measure_once, Reached, Comparison, require_form, run_comparison, ranges)
covers(sources_table)


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rig")
    rig = small_rig.calibration()
    rig["camera"]["distortion"] = [0.0] * 5
    (folder / "rig.yaml").write_text(yaml.safe_dump(rig))
    (folder / "small.yaml").write_text(yaml.safe_dump(small_rig.config()))
    return folder / "small.yaml"


SOME = {"strategies": ["line-argmax", "gray-spad", "line-camera", "hybrid"], "times": ["2ms", "20ms"], "rows": 8,
        "fogs": ["clear", "20m"], "scenes": ["ramp"]}  # fmt: skip


@pytest.fixture(scope="module")
def done(config, tmp_path_factory):
    told = []
    found = compare_strategies(config, **SOME, out=tmp_path_factory.mktemp("out") / "made",
                               progress=lambda done, total: told.append((done, total)))  # fmt: skip
    assert told[-1] == (len(found.rows), len(found.rows))
    return found


def test_there_is_a_row_for_every_setting(done):
    settings = {(row.strategy, row.air, row.rule, row.time_ms) for row in done.rows}
    assert len(settings) == len(done.rows) == 4 * 2 * 2 * 2
    assert {row.scene for row in done.rows} == {"ramp"}
    assert {row.light for row in done.rows} == {"line", "pattern"}
    assert done.verdict == "complete"


def test_a_way_that_needs_more_time_says_so_in_place_of_figures(done):
    short = [row for row in done.rows if row.strategy == "line-camera"]
    assert all(row.too_short and "ms" in row.too_short and row.mean_px is None for row in short)
    whole = [row for row in done.rows if row.too_short is None]
    for row in whole:
        assert row.mean_px is not None
        assert 0 < row.mean_px <= 10
        assert 0 <= row.good <= row.valid <= 1
        assert row.spent_ms <= row.time_ms * (1 + 1e-6)
        if row.rule == "energy":
            assert row.energy_mj <= 50 * row.spent_ms * 1e-3 * (1 + 1e-6)


def test_more_time_is_not_worse_and_fog_is_not_better(done):
    figures = {(row.strategy, row.air, row.rule, row.time_ms): row for row in done.rows}
    short, long = (figures["line-argmax", "clear", "energy", t].mean_px for t in (2.0, 20.0))
    assert long < short
    assert figures["gray-spad", "clear", "energy", 20.0].good >= figures["gray-spad", "20m", "energy", 20.0].good


def test_patents_are_said_and_laser_classes_stand_beside(done):
    assert len(done.notes) == 1
    assert "US 2023/0410333" in done.notes[0]
    classes = {row.strategy: row.laser_class_still for row in done.rows if row.rule == "energy"}
    assert classes["gray-spad"] in ("1", "2", "3R")
    assert classes["line-argmax"] == "3R"
    assert {scene for of in done.seconds.values() for scene in of} == {"ramp"}


def test_the_files_hold_all_rows(done):
    lines = list(csv.DictReader(io.StringIO((done.folder / "strategies.csv").read_text())))
    assert len(lines) == len(done.rows)
    assert lines[0].keys() == StrategyRow.__dataclass_fields__.keys()
    for name in ("strategies.svg", "strategies-visibility.svg"):
        assert ElementTree.parse(done.folder / name).getroot().tag.endswith("svg")
    assert (done.folder / "strategies.json").stat().st_size > 1000


def test_the_same_seed_gives_the_same_figures(config, done):
    again = compare_strategies(config, **{**SOME, "fogs": ["clear"], "rules": ["energy"], "strategies": ["gray-spad"]})
    expected = [row for row in done.rows if (row.strategy, row.air, row.rule) == ("gray-spad", "clear", "energy")]
    assert [replace(row, compute_s=0.0) for row in again.rows] == [replace(row, compute_s=0.0) for row in expected]


def test_own_air_is_that_of_the_scene(config):
    asked = {**SOME, "rules": ["energy"], "strategies": ["gray-spad"], "times": ["20ms"]}
    own, clear = (compare_strategies(config, **asked | {"scenes": ["street"], "fogs": [air]}).rows[0]
                  for air in ("own", "clear"))  # fmt: skip
    assert (own.air, clear.air) == (None, "clear")
    assert own.good < clear.good  # the street's own is foggy


def test_scenes_of_the_same_name_are_told_apart_and_cases_are_the_parts_of_a_comparison(config, tmp_path):
    folders = [str(tmp_path / name / "street") for name in ("lab", "yard")]
    for folder, depth_m in zip(folders, (2.0, 3.0), strict=True):
        Path(folder).mkdir(parents=True)
        surfaces = {"depth_m": np.full((40, 96), depth_m, np.float32), "albedo": np.full((40, 96), 0.5, np.float32)}
        np.savez(Path(folder) / "world.npz", **surfaces)
    request = StrategiesRequest(
        **SOME | {"scenes": [*folders, "ramp"], "rules": ["energy"], "strategies": ["gray-spad"], "times": ["20ms"]}
    )
    whole = compare_strategies(config, request)
    assert [row.scene for row in whole.rows] == [each for each in (*folders, "ramp") for _ in SOME["fogs"]]
    cases, _ = as_cases(config, request)
    parts = [StrategyRow(**row) for case in cases for row in case.call()["rows"]]
    assert parts == [replace(row, compute_s=0.0) for row in whole.rows]


def test_a_folder_with_the_name_of_a_scene_is_not_that_scene_and_nothing_is_left_behind(config, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    (tmp_path / "ramp").mkdir()
    assert scene_path("ramp") == "ramp"
    assert scene_path("own") == str(tmp_path / "own")
    place = Place("ramp", "ramp", "clear", 4, None)
    assert open_scene(portable_content(configure(config)), place).true_m.size
    assert [each.name for each in tmp_path.iterdir()] == ["ramp"]
    close_scene()


def test_a_scene_whose_surfaces_are_missing_is_told_before_anything_is_measured(config, tmp_path):
    (tmp_path / "bad.yaml").write_text("surfaces: nowhere\n")
    with pytest.raises(UsageError, match=r"bad\.yaml' names surfaces that are not there, .*nowhere; correct it"):
        compare_strategies(config, **SOME | {"scenes": ["ramp", str(tmp_path / "bad.yaml")]})


def test_a_scene_stays_open_until_another_is_wanted_or_its_files_have_changed(config, tmp_path):
    def write(depth_m):
        surfaces = {"depth_m": np.full((40, 96), depth_m, np.float32), "albedo": np.full((40, 96), 0.5, np.float32)}
        np.savez(tmp_path / "world.npz", **surfaces)

    write(2.0)
    content = portable_content(configure(config))
    place = Place("wall", str(tmp_path), "clear", 4, None)
    first = open_scene(content, place)
    assert open_scene(content, replace(place)) is first
    write(3.0)
    changed = open_scene(content, place)
    assert np.allclose(changed.true_m, 3.0, atol=0.2)
    assert open_scene(content, replace(place, air="20m")) is not changed
    assert open_scene(content, place) is not changed
    close_scene()


def test_several_seeds_give_a_spread(config):
    found = compare_strategies(
        config,
        **{**SOME, "fogs": ["snow"], "rules": ["energy"], "strategies": ["gray-spad"], "times": ["2ms"]},
        repeat=2,
    )
    assert len(found.rows) == 1
    assert found.rows[0].spread_px is not None


def test_an_interrupt_keeps_the_whole_rows(config, monkeypatch):
    calls = []
    measure = type(find_strategy("gray-spad")).measure

    def interrupted(*arguments):
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return measure(*arguments)

    monkeypatch.setattr(type(find_strategy("gray-spad")), "measure", interrupted)
    asked = {**SOME, "strategies": ["gray-spad"], "fogs": ["clear"]}
    found = compare_strategies(config, **asked)
    assert (len(found.rows), found.verdict) == (2, "aborted")


def test_a_way_that_overspends_is_an_error(config, monkeypatch):
    class Greedy:
        name, sentence, source, light, clear_px = "greedy", "Takes twice its time.", "nowhere at all", "pattern", 1.0

        def measure(self, apparatus, geometry, budget, rng_seed):
            frames = np.array([round(2 * budget.time_s / apparatus.spad_frame_s)])
            apparatus.spad_counts(np.ones((1, apparatus.columns), np.float32), frames)
            nothing = np.zeros(geometry.shape, np.float32)
            return Answer(nothing * np.nan, nothing)

    for module in ("rig.api.strategies", "rig.strategies.comparison.compare"):
        monkeypatch.setattr(f"{module}.find_strategy", lambda name: Greedy())
    with pytest.raises(RigError, match="greedy took 4 ms of 2 ms"):
        compare_strategies(config, strategies=["greedy"], times=["2ms"], scenes=["ramp"], fogs=["clear"], rows=4)


def test_a_way_that_raises_is_named(config, monkeypatch):
    def broken(*arguments):
        raise ZeroDivisionError("of its own")

    monkeypatch.setattr(type(find_strategy("gray-spad")), "measure", broken)
    with pytest.raises(ZeroDivisionError) as raised:
        compare_strategies(config, strategies=["gray-spad"], times=["2ms"], scenes=["ramp"], fogs=["clear"], rows=4)
    assert raised.value.__notes__ == ["raised by the strategy gray-spad in 2 ms: tell its authors"]


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (None, "greedy answers with NoneType; it must return"),
        (Answer(np.ones((3, 2), np.float32), np.ones((2, 3), np.float32)), r"depth_m of float32 and shape \(3, 2\)"),
        (Answer(np.ones((2, 3), np.float32), np.ones((2, 3))), "confidence of float64"),
        (Answer(np.ones((2, 3), np.float32), np.full((2, 3), np.nan, np.float32)), "not 0 to 1"),
        (Answer(np.full((2, 3), np.nan, np.float32), np.ones((2, 3), np.float32)), "not 0 where depth_m is NaN"),
    ],
)
def test_an_answer_of_another_form_is_an_error_of_its_strategy(answer, said):
    with pytest.raises(RigError, match=said):
        require_form(answer, "greedy", (2, 3))
    nothing = np.zeros((2, 3), np.float32)
    require_form(Answer(nothing * np.nan, nothing), "whole", (2, 3))


def test_repetitions_are_measured_once_and_all_may_stand_beside_names(config, monkeypatch):
    monkeypatch.setattr("rig.api.strategies.strategy_names", lambda: ("gray-spad",))
    found = compare_strategies(
        config, strategies=["all", "gray-spad"], times=["2ms", "0.002 s"], rules=["energy", "energy"],
        scenes=["ramp", "ramp"], fogs=["clear", "clear"], rows=4,
    )  # fmt: skip
    assert [row.strategy for row in found.rows] == ["gray-spad"]


def changed(config, **keys):
    """A copy of the config, beside it, with other values of its world's line or its scan."""
    content = yaml.safe_load(config.read_text())
    for section, values in keys.items():
        place = content["world"] if section == "line" else content
        place[section] = {**place.get(section, {}), **values}
    file = config.with_name("changed.yaml")
    file.write_text(yaml.safe_dump(content))
    return file


def test_invisible_light_has_no_class_and_more_columns_than_a_projector_has_are_said(config):
    asked = {"strategies": ["gray-spad"], "times": ["2ms"], "scenes": ["ramp"], "fogs": ["clear"], "rules": ["energy"]}
    (dark,) = compare_strategies(changed(config, line={"wavelength": "850 nm"}), **asked, rows=4).rows
    assert (dark.laser_class, dark.laser_class_still) == (None, None)
    with pytest.raises(UsageError, match="columns is 4800; a projector has 2 to 4096"):
        compare_strategies(changed(config, scan={"columns": 4800}), **asked, rows=4)


def test_a_flash_of_equal_irradiance_has_twice_the_power(config, monkeypatch):
    seen = []
    monkeypatch.setattr(compare, "class_of", lambda beam, wavelength_m: seen.append(beam.mean_w) or "1")
    compare_strategies(config, strategies=["lidar-peak"], times=["2ms"], scenes=["ramp"], fogs=["clear"], rows=4)
    energy_w, _, irradiance_w, _ = seen
    assert irradiance_w == pytest.approx(2 * energy_w)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"strategies": ["nonsense"]}, "nonsense"),
        ({"fogs": ["20"]}, "visibility with a unit"),
        ({"fogs": ["0 m"]}, "at least 0.1 m"),
        ({"times": ["fast"]}, "times"),
        ({"times": ["0 s"]}, "more than 0 s"),
        ({"times": ["101 s"]}, "at most 100 s"),
        ({"rules": ["fair"]}, "energy and irradiance"),
        ({"rows": 0}, "at least one row"),
        ({"lux": -1.0}, "lux"),
        ({"repeat": 0}, "repeat"),
        ({"seed": -1}, "seed"),
        ({"exposures": [3]}, "exposures"),
        ({"limits": False}, "limits"),
        ({"scenes": ["stret"]}, "did you mean street"),
        ({"strategies": ["all", "gray-sapd"]}, "gray-sapd"),
        ({"rows": 10_000}, "the camera has"),
    ],
)
def test_wrong_requests_are_refused_in_a_line(config, changes, said):
    with pytest.raises(UsageError, match=said) as error:
        compare_strategies(config, **{**SOME, "strategies": ["gray-spad"], **changes})
    assert "\n" not in str(error.value)


def test_air_replaces_what_the_scene_has(tmp_path, config):
    model = load_rig_model(config.parent / "rig.yaml")
    read = lambda *of: yaml.safe_load(scene_file(*of, model, tmp_path).read_text())  # noqa: E731
    assert read("street", "clear", None).keys() == {"surfaces", "ambient"}
    assert read("street", "20m", 7.0) == {
        "surfaces": "street", "ambient": {"illuminance": "7 lux"}, "medium": {"fog": {"visibility": "20m"}}
    }  # fmt: skip
    assert "rain" in read("street-dense-fog", "rain", None)
    assert "medium" in read("street-dense-fog", None, None)
    assert air_problems(["clear", "rain", "snow", "20 m", "own"]) == []
    assert (visibility_m("clear"), visibility_m("20m"), visibility_m("rain")) == (math.inf, 20.0, None)


def row(strategy="line-joint", air="clear", mean_px=1.0, range_m=None, time_ms=50.0, scene="ramp", rule="energy"):
    return StrategyRow(strategy, "line", scene, air, rule, time_ms, 100, mean_px, range_m=range_m)


def test_the_range_ends_at_the_farthest_bin_with_nine_good_pixels_in_ten():
    true_m = np.repeat([2.0, 4.0, 8.0], 100).astype(np.float32)
    reached = Reached(true_m)
    answer = true_m.copy()
    answer[105:111] *= 1.05  # 94 % good at 4 m
    answer[200:230] = np.nan  # 70 % at 8 m
    reached.add(answer)
    assert reached.range_m() == pytest.approx(4.0)
    nothing = Reached(true_m)
    nothing.add(np.full(300, np.nan, np.float32))
    assert nothing.range_m() is None


def test_ranges_are_told_by_air_of_known_visibility():
    rows = [row(range_m=9.0), row(air="20m", range_m=3.0), row(air="rain", range_m=5.0), row("x", scene="street")]
    assert ranges(rows, "ramp") == {("line-joint", 50.0, "energy"): {"clear": 9.0, "20m": 3.0}}


def test_a_picture_shows_the_best_of_each_kind():
    rows = [row(), row("line-edge", mean_px=2.0), row("line-camera", mean_px=3.0), row("gray-spad", mean_px=None)]
    assert best_of_kinds(rows) == ["line-joint", "line-camera", "gray-spad"]
    assert (kind_of("phase-gray-camera"), kind_of("bch"), kind_of("line-4-joint")) == ("phase-camera", "bch", "line")
    assert "line-edge" in time_svg(rows), "as few as these are all drawn"
    many = [*rows, *(row(f"gray-{i}", mean_px=9.0) for i in range(MOST_CURVES))]
    assert "line-edge" not in time_svg(many)
    assert f"{MOST_CURVES + 1} are left out" in " ".join(re.findall(r">([^<]+)<", time_svg(many)))
    both = visibility_svg([*rows, row(air="20m"), row(air="20m", time_ms=1.0)])
    assert "50 ms" in both


def test_csv_of_rows_reads_back():
    read = list(csv.DictReader(io.StringIO(csv_text([row(), row("gray-spad")]))))
    assert [line["strategy"] for line in read] == ["line-joint", "gray-spad"]


def test_classes_of_sources_stand_for_all_lights():
    assert compare.PROTECTED in find_strategy("bch").sentence
    assert compare.PROTECTED not in find_strategy("gray-spad").sentence


def test_tables_have_a_line_for_each_way_also_if_it_was_measured_by_one_rule_alone():
    def row(strategy: str, time_ms: float, **changes: object) -> StrategyRow:
        values = {"mean_px": 0.004, "good": 0.98, "confident_wrong": 0.01, **changes}
        return replace(StrategyRow(strategy, "line", "street", "20m", "energy", time_ms, 100), **values)

    rows = [
        row("line-joint", 1.0, mean_px=None, too_short="needs 2 ms"),
        row("line-joint", 50.0, laser_class="3R"),
        row("gray-spad", 50.0, rule="irradiance", laser_class="1"),
        row("line-joint", 50.0, rule="irradiance", laser_class="1"),
    ]
    energy, irradiance = figures_tables([*rows, row("line-edge", 50.0)])
    assert energy.title == "street, visibility 20m, equal energy"
    assert energy.head == ("", "1 ms", "50 ms")
    assert energy.lines == [("line-joint", "-", "0.004 / 98 / 1.0"), ("line-edge", "", "0.004 / 98 / 1.0")]
    assert [line[0] for line in irradiance.lines] == ["gray-spad", "line-joint"]
    sources = sources_table(rows, {"line-joint": {"street": 2.0}})
    assert sources.lines == [("line-joint", "line", "3R", "-", "2"), ("gray-spad", "line", "1", "-", "0")]
    assert ranges_table(rows) is None
    assert too_short_lines([*rows, row("line-joint", 2.0, too_short="needs 3 ms")]) == ["line-joint, 2 ms: needs 3 ms"]
