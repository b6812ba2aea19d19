"""Tables, figures and pages of studies."""

import csv
import io
import json
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import pytest

from rig.batch.case import Case
from rig.batch.engine import run_batch
from rig.batch.store import Row, Store, read_rows
from rig.errors import UsageError
from rig.report.csv_file import csv_of
from rig.study import tables as module
from rig.study.tables import lines_of, panels_of, study_report
from tests.unit.rig.batch.executors import Inline, squares, troubles


def row(labels: dict[str, Any], result: dict[str, Any], measured: dict[str, Any] | None = None) -> Row:
    """A finished case."""
    return Row("name", labels, result, measured or {})


def test_a_line_has_settings_figures_and_nested_figures() -> None:
    (line,), labels = lines_of([row({"scan.depth_range": ["1 m", "8 m"]}, {"error": 0.5})])
    assert (line, labels) == ({"scan.depth_range": "1 m; 8 m", "error": 0.5, "case": "name"}, ["scan.depth_range"])
    lines, labels = lines_of([row({"fog": "20m", "seed": 1}, {"error": 0.5, "fog": "x", "of": {"a": 1, "b": [1, 2]}})])
    assert lines == [{"fog": "20m", "seed": 1, "error": 0.5, "of.a": 1, "of.b": "1; 2", "case": "name"}]
    assert labels == ["fog", "seed"]


def test_a_case_of_several_rows_has_a_line_for_each_with_its_own_times() -> None:
    result = {"rows": [{"estimator": "edge", "error": 1.0}, {"estimator": "joint", "error": 0.5}], "light": 3}
    lines, labels = lines_of([row({"exposures": 3}, result, {"seconds": 9.0, "compute_ms": [1.0, 2.0]})])
    assert lines == [
        {"exposures": 3, "light": 3, "estimator": "edge", "error": 1.0, "compute_ms": 1.0, "case": "name"},
        {"exposures": 3, "light": 3, "estimator": "joint", "error": 0.5, "compute_ms": 2.0, "case": "name"},
    ]
    assert labels == ["exposures", "estimator"]


def test_the_csv_has_all_columns_of_all_lines() -> None:
    text = csv_of([{"a": 1, "b": "x, y"}, {"a": 2, "c": None}])
    assert list(csv.DictReader(io.StringIO(text))) == [
        {"a": "1", "b": "x, y", "c": ""}, {"a": "2", "b": "", "c": ""},
    ]  # fmt: skip
    assert "\r" not in text


def test_a_panel_shows_means_over_seeds_along_the_setting_with_most_numbers() -> None:
    lines = [
        {"fog": fog, "exposures": k, "seed": seed, "error": 10 * k + seed + more, "verdict": "ok"}
        for fog, more in (("clear", 0), ("20m", 100)) for k in (1, 3, 10) for seed in (0, 2)
    ]  # fmt: skip
    (panel,) = panels_of(lines, ["fog", "exposures", "seed"])
    assert [each.label for each in panel.series] == ["fog clear", "fog 20m"]
    assert panel.series[0].points == [(1.0, 11.0), (3.0, 31.0), (10.0, 101.0)]
    assert panel.series[0].intervals == [(10.0, 12.0), (30.0, 32.0), (100.0, 102.0)]
    assert panel.series[1].points[0] == (1.0, 111.0)


def test_without_numbers_to_go_along_there_is_no_panel() -> None:
    assert panels_of([{"fog": "clear", "error": 1.0}, {"fog": "20m", "error": 2.0}], ["fog"]) == []
    assert panels_of([{"seed": 1, "error": 1.0}, {"seed": 2, "error": 2.0}], ["seed"]) == []
    assert panels_of([{"on": True, "error": 1.0}, {"on": False, "error": 2.0}], ["on"]) == []


def test_errors_come_first_and_not_all_figures_are_shown() -> None:
    lines = [
        {"k": k, **{f"figure{n}": k + n for n in range(9)}, "stripe_error_px": k, "depth_error_m": k} for k in (1, 2)
    ]
    panels = panels_of(lines, ["k"])
    assert [panel.title for panel in panels[:3]] == ["depth error (m)", "stripe error (px)", "figure0"]
    assert len(panels) == module.MOST_PANELS


def test_the_page_of_a_study_has_its_lines_its_figure_and_how_to_repeat_what_failed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "SHOWN_LINES", 4)
    cases = [*squares(6), *troubles("raise", tmp_path / "counts", (7,))]
    with Store(tmp_path / "a study", cases) as store:
        done = run_batch(store, Inline(), command="rig batch study.yaml --out study")
    page = study_report(tmp_path / "a study")
    assert "Study a study" in page
    assert "6 of 7 cases are done" in page
    assert "x 7: raised: ValueError: no 7 second line" in page
    assert f"rig batch study.yaml --out study --case {done.failures[0].case}" in page
    assert "2 more lines are in table.csv" in page
    start = page.index("<svg")
    assert ElementTree.fromstring(page[start : page.index("</svg>", start) + 6]) is not None
    assert "http" not in page.replace("http://www.w3.org", ""), "the page needs no network"


def test_without_a_finished_case_there_is_no_page(tmp_path: Path) -> None:
    Store(tmp_path / "out", squares(2)).close()
    with pytest.raises(UsageError, match=r"has no finished case yet; run `rig batch` first"):
        study_report(tmp_path / "out")


def test_a_study_of_which_all_cases_failed_has_a_page_that_says_so(tmp_path: Path) -> None:
    with Store(tmp_path / "out", troubles("raise", tmp_path / "counts", (7,))) as store:
        run_batch(store, Inline())
    page = study_report(tmp_path / "out")
    assert "0 of 1 cases are done" in page
    assert "x 7: raised: ValueError: no 7 second line" in page


def test_columns_begin_with_what_varies_and_empty_ones_are_left_out(tmp_path: Path) -> None:
    cases = [
        Case("tests.unit.rig.study.test_tables:half_empty", {"n": n}, {"z_last": n, "estimator": "edge"})
        for n in (1, 2)
    ]
    with Store(tmp_path / "out", cases) as store:
        run_batch(store, Inline())
    page = study_report(tmp_path / "out")
    page = page[page.index("<table") :]
    heads = [page.index(f">{name}<") for name in ("estimator", "z last", "a error (px)", "error, missing (share)")]
    assert heads == sorted(heads)
    assert ">nothing<" not in page


def half_empty(n: int) -> dict[str, Any]:
    """A case: a figure, a share beside it, and nothing."""
    return {"error_px": {"missing": 0.5}, "a_error_px": n, "nothing": None}


def test_the_order_of_results_does_not_change_the_page_or_the_csv(tmp_path: Path) -> None:
    texts = set()
    for workers in (1, 4):
        folder = tmp_path / str(workers) / "study"
        with Store(folder, squares(5)) as store:
            run_batch(store, Inline(workers=workers))
        lines = [
            {key: value for key, value in line.items() if key in ("x", "y")}
            for line in lines_of([*read_rows(folder)])[0]
        ]
        texts.add(json.dumps(lines) + csv_of(lines))
    assert len(texts) == 1


def test_a_page_names_scenes_by_the_last_part_of_their_paths_and_figures_in_words(tmp_path: Path) -> None:
    folders = [str(tmp_path / name) for name in ("lab/street", "yard/street", "yard/wall")]
    cases = [
        Case("tests.unit.rig.study.test_tables:error_of", {"scene": scene, "n": n}, {"scene": scene, "n": n})
        for scene in folders for n in (1, 2)
    ]  # fmt: skip
    with Store(tmp_path / "out", cases) as store:
        run_batch(store, Inline())
    page = study_report(tmp_path / "out")
    assert f"<td>{folders[0]}</td>" in page
    assert "<td>wall</td>" in page
    assert folders[2] not in page
    assert "stripe error, mean abs (px)" in page.replace("\n", " ")
    assert "extinction (1/m)" in page


def error_of(scene: str, n: int) -> dict[str, Any]:
    """A case: figures with units in their names."""
    return {"stripe_error_px": {"mean_abs": len(scene) + n}, "extinction_per_m": 0.25 * n}
